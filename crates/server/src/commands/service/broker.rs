//! `taskd broker`: the settings of an external broker, in the formats of its own files.

use clap::Subcommand;
use task_proto::api::{BrokerFiles, NatsFile};

use crate::commands::display::output::stream_text;
use crate::commands::{CommandError, Outcome, Session};

/// What to do about an external broker.
#[derive(Debug, Subcommand)]
pub enum Action {
    /// Print the access control list, as mosquitto reads it (acl_file)
    Acl,
    /// Print the password file of the server and all robots, as mosquitto reads it (password_file)
    Passwd,
    /// Print the configuration of mosquitto's listener
    Conf,
    /// Print users, password hashes and permissions, as nats-server reads them (authorization)
    Nats,
}

pub(in crate::commands) async fn run(
    session: &Session,
    action: Action,
) -> Result<Outcome, CommandError> {
    let files = async || session.client.get::<BrokerFiles>("/broker", &[]).await;
    let text = match action {
        Action::Acl => files().await?.acl,
        Action::Passwd => files().await?.passwd,
        Action::Conf => files().await?.conf,
        Action::Nats => session.client.get::<NatsFile>("/broker/nats", &[]).await?.authorization,
    };
    // The broker reads this text, so the text is the same in every output format.
    stream_text(&text)?;
    Ok(Outcome::Succeeded)
}
