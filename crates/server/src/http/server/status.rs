//! Status of the server and its network: figures gathered on request, the connected robots, and the
//! rules.

use std::collections::BTreeMap;
use std::sync::Arc;

use axum::Json;
use axum::extract::State;
use serde::Deserialize;
use task_macros::operation;
use task_proto::RobotName;
use task_proto::api::{
    BrokerStatus, DatabaseStatus, DiskStatus, MAX_SITES, NodeFigures, RobotCounts, RobotSession,
    ServerRules, ServerStatus, SessionList, SiteStatus,
};
use task_proto::ids::LabelValue;
use task_proto::messages::report::LinkFacts;
use tokio::time::Instant;
use utoipa::IntoParams;

use super::gauges::{Gauges, SlowValues};
use super::nodes;
use super::peers::{own_figures, total};
use super::server_facts::ServerFacts;
use crate::broker::{Broker, Health};
use crate::domain::person::Person;
use crate::http::error::ApiError;
use crate::http::extract::{QueryParams, page_limit};
use crate::http::peers::SessionFigures;
use crate::link::transfers::Transfers;
use crate::store::KnownRobot;
use crate::system::data_directory::disk_space;

/// Default number of listed sessions.
const DEFAULT_LIMIT: u32 = 100;

/// Shows the state of the server and its network.
#[operation(tag = "server")]
pub(in crate::http) async fn status(
    State(gauges): State<Gauges>,
    by: Person,
) -> Result<Json<ServerStatus>, ApiError> {
    let now_ms = gauges.clock.now_ms();
    let nodes = gauges.peers.statuses(own_figures(&gauges)).await?;
    let NodeFigures { uptime_s, mqtt, http, transfers, reports, .. } = match nodes.is_empty() {
        true => own_figures(&gauges),
        false => total(nodes.iter().filter_map(|status| status.figures)),
    };
    let robots = gauges.store.robots().with_links(&by.scope).await?;
    let pinged_at = Instant::now();
    gauges.store.ping().await?;
    let latency_ms = (pinged_at.elapsed().as_secs_f64() * 100_000.0).round() / 100.0;
    let SlowValues { database, packages_bytes } = gauges.slow_values().await?;
    let state = gauges.store.state();
    let is_online = |robot: &KnownRobot| gauges.presence.is_online(&robot.id, now_ms);
    let online = robots.iter().filter(|(robot, _)| is_online(robot)).count() as u64;
    let (free_bytes, total_bytes) = disk_space(&gauges.data).unwrap_or_default();
    Ok(Json(ServerStatus {
        version: env!("CARGO_PKG_VERSION").to_owned(),
        uptime_s,
        now_ms,
        robots: RobotCounts { known: robots.len() as u64, online },
        mqtt,
        http,
        transfers,
        sites: sites(&gauges.transfers, &robots, is_online),
        reports,
        database: DatabaseStatus {
            kind: database.kind.to_owned(),
            size_bytes: database.bytes,
            latency_ms,
            problem: state.problem().or_else(|| gauges.nodes.bus_problem()),
            fully_checked_at_ms: state.fully_checked_at_ms(),
            guard: state.page_protection().map(str::to_owned),
        },
        disk: DiskStatus { free_bytes, total_bytes, packages_bytes },
        broker: broker_status(&gauges.broker),
        listeners: gauges.facts.listeners.clone(),
        nodes: nodes.into_iter().filter_map(nodes::view).collect(),
    }))
}

fn broker_status(broker: &Broker) -> BrokerStatus {
    let kind = if broker.local_addr().is_some() { "embedded" } else { "external" };
    let problem = match &*broker.health().borrow() {
        Health::Serving => None,
        Health::Recovering(problem) | Health::Failed(problem) => Some(problem.clone()),
    };
    let healthy = problem.is_none();
    BrokerStatus {
        kind: kind.to_owned(),
        healthy,
        detail: problem.unwrap_or_else(|| broker.address()),
    }
}

