//! Status of the server and its network: figures gathered on request, the connected robots, and the
//! rules. The sizes of database and packages are computed at most every half minute, regardless of
//! the number of requests.

use std::collections::BTreeMap;
use std::time::Duration;

use axum::Json;
use axum::extract::State;
use serde::Deserialize;
use task_proto::RobotName;
use task_proto::api::{
    BrokerStatus, DatabaseStatus, DiskStatus, MAX_SITES, RobotCounts, RobotSession, ServerRules,
    ServerStatus, SessionList, SiteStatus, TransferStatus,
};
use task_proto::id::LabelValue;
use task_proto::report::LinkFacts;
use tokio::sync::Mutex;
use tokio::time::Instant;
use utoipa::IntoParams;

use crate::broker::Health;
use crate::domain::person::Person;
use crate::http::App;
use crate::http::error::ApiError;
use crate::http::extract::{QueryParams, page_limit};
use crate::store::{DatabaseSize, KnownRobot};
use crate::system::data_directory::room;

/// How long the slow figures stay valid.
const BELIEVED: Duration = Duration::from_secs(30);
/// Default number of listed sessions.
const LISTED: u32 = 100;

/// The last result of the slow figures.
#[derive(Debug, Default)]
pub struct SlowFigures(Mutex<Option<(Instant, Slow)>>);

#[derive(Debug, Clone)]
struct Slow {
    database: DatabaseSize,
    packages_bytes: u64,
}

/// Shows the state of the server and its network.
#[utoipa::path(get, path = "/api/v1/server/status", tag = "server")]
pub(in crate::http) async fn status(
    State(app): State<App>,
    by: Person,
) -> Result<Json<ServerStatus>, ApiError> {
    let now_ms = app.clock.now_ms();
    let robots = app.store.robots_and_links(&by.scope).await?;
    let asked = Instant::now();
    app.store.ping().await?;
    let latency_ms = (asked.elapsed().as_secs_f64() * 100_000.0).round() / 100.0;
    let Slow { database, packages_bytes } = slow_figures(&app).await?;
    let state = app.store.state();
    let is_online = |robot: &KnownRobot| app.presence.is_online(&robot.id, now_ms);
    let online = robots.iter().filter(|(robot, _)| is_online(robot)).count() as u64;
    let (free_bytes, total_bytes) = room(&app.data).unwrap_or_default();
    Ok(Json(ServerStatus {
        version: env!("CARGO_PKG_VERSION").to_owned(),
        uptime_s: app.facts.began.elapsed().as_secs(),
        now_ms,
        robots: RobotCounts { known: robots.len() as u64, online },
        mqtt: app.broker.traffic(),
        http: app.http_traffic.read(),
        transfers: TransferStatus {
            active: app.transfers.running(),
            waiting: app.transfers.waiting(),
            bytes_per_s: app.transfers.bytes_per_s(),
        },
        sites: sites(&app, &robots, is_online),
        reports: app.reports.meter().read(Instant::now()),
        database: DatabaseStatus {
            kind: database.kind.to_owned(),
            size_bytes: database.bytes,
            latency_ms,
            problem: state.problem(),
            fully_checked_at_ms: state.fully_checked_at_ms(),
            guard: state.guard().map(str::to_owned),
        },
        disk: DiskStatus { free_bytes, total_bytes, packages_bytes },
        broker: broker(&app),
        listeners: app.facts.listeners.clone(),
    }))
}

async fn slow_figures(app: &App) -> Result<Slow, ApiError> {
    // Concurrent callers wait here and share one answer.
    let mut known = app.slow_figures.0.lock().await;
    if let Some((at, slow)) = &*known
        && at.elapsed() < BELIEVED
    {
        return Ok(slow.clone());
    }
    let packages_bytes = app.blobs.used_bytes().await?;
    let slow = Slow { database: app.store.size().await?, packages_bytes };
    *known = Some((Instant::now(), slow.clone()));
    Ok(slow)
}

fn broker(app: &App) -> BrokerStatus {
    let kind = if app.broker.local_addr().is_some() { "embedded" } else { "external" };
    let trouble = match &*app.broker.health().borrow() {
        Health::Serving => None,
        Health::Recovering(seen) | Health::Failed(seen) => Some(seen.clone()),
    };
    let healthy = trouble.is_none();
    BrokerStatus {
        kind: kind.to_owned(),
        healthy,
        detail: trouble.unwrap_or_else(|| app.broker.address()),
    }
}

/// Figures of transfers to robots, by site.
fn sites(
    app: &App,
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
        let site = sites.entry(app.transfers.site_of(&robot.labels)).or_default();
        site.robots += 1;
        site.online += u64::from(is_online(robot));
        let link = link.unwrap_or_default();
        site.throughputs.extend(link.throughput_bytes_per_s);
        site.rtts.extend(link.rtt_ms.map(u64::from));
    }
    let mut shown: Vec<SiteStatus> = sites
        .into_iter()
        .map(|(name, Site { robots, online, throughputs, rtts })| SiteStatus {
            site: name,
            robots,
            online,
            throughput_bytes_per_s: median(throughputs),
            rtt_ms: median(rtts),
        })
        .collect();
    shown.sort_by_key(|site| std::cmp::Reverse(site.robots));
    shown.truncate(MAX_SITES);
    shown
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

/// Lists the robots' MQTT sessions with their subscriptions: the paper's subscription table.
#[utoipa::path(get, path = "/api/v1/server/sessions", tag = "server")]
pub(in crate::http) async fn sessions(
    State(app): State<App>,
    by: Person,
    QueryParams(query): QueryParams<SessionsQuery>,
) -> Result<Json<SessionList>, ApiError> {
    let limit = page_limit(query.limit)?.unwrap_or(LISTED) as usize;
    let now_ms = app.clock.now_ms();
    let mut robots = app.store.known_robots(&by.scope).await?;
    robots.retain(|robot| app.presence.is_connected(&robot.id));
    let total = robots.len() as u64;
    robots.retain(|robot| query.after.as_ref().is_none_or(|after| robot.name > *after));
    robots.sort_by(|one, other| one.name.cmp(&other.name));
    let next = robots
        .get(limit.saturating_sub(1))
        .filter(|_| robots.len() > limit)
        .map(|last| last.name.clone());
    let session = |KnownRobot { id, name, .. }: KnownRobot| {
        let sighting = app.presence.get(&id, now_ms)?;
        Some(RobotSession {
            since_ms: sighting.connected_since_ms?,
            address: sighting.address.map(|address| address.to_string()),
            subscriptions: app.broker.subscriptions_of(&id),
            traffic: app.broker.traffic_of(&id).unwrap_or_default(),
            robot: id,
            name,
        })
    };
    // A robot that disconnected in the meantime is left out.
    let sessions = robots.into_iter().take(limit).filter_map(session).collect();
    Ok(Json(SessionList { sessions, total, next }))
}

/// Shows the rules by which bytes travel, and the limits in force.
#[utoipa::path(get, path = "/api/v1/server/rules", tag = "server")]
pub(in crate::http) async fn rules(State(app): State<App>) -> Json<ServerRules> {
    Json(app.facts.rules.clone())
}
