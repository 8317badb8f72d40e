//! One run of one version, and its states. Every change of a run is a transition in this file. The
//! plan decides which one, and when. Pure.
//!
//! ```text
//!          begin             become_ready
//! waiting ───────► starting ──────────────► up
//!  ▲   │             │  │                  │  │
//!  │   │             │  └────────┬─────────┘  │
//!  │   │             │           ▼ fail       │
//!  │   │             │        stopping        │   not ready in time, refused, past its deadline,
//!  │   │             │           │            │   or degraded for too long
//!  │   │             └───────────┼────────────┘
//!  │   │                         │ lose_process: it has ended, was stopped, or never began
//!  ├───┼─────────────────────────┤
//!  │   └─► over ◄────────────────┘ finish: succeeded, failed or stopped
//!  │         │
//!  └─────────┘ enter_boot: a run that had too many restarts gets another chance
//! ```
//!
//! A run that waits may start again after a backoff (`restart`), or after a reboot. An ordered stop
//! is no state: the order itself says it. An event that comes too late for a state changes nothing.

use serde::{Deserialize, Serialize};
use task_proto::DeploymentId;
use task_proto::desired::{DesiredTask, PackageRef};
use task_proto::messages::report::{Failure, Phase};
use task_proto::packages::manifest::{OnBoot, Restart, TaskKind};

use crate::task::timing::{Moment, backoff_ms};

mod rules;
mod stored;

pub use rules::RunRules;

/// A run that is restarted more often than this without a calm stretch has failed. At the longest
/// backoff that takes over an hour: enough time to plug a sensor in again.
pub const MAX_RESTARTS_IN_A_ROW: u32 = 100;
/// The longest wait before a process is started again.
const MAX_RESTART_BACKOFF_MS: u64 = 60 * 1000;

/// A run of one version, alive or meant to be.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(from = "stored::RunRecord", into = "stored::RunRecord")]
pub struct ActiveRun {
    /// The deployment that ordered the run.
    pub deployment: DeploymentId,
    /// The run number within the deployment.
    pub run: u64,
    /// The package that runs.
    pub package: PackageRef,
    /// The rules of the run, from its manifest.
    pub rules: RunRules,
    state: RunState,
    reached: Milestone,
    /// Whether a process was started in this boot, so that the robot's gate need not be asked
    /// again.
    admitted: bool,
    /// The number of starts by the restart policy.
    restarts: u32,
    /// The number of restarts since the last calm stretch.
    restarts_in_a_row: u32,
    /// No start and no stop before this time.
    retry_at_ms: u64,
    /// When the first process of this boot was started.
    first_start_ms: u64,
}

/// The state of a run.
#[derive(Debug, Clone, PartialEq)]
enum RunState {
    /// The run has no process and waits for a start.
    Waiting,
    /// The process was started, or is about to be, and is not ready yet.
    Starting(ProcessRecord),
    /// The process has become ready.
    Up(ProcessRecord),
    /// The process has failed and is to be stopped, although the order wants the run to continue.
    Stopping { process: ProcessRecord, was_ready: bool, pending_stop: PendingStop },
    /// The run is over for good.
    Over(End),
}

/// How far any process of a run has come.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Milestone {
    /// No process is known to have been started.
    None,
    /// A process was started, so that a start continues the run rather than begins it.
    Started,
    /// A process was ready.
    Ready,
}

/// A process that was started or is about to be started.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ProcessRecord {
    /// The name of the run directory; each start has its own directory.
    pub dir: String,
    /// The boot in which the process was started.
    pub boot_id: String,
    /// Milliseconds since boot at the start.
    pub started_ms: u64,
    /// The process id, once known.
    pub pid: Option<u32>,
}

/// Why a process is stopped although the order wants the run to continue.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct PendingStop {
    /// The failure of the process.
    pub failure: Failure,
    /// Whether the restart policy may start another process.
    pub again: bool,
}

/// The outcome of a run.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct End {
    pub phase: Phase,
    /// The reason, if the run did not succeed.
    pub failure: Option<Failure>,
}

impl End {
    /// The end of a run that has failed.
    pub fn failed(failure: Failure) -> Self {
        Self { phase: Phase::Failed, failure: Some(failure) }
    }

    /// The end of a run that did what it should, or was told to end.
    pub fn without_failure(phase: Phase) -> Self {
        Self { phase, failure: None }
    }
}

