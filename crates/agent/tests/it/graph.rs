//! The graph against real rclpy nodes. Each test has a domain of its own, and nothing leaves this host.

use task_agent::graph::{Graph, GraphError, Node, ParameterValue, Snapshot};
use task_proto::ros::{Endpoint, LifecycleState, Transition};

use crate::harness::within;
use crate::ros::{CALL, RosNode, name, open};

/// Waits until the graph shows it.
async fn shows(graph: &Graph, what: &str, condition: impl Fn(&Snapshot) -> bool) -> std::sync::Arc<Snapshot> {
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
async fn a_node_appears_with_its_endpoints_and_vanishes() {
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
    shows(&graph, "the talker gone", |snapshot| snapshot.nodes.is_empty() && snapshot.participants.is_empty()).await;
    graph.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_killed_node_vanishes_when_its_lease_ends() {
    let graph = open(82).await;
    let node = RosNode::start("talker.py", 82, &[]).await;
    shows(&graph, "the talker", |snapshot| has(snapshot, "/talker")).await;
    node.kill().await;
    shows(&graph, "the talker gone", |snapshot| snapshot.nodes.is_empty()).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_service_answers_once_its_server_is_matched() {
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
async fn a_lifecycle_node_is_brought_to_active_and_shut_down() {
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
    let snapshot = shows(&graph, "the mapper", |snapshot| has(snapshot, "/mapper")).await;
    assert!(only(&snapshot, "/mapper").has_lifecycle());
    node.leave().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn parameters_are_read_and_set_and_refused_with_the_nodes_reason() {
    let graph = open(85).await;
    let node = RosNode::start("talker.py", 85, &[]).await;
    let talker = name("/talker");
    let all = graph.parameters(&talker, CALL).await.unwrap();
    assert!(all.contains(&("rate".to_owned(), ParameterValue::Double(1.5))), "{all:?}");
    assert!(all.contains(&("gains".to_owned(), ParameterValue::Integers(vec![1, 2, 3]))), "{all:?}");
    let set = vec![
        ("mode".to_owned(), ParameterValue::String("run".to_owned())),
        ("rate".to_owned(), ParameterValue::Double(-1.0)),
        ("rate".to_owned(), ParameterValue::String("fast".to_owned())),
        ("unknown".to_owned(), ParameterValue::Integer(1)),
        ("rate".to_owned(), ParameterValue::Integer(3).fitting(&ParameterValue::Double(1.5))),
    ];
    let results = graph.set_parameters(&talker, set, CALL).await.unwrap();
    let successful: Vec<_> = results.iter().map(|result| (result.name.as_str(), result.successful)).collect();
    assert_eq!(successful, [("mode", true), ("rate", false), ("rate", false), ("unknown", false), ("rate", true)]);
    assert_eq!(results[1].reason, "rate must be above 0");
    assert!(!results[2].reason.is_empty() && !results[3].reason.is_empty(), "{results:?}");
    assert_eq!(graph.parameter(&talker, "mode", CALL).await.unwrap(), ParameterValue::String("run".to_owned()));
    assert_eq!(graph.parameter(&talker, "rate", CALL).await.unwrap(), ParameterValue::Double(3.0));
    assert_eq!(graph.parameter(&talker, "nothing", CALL).await.unwrap(), ParameterValue::NotSet);
    node.leave().await;
}
