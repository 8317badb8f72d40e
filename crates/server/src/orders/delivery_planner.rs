//! Decides, inside the write that begins a batch, how the bytes travel to each of its robots:
//! gathers the inputs, lets [`crate::domain::delivery`] choose, stores the choice with its reason.
//! Stored decisions never change.

use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use task_proto::desired::{BlobRef, Delivery, PackageRef};
use task_proto::ids::{LabelKey, LabelValue, Labels};
use task_proto::messages::report::{Phase, TaskReport};
use task_proto::{DeploymentId, RobotId};

use crate::config::DeliverySettings;
use crate::domain::delivery::{Inputs, Quantity, Rules, choose};
use crate::fleet::presence::Presence;
use crate::store::{RobotDecision, RobotFacts, StoreError, Transaction};

/// Chooses delivery mechanisms. Clones share their inputs.
#[derive(Clone)]
pub struct DeliveryPlanner {
    rules: Arc<Rules>,
    inline_bytes: u64,
    site_label: LabelKey,
    presence: Arc<Presence>,
    load: Arc<ServerLoad>,
}

/// The server's load at the last sample.
#[derive(Debug, Default)]
pub struct ServerLoad {
    transfers: AtomicU64,
    backlog: AtomicU64,
    transfers_elsewhere: AtomicU64,
    backlog_elsewhere: AtomicU64,
}

/// A robot's site: the value of its site label, otherwise the network of its address.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
enum Site {
    Label(LabelValue),
    V4([u8; 3]),
    V6([u16; 4]),
}

impl ServerLoad {
    /// Sets the number of running transfers, and the bytes of parts that wait for their receivers.
    pub fn set(&self, transfers: u64, backlog: u64) {
        self.transfers.store(transfers, Ordering::Relaxed);
        self.backlog.store(backlog, Ordering::Relaxed);
    }

    /// Sets the same figures of the other servers of the cluster, in total.
    pub fn set_elsewhere(&self, transfers: u64, backlog: u64) {
        self.transfers_elsewhere.store(transfers, Ordering::Relaxed);
        self.backlog_elsewhere.store(backlog, Ordering::Relaxed);
    }

    /// The figures of this server.
    pub fn here(&self) -> (u64, u64) {
        (self.transfers.load(Ordering::Relaxed), self.backlog.load(Ordering::Relaxed))
    }

    /// The figures of all servers.
    fn total(&self) -> (u64, u64) {
        let (transfers, backlog) = self.here();
        (
            transfers.saturating_add(self.transfers_elsewhere.load(Ordering::Relaxed)),
            backlog.saturating_add(self.backlog_elsewhere.load(Ordering::Relaxed)),
        )
    }
}

impl DeliveryPlanner {
    /// Decides by `settings`, with the current `presence` and `load`.
    pub fn new(
        settings: &DeliverySettings,
        presence: Arc<Presence>,
        load: Arc<ServerLoad>,
    ) -> Self {
        Self {
            rules: Arc::new(settings.rules()),
            inline_bytes: settings.inline_bytes.into(),
            site_label: settings.site_label.clone(),
            presence,
            load,
        }
    }

    /// The most bytes of a package that ride inside an announcement.
    pub fn inline_bytes(&self) -> u64 {
        self.inline_bytes
    }

