//! `taskd token`: the access tokens of people and of their programs.

use std::time::Duration;

use clap::Subcommand;
use task_proto::api::{AccessToken, CreateToken, TokenList, TokenOrigin, TokenView};
use task_proto::person::Roles;
use task_proto::selector::Selector;
use task_proto::{TokenId, UserName};

use crate::commands::api::complete;
use crate::commands::display::output::table::Columns;
use crate::commands::display::output::{say, time};
use crate::commands::{CommandError, Outcome, Session};
use crate::config::lifetime;

/// What to do with access tokens.
#[derive(Debug, Subcommand)]
pub enum Action {
    /// Make one and print it; it is shown this once
    Create {
        /// What it is for
        #[arg(long, value_name = "TEXT", default_value = "")]
        title: String,
        /// Whose it is, which takes an administrator [default: one's own]
        #[arg(long, value_name = "NAME", add = complete::users())]
        user: Option<UserName>,
        /// Only these of its user's roles
        #[arg(long, value_name = "ROLES")]
        role: Option<Roles>,
        /// Only robots that this selector means, like site=lab
        #[arg(long, value_name = "SELECTOR", add = complete::selectors())]
        robots: Option<Selector>,
        /// How long it lives, like 12h or 30d [default: 90d]
        #[arg(long, value_name = "TIME", value_parser = lifetime)]
        ttl: Option<Duration>,
    },
    /// List one's own tokens, sign-ins among them
    List {
        /// Everybody's
        #[arg(long)]
        all: bool,
    },
    /// End one now
    Revoke {
        /// Its id
        #[arg(add = complete::tokens())]
        id: TokenId,
    },
}

pub(in crate::commands) async fn run(
    session: &Session,
    action: Action,
) -> Result<Outcome, CommandError> {
    match action {
        Action::Create { title, user, role, robots, ttl } => {
            let ttl_s = ttl.map(|ttl| ttl.as_secs());
            let order = CreateToken { user, title, roles: role, scope: robots, ttl_s };
            let token: AccessToken = session.client.once("/tokens", &order).await?;
            session.output.described(
                &token,
                |token| token.id.to_string(),
                |token| token.token.clone(),
            )?;
            say(&format!(
                "{} of {}, valid until {}; it is not shown again",
                token.id,
                token.user,
                time(token.expires_at_ms)
            ));
        }
        Action::List { all } => {
            let list: TokenList =
                session.client.get("/tokens", &[("all", all.to_string())]).await?;
            session.output.result(&list, &COLUMNS, |list| list.tokens.iter().map(row).collect())?;
        }
        Action::Revoke { id } => {
            session.client.delete(&format!("/tokens/{id}")).await?;
            say(&format!("revoked {id}"));
        }
    }
    Ok(Outcome::Succeeded)
}

const COLUMNS: Columns =
    Columns::of(&["id", "user", "origin", "title", "roles", "robots", "made", "ends"]);

fn row(token: &TokenView) -> Vec<String> {
    let origin = match token.origin {
        TokenOrigin::First => "first",
        TokenOrigin::Token => "token",
        TokenOrigin::Login => "login",
        TokenOrigin::Page => "page",
    };
    let ends = match (token.revoked_at_ms, token.expires_at_ms) {
        (Some(_), _) => "revoked".to_owned(),
        (None, Some(expires_at_ms)) => time(expires_at_ms),
        (None, None) => "never".to_owned(),
    };
    vec![
        token.id.to_string(),
        token.user.to_string(),
        origin.to_owned(),
        token.title.clone(),
        token.roles.as_ref().map_or_else(|| "all".to_owned(), Roles::to_string),
        token.scope.as_ref().map_or_else(|| "all".to_owned(), Selector::to_string),
        time(token.created_at_ms),
        ends,
    ]
}
