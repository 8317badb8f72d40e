//! Formats deployments and robots for the terminal. Text only; the caller has requested the data.

use std::collections::BTreeMap;

use task_proto::api::{
    AssignmentView, DeliveryDecision, DeploymentState, DeploymentView, MatchedRobot, MatchedRobots,
    Placing, join_names,
};
use task_proto::desired::Delivery;
use task_proto::messages::report::Phase;

use super::output::table::Columns;
use super::output::{self, robots, short_digest, time};
use crate::{CommandError, Session};

/// Maximum number of reasons for waiting shown; a gate may give each robot a different reason.
const MAX_REASONS: usize = 5;
/// Maximum number of robots named in one fact.
const MAX_NAMES: usize = 20;

/// A deployment's state, in a word.
pub(crate) fn state(state: DeploymentState) -> &'static str {
    match state {
        DeploymentState::Active => "active",
        DeploymentState::Paused => "paused",
        DeploymentState::Settled => "settled",
        DeploymentState::Cancelled => "cancelled",
    }
}

/// Number of robots in each phase, on one line.
pub(crate) fn phases(view: &DeploymentView) -> String {
    let phases: Vec<_> =
        view.counts.iter().map(|count| format!("{}:{}", count.phase, count.count)).collect();
    phases.join(" ")
}

/// Prints a deployment: its facts, then a line per robot.
pub(crate) fn print(session: &Session, view: &DeploymentView) -> Result<(), CommandError> {
    print_with(session, view, &COLUMNS)
}

/// Prints the deployment, with each robot's delivery mechanism.
pub(crate) fn print_deliveries(
    session: &Session,
    view: &DeploymentView,
) -> Result<(), CommandError> {
    print_with(session, view, &COLUMNS_WITH_DELIVERIES)
}

fn print_with(
    session: &Session,
    view: &DeploymentView,
    columns: &Columns,
) -> Result<(), CommandError> {
    let name = |view: &DeploymentView| view.id.to_string();
    session.output.print_object(view, name, |view| {
        let mut text = describe(view);
        if let Some(assignments) = &view.assignments {
            let rows: Vec<_> = assignments.iter().map(assignment_row).collect();
            text.push('\n');
            text.push_str(&session.output.table(columns, &rows));
        }
        text
    })
}

const COLUMNS: Columns = Columns {
    name: "robot",
    narrow: &["robot", "state", "phase", "progress", "detail"],
    wide: &["delivery"],
};
const COLUMNS_WITH_DELIVERIES: Columns = Columns {
    name: "robot",
    narrow: &["robot", "state", "phase", "progress", "detail", "delivery"],
    wide: &[],
};

fn describe(view: &DeploymentView) -> String {
    let supersedes: Vec<_> = view.supersedes.iter().map(ToString::to_string).collect();
    let mut facts = vec![
        ("deployment", view.id.to_string()),
        (
            "package",
            format!(
                "{} {} ({})",
                view.package.name,
                view.package.version,
                short_digest(&view.package.manifest.digest)
            ),
        ),
        ("selector", view.selector.as_ref().map_or_else(|| "…".to_owned(), ToString::to_string)),
        ("delivery", view.delivery.to_string()),
        ("state", state(view.state).to_owned()),
        ("phases", phases(view)),
        ("created", time(view.created_at_ms)),
        ("expires", time(view.expires_at_ms)),
    ];
    if let Some(Placing { selected, placed }) = view.placing {
        facts.push(("placed", format!("for {placed} of {selected} robots")));
    }
    if view.outdated {
        facts.push(("outdated", "a forced push replaced this version".to_owned()));
    }
    if view.priority != 0 {
        facts.push(("priority", view.priority.to_string()));
    }
    if let Some(batch) = view.batch {
        facts.push(("batch", batch.to_string()));
    }
    if !supersedes.is_empty() {
        facts.push(("supersedes", supersedes.join(" ")));
    }
    let unsettled = view.unsettled_robots();
    for (title, robots) in [
        ("waiting for", &unsettled.busy),
        ("next", &unsettled.queued),
        ("offline", &unsettled.offline),
    ] {
        if view.state != DeploymentState::Cancelled && !robots.is_empty() {
            facts.push((title, join_names(robots, MAX_NAMES)));
        }
    }
    let assignments = view.assignments.as_deref().unwrap_or_default();
    facts.extend(mechanisms(assignments).into_iter().map(|line| ("method", line)));
    facts.extend(deferred(assignments).into_iter().map(|line| ("deferred", line)));
    output::facts(facts)
}

