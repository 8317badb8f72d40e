//! A task's output reaches the operator: requested, followed over disconnections, and within bounds
//! during a flood.

use std::fs::File;
use std::io::{BufRead as _, BufReader, Read, Write as _};
use std::path::PathBuf;
use std::process::{Child, Stdio};
use std::sync::mpsc::{Receiver, channel};

use task_proto::api::{LogsFrom, LogsView};
use task_proto::messages::report::Phase;
use task_proto::telemetry::log::{LogLevel, LogLine};

use crate::harness::{Fleet, TIMEOUT, eventually, open_directory};

/// A robot with a task that follows the test's commands.
struct Bench {
    fleet: Fleet,
    orders: PathBuf,
}

impl Bench {
    async fn start(first: &str) -> Self {
        let fleet = Fleet::start(1).await;
        // The task runs without the test's rights.
        let open = fleet.dir.path().join("open");
        open_directory(&open);
        let orders = open.join("orders");
        let path = orders.display();
        // Held open both ways, so that no order falls between the end of one and the beginning of
        // the next.
        let script = format!(
            "mkfifo {path}\nexec 3<>{path}\n{first}\n\
             while read -r order <&3; do eval \"$order\"; done\n"
        );
        fleet.server.push(&fleet.package("speaker", "1.0.0", "service", &script), "*").await;
        fleet.server.wait_phase("robot-1", "speaker", Phase::Running).await;
        Self { fleet, orders }
    }

    /// Has the task run a line of shell.
    async fn order(&self, line: String) {
        let orders = self.orders.clone();
        // The task may not have created the file yet.
        let mut made = eventually("the task to take orders", async || {
            File::options().write(true).open(&orders).ok()
        })
        .await;
        // It waits for the task to read, should that be behind.
        let written = tokio::task::spawn_blocking(move || made.write_all(line.as_bytes()));
        written.await.expect("no panic").expect("ordered");
    }

    async fn logs(&self, arguments: &[&str]) -> LogsView {
        let out = self
            .fleet
            .server
            .operate([&["logs", "robot-1", "-o", "json"], arguments].concat())
            .await;
        serde_json::from_str(&out).unwrap_or_else(|error| panic!("{error}: {out}"))
    }

    fn follow(&self, arguments: &[&str]) -> Follower {
        let mut command = self
            .fleet
            .server
            .command([&["logs", "-f", "robot-1", "-o", "json"], arguments].concat());
        let mut child =
            command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("taskd runs");
        let lines = lines_of(child.stdout.take());
        let remarks = lines_of(child.stderr.take());
        Follower { child, lines, remarks }
    }
}

fn lines_of(stream: Option<impl Read + Send + 'static>) -> Receiver<String> {
    let (sender, receiver) = channel();
    let stream = BufReader::new(stream.expect("piped"));
    std::thread::spawn(move || {
        stream.lines().map_while(Result::ok).try_for_each(|line| sender.send(line))
    });
    receiver
}

/// `taskd logs -f`; the process ends with the test.
struct Follower {
    child: Child,
    lines: Receiver<String>,
    remarks: Receiver<String>,
}

impl Follower {
    fn next(&self) -> LogLine {
        let line = self.lines.recv_timeout(TIMEOUT).expect("a line in time");
        serde_json::from_str(&line).unwrap_or_else(|error| panic!("{error}: {line}"))
    }

    fn remark(&self, text: &str) -> String {
        loop {
            let remark = self
                .remarks
                .recv_timeout(TIMEOUT)
                .unwrap_or_else(|_| panic!("nothing says {text:?}"));
            if remark.contains(text) {
                return remark;
            }
        }
    }
}

