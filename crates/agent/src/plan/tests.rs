//! Properties of the plan, shown in a small simulated world: whatever happens in whatever order, no job runs twice, no
//! task has two processes, what is not wanted is interrupted, and once it is quiet everything converges.

use proptest::prelude::*;
use task_proto::desired::{BlobRef, Delivery};
use task_proto::manifest::{
    Build, ContentFacts, OnBoot, Outputs, Ready, Requires, Restart, Run, TaskKind, TaskManifest,
};
use task_proto::report::{Failure, FailureCode, Phase};
use task_proto::{DeploymentId, Digest};

use super::*;
use crate::installation::Installation;
use crate::ledger::GateStep;
use crate::observed::{Exit, Missing};
use crate::process::ExitStatus;

/// One robot with one task.
struct World {
    desired: Option<DesiredTask>,
    record: Option<TaskRecord>,
    /// The processes that live, by their directory.
    alive: Vec<String>,
    /// How those ended that do not.
    ended: Vec<(String, Option<ExitStatus>)>,
    /// Versions whose manifest, content and build are there.
    disk: Vec<(PackageRef, u8)>,
    /// The steps under way, with whether their effect has happened.
    steps: Vec<(Step, bool)>,
    /// (deployment, run) of every process of a job that was ever started.
    job_starts: Vec<(DeploymentId, u64)>,
    boot: u32,
    start: u64,
    now_ms: u64,
    held: bool,
    may_begin: bool,
    manifest: Run,
    ros_seen: bool,
    /// What ROS says of the process that lives, unless its version is bad.
    health: Health,
    /// The number of the package that never gets ready.
    bad: Option<u8>,
    gated: bool,
    outputs: Outputs,
}

/// What can happen.
#[derive(Debug, Clone)]
enum Happening {
    Order {
        deployment: u8,
        run: u64,
        stop: bool,
    },
    Withdraw,
    /// The effect of a step happens, well or badly; the agent does not know it yet.
    Effect {
        well: bool,
    },
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
    Gate(bool),
    Sees(Sight),
    Wait {
        ms: u64,
    },
}

/// What ROS can be seen to say.
#[derive(Debug, Clone, Copy)]
enum Sight {
    Nothing,
    All,
    NotAll,
    Refused,
}

fn sight() -> impl Strategy<Value = Sight> {
    prop_oneof![1 => Just(Sight::Nothing), 4 => Just(Sight::All), 1 => Just(Sight::NotAll), 1 => Just(Sight::Refused)]
}

fn health(sight: Sight, since_ms: u64) -> Health {
    match sight {
        Sight::Nothing => Health::Unknown,
        Sight::All => Health::Holds { since_ms },
        Sight::NotAll => Health::Missing(Missing {
            since_ms,
            code: FailureCode::NODE_VANISHED,
            what: "`/mapper` is gone".to_owned(),
            seen: String::new(),
        }),
        Sight::Refused => Health::Refused(Failure::new(FailureCode::NODE_NAME_TAKEN, "it was there before")),
    }
}

fn happening() -> impl Strategy<Value = Happening> {
    use Happening::*;
    prop_oneof![
        4 => (0..3u8, 1..3u64, any::<bool>())
            .prop_map(|(deployment, run, stop)| Order { deployment, run, stop: stop && run == 2 }),
        1 => Just(Withdraw),
        8 => prop::bool::weighted(0.8).prop_map(|well| Effect { well }),
        8 => Just(Learn),
        2 => (0..2i32).prop_map(|code| ProcessEnds { code }),
        1 => Just(ProcessVanishes),
        2 => Just(AgentDies),
        1 => Just(Reboot),
        1 => any::<bool>().prop_map(Hold),
        1 => any::<bool>().prop_map(MayBegin),
        1 => any::<bool>().prop_map(Gate),
        3 => sight().prop_map(Sees),
        3 => (0..90_000u64).prop_map(|ms| Wait { ms }),
    ]
}

