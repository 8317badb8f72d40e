//! Tests of the driver's logic, with a robot whose effects only record calls.

mod changed;
mod fake;
mod hanging;
mod removed;

use task_proto::api::ReportReply;
use task_proto::desired::{BlobRef, Delivery, Inline, PackageRef, TargetState};
use task_proto::messages::part::PartRange;
use task_proto::messages::report::{Failure, FailureCode, Phase, Report};
use task_proto::trust::envelope::{DESIRED_STATE_TYPE, Envelope, SigningKey};
use task_proto::{DeploymentId, Digest};

use self::fake::Fake;
use super::*;
use crate::task::ledger::GateStep;
use crate::task::observed::Missing;
use crate::task::plan::StepFailure;

/// How long a test waits for an event that should come at once.
const PATIENCE: Duration = Duration::from_secs(20);

fn order(version: &str) -> DesiredTask {
    let blob = BlobRef { digest: Digest::of(version.as_bytes()), size: 1 };
    let name: TaskName = "talker".parse().expect("valid");
    let version = version.parse().expect("valid");
    DesiredTask {
        task: name.clone(),
        deployment: DeploymentId::random(),
        package: PackageRef { name, version, manifest: blob, config: blob, content: blob },
        wanted: TargetState::Running,
        run: 1,
        delivery: Delivery::PushPull,
        priority: 0,
    }
}

/// A running driver, and the server's side of it.
struct Bench {
    fake: Arc<Fake>,
    link_state: LinkState,
    server_messages: mpsc::Sender<ServerMessage>,
    key: SigningKey,
    robot: RobotId,
    driver: tokio::task::JoinHandle<()>,
}

impl Bench {
    async fn new() -> Self {
        let key = SigningKey::random();
        let robot = RobotId::random();
        let fake = Arc::new(Fake::default());
        fake.sees(Health::Holds { since_ms: 0 });
        Self::with(fake, Ledger::new(0), key, robot).await
    }

    async fn with(fake: Arc<Fake>, ledger: Ledger, key: SigningKey, robot: RobotId) -> Self {
        let link_state = LinkState::new(CancellationToken::new());
        let agent_identity = AgentIdentity {
            robot_id: robot.clone(),
            server_key: key.public_key(),
            instance: InstanceId::random(),
            place: None,
            boot_id: "boot".to_owned(),
            name: Some("atlas".parse().expect("valid")),
            labels: None,
        };
        let driver =
            Driver::new(fake.clone(), agent_identity, link_state.clone(), ledger, None).await;
        let (server_messages, messages) = mpsc::channel(4);
        Self {
            fake,
            link_state,
            server_messages,
            key,
            robot,
            driver: tokio::spawn(driver.run(messages)),
        }
    }

    fn sealed(&self, generation: u64, tasks: Vec<DesiredTask>, key: &SigningKey) -> ServerMessage {
        let now_ms = crate::system::clock::wall_ms();
        let state = DesiredState {
            robot_id: self.robot.clone(),
            generation: Generation(generation),
            issued_at_ms: now_ms,
            expires_at_ms: now_ms + 1_000_000,
            tasks,
            evidence: Default::default(),
            settings: Default::default(),
            robot: Default::default(),
        };
        let payload = serde_json::to_vec(&state).expect("json");
        let envelope = Box::new(Envelope::seal(DESIRED_STATE_TYPE, &payload, key));
        ServerMessage::Desired { envelope, inline: Inline::default(), was_asked_for: false }
    }

    async fn order(&self, generation: u64, tasks: Vec<DesiredTask>) {
        self.say(self.sealed(generation, tasks, &self.key)).await;
    }

    async fn say(&self, message: ServerMessage) {
        self.server_messages.send(message).await.expect("the driver listens");
    }

    /// The first report that satisfies `expected`.
    async fn report(&self, expected: impl Fn(&Report) -> bool) -> Report {
        let mut reports = self.link_state.reports.subscribe();
        let found =
            reports.wait_for(|report| report.as_ref().is_some_and(|report| expected(report)));
        let found = tokio::time::timeout(PATIENCE, found)
            .await
            .expect("it is reported")
            .expect("the driver lives");
        Report::clone(found.as_ref().expect("waited for"))
    }

