//! Formats robots for the terminal. Text only; the caller has requested the data.

use task_proto::api::{PendingRobot, RobotTask, RobotView};
use task_proto::id::Labels;
use task_proto::report::{ActiveVersion, Isolation, LinkFacts, Phase, RosFacts, TaskAccounts};

use super::robot_settings::shown;
use super::top;
use crate::commands::display::output::table::Columns;
use crate::commands::display::output::{self, Output, bytes, time};
use crate::domain::delivery::Unit;

pub(in crate::commands) const COLUMNS: Columns = Columns {
    name: "name",
    narrow: &["id", "name", "address", "state", "last seen", "tasks"],
    wide: &["mac", "labels", "agent", "arch", "ros", "rtt", "disk free"],
};
pub(in crate::commands) const PENDING: Columns = Columns {
    name: "name",
    narrow: &["id", "name", "mac", "labels", "address", "token", "since"],
    wide: &[],
};
const TASKS: Columns = Columns::of(&[
    "task",
    "version",
    "wanted",
    "run",
    "phase",
    "restarts",
    "deployment",
    "problem",
]);

pub(in crate::commands) fn row(robot: &RobotView) -> Vec<String> {
    let tasks: Vec<_> = robot.tasks.iter().map(standing).collect();
    let (host, rtt_ms) = (robot.host.as_ref(), robot.link.and_then(|link| link.rtt_ms));
    let unknown = || "-".to_owned();
    vec![
        robot.id.to_string(),
        robot.name.to_string(),
        robot.address.clone().unwrap_or_else(|| "-".to_owned()),
        state(robot),
        robot.last_seen_ms.map_or_else(|| "never".to_owned(), time),
        if tasks.is_empty() { "-".to_owned() } else { tasks.join(" ") },
        robot.mac.to_string(),
        shown_labels(&robot.labels),
        host.map_or_else(unknown, |host| host.agent_version.clone()),
        host.map_or_else(unknown, |host| host.arch.clone()),
        host.map_or_else(unknown, |host| host.ros_distros.join(" ")),
        rtt_ms.map_or_else(unknown, |rtt_ms| Unit::Milliseconds.show(rtt_ms.into())),
        host.map_or_else(unknown, |host| bytes(host.disk_free_bytes)),
    ]
}

pub(in crate::commands) fn pending_row(robot: &PendingRobot) -> Vec<String> {
    vec![
        robot.id.to_string(),
        robot.name.to_string(),
        robot.mac.to_string(),
        shown_labels(&robot.labels),
        robot.address.clone().unwrap_or_else(|| "-".to_owned()),
        robot.token.as_ref().map_or_else(|| "-".to_owned(), ToString::to_string),
        time(robot.since_ms),
    ]
}

/// The accounts that run tasks, in words.
fn task_accounts(accounts: TaskAccounts) -> &'static str {
    match accounts {
        TaskAccounts::PerTask => "one for each task",
        TaskAccounts::Shared => "one for all tasks",
        TaskAccounts::Agent => "none: tasks run as the agent",
    }
}

fn shown_labels(labels: &Labels) -> String {
    let labels: Vec<_> = labels.iter().map(|(key, value)| format!("{key}={value}")).collect();
    if labels.is_empty() { "-".to_owned() } else { labels.join(" ") }
}

/// A task and its state, in a word or two.
fn standing(task: &RobotTask) -> String {
    let health = match (&task.degraded, still_running(task)) {
        (Some(_), _) => "/degraded",
        (None, Some(_)) => "/earlier-runs",
        (None, None) => "",
    };
    let age = if task.outdated { "/outdated" } else { "" };
    format!("{}:{}{health}{age}", task.task, task.phase)
}

/// The version that keeps running although a newer order has failed or can't begin.
fn still_running(task: &RobotTask) -> Option<&ActiveVersion> {
    let is_over = task.phase.is_final() && task.phase != Phase::RolledBack;
    task.active.as_ref().filter(|active| is_over && active.deployment != task.deployment)
}

/// Online or offline, and the conditions an operator must know about.
fn state(robot: &RobotView) -> String {
    let mut state = vec![if robot.online { "online" } else { "offline" }];
    state.extend(robot.conditions.iter().map(|condition| condition.code.as_str()));
    state.join(" ")
}

