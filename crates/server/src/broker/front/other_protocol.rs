//! Log lines about clients that speak another version of MQTT. MQTT 3.1.1 answers them only with
//! return code 1, so the log is the only place that can name the client and the remedy. Any client
//! can cause such a line, so we write at most one a minute.

use std::net::SocketAddr;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Minimum time between two lines.
const INTERVAL: Duration = Duration::from_secs(60);

/// When the last line was written, and the number of clients since.
#[derive(Debug, Default)]
pub(super) struct OtherProtocols(Mutex<Lines>);

#[derive(Debug, Default)]
struct Lines {
    last: Option<Instant>,
    unreported: u64,
}

impl OtherProtocols {
    /// Records that the client at `peer` requests protocol level `level`.
    pub(super) fn refused(&self, peer: SocketAddr, level: u8) {
        let version = match level {
            3 => "3.1",
            5 => "5",
            // Tools that probe for MQTT request levels that do not exist.
            _ => return,
        };
        let lines = self.0.lock();
        if let Some(unreported) = lines.unwrap_or_else(PoisonError::into_inner).take(Instant::now())
        {
            tracing::warn!(
                %peer,
                unreported,
                "an MQTT client speaks MQTT {version} and was refused (CONNACK 1): set its protocol version to MQTT 3.1.1 \
                 (mosquitto_sub -V mqttv311, paho protocol=MQTTv311)"
            );
        }
    }
}

impl Lines {
    /// The number of clients without a line, if a line is due at `now`.
    fn take(&mut self, now: Instant) -> Option<u64> {
        if self.last.is_some_and(|last| now.duration_since(last) < INTERVAL) {
            self.unreported += 1;
            return None;
        }
        self.last = Some(now);
        Some(std::mem::take(&mut self.unreported))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn refused_clients_get_one_line_a_minute_with_the_count_of_the_others() {
        let (mut lines, begun) = (Lines::default(), Instant::now());
        assert_eq!(lines.take(begun), Some(0));
        assert_eq!(lines.take(begun + INTERVAL / 2), None);
        assert_eq!(lines.take(begun + INTERVAL * 9 / 10), None);
        assert_eq!(lines.take(begun + INTERVAL), Some(2));
        assert_eq!(lines.take(begun + INTERVAL * 3), Some(0));
    }
}