    async fn phase(&self, phase: Phase) -> Report {
        self.report(|report| report.tasks.first().is_some_and(|task| task.phase == phase)).await
    }

    async fn end(self) -> Ledger {
        self.link_state.shutdown.cancel();
        self.driver.await.expect("no panic");
        self.fake.state(|state| state.ledgers.last().cloned()).expect("a ledger")
    }
}

fn has(report: &Report, code: &str) -> bool {
    report.conditions.iter().any(|condition| condition.code == code)
}

#[tokio::test]
async fn order_runs_and_its_withdrawal_removes_it() {
    let bench = Bench::new().await;
    bench.order(1, vec![order("1.0")]).await;
    let report = bench.phase(Phase::Running).await;
    assert_eq!(report.observed_generation, Generation(1));
    assert_eq!(report.tasks[0].active.as_ref().expect("active").pid, 7);
    bench.order(2, Vec::new()).await;
    bench.report(|report| report.tasks.is_empty()).await;
    assert!(bench.fake.state(|state| state.alive.is_empty()));
    assert!(bench.end().await.tasks.is_empty());
}

#[tokio::test]
async fn missing_ros_package_is_reported_before_the_pull_and_retried_after_installation() {
    let bench = Bench::new().await;
    bench.fake.state(|state| {
        state.exec_depends =
            ["nav2_bringup", "python3-numpy", "std_msgs", "slam_toolbox"].map(str::to_owned).into();
        state.ros_packages = ["std_msgs".to_owned()].into();
    });
    bench.order(1, vec![order("1.0")]).await;
    let report = bench.phase(Phase::Unmet).await;
    let failure = report.tasks[0].failure.clone().expect("why");
    assert_eq!(failure.code, FailureCode::REQUIREMENTS_UNMET);
    let list = "does not meet the requirements of talker 1.0: ROS package nav2_bringup, ROS package slam_toolbox";
    assert!(failure.text.contains(list), "{failure}");
    assert!(bench.fake.state(|state| state.contents.is_empty()), "nothing was pulled");
    // A person installs the missing packages; the same package is ordered again.
    bench.fake.state(|state| {
        state.ros_packages.extend(["nav2_bringup", "slam_toolbox"].map(str::to_owned))
    });
    bench.order(2, vec![order("1.0")]).await;
    bench.phase(Phase::Running).await;
}

#[tokio::test]
async fn untrusted_package_fails_before_any_pull() {
    let bench = Bench::new().await;
    let unsigned = order("1.0");
    let signed = order("2.0");
    bench.fake.state(|state| state.untrusted.insert(unsigned.package.manifest.digest));
    bench.order(1, vec![unsigned.clone()]).await;
    let report = bench.phase(Phase::Failed).await;
    assert_eq!(report.tasks[0].failure.as_ref().expect("why").code, FailureCode::UNTRUSTED_PACKAGE);
    bench.fake.state(|state| {
        assert!(
            state.manifests.is_empty() && state.contents.is_empty() && state.started.is_empty()
        );
        assert_eq!(
            (&state.applied, &state.checked),
            (&vec![Generation(1)], &vec![unsigned.package.manifest.digest])
        );
    });
    bench.order(2, vec![signed.clone()]).await;
    bench.phase(Phase::Running).await;
    // Its publisher is revoked: the task continues, and the report says that it would not start
    // again.
    bench.fake.state(|state| {
        state.untrusted.insert(signed.package.manifest.digest);
        state.trust = TrustFacts {
            epoch: 1,
            refused_list: Some("it is old".to_owned()),
            ..TrustFacts::default()
        };
    });
    let report = bench.report(|report| report.tasks[0].degraded.is_some()).await;
    assert_eq!(report.tasks[0].phase, Phase::Running);
    assert_eq!(
        report.tasks[0].degraded.as_ref().expect("waited for").code,
        FailureCode::UNTRUSTED_PACKAGE
    );
    assert!(has(&report, "publishers_refused"));
}

