//! A standby's wait: another server uses the database, and this one takes over when its lock is
//! free. Until then it only answers that it is alive and not ready. This module starts no part of
//! the server that could touch a robot or a package.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use task_proto::data_directory::Addresses;
use tokio::net::TcpListener;
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

use super::database::is_transient;
use super::{REQUEST_TIMEOUT, ServeError, http_limits, listen_for_http, publish, reachable};
use crate::config::Config;
use crate::http::connection::listener;
use crate::http::server::standby;
use crate::net::tls::Tls;
use crate::store::{LockAttempt, Store, StoreError};
use crate::system::data_directory::DataDirectory;

/// Interval between two attempts to take the lock.
const ATTEMPT_INTERVAL: Duration = Duration::from_millis(500);
/// Head start of the server in use after a failover of the database, which ends the sessions of
/// both: the one in use notices it within two seconds, and its takeover would serve no purpose.
const HEAD_START: Duration = Duration::from_secs(2);

/// Waits, if this server is a standby, until it has the database's lock. Returns the listener for
/// HTTP, which answers meanwhile, and its bound address.
pub(super) async fn wait(
    config: &Config,
    data: &DataDirectory,
    store: &Store,
    tls: Option<&Tls>,
) -> Result<Option<(TcpListener, SocketAddr)>, ServeError> {
    if !config.standby {
        return Ok(None);
    }
    let (http, address) = listen_for_http(config.http)?;
    let (http, answering) = share(http).map_err(|source| ServeError::Listen { address, source })?;
    let reason = watch::Sender::new("it has not reached the database yet".to_owned());
    let stop = CancellationToken::new();
    let _stopped = stop.clone().drop_guard();
    let service = listener::Service {
        router: standby::router(reason.subscribe()),
        tls: tls.cloned(),
        connections: Arc::default(),
        traffic: Arc::default(),
    };
    let limits = http_limits(config);
    let serving =
        tokio::spawn(listener::serve(answering, service, limits, stop.clone(), REQUEST_TIMEOUT));
    let (http_at, mqtt_at) = (reachable(address).to_string(), reachable(config.mqtt).to_string());
    publish(data, &Addresses { http: http_at, mqtt: mqtt_at, ca_pin: tls.map(Tls::pin) })?;
    take_lock(store, &reason).await?;
    tracing::info!("the database's lock is taken: this server takes over");
    stop.cancel();
    // It ends by itself, and a panic there changes nothing here.
    let _ = serving.await;
    Ok(Some((http, address)))
}

/// Attempts to take the lock until it succeeds. Tells the reason of the wait to `reason`, and each
/// new one to the log.
async fn take_lock(store: &Store, reason: &watch::Sender<String>) -> Result<(), StoreError> {
    let mut was_away = false;
    loop {
        let attempt = match was_away {
            true => reconnect(store).await,
            false => store.try_succeed().await.map(Some),
        };
        let waits_for = match attempt {
            Ok(Some(LockAttempt::Taken)) => return Ok(()),
            Ok(Some(LockAttempt::Held(holder))) => format!("{holder} uses the database"),
            Ok(None) => {
                was_away = false;
                continue;
            }
            Err(error) if is_transient(&error) => {
                was_away = true;
                "the database does not answer".to_owned()
            }
            Err(error) => return Err(error),
        };
        let set = |known: &mut String| {
            let is_new = *known != waits_for;
            *known = waits_for;
            is_new
        };
        if reason.send_if_modified(set) {
            tracing::info!("standby: {}; waiting to take over", *reason.borrow());
        }
        tokio::time::sleep(ATTEMPT_INTERVAL).await;
    }
}

/// Reaches the database again, and leaves the lock to the server in use for a moment.
async fn reconnect(store: &Store) -> Result<Option<LockAttempt>, StoreError> {
    store.connect_to_lock().await?;
    tokio::time::sleep(HEAD_START).await;
    Ok(None)
}

/// A listener as two values: connections that one does not accept wait for the other.
fn share(listener: TcpListener) -> std::io::Result<(TcpListener, TcpListener)> {
    let listener = listener.into_std()?;
    let copy = listener.try_clone()?;
    Ok((TcpListener::from_std(listener)?, TcpListener::from_std(copy)?))
}
