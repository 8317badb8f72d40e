//! Log lines about clients that speak another version of MQTT. MQTT 3.1.1 answers them only with
//! return code 1, so the log is the only place that can name the client and the remedy.

use std::net::SocketAddr;
use std::time::Instant;

use crate::net::refusal_log::RefusalLog;

/// The log of refused clients of other versions.
#[derive(Debug, Default)]
pub(in crate::broker::front) struct OtherProtocols(RefusalLog);

impl OtherProtocols {
    /// Records that the client at `peer` requests protocol level `level`.
    pub(in crate::broker::front) fn refused(&self, peer: SocketAddr, level: u8) {
        let version = match level {
            3 => "3.1",
            5 => "5",
            // Tools that probe for MQTT request levels that do not exist.
            _ => return,
        };
        if let Some(unreported) = self.0.refused(Instant::now()) {
            tracing::warn!(
                %peer,
                unreported,
                "an MQTT client speaks MQTT {version} and was refused (CONNACK 1): set its protocol version to MQTT 3.1.1 \
                 (mosquitto_sub -V mqttv311, paho protocol=MQTTv311)"
            );
        }
    }
}