#[tokio::test]
async fn staged_version_waits_after_its_publisher_list_expires() {
    let bench = Bench::new().await;
    let held = order("1.0");
    bench.fake.state(|state| state.held = true);
    bench.order(1, vec![held.clone()]).await;
    bench.phase(Phase::Deferred).await;
    bench.fake.state(|state| {
        state.untrusted.insert(held.package.manifest.digest);
        state.trust.list_expired = true;
    });
    bench.phase(Phase::Failed).await;
    let (checked, started) = bench.fake.state(|state| (state.checked.len(), state.started.len()));
    assert_eq!((checked, started), (1, 0), "it is looked at again, and not started");
}

#[tokio::test]
async fn cancel_interrupts_a_pull_and_leaves_the_old_version_running() {
    let bench = Bench::new().await;
    let old = order("1.0");
    let fake = bench.fake.clone();
    bench.order(1, vec![old.clone()]).await;
    bench.phase(Phase::Running).await;
    bench.fake.slow.store(true, std::sync::atomic::Ordering::SeqCst);
    bench.order(2, vec![order("2.0")]).await;
    let fetching = bench.phase(Phase::Fetching).await;
    assert_eq!(
        fetching.tasks[0].active.as_ref().expect("the old one").version,
        old.package.version
    );
    bench.order(3, vec![old.clone()]).await;
    bench
        .report(|report| {
            report.observed_generation == Generation(3) && report.tasks[0].phase == Phase::Running
        })
        .await;
    let (started, alive) = bench.fake.state(|state| (state.started.len(), state.alive.len()));
    assert_eq!((started, alive), (1, 1));
    bench.end().await;
    let kept = fake.state(|state| state.kept_parts.clone());
    assert!(kept.iter().any(|kept| *kept == [order("2.0").package.content.digest]), "{kept:?}");
    assert_eq!(kept.last(), Some(&vec![]), "the bytes of 2.0 are deleted, and 1.0 is there");
}

fn missing(since_ms: u64) -> Health {
    Health::Missing(Missing {
        is_own_fault: true,
        since_ms,
        code: FailureCode::NODE_VANISHED,
        what: "`/mapper` is gone".to_owned(),
        seen: "on the graph: `/lidar`".to_owned(),
    })
}

#[tokio::test]
async fn ros_health_makes_a_task_ready_degraded_and_recovered() {
    let bench = Bench::new().await;
    bench.fake.sees(Health::Unknown);
    let order = order("1.0");
    bench.order(1, vec![order.clone()]).await;
    bench.phase(Phase::Starting).await;
    bench.fake.sees(Health::Holds { since_ms: bench.fake.now().boot_ms });
    bench.phase(Phase::Running).await;
    bench.fake.sees(missing(bench.fake.now().boot_ms));
    let report = bench.report(|report| report.tasks[0].degraded.is_some()).await;
    assert_eq!(report.tasks[0].phase, Phase::Running);
    let degraded = report.tasks[0].degraded.as_ref().expect("waited for").to_string();
    assert_eq!(degraded, "node_vanished: `/mapper` is gone; on the graph: `/lidar`");
    bench.fake.sees(Health::Holds { since_ms: bench.fake.now().boot_ms });
    bench.report(|report| report.tasks[0].degraded.is_none()).await;
    assert_eq!(bench.fake.state(|state| state.started.len()), 1);
    bench.fake.sees(Health::Refused(Failure::new(FailureCode::LIFECYCLE_FAILED, "it will not")));
    bench.order(2, vec![DesiredTask { run: 2, ..order }]).await;
    let report = bench.phase(Phase::Failed).await;
    assert_eq!(report.tasks[0].failure.as_ref().expect("why").code, FailureCode::LIFECYCLE_FAILED);
    assert!(bench.fake.state(|state| state.alive.is_empty()), "it is stopped before it has failed");
}

