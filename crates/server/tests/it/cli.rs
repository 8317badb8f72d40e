//! The operator's commands: the real binary against a real server, with robots that only report.

#![expect(clippy::unwrap_used, reason = "a helper of tests may panic as they do")]

use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Output, Stdio};

use serde_json::{Value, json};
use task_proto::api::{EnrollResponse, RobotView};
use taskd::config::Config;
use taskd::serve::Server;
use taskd::system::clock::Clock;
use tempfile::TempDir;

use crate::outputs::{Push, file, output};

/// A server and the directory its operator works in.
pub struct Bench {
    pub server: Option<Server>,
    pub dir: TempDir,
    http: reqwest::Client,
}

/// The result of a finished command.
pub struct Ran {
    pub code: i32,
    pub stdout: String,
    pub stderr: String,
}

impl Ran {
    pub fn json(&self) -> Value {
        serde_json::from_str(&self.stdout)
            .unwrap_or_else(|_| panic!("{}\n{}", self.stdout, self.stderr))
    }

    #[track_caller]
    pub fn expect(self, code: i32, stderr: &str) -> Self {
        assert_eq!(self.code, code, "{}\n{}", self.stdout, self.stderr);
        assert!(self.stderr.contains(stderr), "expected {stderr:?} in {}", self.stderr);
        self
    }
}

impl From<Output> for Ran {
    fn from(output: Output) -> Self {
        Self {
            code: output.status.code().expect("not ended by a signal"),
            stdout: String::from_utf8(output.stdout).unwrap(),
            stderr: String::from_utf8(output.stderr).unwrap(),
        }
    }
}

#[expect(clippy::disallowed_methods, reason = "the test starts the program it tests")]
pub fn command(arguments: &[&str]) -> std::process::Command {
    let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_taskd"));
    command.args(arguments).stdin(Stdio::null());
    for (name, _) in std::env::vars().filter(|(name, _)| name.starts_with("TASKD_")) {
        command.env_remove(name);
    }
    // No user is signed in.
    command.env("XDG_CONFIG_HOME", "/nonexistent");
    command
}

pub async fn run(mut command: std::process::Command) -> Ran {
    tokio::task::spawn_blocking(move || command.output()).await.unwrap().unwrap().into()
}

impl Bench {
    pub async fn start() -> Self {
        Self::start_with(|_| {}, Clock::system()).await
    }

    /// With other settings, and by another clock.
    pub async fn start_with(set: impl FnOnce(&mut Config), clock: Clock) -> Self {
        let _ = rustls::crypto::ring::default_provider().install_default();
        let dir = tempfile::tempdir().unwrap();
        let mut config = Config::with_data(dir.path().join("server"));
        config.http = ([127, 0, 0, 1], 0).into();
        config.mqtt = ([127, 0, 0, 1], 0).into();
        set(&mut config);
        let server = Server::start(config, clock).await.unwrap();
        Self { server: Some(server), dir, http: reqwest::Client::new() }
    }

    /// Stops the server and starts it again at the same addresses.
    async fn restart(&mut self) {
        let stopped = self.stop().await;
        self.go_on(stopped).await;
    }

    /// Stops the server; returns the configuration for its next start.
    pub async fn stop(&mut self) -> Config {
        let mut config = Config::with_data(self.data());
        config.http = self.server().addresses().http.parse().unwrap();
        config.mqtt = self.server().addresses().mqtt.parse().unwrap();
        self.server.take().unwrap().stop().await;
        config
    }

    pub async fn go_on(&mut self, stopped: Config) {
        self.server = Some(Server::start(stopped, Clock::system()).await.unwrap());
    }

    pub fn server(&self) -> &Server {
        self.server.as_ref().unwrap()
    }

    pub fn data(&self) -> PathBuf {
        self.dir.path().join("server")
    }

    /// Runs `taskd` as the operator of this server.
    pub async fn taskd(&self, arguments: &[&str]) -> Ran {
        let mut command = command(arguments);
        command.env("TASKD_DATA", self.data());
        run(command).await
    }

