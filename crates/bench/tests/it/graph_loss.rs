//! Attacks of strangers on the ROS network against a robot: a real agent with a task that promises
//! nodes, under the packets that once took a gigabyte each, and with the process killed that takes
//! part in the graph.

use std::net::UdpSocket;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use task_proto::messages::report::Phase;

use crate::harness::{eventually, within};
use crate::ros::{Stage, pid_of};
use crate::rtps;

const READY: &str =
    "restart = 'never'\n[ready]\nhold_s = 0\ntimeout_s = 60\nnodes = ['/watched']\n";
/// Maximum memory growth of a process under the attack.
const GROWTH_BYTES: u64 = 64 << 20;

fn words_of(pid: u32, file: &str) -> String {
    let bytes = std::fs::read(format!("/proc/{pid}/{file}")).unwrap_or_default();
    String::from_utf8_lossy(&bytes).replace('\0', " ")
}

/// The agent of this robot, and the agent's process on the graph, if that runs at the moment.
fn agent_and_graph(stage: &Stage) -> Option<(u32, u32)> {
    let data = stage.robot.data().display().to_string();
    let pids: Vec<u32> = std::fs::read_dir("/proc")
        .expect("/proc")
        .filter_map(|entry| entry.ok()?.file_name().to_str()?.parse().ok())
        .collect();
    let agent = *pids
        .iter()
        .find(|pid| words_of(**pid, "cmdline").contains(&format!("run --data {data}")))?;
    let is_graph = |pid: &&u32| {
        words_of(**pid, "cmdline").starts_with("task-agent graph")
            && words_of(**pid, "status").contains(&format!("PPid:\t{agent}\n"))
    };
    Some((agent, *pids.iter().find(is_graph)?))
}

/// Whether the operator's question about the graph is answered with the task's node.
async fn is_answered(stage: &Stage) -> bool {
    let said = stage.server.try_operate(&["node", "list", "robot-1"]).await;
    String::from_utf8_lossy(&said.stdout).contains("/watched")
}

#[tokio::test(flavor = "multi_thread")]
async fn packets_with_gigabyte_lengths_allocate_no_memory() {
    let stage = Stage::start().await;
    stage.push("watched", "--node watched", READY).await;
    let before = stage.runs("watched").await;
    let (agent, graph) = agent_and_graph(&stage).expect("the agent and its process on the graph");
    let memory = || [agent, graph].map(rtps::memory_of);
    let memory_before = memory();
    let domain: u16 = stage.domain.id.parse().expect("a domain");
    let socket = UdpSocket::bind("127.0.0.1:0").expect("a socket");
    for number in 1..=500_u32 {
        let mut prefix = *b"\x01\x0fattacker\0\0";
        prefix[10..].copy_from_slice(&u16::try_from(number % 100).expect("short").to_le_bytes());
        let stated = if number % 2 == 0 { 1 << 30 } else { u32::MAX };
        let endpoints = [rtps::PARTICIPANTS, rtps::PUBLICATIONS];
        rtps::send(
            &socket,
            domain,
            endpoints.map(|endpoints| rtps::data_frag(prefix, endpoints, number, stated)),
        );
    }
    eventually("an answer under attack", async || is_answered(&stage).await.then_some(())).await;
    let memory_after = memory();
    println!(
        "resident and whole memory of agent and graph: {memory_before:?}, then {memory_after:?}"
    );
    for (before, after) in memory_before.iter().zip(memory_after) {
        assert!(
            after.0 < before.0 + GROWTH_BYTES && after.1 < before.1 + GROWTH_BYTES,
            "{before:?} became {after:?}"
        );
    }
    assert_eq!(agent_and_graph(&stage), Some((agent, graph)), "none was started again");
    assert_eq!(pid_of(&stage.runs("watched").await), pid_of(&before));
}

#[tokio::test(flavor = "multi_thread")]
async fn task_keeps_running_while_the_process_on_its_graph_is_killed_and_comes_back() {
    let stage = Stage::start().await;
    stage.push("watched", "--node watched", READY).await;
    let before = stage.runs("watched").await;
    let (agent, graph) = agent_and_graph(&stage).expect("the agent and its process on the graph");
    kill(Pid::from_raw(i32::try_from(graph).expect("a pid")), Signal::SIGKILL).expect("killed");
    let back = within(crate::harness::TIMEOUT, async || {
        let task = stage.task("watched").await?;
        assert_eq!(task.phase, Phase::Running, "{task:?}");
        assert_eq!((pid_of(&task), task.restarts), (pid_of(&before), before.restarts));
        if let Some(degraded) = &task.degraded {
            assert_eq!(degraded.code.as_str(), "graph_unavailable", "{degraded}");
        }
        let (same, other) = agent_and_graph(&stage)?;
        (same == agent && other != graph && is_answered(&stage).await).then_some(())
    });
    assert!(back.await.is_some(), "the graph does not come back");
    let after = stage.runs("watched").await;
    assert_eq!((pid_of(&after), after.restarts), (pid_of(&before), before.restarts));
    stage.robot_dies_with_its_graph(agent).await;
}

impl Stage {
    /// An agent that is killed takes its process on the graph with it.
    async fn robot_dies_with_its_graph(mut self, agent: u32) {
        let (same, graph) = agent_and_graph(&self).expect("the agent and its process on the graph");
        assert_eq!(same, agent);
        self.robot.kill();
        let is_gone = || !words_of(graph, "cmdline").starts_with("task-agent graph");
        eventually("the process on the graph to be gone", async || is_gone().then_some(())).await;
    }
}
