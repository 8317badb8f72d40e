//! `--wait`: follows a deployment until every robot has settled or the time limit is reached, and
//! determines the exit code. The command polls the server, so a restart of the server costs only
//! time.

use std::collections::BTreeMap;
use std::time::Duration;

use task_proto::DeploymentId;
use task_proto::api::{AssignmentView, DeploymentState, DeploymentView, join_names};
use tokio::time::{Instant, sleep, timeout_at};

use super::client::ClientError;
use crate::display::output::{printable, say};
use crate::display::progress::DeploymentProgress;
use crate::display::view;
use crate::{CommandError, Outcome, Session};

/// The first pause between two polls; the pause doubles while nothing changes.
const MIN_PAUSE: Duration = Duration::from_millis(100);
pub(crate) const MAX_PAUSE: Duration = Duration::from_secs(1);
/// Robots named in one line of the verdict.
const MAX_NAMES: usize = 20;

/// Waits, then prints the deployment and the reasons of every robot that failed.
pub(crate) async fn until_settled(
    session: &Session,
    id: &DeploymentId,
    timeout: Duration,
) -> Result<Outcome, CommandError> {
    let mut progress = DeploymentProgress::new();
    let latest = tokio::select! {
        latest = follow(session, id, timeout, &mut progress) => latest?,
        interrupted = tokio::signal::ctrl_c() => {
            interrupted.map_err(|source| CommandError::Io { what: "can't wait for Ctrl-C".to_owned(), source })?;
            progress.finish();
            say(&format!("stopped waiting; the deployment continues\nwatch it: taskd deploy watch {id}\ncancel it: taskd deploy cancel {id}"));
            return Ok(Outcome::Interrupted);
        }
    };
    progress.finish();
    let Some(view) = latest else {
        say("timed out: no answer from the server about the deployment");
        return Ok(Outcome::TimedOut);
    };
    view::print(session, &view)?;
    let verdict = verdict(&view);
    say(&verdict.text);
    Ok(verdict.outcome)
}

/// Polls the deployment until it is over or the time limit is reached; returns its last known
/// state.
async fn follow(
    session: &Session,
    id: &DeploymentId,
    timeout: Duration,
    progress: &mut DeploymentProgress,
) -> Result<Option<DeploymentView>, CommandError> {
    let deadline = Instant::now() + timeout;
    let mut pause = MIN_PAUSE;
    let mut latest: Option<DeploymentView> = None;
    while Instant::now() < deadline {
        match timeout_at(deadline, fetch(session, id)).await {
            Err(_) => break,
            Ok(Err(error)) if !is_transient(&error) => return Err(error.into()),
            Ok(Err(_)) => pause = MAX_PAUSE,
            Ok(Ok(view)) => {
                progress.show(&view);
                pause = if latest.as_ref() == Some(&view) {
                    (pause * 2).min(MAX_PAUSE)
                } else {
                    MIN_PAUSE
                };
                let finished = is_finished(&view);
                latest = Some(view);
                if finished {
                    break;
                }
            }
        }
        sleep(pause.min(deadline.saturating_duration_since(Instant::now()))).await;
    }
    Ok(latest)
}

async fn fetch(session: &Session, id: &DeploymentId) -> Result<DeploymentView, ClientError> {
    session.client.get(&format!("/deployments/{id}"), &[]).await
}

/// Whether the server may answer a retry: the server is restarting, or a proxy in front of the
/// server answered.
pub(crate) fn is_transient(error: &ClientError) -> bool {
    match error {
        ClientError::Refused { status, .. } | ClientError::NotTaskd { status, .. } => {
            status.is_server_error()
        }
        ClientError::Unreachable { .. } => true,
        _ => false,
    }
}

/// Whether nothing more will happen by itself.
fn is_finished(view: &DeploymentView) -> bool {
    let mut assignments = view.assignments.iter().flatten();
    match view.state {
        DeploymentState::Cancelled => true,
        _ if view.placing.is_some() => false,
        // A paused rollout stays paused until a user resumes the deployment.
        DeploymentState::Paused => {
            assignments.all(|a| !a.released || a.phase.is_settled(view.kind))
        }
        DeploymentState::Active | DeploymentState::Settled => {
            assignments.all(|a| a.phase.is_settled(view.kind))
        }
    }
}

struct Verdict {
    outcome: Outcome,
    text: String,
}

/// The verdict: counts, and a line for each robot that failed.
fn verdict(view: &DeploymentView) -> Verdict {
    let assignments = view.assignments.as_deref().unwrap_or_default();
    let (settled, open): (Vec<_>, Vec<_>) =
        assignments.iter().partition(|a| a.phase.is_settled(view.kind));
    let (succeeded, failed): (Vec<_>, Vec<_>) =
        settled.into_iter().partition(|a| a.phase.is_success(view.kind));
    let (waiting, open): (Vec<_>, Vec<_>) =
        open.into_iter().partition(|a| view.state == DeploymentState::Paused && !a.released);
    let (open, offline): (Vec<_>, Vec<_>) = open.into_iter().partition(|a| a.online);
    let unplaced = view.unsettled_robots().unplaced;
    let selected = assignments.len() as u64 + unplaced;
    let mut lines = vec![format!("{} of {selected} succeeded", succeeded.len())];
    lines.extend(group_by_reason(&failed));
    lines.extend(open.iter().map(|a| format!("{}: timed out, still {}", a.name, reason(a))));
    if !offline.is_empty() {
        lines.push(format!(
            "offline, will follow on reconnect: {}",
            join_names(&offline, MAX_NAMES)
        ));
    }
    if unplaced > 0 {
        lines.push(format!("the order was not placed for {unplaced} robots"));
    }
    if !waiting.is_empty() {
        lines.push(format!(
            "paused after {} failures, not started: {}; to continue: taskd deploy resume {}",
            failed.len(),
            join_names(&waiting, MAX_NAMES),
            view.id
        ));
    }
    if !failed.is_empty() && view.state != DeploymentState::Paused {
        lines.push(format!("to retry the failed robots: taskd deploy retry {}", view.id));
    }
    let unsettled = open.len() as u64 + offline.len() as u64 + unplaced;
    let outcome = match (succeeded.len(), failed.len() + waiting.len(), unsettled) {
        (_, _, 1..) if view.state != DeploymentState::Cancelled => Outcome::TimedOut,
        (1.., 0, 0) => Outcome::Succeeded,
        (1.., _, _) => Outcome::SomeFailed,
        (0, _, _) => Outcome::Failed,
    };
    let text = lines.iter().map(|line| printable(line)).collect::<Vec<_>>().join("\n");
    Verdict { outcome, text }
}

