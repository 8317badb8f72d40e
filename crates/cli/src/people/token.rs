//! `taskd token`: the access tokens of people and of their programs.

use std::time::Duration;

use clap::Subcommand;
use task_proto::api::{AccessToken, CreateToken, TokenList, TokenOrigin, TokenView};
use task_proto::ids::selector::Selector;
use task_proto::people::roles::Roles;
use task_proto::time::parse_lifetime;
use task_proto::{TokenId, UserName};

use crate::api::complete;
use crate::display::output::table::Columns;
use crate::display::output::{say, time};
use crate::{CommandError, Outcome, Session};

#[derive(Debug, Subcommand)]
pub enum Action {
    /// Create a token and print it; it is shown only once
    Create {
        /// Purpose of the token
        #[arg(long, value_name = "TEXT", default_value = "")]
        title: String,
        /// User of the token; for other users, administrators only [default: yourself]
        #[arg(long, value_name = "NAME", add = complete::users())]
        user: Option<UserName>,
        /// Limit the token to these of the user's roles
        #[arg(long, value_name = "ROLES")]
        role: Option<Roles>,
        /// Limit the token to the robots that match, such as site=lab
        #[arg(long, value_name = "SELECTOR", add = complete::selectors())]
        robots: Option<Selector>,
        /// Lifetime, such as 12h or 30d [default: 90d]
        #[arg(long, value_name = "TIME", value_parser = parse_lifetime)]
        ttl: Option<Duration>,
    },
    /// List your tokens and sign-ins
    List {
        /// List the tokens of all users
        #[arg(long)]
        all: bool,
    },
    /// Revoke a token now
    Revoke {
        /// Token id
        #[arg(add = complete::tokens())]
        id: TokenId,
    },
}

pub(crate) async fn run(session: &Session, action: Action) -> Result<Outcome, CommandError> {
    match action {
        Action::Create { title, user, role, robots, ttl } => {
            let ttl_s = ttl.map(|ttl| ttl.as_secs());
            let order = CreateToken { user, title, roles: role, scope: robots, ttl_s };
            let token: AccessToken = session.client.post_once("/tokens", &order).await?;
            session.output.print_object(
                &token,
                |token| token.id.to_string(),
                |token| token.token.clone(),
            )?;
            say(&format!(
                "token {} of {}, valid until {}; it is not shown again",
                token.id,
                token.user,
                time(token.expires_at_ms)
            ));
        }
        Action::List { all } => {
            let list: TokenList =
                session.client.get("/tokens", &[("all", all.to_string())]).await?;
            session
                .output
                .print_list(&list, &COLUMNS, |list| list.tokens.iter().map(row).collect())?;
        }
        Action::Revoke { id } => {
            session.client.delete(&format!("/tokens/{id}")).await?;
            say(&format!("revoked token {id}"));
        }
    }
    Ok(Outcome::Succeeded)
}

const COLUMNS: Columns =
    Columns::of(&["id", "user", "origin", "title", "roles", "robots", "created", "expires"]);

fn row(token: &TokenView) -> Vec<String> {
    let origin = match token.origin {
        TokenOrigin::First => "first",
        TokenOrigin::Token => "token",
        TokenOrigin::Login => "login",
        TokenOrigin::Page => "page",
    };
    let expires = match (token.revoked_at_ms, token.expires_at_ms) {
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
        expires,
    ]
}
