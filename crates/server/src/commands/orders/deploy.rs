//! `taskd deploy`: shows deployments, follows, cancels, resumes and retries them.

use std::time::Duration;

use clap::{Args, Subcommand};
use task_proto::DeploymentId;
use task_proto::api::{
    DeploymentList, DeploymentView, MOST_ON_A_PAGE, MatchedRobots, RetryDeployment,
};
use task_proto::report::FailureCode;
use task_proto::selector::Selector;

use crate::commands::api::client::{ClientError, random_key};
use crate::commands::api::{complete, wait};
use crate::commands::display::confirm::confirm;
use crate::commands::display::output::table::Columns;
use crate::commands::display::output::{robots, say, time};
use crate::commands::display::view;
use crate::commands::display::view::{phases, print_matched, state};
use crate::commands::{CommandError, Outcome, Session};
use crate::config::lifetime;

/// What to do with deployments.
#[derive(Debug, Subcommand)]
pub enum Action {
    /// List deployments, the newest first
    List {
        /// At most so many, the newest
        #[arg(short = 'n', long, value_name = "N", default_value_t = 200, value_parser = clap::value_parser!(u32).range(1..))]
        limit: u32,
    },
    /// Show one deployment, how its bytes travel and why, and where each robot stands
    Info {
        /// Its id
        #[arg(add = complete::deployments())]
        deployment: DeploymentId,
        /// Say of each robot how its bytes travel
        #[arg(long)]
        robots: bool,
    },
    /// Follow one until every robot has settled: what travels, how fast, for how long yet, and who
    /// failed for what reason
    Watch {
        /// Its id
        #[arg(add = complete::deployments())]
        deployment: DeploymentId,
        /// How long to look
        #[arg(long, value_name = "TIME", value_parser = lifetime, default_value = "1d")]
        timeout: Duration,
    },
    /// Interrupt one: where it is under way or has failed the version before it runs on; where it
    /// runs already it stays
    Cancel {
        /// Its id
        #[arg(add = complete::deployments())]
        deployment: DeploymentId,
    },
    /// Go on with one that paused because too many robots failed
    Resume {
        /// Its id
        #[arg(add = complete::deployments())]
        deployment: DeploymentId,
    },
    /// Order the same once more for the robots on which it failed
    Retry(RetryOrder),
}

/// What to order once more, and of whom.
#[derive(Debug, Args)]
pub struct RetryOrder {
    /// The deployment's id
    #[arg(add = complete::deployments())]
    deployment: DeploymentId,
    /// Only on these of its robots
    #[arg(long, value_name = "SELECTOR", add = complete::selectors())]
    on: Option<Selector>,
    /// Only on those that failed with this code, like build_failed
    #[arg(long, value_name = "CODE")]
    code: Option<FailureCode>,
    /// Wait until it runs (a job: has succeeded) everywhere
    #[arg(long)]
    wait: bool,
    /// How long to wait
    #[arg(long, value_name = "TIME", value_parser = lifetime, default_value = "10m", requires = "wait")]
    timeout: Duration,
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

pub(in crate::commands) async fn run(
    session: &Session,
    action: Action,
) -> Result<Outcome, CommandError> {
    let (deployment, verb) = match action {
        Action::List { limit } => {
            let list = newest(session, limit).await?;
            session
                .output
                .result(&list, &COLUMNS, |list| list.deployments.iter().map(row).collect())?;
            if list.next.is_some() {
                say("older ones are left out; -n shows more");
            }
            return Ok(Outcome::Succeeded);
        }
        Action::Info { deployment, robots } => {
            let view: DeploymentView =
                session.client.get(&format!("/deployments/{deployment}"), &[]).await?;
            match robots {
                true => view::print_deliveries(session, &view)?,
                false => view::print(session, &view)?,
            }
            return Ok(Outcome::Succeeded);
        }
        Action::Watch { deployment, timeout } => {
            return wait::until_settled(session, &deployment, timeout).await;
        }
        Action::Retry(order) => return retry(session, order).await,
        Action::Cancel { deployment } => (deployment, "cancel"),
        Action::Resume { deployment } => (deployment, "resume"),
    };
    let path = format!("/deployments/{deployment}/{verb}");
    let view: DeploymentView =
        session.client.order(&path, &serde_json::json!({}), &random_key()).await?;
    view::print(session, &view)?;
    say(&format!("ordered: {verb} {deployment}"));
    Ok(Outcome::Succeeded)
}

/// The newest deployments, up to the limit; the server returns them in pages.
async fn newest(session: &Session, limit: u32) -> Result<DeploymentList, CommandError> {
    let mut list = DeploymentList::default();
    loop {
        let left = limit.saturating_sub(u32::try_from(list.deployments.len()).unwrap_or(u32::MAX));
        let mut query = vec![("limit", left.min(MOST_ON_A_PAGE).to_string())];
        query.extend(list.next.map(|next| ("before", next.to_string())));
        let page: DeploymentList = session.client.get("/deployments", &query).await?;
        list.deployments.extend(page.deployments);
        list.next = page.next;
        if list.next.is_none() || list.deployments.len() >= limit as usize {
            return Ok(list);
        }
    }
}

async fn retry(session: &Session, order: RetryOrder) -> Result<Outcome, CommandError> {
    let RetryOrder { deployment, on, code, wait, timeout, dry_run, yes, idempotency_key } = order;
    let path = format!("/deployments/{deployment}/retry");
    let may_be_repeated = idempotency_key.is_some() && !dry_run;
    let ask = |dry_run| RetryDeployment { selector: on.clone(), code: code.clone(), dry_run };
    let matched: MatchedRobots = match session.client.order(&path, &ask(true), &random_key()).await
    {
        Err(ClientError::Refused { code, .. }) if code == "nothing_to_retry" => {
            MatchedRobots::default()
        }
        answer => answer?,
    };
    if matched.robots.is_empty() && !may_be_repeated {
        return Err(CommandError::Usage(format!(
            "{deployment} failed on no robot that is meant and has no newer order"
        )));
    }
    if dry_run {
        print_matched(session, &matched)?;
        return Ok(Outcome::Succeeded);
    }
    confirm(&format!("retry {deployment}"), matched.robots.len(), yes)?;
    let key = idempotency_key.unwrap_or_else(random_key);
    let ordered: DeploymentView = session.client.order(&path, &ask(false), &key).await?;
    let count = robots(ordered.counts.iter().map(|count| count.count).sum());
    say(&format!(
        "deployment {}: {} {} to {count}",
        ordered.id, ordered.package.name, ordered.package.version
    ));
    if wait {
        return wait::until_settled(session, &ordered.id, timeout).await;
    }
    view::print(session, &ordered)?;
    Ok(Outcome::Succeeded)
}

const COLUMNS: Columns = Columns {
    name: "id",
    narrow: &["id", "package", "robots", "state", "phases", "created"],
    wide: &["selector", "delivery", "priority", "expires", "manifest"],
};

fn row(view: &DeploymentView) -> Vec<String> {
    let robots: u64 = view.counts.iter().map(|count| count.count).sum();
    vec![
        view.id.to_string(),
        format!("{} {}", view.package.name, view.package.version),
        robots.to_string(),
        state(view.state).to_owned(),
        phases(view),
        time(view.created_at_ms),
        view.selector.as_ref().map_or_else(|| "…".to_owned(), ToString::to_string),
        view.delivery.to_string(),
        view.priority.to_string(),
        time(view.expires_at_ms),
        view.package.manifest.digest.to_string(),
    ]
}
