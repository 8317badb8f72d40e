//! The driver: the one task that owns the ledger. It asks the plan for each task's next step,
//! writes the ledger, lets the step run, and reports what changed. It decides nothing about tasks
//! and does nothing to the robot itself: that is the plan's and the effects' work.
//!
//! Steps run as tasks of their own and send back only that they ended, so nothing here is ever
//! waited for long; a step that is no longer wanted is told so and, if it does not end, dropped.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;
use std::time::Duration;

use task_proto::desired::{DesiredState, DesiredTask, Wanted};
use task_proto::envelope::PublicKey;
use task_proto::id::Labels;
use task_proto::report::{Condition, Progress};
use task_proto::{Digest, Generation, InstanceId, RobotId, RobotName, TaskName};
use tokio::sync::{Notify, mpsc, watch};
use tokio::task::{AbortHandle, JoinSet};
use tokio::time::Instant;
use tokio_util::sync::{CancellationToken, DropGuard};

use crate::link::state::{Heard, Shared};
use crate::reconcile::admission;
use crate::system::error_chain::chain;
use crate::task::effects::{Effects, Now};
use crate::task::ledger::{Ledger, TaskRecord};
use crate::task::observed::{Health, Prepared, ProcessState, RobotFacts, TrustFacts, Vouched};
use crate::task::plan::{self, Done, Lane, Next, Situation, Step, StepFailure};
use crate::transfer::parts::Asks;

mod hearing;
mod reporting;
mod steps;
mod watching;

/// How often the hold flag is looked at, were there nothing else to do, and progress is reported.
const TICK: Duration = Duration::from_secs(1);
/// When to try again after the ledger could not be written.
const LEDGER_RETRY: Duration = Duration::from_secs(5);
/// When to look again at a process of which nothing could be told.
const LOOK_AGAIN: Duration = Duration::from_millis(plan::LOOK_AGAIN_MS);
/// More turns than this for one task mean that the plan goes in circles.
const MAX_TURNS: u32 = 64;
/// What watchers have seen and the driver has not taken yet; beyond it they wait.
const MAX_SIGHTS: usize = 16;

/// What is known of a disk that nobody has looked at.
static NOTHING_PREPARED: Prepared = Prepared {
    manifest: None,
    content: false,
    built: false,
    versions: Vec::new(),
    vouched: Vouched::No,
};

/// Who the driver speaks for.
#[derive(Debug, Clone)]
pub struct Speaker {
    /// The robot.
    pub robot_id: RobotId,
    /// The key its desired states are signed with.
    pub server_key: PublicKey,
    /// This start of the agent.
    pub instance: InstanceId,
    /// Where it runs.
    pub place: Option<Digest>,
    /// The kernel's boot id.
    pub boot_id: String,
    /// The name the robot gives itself.
    pub name: Option<RobotName>,
    /// The labels it gives itself.
    pub labels: Option<Labels>,
}

/// What the driver has seen of one task; lost at a restart.
#[derive(Default)]
struct View {
    /// What is on the disk of the ordered version; `None` when that must be looked at.
    prepared: Option<Prepared>,
    /// What became of the active run's process; `None` likewise.
    process: Option<ProcessState>,
    /// When to look at it again, should nothing have been told of it: a look may take long, and all
    /// tasks wait for it.
    look_again: Option<Instant>,
    /// Who looks at that process.
    watched: Option<Watched>,
    /// What ROS says of it.
    health: Health,
    /// How far the transfers under way have come, by lane.
    transfers: BTreeMap<Lane, watch::Receiver<Progress>>,
    /// The same, as it is reported.
    progress: BTreeMap<Lane, Progress>,
    /// What the step that gathers parts says of those that are lacking.
    asked: Option<watch::Receiver<Asks>>,
    /// What was last not stopped or deleted, and why. It is tried again.
    undone: Option<String>,
}

/// The watchers of one process. Dropping it ends the one that asks ROS.
struct Watched {
    /// The run directory's name.
    dir: String,
    _until_dropped: DropGuard,
}

/// What a watcher has seen of the process of a run directory.
struct Seen {
    task: TaskName,
    dir: String,
    what: Sight,
}

/// What can be seen of a process.
enum Sight {
    /// It has ended, or is not watched any more.
    Over,
    /// What ROS says of it now.
    Health(Health),
}

/// A step under way.
struct UnderWay {
    step: Step,
    handle: AbortHandle,
    cancel: CancellationToken,
    /// When it is dropped, once it was told to end.
    drop_at: Option<Instant>,
}

type Outcome = Result<Done, StepFailure>;

