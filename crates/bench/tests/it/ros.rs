//! "Running" as ROS reports: real rclpy nodes, built by real colcon and pushed through the whole
//! system, keep or break the promises of their packages. Each test has its own server, robot and
//! ROS domain; its tasks run side by side.
#![expect(clippy::disallowed_methods, reason = "a test starts processes")]

use std::net::UdpSocket;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use task_proto::api::RobotTask;
use task_proto::messages::report::{Failure, Phase};
use tempfile::TempDir;

use crate::harness::{
    Process, Robot, Server, TIMEOUT, eventually, eventually_within, required, within,
};
use crate::leftovers::processes_with;
use crate::talker::trigger;

/// Directory of the package with the scriptable node.
const PROBE: &str = "tests/it/graph_probe";
/// Time limit for a job on a busy machine.
const JOB_PATIENCE: Duration = Duration::from_secs(600);

/// A ROS domain reserved on this machine while this value lives. The lock is a port that no
/// participant of the domain uses.
pub struct Domain {
    pub id: String,
    _lock: UdpSocket,
}

impl Domain {
    fn free() -> Self {
        // Domains with all ports below the system's ephemeral ports; port 7400 + 250 n + 249 would
        // be the 120th participant's.
        let free = |id: u16| {
            let lock = UdpSocket::bind(("127.0.0.1", 7400 + 250 * id + 249)).ok()?;
            Some(Self { id: id.to_string(), _lock: lock })
        };
        (1..=70).rev().find_map(free).expect("a free ROS domain")
    }
}

/// A server, a robot, and a domain in which the robot's nodes meet.
pub struct Stage {
    pub robot: Robot,
    pub server: Server,
    pub domain: Domain,
    pub dir: TempDir,
}

impl Stage {
    /// A stage with a built node.
    pub async fn start() -> Self {
        let stage = Self::bare().await;
        stage.build().await;
        stage
    }

    /// A stage without anything built.
    pub async fn bare() -> Self {
        Self::with(|domain| {
            vec![
                ("TASK_AGENT_UNDERLAYS", activate()),
                ("TASK_AGENT_ROS_DOMAIN_ID", domain.to_owned()),
            ]
        })
        .await
    }