#[tokio::test]
async fn old_version_comes_back_when_the_new_one_does_not_get_ready() {
    let bench = Bench::new().await;
    let (old, new) = (order("1.0"), order("2.0"));
    bench.order(1, vec![old.clone()]).await;
    bench.phase(Phase::Running).await;
    bench.fake.state(|state| state.bad.insert(new.package.manifest.digest));
    bench.order(2, vec![new.clone()]).await;
    let back = |report: &Report| {
        report.tasks[0].phase == Phase::RolledBack && report.tasks[0].active.is_some()
    };
    let report = bench.report(back).await;
    let task = &report.tasks[0];
    assert_eq!((&task.deployment, task.run), (&new.deployment, 1));
    assert_eq!(task.failure.as_ref().expect("why").to_string(), "lifecycle_failed: it will not");
    assert_eq!(task.active.as_ref().expect("the old one").deployment, old.deployment);
    // Neither a report nor a new agent triggers a retry; a new run does.
    let fake = bench.fake.clone();
    let key = SigningKey::from_bytes(bench.key.to_bytes());
    let robot = bench.robot.clone();
    let ledger = bench.end().await;
    let bench = Bench::with(fake, ledger, key, robot).await;
    bench.report(back).await;
    assert_eq!(bench.fake.state(|state| state.started.len()), 3);
    bench.fake.state(|state| state.bad.clear());
    bench.order(3, vec![DesiredTask { run: 2, ..new }]).await;
    bench.phase(Phase::Running).await;
}

#[tokio::test]
async fn gate_is_asked_before_a_start_and_its_reason_is_reported() {
    let bench = Bench::new().await;
    bench.fake.state(|state| state.gate = Some(Err("carries a load".to_owned())));
    let order = order("1.0");
    bench.order(1, vec![order.clone()]).await;
    let report = bench.phase(Phase::Deferred).await;
    assert_eq!(
        report.tasks[0].failure.as_ref().expect("why").to_string(),
        "gate_refused: carries a load"
    );
    assert!(bench.fake.state(|state| state.started.is_empty()));
    bench.fake.state(|state| state.gate = Some(Ok(())));
    bench.phase(Phase::Running).await;
    bench.fake.state(|state| state.gate = Some(Err("busy".to_owned())));
    bench.order(2, vec![DesiredTask { wanted: TargetState::Stopped, ..order }]).await;
    let report = bench.phase(Phase::Deferred).await;
    assert!(report.tasks[0].active.is_some(), "it runs on");
    bench.fake.state(|state| state.gate = None);
    bench.phase(Phase::Stopped).await;
    let asked = bench.fake.state(|state| state.asked.clone());
    assert!(
        asked.starts_with(&[GateStep::Start]) && asked.ends_with(&[GateStep::Stop]),
        "{asked:?}"
    );
}

#[tokio::test]
async fn job_succeeds_after_its_outputs_are_uploaded() {
    let bench = Bench::new().await;
    bench.fake.state(|state| state.jobs = true);
    let order = order("1.0");
    bench.order(1, vec![order.clone()]).await;
    bench.phase(Phase::Running).await;
    bench.fake.exit(0);
    let sending =
        |report: &Report| report.tasks[0].progress == Some(Progress { done: 1, total: 2 });
    let report = bench.report(sending).await;
    assert_eq!((report.tasks[0].phase, &report.tasks[0].active), (Phase::Running, &None));
    // The agent dies meanwhile: the job does not run again, its files are sent again, and this time
    // refused.
    let fake = bench.fake.clone();
    let key = SigningKey::from_bytes(bench.key.to_bytes());
    let robot = bench.robot.clone();
    let ledger = bench.end().await;
    let failure = Failure::new(FailureCode::OUTPUTS_LOST, "too much");
    fake.state(|state| state.upload = Some(Err(StepFailure { failure, retry_after_ms: None })));
    let bench = Bench::with(fake, ledger, key, robot).await;
    let report = bench.phase(Phase::Succeeded).await;
    let lost = report.tasks[0].degraded.as_ref().expect("said").to_string();
    assert_eq!(
        lost,
        "outputs_lost: output files of run 1 were not uploaded: outputs_lost: too much"
    );
    bench.fake.state(|state| state.upload = Some(Ok(())));
    bench.order(2, vec![DesiredTask { run: 2, ..order }]).await;
    bench.phase(Phase::Running).await;
    bench.fake.exit(3);
    let report = bench.phase(Phase::Failed).await;
    assert_eq!(report.tasks[0].degraded, None);
    let (collected, started) =
        bench.fake.state(|state| (state.collected.clone(), state.started.len()));
    assert_eq!((collected, started), (vec![1, 2], 2));
}