/// What is known of a run.
impl ActiveRun {
    /// Whether this is the run that `order` asks for.
    pub fn is_for(&self, order: &DesiredTask) -> bool {
        self.deployment == order.deployment
            && self.run == order.run
            && self.package == order.package
    }

    /// Whether this is the same run, perhaps with another process.
    pub fn is_same(&self, other: &Self) -> bool {
        self.deployment == other.deployment && self.run == other.run
    }

    /// The last started process that is not known to have ended.
    pub fn process(&self) -> Option<&ProcessRecord> {
        match &self.state {
            RunState::Starting(process)
            | RunState::Up(process)
            | RunState::Stopping { process, .. } => Some(process),
            RunState::Waiting | RunState::Over(_) => None,
        }
    }

    /// Whether the present process has become ready.
    pub fn is_ready(&self) -> bool {
        matches!(self.state, RunState::Up(_) | RunState::Stopping { was_ready: true, .. })
    }

    /// Why the present process is to be stopped, if it has failed.
    pub fn pending_stop(&self) -> Option<&PendingStop> {
        match &self.state {
            RunState::Stopping { pending_stop, .. } => Some(pending_stop),
            _ => None,
        }
    }

    /// The outcome, once the run is over for good.
    pub fn end(&self) -> Option<&End> {
        match &self.state {
            RunState::Over(end) => Some(end),
            _ => None,
        }
    }

    /// Whether the run waits for a start.
    pub fn is_waiting(&self) -> bool {
        self.state == RunState::Waiting
    }

    /// Whether a process of the run was started before.
    pub fn has_started(&self) -> bool {
        self.reached >= Milestone::Started
    }

    /// Whether a process of the run was ever ready.
    pub fn was_ever_ready(&self) -> bool {
        self.reached == Milestone::Ready
    }

    /// Whether a process was started in this boot, so that the robot's gate need not be asked
    /// again.
    pub fn is_admitted(&self) -> bool {
        self.admitted
    }

    /// The number of starts by the restart policy.
    pub fn restarts(&self) -> u32 {
        self.restarts
    }

    /// The number of restarts since the last calm stretch.
    pub fn restarts_in_a_row(&self) -> u32 {
        self.restarts_in_a_row
    }

    /// No start and no stop before this time.
    pub fn retry_at_ms(&self) -> u64 {
        self.retry_at_ms
    }

    /// Whether the policy restarts a failed process. A job is never restarted: it runs once.
    pub fn may_restart(&self) -> bool {
        self.rules.kind == TaskKind::Service && self.rules.restart != Restart::Never
    }

    /// Whether a failed run may have another process. A service that was never ready has its
    /// readiness timeout to become so; one that was ready has [`MAX_RESTARTS_IN_A_ROW`] restarts.
    pub fn has_restarts_left(&self, now_ms: u64) -> bool {
        let tried_ms = now_ms.saturating_sub(self.first_start_ms);
        let timeout_ms = u64::from(self.rules.ready_timeout_s) * 1000;
        (self.was_ever_ready() || tried_ms < timeout_ms)
            && self.restarts_in_a_row < MAX_RESTARTS_IN_A_ROW
    }

    /// Whether the run may come back if its successor does not become ready.
    pub fn is_good(&self) -> bool {
        self.was_ever_ready() && self.end().is_none() && self.rules.kind == TaskKind::Service
    }
}

/// The transitions: each is one event of the run, and returns the run as it is afterwards.
impl ActiveRun {
    /// The run that `order` asks for, before its first start.
    pub fn of(order: &DesiredTask, rules: RunRules, now_ms: u64) -> Self {
        Self {
            deployment: order.deployment.clone(),
            run: order.run,
            package: order.package.clone(),
            rules,
            state: RunState::Waiting,
            reached: Milestone::None,
            admitted: false,
            restarts: 0,
            restarts_in_a_row: 0,
            retry_at_ms: 0,
            first_start_ms: now_ms,
        }
    }

    /// `process` is about to be started.
    pub fn begin(self, process: ProcessRecord) -> Self {
        Self { admitted: true, state: RunState::Starting(process), ..self }
    }

    /// The process is known to have been started, with this process id if it is known.
    pub fn started(self, pid: Option<u32>, now_ms: u64) -> Self {
        let run = self.with_process(|process| {
            process.started_ms = now_ms;
            process.pid = pid.or(process.pid);
        });
        run.known_started()
    }

