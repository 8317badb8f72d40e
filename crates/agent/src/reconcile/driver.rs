//! The driver is the single tokio task that owns the ledger. The driver asks the plan for each
//! task's next step, writes the ledger, runs the step, and reports changes. Decisions about tasks
//! belong to the plan, and actions on the robot belong to the effects.
//!
//! Steps run as tokio tasks of their own and send back only that they ended, so the driver never
//! waits for long. A step that is no longer wanted is cancelled and, if the step does not end,
//! dropped.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;
use std::time::Duration;

use task_proto::desired::{DesiredState, DesiredTask, TargetState};
use task_proto::error_chain::chain;
use task_proto::ids::Labels;
use task_proto::messages::report::{Condition, Progress};
use task_proto::trust::envelope::PublicKey;
use task_proto::{Digest, Generation, InstanceId, RobotId, RobotName, TaskName};
use tokio::sync::{Notify, mpsc, watch};
use tokio::task::{AbortHandle, JoinSet};
use tokio::time::Instant;
use tokio_util::sync::{CancellationToken, DropGuard};

use crate::link::state::{LinkState, ServerMessage};
use crate::reconcile::admission;
use crate::task::effects::Effects;
use crate::task::ledger::{Ledger, TaskRecord};
use crate::task::observed::{Health, Prepared, ProcessState, RobotFacts, TrustFacts};
use crate::task::plan::{self, Lane, Next, Outcome, Permissions, PlanInput, Step};
use crate::task::run::ActiveRun;
use crate::task::timing::Moment;
use crate::transfer::parts::PartRequest;

mod messages;
mod reporting;
mod steps;
mod watchers;

/// Interval between polls of the hold flag while idle, and between progress reports.
const TICK: Duration = Duration::from_secs(1);
/// Delay before the next attempt after the ledger could not be written.
const LEDGER_RETRY: Duration = Duration::from_secs(5);
/// Interval between observations of a process while its state cannot be determined.
const OBSERVE_AGAIN: Duration = Duration::from_millis(plan::OBSERVE_AGAIN_MS);
/// More planning rounds than this for one task mean that the plan is in a cycle.
const MAX_PLANNING_ROUNDS: u32 = 64;
/// The maximum number of watcher observations waiting for the driver; beyond it the watchers wait.
const QUEUED_OBSERVATIONS: usize = 16;

/// The robot and the agent that the driver reports for.
#[derive(Debug, Clone)]
pub struct AgentIdentity {
    pub robot_id: RobotId,
    /// The server's public key, which verifies the desired states.
    pub server_key: PublicKey,
    /// Identifies this start of the agent.
    pub instance: InstanceId,
    /// The place of this start: one data directory, during one boot of one machine.
    pub place: Option<Digest>,
    /// The kernel's boot id.
    pub boot_id: String,
    /// The robot's name in its own settings.
    pub name: Option<RobotName>,
    /// The robot's labels in its own settings.
    pub labels: Option<Labels>,
}

/// The driver's observations of one task; lost at a restart.
#[derive(Default)]
struct View {
    /// The files of the version to prepare on the disk; `None` when the disk must be inspected.
    prepared: Option<Prepared>,
    /// The state of the active run's process; `None` when the process must be observed.
    process: Option<ProcessState>,
    /// When to observe the process again if its state could not be determined. An observation may
    /// take long, and all tasks wait for it.
    observe_again_at: Option<Instant>,
    /// The watchers of the process.
    process_watch: Option<ProcessWatch>,
    /// The health of the process on the ROS graph.
    health: Health,
    /// The progress of the transfers under way, by lane.
    transfers: BTreeMap<Lane, watch::Receiver<Progress>>,
    /// The progress as reported, by lane.
    progress: BTreeMap<Lane, Progress>,
    /// The missing parts, as announced by the step that gathers parts.
    requested_parts: Option<watch::Receiver<PartRequest>>,
    /// The last stop or deletion that failed, and the reason. The step is tried again.
    failed_step: Option<String>,
}

/// The watchers of one process. Dropping this ends the watcher of the ROS graph.
struct ProcessWatch {
    /// The run directory's name.
    dir: String,
    _until_dropped: DropGuard,
}