#[tokio::test]
async fn refused_state_is_named_and_the_old_one_stays() {
    let bench = Bench::new().await;
    bench.order(5, vec![order("1.0")]).await;
    bench.phase(Phase::Running).await;
    let forged = bench.sealed(6, Vec::new(), &SigningKey::random());
    bench.say(forged).await;
    bench.report(|report| has(report, "state_refused")).await;
    bench.order(6, vec![order("1.1")]).await;
    bench
        .report(|report| {
            !has(report, "state_refused") && report.observed_generation == Generation(6)
        })
        .await;
    bench.order(4, Vec::new()).await;
    let report = bench.report(|report| has(report, "state_refused")).await;
    assert_eq!((report.observed_generation, report.tasks.len()), (Generation(6), 1));
    assert_eq!(report.reached_generation(), Generation(6));
    // The order of a server that was restored from an older copy and has forgotten its sixth
    // generation.
    bench.order(6, Vec::new()).await;
    let report = bench.report(|report| has(report, Report::STATE_CONTRADICTED)).await;
    assert_eq!((report.reached_generation(), report.tasks.len()), (Generation(7), 1));
    bench.order(8, Vec::new()).await;
    bench
        .report(|report| {
            report.conditions.is_empty() && report.reached_generation() == Generation(8)
        })
        .await;
}

#[tokio::test]
async fn failed_stop_or_removal_is_reported_until_it_succeeds() {
    let bench = Bench::new().await;
    bench.order(1, vec![order("1.0")]).await;
    bench.phase(Phase::Running).await;
    let failing = |text: &str| StepFailure {
        failure: Failure::new(FailureCode::IO_ERROR, text),
        retry_after_ms: Some(0),
    };
    bench.fake.state(|state| {
        state.stop = Some(failing("it does not end"));
        state.removal = Some(failing("read-only file system"));
    });
    bench.order(2, Vec::new()).await;
    let said = |report: &Report, text: &str| {
        report
            .conditions
            .iter()
            .any(|condition| condition.code == "step_failed" && condition.text == text)
    };
    bench.report(|report| said(report, "stop talker: io_error: it does not end")).await;
    bench.fake.state(|state| state.stop = None);
    bench.report(|report| said(report, "remove talker: io_error: read-only file system")).await;
    bench.fake.state(|state| state.removal = None);
    bench.report(|report| report.tasks.is_empty() && report.conditions.is_empty()).await;
}

#[tokio::test]
async fn restarted_agent_adopts_running_tasks_and_orders() {
    let bench = Bench::new().await;
    bench.order(1, vec![order("1.0")]).await;
    bench.phase(Phase::Running).await;
    let fake = bench.fake.clone();
    let key = SigningKey::from_bytes(bench.key.to_bytes());
    let robot = bench.robot.clone();
    let ledger = bench.end().await;
    let bench = Bench::with(fake, ledger, key, robot).await;
    let report = bench.phase(Phase::Running).await;
    assert_eq!((report.start, report.observed_generation), (2, Generation(1)));
    assert_eq!(bench.fake.state(|state| state.started.len()), 1, "nothing is started again");
}

#[tokio::test]
async fn unwritable_ledger_blocks_new_steps() {
    let bench = Bench::new().await;
    bench.fake.state(|state| state.disk_full = true);
    bench.order(1, vec![order("1.0")]).await;
    let report = bench.report(|report| has(report, "ledger_unwritable")).await;
    let text = &report.conditions[0].text;
    assert!(text.contains("/dev/null/ledger.json"), "{text}");
    assert!(bench.fake.state(|state| state.manifests.is_empty()));
    bench.fake.state(|state| state.disk_full = false);
    let report = bench.phase(Phase::Running).await;
    assert!(!has(&report, "ledger_unwritable"));
    assert_eq!(bench.fake.state(|state| state.started.len()), 1);
}