    /// Some process of the run is known to have been started.
    pub fn known_started(self) -> Self {
        Self { reached: self.reached.max(Milestone::Started), ..self }
    }

    /// The process was seen alive, with this process id.
    pub fn seen(self, pid: u32) -> Self {
        self.with_process(|process| process.pid = Some(pid))
    }

    /// All readiness conditions of the process have held long enough.
    pub fn become_ready(self) -> Self {
        let state = match self.state {
            RunState::Starting(process) => RunState::Up(process),
            other => other,
        };
        Self { state, reached: Milestone::Ready, ..self }
    }

    /// The process has failed and is to be stopped.
    pub fn fail(self, pending_stop: PendingStop) -> Self {
        let was_ready = self.is_ready();
        let state = match self.state {
            RunState::Starting(process)
            | RunState::Up(process)
            | RunState::Stopping { process, .. } => {
                RunState::Stopping { process, was_ready, pending_stop }
            }
            other => other,
        };
        Self { state, ..self }
    }

    /// The process could not be stopped: nothing is tried before this time.
    pub fn postpone(self, retry_at_ms: u64) -> Self {
        Self { retry_at_ms, ..self }
    }

    /// The process is gone, or was never started.
    pub fn lose_process(self) -> Self {
        let state = match self.state {
            RunState::Over(end) => RunState::Over(end),
            _ => RunState::Waiting,
        };
        Self { state, ..self }
    }

    /// The restart policy starts another process after a backoff.
    pub fn restart(self, at: &Moment<'_>) -> Self {
        let restarts_in_a_row = self.restarts_in_a_row + 1;
        let wait_ms = backoff_ms(restarts_in_a_row, MAX_RESTART_BACKOFF_MS, at.jitter);
        let retry_at_ms = at.now_ms + wait_ms;
        let restarts = self.restarts.saturating_add(1);
        Self { restarts, restarts_in_a_row, retry_at_ms, ..self }
    }

    /// The process has run calmly for long enough.
    pub fn calm_down(self) -> Self {
        Self { restarts_in_a_row: 0, ..self }
    }

    /// The run is over for good.
    pub fn finish(self, end: End) -> Self {
        Self { state: RunState::Over(end), ..self }
    }

    /// The robot went down while the process ran: the run starts again at once.
    pub fn resume_after_reboot(self, now_ms: u64) -> Self {
        Self { retry_at_ms: 0, first_start_ms: now_ms, ..self }
    }

    /// Another run takes the place of this one, which may come back.
    pub fn set_aside(self) -> Self {
        Self { retry_at_ms: 0, restarts_in_a_row: 0, ..self }.lose_process()
    }

    /// The run comes back in place of the run that had replaced it.
    pub fn come_back(self, now_ms: u64) -> Self {
        Self { first_start_ms: now_ms, ..self }
    }

    /// The run was stopped by order and is ordered again: it has to become ready anew.
    pub fn order_again(self, now_ms: u64) -> Self {
        let reached = self.reached.min(Milestone::Started);
        Self { reached, first_start_ms: now_ms, ..self }
    }

    /// The robot has booted. Times of the previous boot mean nothing any more, and a resource that
    /// was missing when the run was given up may be there again.
    pub fn enter_boot(self, now_ms: u64) -> Self {
        let state = match self.state {
            RunState::Over(_) if self.has_exhausted_restarts() => RunState::Waiting,
            other => other,
        };
        let admitted = false;
        Self {
            state,
            admitted,
            restarts_in_a_row: 0,
            retry_at_ms: 0,
            first_start_ms: now_ms,
            ..self
        }
    }

    /// Whether the run was good and was given up only because of too many restarts in one boot.
    fn has_exhausted_restarts(&self) -> bool {
        let is_up_at_boot =
            self.rules.kind == TaskKind::Service && self.rules.on_boot == OnBoot::Start;
        is_up_at_boot && self.was_ever_ready() && self.restarts_in_a_row >= MAX_RESTARTS_IN_A_ROW
    }

    fn with_process(mut self, change: impl FnOnce(&mut ProcessRecord)) -> Self {
        match &mut self.state {
            RunState::Starting(process)
            | RunState::Up(process)
            | RunState::Stopping { process, .. } => change(process),
            RunState::Waiting | RunState::Over(_) => {}
        }
        self
    }
}
