//! `taskd deploy`: shows deployments, follows, cancels, resumes and retries them.

use std::time::Duration;

use clap::{Args, Subcommand};
use task_proto::DeploymentId;
use task_proto::api::{
    DeploymentList, DeploymentView, MAX_PAGE_ENTRIES, MatchedRobots, RetryDeployment,
};
use task_proto::ids::selector::Selector;
use task_proto::messages::report::FailureCode;
use task_proto::time::parse_lifetime;

use crate::api::client::{ClientError, random_key};
use crate::api::{complete, wait};
use crate::display::confirm::confirm;
use crate::display::output::table::Columns;
use crate::display::output::{robots, say, time};
use crate::display::view;
use crate::display::view::{phases, print_matched, state};
use crate::{CommandError, Outcome, Session};

#[derive(Debug, Subcommand)]
pub enum Action {
    /// List deployments, newest first
    List {
        /// Maximum number of deployments to list
        #[arg(short = 'n', long, value_name = "N", default_value_t = 200, value_parser = clap::value_parser!(u32).range(1..))]
        limit: u32,
    },
    /// Show a deployment, its delivery method and the state of each robot
    Info {
        /// Deployment id
        #[arg(add = complete::deployments())]
        deployment: DeploymentId,
        /// Show the delivery method of each robot
        #[arg(long)]
        robots: bool,
    },
    /// Watch a deployment until every robot has settled: progress, transfer rate, time left and
    /// failures
    Watch {
        /// Deployment id
        #[arg(add = complete::deployments())]
        deployment: DeploymentId,
        /// Maximum time to watch
        #[arg(long, value_name = "TIME", value_parser = parse_lifetime, default_value = "1d")]
        timeout: Duration,
    },
    /// Cancel a deployment: unfinished and failed robots keep the previous version; robots that
    /// run the new version keep it
    Cancel {
        /// Deployment id
        #[arg(add = complete::deployments())]
        deployment: DeploymentId,
    },
    /// Resume a deployment that paused because too many robots failed
    Resume {
        /// Deployment id
        #[arg(add = complete::deployments())]
        deployment: DeploymentId,
    },
    /// Deploy again to the robots on which a deployment failed
    Retry(RetryArgs),
}

/// The deployment to retry, and on which robots.
#[derive(Debug, Args)]
pub struct RetryArgs {
    /// Deployment id
    #[arg(add = complete::deployments())]
    deployment: DeploymentId,
    /// Only on the robots that match this selector
    #[arg(long, value_name = "SELECTOR", add = complete::selectors())]
    on: Option<Selector>,
    /// Only on robots that failed with this code, such as build_failed
    #[arg(long, value_name = "CODE")]
    code: Option<FailureCode>,
    /// Wait until the task runs (a job: has succeeded) on all robots
    #[arg(long)]
    wait: bool,
    /// Maximum time to wait
    #[arg(long, value_name = "TIME", value_parser = parse_lifetime, default_value = "10m", requires = "wait")]
    timeout: Duration,
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

pub(crate) async fn run(session: &Session, action: Action) -> Result<Outcome, CommandError> {
    let (deployment, verb) = match action {
        Action::List { limit } => {
            let list = newest(session, limit).await?;
            session
                .output
                .print_list(&list, &COLUMNS, |list| list.deployments.iter().map(row).collect())?;
            if list.next.is_some() {
                say("older deployments are not shown; use -n to show more");
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
        Action::Retry(args) => return retry(session, args).await,
        Action::Cancel { deployment } => (deployment, "cancel"),
        Action::Resume { deployment } => (deployment, "resume"),
    };
    let path = format!("/deployments/{deployment}/{verb}");
    let view: DeploymentView =
        session.client.post_with_key(&path, &serde_json::json!({}), &random_key()).await?;
    view::print(session, &view)?;
    say(&format!("requested: {verb} {deployment}"));
    Ok(Outcome::Succeeded)
}

/// The newest deployments, up to the limit; the server returns them in pages.
async fn newest(session: &Session, limit: u32) -> Result<DeploymentList, CommandError> {
    let mut list = DeploymentList::default();
    loop {
        let left = limit.saturating_sub(u32::try_from(list.deployments.len()).unwrap_or(u32::MAX));
        let mut query = vec![("limit", left.min(MAX_PAGE_ENTRIES).to_string())];
        query.extend(list.next.map(|next| ("before", next.to_string())));
        let page: DeploymentList = session.client.get("/deployments", &query).await?;
        list.deployments.extend(page.deployments);
        list.next = page.next;
        if list.next.is_none() || list.deployments.len() >= limit as usize {
            return Ok(list);
        }
    }
}

async fn retry(session: &Session, args: RetryArgs) -> Result<Outcome, CommandError> {
    let RetryArgs { deployment, on, code, wait, timeout, dry_run, yes, idempotency_key } = args;
    let path = format!("/deployments/{deployment}/retry");
    let may_be_retry = idempotency_key.is_some() && !dry_run;
    let request = |dry_run| RetryDeployment { selector: on.clone(), code: code.clone(), dry_run };
    let matched: MatchedRobots =
        match session.client.post_with_key(&path, &request(true), &random_key()).await {
            Err(ClientError::Refused { code, .. }) if code == "nothing_to_retry" => {
                MatchedRobots::default()
            }
            answer => answer?,
        };
    if matched.robots.is_empty() && !may_be_retry {
        return Err(CommandError::Usage(format!(
            "{deployment} has no failed robots to retry: none match, or all have newer orders"
        )));
    }
    if dry_run {
        print_matched(session, &matched)?;
        return Ok(Outcome::Succeeded);
    }
    confirm(&format!("retry {deployment}"), matched.robots.len(), yes)?;
    let key = idempotency_key.unwrap_or_else(random_key);
    let ordered: DeploymentView =
        session.client.post_with_key(&path, &request(false), &key).await?;
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
