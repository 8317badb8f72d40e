//! The agent's process that takes part in the ROS graph: its permissions, its exposure to
//! strangers, and that its loss costs no more than a moment without a graph.

use std::net::UdpSocket;
use std::time::{Duration, Instant};

use nix::fcntl::{FcntlArg, FdFlag, fcntl};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use task_agent::ros::graph::process::program::MEMORY_BYTES;
use task_agent::ros::graph::{Graph, GraphError, ParameterValue};
use task_agent::ros::graph_access::GraphAccess;
use task_agent::ros::readiness::Promise;
use task_agent::ros::watcher::{WatchedRun, Watcher};
use task_agent::system::layout::DataDir;
use task_agent::task::observed::Health;
use task_proto::messages::report::{FailureCode, RosFacts};
use tokio::sync::watch;

use crate::harness::{self, eventually, lives, within};
use crate::ros::{CALL, RosNode, name, open, program};
use crate::rtps;

/// Maximum memory growth of a process under an attack.
const GROWTH_BYTES: u64 = 64 << 20;

fn facts(domain_id: u16) -> RosFacts {
    RosFacts {
        distro: "jazzy".to_owned(),
        rmw: None,
        domain_id: Some(domain_id),
        localhost_only: true,
    }
}

fn status_of(pid: u32, key: &str) -> String {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix(key)).unwrap();
    line.trim_start_matches(':').trim().to_owned()
}

async fn answers(graph: &Graph) {
    let talker = name("/talker");
    let shown = async {
        graph.changes().wait_for(|snapshot| snapshot.named(&talker).next().is_some()).await.is_ok()
    };
    assert!(within("the talker", shown).await);
    let value = graph.parameter(&talker, "rate", CALL).await.unwrap();
    assert_eq!(value, ParameterValue::Double(1.5));
}

