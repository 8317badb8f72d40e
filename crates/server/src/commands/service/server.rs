//! `taskd server`: the server's description and its traffic.

use clap::Subcommand;
use task_proto::api::{ServerInfo, Traffic};

use super::status;
use crate::commands::display::output::{bytes, facts, time};
use crate::commands::{CommandError, Outcome, Session};

/// What to do with the server.
#[derive(Debug, Subcommand)]
pub enum Action {
    /// Show its version, its MQTT address and the traffic since it started
    Info,
    /// Show who is connected over MQTT, and what each listens to
    Sessions,
    /// Show by what rules packages travel, and the limits that hold
    Rules,
}

pub(in crate::commands) async fn run(
    session: &Session,
    action: Action,
) -> Result<Outcome, CommandError> {
    match action {
        Action::Info => {
            let info: ServerInfo = session.client.get("/server", &[]).await?;
            session.output.described(&info, |info| info.version.clone(), describe)?;
            Ok(Outcome::Succeeded)
        }
        Action::Sessions => status::sessions(session).await,
        Action::Rules => status::rules(session).await,
    }
}

fn describe(info: &ServerInfo) -> String {
    let (traffic, http, conduct) = (&info.traffic, &info.http, &info.conduct);
    facts([
        ("version", info.version.clone()),
        ("time", time(info.now_ms)),
        ("mqtt", info.mqtt.clone()),
        ("tls", info.ca_pin.map_or_else(|| "off".to_owned(), |pin| format!("pin {pin}"))),
        ("robots", format!("{} connected", traffic.robots_connected)),
        (
            "connections",
            format!(
                "{} accepted, {} refused",
                traffic.connections_accepted, traffic.connections_refused
            ),
        ),
        (
            "messages",
            format!("{} refused, {} dropped", traffic.messages_refused, traffic.messages_dropped),
        ),
        ("in", inward(&traffic.all)),
        ("out", outward(&traffic.all)),
        (
            "misbehaved",
            format!(
                "{} slowed, {} cut off, {} turned away",
                conduct.slowed, conduct.cut, conduct.turned_away
            ),
        ),
        ("http", format!("{} connections, {} requests", http.connections, http.requests)),
        ("http in", bytes(http.bytes_in)),
        ("http out", bytes(http.bytes_out)),
    ])
}

/// Incoming traffic, in words.
pub(in crate::commands) fn inward(traffic: &Traffic) -> String {
    words(traffic.bytes_in, traffic.packets_in, traffic.messages_in, traffic.acks_in)
}

/// Outgoing traffic, in words.
pub(in crate::commands) fn outward(traffic: &Traffic) -> String {
    words(traffic.bytes_out, traffic.packets_out, traffic.messages_out, traffic.acks_out)
}

fn words(count: u64, packets: u64, messages: u64, acks: u64) -> String {
    format!("{}, {packets} packets, {messages} messages, {acks} acknowledgements", bytes(count))
}