#[tokio::test]
async fn unwritable_ledger_does_not_block_stops_and_removals() {
    let bench = Bench::new().await;
    bench.order(1, vec![order("1.0")]).await;
    bench.phase(Phase::Running).await;
    bench.fake.state(|state| state.held = true);
    bench.order(2, vec![order("2.0")]).await;
    bench.phase(Phase::Deferred).await;
    bench.fake.state(|state| (state.disk_full, state.held) = (true, false));
    // The new version's start would have to be recorded: the old version is not stopped for a start
    // that may never come.
    bench.report(|report| has(report, "ledger_unwritable")).await;
    assert_eq!(bench.fake.state(|state| (state.alive.len(), state.started.len())), (1, 1));
    bench.order(3, Vec::new()).await;
    let report = bench.report(|report| report.tasks.is_empty()).await;
    assert!(has(&report, "ledger_unwritable") && bench.fake.state(|state| state.alive.is_empty()));
    assert_eq!(report.observed_generation, Generation(2), "unsynced files were not observed");
    bench.fake.state(|state| state.disk_full = false);
    bench.report(|report| report.observed_generation == Generation(3)).await;
}

#[tokio::test]
async fn clock_at_1970_is_reported_and_tasks_run() {
    let bench = Bench::new().await;
    bench.fake.state(|state| state.wall_ms = Some(5_000));
    bench.order(1, vec![order("1.0")]).await;
    let report = bench.phase(Phase::Running).await;
    let condition = report
        .conditions
        .iter()
        .find(|condition| condition.code == "clock_wrong")
        .expect("it says so");
    assert!(condition.text.contains("it shows 1970-01-01,"), "{}", condition.text);
    bench.fake.state(|state| state.wall_ms = None);
    bench.order(2, vec![order("2.0")]).await;
    bench.report(|report| !has(report, "clock_wrong")).await;
}

#[tokio::test]
async fn hold_keeps_a_staged_version_from_starting() {
    let bench = Bench::new().await;
    bench.fake.state(|state| state.held = true);
    bench.order(1, vec![order("1.0")]).await;
    let report = bench.phase(Phase::Deferred).await;
    assert!(has(&report, "held"));
    assert!(bench.fake.state(|state| state.started.is_empty()));
    bench.fake.state(|state| state.held = false);
    bench.phase(Phase::Running).await;
}

#[tokio::test]
async fn server_name_wins_and_the_difference_is_reported() {
    let bench = Bench::new().await;
    let reply = |name: &str| ReportReply {
        generation: Generation(0),
        name: name.parse().expect("valid"),
        labels: Labels::new(),
    };
    bench.say(ServerMessage::Confirmed { seq: 1, reply: Some(reply("bolt")) }).await;
    bench.report(|report| has(report, "settings_differ")).await;
    bench.say(ServerMessage::Confirmed { seq: 2, reply: Some(reply("atlas")) }).await;
    bench.report(|report| !has(report, "settings_differ")).await;
}

#[tokio::test]
async fn pull_deferred_by_the_server_stays_fetching_without_a_failure() {
    let bench = Bench::new().await;
    bench.fake.state(|state| state.retry_later = vec![1, 3_600_000]);
    bench.order(1, vec![order("1.0")]).await;
    let waits = |report: &Report| report.tasks.first().is_some_and(|task| task.progress.is_some());
    let report = bench.report(waits).await;
    let task = &report.tasks[0];
    assert_eq!((task.phase, task.attempts, &task.failure), (Phase::Fetching, 1, &None));
    assert_eq!(task.progress, Some(Progress { done: 1, total: 2 }));
    // The wait is in the record, so that a new agent in this boot continues to wait, and another
    // order does not.
    let ledger = bench.fake.state(|state| state.ledgers.last().cloned()).expect("a ledger");
    let preparation = &ledger.tasks.values().next().expect("a task").preparation;
    assert!(
        preparation.retry_at_ms > bench.fake.now().boot_ms + 3_000_000
            && preparation.failure.is_none()
    );
    bench.order(2, vec![order("1.1")]).await;
    bench.phase(Phase::Running).await;
    assert_eq!(*bench.fake.pulls.borrow(), 2);
}

