//! `taskd node|topic|param|lifecycle`: shows a robot's ROS graph, and acts on its nodes. Each
//! command sends one request to the robot; nothing lasts beyond a restart of the task.

use clap::Subcommand;
use task_proto::RobotName;
use task_proto::id::GraphName;
use task_proto::request::{Answer, Ask};
use task_proto::ros::{Endpoint, NodeDetail, NodeSummary, Parameter, TopicSummary, Transition};

use crate::commands::api::complete;
use crate::commands::display::output::table::Columns;
use crate::commands::display::output::{printable, say};
use crate::commands::{CommandError, Outcome, Session};

/// What to do with nodes.
#[derive(Debug, Subcommand)]
pub enum NodeAction {
    /// List the nodes on a robot's graph
    List {
        /// The robot's name or id
        #[arg(add = complete::robots())]
        robot: RobotName,
    },
    /// Show a node with its topics and services
    Info {
        /// The robot's name or id
        #[arg(add = complete::robots())]
        robot: RobotName,
        /// The node's full name, like /mapper
        #[arg(add = complete::nodes())]
        node: GraphName,
    },
}

/// What to do with topics.
#[derive(Debug, Subcommand)]
pub enum TopicAction {
    /// List the topics on a robot's graph
    List {
        /// The robot's name or id
        #[arg(add = complete::robots())]
        robot: RobotName,
    },
}

/// What to do with parameters.
#[derive(Debug, Subcommand)]
pub enum ParamAction {
    /// List a node's parameters
    List {
        /// The robot's name or id
        #[arg(add = complete::robots())]
        robot: RobotName,
        /// The node's full name, like /mapper
        #[arg(add = complete::nodes())]
        node: GraphName,
    },
    /// Show one parameter of a node
    Get {
        /// The robot's name or id
        #[arg(add = complete::robots())]
        robot: RobotName,
        /// The node's full name, like /mapper
        #[arg(add = complete::nodes())]
        node: GraphName,
        /// The parameter's name
        name: String,
    },
    /// Set a parameter of a running node, until its next start
    Set {
        /// The robot's name or id
        #[arg(add = complete::robots())]
        robot: RobotName,
        /// The node's full name, like /mapper
        #[arg(add = complete::nodes())]
        node: GraphName,
        /// The parameter's name
        name: String,
        /// true, 7, 0.5, text or a list like [1, 2]; "7" in its own quotes is a text
        #[arg(allow_hyphen_values = true)]
        value: String,
    },
}

/// Asks a lifecycle node for a transition.
#[derive(Debug, clap::Args)]
pub struct LifecycleOrder {
    /// The robot's name or id
    #[arg(add = complete::robots())]
    robot: RobotName,
    /// The node's full name, like /mapper
    #[arg(add = complete::nodes())]
    node: GraphName,
    /// What it is to do
    #[arg(value_enum)]
    transition: TransitionName,
}

/// A transition by its name, which shells complete.
#[derive(Debug, Clone, Copy, clap::ValueEnum)]
enum TransitionName {
    Configure,
    Activate,
    Deactivate,
    Cleanup,
    Shutdown,
}

impl From<TransitionName> for Transition {
    fn from(name: TransitionName) -> Self {
        match name {
            TransitionName::Configure => Self::Configure,
            TransitionName::Activate => Self::Activate,
            TransitionName::Deactivate => Self::Deactivate,
            TransitionName::Cleanup => Self::Cleanup,
            TransitionName::Shutdown => Self::Shutdown,
        }
    }
}

pub(in crate::commands) async fn node(
    session: &Session,
    action: NodeAction,
) -> Result<Outcome, CommandError> {
    match action {
        NodeAction::List { robot } => {
            let answer = session.client.ask(&robot, &Ask::Nodes).await?;
            say_age(&answer);
            session.output.result(&answer, &Columns::of(&["node", "task", "state"]), |answer| {
                match answer {
                    Answer::Nodes { nodes, .. } => nodes.iter().map(node_row).collect(),
                    _ => Vec::new(),
                }
            })?;
        }
        NodeAction::Info { robot, node } => {
            let answer = session.client.ask(&robot, &Ask::Node { name: node.clone() }).await?;
            say_age(&answer);
            session.output.described(
                &answer,
                |_| node.to_string(),
                |answer| match answer {
                    Answer::Node { nodes, .. } => {
                        nodes.iter().map(describe).collect::<Vec<_>>().join("\n")
                    }
                    _ => String::new(),
                },
            )?;
        }
    }
    Ok(Outcome::Succeeded)
}

pub(in crate::commands) async fn topic(
    session: &Session,
    action: TopicAction,
) -> Result<Outcome, CommandError> {
    let TopicAction::List { robot } = action;
    let answer = session.client.ask(&robot, &Ask::Topics).await?;
    say_age(&answer);
    session.output.result(
        &answer,
        &Columns::of(&["topic", "type", "publishers", "subscriptions"]),
        |answer| match answer {
            Answer::Topics { topics, .. } => topics.iter().map(topic_row).collect(),
            _ => Vec::new(),
        },
    )?;
    Ok(Outcome::Succeeded)
}

