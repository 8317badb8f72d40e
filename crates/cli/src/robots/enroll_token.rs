//! `taskd enroll-token`: the tokens that robots enroll with.

use std::num::NonZeroU64;
use std::str::FromStr;
use std::time::Duration;

use clap::Subcommand;
use task_proto::TokenId;
use task_proto::api::{
    CreateEnrollmentToken, EnrollmentToken, EnrollmentTokenList, EnrollmentTokenView,
};
use task_proto::ids::{LabelKey, LabelValue};
use task_proto::time::parse_lifetime;

use crate::api::complete;
use crate::display::output::table::Columns;
use crate::display::output::{robots, say, time};
use crate::{CommandError, Outcome, Session};

/// Number of enrollments of a token.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Uses {
    /// A number of uses.
    Number(u64),
    Unlimited,
}

impl FromStr for Uses {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "unlimited" => Ok(Self::Unlimited),
            text => text.parse().map(|uses: NonZeroU64| Self::Number(uses.get())).map_err(|_| {
                format!("{text:?} is neither a positive whole number nor \"unlimited\"")
            }),
        }
    }
}

#[derive(Debug, Subcommand)]
pub enum Action {
    /// Create a token and print it; it is shown only once
    Create {
        /// Only for this robot (name or id), to enroll again
        #[arg(long, value_name = "ROBOT", add = complete::robots())]
        robot: Option<String>,
        /// Number of enrollments [default: the server's setting enrolment.uses]
        #[arg(long, value_name = "N|unlimited")]
        uses: Option<Uses>,
        /// Lifetime, such as 2h or 7d [default: 1d]
        #[arg(long, value_name = "TIME", value_parser = parse_lifetime)]
        ttl: Option<Duration>,
        /// Label for each robot that enrolls with the token; may be repeated
        #[arg(long = "label", value_name = "KEY=VALUE", value_parser = label)]
        labels: Vec<(LabelKey, LabelValue)>,
        /// Require an administrator's approval of each new robot (see taskd robot approve)
        #[arg(long)]
        approval: bool,
    },
    /// List valid tokens
    List,
    /// Revoke a token now; robots that enrolled with it stay
    Revoke {
        /// Token id
        #[arg(add = complete::enrollment_tokens())]
        id: TokenId,
    },
}

pub(crate) async fn run(session: &Session, action: Action) -> Result<Outcome, CommandError> {
    match action {
        Action::Create { robot, uses, ttl, labels, approval } => {
            let ttl_s = ttl.map(|ttl| ttl.as_secs());
            let (unlimited, uses) = match uses {
                Some(Uses::Unlimited) => (true, None),
                Some(Uses::Number(uses)) => (false, Some(uses)),
                None => (false, None),
            };
            let labels = labels.into_iter().collect();
            let request = CreateEnrollmentToken { robot, uses, unlimited, ttl_s, labels, approval };
            let key = crate::api::client::random_key();
            let token: EnrollmentToken =
                session.client.post_with_key("/enrollment-tokens", &request, &key).await?;
            session.output.print_object(
                &token,
                |token| token.id.clone(),
                |token| token.token.clone(),
            )?;
            let robot_count =
                token.uses_left.map_or_else(|| "any number of robots".to_owned(), robots);
            let until = time(token.expires_at_ms);
            say(&format!(
                "token {}, for {robot_count}, valid until {until}; it is not shown again",
                token.id
            ));
        }
        Action::List => {
            let list: EnrollmentTokenList = session.client.get("/enrollment-tokens", &[]).await?;
            session
                .output
                .print_list(&list, &COLUMNS, |list| list.tokens.iter().map(row).collect())?;
        }
        Action::Revoke { id } => {
            session.client.delete(&format!("/enrollment-tokens/{id}")).await?;
            say(&format!("revoked token {id}"));
        }
    }
    Ok(Outcome::Succeeded)
}

const COLUMNS: Columns =
    Columns::of(&["id", "robot", "labels", "uses left", "approval", "created", "expires"]);

fn row(token: &EnrollmentTokenView) -> Vec<String> {
    let labels: Vec<_> = token.labels.iter().map(|(key, value)| format!("{key}={value}")).collect();
    vec![
        token.id.to_string(),
        token.robot.as_ref().map_or_else(|| "any new robot".to_owned(), ToString::to_string),
        if labels.is_empty() { "-".to_owned() } else { labels.join(" ") },
        token.uses_left.map_or_else(|| "unlimited".to_owned(), |uses| uses.to_string()),
        if token.approval { "yes" } else { "-" }.to_owned(),
        time(token.created_at_ms),
        time(token.expires_at_ms),
    ]
}

fn label(text: &str) -> Result<(LabelKey, LabelValue), String> {
    let (key, value) = text.split_once('=').ok_or_else(|| "expected KEY=VALUE".to_owned())?;
    let key = key.parse().map_err(|error: task_proto::ids::InvalidId| error.to_string())?;
    let value = value.parse().map_err(|error: task_proto::ids::InvalidId| error.to_string())?;
    Ok((key, value))
}