/// The driver of one robot.
pub struct Driver<E> {
    effects: Arc<E>,
    speaker: Speaker,
    shared: Shared,
    ledger: Ledger,
    /// The ledger has changes that are not on the disk.
    dirty: bool,
    /// Of the accepted state that is on the disk: what was accepted and is forgotten by a power cut
    /// must be sent again.
    observed: Generation,
    desired: Option<DesiredState>,
    views: BTreeMap<TaskName, View>,
    under_way: HashMap<(TaskName, Lane), UnderWay>,
    steps: JoinSet<(TaskName, Lane, Outcome)>,
    /// Where watchers put what they see.
    sights: mpsc::Sender<Seen>,
    seen: mpsc::Receiver<Seen>,
    robot: RobotFacts,
    /// What was last gone by when it was looked who has signed the packages.
    trust: TrustFacts,
    held: bool,
    /// Conditions by code; those that follow from other fields are not in it.
    conditions: BTreeMap<&'static str, String>,
    /// What the server withholds, in its words.
    withheld: Option<Condition>,
    /// The contents whose gathered bytes were kept when they were last gone through; `None`: they
    /// are to be.
    kept_parts: Option<Vec<Digest>>,
    /// Notified when parts that are lacking are to be asked for.
    asks: Arc<Notify>,
    /// Whether they are to be, although the last report may have said the same.
    asks_again: bool,
    seq: u64,
    started: Instant,
}

impl<E: Effects> Driver<E> {
    /// The driver that goes on from `ledger`, which the caller has not counted this start in.
    /// `lost` says that and where an earlier ledger was moved.
    pub async fn new(
        effects: Arc<E>,
        speaker: Speaker,
        shared: Shared,
        mut ledger: Ledger,
        lost: Option<String>,
    ) -> Self {
        let now = effects.now();
        ledger.start += 1;
        ledger.enter_boot(&speaker.boot_id, now.boot_ms);
        let mut conditions = BTreeMap::new();
        if let Some(text) = lost {
            for (task, run) in effects.survivors().await {
                ledger.tasks.insert(task.clone(), TaskRecord::of_survivor(task, run, now.boot_ms));
            }
            conditions.insert("ledger_rebuilt", text);
        }
        let mut desired = None;
        if let Some(accepted) = &ledger.accepted {
            match admission::open(&accepted.envelope, &speaker.server_key, &speaker.robot_id) {
                Ok(state) => desired = Some(state),
                // The robot was registered anew: the tasks go on as they are until the new server
                // has spoken.
                Err(error) => {
                    tracing::warn!(error = %chain(&error), "the state in the ledger is not this server's");
                    ledger.accepted = None;
                }
            }
        }
        // Which ROS there is is looked at when it is needed.
        let robot = RobotFacts { installations: None, ..effects.robot_facts() };
        let (sights, seen) = mpsc::channel(MAX_SIGHTS);
        let held = effects.is_held();
        desired.iter().for_each(|state| effects.heed(state));
        let trust = effects.trust_facts();
        Self {
            effects,
            speaker,
            shared,
            ledger,
            dirty: true,
            observed: Generation(0),
            desired,
            views: BTreeMap::new(),
            under_way: HashMap::new(),
            steps: JoinSet::new(),
            sights,
            seen,
            robot,
            trust,
            held,
            conditions,
            withheld: None,
            kept_parts: None,
            asks: Arc::default(),
            asks_again: false,
            seq: 0,
            started: Instant::now(),
        }
    }

    /// Drives until the agent ends. Steps under way are dropped then, tasks go on running.
    pub async fn run(mut self, mut heard: mpsc::Receiver<Heard>) {
        let mut tick = tokio::time::interval(TICK);
        loop {
            let wake = self.turn().await;
            tokio::select! {
                // Cancel-safe: a step that has ended stays in the set until it is taken.
                Some(ended) = self.steps.join_next_with_id() => self.step_ended(ended),
                // Cancel-safe: a message stays in its channel until it is received.
                Some(seen) = self.seen.recv() => self.see(seen),
                // Cancel-safe: likewise.
                Some(message) = heard.recv() => self.hear(message),
                // Cancel-safe: a permit that was not taken stays.
                () = self.asks.notified() => self.asks_again = true,
                // Cancel-safe: an interval keeps its own time.
                _ = tick.tick() => self.tick(),
                // Cancel-safe: a timer that is made anew each time.
                () = tokio::time::sleep_until(wake) => {}
                // Cancel-safe: a token can be awaited again.
                () = self.shared.shutdown.cancelled() => break,
            }
        }
        self.save();
    }

