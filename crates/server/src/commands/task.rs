//! `taskd start|stop|remove`: orders on tasks that robots already have.

use clap::Args;
use task_proto::TaskName;
use task_proto::api::{MatchedRobots, OrderTask};
use task_proto::selector::Selector;

use super::client::ClientError;
use super::confirm::confirm;
use super::output::{robots, say};
use super::view::print_matched;
use super::{CommandError, Outcome, Session};

/// Which task on which robots.
#[derive(Debug, Args)]
pub struct TaskOrder {
    /// The task's name
    task: TaskName,
    /// Which robots: *, names, label=value; those without the task are left out
    #[arg(long, value_name = "SELECTOR")]
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

/// What is ordered.
#[derive(Debug, Clone, Copy)]
pub(super) enum Verb {
    Start,
    Stop,
    Remove,
}

impl Verb {
    fn as_str(self) -> &'static str {
        match self {
            Self::Start => "start",
            Self::Stop => "stop",
            Self::Remove => "remove",
        }
    }
}

pub(super) async fn run(session: &Session, verb: Verb, order: TaskOrder) -> Result<Outcome, CommandError> {
    let TaskOrder { task, on, dry_run, yes, idempotency_key } = order;
    let path = format!("/tasks/{task}/{}", verb.as_str());
    // With a key this may be an order that was carried out before, whose tasks are gone by now: the server knows.
    let may_be_repeated = idempotency_key.is_some() && !dry_run;
    let key = idempotency_key.unwrap_or_else(super::client::random_key);
    let ask = OrderTask { selector: on.clone(), dry_run: true };
    // A dry run is no order, so it gets a key of its own.
    let matched: MatchedRobots = match session.client.order(&path, &ask, &super::client::random_key()).await {
        Err(ClientError::Refused { code, .. }) if code == "no_robots_match" => MatchedRobots::default(),
        answer => answer?,
    };
    if matched.robots.is_empty() && !may_be_repeated {
        return Err(CommandError::Usage(format!("no robot that {on} selects has the task {task}")));
    }
    if dry_run {
        print_matched(session, &matched)?;
        return Ok(Outcome::Succeeded);
    }
    confirm(&format!("{} {task} on {on}", verb.as_str()), matched.robots.len(), yes)?;
    let ordered: MatchedRobots = session.client.order(&path, &OrderTask { selector: on, dry_run: false }, &key).await?;
    print_matched(session, &ordered)?;
    let offline = ordered.robots.iter().filter(|robot| !robot.online).count();
    say(&format!("ordered: {} {task} on {}", verb.as_str(), robots(ordered.robots.len() as u64)));
    if offline > 0 {
        say(&format!("{offline} of them are offline and follow when they are back"));
    }
    Ok(Outcome::Succeeded)
}
