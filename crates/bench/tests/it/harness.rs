//! Starts the real programs with their own data directories and ports, and stops them. Tests query
//! them only through public interfaces: commands, the HTTP API, files an operator may read.
#![expect(clippy::disallowed_methods, reason = "a test harness starts processes")]

use std::ffi::OsStr;
use std::fs::File;
use std::net::SocketAddr;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use nix::sys::signal::Signal;
use rand::{RngExt as _, SeedableRng as _};
use serde_json::Value;
use task_proto::api::{DeploymentView, INSTANCE_HEADER, PLACE_HEADER, RobotView};
use task_proto::messages::report::Phase;
use task_proto::{CaPin, InstanceId, RobotId};
use task_transport::Trust;
use tempfile::TempDir;

use crate::leftovers;

/// Time limit for any expected event on a busy machine.
pub const TIMEOUT: Duration = Duration::from_secs(90);

/// Maximum number of log lines shown when a test fails.
const MAX_SHOWN: usize = 100;

/// User id of the robots' tasks where the tests run as root, as with agents on real robots: a user
/// that owns nothing.
const TASK_USER: &str = "65534";

/// The path of one of the workspace's programs.
pub fn program(name: &str) -> PathBuf {
    let test = std::env::current_exe().expect("own path");
    let dir = test.parent().and_then(Path::parent).expect("target/debug");
    let path = dir.join(name);
    assert!(
        path.exists(),
        "{} is missing: run `cargo build --bins`, or ./scripts/test",
        path.display()
    );
    path
}

/// Reads an environment variable that `./scripts/test` sets.
pub fn required(variable: &str) -> String {
    std::env::var(variable)
        .unwrap_or_else(|_| panic!("{variable} is not set: run the tests with ./scripts/test"))
}

/// Polls until `ask` returns an answer; fails with `what` after [`TIMEOUT`].
pub async fn eventually<T>(what: &str, ask: impl AsyncFnMut() -> Option<T>) -> T {
    eventually_within(TIMEOUT, what, ask).await
}

/// The same with another time limit, for events that take longer than most.
pub async fn eventually_within<T>(
    patience: Duration,
    what: &str,
    ask: impl AsyncFnMut() -> Option<T>,
) -> T {
    within(patience, ask)
        .await
        .unwrap_or_else(|| panic!("after {patience:?} still waiting for {what}"))
}

/// Polls until `ask` returns an answer or `patience` ends.
pub async fn within<T>(patience: Duration, mut ask: impl AsyncFnMut() -> Option<T>) -> Option<T> {
    let start = Instant::now();
    let mut tick = tokio::time::interval(Duration::from_millis(50));
    loop {
        tick.tick().await;
        let answer = ask().await;
        if answer.is_some() || start.elapsed() >= patience {
            return answer;
        }
    }
}

/// A client that trusts the certificate authority with this pin, if there is one.
fn client(pin: Option<CaPin>) -> reqwest::Client {
    // For clients that a test makes itself. A second install is refused because the first is in
    // place.
    let _ = rustls::crypto::ring::default_provider().install_default();
    let tls = Trust::by(pin).client_config(task_agent::system::clock::for_certificates());
    let client =
        reqwest::Client::builder().timeout(Duration::from_secs(20)).tls_backend_preconfigured(tls);
    client.build().expect("client")
}

/// A child process that is killed when the test ends.
pub struct Process(Child);

impl Process {
    pub fn spawn(command: &mut Command) -> Self {
        Self(command.stdin(Stdio::null()).spawn().expect("program starts"))
    }

    /// Sends SIGKILL, which acts like a power cut.
    pub fn kill(&mut self) {
        self.0.kill().expect("killable");
        self.0.wait().expect("reaped");
    }

    /// Sends SIGTERM and returns the exit code.
    pub fn terminate(&mut self) -> Option<i32> {
        self.signal(Signal::SIGTERM);
        self.0.wait().expect("reaped").code()
    }

    /// The exit code, once the process has ended by itself.
    fn exit_code(&mut self) -> Option<i32> {
        self.0.try_wait().expect("a child")?.code()
    }

