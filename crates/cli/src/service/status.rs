//! `taskd status`, and the sessions and rules of `taskd server`: the health of the server and of
//! the links to the robots.

use std::time::Duration;

use task_proto::api::{
    DatabaseStatus, ListenerView, RobotSession, RuleView, ServerRules, ServerStatus, SessionList,
    SiteStatus,
};
use task_proto::size::{format_bytes, format_rate};
use task_proto::time::span;

use crate::display::output::table::Columns;
use crate::display::output::{facts, time};
use crate::{CommandError, Outcome, Session};

/// Sessions requested at a time.
const PAGE: u64 = 1000;

const SITES: Columns = Columns::of(&["site", "robots", "online", "throughput", "rtt"]);

/// The server's current status.
pub(crate) async fn status(session: &Session) -> Result<Outcome, CommandError> {
    let status: ServerStatus = session.client.get("/server/status", &[]).await?;
    let name = |status: &ServerStatus| status.version.clone();
    session.output.print_object(&status, name, |status| {
        let mut text = describe(status);
        if !status.sites.is_empty() {
            let rows: Vec<_> = status.sites.iter().map(site_row).collect();
            text.push('\n');
            text.push_str(&session.output.table(&SITES, &rows));
        }
        text
    })?;
    Ok(Outcome::Succeeded)
}

fn describe(status: &ServerStatus) -> String {
    let ServerStatus {
        robots,
        mqtt,
        http,
        transfers,
        reports,
        database,
        disk,
        broker,
        listeners,
        ..
    } = status;
    let latency = match (reports.latency_ms_p50, reports.latency_ms_p99) {
        (Some(half), Some(most)) => {
            format!(", stored within {half:.1} ms (p50), {most:.1} ms (p99)")
        }
        _ => String::new(),
    };
    let listener = |listener: &ListenerView| {
        format!(
            "{} {}{}",
            listener.kind,
            listener.address,
            if listener.tls { " (TLS)" } else { "" }
        )
    };
    let size =
        database.size_bytes.map_or_else(String::new, |size| format!(", {}", format_bytes(size)));
    let health = if broker.healthy { "ready" } else { "not ready" };
    facts([
        ("version", status.version.clone()),
        ("uptime", span(Duration::from_secs(status.uptime_s))),
        ("time", time(status.now_ms)),
        ("listeners", listeners.iter().map(listener).collect::<Vec<_>>().join(", ")),
        (
            "robots",
            format!(
                "{} of {} online, {} connected over MQTT",
                robots.online, robots.known, mqtt.robots_connected
            ),
        ),
        (
            "transfers",
            format!(
                "{} active, {} waiting, {}",
                transfers.active,
                transfers.waiting,
                format_rate(transfers.bytes_per_s)
            ),
        ),
        ("reports", format!("{:.1}/s{latency}", reports.per_s)),
        (
            "mqtt",
            format!(
                "{} in, {} out",
                format_bytes(mqtt.all.bytes_in),
                format_bytes(mqtt.all.bytes_out)
            ),
        ),
        (
            "http",
            format!(
                "{} requests, {} in, {} out",
                http.requests,
                format_bytes(http.bytes_in),
                format_bytes(http.bytes_out)
            ),
        ),
        (
            "database",
            format!(
                "{}{size}, latency {:.1} ms{}",
                database.kind,
                database.latency_ms,
                integrity(database)
            ),
        ),
        (
            "disk",
            format!(
                "{} of {} free, {} in packages",
                format_bytes(disk.free_bytes),
                format_bytes(disk.total_bytes),
                format_bytes(disk.packages_bytes)
            ),
        ),
        ("broker", format!("{health}: {}, {}", broker.kind, broker.detail)),
    ])
}

/// For the line about the database: whether its structure is sound, as far as known.
fn integrity(
    DatabaseStatus { problem, fully_checked_at_ms, guard, .. }: &DatabaseStatus,
) -> String {
    let known = match (problem, fully_checked_at_ms) {
        (Some(problem), _) => Some(format!("NOT READY: {problem}")),
        (None, Some(at_ms)) => Some(format!("fully checked {}", time(*at_ms))),
        (None, None) => guard.clone(),
    };
    known.map_or_else(String::new, |known| format!("; {known}"))
}

fn site_row(site: &SiteStatus) -> Vec<String> {
    let unknown = || "-".to_owned();
    vec![
        site.site.as_ref().map_or_else(unknown, ToString::to_string),
        site.robots.to_string(),
        site.online.to_string(),
        site.throughput_bytes_per_s.map_or_else(unknown, format_rate),
        site.rtt_ms.map_or_else(unknown, |rtt_ms| format!("{rtt_ms} ms")),
    ]
}

const SESSIONS: Columns = Columns {
    name: "robot",
    narrow: &["robot", "address", "since", "subscriptions"],
    wide: &["id", "in", "out", "server"],
};

/// The connected clients, and the subscriptions of each.
pub(crate) async fn sessions(session: &Session) -> Result<Outcome, CommandError> {
    let mut all = SessionList::default();
    loop {
        let mut query = vec![("limit", PAGE.to_string())];
        query.extend(all.next.take().map(|next| ("after", next.to_string())));
        let page: SessionList = session.client.get("/server/sessions", &query).await?;
        all.sessions.extend(page.sessions);
        (all.total, all.next) = (page.total, page.next);
        if all.next.is_none() {
            break;
        }
    }
    session
        .output
        .print_list(&all, &SESSIONS, |all| all.sessions.iter().map(session_row).collect())?;
    Ok(Outcome::Succeeded)
}

fn session_row(session: &RobotSession) -> Vec<String> {
    let filters =
        session.subscriptions.iter().map(|to| format!("{} (QoS {})", to.topic_filter, to.qos));
    vec![
        session.name.to_string(),
        session.address.clone().unwrap_or_else(|| "-".to_owned()),
        time(session.since_ms),
        filters.collect::<Vec<_>>().join(", "),
        session.robot.to_string(),
        format_bytes(session.traffic.bytes_in),
        format_bytes(session.traffic.bytes_out),
        session.node.as_ref().map_or_else(|| "-".to_owned(), ToString::to_string),
    ]
}

const RULES: Columns = Columns {
    name: "name",
    narrow: &["order", "name", "mechanism", "condition"],
    wide: &["source"],
};
const LIMITS: Columns = Columns::of(&["limit", "value"]);

/// The delivery rules, and the limits in force.
pub(crate) async fn rules(session: &Session) -> Result<Outcome, CommandError> {
    let rules: ServerRules = session.client.get("/server/rules", &[]).await?;
    let names = |rules: &ServerRules| {
        rules.rules.iter().map(|rule| rule.name.clone()).collect::<Vec<_>>().join("\n")
    };
    session.output.print_object(&rules, names, |rules| {
        let rows: Vec<_> = rules.rules.iter().map(rule_row).collect();
        let limits: Vec<_> =
            rules.limits.iter().map(|limit| vec![limit.key.clone(), limit.value.clone()]).collect();
        format!(
            "{}\n{}",
            session.output.table(&RULES, &rows),
            session.output.table(&LIMITS, &limits)
        )
    })?;
    Ok(Outcome::Succeeded)
}

fn rule_row(rule: &RuleView) -> Vec<String> {
    vec![
        rule.order.to_string(),
        rule.name.clone(),
        rule.mechanism.to_string(),
        if rule.condition.is_empty() { "always".to_owned() } else { rule.condition.clone() },
        if rule.own { "configured" } else { "built in" }.to_owned(),
    ]
}