#[tokio::test]
async fn inline_blobs_are_offered_only_if_an_accepted_state_names_them() {
    let bench = Bench::new().await;
    let blob = |bytes: &[u8]| BlobRef { digest: Digest::of(bytes), size: bytes.len() as u64 };
    let mut order = order("1.0");
    (order.package.config, order.package.content) = (blob(b"config"), blob(b"content"));
    let mut came = Inline::default();
    came.insert(Digest::of(b"config"), b"config".to_vec());
    came.insert(Digest::of(b"content"), b"others".to_vec());
    came.insert(Digest::of(b"not asked for"), b"not asked for".to_vec());
    let rung = |message: ServerMessage| match message {
        ServerMessage::Desired { envelope, .. } => {
            ServerMessage::Desired { envelope, inline: came.clone(), was_asked_for: false }
        }
        other => other,
    };
    bench.say(rung(bench.sealed(1, vec![order.clone()], &SigningKey::random()))).await;
    bench.report(|report| has(report, "state_refused")).await;
    assert!(bench.fake.state(|state| state.offered.is_empty()));
    bench.say(rung(bench.sealed(1, vec![order.clone()], &bench.key))).await;
    bench.phase(Phase::Running).await;
    let offered = bench.fake.state(|state| state.offered.clone());
    assert_eq!(offered, [(order.package.config, bytes::Bytes::from_static(b"config"))]);
}

#[tokio::test]
async fn missing_parts_are_reported_on_each_request() {
    let bench = Bench::new().await;
    let pushed = DesiredTask { delivery: Delivery::DirectPush, ..order("1.0") };
    bench.order(1, vec![pushed.clone()]).await;
    bench.phase(Phase::Fetching).await;
    let says = |missing: Option<Vec<PartRange>>, times| {
        bench.fake.part_requests.send_replace(PartRequest { missing, times })
    };
    let missing = |report: &Report| report.tasks[0].missing_parts.clone();
    says(Some(Vec::new()), 1);
    let first = bench.report(|report| missing(report) == Some(Vec::new())).await;
    let ranges = vec![PartRange { from: 3, to: 5 }];
    says(Some(ranges.clone()), 2);
    let second = bench.report(|report| missing(report).as_ref() == Some(&ranges)).await;
    says(Some(ranges.clone()), 3);
    let third = bench
        .report(|report| report.seq > second.seq && missing(report).as_ref() == Some(&ranges))
        .await;
    assert!(first.seq < second.seq && second.seq < third.seq);
    // The server switches to a pull: the gathering step ends, and the robot pulls.
    bench.order(2, vec![DesiredTask { delivery: Delivery::PushPull, ..pushed }]).await;
    let report = bench.phase(Phase::Running).await;
    assert_eq!(missing(&report), None);
    assert_eq!(bench.fake.state(|state| state.pulled.len()), 1);
}

#[tokio::test]
async fn tasks_of_higher_priority_are_prepared_first() {
    let bench = Bench::new().await;
    let named = |name: &str, priority| {
        let mut order = order("1.0");
        order.task = name.parse().expect("valid");
        order.package.name = order.task.clone();
        order.package.manifest.digest = Digest::of(name.as_bytes());
        DesiredTask { priority, ..order }
    };
    // Two versions are prepared at a time. The tasks wait for a person, so that only the order of
    // the pulls is seen.
    bench.fake.state(|state| state.held = true);
    let tasks = [("a", -5), ("b", 0), ("c", 7), ("d", 100), ("e", 0), ("f", 7)];
    bench.order(1, tasks.map(|(name, priority)| named(name, priority)).into()).await;
    let all_wait = |report: &Report| {
        report.tasks.iter().filter(|task| task.phase == Phase::Deferred).count() == 6
    };
    bench.report(all_wait).await;
    let begun = bench.fake.state(|state| state.pulled.clone());
    let place =
        |name: &str| begun.iter().position(|task| task.as_str() == name).expect("pulled") / 2;
    let places = ["d", "c", "f", "b", "e", "a"].map(place);
    assert_eq!(places, [0, 0, 1, 1, 2, 2], "{begun:?}");
}

#[tokio::test]
async fn report_contains_link_measurements() {
    let bench = Bench::new().await;
    let report = bench.report(|_| true).await;
    assert_eq!(report.link, None);
    bench.link_state.meter.transferred(1 << 20, std::time::Duration::from_secs(1));
    bench.link_state.meter.reconnected(Instant::now());
    let report = bench.report(|report| report.link.is_some()).await;
    let link = report.link.expect("waited for");
    assert_eq!((link.throughput_bytes_per_s, link.reconnects), (Some(1 << 20), 1));
}