pub(in crate::commands) async fn param(
    session: &Session,
    action: ParamAction,
) -> Result<Outcome, CommandError> {
    let (robot, ask) = match action {
        ParamAction::List { robot, node } => (robot, Ask::Parameters { node }),
        ParamAction::Get { robot, node, name } => (robot, Ask::Parameter { node, name }),
        ParamAction::Set { robot, node, name, value } => {
            let value = parameter_value(&value)?;
            (robot, Ask::SetParameter { node, parameter: Parameter { name, value } })
        }
    };
    let answer = session.client.ask(&robot, &ask).await?;
    let row = |parameter: &Parameter| vec![parameter.name.clone(), parameter.value.to_string()];
    session.output.result(
        &answer,
        &Columns::of(&["parameter", "value"]),
        |answer| match answer {
            Answer::Parameters { parameters } => parameters.iter().map(row).collect(),
            Answer::ParameterSet { parameter } => vec![row(parameter)],
            _ => Vec::new(),
        },
    )?;
    Ok(Outcome::Succeeded)
}

pub(in crate::commands) async fn lifecycle(
    session: &Session,
    order: LifecycleOrder,
) -> Result<Outcome, CommandError> {
    let LifecycleOrder { robot, node, transition } = order;
    let answer = session
        .client
        .ask(&robot, &Ask::Lifecycle { node: node.clone(), transition: transition.into() })
        .await?;
    session.output.described(
        &answer,
        |_| node.to_string(),
        |answer| match answer {
            Answer::Lifecycle { state } => format!("{node} is {}", state.as_str()),
            _ => String::new(),
        },
    )?;
    Ok(Outcome::Succeeded)
}

fn say_age(answer: &Answer) {
    if let Answer::Nodes { age_ms, .. }
    | Answer::Node { age_ms, .. }
    | Answer::Topics { age_ms, .. } = answer
    {
        // Tenths are enough, and a count of milliseconds fits a float exactly.
        say(&format!("the graph as it was {:.1} s ago", *age_ms as f64 / 1000.0));
    }
}

/// A value from the command line: JSON if the text is valid JSON, otherwise a string.
fn parameter_value(text: &str) -> Result<serde_json::Value, CommandError> {
    match serde_json::from_str(text) {
        Ok(serde_json::Value::Object(_)) => {
            Err(CommandError::Usage(format!("VALUE: {text:?}: a parameter is no table")))
        }
        Ok(value) => Ok(value),
        Err(error) if text.starts_with(['[', '{', '"']) => {
            Err(CommandError::Usage(format!("VALUE: {text:?}: {error}")))
        }
        Err(_) => Ok(text.into()),
    }
}

fn node_row(node: &NodeSummary) -> Vec<String> {
    vec![
        node.name.to_string(),
        node.task.as_ref().map_or_else(|| "-".to_owned(), ToString::to_string),
        node.lifecycle.map_or("-", task_proto::ros::LifecycleState::as_str).to_owned(),
    ]
}

fn topic_row(topic: &TopicSummary) -> Vec<String> {
    let names = |names: &[GraphName]| {
        let names: Vec<_> = names.iter().map(GraphName::as_str).collect();
        if names.is_empty() { "-".to_owned() } else { names.join(" ") }
    };
    vec![
        topic.name.to_string(),
        topic.types.join(" "),
        names(&topic.publishers),
        names(&topic.subscriptions),
    ]
}

fn describe(detail: &NodeDetail) -> String {
    let NodeDetail { node, publishers, subscriptions, services, clients } = detail;
    let mut text = format!("{}\n", node.name);
    if let Some(task) = &node.task {
        text.push_str(&format!("  task: {task}\n"));
    }
    if let Some(state) = node.lifecycle {
        text.push_str(&format!("  state: {}\n", state.as_str()));
    }
    let lists = [
        ("publishes", publishers),
        ("subscribes to", subscriptions),
        ("offers", services),
        ("calls", clients),
    ];
    for (what, endpoints) in lists {
        if !endpoints.is_empty() {
            text.push_str(&format!("  {what}:\n"));
        }
        let line =
            |endpoint: &Endpoint| format!("    {}  {}\n", endpoint.name, printable(&endpoint.kind));
        text.extend(endpoints.iter().map(line));
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn values_are_read_as_they_are_typed() {
        for (text, expected) in [
            ("true", json!(true)),
            ("7", json!(7)),
            ("-0.5", json!(-0.5)),
            ("1.0", json!(1.0)),
            ("[1, 2]", json!([1, 2])),
            ("\"7\"", json!("7")),
            ("fast lane", json!("fast lane")),
        ] {
            assert_eq!(parameter_value(text).expect(text), expected);
        }
        for bad in ["[1, 2", "{\"a\": 1}", "\"open"] {
            assert!(matches!(parameter_value(bad), Err(CommandError::Usage(_))), "{bad}");
        }
    }
}
