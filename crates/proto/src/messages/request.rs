//! Requests to a robot and one-off actions, over MQTT: each has an id and a deadline, is sent once
//! and never replayed. Lasting changes are part of the desired state instead.

use serde::{Deserialize, Serialize};

use crate::ids::{GraphName, InstanceId, RequestId};
use crate::telemetry::log::{LogBatch, LogLevel};
use crate::telemetry::ros::{
    LifecycleState, NodeDetail, NodeSummary, Parameter, TopicSummary, Transition,
};
use crate::telemetry::vitals::Vitals;
use crate::trust::envelope::Envelope;
use crate::{RobotId, TaskName};

/// The largest reply, in bytes of JSON; our older brokers accept packets up to 256 KiB.
pub const MAX_REPLY_BYTES: usize = 240 * 1024;
/// Maximum time for a robot's answer, in milliseconds.
pub const MAX_TTL_MS: u64 = 60_000;
/// The payload type of a signed [`Action`].
pub const ACTION_TYPE: &str = "application/vnd.taskd.action.v1+json";

/// The message that the server publishes on a robot's `request` topic.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Request {
    /// The request's id; the reply repeats it.
    pub id: RequestId,
    /// Milliseconds from arrival during which an answer is useful; the robot begins no work later.
    pub ttl_ms: u64,
    /// The question.
    pub ask: Ask,
    /// The signed [`Action`], if the question changes the robot's state: an external broker or an
    /// eavesdropper must not be able to forge such a request.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub signed: Option<Envelope>,
}

/// The signed content of a question that changes the robot's state. Valid for one robot and one
/// start of its agent, and only once.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Action {
    /// The robot that the action is for.
    pub robot_id: RobotId,
    /// The start of the agent that the action is for.
    pub instance: InstanceId,
    /// The request's id.
    pub id: RequestId,
    /// The question.
    pub ask: Ask,
}

/// A question to a robot. Also the body of `POST /robots/{robot}/ask` (read; operate if the
/// question changes the robot's state).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum Ask {
    /// The nodes on the robot's ROS graph.
    Nodes,
    /// One node with its endpoints.
    Node {
        /// The node's name.
        name: GraphName,
    },
    /// The topics on the robot's ROS graph.
    Topics,
    /// All parameters of a node.
    Parameters {
        /// The node's name.
        node: GraphName,
    },
    /// One parameter of a node.
    Parameter {
        /// The node's name.
        node: GraphName,
        /// The parameter's name.
        name: String,
    },
    /// Sets a parameter now. The value lasts as long as the node: the next start applies the
    /// package's values.
    SetParameter {
        /// The node's name.
        node: GraphName,
        /// The parameter and its new value.
        parameter: Parameter,
    },
    /// Asks a lifecycle node for a transition.
    Lifecycle {
        /// The node's name.
        node: GraphName,
        /// The requested transition.
        transition: Transition,
    },
    /// Stored log lines, the newest that fit into the answer.
    Logs {
        /// Only lines of this task; absent: all tasks.
        #[serde(default)]
        task: Option<TaskName>,
        /// Minimum severity.
        #[serde(default)]
        level: LogLevel,
        /// Maximum age in milliseconds.
        #[serde(default)]
        since_ms: Option<u64>,
        /// Maximum number of lines.
        max_lines: u64,
    },
    /// Publishes new lines of this level and above until the lease ends; a later request replaces
    /// this one.
    Follow {
        /// Minimum severity.
        level: LogLevel,
        /// Duration in milliseconds.
        lease_ms: u64,
    },
    /// Current vitals of the robot's machine.
    Vitals,
    /// A question of a newer version; the robot refuses it as `unsupported`.
    #[serde(other)]
    Unknown,
}

impl Ask {
    /// Whether the question changes the robot's state.
    pub fn changes_something(&self) -> bool {
        matches!(self, Self::SetParameter { .. } | Self::Lifecycle { .. })
    }
}

/// The message that a robot publishes on its `reply` topic.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Reply {
    /// The robot that replies.
    pub robot_id: RobotId,
    /// The request's id.
    pub id: RequestId,
    /// The outcome: the field `answer` or `refusal`.
    #[serde(flatten)]
    pub outcome: Outcome,
}

/// The outcome of a request.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// An answer.
    Answer(Answer),
    /// A refusal, with its reason.
    Refusal(Refusal),
}

/// An answer, of the requested type.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum Answer {
    /// Answer to [`Ask::Nodes`].
    Nodes {
        /// Age of the robot's view of the graph, in milliseconds.
        age_ms: u64,
        /// Sorted by name.
        nodes: Vec<NodeSummary>,
    },
    /// Answer to [`Ask::Node`].
    Node {
        /// Age of the robot's view of the graph, in milliseconds.
        age_ms: u64,
        /// The node; nodes with the same name are separate elements.
        nodes: Vec<NodeDetail>,
    },
    /// Answer to [`Ask::Topics`].
    Topics {
        /// Age of the robot's view of the graph, in milliseconds.
        age_ms: u64,
        /// Sorted by name.
        topics: Vec<TopicSummary>,
    },
    /// Answer to [`Ask::Parameters`] and [`Ask::Parameter`], with values read from the node now.
    Parameters {
        /// Sorted by name.
        parameters: Vec<Parameter>,
    },
    /// Answer to [`Ask::SetParameter`]: the value that the node has now.
    ParameterSet {
        /// The parameter's current value.
        parameter: Parameter,
    },
    /// Answer to [`Ask::Lifecycle`]: the state that the node is in now.
    Lifecycle {
        /// The node's current state.
        state: LifecycleState,
    },
    /// Answer to [`Ask::Logs`].
    Logs(LogBatch),
    /// Answer to [`Ask::Follow`].
    Following,
    /// Answer to [`Ask::Vitals`].
    Vitals(Vitals),
}

/// Why a robot refuses a request: a stable code for programs, a sentence for people.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Refusal {
    /// `no_ros`, `no_such_node`, `no_such_parameter`, `no_such_task`, `rejected`, `timeout`,
    /// `too_large`, `busy`, `unsupported`, …
    pub code: String,
    /// Description of the refusal and its reason.
    pub text: String,
}
