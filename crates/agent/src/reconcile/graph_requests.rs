//! Answers about the robot's ROS graph: its contents, and calls to its nodes on request. The
//! agent's own node reads the graph; this module decides nothing.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use task_proto::TaskName;
use task_proto::error_chain::chain;
use task_proto::messages::report::Failure;
use task_proto::messages::request::{Answer, Refusal};
use task_proto::telemetry::ros::{
    GraphName, LifecycleState, NodeDetail, NodeSummary, Parameter, TopicSummary, Transition,
};
use task_proto::time::millis;
use tokio::task::JoinSet;

use crate::reconcile::robot::Robot;
use crate::ros::graph::{Graph, GraphError, Node, ParameterValue, ParticipantId, Snapshot};

/// Time limit for a node's answer to a question.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(3);
/// Time limit for a transition or for setting a parameter: a node may open a device meanwhile.
const WORK_TIMEOUT: Duration = Duration::from_secs(15);
/// The maximum number of lifecycle nodes with a state in a list.
const MAX_STATES: usize = 64;

/// Answers questions about the ROS graph.
#[derive(Clone)]
pub struct GraphRequests {
    pub robot: Arc<Robot>,
}

/// A snapshot of the graph, with the task of each participant.
struct GraphView {
    graph: Graph,
    snapshot: Arc<Snapshot>,
    tasks: BTreeMap<ParticipantId, TaskName>,
}

impl GraphRequests {
    /// The nodes; lifecycle nodes include their states.
    pub async fn nodes(&self) -> Result<Answer, Refusal> {
        let graph_view = self.graph_view().await?;
        let states = graph_view.states(graph_view.snapshot.nodes.iter()).await;
        let nodes = graph_view
            .snapshot
            .nodes
            .iter()
            .map(|node| graph_view.summary(node, &states))
            .collect();
        Ok(Answer::Nodes { age_ms: graph_view.age_ms(), nodes })
    }

    /// One node with its endpoints; several nodes if the name is not unique.
    pub async fn node(&self, name: &GraphName) -> Result<Answer, Refusal> {
        let graph_view = self.graph_view().await?;
        let found: Vec<&Node> =
            graph_view.snapshot.nodes.iter().filter(|node| node.name == *name).collect();
        if found.is_empty() {
            return Err(graph_view.no_such_node(name));
        }
        let states = graph_view.states(found.iter().copied()).await;
        let detail = |node: &&Node| NodeDetail {
            node: graph_view.summary(node, &states),
            publishers: node.publishers.clone(),
            subscriptions: node.subscriptions.clone(),
            services: node.services.clone(),
            clients: node.clients.clone(),
        };
        Ok(Answer::Node { age_ms: graph_view.age_ms(), nodes: found.iter().map(detail).collect() })
    }

    /// The topics, with the nodes at their ends.
    pub async fn topics(&self) -> Result<Answer, Refusal> {
        let graph_view = self.graph_view().await?;
        let topics = topics(&graph_view.snapshot.nodes);
        Ok(Answer::Topics { age_ms: graph_view.age_ms(), topics })
    }

    /// All parameters of a node.
    pub async fn parameters(&self, node: &GraphName) -> Result<Answer, Refusal> {
        let graph = self.graph_with(node).await?;
        let mut parameters: Vec<_> =
            graph.parameters(node, ANSWER_TIMEOUT).await.map_err(graph_refusal)?;
        parameters.sort_by(|one, other| one.0.cmp(&other.0));
        let parameter =
            |(name, value): (String, ParameterValue)| Parameter { name, value: value.to_json() };
        Ok(Answer::Parameters { parameters: parameters.into_iter().map(parameter).collect() })
    }

    /// One parameter of a node.
    pub async fn parameter(&self, node: &GraphName, name: &str) -> Result<Answer, Refusal> {
        let graph = self.graph_with(node).await?;
        match graph.parameter(node, name, ANSWER_TIMEOUT).await.map_err(graph_refusal)? {
            ParameterValue::NotSet => {
                Err(refusal("no_such_parameter", format!("{node} has no parameter {name}")))
            }
            value => Ok(Answer::Parameters {
                parameters: vec![Parameter { name: name.to_owned(), value: value.to_json() }],
            }),
        }
    }