fn package(number: u8) -> PackageRef {
    let blob = |kind: u8| BlobRef { digest: Digest::of(&[number, kind]), size: 1 };
    PackageRef {
        name: "talker".parse().expect("valid"),
        version: format!("1.{number}").parse().expect("valid"),
        manifest: blob(0),
        config: blob(1),
        content: blob(2),
    }
}

fn order(deployment: u8, package_number: u8, run: u64, wanted: Wanted) -> DesiredTask {
    DesiredTask {
        task: "talker".parse().expect("valid"),
        deployment: format!("d{deployment:016x}").parse().expect("valid"),
        package: package(package_number),
        wanted,
        run,
        delivery: Delivery::PushPull,
    }
}

fn ros() -> Installation {
    Installation { packages: Some(["std_msgs".to_owned()].into()), ..Installation::default() }
}

impl World {
    fn new(manifest: Run) -> Self {
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
        }
    }

    fn happen(&mut self, happening: Happening) {
        match happening {
            Happening::Order { deployment, run, stop } => {
                let wanted = if stop { Wanted::Stopped } else { Wanted::Running };
                // A deployment is of one package.
                self.desired = Some(order(deployment, deployment % 2, run, wanted));
            }
            Happening::Withdraw => self.desired = None,
            Happening::Effect { well } => self.effect(well),
            Happening::Learn => self.learn(),
            Happening::ProcessEnds { code } => self.end_process(Some(ExitStatus::Code(code))),
            Happening::ProcessVanishes => self.end_process(None),
            Happening::AgentDies => self.start_agent(self.boot),
            Happening::Reboot => {
                self.end_process(None);
                self.now_ms = 1000;
                self.health = health(Sight::All, 0);
                self.start_agent(self.boot + 1);
            }
            Happening::Hold(held) => self.held = held,
            Happening::MayBegin(may_begin) => self.may_begin = may_begin,
            Happening::Gate(gated) => self.gated = gated,
            Happening::Sees(sight) => self.health = health(sight, self.now_ms),
            Happening::Wait { ms } => self.now_ms += ms,
        }
        self.plan();
    }

    fn start_agent(&mut self, boot: u32) {
        self.steps.clear();
        self.start += 1;
        let mut ledger = crate::ledger::Ledger::new(1);
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

    /// The driver's loop: plans both lanes until they rest.
    fn plan(&mut self) {
        let desired = self.desired.clone();
        // An interrupted step has no further effect; the driver waits for that before it begins another.
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
                let next = self.with_situation(|s| match lane {
                    Lane::Run => supervise(s),
                    Lane::Prepare => prepare(s),
                    Lane::Gate => consult(s),
                    Lane::Collect => collect(s),
                });
                match next {
                    Next::Rest { .. } => {}
                    Next::Record(record) => self.record = Some(*record),
                    Next::Act(step) => self.begin(step),
                }
            }
            if before == (self.record.clone(), self.steps.len()) {
                return;
            }
        }
    }

    fn begin(&mut self, step: Step) {
        let record = self.record.as_ref().expect("a step is of a record");
        self.record = Some(begun(record, &step, &self.boot.to_string(), self.start, self.now_ms));
        // What a start will do is fixed by the record written before it.
        let step = match step {
            Step::Start(_) => {
                Step::Start(Box::new(self.record.clone().and_then(|record| record.active).expect("begun")))
            }
            other => other,
        };
        self.steps.push((step, false));
    }

    fn with_situation<T>(&self, ask: impl Fn(&Situation<'_>) -> T) -> T {
        let record = self.record.as_ref().expect("there is a record");
        let level =
            self.disk.iter().find(|(on_disk, _)| *on_disk == record.order.package).map_or(0, |(_, level)| *level);
        let prepared = Prepared {
            manifest: (level > 0).then(|| TaskManifest { outputs: self.outputs.clone(), ..manifest(&self.manifest) }),
            content: level > 1,
            built: level > 2,
            versions: self.disk.iter().map(|(package, _)| package.manifest.digest).collect(),
        };
        let process = match record.active.as_ref().and_then(|active| active.process.as_ref()) {
            None => ProcessState::None,
            Some(process) if self.alive.contains(&process.dir) => ProcessState::Alive { pid: 7 },
            Some(process) => match self.ended.iter().find(|(dir, _)| *dir == process.dir) {
                Some((_, status)) => {
                    ProcessState::Ended(Exit { status: *status, out_of_memory_bytes: None, last_lines: String::new() })
                }
                None => ProcessState::NeverStarted,
            },
        };
        let active = record.active.as_ref().map(|active| &active.package);
        let bad = self.bad.is_some_and(|number| active == Some(&package(number)));
        let health = if bad { health(Sight::NotAll, 0) } else { self.health.clone() };
        ask(&Situation {
            desired: self.desired.as_ref(),
            record,
            prepared: &prepared,
            process: &process,
            health: &health,
            preparing: self.steps.iter().any(|(step, _)| step.lane() == Lane::Prepare),
            acting: self.steps.iter().any(|(step, _)| step.lane() == Lane::Run),
            collecting: self.steps.iter().any(|(step, _)| step.lane() == Lane::Collect),
            deleting: self.steps.iter().any(|(step, _)| step.deletes()),
            robot: &RobotFacts { installations: self.ros_seen.then(|| vec![ros()]), ..RobotFacts::default() },
            may_begin: self.may_begin,
            held: self.held,
            gated: self.gated,
            boot_id: &self.boot.to_string(),
            now_ms: self.now_ms,
            jitter: 0.5,
        })
    }

    fn effect(&mut self, well: bool) {
        let Some((step, done)) = self.steps.iter_mut().find(|(_, done)| !done) else { return };
        *done = true;
        let step = step.clone();
        if !well {
            self.steps.retain(|(other, _)| *other != step);
            let failure = Failure::new(FailureCode::IO_ERROR, "it went badly");
            let error = StepFailure { failure, retry_after_ms: Some(0) };
            self.record = Some(self.with_situation(|s| finished(s, &step, Err(error.clone()))));
            return;
        }
        match &step {
            Step::PullManifest(package) => self.raise(package, 1),
            Step::LookForRos(_) => self.ros_seen = true,
            Step::Ask(_) => {}
            Step::Collect(files) => {
                assert!(self.disk.iter().any(|(package, _)| *package == files.package), "its files are gone");
                let active = self.record.as_ref().and_then(|record| record.active.as_ref());
                let same = active.is_some_and(|run| {
                    run.deployment == files.deployment && run.run == files.run && run.process.is_some()
                });
                assert!(!same, "it still writes");
            }
            Step::PullContent(package) => self.raise(package, 2),
            Step::Build(package) => self.raise(package, 3),
            Step::Start(run) => {
                assert!(self.alive.is_empty(), "a second process of the task");
                let dir = run.process.as_ref().expect("begun").dir.clone();
                assert!(self.ended.iter().all(|(other, _)| *other != dir), "a run directory is used twice");
                self.alive.push(dir);
                if self.manifest.kind == TaskKind::Job {
                    let job = (run.deployment.clone(), run.run);
                    assert!(self.manifest.idempotent || !self.job_starts.contains(&job), "a job is started twice");
                    self.job_starts.push(job);
                }
            }
            Step::Stop(run) => {
                assert_eq!(self.record.as_ref().and_then(|record| record.active.as_ref()), Some(&**run));
                let process = run.process.as_ref().expect("what lives");
                self.alive.retain(|dir| *dir != process.dir);
                self.ended.push((process.dir.clone(), Some(ExitStatus::Signal(2))));
            }
            Step::Prune { kept } => {
                let active = self.record.as_ref().and_then(|record| record.active.as_ref());
                let fallback = self.record.as_ref().and_then(|record| record.fallback.as_ref());
                for run in [active, fallback].into_iter().flatten() {
                    assert!(kept.contains(&run.package.manifest.digest), "prunes what runs or may come back");
                }
                self.disk.retain(|(package, _)| kept.contains(&package.manifest.digest));
            }
            Step::Remove => {
                assert!(self.alive.is_empty(), "removes a task that runs");
                self.disk.clear();
                // With the task its history and directories go: the same order afterwards is a new one.
                self.job_starts.clear();
                self.ended.clear();
            }
        }
    }

    fn raise(&mut self, package: &PackageRef, level: u8) {
        self.disk.retain(|(on_disk, _)| on_disk != package);
        self.disk.push((package.clone(), level));
    }

    fn learn(&mut self) {
        let (done, under_way) = std::mem::take(&mut self.steps).into_iter().partition(|(_, done)| *done);
        self.steps = under_way;
        for (step, _) in done {
            if step == Step::Remove {
                self.record = None;
            } else {
                self.record = Some(self.with_situation(|s| finished(s, &step, Ok(Some(7)))));
            }
        }
    }

    /// Lets everything go well until nothing is left to do.
    fn settle(&mut self) {
        self.happen(Happening::Hold(false));
        self.happen(Happening::MayBegin(true));
        self.health = health(Sight::All, 0);
        for _ in 0..60 {
            self.happen(Happening::Effect { well: true });
            self.happen(Happening::Learn);
            self.happen(Happening::Wait { ms: 400_000 });
        }
        assert!(self.steps.is_empty(), "still under way: {:?}", self.steps);
    }
}