    /// How long each of these robots has been offline; `None`: online.
    pub fn offline_ms<'a>(
        &self,
        robots: impl IntoIterator<Item = &'a RobotId>,
        now_ms: u64,
    ) -> Vec<Option<u64>> {
        self.presence.offline_ms(robots, now_ms)
    }

    /// Decides for `batch`: robots of `deployment` whose batch begins now.
    pub async fn decide(
        &self,
        write: &mut Transaction,
        deployment: &DeploymentId,
        batch: &[RobotId],
        now_ms: u64,
    ) -> Result<Vec<(RobotId, Delivery)>, StoreError> {
        let order = write.deliveries().request(deployment).await?;
        let known = write.deliveries().robot_facts(batch, &order.package.content.digest).await?;
        let sites = self.robots_by_site(write, deployment, now_ms).await?;
        let (transfers, backlog) = self.load.total();
        let common = Inputs {
            size: transfer_bytes(&order.package),
            robots: order.robots,
            batch: batch.len() as u64,
            transfers,
            backlog,
            ..Inputs::default()
        };
        let decide = |facts: RobotFacts| {
            let inputs = self.inputs_of(&facts, &order.package, sites.as_ref(), common, now_ms);
            let decision = choose(&self.rules, order.choice, &inputs);
            let inputs =
                serde_json::to_string(&inputs).expect("plain numbers always have a JSON form");
            RobotDecision { robot: facts.robot, decision, inputs }
        };
        let decided: Vec<RobotDecision> = known.into_iter().map(decide).collect();
        write.deliveries().store_decisions(deployment, &decided).await?;
        Ok(decided.into_iter().map(|decided| (decided.robot, decided.decision.mechanism)).collect())
    }

    fn inputs_of(
        &self,
        facts: &RobotFacts,
        package: &PackageRef,
        sites: Option<&HashMap<Site, u64>>,
        common: Inputs,
        now_ms: u64,
    ) -> Inputs {
        let link = facts.link.unwrap_or_default();
        let sighting = self.presence.get(&facts.robot, now_ms);
        // A robot without a known site counts as alone on its site.
        let on_site = |sites: &HashMap<Site, u64>| {
            let site = self.site_of(
                &facts.labels,
                sighting.as_ref().and_then(|sighting| sighting.address).map(|address| address.ip()),
            );
            site.and_then(|site| sites.get(&site).copied()).unwrap_or(1)
        };
        Inputs {
            lacking: missing_bytes(package, facts.has.as_ref()),
            same_site: sites.map(on_site),
            connected: sighting
                .as_ref()
                .is_some_and(|sighting| sighting.connected_since_ms.is_some()),
            metered: facts
                .labels
                .iter()
                .any(|(key, value)| (key.as_str(), value.as_str()) == ("metered", "true")),
            throughput_bytes_per_s: link.throughput_bytes_per_s,
            rtt_ms: link.rtt_ms.map(u64::from),
            losses: link.losses.into(),
            reconnects: link.reconnects.into(),
            battery_percent: facts.battery_percent,
            ..common
        }
    }

    /// Number of robots of `deployment` on each site; `None` if no rule uses this number, because
    /// counting reads all their labels.
    async fn robots_by_site(
        &self,
        write: &mut Transaction,
        deployment: &DeploymentId,
        now_ms: u64,
    ) -> Result<Option<HashMap<Site, u64>>, StoreError> {
        if !self.rules.use_quantity(Quantity::SameSite) {
            return Ok(None);
        }
        let mut sites = HashMap::new();
        for (robot, labels) in write.deliveries().labels(deployment).await? {
            let address = self
                .presence
                .get(&robot, now_ms)
                .and_then(|sighting| sighting.address)
                .map(|address| address.ip());
            if let Some(site) = self.site_of(&labels, address) {
                *sites.entry(site).or_default() += 1;
            }
        }
        Ok(Some(sites))
    }

    fn site_of(&self, labels: &Labels, address: Option<IpAddr>) -> Option<Site> {
        if let Some(value) = labels.get(&self.site_label) {
            return Some(Site::Label(value.clone()));
        }
        Some(match address?.to_canonical() {
            IpAddr::V4(address) => {
                let [a, b, c, _] = address.octets();
                Site::V4([a, b, c])
            }
            IpAddr::V6(address) => {
                let [a, b, c, d, ..] = address.segments();
                Site::V6([a, b, c, d])
            }
        })
    }
}

/// The bytes of a package to transfer to a robot that has none of them.
pub fn transfer_bytes(package: &PackageRef) -> u64 {
    package.content.size.saturating_add(package.config.size)
}

/// The bytes missing on a robot that reports `has`, a task with the same content.
fn missing_bytes(package: &PackageRef, has: Option<&TaskReport>) -> u64 {
    let Some(has) = has else { return transfer_bytes(package) };
    let content = match has.phase {
        Phase::Unpacking
        | Phase::Building
        | Phase::Staged
        | Phase::Starting
        | Phase::Running
        | Phase::Succeeded
        | Phase::Stopped
        | Phase::RolledBack => 0,
        Phase::Fetching => {
            package.content.size.saturating_sub(has.progress.map_or(0, |progress| progress.done))
        }
        _ => package.content.size,
    };
    let BlobRef { digest, size } = package.config;
    content.saturating_add(if has.package.config.digest == digest && content == 0 {
        0
    } else {
        size
    })
}
