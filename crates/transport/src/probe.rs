//! Looks whether somebody answers as it should, for those who search for what is wrong. Nothing is proven by it and nobody
//! is let in: no password travels, and no failed attempt is counted.

use std::io;
use std::sync::Arc;

use rustls::CertificateError;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};

use crate::dial::{DialError, Route, dial};
use crate::trust::{Clock, Trust};

/// A CONNECT of a protocol that there is not: whoever speaks MQTT refuses it by that reason, before asking who it is.
const GREETING: [u8; 14] = [0x10, 12, 0, 4, b'M', b'Q', b'T', b'T', 0x7f, 0x02, 0, 10, 0, 0];
/// The first byte of a CONNACK.
const CONNACK: u8 = 0x20;
/// 2200-01-01: no certificate of today is good then.
const FAR_FUTURE_MS: u64 = 7_258_118_400_000;

/// What answered.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Probed {
    /// MQTT.
    Mqtt,
    /// Something else, or somebody who hung up.
    SomethingElse,
}

/// Whether MQTT is spoken there. Waits for as long as it takes.
pub async fn greet_mqtt(route: &Route) -> Result<Probed, DialError> {
    let mut stream = dial(route).await?;
    let mut answer = [0];
    let greeted: io::Result<()> = async {
        stream.write_all(&GREETING).await?;
        stream.flush().await?;
        stream.read_exact(&mut answer).await.map(drop)
    }
    .await;
    Ok(if greeted.is_ok() && answer[0] == CONNACK { Probed::Mqtt } else { Probed::SomethingElse })
}

/// When the certificate ends that is shown there, in milliseconds since the Unix epoch: what TLS complains of when its clock
/// shows a time at which none is good. `None` where that can't be found out. Waits for as long as it takes.
pub async fn certificate_end_ms(host: &str, port: u16, trust: Trust) -> Option<u64> {
    let clock = Clock { now_ms: || FAR_FUTURE_MS, earliest_ms: 0 };
    let tls = Some(Arc::new(trust.client_config(clock)));
    let Err(DialError::Tls { source, .. }) = dial(&Route { host: host.to_owned(), port, tls, websocket: None }).await
    else {
        return None;
    };
    match source.get_ref()?.downcast_ref::<rustls::Error>()? {
        rustls::Error::InvalidCertificate(CertificateError::ExpiredContext { not_after, .. }) => {
            Some(not_after.as_secs() * 1000)
        }
        _ => None,
    }
}