fn manifest(run: &Run) -> TaskManifest {
    TaskManifest {
        name: "talker".parse().expect("valid"),
        version: "1.0".parse().expect("valid"),
        build: Build::default(),
        run: run.clone(),
        ready: Ready::default(),
        parameters: Default::default(),
        outputs: Outputs::default(),
        requires: Requires::default(),
        limits: task_proto::manifest::Limits::default(),
        exec_depends: vec!["std_msgs".to_owned()],
        content: ContentFacts { tar_digest: Digest::of(b""), tar_size: 0, entries: 0 },
    }
}

fn run_rules() -> impl Strategy<Value = Run> {
    let kind = prop_oneof![Just(TaskKind::Service), Just(TaskKind::Job)];
    let on_boot = prop_oneof![Just(OnBoot::Start), Just(OnBoot::Hold)];
    let restart = prop_oneof![Just(Restart::Always), Just(Restart::OnFailure), Just(Restart::Never)];
    (kind, on_boot, restart, any::<bool>()).prop_map(|(kind, on_boot, restart, idempotent)| Run {
        kind,
        on_boot,
        restart,
        idempotent,
        ..Run::default()
    })
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 512, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn whatever_happens_it_is_safe_and_converges(
        rules in run_rules(),
        outputs in prop::bool::ANY,
        bad in prop_oneof![Just(None), Just(Some(0)), Just(Some(1))],
        happenings in prop::collection::vec(happening(), 1..80),
    ) {
        let outputs = Outputs { paths: outputs.then(|| "maps/*".to_owned()).into_iter().collect() };
        let mut world = World { bad, outputs, ..World::new(rules) };
        for happening in happenings {
            world.happen(happening);
            prop_assert!(world.alive.len() <= 1);
        }
        world.settle();
        match (&world.desired, &world.record) {
            (None, record) => {
                prop_assert!(record.is_none() && world.alive.is_empty() && world.disk.is_empty());
            }
            (Some(order), Some(record)) => {
                prop_assert_eq!(&record.order, order);
                let phase = record.standing().0;
                prop_assert_eq!(phase, record.phase);
                match order.wanted {
                    Wanted::Stopped => prop_assert!(world.alive.is_empty() && phase == Phase::Stopped),
                    Wanted::Running => {
                        let active = record.active.as_ref().filter(|active| active.is_for(order));
                        let runs = active.is_some_and(|active| active.process.is_some()) && world.alive.len() == 1;
                        prop_assert!(runs == (phase == Phase::Running), "{phase} {active:?} {:?}", world.alive);
                        prop_assert!(runs || phase.is_final(), "stuck in {phase}: {record:?}");
                        let old_runs = active.is_none() && world.alive.len() == 1;
                        prop_assert!(phase != Phase::RolledBack || old_runs, "nothing came back: {record:?}");
                        let bad = bad.is_some_and(|number| order.package == package(number));
                        prop_assert!(!(bad && runs), "it runs, and is not ready");
                    }
                }
                prop_assert!(world.disk.len() <= 3);
                prop_assert!(record.collections.is_empty());
            }
            (Some(_), None) => prop_assert!(false, "an order without a record"),
        }
    }

    #[test]
    fn backoff_stays_in_its_bounds(attempt in 0..u32::MAX, jitter in 0.0..1.0f64) {
        prop_assert!(backoff_ms(attempt, 60_000, jitter) <= 60_000);
        prop_assert!(backoff_ms(attempt, 60_000, 1.0) >= backoff_ms(attempt, 60_000, jitter));
    }
}

