//! The graph against real rclpy nodes. Each test has a domain of its own, and nothing leaves this
//! host.

use task_agent::ros::graph::{
    DiagnosticLevel, Graph, GraphError, GraphSettings, Node, ParameterValue, Snapshot,
};
use task_proto::telemetry::log::LogLevel;
use task_proto::telemetry::ros::{Endpoint, LifecycleState, Transition};

use crate::harness::{eventually, within};
use crate::ros::{CALL, RosNode, name, open, open_as, program};

/// Waits until the graph shows it.
async fn shows(
    graph: &Graph,
    what: &str,
    condition: impl Fn(&Snapshot) -> bool,
) -> std::sync::Arc<Snapshot> {
    let mut changes = graph.changes();
    let found = within(what, changes.wait_for(|snapshot| condition(snapshot))).await;
    found.expect("the graph is open").clone()
}

fn has(snapshot: &Snapshot, node: &str) -> bool {
    snapshot.named(&name(node)).next().is_some()
}

fn only<'a>(snapshot: &'a Snapshot, node: &str) -> &'a Node {
    let node = name(node);
    let mut named = snapshot.nodes.iter().filter(|candidate| candidate.name == node);
    let first = named.next().expect("the node");
    assert!(named.next().is_none(), "two nodes are called {node}");
    first
}

fn endpoint(of: &str, kind: &str) -> Endpoint {
    Endpoint { name: name(of), kind: kind.to_owned() }
}