/// Numbers of robots by delivery mechanism and reason, the most common first.
fn mechanisms(assignments: &[AssignmentView]) -> Vec<String> {
    let mut groups: BTreeMap<(Delivery, &str), Vec<&str>> = BTreeMap::new();
    for decision in assignments.iter().filter_map(|assignment| assignment.delivery.as_ref()) {
        groups
            .entry((decision.mechanism, decision.rule.as_str()))
            .or_default()
            .push(&decision.because);
    }
    let mut groups: Vec<_> = groups.into_iter().collect();
    groups.sort_by_key(|(_, reasons)| std::cmp::Reverse(reasons.len()));
    let line = |((mechanism, rule), reasons): ((Delivery, &str), Vec<&str>)| {
        let count = if assignments.len() == 1 {
            String::new()
        } else {
            format!("{}, ", robots(reasons.len() as u64))
        };
        let is_one = reasons.iter().all(|reason| *reason == reasons[0]);
        let others = if is_one { "" } else { " and similar" };
        format!("{count}{mechanism}: {}, {}{others}", format_rule(rule), reasons[0])
    };
    groups.into_iter().map(line).collect()
}

fn format_rule(rule: &str) -> String {
    // The first two are no configured rules.
    if [DeliveryDecision::ORDERED, DeliveryDecision::FELL_BEHIND].contains(&rule) {
        rule.to_owned()
    } else {
        format!("rule {rule:?}")
    }
}

/// One robot's delivery mechanism and its reason.
fn describe_delivery(delivery: Option<&DeliveryDecision>) -> String {
    let shown = |decision: &DeliveryDecision| {
        format!("{}: {}, {}", decision.mechanism, format_rule(&decision.rule), decision.because)
    };
    delivery.map_or_else(|| "-".to_owned(), shown)
}

/// Numbers of waiting robots by reason, the most common reason first.
fn deferred(assignments: &[AssignmentView]) -> Vec<String> {
    let mut counts: BTreeMap<&str, u64> = BTreeMap::new();
    for assignment in assignments.iter().filter(|assignment| assignment.phase == Phase::Deferred) {
        let reason = assignment.failure.as_ref().map_or("", |failure| failure.text.trim());
        *counts.entry(if reason.is_empty() { "no reason given" } else { reason }).or_default() += 1;
    }
    let mut reasons: Vec<(&str, u64)> = counts.into_iter().collect();
    reasons.sort_by_key(|&(_, count)| std::cmp::Reverse(count));
    let others = reasons.split_off(reasons.len().min(MAX_REASONS));
    let mut lines: Vec<String> =
        reasons.iter().map(|&(reason, count)| format!("{}: {reason}", robots(count))).collect();
    if !others.is_empty() {
        let count = others.iter().map(|(_, count)| count).sum();
        lines.push(format!("{}: {} other reasons, see below", robots(count), others.len()));
    }
    lines
}

fn assignment_row(assignment: &AssignmentView) -> Vec<String> {
    let detail = match (&assignment.failure, &assignment.superseded_by) {
        (Some(failure), _) => failure.to_string(),
        (None, Some(newer)) => format!("by {newer}"),
        (None, None) if assignment.phase.is_final() => "-".to_owned(),
        (None, None) if !assignment.released && assignment.online => {
            "waiting for its batch".to_owned()
        }
        (None, None) if !assignment.released => "starts when the robot reconnects".to_owned(),
        (None, None) => "-".to_owned(),
    };
    let progress = assignment.progress.filter(|progress| progress.total > 0);
    vec![
        assignment.name.to_string(),
        if assignment.online { "online" } else { "offline" }.to_owned(),
        assignment.phase.to_string(),
        progress.map_or_else(
            || "-".to_owned(),
            |p| format!("{}%", p.done.min(p.total) * 100 / p.total),
        ),
        detail,
        describe_delivery(assignment.delivery.as_ref()),
    ]
}