fn running(run: Run) -> World {
    let mut world = World::new(run);
    world.happen(Happening::Order { deployment: 0, run: 1, stop: false });
    while world.alive.is_empty() {
        world.happen(Happening::Effect { well: true });
        world.happen(Happening::Learn);
    }
    world.happen(Happening::Wait { ms: 2000 });
    assert_eq!(world.record.as_ref().expect("a record").phase, Phase::Running);
    world
}

fn phase(world: &World) -> Phase {
    world.record.as_ref().expect("a record").phase
}

#[test]
fn the_old_version_runs_until_the_new_one_is_staged_and_after_a_cancel() {
    let mut world = running(Run::default());
    let old = world.alive.clone();
    world.happen(Happening::Order { deployment: 1, run: 1, stop: false });
    assert!(matches!(world.steps[..], [(Step::PullManifest(_), false)]));
    assert_eq!((phase(&world), &world.alive), (Phase::Fetching, &old));
    world.happen(Happening::Order { deployment: 0, run: 1, stop: false });
    assert_eq!((phase(&world), &world.alive), (Phase::Running, &old));
    assert!(world.steps.is_empty(), "the cancelled step is interrupted: {:?}", world.steps);
}

#[test]
fn the_old_version_comes_back_after_a_reboot_while_the_new_one_is_pulled() {
    let mut world = running(Run::default());
    world.happen(Happening::Order { deployment: 1, run: 1, stop: false });
    world.happen(Happening::Reboot);
    let mut lanes: Vec<Lane> = world.steps.iter().map(|(step, _)| step.lane()).collect();
    lanes.sort();
    assert_eq!(lanes, [Lane::Prepare, Lane::Run]);
    assert_eq!(phase(&world), Phase::Fetching);
}

