//! `taskd enroll-token`: the tokens that robots enrol with.

use std::time::Duration;

use clap::Subcommand;
use task_proto::TokenId;
use task_proto::api::{CreateEnrollmentToken, EnrollmentToken, EnrollmentTokenList, EnrollmentTokenView};
use task_proto::id::{LabelKey, LabelValue};

use super::output::{say, time};
use super::table::Columns;
use super::{CommandError, Outcome, Session, complete};
use crate::config::{at_least_one, lifetime};

/// What to do with enrolment tokens.
#[derive(Debug, Subcommand)]
pub enum Action {
    /// Make one and print it; it is shown this once
    Create {
        /// Only this robot (id or name) may register again with it
        #[arg(long, value_name = "ROBOT", add = complete::robots())]
        robot: Option<String>,
        /// How many enrolments it is good for [default: any number]
        #[arg(long, value_name = "N", value_parser = at_least_one)]
        uses: Option<u64>,
        /// How long it lives, like 2h or 7d [default: 1d]
        #[arg(long, value_name = "TIME", value_parser = lifetime)]
        ttl: Option<Duration>,
        /// A label that each robot that uses it gets; may be repeated
        #[arg(long = "label", value_name = "KEY=VALUE", value_parser = label)]
        labels: Vec<(LabelKey, LabelValue)>,
        /// Let each new robot that uses it wait until an administrator approves it (taskd robot approve)
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

pub(super) async fn run(session: &Session, action: Action) -> Result<Outcome, CommandError> {
    match action {
        Action::Create { robot, uses, ttl, labels, approval } => {
            let ttl_s = ttl.map(|ttl| ttl.as_secs());
            let request = CreateEnrollmentToken { robot, uses, ttl_s, labels: labels.into_iter().collect(), approval };
            let key = super::client::random_key();
            let token: EnrollmentToken = session.client.order("/enrollment-tokens", &request, &key).await?;
            session.output.described(&token, |token| token.id.clone(), |token| token.token.clone())?;
            say(&format!("{}, valid until {}; it is not shown again", token.id, time(token.expires_at_ms)));
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

const COLUMNS: Columns = Columns::of(&["id", "robot", "labels", "uses left", "approval", "made", "ends"]);

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
