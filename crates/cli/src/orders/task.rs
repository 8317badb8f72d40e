//! `taskd start|stop|restart|rollback|remove`: orders on tasks that robots already have.

use std::time::Duration;

use clap::Args;
use task_proto::TaskName;
use task_proto::api::{
    DeploymentView, MatchedRobot, MatchedRobots, OrderTask, RobotView, RolledBack,
};
use task_proto::ids::selector::Selector;
use task_proto::time::parse_lifetime;
use tokio::time::{Instant, sleep, timeout_at};

use crate::api::client::{ClientError, random_key};
use crate::api::{complete, wait};
use crate::display::confirm::confirm;
use crate::display::output::table::Columns;
use crate::display::output::{robots, say};
use crate::display::view::print_matched;
use crate::robots::selection;
use crate::{CommandError, Outcome, Session};

/// The task and its robots.
#[derive(Debug, Args)]
pub struct TaskArgs {
    /// Task name
    #[arg(add = complete::tasks())]
    task: TaskName,
    /// Robots: *, names or ids, label=value, !TERM to exclude; robots without the task are skipped
    #[arg(long, value_name = "SELECTOR", add = complete::selectors())]
    on: Selector,
    /// Only list the matching robots
    #[arg(long)]
    dry_run: bool,
    /// Skip the confirmation prompt
    #[arg(short, long)]
    yes: bool,
    /// Idempotency key: a repeated command with the same key is carried out once
    #[arg(long, value_name = "KEY")]
    idempotency_key: Option<String>,
}

/// The task to remove, and whether to wait until it is gone.
#[derive(Debug, Args)]
pub struct RemoveArgs {
    #[command(flatten)]
    task: TaskArgs,
    /// Wait until the task is removed from all robots
    #[arg(long, conflicts_with = "dry_run")]
    wait: bool,
    /// Maximum time to wait
    #[arg(long, value_name = "TIME", value_parser = parse_lifetime, default_value = "2m", requires = "wait")]
    timeout: Duration,
}

/// The action on the task.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Verb {
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

pub(crate) async fn run(
    session: &Session,
    verb: Verb,
    args: TaskArgs,
) -> Result<Outcome, CommandError> {
    send_order(session, verb, args).await?;
    Ok(Outcome::Succeeded)
}

pub(crate) async fn remove(session: &Session, args: RemoveArgs) -> Result<Outcome, CommandError> {
    let RemoveArgs { task: args, wait, timeout } = args;
    let task = args.task.clone();
    let ordered = send_order(session, Verb::Remove, args).await?;
    if !wait {
        return Ok(Outcome::Succeeded);
    }
    wait_until_gone(session, &task, &ordered, timeout).await
}

/// Moves each robot back to the package it had before the present one.
pub(crate) async fn rollback(session: &Session, args: TaskArgs) -> Result<Outcome, CommandError> {
    let TaskArgs { task, on, dry_run, yes, idempotency_key } = args;
    let path = format!("/tasks/{task}/rollback");
    let may_be_retry = idempotency_key.is_some() && !dry_run;
    let dry_order = OrderTask { selector: on.clone(), dry_run: true };
    let preview: RolledBack =
        match session.client.post_with_key(&path, &dry_order, &random_key()).await {
            Err(ClientError::Refused { code, .. })
                if is_empty_selection(&code, may_be_retry) || code == "nothing_to_roll_back" =>
            {
                RolledBack::default()
            }
            answer => answer?,
        };
    if preview.robots.is_empty() && !may_be_retry {
        report_skipped(&preview.without);
        return Err(CommandError::Usage(format!(
            "no robot that matches {on} has an earlier version of {task}"
        )));
    }
    if dry_run {
        print_matched(session, &MatchedRobots { robots: preview.robots })?;
        report_skipped(&preview.without);
        return Ok(Outcome::Succeeded);
    }
    confirm(&format!("rollback {task} on {on}"), preview.robots.len(), yes)?;
    let order = OrderTask { selector: on, dry_run: false };
    let key = idempotency_key.unwrap_or_else(random_key);
    let rolled_back: RolledBack = session.client.post_with_key(&path, &order, &key).await?;
    session.output.print_list(&rolled_back, &ROLLED_BACK, |rolled_back| {
        rolled_back.deployments.iter().map(deployment_row).collect()
    })?;
    report_skipped(&rolled_back.without);
    say(&format!("requested: rollback {task} on {}", robots(rolled_back.robots.len() as u64)));
    Ok(Outcome::Succeeded)
}

const ROLLED_BACK: Columns = Columns {
    name: "deployment",
    narrow: &["deployment", "package", "version", "robots"],
    wide: &["manifest"],
};

fn deployment_row(deployment: &DeploymentView) -> Vec<String> {
    let package = &deployment.package;
    vec![
        deployment.id.to_string(),
        package.name.to_string(),
        package.version.to_string(),
        deployment.counts.iter().map(|count| count.count).sum::<u64>().to_string(),
        package.manifest.digest.to_string(),
    ]
}