#[test]
fn hold_starts_nothing_and_stops_nothing() {
    let mut world = running(Run::default());
    let old = world.alive.clone();
    world.happen(Happening::Hold(true));
    world.happen(Happening::Order { deployment: 1, run: 1, stop: false });
    for _ in 0..4 {
        world.happen(Happening::Effect { well: true });
        world.happen(Happening::Learn);
    }
    assert_eq!((phase(&world), &world.alive), (Phase::Deferred, &old));
    world.happen(Happening::Hold(false));
    assert!(matches!(world.steps[..], [(Step::Stop(_), false)]));
}

#[test]
fn a_job_that_the_robot_lost_is_interrupted_unless_it_is_idempotent() {
    for (idempotent, expected) in [(false, Phase::Failed), (true, Phase::Starting)] {
        let mut world = running(Run { kind: TaskKind::Job, idempotent, ..Run::default() });
        world.happen(Happening::Reboot);
        assert_eq!(phase(&world), expected);
    }
}

#[test]
fn a_service_that_never_gets_ready_fails_with_its_exit_code() {
    let mut world = World::new(Run::default());
    world.happen(Happening::Order { deployment: 1, run: 1, stop: false });
    for _ in 0..200 {
        world.happen(Happening::Effect { well: true });
        world.happen(Happening::Learn);
        if world.alive.iter().any(|dir| dir.starts_with("d0000000000000001")) {
            world.happen(Happening::ProcessEnds { code: 3 });
        }
        world.happen(Happening::Wait { ms: 500 });
    }
    let (phase, failure) = world.record.as_ref().expect("a record").standing();
    assert_eq!(phase, Phase::Failed);
    assert!(failure.expect("a failure").text.contains("exited with code 3"));
}