/// A watcher's observation of the process of a run directory.
struct WatcherEvent {
    task: TaskName,
    dir: String,
    observation: Observation,
}

/// An observation of a process.
enum Observation {
    /// The process has ended, or is no longer watched.
    Over,
    /// The current health on the ROS graph.
    Health(Health),
}

/// A step under way.
struct RunningStep {
    step: Step,
    handle: AbortHandle,
    cancel: CancellationToken,
    /// When a cancelled step is dropped.
    drop_at: Option<Instant>,
}

/// The driver of one robot.
pub struct Driver<E> {
    effects: Arc<E>,
    agent_identity: AgentIdentity,
    link_state: LinkState,
    ledger: Ledger,
    /// Whether the ledger has changes that are not on the disk.
    dirty: bool,
    /// The generation of the accepted state that is on the disk. A state that was accepted and is
    /// lost in a power cut must be sent again.
    observed: Generation,
    desired: Option<DesiredState>,
    views: BTreeMap<TaskName, View>,
    under_way: HashMap<(TaskName, Lane), RunningStep>,
    steps: JoinSet<(TaskName, Lane, Outcome)>,
    /// The channel on which watchers send their observations.
    observation_sender: mpsc::Sender<WatcherEvent>,
    observations: mpsc::Receiver<WatcherEvent>,
    robot: RobotFacts,
    /// The trust facts at the last check of the packages' signers.
    trust: TrustFacts,
    held: bool,
    /// Conditions by code, except those that follow from other fields.
    conditions: BTreeMap<&'static str, String>,
    /// Why the server withholds a desired state, in the server's words.
    state_unavailable: Option<Condition>,
    /// The contents whose gathered bytes were kept at the last cleanup; `None`: a cleanup is due.
    kept_parts: Option<Vec<Digest>>,
    /// Notified when missing parts are to be requested.
    part_requests: Arc<Notify>,
    /// Whether missing parts are to be requested, even if the last report may have said the same.
    report_parts_again: bool,
    seq: u64,
    started: Instant,
}

impl<E: Effects> Driver<E> {
    /// A driver that continues from `ledger`. The caller has not counted this start in the ledger.
    /// `lost` says that an earlier ledger was moved aside, and where.
    pub async fn new(
        effects: Arc<E>,
        agent_identity: AgentIdentity,
        link_state: LinkState,
        mut ledger: Ledger,
        lost: Option<String>,
    ) -> Self {
        let now = effects.now();
        ledger.start += 1;
        ledger.enter_boot(&agent_identity.boot_id, now.boot_ms);
        let mut conditions = BTreeMap::new();
        if let Some(text) = lost {
            for (task, run) in effects.survivors().await {
                ledger.tasks.insert(task.clone(), TaskRecord::of_survivor(task, run, now.boot_ms));
            }
            conditions.insert("ledger_rebuilt", text);
        }
        let mut desired = None;
        if let Some(accepted) = &ledger.accepted {
            match admission::open(
                &accepted.envelope,
                &agent_identity.server_key,
                &agent_identity.robot_id,
            ) {
                Ok(state) => desired = Some(state),
                // The robot was registered anew. The tasks continue unchanged until the new server
                // has sent a state.
                Err(error) => {
                    tracing::warn!(error = %chain(&error), "the state in the ledger was signed by another server");
                    ledger.accepted = None;
                }
            }
        }
        // The ROS installations are inspected when they are needed.
        let robot = RobotFacts { installations: None, ..effects.robot_facts() };
        let (observation_sender, observations) = mpsc::channel(QUEUED_OBSERVATIONS);
        let held = effects.is_held();
        desired.iter().for_each(|state| effects.apply_state(state));
        let trust = effects.trust_facts();
        Self {
            effects,
            agent_identity,
            link_state,
            ledger,
            dirty: true,
            observed: Generation(0),
            desired,
            views: BTreeMap::new(),
            under_way: HashMap::new(),
            steps: JoinSet::new(),
            observation_sender,
            observations,
            robot,
            trust,
            held,
            conditions,
            state_unavailable: None,
            kept_parts: None,
            part_requests: Arc::default(),
            report_parts_again: false,
            seq: 0,
            started: Instant::now(),
        }
    }

