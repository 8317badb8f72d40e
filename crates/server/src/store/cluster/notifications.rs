//! Notifications between the servers of a Postgres database: short texts that a listener receives
//! at once or never. This module never reads them.

use sqlx::postgres::{PgListener, PgPoolOptions};
use sqlx::{Error, Executor as _};

use crate::domain::database_url::{servers, without_password};
use crate::store::database::primary::bounded;
use crate::store::database::sessions::CONNECT_TIMEOUT;
use crate::store::{Store, StoreError};

/// The channel of all servers of the database.
const CHANNEL: &str = "taskd";
/// Makes Postgres end, within seconds, the session of a listener that is lost or reads nothing,
/// because it keeps what such a listener has not read.
const LISTENER_SESSION: &str = "SET tcp_keepalives_idle = 2; SET tcp_keepalives_interval = 2;
    SET tcp_keepalives_count = 2; SET tcp_user_timeout = 5000;
    SET application_name = 'taskd listener';";

/// A connection that receives the notifications of all servers, its own among them.
pub struct NotificationListener(PgListener);

impl NotificationListener {
    /// The next notification; `None`: the connection is lost, and this listener of no use.
    pub async fn next(&mut self) -> Option<String> {
        match self.0.try_recv().await {
            Ok(Some(notification)) => Some(notification.payload().to_owned()),
            Ok(None) => None,
            Err(error) => {
                tracing::debug!(%error, "the database's listener failed");
                None
            }
        }
    }
}

impl Store {
    /// Listens, on a connection of its own, at the one of the database servers that permits it:
    /// the primary.
    pub async fn listen(&self) -> Result<NotificationListener, StoreError> {
        let mut last = None;
        for url in servers(&self.url) {
            match bounded(CONNECT_TIMEOUT, listener(url)).await {
                Ok(listener) => return Ok(NotificationListener(listener)),
                Err(error) => last = Some((url, error)),
            }
        }
        let (url, source) = last.unwrap_or(("", Error::PoolClosed));
        Err(StoreError::Open { url: without_password(url), source })
    }

    /// Sends a notification of at most 7,999 bytes to all servers.
    pub async fn notify(&self, text: &str) -> Result<(), StoreError> {
        sqlx::query("SELECT 1 FROM pg_notify($1, $2)")
            .bind(CHANNEL)
            .bind(text)
            .execute(&self.cluster_writes)
            .await?;
        Ok(())
    }
}

async fn listener(url: &str) -> Result<PgListener, Error> {
    let pool = PgPoolOptions::new().max_connections(1).max_lifetime(None).idle_timeout(None);
    let mut listener = PgListener::connect_with(&pool.connect(url).await?).await?;
    listener.ignore_pool_close_event(true);
    listener.eager_reconnect(false);
    listener.execute(sqlx::raw_sql(LISTENER_SESSION)).await?;
    listener.listen(CHANNEL).await?;
    Ok(listener)
}