fn bad_switch(world: &mut World) -> String {
    let old = world.alive[0].clone();
    world.bad = Some(1);
    world.happen(Happening::Order { deployment: 1, run: 1, stop: false });
    while !world.alive.iter().any(|dir| dir.starts_with("d0000000000000001")) {
        world.happen(Happening::Effect { well: true });
        world.happen(Happening::Learn);
    }
    old
}

#[test]
fn a_version_that_does_not_get_ready_is_stopped_and_the_old_one_started_again() {
    let mut world = running(Run::default());
    bad_switch(&mut world);
    assert_eq!(phase(&world), Phase::Starting);
    world.happen(Happening::Wait { ms: 30_000 });
    assert!(matches!(world.steps[..], [(Step::Stop(_), false)]), "{:?}", world.steps);
    assert_eq!(phase(&world), Phase::Starting, "it is not final before the process is gone");
    world.happen(Happening::Effect { well: true });
    world.happen(Happening::Learn);
    let record = world.record.as_ref().expect("a record");
    let (phase, failure) = record.standing();
    assert_eq!(phase, Phase::RolledBack);
    assert_eq!(failure.expect("why").to_string(), "not_ready: `/mapper` is gone within 30 s");
    assert!(matches!(&world.steps[..], [(Step::Start(run), false)] if run.package == package(0)), "{:?}", world.steps);
    world.settle();
    assert_eq!((world.alive.len(), world.record.as_ref().expect("a record").phase), (1, Phase::RolledBack));
    // A reboot brings the old one back, and the order is not tried again by itself.
    world.happen(Happening::Reboot);
    world.settle();
    let record = world.record.as_ref().expect("a record");
    assert_eq!((record.phase, &record.active.as_ref().expect("active").package), (Phase::RolledBack, &package(0)));
    world.bad = None;
    world.happen(Happening::Order { deployment: 1, run: 2, stop: false });
    world.settle();
    assert_eq!(world.record.as_ref().expect("a record").phase, Phase::Running);
}

#[test]
fn a_rollback_survives_a_power_cut_before_and_after_every_step() {
    for cut in 0..12 {
        let mut world = running(Run::default());
        bad_switch(&mut world);
        for at in 0..12 {
            if at == cut {
                world.happen(Happening::Reboot);
            }
            world.happen(if at % 2 == 0 { Happening::Wait { ms: 15_000 } } else { Happening::Effect { well: true } });
            world.happen(Happening::Learn);
        }
        world.settle();
        assert_eq!((phase(&world), world.alive.len()), (Phase::RolledBack, 1), "cut at {cut}");
    }
}

#[test]
fn when_the_old_version_fails_after_it_came_back_the_order_has_failed() {
    let mut world = running(Run::default());
    bad_switch(&mut world);
    for _ in 0..10_000 {
        world.happen(Happening::Effect { well: true });
        world.happen(Happening::Learn);
        if phase(&world) == Phase::RolledBack {
            world.happen(Happening::ProcessEnds { code: 3 });
        }
        world.happen(Happening::Wait { ms: 30_000 });
    }
    let (phase, failure) = world.record.as_ref().expect("a record").standing();
    let text = &failure.expect("why").text;
    assert_eq!((phase, world.alive.len()), (Phase::Failed, 0));
    assert!(text.contains("within 30 s\n1.0, which had come back, failed: the process ended"), "{text}");
}