/// Robots that failed, grouped by reason, the most common reason first.
fn group_by_reason(assignments: &[&AssignmentView]) -> Vec<String> {
    let mut reasons: BTreeMap<String, Vec<&AssignmentView>> = BTreeMap::new();
    for assignment in assignments {
        reasons.entry(reason(assignment)).or_default().push(assignment);
    }
    let mut reasons: Vec<_> = reasons.into_iter().collect();
    reasons.sort_by_key(|(_, robots)| std::cmp::Reverse(robots.len()));
    reasons
        .into_iter()
        .map(|(reason, robots)| format!("{}: {reason}", join_names(&robots, MAX_NAMES)))
        .collect()
}

fn reason(assignment: &AssignmentView) -> String {
    match (&assignment.failure, &assignment.superseded_by) {
        (Some(failure), _) => format!("{} ({failure})", assignment.phase),
        (None, Some(newer)) => format!("{} by {newer}", assignment.phase),
        (None, None) => assignment.phase.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use task_proto::api::Placing;
    use task_proto::messages::report::Phase;

    use super::*;
    use crate::display::transfer_eta::tests::{assignment, deployment};

    fn outcome(state: DeploymentState, phases: &[Phase]) -> Outcome {
        verdict(&deployment(
            state,
            phases.iter().map(|phase| assignment("a", *phase, true)).collect(),
        ))
        .outcome
    }

    #[test]
    fn outcome_combines_all_robots() {
        use DeploymentState::{Active, Cancelled, Settled};
        use Phase::{Failed, Fetching, Running, Stopped};
        assert_eq!(outcome(Settled, &[Running, Running]), Outcome::Succeeded);
        assert_eq!(outcome(Settled, &[Running, Failed]), Outcome::SomeFailed);
        assert_eq!(outcome(Settled, &[Failed, Stopped]), Outcome::Failed);
        assert_eq!(outcome(Active, &[Running, Fetching]), Outcome::TimedOut);
        assert_eq!(outcome(Cancelled, &[Phase::Cancelled]), Outcome::Failed);
    }

    #[test]
    fn reasons_are_given_and_offline_robots_listed_apart() {
        let view = deployment(
            DeploymentState::Active,
            vec![
                assignment("good", Phase::Running, true),
                assignment("bad", Phase::Failed, true),
                assignment("slow", Phase::Building, true),
                assignment("away", Phase::Assigned, false),
            ],
        );
        assert!(!is_finished(&view));
        assert_eq!(
            verdict(&view).text,
            format!(
                "1 of 4 succeeded\nbad: failed (build_failed: colcon said no)\nslow: timed out, still building\n\
                 offline, will follow on reconnect: away\nto retry the failed robots: taskd deploy retry {}",
                view.id
            )
        );
    }

    #[test]
    fn deployment_is_not_finished_before_it_is_placed_for_all_robots() {
        let running = || vec![assignment("a", Phase::Running, true)];
        let placing = Some(Placing { selected: 3, placed: 1 });
        let active = deployment(DeploymentState::Active, running());
        let active = DeploymentView { placing, ..active };
        assert!(!is_finished(&active));
        assert_eq!(verdict(&active).outcome, Outcome::TimedOut);
        let cancelled = DeploymentView { state: DeploymentState::Cancelled, ..active };
        assert!(is_finished(&cancelled));
        let verdict = verdict(&cancelled);
        assert_eq!(verdict.outcome, Outcome::SomeFailed);
        let expected = "1 of 3 succeeded\nthe order was not placed for 2 robots";
        assert_eq!(verdict.text, expected);
    }

    #[test]
    fn failed_robots_are_grouped_by_reason() {
        let bad = |name| assignment(name, Phase::Failed, true);
        let (a, b, c) = (bad("a"), bad("b"), assignment("c", Phase::Unmet, true));
        let lines = group_by_reason(&[&c, &a, &b]);
        assert_eq!(lines, ["a, b: failed (build_failed: colcon said no)", "c: unmet"]);
    }

    #[test]
    fn paused_deployment_is_finished_once_released_robots_settle() {
        let mut waiting = assignment("later", Phase::Assigned, true);
        waiting.released = false;
        let view = deployment(
            DeploymentState::Paused,
            vec![assignment("bad", Phase::Failed, true), waiting],
        );
        assert!(is_finished(&view));
        let verdict = verdict(&view);
        assert_eq!(verdict.outcome, Outcome::Failed);
        assert!(
            verdict.text.contains("not started: later; to continue: taskd deploy resume"),
            "{}",
            verdict.text
        );
    }
}
