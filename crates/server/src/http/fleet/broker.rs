//! Tells robots where the broker is, and provides an external broker with the robots' accounts.

use axum::Json;
use axum::extract::State;
use task_proto::RobotId;
use task_proto::api::{BrokerChecks, BrokerFiles, MqttEndpoint, NatsFile};

use crate::http::App;
use crate::http::error::ApiError;
use crate::http::extract::PathParam;
use crate::link::mqtt_access::MqttAccess;
use crate::store::BrokerCredential;

/// Returns the current endpoint for the robot's MQTT session.
#[utoipa::path(get, path = "/api/v1/robots/{robot}/mqtt", tag = "agent")]
pub(in crate::http) async fn endpoint(
    State(app): State<App>,
    PathParam(robot): PathParam<RobotId>,
) -> Result<Json<MqttEndpoint>, ApiError> {
    endpoint_of(&app, &robot).await.map(Json)
}

/// The same endpoint, for handlers that answer the robot with more.
pub(in crate::http) async fn endpoint_of(
    app: &App,
    robot: &RobotId,
) -> Result<MqttEndpoint, ApiError> {
    let credential = app.store.broker_credential(robot).await?;
    let credential =
        credential.ok_or_else(|| ApiError::not_found(format!("there is no robot {robot}")))?;
    Ok(app.mqtt.endpoint_of(&credential))
}

/// Returns the configuration files for a mosquitto broker.
#[utoipa::path(get, path = "/api/v1/broker", tag = "server",
    responses((status = 409, description = "`no_external_broker`: the server uses its own."),
        (status = 503, description = "The files could not be made now.")))]
pub(in crate::http) async fn files(State(app): State<App>) -> Result<Json<BrokerFiles>, ApiError> {
    made(&app, MqttAccess::files).await
}

/// Returns the configuration file for a NATS server.
#[utoipa::path(get, path = "/api/v1/broker/nats", tag = "server",
    responses((status = 409, description = "`no_external_broker`: the server uses its own."),
        (status = 503, description = "The file could not be made now.")))]
pub(in crate::http) async fn nats_file(State(app): State<App>) -> Result<Json<NatsFile>, ApiError> {
    made(&app, MqttAccess::nats_file).await
}

/// Runs `make` for all robots.
async fn made<T: Send + 'static>(
    app: &App,
    make: fn(&MqttAccess, &[BrokerCredential]) -> Option<T>,
) -> Result<Json<T>, ApiError> {
    if !app.mqtt.is_external() {
        return Err(no_external_broker());
    }
    let (robots, access) = (app.store.broker_credentials().await?, app.mqtt.clone());
    // One hash per robot takes too long for an async thread, which serves other requests.
    let made = tokio::task::spawn_blocking(move || make(&access, &robots)).await;
    made.ok()
        .flatten()
        .map(Json)
        .ok_or_else(|| ApiError::unavailable("the files could not be made"))
}

/// Tests the external brokers with two accounts reserved for this test.
#[utoipa::path(get, path = "/api/v1/broker/check", tag = "server",
    responses((status = 409, description = "`no_external_broker`: the server uses its own.")))]
pub(in crate::http) async fn check(State(app): State<App>) -> Result<Json<BrokerChecks>, ApiError> {
    let brokers = app.mqtt.check().await.ok_or_else(no_external_broker)?;
    Ok(Json(BrokerChecks { brokers }))
}

fn no_external_broker() -> ApiError {
    let message = "the server uses its own broker; `broker` in its settings names another";
    ApiError::conflict("no_external_broker", message)
}