    /// Plans every task until all rest, begins what is to be done, reports. Gives the time of the
    /// next turn.
    async fn turn(&mut self) -> Instant {
        // Looked at before each turn: after `hold` nothing may be started any more.
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
        // Written before anything is done: if that fails the plan sees steps that never began.
        let saved = self.save();
        if saved {
            self.keep_ordered_parts();
        } else {
            wake = wake.min(Instant::now() + LEDGER_RETRY);
        }
        for (task, step) in begin {
            if saved || self.only_takes_away(&task, &step) {
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

    /// Whether the step ends something and nothing is to come in its place. It is done also where
    /// nothing can be written: it may be what makes room, and an agent that has forgotten it does
    /// it again.
    fn only_takes_away(&self, task: &TaskName, step: &Step) -> bool {
        let is_wanted =
            self.desired_task(task).is_some_and(|desired| desired.wanted == Wanted::Running);
        matches!(step, Step::Stop(_) | Step::Remove) && !is_wanted
    }

    /// All tasks, in the order in which they get what not all can have at once.
    fn task_names(&self) -> Vec<TaskName> {
        let desired = self.desired.iter().flat_map(|state| &state.tasks);
        let desired = desired.map(|task| (task.task.clone(), task.priority));
        let known =
            self.ledger.tasks.iter().map(|(task, record)| (task.clone(), record.order.priority));
        let is_desired = |task: &TaskName| desired.clone().any(|(other, _)| other == *task);
        plan::in_turn(known.filter(|(task, _)| !is_desired(task)).chain(desired.clone()).collect())
    }

    /// What is desired of a task. Before any desired state is known, what its record was ordered to
    /// be.
    fn desired_task(&self, task: &TaskName) -> Option<DesiredTask> {
        match &self.desired {
            Some(state) => state.tasks.iter().find(|desired| desired.task == *task).cloned(),
            None => self.ledger.tasks.get(task).map(|record| record.order.clone()),
        }
    }

    /// Whether new work may be begun.
    fn may_begin(&self, now: Now) -> bool {
        let in_force =
            self.desired.as_ref().is_none_or(|state| !admission::is_expired(state, now.wall_ms));
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
        for _ in 0..MAX_TURNS {
            let mut changed = false;
            until_ms = None;
            for lane in Lane::ALL {
                let planned =
                    |(other, step): &(TaskName, Step)| other == task && step.lane() == lane;
                if self.under_way.contains_key(&(task.clone(), lane)) || begin.iter().any(planned) {
                    continue;
                }
                self.observe(task).await;
                match self.ask(task, lane, desired.as_ref(), begin) {
                    Next::Rest { until_ms: rest } => {
                        until_ms = [until_ms, rest].into_iter().flatten().min()
                    }
                    Next::Record(record) => {
                        self.put(task, *record);
                        changed = true;
                    }
                    Next::Act(step) if lane == Lane::Prepare && !self.has_room(begin) => {
                        tracing::debug!(
                            step = plan::describe(task, &step),
                            "waits for another task's step"
                        );
                    }
                    Next::Act(step) => {
                        let record = self.ledger.tasks.get(task)?;
                        let (boot_id, start) = (&self.speaker.boot_id, self.ledger.start);
                        let record =
                            plan::begun(record, &step, boot_id, start, self.effects.now().boot_ms);
                        // A start does what the record written before it says.
                        let step = match (step, &record.active) {
                            (Step::Start(_), Some(active)) => Step::Start(Box::new(active.clone())),
                            (step, _) => step,
                        };
                        self.put(task, record);
                        begin.push((task.clone(), step));
                        changed = true;
                    }
                }
            }
            if !changed {
                return until_ms;
            }
        }
        tracing::error!(%task, "the plan goes in circles");
        until_ms
    }

    fn ask(
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
        let rest = Next::Rest { until_ms: None };
        let Some(view) =
            self.views.get(task).filter(|view| view.prepared.is_some() && view.process.is_some())
        else {
            return rest;
        };
        self.situation(task, view, desired, &steps).map_or(rest, |situation| match lane {
            Lane::Run => plan::supervise(&situation),
            Lane::Prepare => plan::prepare(&situation),
            Lane::Gate => plan::consult(&situation),
            Lane::Collect => plan::collect(&situation),
        })
    }

    /// All that the plan is to know of `task`, while `steps` are under way.
    fn situation<'a>(
        &'a self,
        task: &TaskName,
        view: &'a View,
        desired: Option<&'a DesiredTask>,
        steps: &[&Step],
    ) -> Option<Situation<'a>> {
        let now = self.effects.now();
        Some(Situation {
            desired,
            record: self.ledger.tasks.get(task)?,
            prepared: view.prepared.as_ref().unwrap_or(&NOTHING_PREPARED),
            process: view.process.as_ref().unwrap_or(&ProcessState::None),
            health: &view.health,
            preparing: steps.iter().any(|step| step.lane() == Lane::Prepare),
            acting: steps.iter().any(|step| step.lane() == Lane::Run),
            collecting: steps.iter().any(|step| step.lane() == Lane::Collect),
            deleting: steps.iter().any(|step| step.deletes()),
            robot: &self.robot,
            may_begin: self.may_begin(now),
            held: self.held,
            gated: self.effects.is_gated(),
            boot_id: &self.speaker.boot_id,
            now_ms: now.boot_ms,
            jitter: rand::random(),
        })
    }

    /// Looks at whatever is not known to be as it was.
    async fn observe(&mut self, task: &TaskName) {
        let Some(record) = self.ledger.tasks.get(task) else { return };
        let view = self.views.entry(task.clone()).or_default();
        if view.prepared.is_none() {
            let prepared = self.effects.prepared(&record.order.package).await;
            if self.robot.labels.is_none() && requires_labels(&prepared) {
                self.shared.post.notify_one();
            }
            view.prepared = Some(prepared);
        }
        let is_due = match view.process {
            None => true,
            Some(ProcessState::Unknown) => view.look_again.is_none_or(|at| at <= Instant::now()),
            Some(_) => false,
        };
        if is_due {
            view.process =
                Some(match record.active.as_ref().and_then(|active| active.process.as_ref()) {
                    Some(process) => self.effects.process(task, process).await,
                    None => ProcessState::None,
                });
            view.look_again = Some(Instant::now() + LOOK_AGAIN);
        }
        if let Some(ProcessState::Alive { pid }) = view.process {
            // An agent that died during the start did not write it down.
            let record = self
                .ledger
                .tasks
                .get_mut(task)
                .and_then(|record| record.active.as_mut()?.process.as_mut());
            if let Some(process) = record.filter(|process| process.pid != Some(pid)) {
                process.pid = Some(pid);
                self.dirty = true;
            }
        }
    }

    /// Deletes what was gathered of contents that are no longer ordered, or that are in their
    /// place: a power cut may have brought it back.
    fn keep_ordered_parts(&mut self) {
        let is_there = |task| {
            self.views.get(task).and_then(|view| view.prepared.as_ref()).is_some_and(|p| p.content)
        };
        let ordered =
            self.ledger.tasks.iter().filter(|(task, record)| {
                record.order.wanted == Wanted::Running && !is_there(*task)
            });
        let wanted: Vec<Digest> =
            ordered.map(|(_, record)| record.order.package.content.digest).collect();
        if self.kept_parts.as_ref() != Some(&wanted) {
            self.effects.keep_parts(&wanted);
            self.kept_parts = Some(wanted);
        }
    }

    fn has_room(&self, begin: &[(TaskName, Step)]) -> bool {
        let under_way = self.under_way.keys().filter(|(_, lane)| *lane == Lane::Prepare).count();
        let planned = begin.iter().filter(|(_, step)| step.lane() == Lane::Prepare).count();
        under_way + planned < self.effects.parallel_tasks()
    }

    /// Takes a changed record; what was seen under another order or process is forgotten.
    fn put(&mut self, task: &TaskName, record: TaskRecord) {
        let view = self.views.entry(task.clone()).or_default();
        let before = self.ledger.tasks.get(task);
        let package = |record: &TaskRecord| record.order.package.clone();
        if before.map(package).as_ref() != Some(&record.order.package) {
            view.prepared = None;
            view.progress.remove(&Lane::Prepare);
        }
        let process =
            |record: &TaskRecord| Some(record.active.as_ref()?.process.as_ref()?.dir.clone());
        if before.and_then(process) != process(&record) {
            (view.process, view.watched, view.health) = (None, None, Health::Unknown);
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

    /// Writes the ledger if it changed; whether what it says is on the disk.
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
                        "nothing but what was ordered to end is done until the ledger can be written: {text}"
                    );
                }
                self.conditions.insert("ledger_unwritable", text);
            }
        }
        !self.dirty
    }
}

/// Whether the robot's labels, which the server's answer to a posted report says, decide if it can
/// run this.
fn requires_labels(prepared: &Prepared) -> bool {
    prepared.manifest.as_ref().is_some_and(|manifest| !manifest.requires.labels.is_empty())
}

#[cfg(test)]
mod tests;
