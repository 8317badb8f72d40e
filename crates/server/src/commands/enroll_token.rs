//! `taskd enroll-token`: makes the tokens that robots enrol with.

use std::time::Duration;

use clap::Subcommand;
use task_proto::api::{CreateEnrollmentToken, EnrollmentToken};
use task_proto::id::{LabelKey, LabelValue};

use super::output::{say, time};
use super::{CommandError, Outcome, Session};
use crate::config::lifetime;

/// What to do with enrolment tokens.
#[derive(Debug, Subcommand)]
pub enum Action {
    /// Make one and print it; it is shown this once
    Create {
        /// Only this robot (id or name) may register again with it
        #[arg(long, value_name = "ROBOT")]
        robot: Option<String>,
        /// How many enrolments it is good for [default: any number]
        #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
        uses: Option<u64>,
        /// How long it lives, like 2h or 7d [default: 1d]
        #[arg(long, value_name = "TIME", value_parser = lifetime)]
        ttl: Option<Duration>,
        /// A label that each robot that uses it gets; may be repeated
        #[arg(long = "label", value_name = "KEY=VALUE", value_parser = label)]
        labels: Vec<(LabelKey, LabelValue)>,
    },
}

pub(super) async fn run(session: &Session, action: Action) -> Result<Outcome, CommandError> {
    let Action::Create { robot, uses, ttl, labels } = action;
    let request = CreateEnrollmentToken {
        robot,
        uses,
        ttl_s: ttl.map(|ttl| ttl.as_secs()),
        labels: labels.into_iter().collect(),
    };
    let key = super::client::random_key();
    let token: EnrollmentToken = session.client.order("/enrollment-tokens", &request, &key).await?;
    session.output.described(&token, |token| token.token.clone())?;
    say(&format!("valid until {}; it is not shown again", time(token.expires_at_ms)));
    Ok(Outcome::Succeeded)
}

fn label(text: &str) -> Result<(LabelKey, LabelValue), String> {
    let (key, value) = text.split_once('=').ok_or_else(|| "expected KEY=VALUE".to_owned())?;
    let key = key.parse().map_err(|error: task_proto::id::InvalidId| error.to_string())?;
    let value = value.parse().map_err(|error: task_proto::id::InvalidId| error.to_string())?;
    Ok((key, value))
}
