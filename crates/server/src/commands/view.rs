//! How deployments and robots look to a person at the terminal. Text only; what is shown was asked for elsewhere.

use task_proto::api::{AssignmentView, DeploymentState, DeploymentView, MatchedRobot, MatchedRobots};

use super::output::{printable, table, time};
use super::{CommandError, Session};

/// A deployment's state, in a word.
pub(super) fn state(state: DeploymentState) -> &'static str {
    match state {
        DeploymentState::Active => "active",
        DeploymentState::Paused => "paused",
        DeploymentState::Settled => "settled",
        DeploymentState::Cancelled => "cancelled",
    }
}

/// How many robots stand in which phase, on one line.
pub(super) fn phases(view: &DeploymentView) -> String {
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

/// Lists the robots an order means.
pub(super) fn print_matched(session: &Session, matched: &MatchedRobots) -> Result<(), CommandError> {
    session.output.result(matched, &["id", "name", "state"], |matched| {
        let row = |robot: &MatchedRobot| {
            vec![
                robot.id.to_string(),
                robot.name.to_string(),
                if robot.online { "online" } else { "offline" }.to_owned(),
            ]
        };
        matched.robots.iter().map(row).collect()
    })
}
