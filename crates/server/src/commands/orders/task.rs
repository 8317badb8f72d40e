//! `taskd start|stop|restart|rollback|remove`: orders on tasks that robots already have.

use std::time::Duration;

use clap::Args;
use task_proto::TaskName;
use task_proto::api::{
    DeploymentView, MatchedRobot, MatchedRobots, OrderTask, RobotView, RolledBack,
};
use task_proto::selector::Selector;
use tokio::time::{Instant, sleep, timeout_at};

use crate::commands::api::client::{ClientError, random_key};
use crate::commands::api::{complete, wait};
use crate::commands::display::confirm::confirm;
use crate::commands::display::output::table::Columns;
use crate::commands::display::output::{robots, say};
use crate::commands::display::view::print_matched;
use crate::commands::robots::selection;
use crate::commands::{CommandError, Outcome, Session};
use crate::config::lifetime;

/// Which task on which robots.
#[derive(Debug, Args)]
pub struct TaskOrder {
    /// The task's name
    #[arg(add = complete::tasks())]
    task: TaskName,
    /// Which robots: *, names, label=value, !term for all but; those without the task are left out
    #[arg(long, value_name = "SELECTOR", add = complete::selectors())]
    on: Selector,
    /// Only list the robots that are meant
    #[arg(long)]
    dry_run: bool,
    /// Don't ask, however many robots are meant
    #[arg(short, long)]
    yes: bool,
    /// Makes a repeated command the same order
    #[arg(long, value_name = "KEY")]
    idempotency_key: Option<String>,
}

/// Which task to remove, and whether to wait until it is gone.
#[derive(Debug, Args)]
pub struct RemoveOrder {
    #[command(flatten)]
    order: TaskOrder,
    /// Wait until it is gone from every robot
    #[arg(long, conflicts_with = "dry_run")]
    wait: bool,
    /// How long to wait
    #[arg(long, value_name = "TIME", value_parser = lifetime, default_value = "2m", requires = "wait")]
    timeout: Duration,
}

/// The action on the task.
#[derive(Debug, Clone, Copy)]
pub(in crate::commands) enum Verb {
    Start,
    Stop,
    Restart,
    Remove,
}

impl Verb {
    fn as_str(self) -> &'static str {
        match self {
            Self::Start => "start",
            Self::Stop => "stop",
            Self::Restart => "restart",
            Self::Remove => "remove",
        }
    }
}

pub(in crate::commands) async fn run(
    session: &Session,
    verb: Verb,
    order: TaskOrder,
) -> Result<Outcome, CommandError> {
    give(session, verb, order).await?;
    Ok(Outcome::Succeeded)
}

pub(in crate::commands) async fn remove(
    session: &Session,
    order: RemoveOrder,
) -> Result<Outcome, CommandError> {
    let RemoveOrder { order, wait, timeout } = order;
    let task = order.task.clone();
    let ordered = give(session, Verb::Remove, order).await?;
    if !wait {
        return Ok(Outcome::Succeeded);
    }
    until_gone(session, &task, &ordered, timeout).await
}

/// Moves each robot back to the package it had before the present one.
pub(in crate::commands) async fn roll_back(
    session: &Session,
    order: TaskOrder,
) -> Result<Outcome, CommandError> {
    let TaskOrder { task, on, dry_run, yes, idempotency_key } = order;
    let path = format!("/tasks/{task}/rollback");
    let may_be_repeated = idempotency_key.is_some() && !dry_run;
    let ask = OrderTask { selector: on.clone(), dry_run: true };
    let meant: RolledBack = match session.client.order(&path, &ask, &random_key()).await {
        Err(ClientError::Refused { code, .. })
            if is_nobody(&code, may_be_repeated) || code == "nothing_to_roll_back" =>
        {
            RolledBack::default()
        }
        answer => answer?,
    };
    if meant.robots.is_empty() && !may_be_repeated {
        say_without(&meant.without);
        return Err(CommandError::Usage(format!(
            "no robot that {on} selects has an earlier version of {task}"
        )));
    }
    if dry_run {
        print_matched(session, &MatchedRobots { robots: meant.robots })?;
        say_without(&meant.without);
        return Ok(Outcome::Succeeded);
    }
    confirm(&format!("rollback {task} on {on}"), meant.robots.len(), yes)?;
    let order = OrderTask { selector: on, dry_run: false };
    let key = idempotency_key.unwrap_or_else(random_key);
    let back: RolledBack = session.client.order(&path, &order, &key).await?;
    session.output.result(&back, &ROLLED_BACK, |back| {
        back.deployments.iter().map(rolled_back_row).collect()
    })?;
    say_without(&back.without);
    say(&format!("ordered: rollback {task} on {}", robots(back.robots.len() as u64)));
    Ok(Outcome::Succeeded)
}

const ROLLED_BACK: Columns = Columns {
    name: "deployment",
    narrow: &["deployment", "package", "version", "robots"],
    wide: &["manifest"],
};

fn rolled_back_row(deployment: &DeploymentView) -> Vec<String> {
    let package = &deployment.package;
    vec![
        deployment.id.to_string(),
        package.name.to_string(),
        package.version.to_string(),
        deployment.counts.iter().map(|count| count.count).sum::<u64>().to_string(),
        package.manifest.digest.to_string(),
    ]
}

