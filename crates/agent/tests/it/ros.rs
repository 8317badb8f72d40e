//! Real rclpy nodes for tests, each in a process of its own; no test leaves one behind.
#![expect(clippy::disallowed_methods, reason = "a test starts processes")]

use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::Duration;

use task_agent::ros::graph::{Graph, GraphProgram, GraphSettings};
use task_proto::telemetry::ros::GraphName;
use tokio::io::{AsyncBufReadExt, AsyncWriteExt, BufReader};
use tokio::process::{Child, ChildStdin, ChildStdout, Command};

use crate::harness::within;

/// How long a call may take on a loaded machine.
pub const CALL: Duration = Duration::from_secs(30);

/// The virtual environment with ROS.
pub fn ros() -> PathBuf {
    let root = std::env::var_os("TASKD_TEST_ROS").map(PathBuf::from);
    root.expect(
        "TASKD_TEST_ROS names no virtual environment with ROS 2: \
         run ./scripts/test, which makes one",
    )
}

/// A name on the graph.
pub fn name(text: &str) -> GraphName {
    text.parse().expect("a ROS name")
}

/// The program that takes part in the graph, with the rights that the agent gives it.
pub fn program() -> GraphProgram {
    GraphProgram::at(env!("CARGO_BIN_EXE_task-agent"))
}

/// The agent's node in this domain, which stays on this host.
pub async fn open(domain_id: u16) -> Graph {
    open_as(domain_id, "/taskd_test").await
}

/// The same with a name of its own.
pub async fn open_as(domain_id: u16, node_name: &str) -> Graph {
    let settings =
        GraphSettings { domain_id, localhost_only: true, node_name: name(node_name), distro: None };
    within("the graph to open", Graph::open(&settings, &program())).await.expect("the graph")
}

/// A script of `tests/it/ros`, running.
pub struct RosNode {
    child: Child,
    input: Option<ChildStdin>,
    output: tokio::io::Lines<BufReader<ChildStdout>>,
}

impl RosNode {
    /// Starts the script in this domain and waits until the script reports that it is up.
    pub async fn start(script: &str, domain_id: u16, arguments: &[&str]) -> Self {
        Self::start_with(script, domain_id, arguments, &[]).await
    }

    /// The same with more in its environment.
    pub async fn start_with(
        script: &str,
        domain_id: u16,
        arguments: &[&str],
        environment: &[(&str, &Path)],
    ) -> Self {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/it/ros").join(script);
        let mut child = Command::new(ros().join("bin/python3"))
            .arg(path)
            .args(arguments)
            .env("ROS_DOMAIN_ID", domain_id.to_string())
            .env("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
            .envs(environment.iter().copied())
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .kill_on_drop(true)
            .spawn()
            .expect("python3");
        let input = child.stdin.take();
        let output = BufReader::new(child.stdout.take().expect("stdout")).lines();
        let mut node = Self { child, input, output };
        node.says("up").await;
        node
    }

    /// Its process.
    pub fn pid(&self) -> u32 {
        self.child.id().expect("it runs")
    }

    /// Sends this command, and waits until the command is done.
    pub async fn order(&mut self, line: &str) {
        let input = self.input.as_mut().expect("input");
        input.write_all(format!("{line}\n").as_bytes()).await.expect("input");
        self.says("done").await;
    }

    async fn says(&mut self, wanted: &str) {
        let line = within(wanted, self.output.next_line()).await.expect("output");
        assert_eq!(line.as_deref(), Some(wanted));
    }

    /// Lets the node leave the graph in an orderly way.
    pub async fn leave(mut self) {
        self.input = None;
        within("the node to leave", self.child.wait()).await.expect("exit");
    }

    /// Kills the node without a farewell.
    pub async fn kill(mut self) {
        within("the node to die", self.child.kill()).await.expect("kill");
    }
}