    /// A package of one script; `extra` is more of its task.toml.
    pub fn package(&self, version: &str, extra: &str) -> String {
        let dir = self.dir.path().join(format!("hello-{version}"));
        std::fs::create_dir_all(&dir).unwrap();
        let task =
            format!("name = \"hello\"\nversion = \"{version}\"\n[run]\nexec = [\"true\"]\n{extra}");
        std::fs::write(dir.join("task.toml"), task).unwrap();
        dir.to_str().unwrap().to_owned()
    }

    fn url(&self, path: &str) -> String {
        format!("http://{}/api/v1{path}", self.server().addresses().http)
    }

    pub async fn enroll(&self, number: u8) -> Robot {
        let token = self.taskd(&["enroll-token", "create", "-o", "json"]).await.json()["token"]
            .as_str()
            .unwrap()
            .to_owned();
        let mac = format!("02:00:00:00:00:{number:02x}");
        let body = json!({ "mac": mac, "name": format!("robot-{number}") });
        let answer = self
            .http
            .post(self.url("/enroll"))
            .bearer_auth(token)
            .json(&body)
            .send()
            .await
            .unwrap();
        assert!(answer.status().is_success(), "{}", answer.text().await.unwrap());
        Robot { identity: answer.json().await.unwrap(), seq: 0.into() }
    }

    /// Robot `robot` brings these files back from a task called mapping.
    pub async fn bring_back(&self, robot: &Robot, files: &[(&str, &[u8])]) {
        let EnrollResponse { robot_id, token, .. } = &robot.identity;
        let url =
            format!("http://{}/v2/outputs/{robot_id}/mapping", self.server().addresses().http);
        let push = Push { client: self.http.clone(), url, token: token.clone() };
        let mut set = output(robot_id, 1, Vec::new());
        for (path, bytes) in files {
            set.files.push(file(path, push.blob(bytes).await));
        }
        assert_eq!(push.output(&set).await, 201);
    }

    /// Reports for robot `robot` that all orders are observed, and that the task of `deployment` is
    /// in `phase`.
    pub async fn report(&self, robot: &Robot, deployment: &Value, phase: &str) {
        let mut task = json!({
            "task": "hello", "deployment": deployment["id"], "package": deployment["package"],
            "wanted": "running", "run": 1, "kind": "service", "phase": phase, "phase_ms": 1,
        });
        if phase == "failed" {
            task["failure"] = json!({ "code": "process_exited", "text": "exit code 3" });
        }
        self.report_tasks(robot, json!([task])).await;
    }

    /// Reports for robot `robot` that all orders are done and no task is left.
    async fn report_absence(&self, robot: &Robot) {
        self.report_tasks(robot, json!([])).await;
    }

    async fn report_tasks(&self, robot: &Robot, tasks: Value) {
        let id = &robot.identity.robot_id;
        let view: RobotView = serde_json::from_value(
            self.taskd(&["robot", "info", id.as_str(), "-o", "json"]).await.json(),
        )
        .unwrap();
        let seq = robot.seq.get() + 1;
        robot.seq.set(seq);
        let report = json!({
            "robot_id": id, "start": 1, "instance": "i0123456789abcdef", "boot_id": "b", "seq": seq,
            "observed_generation": view.generation, "uptime_ms": 1,
            "host": { "agent_version": "1", "hostname": "h", "arch": "x86_64" }, "tasks": tasks,
        });
        let url = self.url(&format!("/robots/{id}/report"));
        let answer = self
            .http
            .post(url)
            .bearer_auth(&robot.identity.token)
            .json(&report)
            .send()
            .await
            .unwrap();
        assert!(answer.status().is_success(), "{}", answer.text().await.unwrap());
    }
}

pub struct Robot {
    pub identity: EnrollResponse,
    seq: std::cell::Cell<u64>,
}

