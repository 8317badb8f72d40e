//! Starting and stopping: the directory's content, the data that survives, and the work that a stop
//! waits for.

use std::io::{BufRead as _, BufReader};
use std::os::unix::fs::PermissionsExt as _;
use std::process::{Child, Stdio};
use std::time::{Duration, Instant};

use nix::sys::signal::Signal;
use reqwest::{Method, StatusCode};
use serde_json::{Value, json};
use task_proto::messages::report::Phase;
use task_proto::messages::topic::RobotTopic;
use taskd::config::Config;
use taskd::serve::{ServeError, Server};
use taskd::system::clock::Clock;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpSocket, TcpStream};

use crate::harness::{TestServer, answer};
use crate::mqtt_harness::{Connect, Raw, publish, topic};

#[tokio::test(flavor = "multi_thread")]
async fn first_start_creates_private_files() {
    let server = TestServer::start().await;
    let mode =
        |name: &str| server.data().join(name).metadata().expect(name).permissions().mode() & 0o777;
    assert_eq!(mode(""), 0o700);
    assert_eq!((mode("operator.token"), mode("signing.key")), (0o600, 0o600));
    let addresses = std::fs::read(server.data().join("addresses.json")).expect("published");
    let addresses: task_proto::data_directory::Addresses =
        serde_json::from_slice(&addresses).expect("json");
    assert_eq!(addresses, *server.server.addresses());
    for path in ["/healthz", "/readyz"] {
        let status = server.bare(Method::GET, path).send().await.expect("an answer").status();
        assert_eq!(status, StatusCode::OK, "{path}");
    }
    let addresses = server.data().join("addresses.json");
    let _directory = server.stop().await;
    assert!(!addresses.exists());
}