    /// Drives the tasks until the agent ends. Steps under way are dropped then; the tasks keep
    /// running.
    pub async fn run(mut self, mut server_messages: mpsc::Receiver<ServerMessage>) {
        let mut tick = tokio::time::interval(TICK);
        loop {
            let wake = self.plan_all().await;
            tokio::select! {
                // Cancel-safe: a step that has ended stays in the set until it is taken.
                Some(ended) = self.steps.join_next_with_id() => self.step_ended(ended),
                // Cancel-safe: a message stays in its channel until it is received.
                Some(event) = self.observations.recv() => self.handle_observation(event),
                // Cancel-safe: a message stays in its channel until it is received.
                Some(message) = server_messages.recv() => self.handle_message(message),
                // Cancel-safe: a permit that was not taken stays.
                () = self.part_requests.notified() => self.report_parts_again = true,
                // Cancel-safe: an interval keeps its own time.
                _ = tick.tick() => self.tick(),
                // Cancel-safe: the timer is created anew in each turn.
                () = tokio::time::sleep_until(wake) => {}
                // Cancel-safe: a token can be awaited again.
                () = self.link_state.shutdown.cancelled() => break,
            }
        }
        self.save();
    }

    /// Plans every task until all rest, begins the planned steps, reports. Returns the time of the
    /// next turn.
    async fn plan_all(&mut self) -> Instant {
        // Polled before each turn: after `hold` nothing may be started any more.
        self.held = self.effects.is_held();
        self.interrupt_unwanted();
        let mut wake = Instant::now() + Duration::from_secs(3600);
        let mut begin = Vec::new();
        for task in self.task_names() {
            let until_ms = self.plan_task(&task, &mut begin).await;
            if let Some(until_ms) = until_ms {
                let wait_ms = until_ms.saturating_sub(self.effects.now().boot_ms);
                wake = wake.min(Instant::now() + Duration::from_millis(wait_ms));
            }
        }
        // Written before any step begins. If the write fails, the plan sees steps that never began.
        let saved = self.save();
        if saved {
            self.retain_ordered_parts();
        } else {
            wake = wake.min(Instant::now() + LEDGER_RETRY);
        }
        for (task, step) in begin {
            if saved || self.is_removal(&task, &step) {
                self.begin(task, step);
            }
        }
        for under_way in self.under_way.values() {
            wake = under_way.drop_at.map_or(wake, |at| wake.min(at));
        }
        self.watch_processes();
        self.publish_report();
        wake
    }

    /// Whether the step ends something without a replacement. Such a step runs even when the ledger
    /// cannot be written: it may free the disk space, and an agent that has forgotten the step
    /// repeats it.
    fn is_removal(&self, task: &TaskName, step: &Step) -> bool {
        let is_wanted =
            self.desired_task(task).is_some_and(|desired| desired.wanted == TargetState::Running);
        matches!(step, Step::Stop(_) | Step::Remove) && !is_wanted
    }

    /// All tasks, in the order in which they get scarce resources.
    fn task_names(&self) -> Vec<TaskName> {
        let desired = self.desired.iter().flat_map(|state| &state.tasks);
        let desired = desired.map(|task| (task.task.clone(), task.priority));
        let known =
            self.ledger.tasks.iter().map(|(task, record)| (task.clone(), record.order.priority));
        let is_desired = |task: &TaskName| desired.clone().any(|(other, _)| other == *task);
        plan::by_priority(
            known.filter(|(task, _)| !is_desired(task)).chain(desired.clone()).collect(),
        )
    }

    /// The desired state of a task. Before any desired state is known, this is the order in the
    /// task's record.
    fn desired_task(&self, task: &TaskName) -> Option<DesiredTask> {
        match &self.desired {
            Some(state) => state.tasks.iter().find(|desired| desired.task == *task).cloned(),
            None => self.ledger.tasks.get(task).map(|record| record.order.clone()),
        }
    }

    /// Whether new work may be begun.
    fn may_begin(&self) -> bool {
        let wall_ms = self.effects.now().wall_ms;
        let in_force =
            self.desired.as_ref().is_none_or(|state| !admission::is_expired(state, wall_ms));
        in_force && !self.ledger.removed
    }

