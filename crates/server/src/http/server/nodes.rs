//! The servers of the cluster, with their figures, and the order that one of them sends its robots
//! to the others.

use std::net::SocketAddr;

use axum::Json;
use axum::extract::{ConnectInfo, Request, State};
use axum::response::{IntoResponse as _, NoContent, Response};
use task_macros::operation;
use task_proto::api::{NodeFigures, NodeList, NodeState, NodeView};
use task_proto::ids::NodeName;
use task_proto::time::millis;

use super::gauges::Gauges;
use super::node_drain::NodeDrain;
use super::peers::own_figures;
use crate::domain::person::Person;
use crate::http::error::ApiError;
use crate::http::extract::PathParam;
use crate::http::peers::{Patience, PeerStatus, Peers};
use crate::orders::actions::NodeActions;

/// Lists the servers of the cluster.
#[operation(tag = "server")]
pub(in crate::http) async fn list(
    State(gauges): State<Gauges>,
) -> Result<Json<NodeList>, ApiError> {
    let nodes = gauges.peers.statuses(own_figures(&gauges)).await?;
    Ok(Json(NodeList { nodes: nodes.into_iter().filter_map(view).collect() }))
}

/// A server for people; `None`: its name was stored by no server.
pub(super) fn view(status: PeerStatus) -> Option<NodeView> {
    let PeerStatus { node, heartbeat_age, is_own, is_live, figures } = status;
    Some(NodeView {
        name: node.name.parse().ok()?,
        url: node.url,
        version: node.version,
        state: state(is_live, figures.as_ref()),
        answers: is_own,
        heartbeat_age_ms: heartbeat_age.map(millis),
        figures,
    })
}

fn state(is_live: bool, figures: Option<&NodeFigures>) -> NodeState {
    match figures {
        _ if !is_live => NodeState::Lost,
        Some(NodeFigures { draining: true, .. }) => NodeState::Draining,
        Some(_) => NodeState::Serving,
        None => NodeState::Silent,
    }
}

/// Makes a server of the cluster send its robots to the others.
///
/// From now on its `/readyz` answers 503, and soon its robots' sessions end one after the other. It
/// serves until it is stopped.
#[operation(tag = "server",
    responses((status = 204, description = "The server drains."),
        (status = 409, description = "`no_cluster`: this server is alone; `server_silent`: the other does not answer.")))]
pub(in crate::http) async fn drain(
    State(nodes): State<NodeActions>,
    State(peers): State<Peers>,
    State(own): State<NodeDrain>,
    ConnectInfo(client): ConnectInfo<SocketAddr>,
    by: Person,
    PathParam(node): PathParam<NodeName>,
    request: Request,
) -> Result<Response, ApiError> {
    let alone = || ApiError::conflict("no_cluster", "this server is part of no cluster");
    if *peers.own_name().ok_or_else(alone)? == node {
        nodes.drain(&by, &node).await?;
        own.begin();
        return Ok(NoContent.into_response());
    }
    let peer = peers.named(&node, request.headers()).await?;
    let unknown = || ApiError::not_found(format!("no server {node} lives in this cluster"));
    let peer = peer.ok_or_else(unknown)?;
    let address = by.address.unwrap_or(client.ip());
    let silent = |_| ApiError::conflict("server_silent", format!("server {node} does not answer"));
    peers.forward(&peer, Patience::ROBOT, address, request).await.map_err(silent)
}
