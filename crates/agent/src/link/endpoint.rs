//! The endpoint of the robot's MQTT session: the one from the enrollment, until the server names
//! another. The endpoint is not stored on the disk, because each start asks again. This module
//! never connects to a broker.

use std::time::Duration;

use crate::link::state::Shared;
use crate::system::error_chain::chain;
use crate::transfer::server::Server;

/// Asks the server for the endpoint at the start, whenever no session can be opened, and every
/// `interval` while the sessions go to an external broker, which stays up when the server switches
/// to another. Runs until the agent ends.
pub async fn follow(server: Server, shared: Shared, interval: Duration) {
    loop {
        tokio::select! {
            // Dropping the request at the agent's end has no effect.
            () = ask(&server, &shared) => {}
            () = shared.shutdown.cancelled() => return,
        }
        let is_external =
            shared.endpoint.borrow().as_ref().is_some_and(|endpoint| endpoint.external.is_some());
        let spread = 0.5 + rand::random::<f64>();
        tokio::select! {
            // Cancel-safe: the timer is recreated on each iteration.
            () = tokio::time::sleep(interval.mul_f64(spread)), if is_external => {}
            // Cancel-safe: a permit that was not taken stays.
            () = shared.find.notified() => {}
            // Cancel-safe: a token can be awaited again.
            () = shared.shutdown.cancelled() => return,
        }
    }
}

async fn ask(server: &Server, shared: &Shared) {
    match server.mqtt_endpoint().await {
        Ok(endpoint) => {
            shared.endpoint.send_if_modified(|known| {
                let is_news = known.as_ref() != Some(&endpoint);
                if is_news {
                    tracing::info!(?endpoint, "the server says where MQTT is");
                    *known = Some(endpoint);
                }
                is_news
            });
            shared.endpoint_answers.send_modify(|answers| *answers += 1);
        }
        Err(error) => {
            tracing::debug!(error = %chain(&error), "the server does not say where MQTT is")
        }
    }
}