    async fn plan_task(
        &mut self,
        task: &TaskName,
        begin: &mut Vec<(TaskName, Step)>,
    ) -> Option<u64> {
        let desired = self.desired_task(task);
        if !self.ledger.tasks.contains_key(task) {
            let record = TaskRecord::new(desired.clone()?, self.effects.now().boot_ms);
            self.ledger.tasks.insert(task.clone(), record);
            self.dirty = true;
        }
        let mut until_ms: Option<u64> = None;
        for _ in 0..MAX_PLANNING_ROUNDS {
            let mut changed = false;
            until_ms = None;
            for lane in Lane::ALL {
                let planned =
                    |(other, step): &(TaskName, Step)| other == task && step.lane() == lane;
                if self.under_way.contains_key(&(task.clone(), lane)) || begin.iter().any(planned) {
                    continue;
                }
                self.observe(task).await;
                match self.next_step(task, lane, desired.as_ref(), begin) {
                    Next::Rest { until_ms: rest } => {
                        until_ms = [until_ms, rest].into_iter().flatten().min()
                    }
                    Next::Record(record) => {
                        self.store_record(task, *record);
                        changed = true;
                    }
                    Next::Act(step) if lane == Lane::Prepare && !self.has_free_slot(begin) => {
                        tracing::debug!(
                            step = plan::describe(task, &step),
                            "waiting for another task's step"
                        );
                    }
                    Next::Act(step) => {
                        let record = self.ledger.tasks.get(task)?;
                        let record =
                            plan::begin_step(record, &step, self.ledger.start, &self.moment());
                        // A start follows the record that was written before it.
                        let step = match (step, &record.active) {
                            (Step::Start(_), Some(active)) => Step::Start(Box::new(active.clone())),
                            (step, _) => step,
                        };
                        self.store_record(task, record);
                        begin.push((task.clone(), step));
                        changed = true;
                    }
                }
            }
            if !changed {
                return until_ms;
            }
        }
        tracing::error!(%task, "the plan does not converge");
        until_ms
    }

    fn next_step(
        &self,
        task: &TaskName,
        lane: Lane,
        desired: Option<&DesiredTask>,
        begin: &[(TaskName, Step)],
    ) -> Next {
        let planned = begin.iter().filter(|(other, _)| other == task).map(|(_, step)| step);
        let under_way = self.under_way.iter().filter(|((other, _), _)| other == task);
        let steps: Vec<&Step> =
            planned.chain(under_way.map(|(_, under_way)| &under_way.step)).collect();
        let (Some(record), Some(view)) = (self.ledger.tasks.get(task), self.views.get(task)) else {
            return Next::Rest { until_ms: None };
        };
        let (Some(prepared), Some(process)) = (&view.prepared, &view.process) else {
            return Next::Rest { until_ms: None };
        };
        let plan_input = PlanInput {
            desired,
            record,
            prepared,
            process,
            health: &view.health,
            under_way: &steps,
            robot: &self.robot,
            permissions: Permissions {
                may_begin: self.may_begin(),
                held: self.held,
                gated: self.effects.is_gated(),
            },
            at: self.moment(),
        };
        match lane {
            Lane::Run => plan::supervise(&plan_input),
            Lane::Prepare => plan::prepare(&plan_input),
            Lane::Gate => plan::check_gate(&plan_input),
            Lane::Upload => plan::upload(&plan_input),
        }
    }

