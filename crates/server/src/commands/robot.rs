//! `taskd robot`: shows robots, lets them in, puts them out and removes them.

use clap::Subcommand;
use task_proto::RobotName;
use task_proto::api::{PendingRobot, PendingRobotList, RobotList, RobotTask, RobotView};
use task_proto::id::Labels;
use task_proto::report::{Isolation, LinkFacts, RosFacts};
use task_proto::selector::Selector;

use super::confirm::always;
use super::output::{printable, say, table, time};
use super::{CommandError, Outcome, Session};
use crate::delivery::Unit;

/// What to do with robots.
#[derive(Debug, Subcommand)]
pub enum Action {
    /// List robots
    List {
        /// Which robots: *, names, label=value; commas separate alternatives, & joins conditions
        #[arg(default_value = "*")]
        selector: Selector,
    },
    /// Show everything about one robot
    Info {
        /// Its name or id
        robot: RobotName,
    },
    /// List robots that wait to be approved
    Pending,
    /// Let robots in that wait
    Approve {
        /// Their names or ids
        #[arg(required = true)]
        robots: Vec<RobotName>,
    },
    /// Turn away a robot that waits, and forget it
    Reject {
        /// Its name or id
        robot: RobotName,
    },
    /// End a robot's tokens and whatever it does by them, now; it comes back only by enrolling with a token made for it
    Revoke {
        /// Its name or id
        robot: RobotName,
    },
    /// Remove a robot; its token ends, its tasks run on but nothing new starts
    Rm {
        /// Its name or id
        robot: RobotName,
        /// Don't ask
        #[arg(short, long)]
        yes: bool,
    },
}

pub(super) async fn run(session: &Session, action: Action) -> Result<Outcome, CommandError> {
    match action {
        Action::List { selector } => {
            let list = matching(session, &selector).await?;
            session.output.result(&list, &HEADER, |list| list.robots.iter().map(row).collect())?;
        }
        Action::Info { robot } => {
            let robot = one(session, &robot).await?.id;
            let robot: RobotView = session.client.get(&format!("/robots/{robot}"), &[]).await?;
            session.output.described(&robot, describe)?;
        }
        Action::Pending => {
            let list: PendingRobotList = session.client.get("/pending-robots", &[]).await?;
            let header = ["id", "name", "mac", "labels", "address", "token", "since"];
            session.output.result(&list, &header, |list| list.robots.iter().map(pending_row).collect())?;
        }
        Action::Approve { robots } => {
            for robot in robots {
                let robot = one(session, &robot).await?;
                session.client.act(&format!("/robots/{}/approve", robot.id)).await?;
                say(&format!("approved {} ({})", robot.name, robot.id));
            }
        }
        Action::Reject { robot } => {
            let robot = one(session, &robot).await?;
            session.client.act(&format!("/robots/{}/reject", robot.id)).await?;
            say(&format!("rejected {} ({})", robot.name, robot.id));
        }
        Action::Revoke { robot } => {
            let robot = one(session, &robot).await?;
            session.client.act(&format!("/robots/{}/revoke", robot.id)).await?;
            say(&format!("revoked {} ({})", robot.name, robot.id));
            say(&format!("it comes back with: taskd enroll-token create --uses 1 --robot {}", robot.name));
        }
        Action::Rm { robot, yes } => {
            let robot = one(session, &robot).await?;
            always(&format!("remove the robot {}", robot.name), yes)?;
            session.client.delete(&format!("/robots/{}", robot.id)).await?;
            say(&format!("removed {} ({})", robot.name, robot.id));
        }
    }
    Ok(Outcome::Succeeded)
}

/// The robots that `selector` means now.
pub(super) async fn matching(session: &Session, selector: &Selector) -> Result<RobotList, CommandError> {
    Ok(session.client.get("/robots", &[("selector", selector.to_string())]).await?)
}

async fn one(session: &Session, name: &RobotName) -> Result<RobotView, CommandError> {
    let selector = name.as_str().parse().map_err(|error| CommandError::Usage(format!("{error}")))?;
    let mut robots = matching(session, &selector).await?.robots;
    match robots.len() {
        0 => Err(CommandError::Usage(format!("no robot has the name or id {name}"))),
        1 => Ok(robots.remove(0)),
        _ => Err(CommandError::Usage(format!("{name} is the name of one robot and the id of another"))),
    }
}

const HEADER: [&str; 7] = ["id", "name", "mac", "address", "state", "last seen", "tasks"];

fn row(robot: &RobotView) -> Vec<String> {
    let tasks: Vec<_> = robot.tasks.iter().map(standing).collect();
    vec![
        robot.id.to_string(),
        robot.name.to_string(),
        robot.mac.to_string(),
        robot.address.clone().unwrap_or_else(|| "-".to_owned()),
        state(robot),
        robot.last_seen_ms.map_or_else(|| "never".to_owned(), time),
        if tasks.is_empty() { "-".to_owned() } else { tasks.join(" ") },
    ]
}