impl Drop for Follower {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn texts(view: &LogsView) -> Vec<&str> {
    view.lines.iter().map(|line| line.text.as_str()).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn log_lines_keep_levels_and_stay_available_offline() {
    let first = "echo hello; echo oops >&2; echo '[ERROR] [1.5] [arm.driver]: broken' >&2";
    let mut bench = Bench::start(first).await;
    let view = eventually("all three lines", async || {
        let view = bench.logs(&["speaker"]).await;
        (view.lines.len() == 4).then_some(view)
    })
    .await;
    assert_eq!((view.from, view.age_ms), (LogsFrom::Robot, 0));
    let shown: Vec<_> = view.lines.iter().map(|line| (line.level, line.text.as_str())).collect();
    for expected in
        [(LogLevel::Info, "hello"), (LogLevel::Warn, "oops"), (LogLevel::Error, "broken")]
    {
        assert!(shown.contains(&expected), "{shown:?}");
    }
    assert!(
        view.lines
            .iter()
            .any(|line| line.node.as_ref().is_some_and(|node| node.as_str() == "/arm/driver"))
    );
    assert_eq!(texts(&bench.logs(&["--level", "error"]).await), ["broken"]);
    let none = bench.fleet.server.try_operate(["logs", "robot-1", "nothing"]).await;
    assert_eq!(none.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&none.stderr).contains("no_such_task"));

    let remembers = async || bench.fleet.server.get("/api/v1/robots/robot-1/logs?level=warn").await;
    eventually("the warnings on the server", remembers).await;
    bench.order("echo the last >&2\n".to_owned()).await;
    let follower = bench.follow(&["--level", "warn"]);
    while follower.next().text != "the last" {}
    bench.fleet.robots[0].kill();
    let view = eventually("the server's memory", async || {
        let view = bench.logs(&["--level", "warn"]).await;
        let is_away = view.reason.as_ref().is_some_and(|reason| reason.contains("not connected"));
        (view.from == LogsFrom::Server && is_away).then_some(view)
    })
    .await;
    assert!(view.lines.iter().all(|line| line.level >= LogLevel::Warn));
    follower.remark("not connected");
}

#[tokio::test(flavor = "multi_thread")]
async fn follow_shows_each_line_once_across_a_server_restart() {
    let mut bench = Bench::start("echo before").await;
    eventually("the past", async || {
        texts(&bench.logs(&[]).await).contains(&"before").then_some(())
    })
    .await;
    // A limit on past lines is no limit on the lines that a disconnection leaves out.
    let follower = bench.follow(&["-n", "1", "speaker"]);
    while follower.next().text != "before" {}
    for number in 0..30 {
        if number == 10 {
            bench.fleet.server.kill();
        }
        bench.order(format!("echo line {number}\n")).await;
        if number == 15 {
            bench.fleet.server.restart().await;
        }
    }
    // Lines written in the moment before the stream began may arrive by the stream.
    let said =
        std::iter::repeat_with(|| follower.next().text).filter(|text| text.starts_with("line "));
    let seen: Vec<String> = said.take(30).collect();
    let expected: Vec<String> = (0..30).map(|number| format!("line {number}")).collect();
    assert_eq!(seen, expected);
}

#[tokio::test(flavor = "multi_thread")]
async fn log_flood_is_counted_and_bounded() {
    let bench = Bench::start("echo up").await;
    let follower = bench.follow(&["--level", "warn"]);
    bench.order("echo ready >&2\n".to_owned()).await;
    while follower.next().text != "ready" {}
    bench.order("seq 25000 >&2\n".to_owned()).await;
    follower.remark("more lines were dropped");
    let view = eventually("the end of the flood", async || {
        let view = bench.logs(&["-n", "10"]).await;
        texts(&view).last().is_some_and(|last| *last == "25000").then_some(view)
    })
    .await;
    assert_eq!(
        texts(&view),
        (24_991..=25_000).map(|number| number.to_string()).collect::<Vec<_>>()
    );
    let published = follower.lines.try_iter().count();
    assert!(published < 10_000, "{published} lines were published");
    bench.order("echo after >&2\n".to_owned()).await;
    eventually("the line after the flood", async || {
        texts(&bench.logs(&["-n", "1"]).await).contains(&"after").then_some(())
    })
    .await;
}