    /// Sets a parameter and returns its value afterwards.
    pub async fn set_parameter(
        &self,
        node: &GraphName,
        parameter: &Parameter,
    ) -> Result<Answer, Refusal> {
        let graph = self.graph_with(node).await?;
        let Parameter { name, value } = parameter;
        let no_value = || refusal("rejected", format!("{value} is not a valid parameter value"));
        let current = graph.parameter(node, name, ANSWER_TIMEOUT).await.map_err(graph_refusal)?;
        let wanted = ParameterValue::from_json(value).ok_or_else(no_value)?.fitting(&current);
        let results = graph
            .set_parameters(node, vec![(name.clone(), wanted)], WORK_TIMEOUT)
            .await
            .map_err(graph_refusal)?;
        if let Some(result) = results.iter().find(|result| !result.successful) {
            let reason = if result.reason.is_empty() { "no reason given" } else { &result.reason };
            return Err(refusal(
                "rejected",
                format!("{node} does not accept {name} = {value}: {reason}"),
            ));
        }
        let now = graph.parameter(node, name, ANSWER_TIMEOUT).await.map_err(graph_refusal)?;
        Ok(Answer::ParameterSet {
            parameter: Parameter { name: name.clone(), value: now.to_json() },
        })
    }

    /// Requests a transition and returns the state afterwards.
    pub async fn lifecycle(
        &self,
        node: &GraphName,
        transition: Transition,
    ) -> Result<Answer, Refusal> {
        let graph = self.graph_with(node).await?;
        let before = graph.lifecycle_state(node, ANSWER_TIMEOUT).await.map_err(graph_refusal)?;
        let done =
            graph.change_state(node, transition, WORK_TIMEOUT).await.map_err(graph_refusal)?;
        if !done {
            let text =
                format!("{node} does not {}: it is {}", transition.as_str(), before.as_str());
            return Err(refusal("rejected", text));
        }
        match graph.lifecycle_state(node, ANSWER_TIMEOUT).await {
            Ok(state) => Ok(Answer::Lifecycle { state }),
            // A node that was shut down may be gone before it can answer.
            Err(_) if transition == Transition::Shutdown => {
                Ok(Answer::Lifecycle { state: LifecycleState::Finalized })
            }
            Err(error) => Err(graph_refusal(error)),
        }
    }

    async fn graph_view(&self) -> Result<GraphView, Refusal> {
        let graph = self.robot.graph().await.map_err(|failure| no_graph(&failure))?;
        let snapshot = graph.snapshot();
        let mut tasks = BTreeMap::new();
        for (task, pids) in self.robot.task_pids().await {
            let owners = Graph::owners(snapshot.clone(), pids).await;
            tasks.extend(owners.theirs.into_iter().map(|id| (id, task.clone())));
        }
        Ok(GraphView { graph, snapshot, tasks })
    }

    /// The graph, if it contains this node.
    async fn graph_with(&self, node: &GraphName) -> Result<Graph, Refusal> {
        let graph_view = self.graph_view().await?;
        let is_there = graph_view.snapshot.nodes.iter().any(|known| known.name == *node);
        if is_there { Ok(graph_view.graph) } else { Err(graph_view.no_such_node(node)) }
    }
}

impl GraphView {
    fn age_ms(&self) -> u64 {
        millis(self.snapshot.at.elapsed())
    }

    fn no_such_node(&self, name: &GraphName) -> Refusal {
        let mut there: Vec<&str> =
            self.snapshot.nodes.iter().map(|node| node.name.as_str()).collect();
        there.truncate(20);
        let there = if there.is_empty() { "nothing".to_owned() } else { there.join(", ") };
        refusal("no_such_node", format!("there is no node {name}; on the graph: {there}"))
    }