    /// The moment of a decision.
    fn moment(&self) -> Moment<'_> {
        Moment {
            boot_id: &self.agent_identity.boot_id,
            now_ms: self.effects.now().boot_ms,
            jitter: rand::random(),
        }
    }

    /// Observes the disk and the process again where the last observation may be stale.
    async fn observe(&mut self, task: &TaskName) {
        let Some(record) = self.ledger.tasks.get(task) else { return };
        let view = self.views.entry(task.clone()).or_default();
        if view.prepared.is_none() {
            let prepared = self.effects.prepared(record.to_prepare().0).await;
            if self.robot.labels.is_none() && requires_labels(&prepared) {
                self.link_state.post.notify_one();
            }
            view.prepared = Some(prepared);
        }
        let is_due = match view.process {
            None => true,
            Some(ProcessState::Unknown) => {
                view.observe_again_at.is_none_or(|at| at <= Instant::now())
            }
            Some(_) => false,
        };
        if is_due {
            view.process = Some(match record.active.as_ref().and_then(ActiveRun::process) {
                Some(process) => self.effects.process(task, process).await,
                None => ProcessState::None,
            });
            view.observe_again_at = Some(Instant::now() + OBSERVE_AGAIN);
        }
        if let Some(ProcessState::Alive { pid }) = view.process {
            // An agent that died during the start did not record the process id.
            let known = record.active.as_ref().and_then(|active| active.process()?.pid);
            if known != Some(pid)
                && let Some(record) = self.ledger.tasks.get_mut(task)
            {
                record.change_active(|active| active.seen(pid));
                self.dirty = true;
            }
        }
    }

    /// Deletes the gathered parts of contents that are no longer needed or are already unpacked. A
    /// power cut may have brought such parts back.
    fn retain_ordered_parts(&mut self) {
        let is_there = |task| {
            self.views.get(task).and_then(|view| view.prepared.as_ref()).is_some_and(|p| p.content)
        };
        let ordered = self.ledger.tasks.iter().filter(|(task, record)| {
            record.order.wanted == TargetState::Running && !is_there(*task)
        });
        let wanted: Vec<Digest> =
            ordered.map(|(_, record)| record.to_prepare().0.content.digest).collect();
        if self.kept_parts.as_ref() != Some(&wanted) {
            self.effects.retain_parts(&wanted);
            self.kept_parts = Some(wanted);
        }
    }

    fn has_free_slot(&self, begin: &[(TaskName, Step)]) -> bool {
        let under_way = self.under_way.keys().filter(|(_, lane)| *lane == Lane::Prepare).count();
        let planned = begin.iter().filter(|(_, step)| step.lane() == Lane::Prepare).count();
        under_way + planned < self.effects.parallel_tasks()
    }

    /// Stores a changed record, and drops observations that belong to an earlier order or process.
    fn store_record(&mut self, task: &TaskName, record: TaskRecord) {
        let view = self.views.entry(task.clone()).or_default();
        let before = self.ledger.tasks.get(task);
        if before.map(|before| before.to_prepare().0) != Some(record.to_prepare().0) {
            view.prepared = None;
            view.progress.remove(&Lane::Prepare);
        }
        let process = |record: &TaskRecord| Some(record.active.as_ref()?.process()?.dir.clone());
        if before.and_then(process) != process(&record) {
            (view.process, view.process_watch, view.health) = (None, None, Health::Unknown);
        }
        self.ledger.tasks.insert(task.clone(), record);
        self.dirty = true;
    }

    fn tick(&mut self) {
        let trust = self.effects.trust_facts();
        if self.trust != trust {
            self.trust = trust;
            self.views.values_mut().for_each(|view| view.prepared = None);
        }
        for view in self.views.values_mut() {
            let known = view.transfers.iter().map(|(lane, transfer)| (*lane, *transfer.borrow()));
            view.progress.extend(known.filter(|(_, progress)| progress.total > 0));
        }
    }

    /// Writes the ledger if it changed. Returns whether the disk is up to date.
    fn save(&mut self) -> bool {
        if !self.dirty {
            return true;
        }
        match self.effects.write_ledger(&self.ledger) {
            Ok(()) => {
                self.dirty = false;
                self.observed = self
                    .ledger
                    .accepted
                    .as_ref()
                    .map_or(Generation(0), |accepted| accepted.generation);
                self.conditions.remove("ledger_unwritable");
            }
            Err(error) => {
                let text = chain(&error);
                if self.conditions.get("ledger_unwritable") != Some(&text) {
                    tracing::error!(
                        "cannot write the ledger; only stops and removals run until it can be written: {text}"
                    );
                }
                self.conditions.insert("ledger_unwritable", text);
            }
        }
        !self.dirty
    }
}

/// Whether the decision to run this version depends on the robot's labels. The labels come in the
/// server's answer to a posted report.
fn requires_labels(prepared: &Prepared) -> bool {
    prepared.manifest.as_ref().is_some_and(|manifest| !manifest.requires.labels.is_empty())
}

#[cfg(test)]
mod tests;
