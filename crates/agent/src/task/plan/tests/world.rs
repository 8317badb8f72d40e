//! The simulated world: one robot with one task, and events in any order. The world acts for the
//! agent exactly as the plan decides, and checks on the way that no job starts twice.

use proptest::prelude::*;
use task_proto::desired::{BlobRef, Delivery, PackageRef};
use task_proto::messages::report::{Failure, FailureCode};
use task_proto::packages::manifest::{
    Build, ContentFacts, Outputs, Ready, Requires, Run, TaskKind, TaskManifest,
};
use task_proto::{DeploymentId, Digest};

use crate::process::program::ExitStatus;
use crate::setup::installation::Installation;
use crate::task::observed::{Exit, Missing};
use crate::task::plan::*;
use crate::task::timing::Moment;

/// One robot with one task.
pub(super) struct World {
    pub(super) desired: Option<DesiredTask>,
    pub(super) record: Option<TaskRecord>,
    /// The live processes, by their directory.
    pub(super) alive: Vec<String>,
    /// The exit status of each ended process.
    ended: Vec<(String, Option<ExitStatus>)>,
    /// Versions on the disk, with the number of completed steps: manifest, content, build.
    pub(super) disk: Vec<(PackageRef, u8)>,
    /// The steps under way, and whether their effect has happened.
    pub(super) steps: Vec<(Step, bool)>,
    /// The (deployment, run) pair of every job process ever started.
    job_starts: Vec<(DeploymentId, u64)>,
    boot: u32,
    pub(super) start: u64,
    now_ms: u64,
    held: bool,
    may_begin: bool,
    pub(super) manifest: Run,
    ros_seen: bool,
    /// The health of the live process, unless its version is bad.
    pub(super) health: Health,
    /// The number of the package that never becomes ready.
    pub(super) bad: Option<u8>,
    pub(super) gated: bool,
    pub(super) outputs: Outputs,
    /// Whether the robot checks signatures, the versions with signatures on its disk, and whether
    /// these signatures suffice.
    pub(super) checks_signatures: bool,
    signatures: Vec<PackageRef>,
    signed: bool,
}

/// An event in the world.
#[derive(Debug, Clone)]
pub(super) enum WorldEvent {
    Order {
        deployment: u8,
        run: u64,
        stop: bool,
    },
    Withdraw,
    /// The effect of a step happens, well or badly; the agent does not know yet.
    Effect {
        succeeds: bool,
    },
    /// The server has no capacity for a pull and says when to come back.
    RetryLater {
        ms: u64,
    },
    /// A start finds changed files on the disk and deletes them.
    FindsChange,
    /// The agent learns of the ends of steps.
    Learn,
    ProcessEnds {
        code: i32,
    },
    ProcessVanishes,
    AgentDies,
    Reboot,
    Hold(bool),
    MayBegin(bool),
    /// Whether the signatures suffice from now on.
    Signed(bool),
    Gate(bool),
    Sees(HealthSample),
    Wait {
        ms: u64,
    },
}

/// An observation of the ROS graph.
#[derive(Debug, Clone, Copy)]
pub(super) enum HealthSample {
    Nothing,
    All,
    NotAll,
    Refused,
}

fn sample() -> impl Strategy<Value = HealthSample> {
    prop_oneof![1 => Just(HealthSample::Nothing), 4 => Just(HealthSample::All), 1 => Just(HealthSample::NotAll), 1 => Just(HealthSample::Refused)]
}

pub(super) fn health(sample: HealthSample, since_ms: u64) -> Health {
    match sample {
        HealthSample::Nothing => Health::Unknown,
        HealthSample::All => Health::Holds { since_ms },
        HealthSample::NotAll => Health::Missing(Missing {
            is_own_fault: true,
            since_ms,
            code: FailureCode::NODE_VANISHED,
            what: "`/mapper` is gone".to_owned(),
            seen: String::new(),
        }),
        HealthSample::Refused => {
            Health::Refused(Failure::new(FailureCode::NODE_NAME_TAKEN, "it was there before"))
        }
    }
}

