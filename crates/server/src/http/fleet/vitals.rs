//! Vitals of robots' machines: reports from robots without a session, and views for people.

use std::net::SocketAddr;

use axum::Json;
use axum::extract::{ConnectInfo, State};
use axum::response::NoContent;
use task_macros::operation;
use task_proto::api::VitalsView;
use task_proto::telemetry::vitals::Telemetry;
use task_proto::{RobotId, RobotName};

use super::live_robots::LiveRobots;
use super::robots::find;
use crate::domain::person::Person;
use crate::fleet::robot_vitals::RobotVitals;
use crate::http::error::ApiError;
use crate::http::extract::{PathParam, TolerantJson};
use crate::store::Store;
use crate::system::clock::Clock;

/// Receives the vitals of the robot's machine while the robot has no MQTT session.
#[operation(tag = "agent")]
pub(in crate::http) async fn telemetry(
    State(live): State<LiveRobots>,
    ConnectInfo(peer): ConnectInfo<SocketAddr>,
    PathParam(robot): PathParam<RobotId>,
    TolerantJson(received): TolerantJson<Telemetry>,
) -> Result<NoContent, ApiError> {
    if received.robot_id != robot {
        return Err(ApiError::invalid(format!(
            "robot_id: the vitals are of {}, not of {robot}",
            received.robot_id
        )));
    }
    live.record_request(&robot, peer);
    live.record_vitals(robot, received.vitals);
    Ok(NoContent)
}

/// Shows the vitals of a robot's machine over the last hour.
#[operation(tag = "robots")]
pub(in crate::http) async fn show(
    State(store): State<Store>,
    State(clock): State<Clock>,
    State(vitals): State<RobotVitals>,
    by: Person,
    PathParam(robot): PathParam<RobotName>,
) -> Result<Json<VitalsView>, ApiError> {
    let id = find(&store, &by, &robot).await?;
    Ok(Json(VitalsView { samples: vitals.last_hour(&id, clock.now_ms()) }))
}
