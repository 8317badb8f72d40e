//! Facts that are fixed while the server runs: its start time, its listeners, its rules, its limits
//! and its public keys. Built once from the configuration; contains no secrets.

use std::time::Duration;

use task_proto::CaPin;
use task_proto::api::{LimitView, ListenerView, ServerRules};
use task_proto::size::format_bytes;
use task_proto::trust::envelope::PublicKey;
use tokio::time::Instant;

use crate::blobs::{BlobSettings, Blobs};
use crate::config::Config;

/// Facts about this server.
#[derive(Debug)]
pub struct ServerFacts {
    /// The start of this run.
    pub began: Instant,
    /// The addresses that the server listens on.
    pub listeners: Vec<ListenerView>,
    /// The delivery rules and the limits.
    pub rules: ServerRules,
    /// The key that verifies desired states.
    pub key: PublicKey,
    /// The pin of the private authority, if the listeners encrypt.
    pub ca_pin: Option<CaPin>,
}

impl ServerFacts {
    /// The facts of a server with this configuration, these listeners and these public keys.
    pub fn new(
        config: &Config,
        blobs: &Blobs,
        listeners: Vec<ListenerView>,
        key: PublicKey,
        ca_pin: Option<CaPin>,
    ) -> Self {
        let rules = config.delivery.rules().views();
        Self {
            began: Instant::now(),
            listeners,
            rules: ServerRules { rules, limits: limits(config, blobs.settings()) },
            key,
            ca_pin,
        }
    }
}

fn limits(config: &Config, blobs: BlobSettings) -> Vec<LimitView> {
    let limit = |key: &str, value: String| LimitView { key: key.to_owned(), value };
    let count = |most: Option<u64>| most.map_or("none".to_owned(), |most| most.to_string());
    let speed = |most: Option<u64>| {
        most.map_or("none".to_owned(), |most| format!("{}/s", format_bytes(most)))
    };
    let seconds = |time: Duration| format!("{} s", time.as_secs());
    let (transfers, robots, delivery) = (&config.transfers, &config.robots, &config.delivery);
    let mut limits = vec![
        limit("assignment_expiry", seconds(config.assignment_expiry)),
        limit("delivery.inline_bytes", format_bytes(delivery.inline_bytes.into())),
        limit("delivery.part_bytes", format_bytes(delivery.part_bytes.into())),
        limit("desired_lifetime", seconds(config.desired_lifetime)),
        limit("disk_reserve", format_bytes(blobs.reserve_bytes)),
        limit("enrolment.per_minute", config.enrollment_per_minute.to_string()),
        limit("enrolment.uses", config.enrollment_uses.to_string()),
        limit("max_blob_bytes", format_bytes(blobs.max_blob_bytes)),
        limit("max_http_connections", config.max_http_connections.to_string()),
        limit("max_mqtt_connections", config.max_mqtt_connections.to_string()),
        limit("people.requests_per_s", config.people.requests_per_s.to_string()),
        limit("presence_timeout", seconds(config.presence_timeout)),
        limit("robots.bytes_per_s", speed(Some(robots.bytes_per_s))),
        limit("robots.messages_per_s", robots.messages_per_s.to_string()),
        limit("robots.output_bytes", format_bytes(blobs.max_robot_bytes)),
        limit("robots.requests_per_s", robots.requests_per_s.to_string()),
        limit("transfers.max", count(transfers.all.max)),
        limit("transfers.bytes_per_s", speed(transfers.all.bytes_per_s)),
    ];
    for (site, of_site) in &transfers.sites {
        limits.push(limit(&format!("transfers.sites.{site}.max"), count(of_site.max)));
        limits.push(limit(
            &format!("transfers.sites.{site}.bytes_per_s"),
            speed(of_site.bytes_per_s),
        ));
    }
    limits
}