#[tokio::test(flavor = "multi_thread")]
async fn node_appears_with_its_endpoints_and_vanishes() {
    let graph = open(81).await;
    assert!(graph.snapshot().nodes.is_empty());
    let node = RosNode::start("talker.py", 81, &["--ros-args", "-r", "__ns:=/robot"]).await;
    let complete = |snapshot: &Snapshot| {
        snapshot.named(&name("/robot/talker")).any(|node| {
            node.publishers.contains(&endpoint("/robot/chatter", "std_msgs/msg/String"))
                && node.publishers.contains(&endpoint("/rosout", "rcl_interfaces/msg/Log"))
                && node.subscriptions.contains(&endpoint("/robot/orders", "std_msgs/msg/String"))
                && node.services.contains(&endpoint("/robot/say", "std_srvs/srv/Trigger"))
                && node.clients == [endpoint("/robot/ask", "std_srvs/srv/Trigger")]
        })
    };
    let snapshot = shows(&graph, "the talker with all its endpoints", complete).await;
    let talker = only(&snapshot, "/robot/talker");
    assert!(!talker.has_lifecycle());
    assert_eq!(snapshot.publishers_of(&name("/robot/chatter")).count(), 1);
    assert_eq!(snapshot.servers_of(&name("/robot/ask")).count(), 0);
    assert!(!snapshot.participants[&talker.participant].locators.is_empty());
    node.leave().await;
    shows(&graph, "the talker gone", |snapshot| {
        snapshot.nodes.is_empty() && snapshot.participants.is_empty()
    })
    .await;
    graph.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn killed_node_vanishes_when_its_lease_ends() {
    let graph = open(82).await;
    let node = RosNode::start("talker.py", 82, &[]).await;
    shows(&graph, "the talker", |snapshot| has(snapshot, "/talker")).await;
    node.kill().await;
    shows(&graph, "the talker gone", |snapshot| snapshot.nodes.is_empty()).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_answers_once_its_server_is_matched() {
    let graph = open(83).await;
    let say = name("/say");
    let nobody = graph.service_answers(&say, None, std::time::Duration::from_millis(100)).await;
    assert!(matches!(nobody, Err(GraphError::NoServer { .. })), "{nobody:?}");
    let node = RosNode::start("talker.py", 83, &[]).await;
    let servers = graph.service_answers(&say, None, CALL).await.unwrap();
    let snapshot = shows(&graph, "the talker", |snapshot| has(snapshot, "/talker")).await;
    let talker = only(&snapshot, "/talker");
    assert_eq!(servers.into_iter().collect::<Vec<_>>(), [talker.participant]);
    node.leave().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn lifecycle_node_is_activated_and_shut_down() {
    let graph = open(84).await;
    let mapper = name("/mapper");
    graph.prepare(&mapper).await.unwrap();
    let node = RosNode::start("managed.py", 84, &[]).await;
    assert_eq!(graph.lifecycle_state(&mapper, CALL).await.unwrap(), LifecycleState::Unconfigured);
    let broken = |broken| vec![("broken".to_owned(), ParameterValue::Bool(broken))];
    graph.set_parameters(&mapper, broken(true), CALL).await.unwrap();
    assert!(!graph.change_state(&mapper, Transition::Configure, CALL).await.unwrap());
    assert_eq!(graph.lifecycle_state(&mapper, CALL).await.unwrap(), LifecycleState::Unconfigured);
    graph.set_parameters(&mapper, broken(false), CALL).await.unwrap();
    for (transition, state) in [
        (Transition::Configure, LifecycleState::Inactive),
        (Transition::Activate, LifecycleState::Active),
        (Transition::Deactivate, LifecycleState::Inactive),
        (Transition::Cleanup, LifecycleState::Unconfigured),
        (Transition::Shutdown, LifecycleState::Finalized),
    ] {
        assert!(graph.change_state(&mapper, transition, CALL).await.unwrap(), "{transition:?}");
        assert_eq!(graph.lifecycle_state(&mapper, CALL).await.unwrap(), state);
    }
    // Its services may answer before the node has announced them as its own.
    shows(&graph, "the mapper with its lifecycle", |snapshot| {
        snapshot.named(&mapper).any(Node::has_lifecycle)
    })
    .await;
    node.leave().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn parameters_are_read_and_set_and_refused_with_the_nodes_reason() {
    let graph = open(85).await;
    let node = RosNode::start("talker.py", 85, &[]).await;
    let talker = name("/talker");
    let all = graph.parameters(&talker, CALL).await.unwrap();
    assert!(all.contains(&("rate".to_owned(), ParameterValue::Double(1.5))), "{all:?}");
    assert!(
        all.contains(&("gains".to_owned(), ParameterValue::Integers(vec![1, 2, 3]))),
        "{all:?}"
    );
    let set = vec![
        ("mode".to_owned(), ParameterValue::String("run".to_owned())),
        ("rate".to_owned(), ParameterValue::Double(-1.0)),
        ("rate".to_owned(), ParameterValue::String("fast".to_owned())),
        ("unknown".to_owned(), ParameterValue::Integer(1)),
        ("rate".to_owned(), ParameterValue::Integer(3).fitting(&ParameterValue::Double(1.5))),
    ];
    let results = graph.set_parameters(&talker, set, CALL).await.unwrap();
    let successful: Vec<_> =
        results.iter().map(|result| (result.name.as_str(), result.successful)).collect();
    assert_eq!(
        successful,
        [("mode", true), ("rate", false), ("rate", false), ("unknown", false), ("rate", true)]
    );
    assert_eq!(results[1].reason, "rate must be above 0");
    assert!(!results[2].reason.is_empty() && !results[3].reason.is_empty(), "{results:?}");
    assert_eq!(
        graph.parameter(&talker, "mode", CALL).await.unwrap(),
        ParameterValue::String("run".to_owned())
    );
    assert_eq!(graph.parameter(&talker, "rate", CALL).await.unwrap(), ParameterValue::Double(3.0));
    assert_eq!(graph.parameter(&talker, "nothing", CALL).await.unwrap(), ParameterValue::NotSet);
    node.leave().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn two_nodes_of_one_name_are_told_apart_by_their_processes() {
    let graph = open(86).await;
    let (first, second) =
        (RosNode::start("talker.py", 86, &[]).await, RosNode::start("talker.py", 86, &[]).await);
    let talker = name("/talker");
    let both = shows(&graph, "two talkers", |snapshot| snapshot.named(&talker).count() == 2).await;
    let mut found = Vec::new();
    for node in [&first, &second] {
        let owners = Graph::owners(both.clone(), vec![node.pid()]).await;
        assert_eq!(
            (owners.theirs.len(), owners.others.len(), owners.unknown.len()),
            (1, 1, 0),
            "{owners:?}"
        );
        found.extend(owners.theirs);
    }
    assert_ne!(found[0], found[1]);
    let all = Graph::owners(both, vec![first.pid(), second.pid(), std::process::id()]).await;
    assert_eq!((all.theirs.len(), all.others.len()), (2, 0), "{all:?}");
    first.leave().await;
    let one = shows(&graph, "one talker", |snapshot| snapshot.named(&talker).count() == 1).await;
    assert_eq!(only(&one, "/talker").participant, found[1]);
    second.leave().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn rates_are_counted_of_reliable_and_of_best_effort_publishers() {
    let graph = open(87).await;
    let chatter = graph.rate(&name("/chatter"), "std_msgs/msg/String").unwrap();
    let scan = graph.rate(&name("/scan"), "std_msgs/msg/String").unwrap();
    let node = RosNode::start("talker.py", 87, &[]).await;
    eventually("both topics at their rates", || {
        let (fast, slow) = (chatter.rate(), scan.rate());
        (fast.hz > 10.0 && fast.hz < 30.0 && slow.hz > 5.0 && slow.hz < 15.0).then_some(())
    })
    .await;
    node.leave().await;
    eventually("both topics silent", || {
        (chatter.rate().hz == 0.0 && scan.rate().hz == 0.0).then_some(())
    })
    .await;
    assert!(chatter.rate().since_last > Some(task_agent::ros::graph::rate::WINDOW));
    assert!(matches!(graph.rate(&name("/scan"), "String"), Err(GraphError::Kind(_))));
}

#[tokio::test(flavor = "multi_thread")]
async fn late_joiner_receives_log_lines() {
    let mut node = RosNode::start("talker.py", 88, &["--ros-args", "-r", "__ns:=/robot"]).await;
    node.order("log said before the agent came").await;
    let graph = open(88).await;
    let mut lines = graph.rosout().unwrap();
    let mut next = async || within("a line", lines.recv()).await.unwrap();
    while next().await.text != "said before the agent came" {}
    node.order("warn said afterwards").await;
    let line = next().await;
    assert_eq!((line.text.as_str(), line.level), ("said afterwards", LogLevel::Warn));
    assert_eq!(
        (line.node.clone(), line.logger.as_str(), line.lost),
        (Some(name("/robot/talker")), "robot.talker", 0)
    );
    assert!(
        line.file.ends_with("talker.py") && line.line > 0 && line.at_ms > 1_700_000_000_000,
        "{line:?}"
    );
    let snapshot = shows(&graph, "the talker", |snapshot| has(snapshot, "/robot/talker")).await;
    assert_eq!(line.participant, only(&snapshot, "/robot/talker").participant);
    node.leave().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn diagnostics_are_received() {
    let graph = open(89).await;
    let mut statuses = graph.diagnostics().unwrap();
    let mut node = RosNode::start("talker.py", 89, &[]).await;
    shows(&graph, "the talker", |snapshot| {
        snapshot.publishers_of(&name("/diagnostics")).next().is_some()
    })
    .await;
    // A status sent before both sides have matched is lost, so the status is sent until one
    // arrives.
    let status = loop {
        node.order("diagnose battery is low").await;
        match tokio::time::timeout(std::time::Duration::from_millis(200), statuses.recv()).await {
            Ok(status) => break status.unwrap(),
            Err(_) => continue,
        }
    };
    assert_eq!((status.name.as_str(), status.message.as_str()), ("battery", "battery is low"));
    assert_eq!((status.level, status.hardware_id.as_str()), (DiagnosticLevel::Warn, "b1"));
    assert_eq!(status.values, [("volts".to_owned(), "11.1".to_owned())]);
    node.leave().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn domains_do_not_mix_and_two_agents_on_one_host_do_not_confuse_each_other() {
    let (here, beside, elsewhere) = (
        open_as(90, "/taskd_one").await,
        open_as(90, "/taskd_two").await,
        open_as(232, "/taskd_one").await,
    );
    let node = RosNode::start("talker.py", 90, &[]).await;
    let other = RosNode::start("talker.py", 232, &["--ros-args", "-r", "__node:=stranger"]).await;
    let seen = |own: &'static str, also: &'static str| {
        move |snapshot: &Snapshot| {
            has(snapshot, "/talker") && has(snapshot, also) && !has(snapshot, own)
        }
    };
    shows(&here, "the talker and the other agent", seen("/taskd_one", "/taskd_two")).await;
    shows(&beside, "the talker and the other agent", seen("/taskd_two", "/taskd_one")).await;
    let alone = shows(&elsewhere, "the stranger", |snapshot| has(snapshot, "/stranger")).await;
    assert_eq!(alone.nodes.len(), 1);
    let both = [&here, &beside]
        .map(|graph| async { graph.parameter(&name("/talker"), "rate", CALL).await.unwrap() });
    for value in futures_util::future::join_all(both).await {
        assert_eq!(value, ParameterValue::Double(1.5));
    }
    beside.close().await;
    shows(&here, "the other agent gone", |snapshot| {
        !has(snapshot, "/taskd_two") && has(snapshot, "/talker")
    })
    .await;
    other.leave().await;
    node.leave().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn invalid_domain_id_is_refused_by_its_key() {
    let settings = GraphSettings {
        domain_id: 233,
        localhost_only: true,
        node_name: name("/taskd_test"),
        distro: None,
    };
    let refused = Graph::open(&settings, &program()).await.err().expect("a refusal");
    assert_eq!(refused.to_string(), "ros_domain_id: 233 is not from 0 to 232");
}

#[tokio::test(flavor = "multi_thread")]
async fn closed_graph_returns_an_error() {
    let graph = open(91).await;
    let (other, mut changes) = (graph.clone(), graph.changes());
    within("the graph to close", graph.close()).await;
    // A change that came before the end is seen first.
    within("the end of changes", async { while changes.changed().await.is_ok() {} }).await;
    let refused = other.lifecycle_state(&name("/mapper"), CALL).await;
    assert!(matches!(refused, Err(GraphError::Closed)), "{refused:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn nodes_of_a_robot_with_another_distribution_see_the_agent() {
    for (domain_id, distro) in [(93, "kilted"), (94, "humble")] {
        let settings = GraphSettings {
            domain_id,
            localhost_only: true,
            node_name: name("/taskd_here"),
            distro: Some(distro.to_owned()),
        };
        let graph = within("the graph to open", Graph::open(&settings, &program())).await.unwrap();
        let other = open_as(domain_id, "/taskd_there").await;
        shows(&other, "the agent of either form", |snapshot| has(snapshot, "/taskd_here")).await;
        graph.close().await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn killed_node_is_not_confused_with_its_successor() {
    let graph = open(97).await;
    let killed = RosNode::start("talker.py", 97, &[]).await;
    let before = shows(&graph, "the talker", |snapshot| has(snapshot, "/talker")).await;
    let ghost = only(&before, "/talker").participant;
    killed.kill().await;
    // The new node gets the freed ports, which the killed node's participant still announces.
    let started = RosNode::start("talker.py", 97, &[]).await;
    let is_new = |node: &Node| node.name == name("/talker") && node.participant != ghost;
    let after =
        shows(&graph, "the second talker", |snapshot| snapshot.nodes.iter().any(is_new)).await;
    let owners = Graph::owners(after.clone(), vec![started.pid()]).await;
    let new: Vec<_> =
        after.nodes.iter().filter(|node| is_new(node)).map(|node| node.participant).collect();
    assert_eq!(owners.theirs.iter().copied().collect::<Vec<_>>(), new);
    assert_eq!(owners.gone.contains(&ghost), after.participants.contains_key(&ghost), "{owners:?}");
    started.leave().await;
}