pub(super) fn event() -> impl Strategy<Value = WorldEvent> {
    use WorldEvent::*;
    prop_oneof![
        4 => (0..3u8, 1..3u64, any::<bool>())
            .prop_map(|(deployment, run, stop)| Order { deployment, run, stop: stop && run == 2 }),
        1 => Just(Withdraw),
        8 => prop::bool::weighted(0.8).prop_map(|succeeds| Effect { succeeds }),
        2 => (0..90_000u64).prop_map(|ms| RetryLater { ms }),
        1 => Just(FindsChange),
        8 => Just(Learn),
        2 => (0..2i32).prop_map(|code| ProcessEnds { code }),
        1 => Just(ProcessVanishes),
        2 => Just(AgentDies),
        1 => Just(Reboot),
        1 => any::<bool>().prop_map(Hold),
        1 => any::<bool>().prop_map(MayBegin),
        1 => any::<bool>().prop_map(Signed),
        1 => any::<bool>().prop_map(Gate),
        3 => sample().prop_map(Sees),
        3 => (0..90_000u64).prop_map(|ms| Wait { ms }),
    ]
}

pub(super) fn package(number: u8) -> PackageRef {
    let blob = |kind: u8| BlobRef { digest: Digest::of(&[number, kind]), size: 1 };
    PackageRef {
        name: "talker".parse().expect("valid"),
        version: format!("1.{number}").parse().expect("valid"),
        manifest: blob(0),
        config: blob(1),
        content: blob(2),
    }
}

pub(super) fn order(
    deployment: u8,
    package_number: u8,
    run: u64,
    wanted: TargetState,
) -> DesiredTask {
    DesiredTask {
        task: "talker".parse().expect("valid"),
        deployment: format!("d{deployment:016x}").parse().expect("valid"),
        package: package(package_number),
        wanted,
        run,
        delivery: Delivery::PushPull,
        priority: 0,
    }
}

fn ros() -> Installation {
    Installation { packages: Some(["std_msgs".to_owned()].into()), ..Installation::default() }
}

impl World {
    pub(super) fn new(manifest: Run) -> Self {
        Self {
            desired: None,
            record: None,
            alive: Vec::new(),
            ended: Vec::new(),
            disk: Vec::new(),
            steps: Vec::new(),
            job_starts: Vec::new(),
            boot: 1,
            start: 1,
            now_ms: 1000,
            held: false,
            may_begin: true,
            ros_seen: false,
            manifest,
            health: Health::Holds { since_ms: 0 },
            bad: None,
            gated: false,
            outputs: Outputs::default(),
            checks_signatures: false,
            signatures: Vec::new(),
            signed: true,
        }
    }

    pub(super) fn apply(&mut self, event: WorldEvent) {
        match event {
            WorldEvent::Order { deployment, run, stop } => {
                let wanted = if stop { TargetState::Stopped } else { TargetState::Running };
                // A deployment is of one package.
                self.desired = Some(order(deployment, deployment % 2, run, wanted));
            }
            WorldEvent::Withdraw => self.desired = None,
            WorldEvent::Effect { succeeds } => self.effect(succeeds),
            WorldEvent::RetryLater { ms } => self.retry_later(ms),
            WorldEvent::Learn => self.learn(),
            WorldEvent::FindsChange => self.find_change(),
            WorldEvent::ProcessEnds { code } => self.end_process(Some(ExitStatus::Code(code))),
            WorldEvent::ProcessVanishes => self.end_process(None),
            WorldEvent::AgentDies => self.start_agent(self.boot),
            WorldEvent::Reboot => {
                self.end_process(None);
                self.now_ms = 1000;
                self.health = health(HealthSample::All, 0);
                self.start_agent(self.boot + 1);
            }
            WorldEvent::Hold(held) => self.held = held,
            WorldEvent::MayBegin(may_begin) => self.may_begin = may_begin,
            WorldEvent::Signed(signed) => self.signed = signed,
            WorldEvent::Gate(gated) => self.gated = gated,
            WorldEvent::Sees(sample) => self.health = health(sample, self.now_ms),
            WorldEvent::Wait { ms } => self.now_ms += ms,
        }
        self.plan();
    }

    fn start_agent(&mut self, boot: u32) {
        self.steps.clear();
        self.start += 1;
        let mut ledger = crate::task::ledger::Ledger::new(1);
        ledger.boot_id = self.boot.to_string();
        ledger.tasks.extend(self.record.take().map(|record| (record.order.task.clone(), record)));
        self.boot = boot;
        ledger.enter_boot(&self.boot.to_string(), self.now_ms);
        self.record = ledger.tasks.into_values().next();
    }

