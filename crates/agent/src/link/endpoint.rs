//! The endpoint of the robot's MQTT session: the one from the enrollment, until the server names
//! another. The endpoint is not stored on the disk, because each start asks again. This module
//! never connects to a broker.

use std::time::Duration;

use task_proto::error_chain::chain;

use crate::link::state::LinkState;
use crate::transfer::server::Server;

/// Asks the server for the endpoint at the start, whenever no session can be opened, and every
/// `interval` while the sessions go to an external broker, which stays up when the server switches
/// to another. Runs until the agent ends.
pub async fn follow(server: Server, link_state: LinkState, interval: Duration) {
    loop {
        tokio::select! {
            // Dropping the request at the agent's end has no effect.
            () = request_endpoint(&server, &link_state) => {}
            () = link_state.shutdown.cancelled() => return,
        }
        let is_external = link_state
            .endpoint
            .borrow()
            .as_ref()
            .is_some_and(|endpoint| endpoint.external.is_some());
        let spread = 0.5 + rand::random::<f64>();
        tokio::select! {
            // Cancel-safe: the timer is recreated on each iteration.
            () = tokio::time::sleep(interval.mul_f64(spread)), if is_external => {}
            // Cancel-safe: a permit that was not taken stays.
            () = link_state.refresh_endpoint.notified() => {}
            // Cancel-safe: a token can be awaited again.
            () = link_state.shutdown.cancelled() => return,
        }
    }
}

async fn request_endpoint(server: &Server, link_state: &LinkState) {
    match server.mqtt_endpoint().await {
        Ok(endpoint) => {
            link_state.endpoint.send_if_modified(|known| {
                let is_news = known.as_ref() != Some(&endpoint);
                if is_news {
                    tracing::info!(?endpoint, "received the MQTT endpoint");
                    *known = Some(endpoint);
                }
                is_news
            });
            link_state.endpoint_answers.send_modify(|answers| *answers += 1);
        }
        Err(error) => {
            tracing::debug!(error = %chain(&error), "cannot get the MQTT endpoint")
        }
    }
}
