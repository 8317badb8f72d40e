//! `taskd server`: the server's description and its traffic.

use clap::Subcommand;
use task_proto::api::{ServerInfo, Traffic};
use task_proto::size::format_bytes;

use super::status;
use crate::display::output::{facts, time};
use crate::{CommandError, Outcome, Session};

#[derive(Debug, Subcommand)]
pub enum Action {
    /// Show the version, the MQTT address and the traffic since the start
    Info,
    /// List the robots connected over MQTT, with their subscriptions
    Sessions,
    /// Show the delivery rules and the limits in effect
    Rules,
}

pub(crate) async fn run(session: &Session, action: Action) -> Result<Outcome, CommandError> {
    match action {
        Action::Info => {
            let info: ServerInfo = session.client.get("/server", &[]).await?;
            session.output.print_object(&info, |info| info.version.clone(), describe)?;
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
        ("in", incoming(&traffic.all)),
        ("out", outgoing(&traffic.all)),
        (
            "penalties",
            format!(
                "{} throttled, {} disconnected, {} refused",
                conduct.slowed, conduct.cut, conduct.turned_away
            ),
        ),
        ("http", format!("{} connections, {} requests", http.connections, http.requests)),
        ("http in", format_bytes(http.bytes_in)),
        ("http out", format_bytes(http.bytes_out)),
    ])
}

/// Incoming traffic, in words.
pub(crate) fn incoming(traffic: &Traffic) -> String {
    describe_traffic(traffic.bytes_in, traffic.packets_in, traffic.messages_in, traffic.acks_in)
}

/// Outgoing traffic, in words.
pub(crate) fn outgoing(traffic: &Traffic) -> String {
    describe_traffic(traffic.bytes_out, traffic.packets_out, traffic.messages_out, traffic.acks_out)
}

fn describe_traffic(count: u64, packets: u64, messages: u64, acks: u64) -> String {
    format!(
        "{}, {packets} packets, {messages} messages, {acks} acknowledgements",
        format_bytes(count)
    )
}
