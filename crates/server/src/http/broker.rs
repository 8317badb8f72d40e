//! What robots are told about the broker, and a broker that is not the server's own about robots.

use axum::Json;
use axum::extract::State;
use task_proto::RobotId;
use task_proto::api::{BrokerFiles, MqttEndpoint};

use super::App;
use super::error::ApiError;
use super::extract::PathParam;

/// Says where the robot's MQTT session goes now.
#[utoipa::path(get, path = "/api/v1/robots/{robot}/mqtt", tag = "agent")]
pub(super) async fn endpoint(
    State(app): State<App>,
    PathParam(robot): PathParam<RobotId>,
) -> Result<Json<MqttEndpoint>, ApiError> {
    endpoint_of(&app, &robot).await.map(Json)
}

/// The same, for whoever answers the robot something else as well.
pub(super) async fn endpoint_of(app: &App, robot: &RobotId) -> Result<MqttEndpoint, ApiError> {
    let credential = app.store.broker_credential(robot).await?;
    let credential = credential.ok_or_else(|| ApiError::not_found(format!("there is no robot {robot}")))?;
    Ok(app.mqtt.endpoint_of(&credential))
}

/// Gives the files that an external broker needs.
#[utoipa::path(get, path = "/api/v1/broker", tag = "server",
    responses((status = 409, description = "`no_external_broker`: the server uses its own."),
        (status = 503, description = "The files could not be made now.")))]
pub(super) async fn files(State(app): State<App>) -> Result<Json<BrokerFiles>, ApiError> {
    if !app.mqtt.is_external() {
        let message = "the server uses its own broker; `broker` in its settings names another";
        return Err(ApiError::conflict("no_external_broker", message));
    }
    let (robots, access) = (app.store.broker_credentials().await?, app.mqtt.clone());
    // A hash for each robot: too long for a thread that serves others.
    let files = tokio::task::spawn_blocking(move || access.files(&robots)).await;
    files.ok().flatten().map(Json).ok_or_else(|| ApiError::unavailable("the files could not be made"))
}