fn say_without(without: &[MatchedRobot]) {
    const MAX_NAMES: usize = 10;
    if without.is_empty() {
        return;
    }
    let mut names: Vec<&str> =
        without.iter().take(MAX_NAMES).map(|robot| robot.name.as_str()).collect();
    let more = without.len().saturating_sub(MAX_NAMES);
    let and_more = format!("and {more} more");
    if more > 0 {
        names.push(&and_more);
    }
    say(&format!("no earlier version ran on {}", names.join(", ")));
}

/// Waits until none of `ordered` has the task any more. A robot removed meanwhile no longer counts;
/// a robot with new labels or a new name still does.
async fn until_gone(
    session: &Session,
    task: &TaskName,
    ordered: &MatchedRobots,
    timeout: Duration,
) -> Result<Outcome, CommandError> {
    let deadline = Instant::now() + timeout;
    let still_meant = by_id(&ordered.robots);
    let mut left: Option<Vec<RobotView>> = None;
    while Instant::now() < deadline {
        match timeout_at(deadline, selection::matching(session, &still_meant)).await {
            Err(_) => break,
            Ok(Err(CommandError::Client(error))) if wait::may_pass(&error) => {}
            Ok(Err(error)) => return Err(error),
            Ok(Ok(list)) => {
                let is_meant =
                    |robot: &RobotView| ordered.robots.iter().any(|meant| meant.id == robot.id);
                let robots = list.robots.into_iter().filter(is_meant);
                let robots: Vec<RobotView> =
                    robots.filter(|robot| has_still(robot, task)).collect();
                if robots.is_empty() {
                    say(&format!(
                        "{task} is gone from {}",
                        self::robots(ordered.robots.len() as u64)
                    ));
                    return Ok(Outcome::Succeeded);
                }
                left = Some(robots);
            }
        }
        sleep(wait::MAX_PAUSE.min(deadline.saturating_duration_since(Instant::now()))).await;
    }
    match left {
        None => say("timed out: the server did not say how the robots stand"),
        Some(left) => {
            for robot in left {
                let why = if robot.online {
                    "not done in time"
                } else {
                    "offline, follows when it is back"
                };
                say(&format!("{}: {why}", robot.name));
            }
        }
    }
    Ok(Outcome::TimedOut)
}

/// A selector of these robots by id, independent of their names and labels; of all robots if the
/// list is too long for a query.
fn by_id(robots: &[MatchedRobot]) -> Selector {
    const MAX_LISTED: usize = 200;
    let ids: Vec<&str> =
        robots.iter().take(MAX_LISTED + 1).map(|robot| robot.id.as_str()).collect();
    let listed = if ids.len() > MAX_LISTED { "*".to_owned() } else { ids.join(",") };
    listed.parse().expect("ids are a selector")
}

/// Whether the robot has not followed its newest order yet, or is still getting rid of the task.
fn has_still(robot: &RobotView, task: &TaskName) -> bool {
    robot.observed_generation < robot.generation
        || robot.tasks.iter().any(|known| known.task == *task)
}

/// Whether the refusal means that the selection is empty. If the order may be a repetition, its
/// robots may be gone by now.
fn is_nobody(code: &str, may_be_repeated: bool) -> bool {
    code == "no_robots_match" || (may_be_repeated && code == "unknown_robots")
}

/// Sends the order; returns the robots that received the order.
async fn give(
    session: &Session,
    verb: Verb,
    order: TaskOrder,
) -> Result<MatchedRobots, CommandError> {
    let TaskOrder { task, on, dry_run, yes, idempotency_key } = order;
    let path = format!("/tasks/{task}/{}", verb.as_str());
    // With a key this may repeat an earlier order, whose tasks are gone by now: the server knows.
    let may_be_repeated = idempotency_key.is_some() && !dry_run;
    let key = idempotency_key.unwrap_or_else(random_key);
    let ask = OrderTask { selector: on.clone(), dry_run: true };
    // A dry run changes nothing, so it gets a key of its own.
    let matched: MatchedRobots = match session.client.order(&path, &ask, &random_key()).await {
        Err(ClientError::Refused { code, .. }) if is_nobody(&code, may_be_repeated) => {
            MatchedRobots::default()
        }
        answer => answer?,
    };
    if matched.robots.is_empty() && !may_be_repeated {
        return Err(CommandError::Usage(format!("no robot that {on} selects has the task {task}")));
    }
    if dry_run {
        print_matched(session, &matched)?;
        return Ok(matched);
    }
    confirm(&format!("{} {task} on {on}", verb.as_str()), matched.robots.len(), yes)?;
    let ordered: MatchedRobots =
        session.client.order(&path, &OrderTask { selector: on, dry_run: false }, &key).await?;
    print_matched(session, &ordered)?;
    let offline = ordered.robots.iter().filter(|robot| !robot.online).count();
    say(&format!("ordered: {} {task} on {}", verb.as_str(), robots(ordered.robots.len() as u64)));
    if offline > 0 {
        say(&format!("{offline} of them are offline and follow when they are back"));
    }
    Ok(ordered)
}
