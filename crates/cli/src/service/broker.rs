//! `taskd broker`: the settings of an external broker, in the formats of its own files.

use clap::Subcommand;
use task_proto::api::{BrokerFiles, NatsFile};

use crate::display::output::stream_text;
use crate::{CommandError, Outcome, Session};

#[derive(Debug, Subcommand)]
pub enum Action {
    /// Print the access control list for mosquitto (acl_file)
    Acl,
    /// Print the password file for mosquitto, with the server and all robots (password_file)
    Passwd,
    /// Print the listener configuration for mosquitto
    Conf,
    /// Print the authorization block for nats-server: users, password hashes, permissions
    Nats,
}

pub(crate) async fn run(session: &Session, action: Action) -> Result<Outcome, CommandError> {
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