/// A version that could not replace another one reports that, and the version that continues.
#[tokio::test(flavor = "multi_thread")]
async fn unmet_run_reports_the_version_that_still_runs() {
    let bench = Bench::start().await;
    let robot = bench.enroll(1).await;
    let order = ["push", &bench.package("1", ""), "--to", "*", "-o", "json"];
    let before = bench.taskd(&order).await.expect(0, "").json();
    bench.report(&robot, &before, "running").await;
    let again = bench.taskd(&["push", &bench.package("1", ""), "--to", "*"]).await;
    again.expect(0, "already running on robot-1; use --restart to restart it");
    let new = bench.package("2", "");
    let run = ["run", "robot-1", &new, "-o", "json", "--timeout", "60s"];
    let (ran, ()) = tokio::join!(bench.taskd(&run), async {
        let newest = loop {
            let list = bench
                .taskd(&["deploy", "list", "-n", "1", "-o", "json"])
                .await
                .expect(0, "")
                .json();
            let newest = list["deployments"][0].clone();
            if newest["package"]["version"] == "2" {
                break newest;
            }
        };
        let task = json!([{
            "task": "hello", "deployment": newest["id"], "package": newest["package"],
            "wanted": "running", "run": 1, "kind": "service", "phase": "unmet", "phase_ms": 1,
            "failure": { "code": "requirements_unmet", "text": "no ros2launch" },
            "active": { "deployment": before["id"], "version": "1", "pid": 7 },
        }]);
        bench.report_tasks(&robot, task).await;
    });
    let said = "robot-1 still runs the previous version, hello 1; \
                the new version does not run: requirements_unmet";
    ran.expect(1, said);
    let list = bench.taskd(&["robot", "list"]).await.expect(0, "").stdout;
    assert!(list.contains("hello:unmet/previous-runs"), "{list}");
}

/// Ctrl-C ends the wait and nothing else, and says how to go on.
#[tokio::test(flavor = "multi_thread")]
async fn interrupted_wait_prints_how_to_watch_and_cancel() {
    let bench = Bench::start().await;
    bench.enroll(1).await;
    let (data, package) = (bench.data().display().to_string(), bench.package("1", ""));
    let mut command = command(&["--data", &data, "push", &package, "--to", "*", "--wait"]);
    let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let interrupted = tokio::task::spawn_blocking(move || {
        let mut lines = BufReader::new(child.stderr.take().unwrap()).lines().map(Result::unwrap);
        // The command waits as soon as it has printed the robot's state.
        let id = lines
            .by_ref()
            .find_map(|line| Some(line.strip_prefix("deployment ")?.split(':').next()?.to_owned()));
        lines.by_ref().find(|line| line.starts_with("robot-1 assigned")).expect("it waits");
        let pid = nix::unistd::Pid::from_raw(child.id().try_into().unwrap());
        nix::sys::signal::kill(pid, nix::sys::signal::Signal::SIGINT).unwrap();
        let said: Vec<String> = lines.collect();
        (id.unwrap(), said, child.wait().unwrap())
    });
    let (id, said, status) = interrupted.await.unwrap();
    assert_eq!(status.code(), Some(130), "{said:?}");
    let expected = [
        "stopped waiting; the deployment continues".to_owned(),
        format!("watch it: taskd deploy watch {id}"),
    ];
    assert_eq!(said[said.len() - 3..][..2], expected);
    assert_eq!(said.last(), Some(&format!("cancel it: taskd deploy cancel {id}")));
    let view = bench.taskd(&["deploy", "info", &id, "-o", "json"]).await.expect(0, "").json();
    assert_eq!(view["state"], "active");
}

#[tokio::test(flavor = "multi_thread")]
async fn second_push_of_the_same_tree_transfers_no_blob() {
    let bench = Bench::start().await;
    let package = bench.package("1", "");
    let first = bench.taskd(&["push", &package, "-o", "json"]).await.expect(0, "2 blobs uploaded");
    let second =
        bench.taskd(&["push", &package, "-o", "json"]).await.expect(0, "nothing to upload");
    assert_eq!(first.json(), second.json());
    let packed = bench.taskd(&["-o", "json", "pack", &package]).await.expect(0, "");
    assert_eq!(packed.json(), first.json());
}