    /// A stage with extra robot settings for this domain, without anything built.
    pub async fn with(own: impl FnOnce(&str) -> Vec<(&'static str, String)>) -> Self {
        let domain = Domain::free();
        let dir = TempDir::new().expect("temp dir");
        let server = Server::start(&dir.path().join("server")).await;
        let own = own(&domain.id);
        let mut settings: Vec<_> =
            own.iter().map(|(name, value)| (*name, value.as_str())).collect();
        settings.push(("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST"));
        let robot =
            Robot::start_with(&server, dir.path(), "robot-1", 1, &server.url(""), &settings).await;
        Self { robot, server, domain, dir }
    }

    /// Builds the node in advance, for packages that the robot does not build.
    pub async fn build(&self) {
        build(&activate(), &self.dir.path().join("built")).await;
    }

    /// A prebuilt package. Its node gets `arguments`, and its task.toml has `rest` after the
    /// `[run]` table.
    pub fn package(&self, name: &str, version: &str, arguments: &str, rest: &str) -> PathBuf {
        let dir = self.dir.path().join(format!("{name}-{version}"));
        copy(&self.dir.path().join("built/install"), &dir.join("install"));
        write_toml(&dir, name, version, arguments, &format!("{rest}\n[build]\ntool = 'none'\n"));
        dir
    }

    pub async fn push(&self, name: &str, arguments: &str, rest: &str) {
        self.server.push(&self.package(name, "1.0.0", arguments, rest), "*").await;
    }

    pub async fn task(&self, name: &str) -> Option<RobotTask> {
        self.server
            .robot("robot-1")
            .await?
            .tasks
            .into_iter()
            .find(|task| task.task.as_str() == name)
    }

    /// Waits until a task that is built on the robot runs.
    pub async fn builds(&self, name: &str) {
        eventually_within(JOB_PATIENCE, &format!("{name} to be built"), async || {
            let task = self.task(name).await?;
            assert!(!task.phase.is_final(), "{name} is {}: {:?}", task.phase, task.failure);
            (task.phase == Phase::Running).then_some(())
        })
        .await;
    }

    /// Waits until the task is running and healthy.
    pub async fn runs(&self, name: &str) -> RobotTask {
        self.is(name, Phase::Running, |task| task.degraded.is_none().then_some(task)).await
    }

    pub async fn fails(&self, name: &str) -> Failure {
        self.is(name, Phase::Failed, |task| task.failure).await
    }

    /// Waits until a job has succeeded.
    pub async fn succeeds(&self, name: &str) {
        eventually_within(JOB_PATIENCE, &format!("{name} to succeed"), async || {
            let task = self.task(name).await?;
            let is_over = task.phase.is_final() && task.phase != Phase::Succeeded;
            assert!(!is_over, "{name} is {}: {:?}\n{}", task.phase, task.failure, self.log(name));
            (task.phase == Phase::Succeeded).then_some(())
        })
        .await;
    }

    pub async fn degrades(&self, name: &str) -> Failure {
        self.is(name, Phase::Running, |task| task.degraded).await
    }

    pub async fn is<T>(
        &self,
        name: &str,
        phase: Phase,
        which: impl Fn(RobotTask) -> Option<T>,
    ) -> T {
        let mut seen = None;
        let answer = within(TIMEOUT, async || {
            seen = self.task(name).await;
            which(seen.clone().filter(|task| task.phase == phase)?)
        })
        .await;
        answer.unwrap_or_else(|| {
            panic!("{name} was to be {phase}, and is {seen:#?}\n{}", self.log(name))
        })
    }

    /// The process of the task's node, found by these words in its command line.
    fn node(&self, name: &str) -> i32 {
        let needle = format!("tasks/{name}/");
        let found: Vec<i32> = processes_with(self.dir.path().to_str().expect("utf-8").as_bytes())
            .into_iter()
            .filter(|pid| {
                let line = std::fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
                let environment = std::fs::read(format!("/proc/{pid}/environ")).unwrap_or_default();
                let text = String::from_utf8_lossy(&line).into_owned();
                text.contains("graph_probe/probe")
                    && !text.contains("--below")
                    && String::from_utf8_lossy(&environment).contains(&needle)
            })
            .collect();
        assert_eq!(found.len(), 1, "the processes of {name}'s node: {found:?}");
        found[0]
    }

    pub fn signal(&self, name: &str, signal: Signal) {
        kill(Pid::from_raw(self.node(name)), signal).expect("signalled");
    }

    pub async fn say(&self, service: &str) -> String {
        trigger(Path::new(&required("TASKD_TEST_ROS")), &self.domain.id, service).await
    }

    pub fn log(&self, name: &str) -> String {
        std::fs::read_to_string(self.robot.data().join(format!("tasks/{name}/logs/task.log")))
            .unwrap_or_default()
    }
}

/// The script that sets up ROS.
pub fn activate() -> String {
    format!("{}/bin/activate", required("TASKD_TEST_ROS"))
}

fn write_toml(dir: &Path, name: &str, version: &str, arguments: &str, rest: &str) {
    let words =
        ["install/graph_probe/lib/graph_probe/probe"].into_iter().chain(arguments.split(' '));
    let words: Vec<&str> = words.collect();
    let toml = format!(
        "name = {name:?}\nversion = {version:?}\n\
         [run]\nexec = {words:?}\nstop_timeout_s = 30\n{rest}"
    );
    std::fs::write(dir.join("task.toml"), toml).expect("task.toml");
}

/// Builds the package as a person would on their own machine.
async fn build(activate: &str, dir: &Path) {
    copy(&Path::new(env!("CARGO_MANIFEST_DIR")).join(PROBE), &dir.join("src"));
    let mut colcon = tokio::process::Command::new("bash");
    colcon
        .args(["-c", ". \"$0\" && exec colcon build --base-paths src", activate])
        .current_dir(dir);
    let output = colcon.output().await.expect("bash runs");
    assert!(output.status.success(), "colcon: {}", String::from_utf8_lossy(&output.stderr));
}

pub fn copy(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).expect("directory");
    for entry in std::fs::read_dir(from).expect("readable").map(|entry| entry.expect("entry")) {
        let target = to.join(entry.file_name());
        if entry.path().is_dir() {
            copy(&entry.path(), &target);
        } else {
            std::fs::copy(entry.path(), target).expect("copied");
        }
    }
}

pub fn pid_of(task: &RobotTask) -> u32 {
    task.active.as_ref().expect("a process").pid
}