#[tokio::test(flavor = "multi_thread")]
async fn idle_server_stops_without_waiting_for_reports() {
    let server = TestServer::start().await;
    let begun = Instant::now();
    let _directory = server.stop().await;
    let elapsed = begun.elapsed();
    // The time that a stop gives to reports that are not stored yet.
    assert!(elapsed < Duration::from_secs(3), "{elapsed:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn readyz_asked_often_writes_seldom() {
    let server = TestServer::start().await;
    let probe = server.data().join(".ready");
    let mut written = 0;
    for _ in 0..100 {
        // The background check may write the file again at any time.
        written += usize::from(std::fs::remove_file(&probe).is_ok());
        let response = server.bare(Method::GET, "/readyz").send().await.expect("an answer");
        assert_eq!(response.status(), StatusCode::OK);
    }
    assert!(
        (1..50).contains(&written),
        "{written} of 100 requests found that the file was written"
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn second_server_on_the_same_directory_is_refused() {
    let server = TestServer::start().await;
    let mut config = Config::with_data(server.data().to_owned());
    config.http.set_port(0);
    config.mqtt.set_port(0);
    let second = Server::start(config, Clock::system()).await.err().expect("refused");
    assert!(
        matches!(second, ServeError::Data(_))
            && second.to_string().contains("another taskd serves from it")
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn idle_connections_are_closed_at_the_connection_limit() {
    let directory = tempfile::tempdir().expect("a directory");
    let server = TestServer::start_in(directory, |config| config.max_http_connections = 2).await;
    let (mut streams, request) = (Vec::new(), b"GET /healthz HTTP/1.1\r\nhost: x\r\n\r\n");
    for _ in 0..5 {
        let mut stream =
            TcpStream::connect(&server.server.addresses().http).await.expect("a connection");
        stream.write_all(request).await.expect("sent");
        let mut answer = [0; 12];
        // Earlier than the timeout for clients without a request.
        let read =
            tokio::time::timeout(Duration::from_secs(15), stream.read_exact(&mut answer)).await;
        read.expect("a place in time").expect("an answer");
        assert_eq!(&answer, b"HTTP/1.1 200");
        // Each stays open on this side.
        streams.push(stream);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn restart_keeps_everything() {
    let server = TestServer::start().await;
    let mut robot = server.enroll("atlas").await;
    let package = server.push("talker", "1.0.0").await;
    let ordered = server.deploy(&package, "*", "key-1").await;
    let state = server.desired(&robot).await;
    server.report(&mut robot, &state, Phase::Running).await;
    let operator = server.operator.clone();

    let server = server.restart().await;
    assert_eq!(server.operator, operator);
    assert_eq!(server.desired(&robot).await.tasks, state.tasks);
    assert_eq!(server.robot(&robot).await.tasks[0].phase, Phase::Running);
    assert_eq!(server.deploy(&package, "*", "key-1").await.id, ordered.id);
    let path = format!("/v2/talker/blobs/{}", package.content.digest);
    let blob =
        server.bare(Method::GET, &path).bearer_auth(&robot.token).send().await.expect("an answer");
    assert_eq!(blob.status(), StatusCode::OK);
}

#[tokio::test(flavor = "multi_thread")]
async fn stop_under_load_loses_no_answered_report() {
    let server = TestServer::start().await;
    let package = server.push("talker", "1.0.0").await;
    let mut robots = Vec::new();
    for n in 0..16 {
        robots.push(server.enroll(&format!("robot-{n}")).await);
    }
    server.deploy(&package, "*", "key-1").await;
    let mut asking = tokio::task::JoinSet::new();
    for mut robot in robots {
        let report = robot.next_report(&server.desired(&robot).await, Phase::Running);
        let request = server.bare(Method::POST, &format!("/api/v1/robots/{}/report", robot.id));
        let request = request.bearer_auth(&robot.token).json(&report);
        asking.spawn(async move {
            (robot, request.send().await.is_ok_and(|answer| answer.status().is_success()))
        });
    }
    // One answer is there, the others are somewhere under way.
    let mut answered: Vec<_> =
        asking.join_next().await.into_iter().collect::<Result<_, _>>().expect("no panic");
    let server = server.restart().await;
    answered.extend(asking.join_all().await);
    for (robot, was_stored) in answered {
        let phase = server.robot(&robot).await.tasks[0].phase;
        assert!(!was_stored || phase == Phase::Running, "{}: {phase}", robot.id);
    }
}

/// A socket that begins to send a login and never completes the login.
async fn trickling_login(address: &str) -> TcpStream {
    let mut stream = TcpStream::connect(address).await.expect("connects");
    let head = b"POST /api/v1/login HTTP/1.1\r\nhost: x\r\ncontent-type: application/json\r\n\
                 content-length: 99\r\n\r\n{";
    stream.write_all(head).await.expect("written");
    stream
}

#[tokio::test(flavor = "multi_thread")]
async fn trickling_clients_do_not_block_authenticated_ones() {
    let directory = tempfile::TempDir::new().expect("a directory");
    let server = TestServer::start_in(directory, |config| config.max_http_connections = 8).await;
    let address = server.server.addresses().http.clone();
    let mut strangers = Vec::new();
    for _ in 0..12 {
        strangers.push(trickling_login(&address).await);
    }
    let elsewhere = TcpSocket::new_v4().expect("a socket");
    elsewhere.bind(([127, 0, 0, 2], 0).into()).expect("bound");
    let mut asks = elsewhere.connect(address.parse().expect("an address")).await.expect("connects");
    let token = server.operator.reveal();
    let request =
        format!("GET /api/v1/server HTTP/1.1\r\nhost: x\r\nauthorization: Bearer {token}\r\n\r\n");
    asks.write_all(request.as_bytes()).await.expect("written");
    let mut first = [0; 12];
    // Sooner than a body may pause.
    let answer = tokio::time::timeout(Duration::from_secs(20), asks.read_exact(&mut first)).await;
    answer.expect("in time").expect("an answer");
    assert_eq!(&first, b"HTTP/1.1 200");
}

#[tokio::test(flavor = "multi_thread")]
async fn unauthenticated_connections_are_limited_by_address() {
    let directory = tempfile::TempDir::new().expect("a directory");
    let server = TestServer::start_in(directory, |config| config.max_silent_per_address = 1).await;
    let address = server.server.addresses().http.clone();
    let token = server.operator.reveal();
    let request =
        format!("GET /api/v1/server HTTP/1.1\r\nhost: x\r\nauthorization: Bearer {token}\r\n\r\n");
    let mut known = TcpStream::connect(&address).await.expect("connects");
    known.write_all(request.as_bytes()).await.expect("written");
    let mut oldest = trickling_login(&address).await;
    let newcomers = async {
        let (mut ticks, mut all) = (tokio::time::interval(Duration::from_millis(200)), Vec::new());
        loop {
            ticks.tick().await;
            all.push(trickling_login(&address).await);
        }
    };
    let mut rest = Vec::new();
    let ended = tokio::time::timeout(Duration::from_secs(20), async {
        tokio::select! {
            ended = oldest.read_to_end(&mut rest) => ended,
            () = newcomers => unreachable!("they go on coming"),
        }
    });
    // A reset is an end as well.
    let _ = ended.await.expect("the connection ends");
    // The one that has shown its token is older, and stays.
    known
        .write_all(request.replace("host", "connection: close\r\nhost").as_bytes())
        .await
        .expect("written");
    known.read_to_end(&mut rest).await.expect("answers");
    assert_eq!(String::from_utf8_lossy(&rest).matches("HTTP/1.1 200").count(), 2);
}

#[tokio::test(flavor = "multi_thread")]
async fn idle_and_slow_clients_do_not_delay_a_stop() {
    let server = TestServer::start().await;
    let address = server.server.addresses().http.clone();
    let mut idle = TcpStream::connect(&address).await.expect("connects");
    let mut dawdling = TcpStream::connect(&address).await.expect("connects");
    dawdling.write_all(b"GET /healthz HTTP/1.1\r\nhost: x\r\nx-slow: ").await.expect("written");
    let mut asked = TcpStream::connect(&address).await.expect("connects");
    asked.write_all(b"GET /healthz HTTP/1.1\r\nhost: x\r\n\r\n").await.expect("written");
    let mut first = [0; 12];
    asked.read_exact(&mut first).await.expect("an answer");
    assert_eq!(&first, b"HTTP/1.1 200");
    tokio::time::timeout(Duration::from_secs(9), server.stop()).await.expect("stops in time");
    for connection in [&mut idle, &mut dawdling, &mut asked] {
        let mut rest = Vec::new();
        // A reset is an end as well.
        let _ = connection.read_to_end(&mut rest).await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn restored_database_changes_no_robot_until_the_next_order() {
    let server = TestServer::start().await;
    let mut robot = server.enroll("atlas").await;
    let (first, later) =
        (server.push("talker", "1.0.0").await, server.push("talker", "2.0.0").await);
    server.deploy(&first, "*", "key-1").await;
    let directory = server.stop().await;
    let (database, copy) =
        (directory.path().join("data/taskd.sqlite"), directory.path().join("copy"));
    std::fs::copy(&database, &copy).expect("copied");

    let server = TestServer::start_in(directory, |_| {}).await;
    for n in 0..3 {
        server.deploy(if n == 1 { &first } else { &later }, "*", &format!("later-{n}")).await;
    }
    let state = server.desired(&robot).await;
    server.report(&mut robot, &state, Phase::Running).await;
    let directory = server.stop().await;
    std::fs::copy(&copy, &database).expect("put back");

    let server = TestServer::start_in(directory, |_| {}).await;
    let reported = server.report(&mut robot, &state, Phase::Running).await;
    assert_eq!(reported.status(), StatusCode::OK);
    let view = server.robot(&robot).await;
    assert!(view.conditions.iter().any(|condition| condition.code == "diverged"), "{view:?}");
    assert_eq!(server.ask_desired(&robot).await.status(), StatusCode::CONFLICT);
    let other = server.push("listener", "1.0.0").await;
    server.deploy(&other, "*", "after").await;
    let after = server.desired(&robot).await;
    assert!(after.generation > state.generation);
    let tasks: Vec<&str> = after.tasks.iter().map(|task| task.task.as_str()).collect();
    assert_eq!(tasks, ["listener", "talker"]);
    assert_eq!(after.tasks[1].package, later);
    assert!(server.robot(&robot).await.conditions.is_empty());
}

/// The real program, which gets real signals.
struct Program {
    process: Child,
    http: String,
    mqtt: String,
    token: String,
    directory: tempfile::TempDir,
}

impl Program {
    fn start() -> Self {
        Self::start_logging_to(Stdio::null())
    }

    fn start_logging_to(log: Stdio) -> Self {
        Self::start_with(&[], log)
    }

    #[expect(clippy::disallowed_methods, reason = "the test starts the program it tests")]
    fn start_with(options: &[&str], log: Stdio) -> Self {
        let directory = tempfile::TempDir::new().expect("a directory");
        let data = directory.path().join("data");
        let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_taskd"));
        command
            .args(["serve", "--http", "127.0.0.1:0", "--mqtt", "127.0.0.1:0", "--data"])
            .arg(&data)
            .args(options);
        command.env_clear().stdin(Stdio::null()).stdout(Stdio::piped()).stderr(log);
        let mut process = command.spawn().expect("it starts");
        // The first line comes when both listeners accept.
        let mut said = String::new();
        let stdout = process.stdout.take().expect("piped");
        BufReader::new(stdout).read_line(&mut said).expect("it says where it is");
        assert!(said.starts_with("taskd serves HTTP on http://127.0.0.1:"), "{said}");
        let addresses = std::fs::read(data.join("addresses.json")).expect("published");
        let addresses: task_proto::data_directory::Addresses =
            serde_json::from_slice(&addresses).expect("json");
        let token = std::fs::read_to_string(data.join("operator.token"))
            .expect("a token")
            .trim()
            .to_owned();
        Self { process, http: addresses.http, mqtt: addresses.mqtt, token, directory }
    }

    fn data(&self) -> std::path::PathBuf {
        self.directory.path().join("data")
    }

    /// A new robot, and its session.
    async fn connected_robot(&self) -> (task_proto::RobotId, Raw) {
        let client = crate::registry::client();
        let post = |path: &str, token: &str, body: &Value| {
            let request = client.post(format!("http://{}/api/v1/{path}", self.http));
            answer::<Value>(request.bearer_auth(token).json(body))
        };
        let enrollment = post("enrollment-tokens", &self.token, &json!({})).await;
        let enrollment = enrollment["token"].as_str().expect("a token");
        let body = json!({ "mac": "02:00:00:00:00:07", "name": "atlas" });
        let robot = post("enroll", enrollment, &body).await;
        let id: task_proto::RobotId =
            robot["robot_id"].as_str().expect("an id").parse().expect("an id");
        let mut raw = Raw { stream: TcpStream::connect(&self.mqtt).await.expect("connects") };
        let password = robot["token"].as_str().map(str::to_owned);
        raw.send(&Connect { password, ..Connect::robot(&id) }.packet()).await;
        raw.expect(&[0x20, 2, 0, 0]).await;
        (id, raw)
    }

    /// Begins an upload of ten bytes and sends five.
    async fn half_an_upload(&self) -> TcpStream {
        let mut upload = TcpStream::connect(&self.http).await.expect("connects");
        let digest = task_proto::Digest::of(b"0123456789");
        let head = format!(
            "POST /v2/talker/blobs/uploads/?digest={digest} HTTP/1.1\r\nhost: x\r\n\
             authorization: Bearer {}\r\ncontent-type: application/octet-stream\r\n\
             expect: 100-continue\r\ncontent-length: 10\r\n\r\n",
            self.token
        );
        upload.write_all(head.as_bytes()).await.expect("written");
        // "Continue" means that a handler waits for the body.
        let mut answer = [0; 12];
        upload.read_exact(&mut answer).await.expect("an answer");
        assert_eq!(&answer, b"HTTP/1.1 100");
        upload.write_all(b"01234").await.expect("written");
        upload
    }

    fn signal(&self, signal: Signal) {
        let id = nix::unistd::Pid::from_raw(self.process.id().try_into().expect("a process id"));
        nix::sys::signal::kill(id, signal).expect("it lives");
    }

    /// Waits until the server no longer accepts connections: the stop is under way.
    async fn refuses(&self) {
        let refuses = async { while TcpStream::connect(&self.http).await.is_ok() {} };
        tokio::time::timeout(Duration::from_secs(9), refuses).await.expect("the listener closes");
    }

    async fn exit_code(mut self) -> Option<i32> {
        let ended = tokio::task::spawn_blocking(move || self.process.wait().expect("it ends"));
        tokio::time::timeout(Duration::from_secs(9), ended)
            .await
            .expect("it ends in time")
            .expect("no panic")
            .code()
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn signal_lets_running_requests_end() {
    let program = Program::start();
    let mut upload = program.half_an_upload().await;
    program.signal(Signal::SIGTERM);
    program.refuses().await;
    upload.write_all(b"56789").await.expect("written");
    let mut answer = String::new();
    upload.read_to_string(&mut answer).await.expect("an answer, then the end");
    assert!(answer.contains("HTTP/1.1 201 Created"), "{answer}");
    assert_eq!(program.exit_code().await, Some(0));
}

#[tokio::test(flavor = "multi_thread")]
async fn draining_server_is_not_ready_and_ends_sessions_before_it_stops() {
    let program = Program::start_with(&["--drain", "6s"], Stdio::null());
    let (_, mut robot) = program.connected_robot().await;
    program.signal(Signal::SIGTERM);
    let client = crate::registry::client();
    let readiness = async || {
        let request = client.get(format!("http://{}/readyz", program.http));
        request.send().await.expect("the listener is open").json::<Value>().await.expect("json")
    };
    let stopping = async { while readiness().await["status"] != "stopping" {} };
    tokio::time::timeout(Duration::from_secs(3), stopping).await.expect("it is not ready");
    // The session is still served.
    robot.send(&[0xc0, 0]).await;
    robot.expect(&[0xd0, 0]).await;
    robot.expect_close().await;
    assert_eq!(program.exit_code().await, Some(0));
}

#[tokio::test(flavor = "multi_thread")]
async fn second_signal_ends_the_server_at_once() {
    let program = Program::start();
    let _upload = program.half_an_upload().await;
    program.signal(Signal::SIGINT);
    program.refuses().await;
    program.signal(Signal::SIGINT);
    let asked = std::time::Instant::now();
    assert_eq!(program.exit_code().await, Some(1));
    assert!(
        asked.elapsed() < Duration::from_secs(3),
        "it waited {:?} for the upload",
        asked.elapsed()
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn robot_text_is_one_line_of_the_log() {
    let directory = tempfile::TempDir::new().expect("a directory");
    let path = directory.path().join("log");
    let program = Program::start_logging_to(std::fs::File::create(&path).expect("created").into());
    let (id, mut raw) = program.connected_robot().await;
    let level = "x\n2026-01-01T00:00:00Z ERROR forged\r\u{1b}[2J\u{9b}2J\u{202e}";
    let batch = json!({ "robot_id": id, "lines": [{ "level": level }] }).to_string();
    raw.send(&publish(&topic(&id, RobotTopic::Log), 1, 7, batch.as_bytes())).await;
    raw.expect(&[0x40, 2, 0, 7]).await;
    program.signal(Signal::SIGTERM);
    assert_eq!(program.exit_code().await, Some(0));
    let log = std::fs::read_to_string(&path).expect("text");
    let line =
        log.lines().find(|line| line.contains("can't be read and is dropped")).expect("it is said");
    assert!(line.contains("ERROR forged"), "{line:?}");
    let bad = |c: char| (c.is_control() && c != '\n') || c == '\u{202e}';
    assert!(!log.contains(bad), "{log:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn repeated_robot_errors_do_not_fill_the_log_and_data_is_private() {
    let directory = tempfile::TempDir::new().expect("a directory");
    let path = directory.path().join("log");
    let program = Program::start_logging_to(std::fs::File::create(&path).expect("created").into());
    let (id, mut raw) = program.connected_robot().await;
    for number in 1..=200_u8 {
        raw.send(&publish(&topic(&id, RobotTopic::Telemetry), 1, number.into(), b"no vitals"))
            .await;
        raw.expect(&[0x40, 2, 0, number]).await;
    }
    // SQLite's own files exist while the server runs.
    let mut looked_at = 0;
    let mut directories = vec![program.data()];
    while let Some(directory) = directories.pop() {
        for entry in
            std::fs::read_dir(directory).expect("a directory").map(|entry| entry.expect("an entry"))
        {
            let metadata = entry.metadata().expect("there");
            assert_eq!(metadata.permissions().mode() & 0o077, 0, "{:?}", entry.path());
            looked_at += 1;
            if metadata.is_dir() {
                directories.push(entry.path());
            }
        }
    }
    assert!(looked_at >= 8, "{looked_at}");
    program.signal(Signal::SIGTERM);
    assert_eq!(program.exit_code().await, Some(0));
    let log = std::fs::read_to_string(&path).expect("text");
    assert_eq!(
        log.lines().filter(|line| line.contains("can't be read and is dropped")).count(),
        10
    );
}

#[test]
#[expect(clippy::disallowed_methods, reason = "the test starts the program it tests")]
fn invalid_setting_is_a_usage_error_from_every_source() {
    let directory = tempfile::TempDir::new().expect("a directory");
    let file = directory.path().join("taskd.toml");
    std::fs::write(&file, "htpt = \"127.0.0.1:0\"").expect("written");
    let run = |arguments: &[&str], variable: Option<(&str, &str)>| {
        let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_taskd"));
        command.arg("serve").args(arguments).arg("--data").arg(directory.path().join("data"));
        command.env_clear().envs(variable).stdin(Stdio::null());
        let output = command.output().expect("it runs");
        (output.status.code(), String::from_utf8(output.stderr).expect("text"))
    };
    for (arguments, variable, named) in [
        (&["--http", "nowhere"][..], None, "--http"),
        (&["--htpt", "127.0.0.1:0"], None, "--htpt"),
        (&[], Some(("TASKD_MQTT", "nowhere")), "TASKD_MQTT"),
        (&["--config", file.to_str().expect("text")], None, "htpt in "),
    ] {
        let (code, said) = run(arguments, variable);
        assert_eq!(code, Some(2), "{said}");
        assert!(said.contains(named), "{said}");
    }
    assert!(!directory.path().join("data").exists());
}

#[test]
#[expect(clippy::disallowed_methods, reason = "the test starts the program it tests")]
fn too_few_open_files_are_refused_with_the_number_needed() {
    let directory = tempfile::TempDir::new().expect("a directory");
    let mut command = std::process::Command::new("/bin/sh");
    command.args([
        "-c",
        "ulimit -n 256; exec \"$0\" serve --http 127.0.0.1:0 --mqtt 127.0.0.1:0 --data \"$1\"",
    ]);
    command
        .arg(env!("CARGO_BIN_EXE_taskd"))
        .arg(directory.path().join("data"))
        .env_clear()
        .stdin(Stdio::null());
    let ended = command.stdout(Stdio::null()).output().expect("it runs");
    let said = String::from_utf8_lossy(&ended.stderr);
    assert_eq!(ended.status.code(), Some(1), "{said}");
    assert!(said.contains("only 256 files may be open, 1024 are needed"), "{said}");
    assert!(said.contains("LimitNOFILE=1024") && said.contains("ulimit -n 1024"), "{said}");
}

#[tokio::test(flavor = "multi_thread")]
async fn chunked_push_goes_on_after_a_restart() {
    let server = TestServer::start().await;
    let begun =
        server.request(Method::POST, "/v2/talker/blobs/uploads/").send().await.expect("an answer");
    let upload = begun.headers()["location"].to_str().expect("text").to_owned();
    let chunk = |server: &TestServer, range: &str, bytes: &'static str| {
        let request = server
            .request(Method::PATCH, &upload)
            .header("content-type", "application/octet-stream");
        request.header("content-range", range).body(bytes)
    };
    let sent = chunk(&server, "0-3", "some").send().await.expect("an answer");
    assert_eq!(sent.status(), StatusCode::ACCEPTED);

    // The clock of the test is ahead of the times of files.
    let keep = |config: &mut Config| config.blob_grace = Duration::from_secs(1 << 32);
    let server = TestServer::start_in(server.stop().await, keep).await;
    let stands = server.request(Method::GET, &upload).send().await.expect("an answer");
    assert_eq!(
        (stands.status(), &stands.headers()["range"]),
        (StatusCode::NO_CONTENT, &"0-3".parse().expect("text"))
    );
    let sent = chunk(&server, "4-7", "more").send().await.expect("an answer");
    assert_eq!(sent.status(), StatusCode::ACCEPTED);
    let digest = task_proto::Digest::of(b"somemore");
    let done = server
        .request(Method::PUT, &format!("{upload}?digest={digest}"))
        .send()
        .await
        .expect("an answer");
    assert_eq!(done.status(), StatusCode::CREATED);
    let blob = server
        .request(Method::GET, &format!("/v2/talker/blobs/{digest}"))
        .send()
        .await
        .expect("an answer");
    assert_eq!(blob.text().await.expect("a body"), "somemore");
}
