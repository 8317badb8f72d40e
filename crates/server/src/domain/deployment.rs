//! The state transitions of an assignment, and the state of a deployment as a whole. These are pure
//! functions; nothing is read or stored here.
//!
//! ```text
//!             report            report             report
//! assigned ──────────► … ──────────────► running ──────────► succeeded | failed | stopped | unmet | rolled_back
//!    │                 │                    │
//!    └─────────────────┴────────────────────┴── an order or the clock ──► superseded | cancelled | expired
//! ```
//! A robot's report moves an assignment only forward, out of a phase that is not final, and only
//! within the requested run. Only an order begins a new run.

use task_proto::Generation;
use task_proto::api::{DeploymentState, PhaseCount};
use task_proto::messages::report::{Failure, Phase, Progress, TaskReport};
use task_proto::packages::manifest::TaskKind;

/// The state of one assignment.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AssignmentState {
    /// The number of times that the task was asked to start.
    pub run: u64,
    /// The phase of that run.
    pub phase: Phase,
    /// The progress within the phase.
    pub progress: Option<Progress>,
    /// The cause of a failure.
    pub failure: Option<Failure>,
    /// Tries of the phase.
    pub attempts: u32,
}

impl AssignmentState {
    /// The state after the robot's `report`; `None` if the report changes nothing.
    pub fn after(&self, report: &TaskReport) -> Option<Self> {
        if self.phase.is_final() || report.run != self.run || !is_reportable(report.phase) {
            return None;
        }
        let next = Self {
            run: self.run,
            phase: report.phase,
            progress: report.progress,
            failure: report.failure.clone(),
            attempts: report.attempts,
        };
        (next != *self).then_some(next)
    }

    /// The state after a robot that accepted `observed` no longer lists the task, if the task left
    /// the desired state in generation `removed`: the task has been stopped.
    pub fn after_absence(&self, removed: Option<Generation>, observed: Generation) -> Option<Self> {
        let gone = !self.phase.is_final() && removed.is_some_and(|removed| observed >= removed);
        gone.then(|| Self { phase: Phase::Stopped, progress: None, failure: None, ..self.clone() })
    }
}

/// Whether a robot may report the phase; only the server sets the others.
fn is_reportable(phase: Phase) -> bool {
    !matches!(phase, Phase::Superseded | Phase::Cancelled | Phase::Expired | Phase::Unknown)
}

/// Whether `phase`, in which an order for a `kind` has settled, counts as a failure of the rollout.
/// A phase set by an operator does not.
pub fn is_failure(phase: Phase, kind: TaskKind) -> bool {
    phase.is_settled(kind)
        && !phase.is_success(kind)
        && !matches!(phase, Phase::Superseded | Phase::Cancelled | Phase::Stopped)
}

/// The state of a deployment as a whole. While an order is still to be placed for some of its
/// robots, it has not settled.
pub fn state(
    kind: TaskKind,
    cancelled: bool,
    paused: bool,
    is_placing: bool,
    counts: &[PhaseCount],
) -> DeploymentState {
    if cancelled {
        DeploymentState::Cancelled
    } else if !is_placing && counts.iter().all(|count| count.phase.is_settled(kind)) {
        DeploymentState::Settled
    } else if paused {
        DeploymentState::Paused
    } else {
        DeploymentState::Active
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use task_proto::desired::{BlobRef, PackageRef, TargetState};
    use task_proto::{DeploymentId, Digest};

    use super::*;

    fn assignment(run: u64, phase: Phase) -> AssignmentState {
        AssignmentState { run, phase, progress: None, failure: None, attempts: 0 }
    }

    fn report(run: u64, phase: Phase) -> TaskReport {
        let blob = BlobRef { digest: Digest::of(b""), size: 0 };
        TaskReport {
            task: "talker".parse().expect("valid"),
            deployment: DeploymentId::random(),
            package: PackageRef {
                name: "talker".parse().expect("valid"),
                version: "1".parse().expect("valid"),
                manifest: blob,
                config: blob,
                content: blob,
            },
            wanted: TargetState::Running,
            run,
            kind: None,
            phase,
            phase_ms: 0,
            progress: None,
            missing_parts: None,
            attempts: 0,
            restarts: 0,
            failure: None,
            degraded: None,
            active: None,
        }
    }

    fn arbitrary_phase() -> impl Strategy<Value = Phase> {
        proptest::sample::select(Phase::ALL.to_vec())
    }

    proptest! {
        #[test]
        fn report_never_leaves_a_final_phase(from in arbitrary_phase(), to in arbitrary_phase(), run in 1u64..4, said in 1u64..4) {
            let next = assignment(run, from).after(&report(said, to));
            if from.is_final() || run != said {
                prop_assert_eq!(next, None);
            } else if let Some(next) = next {
                prop_assert_eq!(next.phase, to);
                prop_assert!(is_reportable(to));
            }
        }

        #[test]
        fn absence_stops_only_removed_tasks(from in arbitrary_phase(), removed in proptest::option::of(0u64..5), observed in 0u64..5) {
            let next = assignment(1, from).after_absence(removed.map(Generation), Generation(observed));
            let gone = !from.is_final() && removed.is_some_and(|removed| removed <= observed);
            prop_assert_eq!(next.map(|next| next.phase), gone.then_some(Phase::Stopped));
        }
    }

    #[test]
    fn deployment_settles_with_its_last_assignment() {
        let count = |phase, count| PhaseCount { phase, count };
        let open = [count(Phase::Running, 3), count(Phase::Assigned, 1)];
        let done = [count(Phase::Running, 3), count(Phase::Failed, 1)];
        assert_eq!(state(TaskKind::Service, false, false, false, &open), DeploymentState::Active);
        assert_eq!(state(TaskKind::Service, false, true, false, &open), DeploymentState::Paused);
        assert_eq!(state(TaskKind::Service, false, true, false, &done), DeploymentState::Settled);
        assert_eq!(state(TaskKind::Job, false, false, false, &done), DeploymentState::Active);
        assert_eq!(state(TaskKind::Service, true, false, true, &done), DeploymentState::Cancelled);
        assert_eq!(state(TaskKind::Service, false, false, true, &done), DeploymentState::Active);
    }
}
