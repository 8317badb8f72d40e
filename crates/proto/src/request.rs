//! Questions to a robot and one-off actions, over MQTT: each has an id and a deadline, is asked
//! once and never replayed. What is meant to last is part of the desired state instead.

use serde::{Deserialize, Serialize};

use crate::envelope::Envelope;
use crate::id::{GraphName, InstanceId, RequestId};
use crate::log::{LogBatch, LogLevel};
use crate::ros::{LifecycleState, NodeDetail, NodeSummary, Parameter, TopicSummary, Transition};
use crate::vitals::Vitals;
use crate::{RobotId, TaskName};

/// The largest reply, in bytes of JSON; older brokers of ours take packets up to 256 KiB.
pub const MAX_REPLY_BYTES: usize = 240 * 1024;
/// The longest a robot may take for an answer, in milliseconds.
pub const MAX_TTL_MS: u64 = 60_000;
/// The payload type of a signed [`Action`].
pub const ACTION_TYPE: &str = "application/vnd.taskd.action.v1+json";

/// What the server publishes on a robot's `request` topic.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Request {
    /// Comes back in the reply.
    pub id: RequestId,
    /// Milliseconds from its arrival in which an answer is of use; nothing is begun after that.
    pub ttl_ms: u64,
    /// What is asked.
    pub ask: Ask,
    /// The [`Action`], where the question changes something: a broker that is not the server's, or
    /// who listens in, must not be able to ask that.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub signed: Option<Envelope>,
}

/// What the server signs of a question that changes something. It is good for one robot, one start
/// of its agent, and once.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Action {
    /// Whom it is for.
    pub robot_id: RobotId,
    /// The start of the agent that is to do it.
    pub instance: InstanceId,
    /// The request's.
    pub id: RequestId,
    /// What is asked.
    pub ask: Ask,
}

/// What can be asked of a robot. Also the body of `POST /robots/{robot}/ask` (read, or operate if
/// it changes something).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum Ask {
    /// The nodes on its ROS graph.
    Nodes,
    /// One node with its endpoints.
    Node {
        /// Which.
        name: GraphName,
    },
    /// The topics on its ROS graph.
    Topics,
    /// A node's parameters, all of them.
    Parameters {
        /// Which node.
        node: GraphName,
    },
    /// One parameter of a node.
    Parameter {
        /// Which node.
        node: GraphName,
        /// Which parameter.
        name: String,
    },
    /// Sets a parameter now. It lasts as long as the node: the next start sets what the package
    /// says.
    SetParameter {
        /// Which node.
        node: GraphName,
        /// Which parameter and to what.
        parameter: Parameter,
    },
    /// Asks a lifecycle node for a transition.
    Lifecycle {
        /// Which node.
        node: GraphName,
        /// Which transition.
        transition: Transition,
    },
    /// Lines that the robot kept, the newest that fit.
    Logs {
        /// Of one task; absent: of all.
        #[serde(default)]
        task: Option<TaskName>,
        /// Only these and more serious ones.
        #[serde(default)]
        level: LogLevel,
        /// Not older than this many milliseconds.
        #[serde(default)]
        since_ms: Option<u64>,
        /// At most so many.
        max_lines: u64,
    },
    /// Publish lines of this level and above as they come, for so long; a later one replaces it.
    Follow {
        /// Only these and more serious ones.
        level: LogLevel,
        /// For how many milliseconds.
        lease_ms: u64,
    },
    /// How its machine does now.
    Vitals,
    /// A question of a newer version; it is refused as `unsupported`.
    #[serde(other)]
    Unknown,
}

impl Ask {
    /// Whether the robot is not the same afterwards.
    pub fn changes_something(&self) -> bool {
        matches!(self, Self::SetParameter { .. } | Self::Lifecycle { .. })
    }
}

/// What a robot publishes on its `reply` topic.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Reply {
    /// Who speaks.
    pub robot_id: RobotId,
    /// The request's.
    pub id: RequestId,
    /// What came of it: the field `answer` or `refusal`.
    #[serde(flatten)]
    pub outcome: Outcome,
}

/// What came of a request.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// An answer.
    Answer(Answer),
    /// None, and why.
    Refusal(Refusal),
}

/// An answer, of the kind that was asked for.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum Answer {
    /// To [`Ask::Nodes`].
    Nodes {
        /// How old the picture is, in milliseconds.
        age_ms: u64,
        /// Sorted by name.
        nodes: Vec<NodeSummary>,
    },
    /// To [`Ask::Node`].
    Node {
        /// How old the picture is, in milliseconds.
        age_ms: u64,
        /// The node; several of one name are one after the other.
        nodes: Vec<NodeDetail>,
    },
    /// To [`Ask::Topics`].
    Topics {
        /// How old the picture is, in milliseconds.
        age_ms: u64,
        /// Sorted by name.
        topics: Vec<TopicSummary>,
    },
    /// To [`Ask::Parameters`] and [`Ask::Parameter`]: asked of the node now.
    Parameters {
        /// Sorted by name.
        parameters: Vec<Parameter>,
    },
    /// To [`Ask::SetParameter`]: the value the node has now.
    ParameterSet {
        /// As it is now.
        parameter: Parameter,
    },
    /// To [`Ask::Lifecycle`]: the state the node is in now.
    Lifecycle {
        /// As it is now.
        state: LifecycleState,
    },
    /// To [`Ask::Logs`].
    Logs(LogBatch),
    /// To [`Ask::Follow`].
    Following,
    /// To [`Ask::Vitals`].
    Vitals(Vitals),
}

/// Why a robot gives no answer: a stable code for programs, a sentence for people.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Refusal {
    /// `no_ros`, `no_such_node`, `no_such_parameter`, `no_such_task`, `rejected`, `timeout`,
    /// `too_large`, `busy`, `unsupported`, …
    pub code: String,
    /// What and why.
    pub text: String,
}
