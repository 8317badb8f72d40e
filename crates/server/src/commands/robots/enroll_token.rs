//! `taskd enroll-token`: the tokens that robots enroll with.

use std::str::FromStr;
use std::time::Duration;

use clap::Subcommand;
use task_proto::TokenId;
use task_proto::api::{
    CreateEnrollmentToken, EnrollmentToken, EnrollmentTokenList, EnrollmentTokenView,
};
use task_proto::id::{LabelKey, LabelValue};

use crate::commands::api::complete;
use crate::commands::display::output::table::Columns;
use crate::commands::display::output::{robots, say, time};
use crate::commands::{CommandError, Outcome, Session};
use crate::config::{at_least_one, lifetime};

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
            text => at_least_one(text).map(Self::Number).map_err(|_| {
                format!("{text:?} is neither a whole number, at least 1, nor \"unlimited\"")
            }),
        }
    }
}

/// What to do with enrollment tokens.
#[derive(Debug, Subcommand)]
pub enum Action {
    /// Make one and print it; it is shown this once
    Create {
        /// Only this robot (id or name) may register again with it
        #[arg(long, value_name = "ROBOT", add = complete::robots())]
        robot: Option<String>,
        /// How many enrollments it is good for [default: the server's setting enrollment.uses, 100]
        #[arg(long, value_name = "N|unlimited")]
        uses: Option<Uses>,
        /// How long it lives, like 2h or 7d [default: 1d]
        #[arg(long, value_name = "TIME", value_parser = lifetime)]
        ttl: Option<Duration>,
        /// A label that each robot that uses it gets; may be repeated
        #[arg(long = "label", value_name = "KEY=VALUE", value_parser = label)]
        labels: Vec<(LabelKey, LabelValue)>,
        /// Let each new robot that uses it wait until an administrator approves it (taskd robot
        /// approve)
        #[arg(long)]
        approval: bool,
    },
    /// List those that are still good for something
    List,
    /// End one now; robots that came by it stay
    Revoke {
        /// Its id
        #[arg(add = complete::enrollment_tokens())]
        id: TokenId,
    },
}

pub(in crate::commands) async fn run(
    session: &Session,
    action: Action,
) -> Result<Outcome, CommandError> {
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
            let key = crate::commands::api::client::random_key();
            let token: EnrollmentToken =
                session.client.order("/enrollment-tokens", &request, &key).await?;
            session.output.described(
                &token,
                |token| token.id.clone(),
                |token| token.token.clone(),
            )?;
            let good_for =
                token.uses_left.map_or_else(|| "any number of robots".to_owned(), robots);
            let until = time(token.expires_at_ms);
            say(&format!(
                "{}, good for {good_for}, valid until {until}; it is not shown again",
                token.id
            ));
        }
        Action::List => {
            let list: EnrollmentTokenList = session.client.get("/enrollment-tokens", &[]).await?;
            session.output.result(&list, &COLUMNS, |list| list.tokens.iter().map(row).collect())?;
        }
        Action::Revoke { id } => {
            session.client.delete(&format!("/enrollment-tokens/{id}")).await?;
            say(&format!("revoked {id}"));
        }
    }
    Ok(Outcome::Succeeded)
}

const COLUMNS: Columns =
    Columns::of(&["id", "robot", "labels", "uses left", "approval", "made", "ends"]);

fn row(token: &EnrollmentTokenView) -> Vec<String> {
    let labels: Vec<_> = token.labels.iter().map(|(key, value)| format!("{key}={value}")).collect();
    vec![
        token.id.to_string(),
        token.robot.as_ref().map_or_else(|| "any new one".to_owned(), ToString::to_string),
        if labels.is_empty() { "-".to_owned() } else { labels.join(" ") },
        token.uses_left.map_or_else(|| "any number".to_owned(), |uses| uses.to_string()),
        if token.approval { "yes" } else { "-" }.to_owned(),
        time(token.created_at_ms),
        time(token.expires_at_ms),
    ]
}

fn label(text: &str) -> Result<(LabelKey, LabelValue), String> {
    let (key, value) = text.split_once('=').ok_or_else(|| "expected KEY=VALUE".to_owned())?;
    let key = key.parse().map_err(|error: task_proto::id::InvalidId| error.to_string())?;
    let value = value.parse().map_err(|error: task_proto::id::InvalidId| error.to_string())?;
    Ok((key, value))
}
