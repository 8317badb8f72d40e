//! The ROS graph on a host with a network: a robot and another host, each in a network namespace of
//! its own, with a cable between them. The namespaces end with the test.
#![expect(clippy::disallowed_methods, reason = "a test starts processes")]

use std::net::{Ipv4Addr, UdpSocket};
use std::process::Command;
use std::sync::mpsc;

use nix::sched::{CloneFlags, unshare};
use nix::unistd::gettid;
use task_agent::ros::graph::{Graph, GraphSettings};

use crate::harness::within;
use crate::ros::{name, program};
use crate::rtps;

/// No other namespace has participants here.
const DOMAIN: u16 = 1;
const ROBOT: Ipv4Addr = Ipv4Addr::new(10, 77, 0, 1);
/// The group at which participants find each other.
const GROUP: Ipv4Addr = Ipv4Addr::new(239, 255, 0, 1);

fn ip(arguments: &str) {
    let status = Command::new("ip").args(arguments.split_whitespace()).status();
    assert!(status.expect("iproute2").success(), "ip {arguments}");
}

/// Begins a network namespace for the calling thread, and for the threads and processes that it
/// starts from now on.
fn enter_network() {
    unshare(CloneFlags::CLONE_NEWNET).expect("a network namespace");
    ip("link set lo up");
}

/// Sends datagrams from the other host to all ports of the graph on the robot.
struct OtherHost {
    datagrams: mpsc::SyncSender<Vec<u8>>,
    sent: mpsc::Receiver<()>,
}

impl OtherHost {
    /// Another host with a cable to the calling thread's namespace.
    fn connect() -> Self {
        let (thread, its_thread) = mpsc::sync_channel(0);
        let (connected, when_connected) = mpsc::sync_channel::<()>(0);
        let (datagrams, to_send) = mpsc::sync_channel::<Vec<u8>>(0);
        let (has_sent, sent) = mpsc::sync_channel(0);
        std::thread::spawn(move || {
            enter_network();
            thread.send(gettid()).expect("the robot");
            when_connected.recv().expect("a cable");
            ip("address add 10.77.0.2/24 dev other");
            ip("link set other up");
            ip("route add 239.0.0.0/8 dev other");
            let socket = UdpSocket::bind("10.77.0.2:0").expect("a socket");
            while let Ok(datagram) = to_send.recv() {
                for port in rtps::all_ports(DOMAIN) {
                    for address in [ROBOT, GROUP] {
                        // A port without a socket may be reported by a later call.
                        let _ = socket.send_to(&datagram, (address, port));
                    }
                }
                has_sent.send(()).expect("the robot");
            }
        });
        ip("link add robot type veth peer name other");
        ip(&format!("link set other netns {}", its_thread.recv().expect("the other host")));
        ip("address add 10.77.0.1/24 dev robot");
        ip("link set robot up");
        ip("route add 239.0.0.0/8 dev robot");
        connected.send(()).expect("the other host");
        Self { datagrams, sent }
    }

    fn send(&self, datagram: Vec<u8>) {
        self.datagrams.send(datagram).expect("the other host");
        self.sent.recv().expect("the other host");
    }
}

/// Whether the robot asks a participant for samples that announces itself by `send`. The
/// participant listens on the robot's loopback, which the robot reaches in any case.
fn is_read(prefix: [u8; 12], attempts: u32, send: impl Fn(Vec<u8>)) -> bool {
    let socket = UdpSocket::bind("127.0.0.1:0").expect("a socket");
    let port = socket.local_addr().expect("an address").port();
    (1..=attempts).any(|number| {
        send(rtps::announcement(prefix, number, port));
        send(rtps::heartbeat(prefix, rtps::PUBLICATIONS, 5, number));
        rtps::is_asked(&socket)
    })
}

async fn open(localhost_only: bool) -> Graph {
    let node_name = name("/taskd_test");
    let settings = GraphSettings { domain_id: DOMAIN, localhost_only, node_name, distro: None };
    within("the graph to open", Graph::open(&settings, &program())).await.expect("the graph")
}

async fn reads_loopback_alone_if_it_should() {
    let other = OtherHost::connect();
    let loopback = UdpSocket::bind("127.0.0.1:0").expect("a socket");
    let from_robot = |datagram| rtps::send(&loopback, DOMAIN, [datagram]);
    let graph = open(true).await;
    assert!(is_read(*b"\x01\x0fown host..", 300, from_robot), "loopback is read");
    assert!(!is_read(*b"\x01\x0fother host", 20, |datagram| other.send(datagram)));
    graph.close().await;
    // The same packets count where the graph is open to the network.
    let graph = open(false).await;
    assert!(is_read(*b"\x01\x0fother host", 300, |datagram| other.send(datagram)));
    graph.close().await;
}

#[test]
fn localhost_only_graph_reads_no_packet_of_another_host() {
    if !nix::unistd::geteuid().is_root() {
        return eprintln!("unavailable: only root may make a network namespace");
    }
    let robot = std::thread::spawn(|| {
        enter_network();
        let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build();
        runtime.expect("a runtime").block_on(reads_loopback_alone_if_it_should());
    });
    robot.join().expect("the robot");
}