fn pending_row(robot: &PendingRobot) -> Vec<String> {
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

fn shown_labels(labels: &Labels) -> String {
    let labels: Vec<_> = labels.iter().map(|(key, value)| format!("{key}={value}")).collect();
    if labels.is_empty() { "-".to_owned() } else { labels.join(" ") }
}

/// A task and where it stands, in a word or two.
fn standing(task: &RobotTask) -> String {
    let health = if task.degraded.is_some() { "/degraded" } else { "" };
    format!("{}:{}{health}", task.task, task.phase)
}

/// Online or offline, and the conditions an operator must know about.
fn state(robot: &RobotView) -> String {
    let mut state = vec![if robot.online { "online" } else { "offline" }];
    state.extend(robot.conditions.iter().map(|condition| condition.code.as_str()));
    state.join(" ")
}

fn describe(robot: &RobotView) -> String {
    let mut facts = vec![
        ("id", robot.id.to_string()),
        ("name", robot.name.to_string()),
        ("mac", robot.mac.to_string()),
        ("state", if robot.online { "online" } else { "offline" }.to_owned()),
        ("address", robot.address.clone().unwrap_or_else(|| "-".to_owned())),
        ("last seen", robot.last_seen_ms.map_or_else(|| "never".to_owned(), time)),
        ("enrolled", time(robot.enrolled_at_ms)),
        ("labels", shown_labels(&robot.labels)),
        ("generation", format!("{} ordered, {} observed", robot.generation, robot.observed_generation)),
    ];
    if let Some(host) = &robot.host {
        facts.push(("host", format!("{} {} agent {}", host.hostname, host.arch, host.agent_version)));
        facts.push(("ros", if host.ros_distros.is_empty() { "-".to_owned() } else { host.ros_distros.join(" ") }));
        if let Some(ros) = &host.ros {
            facts.push(("ros in use", ros_in_use(ros)));
        }
        facts.push(("isolation", if host.isolation == Isolation::Cgroup { "cgroup" } else { "none" }.to_owned()));
        facts.push(("disk free", super::output::bytes(host.disk_free_bytes)));
        facts.push(("publishers", publishers(host.publishers)));
        if let Some(percent) = host.battery_percent {
            facts.push(("battery", format!("{percent}%")));
        }
    }
    if let Some(link) = &robot.link {
        facts.push(("link", measured(link)));
    }
    if let Some(mqtt) = &robot.mqtt {
        facts.push(("connected", time(mqtt.since_ms)));
        facts.push(("mqtt in", super::server::inward(&mqtt.traffic)));
        facts.push(("mqtt out", super::server::outward(&mqtt.traffic)));
    }
    facts.extend(robot.conditions.iter().map(|c| ("condition", format!("{}: {}", c.code, c.text))));
    let mut text: String = facts.iter().map(|(key, value)| format!("{key:<12}{}\n", printable(value))).collect();
    if !robot.tasks.is_empty() {
        text.push('\n');
        let header = ["task", "version", "wanted", "run", "phase", "restarts", "deployment", "problem"];
        text.push_str(&table(&header, robot.tasks.iter().map(task_row).collect()));
    }
    text
}

/// By whose word a robot runs packages, in words.
fn publishers(version: Option<u64>) -> String {
    match version {
        None => "not asked for: it runs what the server orders".to_owned(),
        Some(0) => "those of its own settings".to_owned(),
        Some(version) => format!("by version {version} of their list"),
    }
}

/// What transfers have shown of a robot's way to the server, in words.
fn measured(link: &LinkFacts) -> String {
    let counted = |count: u32, one: &str, many: &str| format!("{count} {}", if count == 1 { one } else { many });
    let parts = [
        link.throughput_bytes_per_s.map(|rate| Unit::BytesPerSecond.show(rate)),
        link.rtt_ms.map(|rtt_ms| format!("rtt {}", Unit::Milliseconds.show(rtt_ms.into()))),
        Some(counted(link.losses, "transfer broke off", "transfers broke off")),
        Some(format!("{} in an hour", counted(link.reconnects, "session lost", "sessions lost"))),
    ];
    parts.into_iter().flatten().collect::<Vec<_>>().join(", ")
}

/// How tasks meet ROS, in words.
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
        task.version.to_string(),
        wanted.to_owned(),
        task.run.to_string(),
        task.phase.to_string(),
        task.restarts.to_string(),
        task.deployment.to_string(),
        problem(task),
    ]
}

/// Why a task failed or waits, or else why it runs not as it should.
fn problem(task: &RobotTask) -> String {
    match (&task.failure, &task.degraded) {
        (Some(failure), _) => failure.to_string(),
        (None, Some(degraded)) => format!("degraded: {degraded}"),
        (None, None) => "-".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_link_is_told_as_far_as_it_was_measured() {
        let link = LinkFacts { throughput_bytes_per_s: Some(2 << 20), rtt_ms: Some(31), reconnects: 1, losses: 2 };
        assert_eq!(measured(&link), "2 MB/s, rtt 31 ms, 2 transfers broke off, 1 session lost in an hour");
        assert_eq!(measured(&LinkFacts::default()), "0 transfers broke off, 0 sessions lost in an hour");
    }
}
