//! Probes of a server's ports, for diagnosis. Greetings do not sign in: no password is sent, and no
//! failed attempt is counted. Only [`displaces`] signs in, with accounts created for this test.

use std::io;
use std::sync::Arc;
use std::time::Duration;

use rustls::CertificateError;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::time::timeout;

use crate::dial::{DialError, Duplex, Route, dial};
use crate::trust::{Clock, Trust};

/// A CONNECT with an unknown protocol version: an MQTT server refuses the packet for that reason,
/// before authentication.
const GREETING: [u8; 14] = [0x10, 12, 0, 4, b'M', b'Q', b'T', b'T', 0x7f, 0x02, 0, 10, 0, 0];
/// The first byte of a CONNACK.
const CONNACK: u8 = 0x20;
/// Fixed packets: PINGREQ and PINGRESP.
const PING: [u8; 2] = [0xc0, 0];
const PONG: [u8; 2] = [0xd0, 0];
/// CONNECT's flags for a clean session, a user name and a password.
const CONNECT_FLAGS: u8 = 0b1100_0010;
/// The keepalive of a session that is over within seconds.
const KEEP_ALIVE_S: u16 = 30;
/// Time limit for a broker to close the session that is replaced.
const CLOSING: Duration = Duration::from_millis(500);
/// 2200-01-01: no certificate of today is good then.
const FAR_FUTURE_MS: u64 = 7_258_118_400_000;

/// The result of a probe.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ProbeResult {
    /// The port answered in MQTT.
    Mqtt,
    /// Another protocol, or the connection was closed.
    Other,
}

/// Whether the port speaks MQTT. There is no timeout.
pub async fn probe_mqtt(route: &Route) -> Result<ProbeResult, DialError> {
    let mut stream = dial(route).await?;
    let mut answer = [0];
    let greeted: io::Result<()> = async {
        stream.write_all(&GREETING).await?;
        stream.flush().await?;
        stream.read_exact(&mut answer).await.map(drop)
    }
    .await;
    Ok(if greeted.is_ok() && answer[0] == CONNACK { ProbeResult::Mqtt } else { ProbeResult::Other })
}

/// An account at an MQTT broker.
#[derive(Clone, Copy)]
pub struct MqttLogin<'a> {
    /// User name of the MQTT account.
    pub user_name: &'a str,
    /// Password of the MQTT account.
    pub password: &'a str,
}

/// Why the displacement test gave no result.
#[derive(Debug, thiserror::Error)]
pub enum DisplaceError {
    /// The connection failed or was lost.
    #[error(transparent)]
    Dial(#[from] DialError),
    /// The broker does not let the account in.
    #[error("the broker refuses the user {user_name} (CONNACK {code})")]
    Refused {
        /// The user name that was refused.
        user_name: String,
        /// The return code of the CONNACK.
        code: u8,
    },
    /// The connection ended before the broker had let the account in.
    #[error("the broker closes the connection of the user {user_name}")]
    Closed {
        /// The user name that was refused.
        user_name: String,
        /// The error of the connection.
        source: io::Error,
    },
}

/// Whether an MQTT 3.1.1 broker ends the session of the first account when the second one connects
/// with the same client id. There is no timeout.
pub async fn displaces(
    route: &Route,
    client_id: &str,
    logins: [MqttLogin<'_>; 2],
) -> Result<bool, DisplaceError> {
    let mut first = sign_in(route, client_id, logins[0]).await?;
    let _second = sign_in(route, client_id, logins[1]).await?;
    let mut answer = [0; 2];
    let is_alive = async {
        first.write_all(&PING).await?;
        first.flush().await?;
        first.read_exact(&mut answer).await
    };
    if is_alive.await.is_err() || answer != PONG {
        return Ok(true);
    }
    // Some brokers close the older session a moment later.
    Ok(timeout(CLOSING, first.read_exact(&mut answer)).await.is_ok())
}

async fn sign_in(
    route: &Route,
    client_id: &str,
    login: MqttLogin<'_>,
) -> Result<Box<dyn Duplex>, DisplaceError> {
    let mut stream = dial(route).await?;
    let mut answer = [0; 4];
    let answered: io::Result<()> = async {
        stream.write_all(&connect_packet(client_id, login)).await?;
        stream.flush().await?;
        stream.read_exact(&mut answer).await.map(drop)
    }
    .await;
    let user_name = || login.user_name.to_owned();
    answered.map_err(|source| DisplaceError::Closed { user_name: user_name(), source })?;
    match answer {
        [CONNACK, 2, _, 0] => Ok(stream),
        [.., code] => Err(DisplaceError::Refused { user_name: user_name(), code }),
    }
}

/// A CONNECT of MQTT 3.1.1 with a clean session.
fn connect_packet(client_id: &str, login: MqttLogin<'_>) -> Vec<u8> {
    let mut body = vec![0, 4, b'M', b'Q', b'T', b'T', 4, CONNECT_FLAGS];
    body.extend(KEEP_ALIVE_S.to_be_bytes());
    for text in [client_id, login.user_name, login.password] {
        // Texts above MQTT's limit are cut, and refused by the broker.
        let bytes = &text.as_bytes()[..text.len().min(usize::from(u16::MAX))];
        body.extend((bytes.len() as u16).to_be_bytes());
        body.extend(bytes);
    }
    let mut packet = vec![0x10];
    let mut length = body.len();
    while length > 0x7f {
        packet.push(0x80 | (length & 0x7f) as u8);
        length >>= 7;
    }
    packet.push(length as u8);
    packet.extend(body);
    packet
}

/// Expiry of the certificate shown by the server, in milliseconds since the Unix epoch: TLS reports
/// this error when its clock shows a time at which no certificate is valid. `None` if the expiry
/// can't be determined. There is no timeout.
pub async fn certificate_end_ms(host: &str, port: u16, trust: Trust) -> Option<u64> {
    let clock = Clock { now_ms: || FAR_FUTURE_MS, earliest_ms: 0 };
    let tls = Some(Arc::new(trust.client_config(clock)));
    let Err(DialError::Tls { source, .. }) =
        dial(&Route { host: host.to_owned(), port, tls, websocket: None }).await
    else {
        return None;
    };
    match source.get_ref()?.downcast_ref::<rustls::Error>()? {
        rustls::Error::InvalidCertificate(CertificateError::ExpiredContext {
            not_after, ..
        }) => Some(not_after.as_secs() * 1000),
        _ => None,
    }
}