#[tokio::test(flavor = "multi_thread")]
async fn exit_codes_tell_refusals_from_failures() {
    let bench = Bench::start().await;
    let list = ["robot", "list"];
    bench.taskd(&list).await.expect(0, "");
    let other =
        task_proto::trust::token::Token::random(task_proto::trust::token::TokenKind::Operator)
            .reveal();
    bench.taskd(&["robot", "list", "--token", &other]).await.expect(4, "");
    bench.taskd(&["robot", "list", "--token", "secret"]).await.expect(2, "not a token");
    bench.taskd(&["robot", "list", "--server", "nonsense"]).await.expect(2, "--server");
    bench
        .taskd(&["robot", "list", "--server", "http://127.0.0.1:9"])
        .await
        .expect(2, "no token for http://127.0.0.1:9");
    bench.taskd(&["robot", "list", "--nonsense"]).await.expect(2, "--nonsense");
    let mut without = command(&list);
    without.env("HOME", "/nonexistent").env("XDG_DATA_HOME", "/nonexistent");
    run(without).await.expect(2, "no token");
    let nobody = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let nobody = format!("http://{nobody}");
    bench
        .taskd(&["robot", "list", "--token", &other, "--server", &nobody])
        .await
        .expect(1, "can't reach the server");
}

#[tokio::test(flavor = "multi_thread")]
async fn mistakes_are_reported_before_any_upload() {
    let bench = Bench::start().await;
    let package = bench.package("1", "");
    bench.taskd(&["push", &package, "--to", "*"]).await.expect(2, "no robots match *");
    let wrong = bench.package("2", "kindd = \"job\"\n[redy]\n");
    let ran = bench
        .taskd(&["push", &wrong])
        .await
        .expect(2, "task.toml: run.kindd: unknown key (did you mean run.kind?)");
    assert!(
        ran.stderr.contains("task.toml: redy: unknown key (did you mean ready?)"),
        "{}",
        ran.stderr
    );
    bench.taskd(&["push", "/nonexistent"]).await.expect(2, "no such directory");
    // The package is checked before the robots are selected.
    bench.taskd(&["push", "/nonexistent", "--to", "*"]).await.expect(2, "no such directory");
    let packages = bench
        .http
        .get(bench.url("/packages"))
        .bearer_auth(std::fs::read_to_string(bench.data().join("operator.token")).unwrap().trim());
    let packages: Value = packages.send().await.unwrap().json().await.unwrap();
    assert_eq!(packages["packages"], json!([]));
}

#[tokio::test(flavor = "multi_thread")]
async fn waiting_ends_with_the_outcome_of_all_robots() {
    let bench = Bench::start().await;
    let (one, two) = (bench.enroll(1).await, bench.enroll(2).await);
    let package = bench.package("1", "");
    let order = ["push", &package, "--to", "*", "--idempotency-key", "first", "-o", "json"];
    let wait = [&order[..], &["--wait", "--timeout", "5s"]].concat();
    let deployment = bench.taskd(&order).await.expect(0, "to 2 robots").json();
    let late = bench.taskd(&wait).await.expect(5, "0 of 2 succeeded");
    assert_eq!(late.json()["id"], deployment["id"], "the same key is the same order");

    bench.report(&one, &deployment, "running").await;
    bench.report(&two, &deployment, "failed").await;
    let wait = [&order[..], &["--wait", "--timeout", "1m"]].concat();
    bench.taskd(&wait).await.expect(3, "robot-2: failed (process_exited: exit code 3)");

    let order = [
        "push",
        &package,
        "--to",
        "robot-1",
        "--restart",
        "--idempotency-key",
        "second",
        "-o",
        "json",
    ];
    let wait = [&order[..], &["--wait", "--timeout", "1m"]].concat();
    let deployment = bench.taskd(&order).await.expect(0, "supersedes").json();
    bench.report(&one, &deployment, "running").await;
    bench.taskd(&wait).await.expect(0, "1 of 1 succeeded");
    bench.report(&one, &deployment, "failed").await;
    bench.taskd(&wait).await.expect(1, "robot-1: failed");
}