#[test]
fn what_the_operator_had_stopped_does_not_come_back() {
    let mut world = running(Run::default());
    world.happen(Happening::Order { deployment: 0, run: 2, stop: true });
    world.settle();
    assert_eq!(phase(&world), Phase::Stopped);
    world.happen(Happening::Order { deployment: 1, run: 1, stop: false });
    assert!(world.steps.iter().all(|(step, _)| step.lane() == Lane::Prepare), "the old one stays down meanwhile");
    bad_order(&mut world);
    assert_eq!((phase(&world), world.alive.len()), (Phase::Failed, 0));
}

#[test]
fn a_first_version_and_a_job_that_do_not_get_ready_have_failed() {
    let mut world = World::new(Run::default());
    bad_order(&mut world);
    assert_eq!((phase(&world), world.alive.len()), (Phase::Failed, 0));
    let mut world = running(Run::default());
    world.manifest.kind = TaskKind::Job;
    bad_order(&mut world);
    assert_eq!((phase(&world), world.alive.len()), (Phase::Failed, 0));
}

fn bad_order(world: &mut World) {
    world.bad = Some(1);
    world.happen(Happening::Order { deployment: 1, run: 1, stop: false });
    world.settle();
}

#[test]
fn a_task_that_stays_degraded_is_started_again_unless_its_policy_is_never() {
    for (restart, again) in [(Restart::OnFailure, true), (Restart::Always, true), (Restart::Never, false)] {
        let mut world = running(Run { restart, ..Run::default() });
        world.happen(Happening::Sees(Sight::NotAll));
        world.happen(Happening::Wait { ms: 29_999 });
        assert!(world.steps.is_empty());
        world.happen(Happening::Wait { ms: 1 });
        assert_eq!(matches!(world.steps[..], [(Step::Stop(_), false)]), again, "{restart:?}");
        assert_eq!(phase(&world), Phase::Running);
        world.settle();
        let active = world.record.as_ref().expect("a record").active.as_ref().expect("active");
        assert_eq!((phase(&world), active.restarts), (Phase::Running, u32::from(again)));
    }
}

#[test]
fn a_task_must_hold_for_its_time_without_a_break() {
    let mut world = World::new(Run::default());
    world.health = Health::Unknown;
    world.happen(Happening::Order { deployment: 0, run: 1, stop: false });
    while world.alive.is_empty() {
        world.happen(Happening::Effect { well: true });
        world.happen(Happening::Learn);
    }
    for sight in [Sight::All, Sight::NotAll, Sight::All] {
        world.happen(Happening::Sees(sight));
        world.happen(Happening::Wait { ms: 1999 });
        assert_eq!(phase(&world), Phase::Starting);
    }
    world.happen(Happening::Wait { ms: 1 });
    assert_eq!(phase(&world), Phase::Running);
    let mut world = running(Run::default());
    world.happen(Happening::Sees(Sight::Refused));
    assert_eq!((phase(&world), world.steps.len()), (Phase::Running, 0), "only a start can be refused");
}

#[test]
fn a_job_has_its_deadline() {
    let mut world = running(Run { kind: TaskKind::Job, deadline_s: Some(60), ..Run::default() });
    world.happen(Happening::Wait { ms: 57_999 });
    assert!(world.steps.is_empty());
    world.happen(Happening::Wait { ms: 1 });
    assert!(matches!(world.steps[..], [(Step::Stop(_), false)]), "{:?}", world.steps);
    world.settle();
    let (phase, failure) = world.record.as_ref().expect("a record").standing();
    assert_eq!((phase, &failure.expect("why").code), (Phase::Failed, &FailureCode::DEADLINE_EXCEEDED));
}