    /// The lifecycle states of the nodes that have one and answer in time. All nodes are asked at
    /// once.
    async fn states(
        &self,
        nodes: impl Iterator<Item = &Node>,
    ) -> BTreeMap<GraphName, LifecycleState> {
        let with_state: BTreeSet<GraphName> = nodes
            .filter(|node| node.has_lifecycle())
            .map(|node| node.name.clone())
            .take(MAX_STATES)
            .collect();
        let mut queries = JoinSet::new();
        for name in with_state {
            let graph = self.graph.clone();
            queries.spawn(async move {
                let state = graph.lifecycle_state(&name, ANSWER_TIMEOUT).await;
                Some((name, state.ok()?))
            });
        }
        queries.join_all().await.into_iter().flatten().collect()
    }

    fn summary(&self, node: &Node, states: &BTreeMap<GraphName, LifecycleState>) -> NodeSummary {
        NodeSummary {
            name: node.name.clone(),
            task: self.tasks.get(&node.participant).cloned(),
            lifecycle: states.get(&node.name).copied(),
        }
    }
}

fn topics(nodes: &[Node]) -> Vec<TopicSummary> {
    let mut topics: BTreeMap<&GraphName, TopicSummary> = BTreeMap::new();
    for node in nodes {
        for (endpoints, publishes) in [(&node.publishers, true), (&node.subscriptions, false)] {
            for endpoint in endpoints {
                let topic = topics.entry(&endpoint.name).or_insert_with(|| TopicSummary {
                    name: endpoint.name.clone(),
                    types: Vec::new(),
                    publishers: Vec::new(),
                    subscriptions: Vec::new(),
                });
                if !topic.types.contains(&endpoint.kind) {
                    topic.types.push(endpoint.kind.clone());
                }
                let ends = if publishes { &mut topic.publishers } else { &mut topic.subscriptions };
                // A node with two publishers of a topic is listed once.
                if ends.last() != Some(&node.name) {
                    ends.push(node.name.clone());
                }
            }
        }
    }
    topics.into_values().collect()
}

fn refusal(code: &str, text: impl Into<String>) -> Refusal {
    Refusal { code: code.to_owned(), text: text.into() }
}

fn no_graph(failure: &Failure) -> Refusal {
    refusal("no_ros", failure.text.clone())
}

fn graph_refusal(error: GraphError) -> Refusal {
    let code = match &error {
        GraphError::NoServer { .. } | GraphError::NoAnswer { .. } => "timeout",
        GraphError::TooMany { .. } => "too_large",
        _ => "rejected",
    };
    refusal(code, chain(&error))
}

#[cfg(test)]
mod tests {
    use super::*;
    use task_proto::telemetry::ros::Endpoint;

    #[test]
    fn topic_lists_each_node_once() {
        let endpoint =
            |kind: &str| Endpoint { name: "/scan".parse().expect("valid"), kind: kind.to_owned() };
        let node = |name: &str, publishers: Vec<Endpoint>, subscriptions: Vec<Endpoint>| Node {
            name: name.parse().expect("valid"),
            participant: ParticipantId([0; 12]),
            publishers,
            subscriptions,
            services: Vec::new(),
            clients: Vec::new(),
        };
        let scan = "sensor_msgs/msg/LaserScan";
        let found = topics(&[
            node("/lidar", vec![endpoint(scan), endpoint(scan)], vec![]),
            node("/mapper", vec![], vec![endpoint(scan)]),
            node("/odd", vec![], vec![endpoint("std_msgs/msg/String")]),
        ]);
        let [topic] = &found[..] else { panic!("{found:?}") };
        assert_eq!(topic.types, [scan, "std_msgs/msg/String"]);
        assert_eq!(topic.publishers.len(), 1);
        assert_eq!(
            topic.subscriptions.iter().map(GraphName::as_str).collect::<Vec<_>>(),
            ["/mapper", "/odd"]
        );
    }
}
