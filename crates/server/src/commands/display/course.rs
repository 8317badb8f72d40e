//! Progress of a deployment: bytes transferred, rate, and remaining time. Pure: time is a
//! parameter.

use std::collections::VecDeque;
use std::time::Duration;

use task_proto::api::DeploymentView;
use task_proto::report::Phase;
use task_proto::time::span;

use super::output::bytes;

/// The time window of the rate.
const WINDOW: Duration = Duration::from_secs(10);
/// A speed over less time would be a guess.
const MIN_WINDOW: Duration = Duration::from_secs(1);

/// Recent observations of a deployment.
#[derive(Debug, Default)]
pub(in crate::commands) struct Course {
    seen: VecDeque<(Duration, u64)>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::commands) struct Estimate {
    /// Bytes that robots have.
    pub(in crate::commands) done: u64,
    /// Bytes needed by all robots that may still receive them.
    pub(in crate::commands) total: u64,
    /// Current bytes per second; absent: nothing is being transferred, or there are too few
    /// observations.
    pub(in crate::commands) bytes_per_s: Option<u64>,
    /// Time until the last byte at the current rate.
    pub(in crate::commands) left: Option<Duration>,
}

impl Course {
    /// Records the deployment's state at `now`, a time since any fixed origin.
    pub(in crate::commands) fn look(&mut self, view: &DeploymentView, now: Duration) -> Estimate {
        let (done, total) = travelled(view);
        // A robot may have to restart its transfer.
        if self.seen.back().is_some_and(|(_, before)| *before > done) {
            self.seen.clear();
        }
        self.seen.push_back((now, done));
        while self.seen.len() > 2 && self.seen[1].0 + WINDOW <= now {
            self.seen.pop_front();
        }
        let (since, before) = self.seen[0];
        let (time, moved) = (now.saturating_sub(since), done - before);
        let per_s =
            (time >= MIN_WINDOW && moved > 0).then(|| u128::from(moved) * 1000 / time.as_millis());
        let bytes_per_s = per_s.and_then(|rate| u64::try_from(rate).ok()).filter(|rate| *rate > 0);
        let left = bytes_per_s.map(|rate| Duration::from_secs((total - done).div_ceil(rate)));
        Estimate { done, total, bytes_per_s, left: left.filter(|left| !left.is_zero()) }
    }
}

/// Bytes that have travelled, and that will have.
fn travelled(view: &DeploymentView) -> (u64, u64) {
    let size = view.package.content.size;
    let mut sum = (0, 0);
    for assignment in view.assignments.iter().flatten() {
        let done = match assignment.phase {
            Phase::Assigned | Phase::Deferred | Phase::Unknown => 0,
            Phase::Fetching => assignment.progress.map_or(0, |progress| progress.done.min(size)),
            Phase::Unpacking | Phase::Building | Phase::Staged | Phase::Starting => size,
            Phase::Running | Phase::Succeeded | Phase::Stopped | Phase::RolledBack => size,
            // A failed robot receives no more bytes.
            Phase::Failed
            | Phase::Unmet
            | Phase::Superseded
            | Phase::Cancelled
            | Phase::Expired => continue,
        };
        sum = (sum.0 + done, sum.1 + size);
    }
    sum
}

impl Estimate {
    /// `12 MiB of 40 MiB, 3 MiB/s, 10 s left`.
    pub(in crate::commands) fn text(&self) -> String {
        let mut text = format!("{} of {}", bytes(self.done), bytes(self.total));
        if let Some(rate) = self.bytes_per_s {
            text.push_str(&format!(", {}/s", bytes(rate)));
        }
        if let Some(left) = self.left {
            text.push_str(&format!(", {} left", span(left)));
        }
        text
    }
}

#[cfg(test)]
pub(in crate::commands) mod tests {
    use task_proto::api::{AssignmentView, DeploymentState};
    use task_proto::report::{Failure, FailureCode, Phase, Progress};
    use task_proto::{DeploymentId, Digest, RobotId};

    use super::*;

    pub(in crate::commands) fn assignment(
        name: &str,
        phase: Phase,
        online: bool,
    ) -> AssignmentView {
        AssignmentView {
            robot: RobotId::random(),
            name: name.parse().unwrap(),
            online,
            released: true,
            delivery: None,
            phase,
            progress: None,
            failure: (phase == Phase::Failed)
                .then(|| Failure::new(FailureCode::BUILD_FAILED, "colcon said no")),
            attempts: 1,
            superseded_by: None,
            updated_at_ms: 0,
            timeline: None,
        }
    }

    pub(in crate::commands) fn deployment(
        state: DeploymentState,
        assignments: Vec<AssignmentView>,
    ) -> DeploymentView {
        let blob = serde_json::json!({ "digest": Digest::of(b""), "size": 0 });
        let package = serde_json::json!({
            "name": "talker", "version": "1", "manifest": blob, "config": blob, "content": blob,
        });
        DeploymentView {
            id: DeploymentId::random(),
            package: serde_json::from_value(package).unwrap(),
            kind: task_proto::manifest::TaskKind::Service,
            selector: "*".parse().ok(),
            delivery: task_proto::api::DeliveryChoice::PushPull,
            priority: 0,
            state,
            batch: None,
            max_failures: None,
            created_at_ms: 0,
            expires_at_ms: 0,
            counts: Vec::new(),
            supersedes: Vec::new(),
            outdated: false,
            assignments: Some(assignments),
        }
    }

    fn view(done: &[u64]) -> DeploymentView {
        let fetching = |done: &u64| {
            let mut assignment = assignment("a", Phase::Fetching, true);
            assignment.progress = Some(Progress { done: *done, total: 1000 });
            assignment
        };
        let mut view = deployment(DeploymentState::Active, done.iter().map(fetching).collect());
        view.package.content.size = 1000;
        view
    }

    #[test]
    fn speed_and_time_left_are_those_of_the_last_seconds() {
        let mut course = Course::default();
        let at = Duration::from_secs;
        assert_eq!(course.look(&view(&[0, 0]), at(0)).text(), "0 B of 1.95 KiB");
        let estimate = course.look(&view(&[200, 0]), at(2));
        assert_eq!((estimate.bytes_per_s, estimate.left), (Some(100), Some(at(18))));
        // Observations from 30 s ago no longer count.
        course.look(&view(&[200, 300]), at(30));
        let estimate = course.look(&view(&[300, 300]), at(40));
        assert_eq!(estimate.bytes_per_s, Some(10));
        assert_eq!(estimate.text(), "600 B of 1.95 KiB, 10 B/s, 2 min 20 s left");
        let again = course.look(&view(&[0, 0]), at(41));
        assert_eq!((again.done, again.bytes_per_s), (0, None));
    }

    #[test]
    fn who_failed_gets_no_more_and_who_runs_has_all() {
        let mut view = view(&[500]);
        let assignments = view.assignments.as_mut().expect("there are some");
        assignments.push(assignment("b", Phase::Failed, true));
        assignments.push(assignment("c", Phase::Running, true));
        assert_eq!(travelled(&view), (1500, 2000));
    }
}
