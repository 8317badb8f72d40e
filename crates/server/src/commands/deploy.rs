//! `taskd deploy`: shows deployments, cancels and resumes them.

use clap::Subcommand;
use task_proto::DeploymentId;
use task_proto::api::{AssignmentView, DeploymentList, DeploymentState, DeploymentView};

use super::output::{printable, say, table, time};
use super::{CommandError, Outcome, Session};

/// What to do with deployments.
#[derive(Debug, Subcommand)]
pub enum Action {
    /// List deployments, the newest first
    List,
    /// Show one deployment and where each robot stands
    Info {
        /// Its id
        deployment: DeploymentId,
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
        Action::Info { deployment } => {
            let view: DeploymentView = session.client.get(&format!("/deployments/{deployment}"), &[]).await?;
            session.output.described(&view, describe)?;
            return Ok(Outcome::Succeeded);
        }
        Action::Cancel { deployment } => (deployment, "cancel"),
        Action::Resume { deployment } => (deployment, "resume"),
    };
    let path = format!("/deployments/{deployment}/{verb}");
    let view: DeploymentView = session.client.order(&path, &serde_json::json!({}), &super::push::random_key()).await?;
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

fn state(state: DeploymentState) -> &'static str {
    match state {
        DeploymentState::Active => "active",
        DeploymentState::Paused => "paused",
        DeploymentState::Settled => "settled",
        DeploymentState::Cancelled => "cancelled",
    }
}

/// How many robots stand in which phase, on one line.
fn phases(view: &DeploymentView) -> String {
    let phases: Vec<_> = view.counts.iter().map(|count| format!("{}:{}", count.phase, count.count)).collect();
    phases.join(" ")
}

/// A deployment for people: its facts, then a line per robot.
pub(super) fn describe(view: &DeploymentView) -> String {
    let supersedes: Vec<_> = view.supersedes.iter().map(ToString::to_string).collect();
    let mut facts = vec![
        ("deployment", view.id.to_string()),
        ("package", format!("{} {} {}", view.package.name, view.package.version, view.package.manifest.digest)),
        ("selector", view.selector.to_string()),
        ("state", state(view.state).to_owned()),
        ("phases", phases(view)),
        ("created", time(view.created_at_ms)),
        ("expires", time(view.expires_at_ms)),
    ];
    if let Some(batch) = view.batch {
        facts.push(("batch", batch.to_string()));
    }
    if !supersedes.is_empty() {
        facts.push(("supersedes", supersedes.join(" ")));
    }
    let mut text: String = facts.iter().map(|(key, value)| format!("{key:<12}{}\n", printable(value))).collect();
    if let Some(assignments) = &view.assignments {
        text.push('\n');
        text.push_str(&table(
            &["robot", "state", "phase", "progress", "detail"],
            assignments.iter().map(assignment_row).collect(),
        ));
    }
    text
}

fn assignment_row(assignment: &AssignmentView) -> Vec<String> {
    let detail = match (&assignment.failure, &assignment.superseded_by) {
        (Some(failure), _) => failure.to_string(),
        (None, Some(newer)) => format!("by {newer}"),
        (None, None) if !assignment.released => "waits for its batch".to_owned(),
        (None, None) => "-".to_owned(),
    };
    let progress = assignment.progress.filter(|progress| progress.total > 0);
    vec![
        assignment.name.to_string(),
        if assignment.online { "online" } else { "offline" }.to_owned(),
        assignment.phase.to_string(),
        progress.map_or_else(|| "-".to_owned(), |p| format!("{}%", p.done.min(p.total) * 100 / p.total)),
        detail,
    ]
}
