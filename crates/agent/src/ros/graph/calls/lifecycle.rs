//! Managed nodes: their state and their transitions, by the services that every lifecycle node has.

use std::time::Duration;

use serde::{Deserialize, Serialize};
use task_proto::telemetry::ros::{GraphName, LifecycleState, Transition};

use super::services::{Clients, Repeat};
use crate::ros::graph::{GraphError, service_of};

const GET_STATE: (&str, &str) = ("get_state", "lifecycle_msgs/srv/GetState");
const CHANGE_STATE: (&str, &str) = ("change_state", "lifecycle_msgs/srv/ChangeState");

/// A request without fields: DDS has no empty messages, so ROS sends one byte.
#[derive(Serialize)]
struct EmptyRequest {
    filler: u8,
}

#[derive(Deserialize)]
struct GetStateResponse {
    id: u8,
    #[expect(dead_code, reason = "the id says the same")]
    label: String,
}

#[derive(Serialize)]
struct ChangeStateRequest {
    id: u8,
    label: &'static str,
}

#[derive(Deserialize)]
struct ChangeStateResponse {
    success: bool,
}

/// Creates the clients for this node, before the node exists.
pub(in crate::ros::graph) async fn prepare(
    clients: &Clients,
    node: &GraphName,
) -> Result<(), GraphError> {
    for (name, kind) in [GET_STATE, CHANGE_STATE] {
        clients.prepare(&service_of(node, name)?, kind).await?;
    }
    Ok(())
}

/// The node's current state.
pub(in crate::ros::graph) async fn state(
    clients: &Clients,
    node: &GraphName,
    within: Duration,
) -> Result<LifecycleState, GraphError> {
    let service = service_of(node, GET_STATE.0)?;
    let state: GetStateResponse = clients
        .call(&service, GET_STATE.1, &EmptyRequest { filler: 0 }, within, Repeat::UntilDeadline)
        .await?;
    Ok(of_id(state.id))
}

/// Requests the transition; returns whether the node made it.
pub(in crate::ros::graph) async fn change(
    clients: &Clients,
    node: &GraphName,
    transition: Transition,
    within: Duration,
) -> Result<bool, GraphError> {
    let service = service_of(node, CHANGE_STATE.0)?;
    let changed: ChangeStateResponse = clients
        .call(&service, CHANGE_STATE.1, &request_of(transition), within, Repeat::Never)
        .await?;
    Ok(changed.success)
}

/// The numbers are those of `lifecycle_msgs/msg/State`.
fn of_id(id: u8) -> LifecycleState {
    match id {
        1 => LifecycleState::Unconfigured,
        2 => LifecycleState::Inactive,
        3 => LifecycleState::Active,
        4 => LifecycleState::Finalized,
        _ => LifecycleState::Changing,
    }
}

/// The numbers are those of `lifecycle_msgs/msg/Transition`. Shutdown has a different number in
/// every state, but one label, which nodes check first.
fn request_of(transition: Transition) -> ChangeStateRequest {
    match transition {
        Transition::Configure => ChangeStateRequest { id: 1, label: "" },
        Transition::Cleanup => ChangeStateRequest { id: 2, label: "" },
        Transition::Activate => ChangeStateRequest { id: 3, label: "" },
        Transition::Deactivate => ChangeStateRequest { id: 4, label: "" },
        Transition::Shutdown => ChangeStateRequest { id: 0, label: "shutdown" },
    }
}
