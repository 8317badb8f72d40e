//! Known secrets go through the real programs, which log at the highest level, and through users'
//! mistakes: no secret appears in a log, a command line, a URL, an answer or an error, and the few
//! files that hold a secret are readable by their owner only.
#![expect(clippy::disallowed_methods, reason = "a test starts processes")]

use std::collections::BTreeSet;
use std::io::Write as _;
use std::net::SocketAddr;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::sync::mpsc::{Sender, channel};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;

use serde_json::{Value, json};
use task_proto::messages::report::Phase;
use tokio::io::{AsyncBufReadExt as _, AsyncReadExt as _, AsyncWriteExt as _, BufReader};
use tokio::net::{TcpListener, TcpStream};

use crate::harness::{Robot, Server, TIMEOUT, from_restarted_agent, program, write_package};

/// Files that may hold a secret, if only their owner can read them.
const TOKEN_FILES: [&str; 3] = ["operator.token", "identity.json", "credentials.json"];

/// Secrets that must not appear anywhere, each with a description.
#[derive(Default)]
struct Secrets(Vec<(&'static str, String)>);

impl Secrets {
    /// The secret part of a token: its id is no secret.
    fn token(&mut self, what: &'static str, token: &str) {
        let secret = token.trim().split('_').nth(2).unwrap_or_else(|| panic!("{what} is no token"));
        assert_eq!(secret.len(), 64, "{what}");
        self.0.push((what, secret.to_owned()));
    }

    fn found_in(&self, bytes: &[u8]) -> Vec<&'static str> {
        let holds =
            |secret: &String| bytes.windows(secret.len()).any(|window| window == secret.as_bytes());
        self.0.iter().filter(|(_, secret)| holds(secret)).map(|(what, _)| *what).collect()
    }

    #[track_caller]
    fn assert_absent(&self, place: &str, bytes: &[u8]) {
        let found = self.found_in(bytes);
        assert!(found.is_empty(), "{place} holds {found:?}");
    }
}

/// All command lines on this machine during the test.
struct Witness {
    end: Sender<()>,
    watching: JoinHandle<BTreeSet<Vec<u8>>>,
}

impl Witness {
    fn begin() -> Self {
        let (end, ended) = channel();
        let watching = std::thread::spawn(move || {
            let own = std::process::id().to_string();
            let mut seen = BTreeSet::new();
            while ended.recv_timeout(Duration::from_millis(10)).is_err() {
                let processes = std::fs::read_dir("/proc").expect("/proc").flatten();
                let processes = processes.filter(|process| *process.file_name() != *own);
                seen.extend(
                    processes
                        .filter_map(|process| std::fs::read(process.path().join("cmdline")).ok()),
                );
            }
            seen
        });
        Self { end, watching }
    }

    fn end(self) -> BTreeSet<Vec<u8>> {
        self.end.send(()).expect("it watches");
        self.watching.join().expect("no panic")
    }
}

/// Stands before the server and records all bytes sent to the server.
async fn listen_in(target: SocketAddr) -> (SocketAddr, Arc<Mutex<Vec<u8>>>) {
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("port");
    let address = listener.local_addr().expect("bound");
    let heard = Arc::new(Mutex::new(Vec::new()));
    let kept = heard.clone();
    tokio::spawn(async move {
        while let Ok((client, _)) = listener.accept().await {
            tokio::spawn(forward(client, target, kept.clone()));
        }
    });
    (address, heard)
}

async fn forward(client: TcpStream, target: SocketAddr, heard: Arc<Mutex<Vec<u8>>>) {
    let Ok(server) = TcpStream::connect(target).await else { return };
    let (mut from_client, mut to_client) = client.into_split();
    let (mut from_server, mut to_server) = server.into_split();
    let upstream = async {
        let mut buffer = vec![0; 64 * 1024];
        while let Ok(count @ 1..) = from_client.read(&mut buffer).await {
            heard.lock().expect("no panic").extend_from_slice(&buffer[..count]);
            if to_server.write_all(&buffer[..count]).await.is_err() {
                return;
            }
        }
    };
    let downstream = tokio::io::copy(&mut from_server, &mut to_client);
    tokio::select! { () = upstream => {}, _ = downstream => {} }
}

/// Runs the command with `input` on its standard input and accepts any exit status.
async fn run(mut command: Command, input: &str) -> Output {
    let input = input.to_owned();
    let run = move || {
        let mut child = command
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .expect("runs");
        // A command that needs no input may have ended.
        let _ = child.stdin.take().expect("piped").write_all(input.as_bytes());
        child.wait_with_output().expect("ends")
    };
    tokio::task::spawn_blocking(run).await.expect("no panic")
}

/// Runs the command until its standard error contains `words`, then kills the process. Returns the
/// standard error up to there.
async fn run_until(command: Command, words: &str) -> Vec<u8> {
    let mut child = tokio::process::Command::from(command)
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .expect("runs");
    let mut errors = BufReader::new(child.stderr.take().expect("piped"));
    let mut said = Vec::new();
    let reading = async {
        while !String::from_utf8_lossy(&said).contains(words) {
            if errors.read_until(b'\n', &mut said).await.expect("readable") == 0 {
                return false;
            }
        }
        true
    };
    let is_said = tokio::time::timeout(TIMEOUT, reading).await;
    child.kill().await.expect("killed");
    let text = String::from_utf8_lossy(&said);
    assert_eq!(is_said, Ok(true), "no {words:?} within {TIMEOUT:?}, only {text:?}");
    said
}

fn files_below(dir: &Path, found: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(dir).expect("readable").flatten() {
        match entry.file_type().expect("a type") {
            kind if kind.is_dir() => files_below(&entry.path(), found),
            kind if kind.is_file() => found.push(entry.path()),
            _ => {}
        }
    }
}

fn mangled(token: &str) -> String {
    let last = if token.ends_with('0') { '1' } else { '0' };
    format!("{}{last}", &token[..token.len() - 1])
}

/// Users' mistakes with secrets at the command line; each must fail.
async fn misuse_credentials(
    server: &Server,
    dir: &Path,
    secrets: &Secrets,
    tokens: &[String],
    password: &str,
) {
    let url = format!("postgres://u:{password}@127.0.0.1:1/db");
    let file = dir.join("wrong.toml");
    std::fs::write(&file, format!("broker = \"mqtt://u:{password}@host\nhttp = 1"))
        .expect("written");
    let serve = |variables: &[(&str, &str)], arguments: &[&str]| {
        let mut command = Command::new(program("taskd"));
        command.args(["serve", "--data"]).arg(dir.join("none")).args([
            "--http",
            "127.0.0.1:0",
            "--mqtt",
            "127.0.0.1:0",
        ]);
        command.args(arguments).envs(variables.iter().copied());
        command
    };
    let mut wrong = vec![
        serve(&[("TASKD_DATABASE", &url.replace("postgres", "mysql"))], &[]),
        serve(&[("TASKD_BROKER", &format!("mqtt://u:{password}@no host"))], &[]),
        serve(&[], &["--config", file.to_str().expect("utf-8")]),
    ];
    for token in tokens {
        let mut command = server.command(["robot", "list"]);
        command.env("TASKD_TOKEN", mangled(token));
        wrong.push(command);
        let mut enroll = Command::new(program("task-agent"));
        enroll.args(["enroll", "--server", &server.url(""), "--data"]).arg(dir.join("nobody"));
        enroll.env("TASK_AGENT_ENROLL_TOKEN", mangled(token));
        wrong.push(enroll);
    }
    // A server waits for a database that is away, and says so.
    let said = run_until(serve(&[("TASKD_DATABASE", &url)], &[]), "waiting for it").await;
    secrets.assert_absent("a server whose database is away", &said);
    for command in wrong {
        let shown = format!("{command:?}").replace(password, "…");
        let output = run(command, "").await;
        assert!(!output.status.success(), "{shown}");
        secrets.assert_absent(&shown, &[output.stdout, output.stderr].concat());
    }
    // A password is not accepted from places where other users could read the password.
    for (flag, value) in [
        ("--broker", format!("mqtt://u:{password}-seen@127.0.0.1:1")),
        ("--database", format!("{url}-seen")),
    ] {
        let output =
            serve(&[], &[flag, &value.replace(password, "unknown")]).output().expect("runs");
        assert_eq!(output.status.code(), Some(2), "{flag}");
        assert!(!String::from_utf8_lossy(&output.stderr).contains("unknown"), "{flag}");
    }
}

/// The same over HTTP: gives all answers.
async fn send_bad_credentials(server: &Server, tokens: &[String], password: &str) -> Vec<u8> {
    let client = reqwest::Client::new();
    let post = |path: &str, body: Value| {
        client.post(server.url(path)).header("origin", server.url("")).json(&body)
    };
    let mut requests = vec![
        post("/api/v1/login", json!({ "user": "bob", "password": password })),
        post("/api/v1/login", json!({ "user": "alice", "password": [password] })),
        post("/api/v1/login", json!({ "user": "alice", "word": password })),
        post("/api/v1/session", json!({ "token": password })),
        client.get(server.url("/api/v1/robots")).bearer_auth(password),
        client.get(server.url("/api/v1/robots")).basic_auth("x", Some(password)),
    ];
    for token in tokens {
        requests.push(client.get(server.url("/api/v1/robots")).bearer_auth(mangled(token)));
        requests.push(post("/api/v1/session", json!({ "token": mangled(token) })));
    }
    let mut answers = Vec::new();
    for request in requests {
        let answer = request.send().await.expect("an answer");
        assert!(answer.status().is_client_error(), "{}", answer.status());
        answers.extend(answer.bytes().await.expect("a body"));
    }
    answers
}

/// A user with a password signs in, by the command line and at the page. Returns the token of the
/// command line.
async fn person(
    server: &Server,
    dir: &Path,
    proxy: SocketAddr,
    password: &str,
    secrets: &mut Secrets,
) -> String {
    let with_password = |arguments: &[&str]| {
        let mut command = server.command(arguments);
        command.env("XDG_CONFIG_HOME", dir).env("TASKD_SERVER", format!("http://{proxy}"));
        command
    };
    let add = with_password(&["user", "add", "alice", "--role", "admin", "--password-stdin"]);
    assert!(run(add, password).await.status.success());
    let mut login = with_password(&["login", "alice", "--password-stdin"]);
    login.env_remove("TASKD_TOKEN");
    let output = run(login, password).await;
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    secrets.assert_absent("taskd login", &[output.stdout, output.stderr].concat());
    let credentials =
        std::fs::read_to_string(dir.join("taskd/credentials.json")).expect("credentials");
    let signed_in =
        credentials.split('"').find(|text| text.starts_with("tsko_")).expect("a token").to_owned();
    secrets.token("a person's token", &signed_in);
    let origin = format!("http://{proxy}");
    let sign_in =
        reqwest::Client::new().post(format!("{origin}/api/v1/session")).header("origin", &origin);
    let sign_in = sign_in.json(&json!({ "user": "alice", "password": password }));
    let answer = sign_in.send().await.expect("an answer");
    let cookie = answer.headers()["set-cookie"].to_str().expect("text");
    let cookie = cookie.split(['=', ';']).nth(1).expect("a value").to_owned();
    secrets.0.push(("the page's cookie", cookie));
    signed_in
}

/// A robot enrolls, runs a task that prints all its inputs, and is issued a next token. Returns the
/// robot and its tokens.
async fn robot(
    server: &Server,
    dir: &Path,
    proxy: SocketAddr,
    secrets: &mut Secrets,
) -> (Robot, [String; 2]) {
    let enrollment = server.enrollment_token().await;
    secrets.token("the enrollment token", &enrollment);
    let data = dir.join("atlas");
    let mut enroll = Command::new(program("task-agent"));
    enroll.args([
        "enroll",
        "--name",
        "atlas",
        "--mac",
        "02:00:00:00:00:01",
        "--server",
        &format!("http://{proxy}"),
    ]);
    enroll
        .arg("--data")
        .arg(&data)
        .env("TASK_AGENT_ENROLL_TOKEN", &enrollment)
        .env("TASK_AGENT_LOG", "trace");
    let output = run(enroll, "").await;
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let identity = std::fs::read(data.join("identity.json")).expect("read");
    let identity: Value = serde_json::from_slice(&identity).expect("json");
    let token = identity["token"].as_str().expect("a token").to_owned();
    secrets.token("the robot's token", &token);
    secrets.assert_absent("task-agent enroll", &[output.stdout, output.stderr].concat());
    let id = server.robot("atlas").await.expect("listed").id;
    let environment =
        [("TASK_AGENT_LOG", "trace"), ("TASK_AGENT_ENROLL_TOKEN", enrollment.as_str())];
    let mut robot = Robot::enrolled(dir, "atlas", id.clone(), &environment);
    robot.restart();
    let package = dir.join("teller");
    write_package(
        &package,
        "teller",
        "1.0.0",
        "service",
        "env\ncat /proc/self/cmdline\nset\nexec sleep 1000\n",
    );
    server.push(&package, "atlas").await;
    server.wait_phase("atlas", "teller", Phase::Running).await;
    let next = reqwest::Client::new()
        .post(format!("http://{proxy}/api/v1/robots/{id}/token"))
        .bearer_auth(&token);
    let next = from_restarted_agent(next, robot.data());
    let next: Value = next.send().await.expect("sent").json().await.expect("json");
    secrets.token("the robot's next token", next["token"].as_str().expect("a token"));
    (robot, [enrollment, token])
}

/// Reads everything that an administrator can read.
async fn read_all(server: &Server, secrets: &Secrets) {
    let paths = [
        "server",
        "me",
        "users",
        "tokens?all=true",
        "audit",
        "enrollment-tokens",
        "robots",
        "robots/atlas",
    ];
    for path in paths {
        let answer =
            server.get(&format!("/api/v1/{path}")).await.unwrap_or_else(|| panic!("{path}"));
        secrets.assert_absent(path, answer.to_string().as_bytes());
    }
    let out = server.operate(["audit", "--export"]).await;
    assert!(out.contains("robot.enroll"), "{out}");
    secrets.assert_absent("the exported audit", out.as_bytes());
}

/// All that was written below `dir`.
fn look_through(dir: &Path, secrets: &Secrets) {
    let mut files = Vec::new();
    files_below(dir, &mut files);
    for name in ["server.server.log", "atlas.agent.log", "task.log", "taskd.sqlite"] {
        assert!(files.iter().any(|path| path.ends_with(name)), "{name} is looked at");
    }
    for path in files {
        let Ok(bytes) = std::fs::read(&path) else { continue };
        let found = secrets.found_in(&bytes);
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let mode = std::fs::metadata(&path).expect("there").permissions().mode() & 0o777;
        let is_kept = TOKEN_FILES.contains(&name.as_str()) && mode == 0o600 || name == "wrong.toml";
        assert!(found.is_empty() || is_kept, "{} ({mode:o}) holds {found:?}", path.display());
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn secrets_are_in_no_log_command_line_url_answer_or_error() {
    let dir = tempfile::tempdir().expect("temp dir");
    let witness = Witness::begin();
    let mut server =
        Server::start_with(&dir.path().join("server"), &[("TASKD_LOG", "trace")]).await;
    let (proxy, heard) = listen_in(server.http).await;
    let password = format!("hush-{:032x}", rand::random::<u128>());
    let mut secrets = Secrets::default();
    secrets.0.push(("the password", password.clone()));
    secrets.token("the first token", &server.operator_token());
    let signed_in = person(&server, dir.path(), proxy, &password, &mut secrets).await;
    let (mut agent, [enrollment, token]) = robot(&server, dir.path(), proxy, &mut secrets).await;

    let tokens = [server.operator_token(), signed_in, enrollment, token];
    misuse_credentials(&server, dir.path(), &secrets, &tokens, &password).await;
    secrets.assert_absent(
        "an error over HTTP",
        &send_bad_credentials(&server, &tokens, &password).await,
    );
    read_all(&server, &secrets).await;

    agent.terminate();
    server.terminate();
    let lines = witness.end();
    let is_shim = |line: &&Vec<u8>| line.windows(4).any(|word| word == b"shim");
    assert!(
        lines.iter().any(|line| is_shim(&line)),
        "no shim is among {} command lines",
        lines.len()
    );
    lines.iter().for_each(|line| secrets.assert_absent("a command line", line));
    let heard = heard.lock().expect("no panic").clone();
    let shown = secrets.found_in(&heard);
    assert_eq!(
        shown,
        ["the password", "the first token", "the enrollment token", "the robot's token"],
        "the secrets that have to be shown"
    );
    // A body may stand before the next request on its line.
    let lines = heard.split(|&byte| byte == b'\n').filter(|line| line.ends_with(b" HTTP/1.1\r"));
    let urls: Vec<&[u8]> =
        lines.filter_map(|line| line.rsplit(|&byte| byte == b' ').nth(1)).collect();
    assert!(urls.len() > 5, "{}", urls.len());
    urls.iter().for_each(|url| secrets.assert_absent("a URL", url));
    look_through(dir.path(), &secrets);
}