pub(in crate::commands) fn describe(robot: &RobotView, output: &Output) -> String {
    let mut facts = vec![
        ("id", robot.id.to_string()),
        ("name", robot.name.to_string()),
        ("mac", robot.mac.to_string()),
        ("state", if robot.online { "online" } else { "offline" }.to_owned()),
        ("address", robot.address.clone().unwrap_or_else(|| "-".to_owned())),
        ("last seen", robot.last_seen_ms.map_or_else(|| "never".to_owned(), time)),
        ("enrolled", time(robot.enrolled_at_ms)),
        ("labels", shown_labels(&robot.labels)),
        (
            "generation",
            format!("{} ordered, {} observed", robot.generation, robot.observed_generation),
        ),
    ];
    if let Some(host) = &robot.host {
        facts.push((
            "host",
            format!("{} {} agent {}", host.hostname, host.arch, host.agent_version),
        ));
        facts.push((
            "ros",
            if host.ros_distros.is_empty() { "-".to_owned() } else { host.ros_distros.join(" ") },
        ));
        if let Some(ros) = &host.ros {
            facts.push(("ros in use", ros_in_use(ros)));
        }
        facts.push((
            "isolation",
            if host.isolation == Isolation::Cgroup { "cgroup" } else { "none" }.to_owned(),
        ));
        if let Some(accounts) = host.accounts {
            facts.push(("accounts", task_accounts(accounts).to_owned()));
        }
        facts.push(("disk free", bytes(host.disk_free_bytes)));
        facts.push(("publishers", publishers(host.publishers)));
        if let Some(percent) = host.battery_percent {
            facts.push(("battery", format!("{percent}%")));
        }
    }
    if let Some(link) = &robot.link {
        facts.push(("link", measured(link)));
    }
    if let Some(vitals) = &robot.vitals {
        facts.push(("vitals", format!("{}, {}", top::summary(vitals), time(vitals.at_ms))));
    }
    if let Some(settings) = &robot.settings {
        facts.push(("set here", shown(settings)));
    }
    if let Some(effective) = &robot.effective_settings {
        facts.push(("settings", shown(&effective.values)));
        facts.extend((!effective.own.is_empty()).then(|| ("robot's own", effective.own.join(" "))));
        facts.extend(
            (!effective.refused.is_empty()).then(|| ("not taken", effective.refused.join(" "))),
        );
    }
    if let Some(mqtt) = &robot.mqtt {
        facts.push(("connected", time(mqtt.since_ms)));
        facts.push(("mqtt in", crate::commands::service::server::inward(&mqtt.traffic)));
        facts.push(("mqtt out", crate::commands::service::server::outward(&mqtt.traffic)));
    }
    facts.extend(robot.conditions.iter().map(|c| ("condition", format!("{}: {}", c.code, c.text))));
    let mut text = output::facts(facts);
    if !robot.tasks.is_empty() {
        let rows: Vec<_> = robot.tasks.iter().map(task_row).collect();
        text.push('\n');
        text.push_str(&output.table(&TASKS, &rows));
    }
    text
}

/// The publishers whose packages a robot runs, in words.
fn publishers(version: Option<u64>) -> String {
    match version {
        None => "not asked for: it runs what the server orders".to_owned(),
        Some(0) => "those of its own settings".to_owned(),
        Some(version) => format!("by version {version} of their list"),
    }
}

/// Measurements by transfers of a robot's link to the server, in words.
fn measured(link: &LinkFacts) -> String {
    let counted = |count: u32, one: &str, many: &str| {
        format!("{count} {}", if count == 1 { one } else { many })
    };
    let parts = [
        link.throughput_bytes_per_s.map(|rate| Unit::BytesPerSecond.show(rate)),
        link.rtt_ms.map(|rtt_ms| format!("rtt {}", Unit::Milliseconds.show(rtt_ms.into()))),
        Some(counted(link.losses, "transfer broke off", "transfers broke off")),
        Some(format!("{} in an hour", counted(link.reconnects, "session lost", "sessions lost"))),
    ];
    parts.into_iter().flatten().collect::<Vec<_>>().join(", ")
}

/// The ROS setup of tasks, in words.
fn ros_in_use(ros: &RosFacts) -> String {
    let domain = ros.domain_id.map(|domain| format!("domain {domain}"));
    let range = ros.localhost_only.then(|| "this host only".to_owned());
    let parts = [Some(ros.distro.clone()), ros.rmw.clone(), domain, range];
    parts.into_iter().flatten().collect::<Vec<_>>().join(", ")
}

fn task_row(task: &RobotTask) -> Vec<String> {
    let wanted = match task.wanted {
        task_proto::desired::Wanted::Running => "running",
        task_proto::desired::Wanted::Stopped => "stopped",
    };
    vec![
        task.task.to_string(),
        if task.outdated {
            format!("{} (outdated)", task.version)
        } else {
            task.version.to_string()
        },
        wanted.to_owned(),
        task.run.to_string(),
        task.phase.to_string(),
        task.restarts.to_string(),
        task.deployment.to_string(),
        problem(task),
    ]
}

/// Why a task failed or waits, or else why the task does not run normally.
fn problem(task: &RobotTask) -> String {
    match (&task.failure, &task.degraded) {
        (Some(failure), _) => match still_running(task) {
            Some(earlier) => {
                format!(
                    "{failure}; {} still runs, from deployment {}",
                    earlier.version, earlier.deployment
                )
            }
            None => failure.to_string(),
        },
        (None, Some(degraded)) => format!("degraded: {degraded}"),
        (None, None) => "-".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_link_is_told_as_far_as_it_was_measured() {
        let link = LinkFacts {
            throughput_bytes_per_s: Some(2 << 20),
            rtt_ms: Some(31),
            reconnects: 1,
            losses: 2,
        };
        assert_eq!(
            measured(&link),
            "2 MB/s, rtt 31 ms, 2 transfers broke off, 1 session lost in an hour"
        );
        assert_eq!(
            measured(&LinkFacts::default()),
            "0 transfers broke off, 0 sessions lost in an hour"
        );
    }
}
