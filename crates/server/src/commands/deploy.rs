//! `taskd deploy`: shows deployments, cancels and resumes them.

use clap::Subcommand;
use task_proto::DeploymentId;
use task_proto::api::{DeploymentList, DeploymentView};

use super::output::{say, time};
use super::view::{describe, describe_fully, phases, state};
use super::{CommandError, Outcome, Session};

/// What to do with deployments.
#[derive(Debug, Subcommand)]
pub enum Action {
    /// List deployments, the newest first
    List,
    /// Show one deployment, how its bytes travel and why, and where each robot stands
    Info {
        /// Its id
        deployment: DeploymentId,
        /// Say of each robot how its bytes travel
        #[arg(long)]
        robots: bool,
    },
    /// Interrupt one: where it is under way or has failed the version before it runs on; where it runs already it stays
    Cancel {
        /// Its id
        deployment: DeploymentId,
    },
    /// Go on with one that paused because too many robots failed
    Resume {
        /// Its id
        deployment: DeploymentId,
    },
}

pub(super) async fn run(session: &Session, action: Action) -> Result<Outcome, CommandError> {
    let (deployment, verb) = match action {
        Action::List => {
            let list: DeploymentList = session.client.get("/deployments", &[]).await?;
            session.output.result(&list, &HEADER, |list| list.deployments.iter().map(row).collect())?;
            return Ok(Outcome::Succeeded);
        }
        Action::Info { deployment, robots } => {
            let view: DeploymentView = session.client.get(&format!("/deployments/{deployment}"), &[]).await?;
            session.output.described(&view, |view| describe_fully(view, robots))?;
            return Ok(Outcome::Succeeded);
        }
        Action::Cancel { deployment } => (deployment, "cancel"),
        Action::Resume { deployment } => (deployment, "resume"),
    };
    let path = format!("/deployments/{deployment}/{verb}");
    let view: DeploymentView =
        session.client.order(&path, &serde_json::json!({}), &super::client::random_key()).await?;
    session.output.described(&view, describe)?;
    say(&format!("ordered: {verb} {deployment}"));
    Ok(Outcome::Succeeded)
}

const HEADER: [&str; 6] = ["id", "package", "robots", "state", "phases", "created"];

fn row(view: &DeploymentView) -> Vec<String> {
    let robots: u64 = view.counts.iter().map(|count| count.count).sum();
    vec![
        view.id.to_string(),
        format!("{} {}", view.package.name, view.package.version),
        robots.to_string(),
        state(view.state).to_owned(),
        phases(view),
        time(view.created_at_ms),
    ]
}
