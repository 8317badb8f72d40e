//! Progress of a deployment: bytes transferred, rate, and remaining time. Pure: time is a
//! parameter.

use std::collections::VecDeque;
use std::time::Duration;

use task_proto::api::DeploymentView;
use task_proto::messages::report::Phase;
use task_proto::size::{format_bytes, format_rate};
use task_proto::time::span;

/// The time window of the rate.
const WINDOW: Duration = Duration::from_secs(10);
/// A speed over less time would be a guess.
const MIN_WINDOW: Duration = Duration::from_secs(1);

/// Recent observations of a deployment.
#[derive(Debug, Default)]
pub(crate) struct TransferEta {
    observations: VecDeque<(Duration, u64)>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct TransferEstimate {
    /// Bytes that robots have.
    pub(crate) done: u64,
    /// Bytes needed by all robots that may still receive them.
    pub(crate) total: u64,
    /// Current bytes per second; absent: nothing is being transferred, or there are too few
    /// observations.
    pub(crate) bytes_per_s: Option<u64>,
    /// Time until the last byte at the current rate.
    pub(crate) left: Option<Duration>,
}

impl TransferEta {
    /// Records the deployment's state at `now`, a time since any fixed origin.
    pub(crate) fn observe(&mut self, view: &DeploymentView, now: Duration) -> TransferEstimate {
        let (done, total) = transferred_bytes(view);
        // A robot may have to restart its transfer.
        if self.observations.back().is_some_and(|(_, before)| *before > done) {
            self.observations.clear();
        }
        self.observations.push_back((now, done));
        while self.observations.len() > 2 && self.observations[1].0 + WINDOW <= now {
            self.observations.pop_front();
        }
        let (since, before) = self.observations[0];
        let (time, moved) = (now.saturating_sub(since), done - before);
        let per_s =
            (time >= MIN_WINDOW && moved > 0).then(|| u128::from(moved) * 1000 / time.as_millis());
        let bytes_per_s = per_s.and_then(|rate| u64::try_from(rate).ok()).filter(|rate| *rate > 0);
        let left = bytes_per_s.map(|rate| Duration::from_secs((total - done).div_ceil(rate)));
        TransferEstimate { done, total, bytes_per_s, left: left.filter(|left| !left.is_zero()) }
    }
}

/// Bytes that have transferred_bytes, and that will have.
fn transferred_bytes(view: &DeploymentView) -> (u64, u64) {
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

impl TransferEstimate {
    /// `12 MB of 40 MB, 3 MB/s, 10 s left`.
    pub(crate) fn text(&self) -> String {
        let mut text = format!("{} of {}", format_bytes(self.done), format_bytes(self.total));
        if let Some(rate) = self.bytes_per_s {
            text.push_str(&format!(", {}", format_rate(rate)));
        }
        if let Some(left) = self.left {
            text.push_str(&format!(", {} left", span(left)));
        }
        text
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use task_proto::api::{AssignmentView, DeploymentState};
    use task_proto::messages::report::{Failure, FailureCode, Phase, Progress};
    use task_proto::{DeploymentId, Digest, RobotId};

    use super::*;

    pub(crate) fn assignment(name: &str, phase: Phase, online: bool) -> AssignmentView {
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

    pub(crate) fn deployment(
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
            kind: task_proto::packages::manifest::TaskKind::Service,
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
            placing: None,
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
    fn rate_and_time_left_come_from_the_last_seconds() {
        let mut transfer_eta = TransferEta::default();
        let at = Duration::from_secs;
        assert_eq!(transfer_eta.observe(&view(&[0, 0]), at(0)).text(), "0 B of 2 KB");
        let estimate = transfer_eta.observe(&view(&[200, 0]), at(2));
        assert_eq!((estimate.bytes_per_s, estimate.left), (Some(100), Some(at(18))));
        // Observations from 30 s ago no longer count.
        transfer_eta.observe(&view(&[200, 300]), at(30));
        let estimate = transfer_eta.observe(&view(&[300, 300]), at(40));
        assert_eq!(estimate.bytes_per_s, Some(10));
        assert_eq!(estimate.text(), "600 B of 2 KB, 10 B/s, 2 min 20 s left");
        let again = transfer_eta.observe(&view(&[0, 0]), at(41));
        assert_eq!((again.done, again.bytes_per_s), (0, None));
    }

    #[test]
    fn failed_robots_need_no_bytes_and_running_robots_have_all() {
        let mut view = view(&[500]);
        let assignments = view.assignments.as_mut().expect("there are some");
        assignments.push(assignment("b", Phase::Failed, true));
        assignments.push(assignment("c", Phase::Running, true));
        assert_eq!(transferred_bytes(&view), (1500, 2000));
    }
}