#[tokio::test(flavor = "multi_thread")]
async fn waiting_survives_a_restart_of_the_server() {
    let mut bench = Bench::start().await;
    let robot = bench.enroll(1).await;
    let package = bench.package("1", "");
    let order = ["push", &package, "--to", "*", "--idempotency-key", "k", "-o", "json"];
    let deployment = bench.taskd(&order).await.json();
    let mut waiting = command(&[&order[..], &["--wait", "--timeout", "1m"]].concat());
    waiting.env("TASKD_DATA", bench.data()).stdout(Stdio::null()).stderr(Stdio::piped());
    let mut waiting = waiting.spawn().unwrap();
    let mut stderr = BufReader::new(waiting.stderr.take().unwrap()).lines();
    // From here on the command only waits.
    assert!(stderr.any(|line| line.unwrap().starts_with("deployment ")));
    bench.restart().await;
    bench.report(&robot, &deployment, "running").await;
    let said: Vec<String> =
        tokio::task::spawn_blocking(move || stderr.map(Result::unwrap).collect()).await.unwrap();
    assert_eq!(waiting.wait().unwrap().code(), Some(0), "{said:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn orders_on_many_robots_need_confirmation() {
    let bench = Bench::start().await;
    for number in 1..=11 {
        bench.enroll(number).await;
    }
    let package = bench.package("1", "");
    let dry = bench
        .taskd(&["push", &package, "--to", "*", "--dry-run", "-o", "json"])
        .await
        .expect(0, "");
    assert_eq!(dry.json()["robots"].as_array().unwrap().len(), 11);
    bench.taskd(&["push", &package, "--to", "*"]).await.expect(2, "confirm with --yes");
    bench.taskd(&["push", &package, "--to", "*", "--yes"]).await.expect(0, "to 11 robots");
    bench.taskd(&["stop", "hello", "--on", "*"]).await.expect(2, "confirm with --yes");
    bench.taskd(&["stop", "hello", "--on", "robot-3"]).await.expect(0, "stop hello on 1 robot");
    bench.taskd(&["stop", "other", "--on", "*"]).await.expect(2, "has the task other");
}

#[tokio::test(flavor = "multi_thread")]
async fn robots_and_deployments_are_shown_and_removed() {
    let bench = Bench::start().await;
    let robot = bench.enroll(7).await;
    let id = robot.identity.robot_id.as_str();
    let list = bench.taskd(&["robot", "list"]).await.expect(0, "");
    let data = bench.data().display().to_string();
    for order in [
        ["--data", &data, "robot", "list"],
        ["robot", "--data", &data, "list"],
        ["robot", "list", "--data", &data],
    ] {
        assert_eq!(
            run(command(&order)).await.expect(0, "").stdout,
            list.stdout,
            "options stand anywhere"
        );
    }
    assert!(
        list.stdout.contains("robot-7") && !list.stdout.contains("02:00:00:00:00:07"),
        "{}",
        list.stdout
    );
    let wide = bench.taskd(&["robot", "list", "-o", "wide"]).await.expect(0, "");
    assert!(wide.stdout.contains("02:00:00:00:00:07"), "{}", wide.stdout);
    let deployment =
        bench.taskd(&["push", &bench.package("1", ""), "--to", "*", "-o", "json"]).await.json();
    let deployment = deployment["id"].as_str().unwrap();
    let shown = bench.taskd(&["deploy", "info", deployment]).await.expect(0, "");
    assert!(
        shown.stdout.contains("robot-7") && shown.stdout.contains("assigned"),
        "{}",
        shown.stdout
    );
    assert!(shown.stdout.contains("delivery    adaptive\n"), "{}", shown.stdout);
    assert!(shown.stdout.contains("method      inline: rule \"tiny\", size "), "{}", shown.stdout);
    assert!(!shown.stdout.contains("DELIVERY"), "{}", shown.stdout);
    let shown = bench.taskd(&["deploy", "info", deployment, "--robots"]).await.expect(0, "");
    assert!(
        shown.stdout.contains("DELIVERY") && shown.stdout.matches("rule \"tiny\"").count() == 2,
        "{}",
        shown.stdout
    );
    assert!(bench.taskd(&["deploy", "list"]).await.expect(0, "").stdout.contains(deployment));
    let (directory, ordered) = (bench.package("1", ""), ["--delivery", "poll", "--priority", "-7"]);
    let urgent = bench
        .taskd(&[&["push", &directory, "--to", "*"], &ordered[..]].concat())
        .await
        .expect(0, "");
    for said in [
        "delivery    poll\n",
        "priority    -7\n",
        "method      poll: ordered, the order says poll\n",
    ] {
        assert!(urgent.stdout.contains(said), "{}", urgent.stdout);
    }
    let refused = bench.taskd(&["push", &directory, "--to", "*", "--priority", "101"]).await;
    refused.expect(2, "101 is not in -100..=100");
    let refused = bench.taskd(&["push", &directory, "--to", "*", "--delivery", "by-pigeon"]).await;
    refused.expect(2, "[possible values: adaptive, push-pull, direct-push, poll, inline]");
    let cancelled =
        bench.taskd(&["deploy", "cancel", deployment, "-o", "json"]).await.expect(0, "cancel");
    assert_eq!(cancelled.json()["state"], "cancelled");
    bench.taskd(&["deploy", "info", "d0000000000000000"]).await.expect(1, "not_found");
    bench.taskd(&["robot", "rm", "robot-7"]).await.expect(2, "confirm with --yes");
    bench.taskd(&["robot", "rm", "robot-7", "--yes"]).await.expect(0, id);
    bench
        .taskd(&["robot", "rm", "robot-7", "--yes"])
        .await
        .expect(2, "no robot has the name or id robot-7");
    bench
        .taskd(&["robot", "info", "robot-7"])
        .await
        .expect(2, "no robot has the name or id robot-7");
}

#[tokio::test(flavor = "multi_thread")]
async fn version_names_the_package_that_was_force_pushed_last() {
    let bench = Bench::start().await;
    let robot = bench.enroll(1).await;
    let push = async |extra: &str| {
        let push = ["push", &bench.package("1", extra), "--force", "-o", "json"];
        bench.taskd(&push).await.expect(0, "").json()["manifest"]["digest"].clone()
    };
    let first = push("").await;
    let order = ["push", &bench.package("1", ""), "--to", "*", "-o", "json"];
    let deployment = bench.taskd(&order).await.expect(0, "").json();
    bench.report(&robot, &deployment, "running").await;
    let changed = bench.package("1", "[ready]\nhold_s = 9\n");
    let refused = bench.taskd(&["push", &changed, "--to", "*"]).await;
    let said = format!(
        "hello 1 already exists on the server with other content ({}",
        first.as_str().unwrap()
    );
    assert!(refused.expect(2, &said).stderr.contains("raise the version"));
    let list = async || bench.taskd(&["robot", "list"]).await.expect(0, "").stdout;
    assert!(list().await.contains("hello:running") && !list().await.contains("outdated"));
    let second = push("[ready]\nhold_s = 9\n").await;
    assert!(list().await.contains("hello:running/outdated"), "{}", list().await);
    let info = bench.taskd(&["robot", "info", "robot-1"]).await.expect(0, "").stdout;
    assert!(info.contains("1 (outdated)"), "{info}");
    let info = bench
        .taskd(&["deploy", "info", deployment["id"].as_str().unwrap()])
        .await
        .expect(0, "")
        .stdout;
    assert!(info.contains("a forced push replaced this version"), "{info}");
    let meant = async || {
        let info =
            bench.taskd(&["package", "info", "hello:1", "-o", "json"]).await.expect(0, "").json();
        info["package"]["manifest"]["digest"].clone()
    };
    assert_eq!(meant().await, second);
    // It is known since before the other one.
    assert_eq!((push("").await, meant().await), (first.clone(), first));
}

#[tokio::test(flavor = "multi_thread")]
async fn truncated_list_says_so() {
    let bench = Bench::start().await;
    bench.enroll(1).await;
    for version in ["1", "2", "3"] {
        bench.taskd(&["push", &bench.package(version, ""), "--to", "*"]).await.expect(0, "");
    }
    let list =
        async |limit: &str| bench.taskd(&["deploy", "list", "-n", limit, "-o", "json"]).await;
    let versions = |ran: Ran| -> Vec<String> {
        let list = ran.json()["deployments"].as_array().unwrap().clone();
        list.iter().map(|one| one["package"]["version"].as_str().unwrap().to_owned()).collect()
    };
    assert_eq!(
        versions(list("2").await.expect(0, "older deployments are not shown; use -n to show more")),
        ["3", "2"]
    );
    let whole = list("3").await;
    assert!(!whole.stderr.contains("not shown"), "{}", whole.stderr);
    assert_eq!(versions(whole), ["3", "2", "1"]);
}

#[tokio::test(flavor = "multi_thread")]
async fn removing_a_task_can_be_waited_for() {
    let bench = Bench::start().await;
    let robot = bench.enroll(1).await;
    let push = ["push", &bench.package("1", ""), "--to", "*", "-o", "json"];
    let deployment = bench.taskd(&push).await.expect(0, "").json();
    bench.report(&robot, &deployment, "running").await;
    let remove = ["remove", "hello", "--on", "*", "--idempotency-key", "k", "--wait"];
    let late = [&remove[..], &["--timeout", "5s"]].concat();
    bench.taskd(&late).await.expect(5, "robot-1: timed out");
    bench.report_absence(&robot).await;
    bench.taskd(&remove).await.expect(0, "removed hello from 1 robot");
}

#[tokio::test(flavor = "multi_thread")]
async fn server_info_shows_the_traffic() {
    let bench = Bench::start().await;
    let told = bench.taskd(&["server", "info"]).await.expect(0, "");
    assert!(told.stdout.contains("0 accepted, 0 refused"), "{}", told.stdout);
    let told = bench.taskd(&["server", "info", "-o", "json"]).await.expect(0, "").json();
    assert_eq!(told["traffic"]["all"]["bytes_in"], 0);
    let requests = told["http"]["requests"].as_u64().expect("a count");
    assert!(requests >= 2 && told["http"]["bytes_in"].as_u64() > Some(requests * 40), "{told}");
}

#[tokio::test(flavor = "multi_thread")]
async fn closed_pipe_does_not_panic() {
    let bench = Bench::start().await;
    let mut list = command(&["robot", "list"]);
    list.env("TASKD_DATA", bench.data()).stdout(closed_pipe()).stderr(Stdio::piped());
    run(list).await.expect(0, "");
    let mut help = command(&["push", "--help"]);
    help.stdout(closed_pipe()).stderr(Stdio::piped());
    let help = run(help).await;
    assert!(!help.stderr.contains("panicked"), "{}", help.stderr);
}

/// A pipe with a closed reading end.
pub fn closed_pipe() -> Stdio {
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    writer.into()
}

#[tokio::test(flavor = "multi_thread")]
async fn examples_can_be_packed() {
    let examples = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples");
    for name in ["talker", "plain"] {
        run(command(&["pack", examples.join(name).to_str().unwrap()])).await.expect(0, "");
    }
}
