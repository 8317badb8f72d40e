//! `taskd user`: users and their rights.

use clap::Subcommand;
use task_proto::UserName;
use task_proto::api::{AddUser, ChangePassword, EditUser, Me, SetPassword, UserList, UserView};
use task_proto::ids::selector::Selector;
use task_proto::people::roles::Roles;

use crate::api::complete;
use crate::display::confirm::confirm_irreversible;
use crate::display::output::table::Columns;
use crate::display::output::{facts, say, time};
use crate::display::password::{self, PasswordSource, Secret};
use crate::{CommandError, Outcome, Session};

#[derive(Debug, Subcommand)]
pub enum Action {
    /// Add a user
    Add {
        /// User name, for sign-in
        name: UserName,
        /// Roles: viewer, operator, publisher, admin, or several separated by commas
        #[arg(long, value_name = "ROLES")]
        role: Roles,
        /// Limit the user to the robots that match, such as site=lab
        #[arg(long, value_name = "SELECTOR", add = complete::selectors())]
        robots: Option<Selector>,
        /// No password: the user can only use tokens that an administrator creates
        #[arg(long, conflicts_with = "password_stdin")]
        no_password: bool,
        #[command(flatten)]
        from: PasswordSource,
    },
    /// List users and their roles
    List,
    /// Change the roles or the robots of a user
    Edit {
        /// User name
        #[arg(add = complete::users())]
        name: UserName,
        /// New roles, in place of the current ones
        #[arg(long, value_name = "ROLES")]
        role: Option<Roles>,
        /// Limit the user to the robots that match; '*' for no limit
        #[arg(long, value_name = "SELECTOR", add = complete::selectors())]
        robots: Option<Selector>,
    },
    /// Remove a user and revoke their tokens
    Remove {
        /// User name
        #[arg(add = complete::users())]
        name: UserName,
        /// Skip the confirmation prompt
        #[arg(short, long)]
        yes: bool,
    },
    /// Change your password, or with a name, set that user's password
    Passwd {
        /// User name [default: yourself; requires the current password]
        #[arg(add = complete::users())]
        name: Option<UserName>,
        #[command(flatten)]
        from: PasswordSource,
    },
}

pub(crate) async fn run(session: &Session, action: Action) -> Result<Outcome, CommandError> {
    let client = &session.client;
    match action {
        Action::Add { name, role, robots, no_password, from } => {
            let password = match no_password {
                true => None,
                false => Some(
                    password::prompt_new(from.password_stdin, &format!("password of {name}"))?
                        .reveal(),
                ),
            };
            let order = AddUser { name, roles: role, scope: robots, password };
            let view: UserView = client.post_once("/users", &order).await?;
            show(session, &UserList { users: vec![view] })?;
        }
        Action::List => show(session, &client.get("/users", &[]).await?)?,
        Action::Edit { name, role, robots } => {
            if role.is_none() && robots.is_none() {
                return Err(CommandError::Usage(
                    "nothing to change: give --role or --robots".to_owned(),
                ));
            }
            let order = EditUser { roles: role, scope: robots };
            let view: UserView = client.patch(&format!("/users/{name}"), &order).await?;
            show(session, &UserList { users: vec![view] })?;
        }
        Action::Remove { name, yes } => {
            confirm_irreversible(&format!("remove user {name}"), yes)?;
            client.delete(&format!("/users/{name}")).await?;
            say(&format!("removed user {name} and revoked their tokens"));
        }
        Action::Passwd { name: Some(name), from } => {
            let password =
                password::prompt_new(from.password_stdin, &format!("new password of {name}"))?
                    .reveal();
            client.put(&format!("/users/{name}/password"), &SetPassword { password }).await?;
            say(&format!("password set; all sessions of {name} are signed out"));
        }
        Action::Passwd { name: None, from } => {
            let me: Me = client.get("/me", &[]).await?;
            let old =
                password::prompt(from.password_stdin, &format!("current password of {}", me.name))
                    .map(Secret::reveal)?;
            let new = password::prompt_new(from.password_stdin, "new password")?.reveal();
            client.put("/password", &ChangePassword { old, new }).await?;
            say("password changed; you are signed out everywhere else");
        }
    }
    Ok(Outcome::Succeeded)
}

/// `taskd whoami`: the user of the token, and the token's rights.
pub(crate) async fn whoami(session: &Session) -> Result<Outcome, CommandError> {
    let me: Me = session.client.get("/me", &[]).await?;
    let name = |me: &Me| me.name.to_string();
    session.output.print_object(&me, name, |me| {
        let permissions: Vec<&str> =
            me.permissions.iter().map(|permission| permission.as_str()).collect();
        let scope: Vec<String> = me.scope.iter().map(Selector::to_string).collect();
        facts([
            ("name", me.name.to_string()),
            ("roles", me.roles.to_string()),
            ("permissions", permissions.join(", ")),
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
    session.output.print_list(list, &COLUMNS, |list| list.users.iter().map(row).collect())
}