    /// Sends any signal.
    pub fn signal(&self, signal: Signal) {
        let pid = nix::unistd::Pid::from_raw(i32::try_from(self.0.id()).expect("pid"));
        nix::sys::signal::kill(pid, signal).expect("signalled");
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// A `taskd serve` with its own data directory. Its ports stay the same over restarts.
pub struct Server {
    process: Option<Process>,
    data: PathBuf,
    settings: Vec<(String, String)>,
    pub http: SocketAddr,
    pub mqtt: SocketAddr,
    /// Pin of its certificate authority, if the server encrypts.
    pub pin: Option<CaPin>,
    client: reqwest::Client,
}

impl Server {
    pub async fn start(data: &Path) -> Self {
        Self::start_with(data, &[]).await
    }

    /// Starts with further `TASKD_*` settings.
    pub async fn start_with(data: &Path, settings: &[(&str, &str)]) -> Self {
        let server = Self::start_unready(data, settings).await;
        server.wait_ready().await;
        server
    }

    /// Starts a server at these addresses, which an earlier server has released.
    pub async fn start_at(
        data: &Path,
        settings: &[(&str, &str)],
        http: SocketAddr,
        mqtt: SocketAddr,
    ) -> Self {
        let mut server = Self::new(data, settings);
        (server.http, server.mqtt) = (http, mqtt);
        server.restart().await;
        server
    }

    /// Starts a server that lacks something that readiness requires.
    pub async fn start_unready(data: &Path, settings: &[(&str, &str)]) -> Self {
        let mut server = Self::new(data, settings);
        server.launch().await;
        server
    }

    fn new(data: &Path, settings: &[(&str, &str)]) -> Self {
        let any: SocketAddr = ([127, 0, 0, 1], 0).into();
        Self {
            process: None,
            data: data.to_owned(),
            settings: settings.iter().map(|(k, v)| ((*k).to_owned(), (*v).to_owned())).collect(),
            http: any,
            mqtt: any,
            pin: None,
            client: client(None),
        }
    }

    /// Starts a server that ends by itself; returns its exit code and its log.
    pub async fn start_refused(data: &Path, settings: &[(&str, &str)]) -> (i32, String) {
        let mut server = Self::new(data, settings);
        server.spawn();
        (server.wait_ended().await, server.log())
    }

    /// Waits until the server has ended by itself, and returns its exit code.
    pub async fn wait_ended(&mut self) -> i32 {
        let process = self.process.as_mut().expect("server runs");
        eventually("taskd to end", async || process.exit_code()).await
    }

    /// The log of all of its starts.
    pub fn log(&self) -> String {
        std::fs::read_to_string(self.data.with_extension("server.log")).expect("a log")
    }

    fn spawn(&mut self) {
        let log = log_file(&self.data.with_extension("server.log"));
        let mut command = Command::new(program("taskd"));
        command.arg("serve").arg("--data").arg(&self.data);
        command.args(["--http", &self.http.to_string(), "--mqtt", &self.mqtt.to_string()]);
        command.envs(self.settings.iter().map(|(k, v)| (k, v)));
        command.stdout(log.try_clone().expect("log")).stderr(log);
        self.process = Some(Process::spawn(&mut command));
    }

    async fn launch(&mut self) {
        let addresses = self.data.join("addresses.json");
        let _ = std::fs::remove_file(&addresses);
        self.spawn();
        let found: Value = eventually("taskd to write its addresses", async || {
            serde_json::from_slice(&std::fs::read(&addresses).ok()?).ok()
        })
        .await;
        let address = |key: &str| {
            found[key].as_str().and_then(|a| a.parse().ok()).unwrap_or_else(|| panic!("{found}"))
        };
        (self.http, self.mqtt) = (address("http"), address("mqtt"));
        self.pin = found["ca_pin"].as_str().map(|pin| pin.parse().expect("a pin"));
        self.client = client(self.pin);
    }

    pub async fn wait_ready(&self) {
        eventually("taskd to be ready", async || {
            (self.readiness().await?["status"] == "ready").then_some(())
        })
        .await;
    }

    /// Waits until this robot's session is established.
    pub async fn wait_online(&self, robot: &str) {
        eventually("the robot to be online", async || {
            self.robot(robot).await?.online.then_some(())
        })
        .await;
    }

    /// The response of `/readyz`.
    pub async fn readiness(&self) -> Option<Value> {
        self.client.get(self.url("/readyz")).send().await.ok()?.json().await.ok()
    }

    /// Restarts the server with another setting; `None` removes the setting. The MQTT port changes.
    pub async fn restart_with(&mut self, name: &str, value: Option<&str>) {
        self.terminate();
        self.set(name, value);
        self.mqtt.set_port(0);
        self.launch().await;
    }

    /// Changes a setting from the next start on; `None` restores the default.
    pub fn set(&mut self, name: &str, value: Option<&str>) {
        self.settings.retain(|(known, _)| known != name);
        self.settings.extend(value.map(|value| (name.to_owned(), value.to_owned())));
    }

    pub fn data(&self) -> &Path {
        &self.data
    }

    pub fn kill(&mut self) {
        self.process.take().expect("server runs").kill();
    }

    pub fn terminate(&mut self) -> Option<i32> {
        self.process.take().expect("server runs").terminate()
    }

    pub fn signal(&self, signal: Signal) {
        self.process.as_ref().expect("server runs").signal(signal);
    }

    /// Restarts the server on the same data and ports.
    pub async fn restart(&mut self) {
        self.launch().await;
        self.wait_ready().await;
    }

    pub fn url(&self, path: &str) -> String {
        let scheme = if self.pin.is_some() { "https" } else { "http" };
        format!("{scheme}://{}{path}", self.http)
    }

    pub fn operator_token(&self) -> String {
        std::fs::read_to_string(self.data.join("operator.token"))
            .expect("operator.token")
            .trim()
            .to_owned()
    }

    /// A request as the operator.
    pub fn request(&self, method: reqwest::Method, path: &str) -> reqwest::RequestBuilder {
        self.client.request(method, self.url(path)).bearer_auth(self.operator_token())
    }

    /// `GET` as the operator; `None` while the server is down.
    pub async fn get(&self, path: &str) -> Option<Value> {
        let answer =
            self.client.get(self.url(path)).bearer_auth(self.operator_token()).send().await.ok()?;
        answer.status().is_success().then_some(())?;
        answer.json().await.ok()
    }

    pub async fn robot(&self, robot: &str) -> Option<RobotView> {
        serde_json::from_value(self.get(&format!("/api/v1/robots/{robot}")).await?).ok()
    }

    pub async fn deployment(&self, id: &str) -> Option<DeploymentView> {
        serde_json::from_value(self.get(&format!("/api/v1/deployments/{id}")).await?).ok()
    }

    /// Waits until `robot` has `task` in `phase`, and returns the robot.
    pub async fn wait_phase(&self, robot: &str, task: &str, phase: Phase) -> RobotView {
        eventually(&format!("{task} on {robot} to be {phase}"), async || {
            let view = self.robot(robot).await?;
            view.tasks.iter().any(|t| t.task.as_str() == task && t.phase == phase).then_some(view)
        })
        .await
    }

    /// The operator's command line, ready to run.
    pub fn command<S: AsRef<OsStr>>(&self, args: impl IntoIterator<Item = S>) -> Command {
        let mut command = Command::new(program("taskd"));
        command.args(args);
        command.env("TASKD_SERVER", self.url("")).env("TASKD_TOKEN", self.operator_token());
        command.envs(self.pin.map(|pin| ("TASKD_PIN", pin.to_string())));
        command.stdin(Stdio::null());
        command
    }

    /// Runs an operator's command that must exit with status 0.
    pub async fn operate<S: AsRef<OsStr>>(&self, args: impl IntoIterator<Item = S>) -> String {
        let output = self.try_operate(args).await;
        let out = String::from_utf8_lossy(&output.stdout);
        let err = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{}\nstdout: {out}\nstderr: {err}", output.status);
        out.into_owned()
    }

    /// Runs an operator's command and accepts any exit status.
    pub async fn try_operate<S: AsRef<OsStr>>(&self, args: impl IntoIterator<Item = S>) -> Output {
        let mut command = self.command(args);
        tokio::task::spawn_blocking(move || command.output().expect("taskd runs"))
            .await
            .expect("no panic")
    }

    /// Uploads `package`, deploys it to `selector` and returns the deployment.
    pub async fn push(&self, package: &Path, selector: &str) -> DeploymentView {
        self.push_with(package, selector, &[]).await
    }

    /// The same with further options.
    pub async fn push_with(
        &self,
        package: &Path,
        selector: &str,
        options: &[&str],
    ) -> DeploymentView {
        let package = package.to_str().expect("utf-8 path");
        let args = [&["push", package, "--to", selector, "--yes", "-o", "json"], options].concat();
        let out = self.operate(args).await;
        serde_json::from_str(&out).unwrap_or_else(|error| panic!("{error}: {out}"))
    }

    pub async fn enrollment_token(&self) -> String {
        let out = self.operate(["enroll-token", "create", "-o", "json"]).await;
        let token: Value = serde_json::from_str(&out).expect("json");
        token["token"].as_str().expect("a token").to_owned()
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        show_log_of_failed(&self.data.with_extension("server.log"));
    }
}

/// A `task-agent` with its own data directory and MAC.
pub struct Robot {
    process: Option<Process>,
    data: PathBuf,
    environment: Vec<(String, String)>,
    pub name: String,
    pub id: RobotId,
}

impl Robot {
    /// Enrolls over `url` (the server's own, or that of a proxy before the server) and starts.
    pub async fn start(server: &Server, dir: &Path, name: &str, number: u8) -> Self {
        Self::start_with(server, dir, name, number, &server.url(""), &[]).await
    }

    pub async fn start_with(
        server: &Server,
        dir: &Path,
        name: &str,
        number: u8,
        url: &str,
        environment: &[(&str, &str)],
    ) -> Self {
        let data = dir.join(name);
        let token = server.enrollment_token().await;
        let environment: Vec<_> =
            environment.iter().map(|(k, v)| ((*k).to_owned(), (*v).to_owned())).collect();
        enroll(&data, number, &environment, &["--server", url, "--token", &token, "--name", name])
            .await;
        let id = server.robot(name).await.expect("an enrolled robot").id;
        let mut robot = Self { process: None, data, environment, name: name.to_owned(), id };
        robot.restart();
        robot
    }

    /// Enrolls the robot anew with this token; the agent must not be running.
    pub async fn enroll_again(&self, number: u8, token: &str) {
        enroll(&self.data, number, &self.environment, &["--token", token, "--force"]).await;
    }

    /// An attacker with this robot's identity who starts an agent elsewhere.
    pub fn stolen(&self, dir: &Path, name: &str) -> Self {
        let data = dir.join(name);
        std::fs::create_dir(&data).expect("directory");
        for file in ["identity.json", "agent.toml"] {
            std::fs::copy(self.data.join(file), data.join(file)).expect("copied");
        }
        let environment = self.environment.clone();
        let id = self.id.clone();
        let mut thief = Self { process: None, data, environment, name: self.name.clone(), id };
        thief.restart();
        thief
    }

    /// A full copy of this robot's current data. Its agent does not run yet.
    pub fn copied(&self, dir: &Path, name: &str) -> Self {
        let data = dir.join(name);
        let copied =
            Command::new("cp").arg("-a").arg(&self.data).arg(&data).status().expect("cp runs");
        assert!(copied.success(), "the data directory is copied");
        let environment = self.environment.clone();
        let id = self.id.clone();
        Self { process: None, data, environment, name: self.name.clone(), id }
    }

    /// A robot that enrolls by itself in the directory `name` below `dir`. Its agent does not run
    /// yet.
    pub fn enrolled(dir: &Path, name: &str, id: RobotId, environment: &[(&str, &str)]) -> Self {
        let environment =
            environment.iter().map(|(k, v)| ((*k).to_owned(), (*v).to_owned())).collect();
        Self { process: None, data: dir.join(name), environment, name: name.to_owned(), id }
    }

    /// Starts the agent, which must not be running.
    pub fn restart(&mut self) {
        assert!(self.process.is_none(), "the agent of {} already runs", self.name);
        let log = log_file(&self.data.with_extension("agent.log"));
        let mut command = Command::new(program("task-agent"));
        command.arg("run").arg("--data").arg(&self.data);
        if nix::unistd::geteuid().is_root() {
            let ros = self
                .environment
                .iter()
                .any(|(name, _)| name.starts_with("ROS_") || name == "TASK_AGENT_UNDERLAYS");
            command.env(
                "TASK_AGENT_TASK_USER",
                if ros && !ros_is_for_all() { "root" } else { TASK_USER },
            );
        }
        command.envs(self.environment.iter().map(|(k, v)| (k, v)));
        command.stdout(log.try_clone().expect("log")).stderr(log);
        self.process = Some(Process::spawn(&mut command));
    }

    pub fn kill(&mut self) {
        self.process.take().expect("agent runs").kill();
    }

    pub fn terminate(&mut self) -> Option<i32> {
        self.process.take().expect("agent runs").terminate()
    }

    /// Sends SIGSTOP: the agent exists and does nothing.
    pub fn freeze(&self) {
        self.process.as_ref().expect("agent runs").signal(Signal::SIGSTOP);
    }

    /// Sends SIGCONT.
    pub fn thaw(&self) {
        self.process.as_ref().expect("agent runs").signal(Signal::SIGCONT);
    }

    pub fn data(&self) -> &Path {
        &self.data
    }
}

impl Drop for Robot {
    /// Tasks outlive the agent on purpose; they must not outlive the test.
    fn drop(&mut self) {
        show_log_of_failed(&self.data.with_extension("agent.log"));
        self.process = None;
        leftovers::end(&self.data);
    }
}

/// Runs `task-agent enroll` for the robot with this number, which must succeed.
async fn enroll(data: &Path, number: u8, environment: &[(String, String)], options: &[&str]) {
    let mut enroll = Command::new(program("task-agent"));
    enroll.arg("enroll").args(options).args(["--mac", &format!("02:00:00:00:00:{number:02x}")]);
    enroll
        .arg("--data")
        .arg(data)
        .envs(environment.iter().map(|(k, v)| (k, v)))
        .stdin(Stdio::null());
    let output = tokio::task::spawn_blocking(move || enroll.output().expect("task-agent runs"))
        .await
        .expect("no panic");
    assert!(output.status.success(), "enroll: {}", String::from_utf8_lossy(&output.stderr));
}

/// A server and robots named `robot-1`, `robot-2`, …, each in a directory below one that is removed
/// with the test.
pub struct Fleet {
    // Robots end before the server, and both before their directory is removed.
    pub robots: Vec<Robot>,
    pub server: Server,
    pub dir: TempDir,
}

impl Fleet {
    pub async fn start(robots: u8) -> Self {
        let dir = TempDir::new().expect("temp dir");
        let server = Server::start(&dir.path().join("server")).await;
        let mut fleet = Self { robots: Vec::new(), server, dir };
        for number in 1..=robots {
            let robot =
                Robot::start(&fleet.server, fleet.dir.path(), &format!("robot-{number}"), number)
                    .await;
            fleet.robots.push(robot);
        }
        fleet
    }

    /// Writes a package that runs `script` with `sh`, and returns its directory.
    pub fn package(&self, name: &str, version: &str, kind: &str, script: &str) -> PathBuf {
        let dir = self.dir.path().join(format!("{name}-{version}"));
        write_package(&dir, name, version, kind, script);
        dir
    }
}

/// Writes a package without ROS that runs `script` with `sh`.
pub fn write_package(dir: &Path, name: &str, version: &str, kind: &str, script: &str) {
    std::fs::create_dir_all(dir).expect("package directory");
    let toml = format!(
        "name = {name:?}\nversion = {version:?}\n\
         [run]\nexec = [\"sh\", \"main.sh\"]\nkind = {kind:?}\nstop_timeout_s = 2\n\
         [ready]\nhold_s = 0\n"
    );
    std::fs::write(dir.join("task.toml"), toml).expect("task.toml");
    std::fs::write(dir.join("main.sh"), script).expect("main.sh");
}

/// Adds incompressible bytes to a package, so that the same number of bytes is transferred.
pub fn add_ballast(package: &Path, bytes: usize) {
    let mut ballast = vec![0; bytes];
    rand::rngs::SmallRng::seed_from_u64(1).fill(&mut ballast[..]);
    std::fs::write(package.join("ballast.bin"), ballast).expect("ballast");
}

/// Whether any user may run the Python of the ROS that the tests use; a Python in root's home is
/// for root only.
fn ros_is_for_all() -> bool {
    let python = Path::new(&required("TASKD_TEST_ROS")).join("bin/python3");
    let open =
        |path: &Path| path.metadata().is_ok_and(|data| data.permissions().mode() & 0o001 != 0);
    [python.canonicalize().expect("python3"), python].iter().all(|path| path.ancestors().all(open))
}

/// Creates a directory that tasks may write to under any user.
pub fn open_directory(path: &Path) {
    std::fs::create_dir(path).expect("directory");
    std::fs::set_permissions(path, std::fs::Permissions::from_mode(0o1777)).expect("open to all");
}

/// Shows the programs' last log lines when a test has failed, because the test's directory is
/// removed with the test.
#[expect(clippy::print_stderr, reason = "the test runner shows the output of a failed test")]
fn show_log_of_failed(path: &Path) {
    if std::thread::panicking() {
        let log = std::fs::read_to_string(path).unwrap_or_default();
        let lines: Vec<&str> = log.lines().collect();
        let last = &lines[lines.len().saturating_sub(MAX_SHOWN)..];
        eprintln!("---- the end of {}\n{}", path.display(), last.join("\n"));
    }
}

fn log_file(path: &Path) -> File {
    File::options().create(true).append(true).open(path).expect("log file")
}

/// A request in the name of a robot, as its agent sends after a restart in the data directory
/// `data`.
pub fn from_restarted_agent(
    request: reqwest::RequestBuilder,
    data: &Path,
) -> reqwest::RequestBuilder {
    let place = std::fs::File::open(data.join("lock"))
        .and_then(|lock| task_agent::system::place::of(&lock))
        .expect("a place");
    request
        .header(INSTANCE_HEADER, InstanceId::random().as_str())
        .header(PLACE_HEADER, place.to_string())
}