/// Lists the robots that an order selects.
pub(crate) fn print_matched(
    session: &Session,
    matched: &MatchedRobots,
) -> Result<(), CommandError> {
    let columns = Columns { name: "name", narrow: &["id", "name", "state"], wide: &[] };
    session.output.print_list(matched, &columns, |matched| {
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::display::transfer_eta::tests::deployment;
    use task_proto::RobotId;
    use task_proto::desired::PackageRef;
    use task_proto::messages::report::{Failure, FailureCode};

    fn assignment(phase: Phase, reason: Option<&str>) -> AssignmentView {
        AssignmentView {
            robot: RobotId::random(),
            name: "atlas".parse().expect("a name"),
            online: true,
            released: true,
            delivery: None,
            phase,
            progress: None,
            failure: reason.map(|reason| Failure::new(FailureCode::GATE_REFUSED, reason)),
            attempts: 1,
            superseded_by: None,
            updated_at_ms: 0,
            timeline: None,
        }
    }

    #[test]
    fn package_is_described_with_a_short_digest() {
        let view = deployment(DeploymentState::Active, Vec::new());
        let PackageRef { name, version, manifest, .. } = &view.package;
        let line = format!("package     {name} {version} ({})\n", short_digest(&manifest.digest));
        assert!(describe(&view).contains(&line), "{}", describe(&view));
    }

    #[test]
    fn delivery_methods_are_counted_and_explained() {
        let travelling = |mechanism, rule: &str, because: &str| AssignmentView {
            delivery: Some(DeliveryDecision {
                mechanism,
                rule: rule.to_owned(),
                because: because.to_owned(),
            }),
            ..assignment(Phase::Fetching, None)
        };
        let pull = || travelling(Delivery::PushPull, "otherwise", "size 9.7 MB > 256 KB");
        assert_eq!(mechanisms(&[pull()]), ["push-pull: rule \"otherwise\", size 9.7 MB > 256 KB"]);
        let assignments = [
            travelling(Delivery::DirectPush, "slow", "rtt 120 ms > 100 ms"),
            pull(),
            travelling(Delivery::DirectPush, "slow", "rtt 140 ms > 100 ms"),
            travelling(Delivery::PushPull, "fell behind", "no progress"),
            assignment(Phase::Assigned, None),
        ];
        assert_eq!(
            mechanisms(&assignments),
            [
                "2 robots, direct-push: rule \"slow\", rtt 120 ms > 100 ms and similar",
                "1 robot, push-pull: fell behind, no progress",
                "1 robot, push-pull: rule \"otherwise\", size 9.7 MB > 256 KB",
            ]
        );
        assert_eq!(assignment_row(&assignments[4])[5], "-");
        assert_eq!(assignment_row(&assignments[3])[5], "push-pull: fell behind, no progress");
    }

    #[test]
    fn deferred_robots_are_counted_by_reason() {
        let mut assignments = vec![
            assignment(Phase::Running, None),
            assignment(Phase::Failed, Some("battery low")),
            assignment(Phase::Deferred, Some("carries a load")),
            assignment(Phase::Deferred, Some("battery low")),
            assignment(Phase::Deferred, Some("battery low\n")),
        ];
        assert_eq!(deferred(&assignments[..2]), [""; 0]);
        assert_eq!(deferred(&assignments), ["2 robots: battery low", "1 robot: carries a load"]);
        assignments.extend(
            (0..MAX_REASONS).map(|n| assignment(Phase::Deferred, Some(&format!("load {n}")))),
        );
        let lines = deferred(&assignments);
        assert_eq!((lines.len(), lines[0].as_str()), (MAX_REASONS + 1, "2 robots: battery low"));
        assert_eq!(lines[MAX_REASONS], "2 robots: 2 other reasons, see below");
        assert!(deferred(&[assignment(Phase::Deferred, None)])[0].ends_with("no reason given"));
    }
}