fn signal(pid: u32, signal: Signal) {
    kill(Pid::from_raw(i32::try_from(pid).unwrap()), signal).unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn graph_process_has_no_privileges_and_little_memory() {
    // A file that a library opens need not be closed by itself when a process is started.
    let kept = std::fs::File::open("/proc/self/status").unwrap();
    fcntl(&kept, FcntlArg::F_SETFD(FdFlag::empty())).unwrap();
    let graph = open(98).await;
    let pid = graph.pid();
    assert_ne!(pid, std::process::id());
    assert_eq!(status_of(pid, "NoNewPrivs"), "1");
    if nix::unistd::geteuid().is_root() {
        let ids = status_of(pid, "Uid");
        assert!(ids.split_whitespace().all(|id| id != "0"), "{ids}");
        assert_eq!(
            status_of(pid, "Groups").split_whitespace().filter(|group| *group == "0").count(),
            0
        );
        for set in ["CapInh", "CapPrm", "CapEff", "CapBnd", "CapAmb"] {
            assert_eq!(status_of(pid, set), "0000000000000000", "{set}");
        }
    }
    let proc = format!("/proc/{pid}");
    let limits = std::fs::read_to_string(format!("{proc}/limits")).unwrap();
    let data = limits.lines().find(|line| line.starts_with("Max data size")).unwrap();
    assert!(data.contains(&MEMORY_BYTES.to_string()), "{data}");
    let score: i32 =
        std::fs::read_to_string(format!("{proc}/oom_score_adj")).unwrap().trim().parse().unwrap();
    assert!(score > 0, "{score}");
    if nix::unistd::geteuid().is_root() {
        assert!(std::fs::read(format!("{proc}/environ")).unwrap().is_empty());
        // Its own: standard streams, sockets, descriptors to wait with. None of the agent's files.
        for file in std::fs::read_dir(format!("{proc}/fd")).unwrap() {
            let target = std::fs::read_link(file.unwrap().path()).unwrap().display().to_string();
            let number_of_a_kind =
                ["pipe:", "socket:", "anon_inode:"].iter().any(|kind| target.starts_with(kind));
            let is_stderr = std::fs::read_link("/proc/self/fd/2")
                .is_ok_and(|own| own.display().to_string() == target);
            assert!(number_of_a_kind || is_stderr, "{target}");
        }
    }
    graph.close().await;
    eventually("the process to end", || (!lives(pid)).then_some(())).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn packets_that_state_gigabytes_cost_no_memory_and_the_graph_still_answers() {
    const DOMAIN: u16 = 99;
    let graph = open(DOMAIN).await;
    let node = RosNode::start("talker.py", DOMAIN, &[]).await;
    answers(&graph).await;
    let (pid, own) = (graph.pid(), std::process::id());
    let before = [rtps::memory_of(pid), rtps::memory_of(own)];
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    for number in 1..=300_u32 {
        let mut prefix = *b"\x01\x0fattacker\0\0";
        prefix[10..].copy_from_slice(&u16::try_from(number % 50).unwrap().to_le_bytes());
        let stated = if number % 2 == 0 { 1 << 30 } else { u32::MAX };
        let datagrams = [rtps::PARTICIPANTS, rtps::PUBLICATIONS]
            .map(|endpoints| rtps::data_frag(prefix, endpoints, number, stated));
        rtps::send(&socket, DOMAIN, datagrams);
    }
    answers(&graph).await;
    for ((pid, before), what) in
        [pid, own].into_iter().zip(before).zip(["the program", "the agent"])
    {
        let after = rtps::memory_of(pid);
        assert!(after.0 < before.0 + GROWTH_BYTES, "{what}: {before:?} became {after:?}");
        // This process runs other tests as well, and their threads take address space.
        assert!(
            pid == own || after.1 < before.1 + GROWTH_BYTES,
            "{what}: {before:?} became {after:?}"
        );
    }
    assert_eq!(graph.pid(), pid);
    assert!(lives(pid));
    node.leave().await;
    graph.close().await;
}

/// Announces a participant and its available samples: a participant that believes the announcement
/// requests the samples.
fn is_matched(
    socket: &UdpSocket,
    domain_id: u16,
    prefix: [u8; 12],
    number: u32,
    port: u16,
) -> bool {
    rtps::send(
        socket,
        domain_id,
        [
            rtps::announcement(prefix, number, port),
            rtps::heartbeat(prefix, rtps::PUBLICATIONS, 5, number),
        ],
    );
    rtps::is_asked(socket)
}

#[tokio::test(flavor = "multi_thread")]
async fn packets_with_full_sequence_ranges_cost_no_time_or_memory() {
    const DOMAIN: u16 = 100;
    let graph = open(DOMAIN).await;
    let node = RosNode::start("talker.py", DOMAIN, &[]).await;
    answers(&graph).await;
    let pid = graph.pid();
    let before = rtps::memory_of(pid);
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    let port = socket.local_addr().unwrap().port();
    let prefix = *b"\x01\x0fattacker\0\0";
    let matched = tokio::task::spawn_blocking({
        let socket = socket.try_clone().unwrap();
        move || (1..300).any(|number| is_matched(&socket, DOMAIN, prefix, number, port))
    });
    assert!(matched.await.unwrap(), "the attacker was not matched");
    let started = Instant::now();
    for count in 501..=550 {
        rtps::send(
            &socket,
            DOMAIN,
            [
                rtps::heartbeat(prefix, rtps::PUBLICATIONS, i64::MAX, 2 * count),
                rtps::gap(
                    prefix,
                    rtps::PUBLICATIONS,
                    i64::from(count) * 1000,
                    i64::MAX - i64::from(count),
                ),
                rtps::heartbeat(prefix, rtps::PUBLICATIONS, i64::MAX - 1, 2 * count + 1),
            ],
        );
    }
    answers(&graph).await;
    let after = rtps::memory_of(pid);
    assert!(
        after.0 < before.0 + GROWTH_BYTES && after.1 < before.1 + GROWTH_BYTES,
        "{before:?} became {after:?}"
    );
    assert!(lives(pid) && started.elapsed() < Duration::from_secs(30));
    node.leave().await;
    graph.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn info_reply_directs_no_packet_to_another_address() {
    const DOMAIN: u16 = 104;
    let graph = open(DOMAIN).await;
    let attack = || {
        let [own, other] = [(); 2].map(|()| UdpSocket::bind("127.0.0.1:0").unwrap());
        let [port, other_port] = [&own, &other].map(|socket| socket.local_addr().unwrap().port());
        let prefix = *b"\x01\x0fattacker\0\0";
        assert!((1..300).any(|number| is_matched(&own, DOMAIN, prefix, number, port)));
        let is_answered = |count| {
            let heartbeat = rtps::heartbeat(prefix, rtps::PUBLICATIONS, 5, count);
            // RustDDS 0.15.1 expects the tag of a list of multicast locators; the standard has none.
            let rest: &[u8] = if count % 2 == 0 { &[0; 4] } else { &[] };
            rtps::send(&own, DOMAIN, [rtps::with_info_reply(other_port, rest, &heartbeat)]);
            rtps::is_asked(&own)
        };
        let answered = (1_001..1_041).filter(|count| is_answered(*count)).count();
        assert!(answered > 30, "{answered} of 40 replies came to the announced address");
        assert!(!rtps::is_asked(&other), "a reply went to an address that was not announced");
    };
    tokio::task::spawn_blocking(attack).await.unwrap();
    graph.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn localhost_only_graph_binds_to_loopback() {
    const DOMAIN: u16 = 101;
    let graph = open(DOMAIN).await;
    let sockets = std::fs::read_to_string("/proc/net/udp").unwrap();
    let ports: Vec<u16> = rtps::all_ports(DOMAIN).collect();
    let bound: Vec<&str> = sockets
        .lines()
        .filter_map(|line| line.split_whitespace().nth(1)?.split_once(':'))
        .filter(|(_, port)| u16::from_str_radix(port, 16).is_ok_and(|port| ports.contains(&port)))
        .map(|(address, _)| address)
        .collect();
    // Loopback, and the group 239.255.0.1, as the kernel prints them.
    let [loopback, group] =
        [[127, 0, 0, 1], [239, 255, 0, 1]].map(|ip| format!("{:08X}", u32::from_ne_bytes(ip)));
    assert!(bound.len() >= 4, "{bound:?}");
    assert!(bound.iter().all(|address| **address == loopback || **address == group), "{bound:?}");
    graph.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn killed_graph_process_is_restarted_with_its_subscriptions() {
    let temp = tempfile::tempdir().unwrap();
    let data = DataDir::new(temp.path()).unwrap();
    let access =
        GraphAccess::of_robot("02:00:00:00:00:02".parse().unwrap(), data.clone(), program());
    let facts = facts(102);
    let first = access.open(Some(&facts)).await.unwrap();
    let mut node = RosNode::start("talker.py", 102, &[]).await;
    answers(&first).await;
    let mut changes = first.changes();
    signal(first.pid(), Signal::SIGKILL);
    let closed = async { while changes.changed().await.is_ok() {} };
    within("the loss to be noticed", closed).await;
    assert!(first.is_closed(), "the changes ended before the graph was closed");
    assert!(matches!(
        first.parameter(&name("/talker"), "rate", CALL).await,
        Err(GraphError::Closed)
    ));
    let refused = access.open(Some(&facts)).await.err().expect("a refusal while it is away");
    assert_eq!(refused.code, FailureCode::GRAPH_UNAVAILABLE);
    // Without a request, the nodes' log lines are kept again all the same.
    let kept = async {
        loop {
            node.order("warn heard again").await;
            let log = std::fs::read_to_string(data.ros_log()).unwrap_or_default();
            if log.contains("heard again") {
                return;
            }
        }
    };
    within("messages of nodes to be recorded again", kept).await;
    let second = access.open(Some(&facts)).await.unwrap();
    assert_ne!(second.pid(), first.pid());
    answers(&second).await;
    node.leave().await;
    drop(access);
    second.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn lost_graph_is_no_fault_of_a_watched_run() {
    let temp = tempfile::tempdir().unwrap();
    let data = DataDir::new(temp.path()).unwrap();
    let access = GraphAccess::of_robot("02:00:00:00:00:03".parse().unwrap(), data, program());
    let facts = facts(105);
    let graph = access.open(Some(&facts)).await.unwrap();
    let watcher = Watcher::new(access, harness::supervisor());
    let promise = Promise { nodes: [name("/absent")].into(), ..Promise::default() };
    let run = WatchedRun { dir: temp.path().to_owned(), ..WatchedRun::default() };
    let mut health = watcher.watch(run, promise, Some(facts));
    let shows = async |code: FailureCode, health: &mut watch::Receiver<Health>| {
        let shown = health.wait_for(|health| match health {
            Health::Missing(missing) => missing.code == code,
            _ => false,
        });
        match &*within("the health", shown).await.unwrap() {
            Health::Missing(missing) => missing.is_own_fault,
            other => panic!("{other:?}"),
        }
    };
    assert!(shows(FailureCode::NODE_VANISHED, &mut health).await);
    signal(graph.pid(), Signal::SIGKILL);
    assert!(!shows(FailureCode::GRAPH_UNAVAILABLE, &mut health).await);
}

#[tokio::test(flavor = "multi_thread")]
async fn hanging_graph_process_is_ended() {
    let graph = open(103).await;
    let (pid, mut changes) = (graph.pid(), graph.changes());
    signal(pid, Signal::SIGSTOP);
    let closed = async { while changes.changed().await.is_ok() {} };
    within("the graph to be closed", closed).await;
    eventually("the process to be ended", || (!lives(pid)).then_some(())).await;
    assert!(graph.is_closed());
}

#[tokio::test(flavor = "multi_thread")]
async fn node_log_reader_leaves_a_closed_domain() {
    let temp = tempfile::tempdir().unwrap();
    let data = DataDir::new(temp.path()).unwrap();
    let access = GraphAccess::of_robot("02:00:00:00:00:01".parse().unwrap(), data, program());
    let before = access.open(Some(&facts(171))).await.unwrap();
    let mut changes = before.changes();
    let now = access.open(Some(&facts(172))).await.unwrap();
    assert!(!before.is_closed(), "a watcher of the task still sees it");
    drop(before);
    let closed = async { while changes.changed().await.is_ok() {} };
    within("the graph of the domain before to be closed", closed).await;
    assert!(!now.is_closed());
}