    fn end_process(&mut self, status: Option<ExitStatus>) {
        for dir in self.alive.drain(..) {
            self.ended.push((dir, status));
        }
    }

    /// The driver's loop: plans all lanes until they rest.
    pub(super) fn plan(&mut self) {
        let desired = self.desired.clone();
        // An interrupted step has no further effect; the driver waits for its end before beginning
        // another.
        self.steps.retain(|(step, _)| step.is_wanted(desired.as_ref(), self.record.as_ref()));
        if self.record.is_none() {
            self.record = desired.map(|order| TaskRecord::new(order, self.now_ms));
        }
        for round in 0.. {
            assert!(round < 20, "the plan does not come to rest: {:?}", self.record);
            let before = (self.record.clone(), self.steps.len());
            for lane in Lane::ALL {
                if self.record.is_none() || self.steps.iter().any(|(step, _)| step.lane() == lane) {
                    continue;
                }
                let next = self.with_plan_input(|s| match lane {
                    Lane::Run => supervise(s),
                    Lane::Prepare => prepare(s),
                    Lane::Gate => check_gate(s),
                    Lane::Upload => upload(s),
                });
                match next {
                    Next::Rest { .. } => {}
                    Next::Record(record) => self.record = Some(*record),
                    Next::Act(step) => self.begin(step),
                }
            }
            self.reads_back();
            if before == (self.record.clone(), self.steps.len()) {
                return;
            }
        }
    }

    /// The next agent finds each record as this one has written it.
    fn reads_back(&self) {
        let json = serde_json::to_value(&self.record).expect("json");
        assert_eq!(json["phase"], serde_json::json!(self.record.as_ref().map(TaskRecord::phase)));
        assert_eq!(serde_json::from_value::<Option<TaskRecord>>(json).expect("read"), self.record);
    }

    fn begin(&mut self, step: Step) {
        let record = self.record.as_ref().expect("a step is of a record");
        let new = match &step {
            Step::PullManifest(package)
            | Step::PullContent { package, .. }
            | Step::Build { package, .. } => Some(package),
            Step::Start(run)
                if record.active.as_ref().is_none_or(|active| !active.is_same(run)) =>
            {
                Some(&run.package)
            }
            _ => None,
        };
        let signatures =
            new.map_or(SignatureVerdict::Sufficient, |package| self.signature_verdict(package));
        assert_eq!(
            signatures,
            SignatureVerdict::Sufficient,
            "nobody trusted has signed what is begun: {step:?}"
        );
        let boot_id = self.boot.to_string();
        self.record = Some(begin_step(record, &step, self.start, &self.moment(&boot_id)));
        // The record written before a start fixes the content of the start.
        let step = match step {
            Step::Start(_) => Step::Start(Box::new(
                self.record.clone().and_then(|record| record.active).expect("begun"),
            )),
            other => other,
        };
        self.steps.push((step, false));
    }

