//! Words of ROS that cross the wire: graph names, lifecycle states and transitions, what a robot's
//! graph shows. Sources: the ROS 2 design articles on names and on managed nodes, and
//! `lifecycle_msgs`. It never talks to ROS.

use serde::{Deserialize, Serialize};

use crate::TaskName;
pub use crate::ids::GraphName;

/// A lifecycle node's primary or transition state, as in `lifecycle_msgs/msg/State`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum LifecycleState {
    /// Created, not configured.
    Unconfigured,
    /// Configured, not processing.
    Inactive,
    /// Processing.
    Active,
    /// About to be destroyed.
    Finalized,
    /// Between two of them, or a state this version does not know.
    #[serde(other)]
    Changing,
}

impl LifecycleState {
    /// The state as text.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Unconfigured => "unconfigured",
            Self::Inactive => "inactive",
            Self::Active => "active",
            Self::Finalized => "finalized",
            Self::Changing => "changing",
        }
    }
}

/// A transition that a lifecycle node can be asked for, as in `lifecycle_msgs/msg/Transition`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum Transition {
    /// Unconfigured to inactive.
    Configure,
    /// Inactive to unconfigured.
    Cleanup,
    /// Inactive to active.
    Activate,
    /// Active to inactive.
    Deactivate,
    /// Any primary state to finalized.
    Shutdown,
}

impl Transition {
    /// Every transition.
    pub const ALL: [Self; 5] =
        [Self::Configure, Self::Cleanup, Self::Activate, Self::Deactivate, Self::Shutdown];

    /// The transition as text.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Configure => "configure",
            Self::Cleanup => "cleanup",
            Self::Activate => "activate",
            Self::Deactivate => "deactivate",
            Self::Shutdown => "shutdown",
        }
    }
}

/// A node in a list.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct NodeSummary {
    /// The node's full name.
    pub name: GraphName,
    /// The task that runs the node, if known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub task: Option<TaskName>,
    /// The node's state, if it is a lifecycle node that answered.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lifecycle: Option<LifecycleState>,
}

/// A node with its endpoints.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct NodeDetail {
    /// Name, task and state.
    #[serde(flatten)]
    pub node: NodeSummary,
    /// Topics that the node publishes.
    pub publishers: Vec<Endpoint>,
    /// Topics that the node subscribes to.
    pub subscriptions: Vec<Endpoint>,
    /// Services that the node offers.
    pub services: Vec<Endpoint>,
    /// Services that the node calls.
    pub clients: Vec<Endpoint>,
}

/// A topic or service at a node.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Endpoint {
    /// The full name of the topic or service.
    pub name: GraphName,
    /// `package/msg/Type` or `package/srv/Type`.
    #[serde(rename = "type")]
    pub kind: String,
}

/// A topic with its publishers and subscribers.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct TopicSummary {
    /// The topic's full name.
    pub name: GraphName,
    /// The topic's types; more than one means that publishers and subscribers disagree.
    pub types: Vec<String>,
    /// The nodes that publish the topic.
    pub publishers: Vec<GraphName>,
    /// The nodes that subscribe to the topic.
    pub subscriptions: Vec<GraphName>,
}

/// A node's parameter. The value is a boolean, a number, a string, a list of one of these, or null
/// if unset.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Parameter {
    /// The parameter's name.
    pub name: String,
    /// The parameter's value.
    pub value: serde_json::Value,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn states_and_transitions_are_the_same_text_everywhere() {
        for transition in Transition::ALL {
            assert_eq!(serde_json::to_value(transition).expect("json"), transition.as_str());
        }
        assert_eq!(serde_json::to_value(LifecycleState::Active).expect("json"), "active");
        assert_eq!(
            serde_json::from_str::<LifecycleState>("\"dreaming\"").expect("tolerated"),
            LifecycleState::Changing
        );
    }
}
