//! `taskd node|topic|param|lifecycle`: shows a robot's ROS graph, and acts on its nodes. Each
//! command sends one request to the robot; nothing lasts beyond a restart of the task.

use clap::Subcommand;
use task_proto::RobotName;
use task_proto::ids::GraphName;
use task_proto::messages::request::{Answer, Ask};
use task_proto::telemetry::ros::{
    Endpoint, NodeDetail, NodeSummary, Parameter, TopicSummary, Transition,
};

use crate::api::complete;
use crate::display::output::table::Columns;
use crate::display::output::{printable, say};
use crate::{CommandError, Outcome, Session};

#[derive(Debug, Subcommand)]
pub enum NodeAction {
    /// List the nodes on a robot's graph
    List {
        /// Robot name or id
        #[arg(add = complete::robots())]
        robot: RobotName,
    },
    /// Show the topics and services of a node
    Info {
        /// Robot name or id
        #[arg(add = complete::robots())]
        robot: RobotName,
        /// Full name of the node, such as /mapper
        #[arg(add = complete::nodes())]
        node: GraphName,
    },
}

#[derive(Debug, Subcommand)]
pub enum TopicAction {
    /// List the topics on a robot's graph
    List {
        /// Robot name or id
        #[arg(add = complete::robots())]
        robot: RobotName,
    },
}

#[derive(Debug, Subcommand)]
pub enum ParamAction {
    /// List the parameters of a node
    List {
        /// Robot name or id
        #[arg(add = complete::robots())]
        robot: RobotName,
        /// Full name of the node, such as /mapper
        #[arg(add = complete::nodes())]
        node: GraphName,
    },
    /// Show a parameter of a node
    Get {
        /// Robot name or id
        #[arg(add = complete::robots())]
        robot: RobotName,
        /// Full name of the node, such as /mapper
        #[arg(add = complete::nodes())]
        node: GraphName,
        /// Parameter name
        name: String,
    },
    /// Set a parameter of a running node until its next start
    Set {
        /// Robot name or id
        #[arg(add = complete::robots())]
        robot: RobotName,
        /// Full name of the node, such as /mapper
        #[arg(add = complete::nodes())]
        node: GraphName,
        /// Parameter name
        name: String,
        /// Value: true, 7, 0.5, text or a list such as [1, 2]; quote numbers to pass text: '"7"'
        #[arg(allow_hyphen_values = true)]
        value: String,
    },
}

/// The node, and the requested transition.
#[derive(Debug, clap::Args)]
pub struct LifecycleArgs {
    /// Robot name or id
    #[arg(add = complete::robots())]
    robot: RobotName,
    /// Full name of the node, such as /mapper
    #[arg(add = complete::nodes())]
    node: GraphName,
    /// Lifecycle transition to request
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

pub(crate) async fn node(session: &Session, action: NodeAction) -> Result<Outcome, CommandError> {
    match action {
        NodeAction::List { robot } => {
            let answer = session.client.query_robot(&robot, &Ask::Nodes).await?;
            print_age(&answer);
            session.output.print_list(
                &answer,
                &Columns::of(&["node", "task", "state"]),
                |answer| match answer {
                    Answer::Nodes { nodes, .. } => nodes.iter().map(node_row).collect(),
                    _ => Vec::new(),
                },
            )?;
        }
        NodeAction::Info { robot, node } => {
            let answer =
                session.client.query_robot(&robot, &Ask::Node { name: node.clone() }).await?;
            print_age(&answer);
            session.output.print_object(
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

pub(crate) async fn topic(session: &Session, action: TopicAction) -> Result<Outcome, CommandError> {
    let TopicAction::List { robot } = action;
    let answer = session.client.query_robot(&robot, &Ask::Topics).await?;
    print_age(&answer);
    session.output.print_list(
        &answer,
        &Columns::of(&["topic", "type", "publishers", "subscriptions"]),
        |answer| match answer {
            Answer::Topics { topics, .. } => topics.iter().map(topic_row).collect(),
            _ => Vec::new(),
        },
    )?;
    Ok(Outcome::Succeeded)
}

pub(crate) async fn param(session: &Session, action: ParamAction) -> Result<Outcome, CommandError> {
    let (robot, ask) = match action {
        ParamAction::List { robot, node } => (robot, Ask::Parameters { node }),
        ParamAction::Get { robot, node, name } => (robot, Ask::Parameter { node, name }),
        ParamAction::Set { robot, node, name, value } => {
            let value = parameter_value(&value)?;
            (robot, Ask::SetParameter { node, parameter: Parameter { name, value } })
        }
    };
    let answer = session.client.query_robot(&robot, &ask).await?;
    let row = |parameter: &Parameter| vec![parameter.name.clone(), parameter.value.to_string()];
    session.output.print_list(
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

pub(crate) async fn lifecycle(
    session: &Session,
    args: LifecycleArgs,
) -> Result<Outcome, CommandError> {
    let LifecycleArgs { robot, node, transition } = args;
    let answer = session
        .client
        .query_robot(&robot, &Ask::Lifecycle { node: node.clone(), transition: transition.into() })
        .await?;
    session.output.print_object(
        &answer,
        |_| node.to_string(),
        |answer| match answer {
            Answer::Lifecycle { state } => format!("{node} is {}", state.as_str()),
            _ => String::new(),
        },
    )?;
    Ok(Outcome::Succeeded)
}

fn print_age(answer: &Answer) {
    if let Answer::Nodes { age_ms, .. }
    | Answer::Node { age_ms, .. }
    | Answer::Topics { age_ms, .. } = answer
    {
        // Tenths are enough, and a count of milliseconds fits a float exactly.
        say(&format!("state of the graph {:.1} s ago", *age_ms as f64 / 1000.0));
    }
}

/// A value from the command line: JSON if the text is valid JSON, otherwise a string.
fn parameter_value(text: &str) -> Result<serde_json::Value, CommandError> {
    match serde_json::from_str(text) {
        Ok(serde_json::Value::Object(_)) => {
            Err(CommandError::Usage(format!("VALUE: {text:?}: a parameter can't be a table")))
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
        node.lifecycle.map_or("-", task_proto::telemetry::ros::LifecycleState::as_str).to_owned(),
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
        ("provides", services),
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
    fn parameter_values_are_parsed_as_json_or_text() {
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