    fn moment<'a>(&self, boot_id: &'a str) -> Moment<'a> {
        Moment { boot_id, now_ms: self.now_ms, jitter: 0.5 }
    }

    /// The number of completed steps of this version.
    fn level(&self, package: &PackageRef) -> u8 {
        self.disk.iter().find(|(on_disk, _)| on_disk == package).map_or(0, |(_, level)| *level)
    }

    /// The files of the version to prepare.
    fn prepared(&self, record: &TaskRecord) -> Prepared {
        let package = record.to_prepare().0;
        let level = self.level(package);
        Prepared {
            manifest: (level > 0).then(|| TaskManifest {
                outputs: self.outputs.clone(),
                ..manifest(&self.manifest)
            }),
            content: level > 1,
            built: level > 2,
            versions: self.disk.iter().map(|(package, _)| package.manifest.digest).collect(),
            signatures: self.signature_verdict(package),
        }
    }

    fn with_plan_input<T>(&self, ask: impl Fn(&PlanInput<'_>) -> T) -> T {
        let record = self.record.as_ref().expect("there is a record");
        let prepared = self.prepared(record);
        let process = match record.active.as_ref().and_then(ActiveRun::process) {
            None => ProcessState::None,
            Some(process) if self.alive.contains(&process.dir) => ProcessState::Alive { pid: 7 },
            Some(process) => match self.ended.iter().find(|(dir, _)| *dir == process.dir) {
                Some((_, status)) => ProcessState::Ended(Exit {
                    status: *status,
                    out_of_memory_bytes: None,
                    last_lines: String::new(),
                }),
                None => ProcessState::NeverStarted,
            },
        };
        let active = record.active.as_ref().map(|active| &active.package);
        let bad = self.bad.is_some_and(|number| active == Some(&package(number)));
        let health = if bad { health(HealthSample::NotAll, 0) } else { self.health.clone() };
        ask(&PlanInput {
            desired: self.desired.as_ref(),
            record,
            prepared: &prepared,
            process: &process,
            health: &health,
            under_way: &self.steps.iter().map(|(step, _)| step).collect::<Vec<_>>(),
            robot: &RobotFacts {
                installations: self.ros_seen.then(|| vec![ros()]),
                ..RobotFacts::default()
            },
            permissions: Permissions {
                may_begin: self.may_begin,
                held: self.held,
                gated: self.gated,
            },
            at: self.moment(&self.boot.to_string()),
        })
    }

    /// The agent learns of the end of a step.
    fn finish(&mut self, step: &Step, outcome: Outcome) {
        let record = self.record.as_ref().expect("a step is of a record");
        let (boot_id, kind) = (self.boot.to_string(), self.prepared(record).kind());
        self.record = Some(finish_step(record, step, outcome, kind, &self.moment(&boot_id)));
    }

    fn retry_later(&mut self, ms: u64) {
        let is_pull =
            |step: &Step| matches!(step, Step::PullManifest(_) | Step::PullContent { .. });
        let Some(at) = self.steps.iter().position(|(step, done)| !done && is_pull(step)) else {
            return;
        };
        let (step, _) = self.steps.remove(at);
        let before = self.record.clone().expect("a step is of a record").preparation;
        let told = Done::RetryLater { at_least_ms: ms };
        self.finish(&step, Ok(told));
        let after = &self.record.as_ref().expect("still").preparation;
        assert_eq!(
            (after.phase, after.attempts),
            (before.phase, before.attempts),
            "it counts as a try"
        );
        assert!(after.failure.is_none() && after.retry_at_ms >= self.now_ms.saturating_add(ms));
    }

    fn find_change(&mut self) {
        let start = |(step, done): &(Step, bool)| {
            if let (Step::Start(run), false) = (step, done) { Some(run.clone()) } else { None }
        };
        let Some((at, run)) =
            self.steps.iter().enumerate().find_map(|(at, step)| Some((at, start(step)?)))
        else {
            return;
        };
        let (step, _) = self.steps.remove(at);
        self.raise(&run.package, 1);
        self.refuse_start(&step);
    }

    fn refuse_start(&mut self, start: &Step) {
        let failure = Failure::new(FailureCode::TREE_CHANGED, "src was changed after unpacking");
        self.finish(start, Err(StepFailure { failure, retry_after_ms: Some(0) }));
    }

    fn effect(&mut self, succeeds: bool) {
        let Some((step, done)) = self.steps.iter_mut().find(|(_, done)| !done) else { return };
        *done = true;
        let step = step.clone();
        if !succeeds {
            self.steps.retain(|(other, _)| *other != step);
            let failure = Failure::new(FailureCode::IO_ERROR, "it went badly");
            return self.finish(&step, Err(StepFailure { failure, retry_after_ms: Some(0) }));
        }
        match &step {
            Step::CheckSigners(package) if self.signed => self.signatures.push(package.clone()),
            Step::CheckSigners(_) => {
                self.steps.retain(|(other, _)| *other != step);
                let failure = Failure::new(FailureCode::UNTRUSTED_PACKAGE, "nobody has signed it");
                self.finish(&step, Err(StepFailure { failure, retry_after_ms: None }));
            }
            Step::PullManifest(package) => self.raise(package, 1),
            Step::ProbeRos(_) => self.ros_seen = true,
            Step::QueryGate(_) => {}
            Step::UploadOutputs(files) => {
                assert!(
                    self.disk.iter().any(|(package, _)| *package == files.package),
                    "its files are gone"
                );
                let active = self.record.as_ref().and_then(|record| record.active.as_ref());
                let same = active.is_some_and(|run| {
                    run.deployment == files.deployment
                        && run.run == files.run
                        && run.process().is_some()
                });
                assert!(!same, "it still writes");
            }
            Step::PullContent { package, .. } => self.raise(package, 2),
            Step::Build { package, .. } => self.raise(package, 3),
            Step::Start(run) if self.level(&run.package) < 3 => {
                self.steps.retain(|(other, _)| *other != step);
                self.refuse_start(&step);
            }
            Step::Start(run) => {
                assert!(self.alive.is_empty(), "a second process of the task");
                let dir = run.process().expect("begun").dir.clone();
                assert!(
                    self.ended.iter().all(|(other, _)| *other != dir),
                    "a run directory is used twice"
                );
                self.alive.push(dir);
                if self.manifest.kind == TaskKind::Job {
                    let job = (run.deployment.clone(), run.run);
                    assert!(
                        self.manifest.idempotent || !self.job_starts.contains(&job),
                        "a job is started twice"
                    );
                    self.job_starts.push(job);
                }
            }
            Step::Stop(run) => {
                assert_eq!(
                    self.record.as_ref().and_then(|record| record.active.as_ref()),
                    Some(&**run)
                );
                let process = run.process().expect("a live run");
                self.alive.retain(|dir| *dir != process.dir);
                self.ended.push((process.dir.clone(), Some(ExitStatus::Signal(2))));
            }
            Step::Prune { kept } => {
                let active = self.record.as_ref().and_then(|record| record.active.as_ref());
                let fallback = self.record.as_ref().and_then(|record| record.fallback.as_ref());
                for run in [active, fallback].into_iter().flatten() {
                    assert!(
                        kept.contains(&run.package.manifest.digest),
                        "prunes a version that runs or may return"
                    );
                }
                self.disk.retain(|(package, _)| kept.contains(&package.manifest.digest));
            }
            Step::Remove => {
                assert!(self.alive.is_empty(), "removes a task that runs");
                self.disk.clear();
                // Removing the task removes its history and directories: the same order afterwards
                // is a new one.
                self.job_starts.clear();
                self.ended.clear();
            }
        }
    }

    fn signature_verdict(&self, package: &PackageRef) -> SignatureVerdict {
        let is_sufficient =
            !self.checks_signatures || (self.signed && self.signatures.contains(package));
        if is_sufficient { SignatureVerdict::Sufficient } else { SignatureVerdict::Insufficient }
    }

    fn raise(&mut self, package: &PackageRef, level: u8) {
        self.disk.retain(|(on_disk, _)| on_disk != package);
        self.disk.push((package.clone(), level));
    }

    fn learn(&mut self) {
        let (done, under_way) =
            std::mem::take(&mut self.steps).into_iter().partition(|(_, done)| *done);
        self.steps = under_way;
        for (step, _) in done {
            if step == Step::Remove {
                self.record = None;
            } else {
                self.finish(&step, Ok(Done::Started(7)));
            }
        }
    }

    /// Lets every step succeed until no work is left.
    pub(super) fn settle(&mut self) {
        self.apply(WorldEvent::Hold(false));
        self.apply(WorldEvent::MayBegin(true));
        self.apply(WorldEvent::Signed(true));
        self.health = health(HealthSample::All, 0);
        for _ in 0..60 {
            self.apply(WorldEvent::Effect { succeeds: true });
            self.apply(WorldEvent::Learn);
            self.apply(WorldEvent::Wait { ms: 400_000 });
        }
        assert!(self.steps.is_empty(), "still under way: {:?}", self.steps);
    }
}

pub(super) fn manifest(run: &Run) -> TaskManifest {
    TaskManifest {
        name: "talker".parse().expect("valid"),
        version: "1.0".parse().expect("valid"),
        build: Build::default(),
        run: run.clone(),
        ready: Ready::default(),
        parameters: Default::default(),
        outputs: Outputs::default(),
        requires: Requires::default(),
        limits: task_proto::packages::manifest::Limits::default(),
        exec_depends: vec!["std_msgs".to_owned()],
        content: ContentFacts { tar_digest: Digest::of(b""), tar_size: 0, entries: 0 },
    }
}
