//! `taskd user`: users and their rights.

use clap::Subcommand;
use task_proto::UserName;
use task_proto::api::{AddUser, ChangePassword, EditUser, Me, SetPassword, UserList, UserView};
use task_proto::person::Roles;
use task_proto::selector::Selector;

use crate::commands::api::complete;
use crate::commands::display::confirm::always;
use crate::commands::display::output::table::Columns;
use crate::commands::display::output::{facts, say, time};
use crate::commands::display::password::{self, PasswordFrom, Secret};
use crate::commands::{CommandError, Outcome, Session};

/// What to do with users.
#[derive(Debug, Subcommand)]
pub enum Action {
    /// Add a user
    Add {
        /// What they sign in with
        name: UserName,
        /// What they may do: viewer, operator, publisher, admin, or several joined by commas
        #[arg(long, value_name = "ROLES")]
        role: Roles,
        /// Only robots that this selector means, like site=lab
        #[arg(long, value_name = "SELECTOR", add = complete::selectors())]
        robots: Option<Selector>,
        /// Without a password: only with tokens that an administrator makes for them
        #[arg(long, conflicts_with = "password_stdin")]
        no_password: bool,
        #[command(flatten)]
        from: PasswordFrom,
    },
    /// List users
    List,
    /// Change what a user may do
    Edit {
        /// Who
        #[arg(add = complete::users())]
        name: UserName,
        /// The roles they have from now on
        #[arg(long, value_name = "ROLES")]
        role: Option<Roles>,
        /// The robots they are limited to from now on; '*' for no limit
        #[arg(long, value_name = "SELECTOR", add = complete::selectors())]
        robots: Option<Selector>,
    },
    /// Remove a user; their tokens end now
    Remove {
        /// Who
        #[arg(add = complete::users())]
        name: UserName,
        /// Don't ask
        #[arg(short, long)]
        yes: bool,
    },
    /// Set a password: one's own, or with a name anybody's
    Passwd {
        /// Whose; absent: one's own, which takes the old one
        #[arg(add = complete::users())]
        name: Option<UserName>,
        #[command(flatten)]
        from: PasswordFrom,
    },
}

pub(in crate::commands) async fn run(
    session: &Session,
    action: Action,
) -> Result<Outcome, CommandError> {
    let client = &session.client;
    match action {
        Action::Add { name, role, robots, no_password, from } => {
            let password = match no_password {
                true => None,
                false => Some(
                    password::new_one(from.password_stdin, &format!("password of {name}"))?
                        .reveal(),
                ),
            };
            let order = AddUser { name, roles: role, scope: robots, password };
            let view: UserView = client.once("/users", &order).await?;
            show(session, &UserList { users: vec![view] })?;
        }
        Action::List => show(session, &client.get("/users", &[]).await?)?,
        Action::Edit { name, role, robots } => {
            if role.is_none() && robots.is_none() {
                return Err(CommandError::Usage("give --role or --robots".to_owned()));
            }
            let order = EditUser { roles: role, scope: robots };
            let view: UserView = client.change(&format!("/users/{name}"), &order).await?;
            show(session, &UserList { users: vec![view] })?;
        }
        Action::Remove { name, yes } => {
            always(&format!("remove the user {name}"), yes)?;
            client.delete(&format!("/users/{name}")).await?;
            say(&format!("removed {name}; their tokens have ended"));
        }
        Action::Passwd { name: Some(name), from } => {
            let password =
                password::new_one(from.password_stdin, &format!("new password of {name}"))?
                    .reveal();
            client.put(&format!("/users/{name}/password"), &SetPassword { password }).await?;
            say(&format!("set; what {name} was signed in to is signed out"));
        }
        Action::Passwd { name: None, from } => {
            let me: Me = client.get("/me", &[]).await?;
            let old = password::ask(from.password_stdin, &format!("old password of {}", me.name))
                .map(Secret::reveal)?;
            let new = password::new_one(from.password_stdin, "new password")?.reveal();
            client.put("/password", &ChangePassword { old, new }).await?;
            say("set; you are signed out everywhere else");
        }
    }
    Ok(Outcome::Succeeded)
}

/// `taskd whoami`: the user of the token, and the token's rights.
pub(in crate::commands) async fn who_am_i(session: &Session) -> Result<Outcome, CommandError> {
    let me: Me = session.client.get("/me", &[]).await?;
    let name = |me: &Me| me.name.to_string();
    session.output.described(&me, name, |me| {
        let permissions: Vec<&str> =
            me.permissions.iter().map(|permission| permission.as_str()).collect();
        let scope: Vec<String> = me.scope.iter().map(Selector::to_string).collect();
        facts([
            ("name", me.name.to_string()),
            ("roles", me.roles.to_string()),
            ("may", permissions.join(", ")),
            ("robots", if scope.is_empty() { "*".to_owned() } else { scope.join(" and ") }),
            ("token", me.token.to_string()),
        ])
    })?;
    Ok(Outcome::Succeeded)
}

const COLUMNS: Columns = Columns::of(&["name", "roles", "robots", "password", "added"]);

fn show(session: &Session, list: &UserList) -> Result<(), CommandError> {
    let row = |user: &UserView| {
        vec![
            user.name.to_string(),
            user.roles.to_string(),
            user.scope.as_ref().map_or_else(|| "*".to_owned(), Selector::to_string),
            match (&user.subject, user.has_password) {
                (Some(_), _) => "by provider",
                (None, true) => "yes",
                (None, false) => "no",
            }
            .to_owned(),
            time(user.created_at_ms),
        ]
    };
    session.output.result(list, &COLUMNS, |list| list.users.iter().map(row).collect())
}