#[test]
fn the_gate_allows_a_switch_as_a_whole() {
    let mut world = running(Run::default());
    world.gated = true;
    let old = world.alive.clone();
    world.happen(Happening::Order { deployment: 1, run: 1, stop: false });
    while !matches!(world.steps[..], [(Step::Ask(_), _)]) {
        world.happen(Happening::Effect { well: true });
        world.happen(Happening::Learn);
    }
    let step = |world: &World| match &world.steps[..] {
        [(Step::Ask(question), false)] => Some(question.step),
        _ => None,
    };
    assert_eq!(step(&world), Some(GateStep::Switch));
    for _ in 0..3 {
        world.happen(Happening::Effect { well: false });
        assert_eq!((phase(&world), &world.alive), (Phase::Deferred, &old));
        assert!(world.steps.is_empty(), "it is asked again later");
        world.happen(Happening::Wait { ms: 60_000 });
        assert_eq!((phase(&world), step(&world)), (Phase::Deferred, Some(GateStep::Switch)));
    }
    world.happen(Happening::Effect { well: true });
    world.happen(Happening::Learn);
    assert!(matches!(world.steps[..], [(Step::Stop(_), false)]), "{:?}", world.steps);
    world.happen(Happening::Effect { well: true });
    world.happen(Happening::Learn);
    assert!(matches!(world.steps[..], [(Step::Start(_), false)]), "{:?}", world.steps);
    world.settle();
    // A crash is no new start, a reboot is.
    world.happen(Happening::ProcessEnds { code: 1 });
    world.happen(Happening::Wait { ms: 60_000 });
    assert!(matches!(world.steps[..], [(Step::Start(_), false)]), "{:?}", world.steps);
    world.settle();
    world.happen(Happening::Reboot);
    assert_eq!(step(&world), Some(GateStep::Start));
    world.happen(Happening::Effect { well: false });
    assert_eq!(phase(&world), Phase::Deferred);
}

#[test]
fn a_stop_that_the_gate_refuses_waits_while_the_task_is_looked_after() {
    let mut world = running(Run::default());
    world.gated = true;
    world.happen(Happening::Order { deployment: 0, run: 2, stop: true });
    world.happen(Happening::Effect { well: false });
    assert_eq!((phase(&world), world.alive.len()), (Phase::Deferred, 1));
    world.happen(Happening::Sees(Sight::NotAll));
    world.happen(Happening::Wait { ms: 30_000 });
    assert!(world.steps.iter().any(|(step, _)| matches!(step, Step::Stop(_))), "what failed is stopped unasked");
    world.settle();
    assert_eq!((phase(&world), world.alive.len()), (Phase::Stopped, 0));
}

#[test]
fn on_boot_hold_leaves_a_service_down_after_a_reboot() {
    let mut world = running(Run { on_boot: OnBoot::Hold, ..Run::default() });
    world.happen(Happening::Reboot);
    world.settle();
    assert_eq!((phase(&world), world.alive.len()), (Phase::Stopped, 0));
    world.happen(Happening::Order { deployment: 0, run: 2, stop: false });
    world.settle();
    assert_eq!((phase(&world), world.alive.len()), (Phase::Running, 1));
}

#[test]
fn every_step_of_the_run_lane_has_a_deadline() {
    let order = order(1, 1, 1, Wanted::Running);
    let stop_timeout_s = 3600;
    let run = ActiveRun::of(&order, RunRules::from(&manifest(&Run { stop_timeout_s, ..Run::default() })), 0);
    let steps =
        [Step::Start(Box::new(run.clone())), Step::Stop(Box::new(run)), Step::Prune { kept: Vec::new() }, Step::Remove];
    assert!(steps.iter().all(|step| step.lane() == Lane::Run && step.deadline().is_some()));
    let stop = steps[1].deadline().expect("checked");
    assert!(stop > Duration::from_secs(2 * u64::from(stop_timeout_s)), "both signals have their time: {stop:?}");
}