/// Figures of transfers to robots, by site.
fn sites(
    transfers: &Transfers,
    robots: &[(KnownRobot, Option<LinkFacts>)],
    is_online: impl Fn(&KnownRobot) -> bool,
) -> Vec<SiteStatus> {
    #[derive(Default)]
    struct Site {
        robots: u64,
        online: u64,
        throughputs: Vec<u64>,
        rtts: Vec<u64>,
    }
    let mut sites: BTreeMap<Option<LabelValue>, Site> = BTreeMap::new();
    for (robot, link) in robots {
        let site = sites.entry(transfers.site_of(&robot.labels)).or_default();
        site.robots += 1;
        site.online += u64::from(is_online(robot));
        let link = link.unwrap_or_default();
        site.throughputs.extend(link.throughput_bytes_per_s);
        site.rtts.extend(link.rtt_ms.map(u64::from));
    }
    let mut statuses: Vec<SiteStatus> = sites
        .into_iter()
        .map(|(name, Site { robots, online, throughputs, rtts })| SiteStatus {
            site: name,
            robots,
            online,
            throughput_bytes_per_s: median(throughputs),
            rtt_ms: median(rtts),
        })
        .collect();
    statuses.sort_by_key(|site| std::cmp::Reverse(site.robots));
    statuses.truncate(MAX_SITES);
    statuses
}

fn median(mut figures: Vec<u64>) -> Option<u64> {
    figures.sort_unstable();
    figures.get(figures.len() / 2).copied()
}

/// The query of `GET /server/sessions`.
#[derive(Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
pub(in crate::http) struct SessionsQuery {
    /// Maximum number of sessions. Default: 100.
    #[param(minimum = 1, maximum = 1000)]
    limit: Option<u32>,
    /// Only sessions of robots whose names come after this one.
    #[param(inline)]
    after: Option<RobotName>,
}

/// Lists the robots' MQTT sessions with their subscriptions.
#[operation(tag = "server")]
pub(in crate::http) async fn sessions(
    State(gauges): State<Gauges>,
    by: Person,
    QueryParams(query): QueryParams<SessionsQuery>,
) -> Result<Json<SessionList>, ApiError> {
    let limit = page_limit(query.limit)?.unwrap_or(DEFAULT_LIMIT) as usize;
    let now_ms = gauges.clock.now_ms();
    let mut robots = gauges.store.robots().known(&by.scope).await?;
    robots.retain(|robot| {
        let presence = gauges.presence.get(&robot.id, now_ms);
        presence.is_some_and(|presence| presence.connected_since_ms.is_some())
    });
    let total = robots.len() as u64;
    robots.retain(|robot| query.after.as_ref().is_none_or(|after| robot.name > *after));
    robots.sort_by(|one, other| one.name.cmp(&other.name));
    let next = robots
        .get(limit.saturating_sub(1))
        .filter(|_| robots.len() > limit)
        .map(|last| last.name.clone());
    robots.truncate(limit);
    let is_elsewhere = |robot: &&KnownRobot| gauges.broker.traffic_of(&robot.id).is_none();
    let elsewhere = robots.iter().filter(is_elsewhere).map(|robot| robot.id.clone()).collect();
    let mut elsewhere = gauges.peers.sessions(elsewhere).await?;
    let session = |KnownRobot { id, name, .. }: KnownRobot| {
        let presence = gauges.presence.get(&id, now_ms)?;
        let here = |traffic| SessionFigures {
            subscriptions: gauges.broker.subscriptions_of(&id),
            traffic,
            node: gauges.peers.own_name().cloned(),
        };
        let SessionFigures { subscriptions, traffic, node } = match gauges.broker.traffic_of(&id) {
            Some(traffic) => here(traffic),
            None => elsewhere.remove(&id).unwrap_or_default(),
        };
        Some(RobotSession {
            since_ms: presence.connected_since_ms?,
            address: presence.address_text(),
            subscriptions,
            traffic,
            node,
            robot: id,
            name,
        })
    };
    // A robot that disconnected in the meantime is left out.
    let sessions = robots.into_iter().filter_map(session).collect();
    Ok(Json(SessionList { sessions, total, next }))
}

/// Shows the delivery rules and the limits in force.
#[operation(tag = "server")]
pub(in crate::http) async fn rules(State(facts): State<Arc<ServerFacts>>) -> Json<ServerRules> {
    Json(facts.rules.clone())
}
