//! Formats robots for the terminal. Text only; the caller has requested the data.

use task_proto::api::{PendingRobot, RobotTask, RobotView};
use task_proto::ids::Labels;
use task_proto::messages::report::{
    ActiveVersion, Isolation, LinkFacts, Phase, RosFacts, TaskAccounts,
};
use task_proto::size::{format_bytes, format_rate};

use super::robot_settings::format_settings;
use super::top;
use crate::display::output::table::Columns;
use crate::display::output::{self, Output, time};

pub(crate) const COLUMNS: Columns = Columns {
    name: "name",
    narrow: &["id", "name", "address", "state", "last seen", "tasks"],
    wide: &["mac", "labels", "agent", "arch", "ros", "rtt", "disk free"],
};
pub(crate) const PENDING: Columns = Columns {
    name: "name",
    narrow: &["id", "name", "mac", "labels", "address", "token", "since"],
    wide: &[],
};
const TASKS: Columns = Columns::of(&[
    "task",
    "version",
    "desired",
    "run",
    "phase",
    "restarts",
    "deployment",
    "problem",
]);

pub(crate) fn row(robot: &RobotView) -> Vec<String> {
    let tasks: Vec<_> = robot.tasks.iter().map(task_state).collect();
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
        format_labels(&robot.labels),
        host.map_or_else(unknown, |host| host.agent_version.clone()),
        host.map_or_else(unknown, |host| host.arch.clone()),
        host.map_or_else(unknown, |host| host.ros_distros.join(" ")),
        rtt_ms.map_or_else(unknown, |rtt_ms| format!("{rtt_ms} ms")),
        host.map_or_else(unknown, |host| format_bytes(host.disk_free_bytes)),
    ]
}

pub(crate) fn pending_row(robot: &PendingRobot) -> Vec<String> {
    vec![
        robot.id.to_string(),
        robot.name.to_string(),
        robot.mac.to_string(),
        format_labels(&robot.labels),
        robot.address.clone().unwrap_or_else(|| "-".to_owned()),
        robot.token.as_ref().map_or_else(|| "-".to_owned(), ToString::to_string),
        time(robot.since_ms),
    ]
}

/// The accounts that run tasks, in words.
fn task_accounts(accounts: TaskAccounts) -> &'static str {
    match accounts {
        TaskAccounts::PerTask => "one per task",
        TaskAccounts::Shared => "one for all tasks",
        TaskAccounts::Agent => "none: tasks run as the agent's user",
    }
}

fn format_labels(labels: &Labels) -> String {
    let labels: Vec<_> = labels.iter().map(|(key, value)| format!("{key}={value}")).collect();
    if labels.is_empty() { "-".to_owned() } else { labels.join(" ") }
}

/// A task and its state, in a word or two.
fn task_state(task: &RobotTask) -> String {
    let health = match (&task.degraded, earlier_version(task)) {
        (Some(_), _) => "/degraded",
        (None, Some(_)) => "/previous-runs",
        (None, None) => "",
    };
    let age = if task.outdated { "/outdated" } else { "" };
    format!("{}:{}{health}{age}", task.task, task.phase)
}

/// The version that keeps running although a newer order has failed or can't begin.
fn earlier_version(task: &RobotTask) -> Option<&ActiveVersion> {
    let is_over = task.phase.is_final() && task.phase != Phase::RolledBack;
    task.active.as_ref().filter(|active| is_over && active.deployment != task.deployment)
}

/// Online or offline, and the conditions an operator must know about.
fn state(robot: &RobotView) -> String {
    let mut state = vec![if robot.online { "online" } else { "offline" }];
    state.extend(robot.conditions.iter().map(|condition| condition.code.as_str()));
    state.join(" ")
}

