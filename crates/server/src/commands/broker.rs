//! `taskd broker`: what an external broker has to know, for its own files.

use clap::Subcommand;
use task_proto::api::BrokerFiles;

use super::output::stream_text;
use super::{CommandError, Outcome, Session};

/// What to do about an external broker.
#[derive(Debug, Subcommand)]
pub enum Action {
    /// Print the access control list, as mosquitto reads it (acl_file)
    Acl,
    /// Print the password file of the server and all robots, as mosquitto reads it (password_file)
    Passwd,
}

pub(super) async fn run(session: &Session, action: Action) -> Result<Outcome, CommandError> {
    let files: BrokerFiles = session.client.get("/broker", &[]).await?;
    // The broker reads it, so it is the same in every format.
    stream_text(match action {
        Action::Acl => &files.acl,
        Action::Passwd => &files.passwd,
    })?;
    Ok(Outcome::Succeeded)
}
