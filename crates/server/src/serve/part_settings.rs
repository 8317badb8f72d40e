//! Settings of single parts, taken from the configuration.

use task_proto::time::millis;

use crate::config::{Config, TlsSettings};
use crate::net::tls::Tls;
use crate::orders::actions::ActionSettings;

pub(super) fn action_settings(config: &Config, tls: Option<&Tls>) -> ActionSettings {
    ActionSettings {
        ca_pin: tls.and_then(Tls::announced_pin),
        assignment_lifetime_ms: millis(config.assignment_expiry),
        enrollment_approval: config.enrollment_approval,
        enrollment_token_uses: config.enrollment_uses,
        enrollments_per_minute: config.enrollment_per_minute,
        ..ActionSettings::default()
    }
}

/// Adds the public host of robots to the certificate's names.
pub(super) fn tls_settings(config: &Config) -> TlsSettings {
    let mut settings = config.tls.clone();
    settings.names.extend(config.public_mqtt_host.clone());
    settings
}