pub(crate) fn describe(robot: &RobotView, output: &Output) -> String {
    let mut facts = vec![
        ("id", robot.id.to_string()),
        ("name", robot.name.to_string()),
        ("mac", robot.mac.to_string()),
        ("state", if robot.online { "online" } else { "offline" }.to_owned()),
        ("address", robot.address.clone().unwrap_or_else(|| "-".to_owned())),
        ("last seen", robot.last_seen_ms.map_or_else(|| "never".to_owned(), time)),
        ("enrolled", time(robot.enrolled_at_ms)),
        ("labels", format_labels(&robot.labels)),
        (
            "generation",
            format!("{} desired, {} observed", robot.generation, robot.observed_generation),
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
            facts.push(("ros in use", describe_ros(ros)));
        }
        facts.push((
            "isolation",
            if host.isolation == Isolation::Cgroup { "cgroup" } else { "none" }.to_owned(),
        ));
        if let Some(accounts) = host.accounts {
            facts.push(("accounts", task_accounts(accounts).to_owned()));
        }
        facts.push(("disk free", format_bytes(host.disk_free_bytes)));
        facts.push(("publishers", describe_publishers(host.publishers)));
        if let Some(percent) = host.battery_percent {
            facts.push(("battery", format!("{percent}%")));
        }
    }
    if let Some(link) = &robot.link {
        facts.push(("link", describe_link(link)));
    }
    if let Some(vitals) = &robot.vitals {
        facts.push(("vitals", format!("{}, {}", top::summary(vitals), time(vitals.at_ms))));
    }
    if let Some(settings) = &robot.settings {
        facts.push(("from server", format_settings(settings)));
    }
    if let Some(effective) = &robot.effective_settings {
        facts.push(("settings", format_settings(&effective.values)));
        facts.extend((!effective.own.is_empty()).then(|| ("from robot", effective.own.join(" "))));
        facts.extend(
            (!effective.refused.is_empty()).then(|| ("rejected", effective.refused.join(" "))),
        );
    }
    if let Some(mqtt) = &robot.mqtt {
        facts.push(("connected", time(mqtt.since_ms)));
        facts.push(("mqtt in", crate::service::server::incoming(&mqtt.traffic)));
        facts.push(("mqtt out", crate::service::server::outgoing(&mqtt.traffic)));
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
fn describe_publishers(version: Option<u64>) -> String {
    match version {
        None => "signatures not required".to_owned(),
        Some(0) => "from the robot's own settings".to_owned(),
        Some(version) => format!("version {version} of the list"),
    }
}

/// Measurements by transfers of a robot's link to the server, in words.
fn describe_link(link: &LinkFacts) -> String {
    let counted = |count: u32, one: &str, many: &str| {
        format!("{count} {}", if count == 1 { one } else { many })
    };
    let parts = [
        link.throughput_bytes_per_s.map(format_rate),
        link.rtt_ms.map(|rtt_ms| format!("rtt {rtt_ms} ms")),
        Some(counted(link.losses, "interrupted transfer", "interrupted transfers")),
        Some(format!(
            "{} in the last hour",
            counted(link.reconnects, "lost session", "lost sessions")
        )),
    ];
    parts.into_iter().flatten().collect::<Vec<_>>().join(", ")
}

/// The ROS setup of tasks, in words.
fn describe_ros(ros: &RosFacts) -> String {
    let domain = ros.domain_id.map(|domain| format!("domain {domain}"));
    let range = ros.localhost_only.then(|| "localhost only".to_owned());
    let parts = [Some(ros.distro.clone()), ros.rmw.clone(), domain, range];
    parts.into_iter().flatten().collect::<Vec<_>>().join(", ")
}

fn task_row(task: &RobotTask) -> Vec<String> {
    let wanted = match task.wanted {
        task_proto::desired::TargetState::Running => "running",
        task_proto::desired::TargetState::Stopped => "stopped",
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
        (Some(failure), _) => match earlier_version(task) {
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
    fn link_description_shows_measured_values() {
        let link = LinkFacts {
            throughput_bytes_per_s: Some(2 << 20),
            rtt_ms: Some(31),
            reconnects: 1,
            losses: 2,
        };
        assert_eq!(
            describe_link(&link),
            "2 MB/s, rtt 31 ms, 2 interrupted transfers, 1 lost session in the last hour"
        );
        assert_eq!(
            describe_link(&LinkFacts::default()),
            "0 interrupted transfers, 0 lost sessions in the last hour"
        );
    }
}
