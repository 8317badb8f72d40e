//! Tells robots where the broker is, and provides an external broker with the robots' accounts.

use std::sync::Arc;

use axum::Json;
use axum::extract::State;
use task_macros::operation;
use task_proto::RobotId;
use task_proto::api::{BrokerChecks, BrokerFiles, MqttEndpoint, NatsFile};

use crate::http::error::ApiError;
use crate::http::extract::PathParam;
use crate::link::mqtt_access::MqttAccess;
use crate::store::{BrokerCredential, Store};

/// The robots' accounts at the broker, and its endpoint for each robot.
#[derive(Clone)]
pub struct BrokerAccounts {
    pub(in crate::http) store: Store,
    pub(in crate::http) mqtt: Arc<MqttAccess>,
}

impl BrokerAccounts {
    /// The endpoint for a robot's MQTT session.
    pub(super) async fn endpoint_of(&self, robot: &RobotId) -> Result<MqttEndpoint, ApiError> {
        let credential = self.store.robots().broker_credential(robot).await?;
        let credential =
            credential.ok_or_else(|| ApiError::not_found(format!("there is no robot {robot}")))?;
        Ok(self.mqtt.endpoint_of(&credential))
    }

    /// Runs `make` for all robots.
    async fn generate<T: Send + 'static>(
        self,
        make: fn(&MqttAccess, &[BrokerCredential]) -> Option<T>,
    ) -> Result<Json<T>, ApiError> {
        if !self.mqtt.is_external() {
            return Err(no_external_broker());
        }
        let robots = self.store.robots().broker_credentials().await?;
        // One hash per robot takes too long for an async thread, which serves other requests.
        let made = tokio::task::spawn_blocking(move || make(&self.mqtt, &robots)).await;
        made.ok()
            .flatten()
            .map(Json)
            .ok_or_else(|| ApiError::unavailable("the files could not be generated"))
    }
}

/// Returns the current endpoint for the robot's MQTT session.
#[operation(tag = "agent")]
pub(in crate::http) async fn endpoint(
    State(accounts): State<BrokerAccounts>,
    PathParam(robot): PathParam<RobotId>,
) -> Result<Json<MqttEndpoint>, ApiError> {
    accounts.endpoint_of(&robot).await.map(Json)
}

/// Returns the configuration files for a mosquitto broker.
#[operation(tag = "server",
    responses((status = 409, description = "`no_external_broker`: the server uses its embedded broker."),
        (status = 503, description = "The files could not be generated.")))]
pub(in crate::http) async fn files(
    State(accounts): State<BrokerAccounts>,
) -> Result<Json<BrokerFiles>, ApiError> {
    accounts.generate(MqttAccess::files).await
}

/// Returns the configuration file for a NATS server.
#[operation(tag = "server",
    responses((status = 409, description = "`no_external_broker`: the server uses its embedded broker."),
        (status = 503, description = "The file could not be generated.")))]
pub(in crate::http) async fn nats_file(
    State(accounts): State<BrokerAccounts>,
) -> Result<Json<NatsFile>, ApiError> {
    accounts.generate(MqttAccess::nats_file).await
}

/// Tests the external brokers with two accounts reserved for this test.
#[operation(tag = "server",
    responses((status = 409, description = "`no_external_broker`: the server uses its embedded broker.")))]
pub(in crate::http) async fn check(
    State(mqtt): State<Arc<MqttAccess>>,
) -> Result<Json<BrokerChecks>, ApiError> {
    let brokers = mqtt.check().await.ok_or_else(no_external_broker)?;
    Ok(Json(BrokerChecks { brokers }))
}

fn no_external_broker() -> ApiError {
    let message = "the server uses its embedded broker; the setting `broker` names an external one";
    ApiError::conflict("no_external_broker", message)
}
