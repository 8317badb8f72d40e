//! The database's lifecycle beside the service: opening, waiting while its server is away, and
//! periodic full checks. This module contains no SQL and serves no requests.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use task_proto::trust::token::Token;
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

use crate::fleet::presence::{AgentIdentity, Presence};
use crate::store::{Fault, ReportingAgent, Store, StoreError};
use crate::system::clock::Clock;

/// The first and the longest pause before an unavailable database is tried again.
const RETRY_PAUSES: [Duration; 2] = [Duration::from_millis(250), Duration::from_secs(5)];

/// The first operator, whose token exists on every server outside of a cluster.
pub struct FirstOperator {
    pub token: Token,
    /// The file with the token.
    pub path: PathBuf,
}

/// A database, and the steps between its opening and its first use.
pub struct Database {
    store: Store,
    operator: Option<FirstOperator>,
    /// Receives each robot's last agent from the database.
    presence: Arc<Presence>,
    /// The database contains the first operator, and the presence the agents.
    is_ready: bool,
    clock: Clock,
    /// The reason why the database can't be used, once known.
    unusable: watch::Sender<Option<String>>,
}

impl Database {
    /// Opens the database of `store`. If Postgres is away or has no connection left,
    /// [`Self::supervise`] waits for it.
    pub async fn open(
        store: Store,
        operator: Option<FirstOperator>,
        presence: Arc<Presence>,
        clock: Clock,
    ) -> Result<Self, StoreError> {
        let unusable = watch::Sender::default();
        let mut database = Self { store, operator, presence, is_ready: false, clock, unusable };
        match database.prepare().await {
            Err(error) if is_transient(&error) && !database.store.state().is_open() => {
                let error = &error as &dyn std::error::Error;
                tracing::warn!(error, "the database is unavailable; waiting for it");
            }
            Err(error) if error.fault() == Some(Fault::Unreachable) => {}
            prepared => prepared?,
        }
        Ok(database)
    }

    pub fn store(&self) -> &Store {
        &self.store
    }

    /// Receives the reason if the database came back after a wait and then can't be used.
    pub fn unusable(&self) -> watch::Receiver<Option<String>> {
        self.unusable.subscribe()
    }

    /// Waits for the database whenever it is away, until `stop`.
    pub async fn supervise(mut self, stop: CancellationToken) {
        tokio::select! {
            () = stop.cancelled() => {}
            () = self.reconnect_whenever_away() => {}
        }
    }

    async fn reconnect_whenever_away(&mut self) {
        let [first, longest] = RETRY_PAUSES;
        loop {
            let mut pause = first;
            while !self.store.state().is_available() || !self.is_ready {
                tokio::time::sleep(pause).await;
                pause = longest.min(pause * 2);
                let Err(error) = self.reconnect().await else { continue };
                if !is_transient(&error) {
                    let error = anyhow::Error::new(error);
                    self.unusable.send_replace(Some(format!("{error:#}")));
                    return;
                }
            }
            self.store.state().unavailable().await;
        }
    }

    /// Checks that the database answers, and performs the first-use steps if not yet done.
    async fn reconnect(&mut self) -> Result<(), StoreError> {
        if !self.is_ready {
            return self.prepare().await;
        }
        // With any other answer the database is available.
        match self.store.ping().await {
            Err(error) if error.fault() == Some(Fault::Unreachable) => Err(error),
            _ => Ok(()),
        }
    }

    /// Performs, once, the steps that precede the first use.
    async fn prepare(&mut self) -> Result<(), StoreError> {
        if !self.store.state().is_open() {
            self.store.prepare().await?;
        }
        self.register_operator().await?;
        let now_ms = self.clock.now_ms();
        for (robot, ReportingAgent { instance, place }) in
            self.store.reports().last_agents().await?
        {
            self.presence.remember(&robot, AgentIdentity { instance, place }, now_ms);
        }
        self.presence.restart(now_ms);
        self.is_ready = true;
        Ok(())
    }

    /// Ensures that the token in the directory is valid in this database, which may be new or
    /// restored.
    async fn register_operator(&self) -> Result<(), StoreError> {
        let Some(FirstOperator { token, path }) = &self.operator else { return Ok(()) };
        let now_ms = self.clock.now_ms();
        if self.store.tokens().holder(token, now_ms).await?.is_some() {
            return Ok(());
        }
        match self.store.tokens().create_first(token, now_ms).await {
            // Another server of the cluster was faster.
            Err(error)
                if error.is_unique_violation()
                    && self.store.tokens().holder(token, now_ms).await?.is_some() =>
            {
                Ok(())
            }
            Err(error) if error.is_unique_violation() => {
                tracing::warn!("the token in {} was revoked and stays revoked", path.display());
                Ok(())
            }
            created => created,
        }
    }
}

/// Whether the error is transient.
pub(super) fn is_transient(error: &StoreError) -> bool {
    matches!(error.fault(), Some(Fault::Unreachable | Fault::Busy))
}

/// Checks the database in full at once and then at this interval, until `stop`.
pub async fn check_periodically(
    store: Store,
    clock: Clock,
    interval: Duration,
    stop: CancellationToken,
) {
    let mut ticks = tokio::time::interval(interval);
    ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    loop {
        tokio::select! {
            () = stop.cancelled() => return,
            _ = ticks.tick() => {}
        }
        // Ends soon after `stop`.
        if let Err(error) = store.check(clock.now_ms(), stop.clone()).await {
            error.log("the database could not be checked");
        }
    }
}
