//! Vitals of robots' machines: reports from robots without a session, and views for people.

use std::net::SocketAddr;

use axum::Json;
use axum::extract::{ConnectInfo, State};
use axum::response::NoContent;
use task_proto::api::VitalsView;
use task_proto::vitals::Telemetry;
use task_proto::{RobotId, RobotName};

use super::robots::find;
use crate::domain::person::Person;
use crate::http::App;
use crate::http::error::ApiError;
use crate::http::extract::{PathParam, TolerantJson};
use crate::link::uplink;
use crate::orders::changes::Change;

/// Receives the vitals of the robot's machine while the robot has no MQTT session.
#[utoipa::path(post, path = "/api/v1/robots/{robot}/telemetry", tag = "agent")]
pub(in crate::http) async fn telemetry(
    State(app): State<App>,
    ConnectInfo(peer): ConnectInfo<SocketAddr>,
    PathParam(robot): PathParam<RobotId>,
    TolerantJson(said): TolerantJson<Telemetry>,
) -> Result<NoContent, ApiError> {
    if said.robot_id != robot {
        return Err(ApiError::invalid(format!(
            "robot_id: the vitals are of {}, not of {robot}",
            said.robot_id
        )));
    }
    let now_ms = app.clock.now_ms();
    uplink::heard(&app.presence, &app.changes, &robot, peer, now_ms);
    app.vitals.take(&robot, said.vitals, now_ms);
    app.changes.announce(Change::Robot(robot));
    Ok(NoContent)
}

/// Shows the vitals of a robot's machine over the last hour.
#[utoipa::path(get, path = "/api/v1/robots/{robot}/vitals", tag = "robots")]
pub(in crate::http) async fn show(
    State(app): State<App>,
    by: Person,
    PathParam(robot): PathParam<RobotName>,
) -> Result<Json<VitalsView>, ApiError> {
    let id = find(&app, &by, &robot).await?;
    Ok(Json(VitalsView { samples: app.vitals.last_hour(&id, app.clock.now_ms()) }))
}