fn report_skipped(without: &[MatchedRobot]) {
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
    say(&format!("skipped, no earlier version: {}", names.join(", ")));
}

/// Waits until none of `ordered` has the task any more. A robot removed meanwhile no longer counts;
/// a robot with new labels or a new name still does.
async fn wait_until_gone(
    session: &Session,
    task: &TaskName,
    ordered: &MatchedRobots,
    timeout: Duration,
) -> Result<Outcome, CommandError> {
    let deadline = Instant::now() + timeout;
    let selector = selector_of_ids(&ordered.robots);
    let mut remaining: Option<Vec<RobotView>> = None;
    while Instant::now() < deadline {
        match timeout_at(deadline, selection::list_robots(session, &selector)).await {
            Err(_) => break,
            Ok(Err(CommandError::Client(error))) if wait::is_transient(&error) => {}
            Ok(Err(error)) => return Err(error),
            Ok(Ok(list)) => {
                let was_ordered =
                    |robot: &RobotView| ordered.robots.iter().any(|matched| matched.id == robot.id);
                let robots = list.robots.into_iter().filter(was_ordered);
                let robots: Vec<RobotView> =
                    robots.filter(|robot| still_has_task(robot, task)).collect();
                if robots.is_empty() {
                    say(&format!(
                        "removed {task} from {}",
                        self::robots(ordered.robots.len() as u64)
                    ));
                    return Ok(Outcome::Succeeded);
                }
                remaining = Some(robots);
            }
        }
        sleep(wait::MAX_PAUSE.min(deadline.saturating_duration_since(Instant::now()))).await;
    }
    match remaining {
        None => say("timed out: no answer from the server about the robots"),
        Some(remaining) => {
            for robot in remaining {
                let why = if robot.online {
                    "timed out"
                } else {
                    "offline, will follow when it reconnects"
                };
                say(&format!("{}: {why}", robot.name));
            }
        }
    }
    Ok(Outcome::TimedOut)
}

/// A selector of these robots by id, independent of their names and labels; of all robots if the
/// list is too long for a query.
fn selector_of_ids(robots: &[MatchedRobot]) -> Selector {
    const MAX_LISTED: usize = 200;
    let ids: Vec<&str> =
        robots.iter().take(MAX_LISTED + 1).map(|robot| robot.id.as_str()).collect();
    let listed = if ids.len() > MAX_LISTED { "*".to_owned() } else { ids.join(",") };
    listed.parse().expect("ids are a selector")
}

/// Whether the robot has not followed its newest order yet, or is still getting rid of the task.
fn still_has_task(robot: &RobotView, task: &TaskName) -> bool {
    robot.observed_generation < robot.generation
        || robot.tasks.iter().any(|known| known.task == *task)
}

/// Whether the refusal means that the selection is empty. If the order may be a repetition, its
/// robots may be gone by now.
fn is_empty_selection(code: &str, may_be_retry: bool) -> bool {
    code == "no_robots_match" || (may_be_retry && code == "unknown_robots")
}

/// Sends the order; returns the robots that received the order.
async fn send_order(
    session: &Session,
    verb: Verb,
    args: TaskArgs,
) -> Result<MatchedRobots, CommandError> {
    let TaskArgs { task, on, dry_run, yes, idempotency_key } = args;
    let path = format!("/tasks/{task}/{}", verb.as_str());
    // With a key this may repeat an earlier order, whose tasks are gone by now: the server knows.
    let may_be_retry = idempotency_key.is_some() && !dry_run;
    let key = idempotency_key.unwrap_or_else(random_key);
    let dry_order = OrderTask { selector: on.clone(), dry_run: true };
    // A dry run changes nothing, so it gets a key of its own.
    let matched: MatchedRobots =
        match session.client.post_with_key(&path, &dry_order, &random_key()).await {
            Err(ClientError::Refused { code, .. }) if is_empty_selection(&code, may_be_retry) => {
                MatchedRobots::default()
            }
            answer => answer?,
        };
    if matched.robots.is_empty() && !may_be_retry {
        return Err(CommandError::Usage(format!("no robot that matches {on} has the task {task}")));
    }
    if dry_run {
        print_matched(session, &matched)?;
        return Ok(matched);
    }
    confirm(&format!("{} {task} on {on}", verb.as_str()), matched.robots.len(), yes)?;
    let ordered: MatchedRobots = session
        .client
        .post_with_key(&path, &OrderTask { selector: on, dry_run: false }, &key)
        .await?;
    print_matched(session, &ordered)?;
    let offline = ordered.robots.iter().filter(|robot| !robot.online).count();
    say(&format!("requested: {} {task} on {}", verb.as_str(), robots(ordered.robots.len() as u64)));
    if offline > 0 {
        say(&format!("{offline} of them are offline and will follow when they reconnect"));
    }
    Ok(ordered)
}