#[tokio::test(flavor = "multi_thread")]
async fn task_runs_once_ros_is_ready_and_stops_gracefully() {
    let stage = Stage::start().await;
    let ready = |what: &str| format!("[ready]\nhold_s = 1\ntimeout_s = 60\n{what}\n");
    // This one is built on the robot.
    let sources = stage.dir.path().join("by-node");
    copy(&Path::new(env!("CARGO_MANIFEST_DIR")).join(PROBE), &sources);
    write_toml(&sources, "by-node", "1.0.0", "--node by_node", &ready("nodes = ['/by_node']"));
    stage.server.push(&sources, "*").await;
    let parameters = "services = ['/say']\n[parameters.'/by_service']\nresolution = 2";
    stage.push("by-service", "--node by_service --service /say", &ready(parameters)).await;
    stage
        .push(
            "by-topic",
            "--node by_topic --topic /ticks --hz 20",
            &ready("topics = { '/ticks' = { min_hz = 10 } }"),
        )
        .await;
    let late = "lifecycle = ['/by_lifecycle']\nservices = ['/ask']\n\
                [parameters.'/by_lifecycle']\nlate = 7\nresolution = 0.5";
    stage
        .push("by-lifecycle", "--node by_lifecycle --lifecycle --service /ask", &ready(late))
        .await;
    stage.builds("by-node").await;
    for name in ["by-node", "by-service", "by-topic", "by-lifecycle"] {
        stage.runs(name).await;
    }
    // An independent client: the parameters have arrived, a whole number as the node's double.
    assert_eq!(
        (stage.say("/say").await, stage.say("/ask").await),
        ("2.0".to_owned(), "0.5".to_owned())
    );

    let asked = Instant::now();
    stage.server.operate(["stop", "by-lifecycle", "--on", "*", "--yes"]).await;
    stage.server.wait_phase("robot-1", "by-lifecycle", Phase::Stopped).await;
    println!("stopped a lifecycle node in {:?}", asked.elapsed());
    assert!(
        stage.log("by-lifecycle").contains("shut down in good order"),
        "{}",
        stage.log("by-lifecycle")
    );
    let asked = Instant::now();
    stage.server.operate(["stop", "by-node", "--on", "*", "--yes"]).await;
    stage.server.wait_phase("robot-1", "by-node", Phase::Stopped).await;
    println!("stopped a plain node in {:?}", asked.elapsed());
}

#[tokio::test(flavor = "multi_thread")]
async fn task_that_never_gets_ready_fails_with_the_missing_condition() {
    let stage = Stage::start().await;
    let by = |timeout_s: u32, what: &str| {
        format!("restart = 'never'\n[ready]\nhold_s = 0\ntimeout_s = {timeout_s}\n{what}\n")
    };
    // A missing item is judged at the deadline, a refused one as soon as the refusal is seen.
    let short = |what: &str| by(30, what);
    let long = |what: &str| by(80, what);
    stage.push("absent", "--node lidar", &short("nodes = ['/mapper']")).await;
    stage
        .push(
            "slow",
            "--node slow --topic /slow --hz 2",
            &short("topics = { '/slow' = { min_hz = 10 } }"),
        )
        .await;
    let negative = long("[parameters.'/picky']\nresolution = -1\nunheard_of = true");
    stage.push("picky", "--node picky", &negative).await;
    stage
        .push(
            "stubborn",
            "--node stubborn --lifecycle --breaks configure",
            &long("lifecycle = ['/stubborn']"),
        )
        .await;

    let mut stranger = Command::new(format!("{}/bin/python3", required("TASKD_TEST_ROS")));
    stranger
        .arg(Path::new(env!("CARGO_MANIFEST_DIR")).join(PROBE).join("graph_probe/probe.py"))
        .args(["--node", "taken"])
        .env("ROS_DOMAIN_ID", &stage.domain.id)
        .env("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        .stdout(Stdio::null());
    let _stranger = Process::spawn(&mut stranger);
    eventually("the robot to see the stranger", async || {
        let nodes = stage.server.try_operate(["node", "list", "robot-1", "-o", "json"]).await;
        String::from_utf8_lossy(&nodes.stdout).contains("\"/taken\"").then_some(())
    })
    .await;
    stage.push("taken", "--node taken --lifecycle", &long("lifecycle = ['/taken']")).await;

    let failures = [
        ("absent", "not_ready", "`/mapper` did not appear within 30 s; on the graph: "),
        (
            "slow",
            "not_ready",
            "`/slow` was not published at 10 Hz within 30 s; it was published at ",
        ),
        ("picky", "parameter_rejected", "`/picky` resolution = -1: must be positive"),
        ("stubborn", "lifecycle_failed", "`/stubborn` failed to configure and is unconfigured"),
        ("taken", "node_name_taken", "`/taken` is already on the graph: process "),
    ];
    for (name, code, text) in failures {
        let failure = stage.fails(name).await;
        assert!(failure.code.as_str() == code && failure.text.contains(text), "{name}: {failure}");
        assert!(name != "absent" || failure.text.contains("`/lidar`"), "{failure}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn lost_readiness_degrades_the_task_with_a_reason() {
    let stage = Stage::start().await;
    let ready =
        |what: &str| format!("restart = 'never'\n[ready]\nhold_s = 0\ntimeout_s = 60\n{what}\n");
    stage.push("crashing", "--node crashing --breaks crash", &ready("nodes = ['/crashing']")).await;
    stage.push("killed", "--node killed --below", &ready("nodes = ['/killed']")).await;
    let topic = ready("topics = { '/ticks' = { min_hz = 5 } }");
    stage.push("silent", "--node silent --topic /ticks --breaks silence", &topic).await;
    stage
        .push(
            "inactive",
            "--node inactive --lifecycle --breaks inactive",
            &ready("lifecycle = ['/inactive']"),
        )
        .await;
    stage
        .push("deaf", "--node deaf --service /say --breaks service", &ready("services = ['/say']"))
        .await;
    let back = "--node back --lifecycle --below --respawn";
    stage.push("back", back, &ready("lifecycle = ['/back']\n[parameters.'/back']\nlate = 2")).await;
    for name in ["crashing", "killed", "silent", "inactive", "deaf", "back"] {
        stage.runs(name).await;
    }
    let before = stage.node("back");
    for name in ["crashing", "silent", "inactive", "deaf"] {
        stage.signal(name, Signal::SIGUSR1);
    }
    stage.signal("killed", Signal::SIGKILL);
    let killed = Instant::now();
    let failure = stage.degrades("killed").await;
    println!("a killed node was noticed after {:?}", killed.elapsed());
    assert_eq!(failure.to_string(), "node_vanished: `/killed` left the graph; its process is gone");
    for (name, code) in
        [("silent", "topic_silent"), ("inactive", "node_inactive"), ("deaf", "service_lost")]
    {
        let failure = stage.degrades(name).await;
        assert_eq!(failure.code.as_str(), code, "{name}: {failure}");
    }
    assert_eq!(stage.fails("crashing").await.code.as_str(), "process_exited");

    // A process that its launcher restarts is brought up again.
    stage.signal("back", Signal::SIGKILL);
    eventually("the node to be active again", async || {
        (stage.log("back").matches("activated with late = 2").count() == 2).then_some(())
    })
    .await;
    stage.runs("back").await;
    assert_ne!(stage.node("back"), before);
}

#[tokio::test(flavor = "multi_thread")]
async fn restarted_agent_adopts_running_tasks_unchanged() {
    let mut stage = Stage::start().await;
    let ready =
        |what: &str| format!("restart = 'never'\n[ready]\nhold_s = 0\ntimeout_s = 60\n{what}\n");
    let kept = ready("lifecycle = ['/kept']\n[parameters.'/kept']\nlate = 2");
    stage.push("kept", "--node kept --lifecycle", &kept).await;
    stage.push("lost", "--node lost --below", &ready("nodes = ['/lost']")).await;
    let (before, _) = (stage.runs("kept").await, stage.runs("lost").await);
    stage.robot.kill();
    stage.signal("lost", Signal::SIGKILL);
    stage.robot.restart();
    // Only the new agent can report this, and by then the agent has checked the other task as well.
    assert_eq!(stage.degrades("lost").await.code.as_str(), "node_vanished");
    let after = stage.runs("kept").await;
    assert_eq!((pid_of(&after), after.restarts), (pid_of(&before), before.restarts));
    assert_eq!(
        stage.log("kept").matches("activated with late = 2").count(),
        1,
        "{}",
        stage.log("kept")
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn version_that_never_gets_ready_is_rolled_back() {
    let stage = Stage::start().await;
    let ready = |node: &str, timeout_s: u32| {
        format!("[ready]\nhold_s = 0\ntimeout_s = {timeout_s}\nlifecycle = ['/{node}']\n")
    };
    stage.push("mapper", "--node mapper --lifecycle", &ready("mapper", 60)).await;
    let before = stage.runs("mapper").await;
    let second =
        stage.package("mapper", "2.0.0", "--node mapper --lifecycle", &ready("better_mapper", 10));
    stage.server.push(&second, "*").await;
    let failure = stage.is("mapper", Phase::RolledBack, |task| task.failure).await;
    assert!(failure.text.contains("`/better_mapper` did not appear within 10 s"), "{failure}");
    let after = stage
        .is("mapper", Phase::RolledBack, |task| {
            let version = task.active.as_ref()?.version.as_str().to_owned();
            (version == "1.0.0" && task.degraded.is_none()).then_some(task)
        })
        .await;
    assert_ne!(pid_of(&after), pid_of(&before));
    // The previous version is on the graph, and active, for any client.
    eventually("the old version to be active again", async || {
        (stage.log("mapper").matches("activated with late = 1").count() == 2).then_some(())
    })
    .await;
}
