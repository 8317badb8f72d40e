//! Admits one server at a time to a Postgres database, or the servers of one cluster. An advisory
//! lock, on a connection of its own, tells servers that run apart; the servers of a cluster share
//! it. The holder's name in the row that every write updates stops a server that does not know yet
//! that it has lost the lock. SQLite needs neither, because its data directory is locked.

use std::fmt;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use sqlx::any::Any;
use sqlx::{AnyConnection, Connection as _, Error, Executor};
use task_proto::time::timestamp;
use tokio::sync::Mutex;
use tokio_util::task::AbortOnDropHandle;

use super::primary::{NewConnection, bounded};
use super::sessions::first_connection;
use super::state::DatabaseState;
use super::write_locks::POSTGRES_LOCKS;
use crate::domain::database_url::without_password;
use crate::store::{StoreError, rows};

/// Counts a write that runs alone, if this server or none is the holder. Without a row, another
/// server has taken over.
pub(in crate::store) const NEXT_TURN: &str =
    "UPDATE write_lock SET turn = turn + 1 WHERE id = 1 AND (holder IS NULL OR holder = $1)
     RETURNING turn";
/// The number of the last write that ran alone, under the same condition.
pub(in crate::store) const LAST_TURN: &str =
    "SELECT turn FROM write_lock WHERE id = 1 AND (holder IS NULL OR holder = $1)";
/// The key of the advisory lock: the text "taskd" and a number.
const LOCK_KEY: i64 = 0x7461_736b_6400_0001;
/// Makes Postgres end the session, and so free the lock, of a server that was stopped or lost.
const IDLE_TIMEOUT: &str = "SET idle_session_timeout = '6s'";
/// Interval between two statements of the holder.
const TOUCH_INTERVAL: Duration = Duration::from_secs(2);
/// Time limit for the answer to such a statement.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(5);
/// Time limit for becoming the holder. A write of the holder before may have to end first.
const CLAIM_TIMEOUT: Duration = Duration::from_secs(40);
/// Pause before the next attempt to take the lock.
const RETRY_INTERVAL: Duration = Duration::from_millis(500);
/// Attempts before a server is refused: more time than Postgres keeps the session of a lost holder,
/// which may be this machine before it was restarted.
const MAX_ATTEMPTS: u32 = 16;

/// How a server takes the database's lock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Sharing {
    Alone,
    /// Together with the other servers of its cluster.
    Cluster,
}

/// One start of a server, and what it has in common with the other servers of its fleet.
#[derive(Debug, Clone)]
pub struct ServerIdentity {
    /// A name that no other start has.
    pub run: String,
    /// The id of the signing key.
    pub key_id: String,
    /// The prefix of all MQTT topics.
    pub topic_prefix: String,
    pub sharing: Sharing,
}

/// The server that may write to a database, as far as known.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Holder {
    run: Option<String>,
    since_ms: Option<u64>,
    /// Whether the servers of a cluster share the lock.
    is_cluster: bool,
}

impl fmt::Display for Holder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.is_cluster {
            return f.write_str("a cluster of servers");
        }
        let Some(run) = &self.run else { return f.write_str("another server") };
        write!(f, "server {run}")?;
        match self.since_ms {
            Some(since_ms) => write!(f, " (since {})", timestamp(since_ms)),
            None => Ok(()),
        }
    }
}

/// The outcome of an attempt to take the lock.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum LockAttempt {
    /// This server has the lock.
    Taken,
    /// Another server has the lock.
    Held(Holder),
}

/// The lock of one server on its database. Clones share it; the last one that is dropped frees it.
#[derive(Clone)]
pub(in crate::store) struct Guard {
    lock: Arc<Lock>,
    keeper: Arc<OnceLock<AbortOnDropHandle<()>>>,
}

struct Lock {
    url: String,
    identity: ServerIdentity,
    state: DatabaseState,
    /// `None` while there is no connection. A statement that fails or is cancelled ends it.
    session: Mutex<Option<Session>>,
}

struct Session {
    connection: AnyConnection,
    has_lock: bool,
}

impl Guard {
    pub(in crate::store) fn new(url: &str, identity: ServerIdentity, state: DatabaseState) -> Self {
        let lock = Lock { url: url.to_owned(), identity, state, session: Mutex::default() };
        Self { lock: Arc::new(lock), keeper: Arc::default() }
    }

    /// The name of this start of the server.
    pub(in crate::store) fn run(&self) -> &str {
        &self.lock.identity.run
    }

    /// Whether the servers of a cluster share the lock.
    pub(in crate::store) fn is_shared(&self) -> bool {
        self.lock.identity.sharing == Sharing::Cluster
    }

    /// Opens the lock's connection, if it is not open. Refuses a server with another signing key
    /// than the fleet's.
    pub(in crate::store) async fn connect(&self) -> Result<(), StoreError> {
        let mut session = self.lock.session.lock().await;
        if session.is_none() {
            *session = Some(self.lock.connect().await?);
        }
        Ok(())
    }

    /// Takes the lock if it is free.
    pub(in crate::store) async fn try_take(&self) -> Result<LockAttempt, StoreError> {
        self.lock.try_take().await
    }

    /// Takes the lock if it is free, and otherwise compares the topic prefix with the holder's, whose
    /// robots this server is to take over.
    pub(in crate::store) async fn try_succeed(&self) -> Result<LockAttempt, StoreError> {
        let attempt = self.lock.try_take().await?;
        match &attempt {
            LockAttempt::Taken => {}
            LockAttempt::Held(holder) if holder.is_cluster => return Err(self.in_use(holder)),
            LockAttempt::Held(_) => self.lock.check_prefix().await?,
        }
        Ok(attempt)
    }

    /// Takes the lock, or gives up after some seconds. A lock that is already held stays held.
    pub(in crate::store) async fn take(&self) -> Result<(), StoreError> {
        let mut holder = Holder::default();
        for attempt in 0..MAX_ATTEMPTS {
            match self.try_take().await? {
                LockAttempt::Taken => return Ok(()),
                LockAttempt::Held(found) => holder = found,
            }
            if attempt == 0 {
                tracing::info!(
                    "the database is in use by {holder}; waiting some seconds for its end"
                );
            }
            tokio::time::sleep(RETRY_INTERVAL).await;
        }
        Err(self.in_use(&holder))
    }

    /// The error that other servers have the lock.
    fn in_use(&self, holder: &Holder) -> StoreError {
        let (url, holder) = (without_password(&self.lock.url), holder.clone());
        match (self.lock.identity.sharing, holder.is_cluster) {
            (Sharing::Alone, false) => StoreError::InUse { url, holder },
            (Sharing::Alone, true) => StoreError::InUseByCluster { url },
            (Sharing::Cluster, _) => StoreError::InUseAlone { url, holder },
        }
    }

    /// Makes this server the holder, so that only its writes are accepted, and keeps the lock from
    /// now on. The lock must be held and the tables up to date.
    pub(in crate::store) async fn claim(&self) -> Result<(), StoreError> {
        self.lock.claim().await?;
        let keep = || AbortOnDropHandle::new(tokio::spawn(self.lock.clone().keep()));
        self.keeper.get_or_init(keep);
        Ok(())
    }

    /// Frees the lock for another server.
    pub(in crate::store) async fn release(&self) {
        if let Some(keeper) = self.keeper.get() {
            keeper.abort();
        }
        let session = self.lock.session.lock().await.take();
        if let Some(Session { connection, .. }) = session
            && let Err(error) = bounded(ANSWER_TIMEOUT, connection.close()).await
        {
            tracing::debug!(%error, "closing the connection of the database's lock failed");
        }
    }
}

impl Lock {
    async fn connect(&self) -> Result<Session, StoreError> {
        let connected = first_connection(&self.url).await;
        let NewConnection { mut connection, .. } = connected
            .inspect_err(|error| self.state.record_error(error))
            .map_err(|source| StoreError::Open { url: without_password(&self.url), source })?;
        let fleet = bounded(ANSWER_TIMEOUT, fleet(&mut connection)).await?;
        self.check_key(fleet)?;
        Ok(Session { connection, has_lock: false })
    }

    async fn try_take(&self) -> Result<LockAttempt, StoreError> {
        let mut slot = self.session.lock().await;
        let mut session = match slot.take() {
            Some(session) => session,
            None => self.connect().await?,
        };
        if !session.has_lock {
            let attempt = try_lock(&mut session.connection, self.identity.sharing);
            session.has_lock = bounded(ANSWER_TIMEOUT, attempt).await?;
        }
        let attempt = match session.has_lock {
            true => LockAttempt::Taken,
            false => {
                let holder = lock_users(&mut session.connection);
                LockAttempt::Held(bounded(ANSWER_TIMEOUT, holder).await?.unwrap_or_default())
            }
        };
        *slot = Some(session);
        Ok(attempt)
    }

    /// Refuses a server with another signing key than the fleet's: robots would refuse its orders.
    fn check_key(&self, fleet: Option<Fleet>) -> Result<(), StoreError> {
        let own = &self.identity.key_id;
        match fleet {
            Some(fleet) if fleet.key_id != *own => {
                Err(StoreError::ForeignKey { own: own.clone(), fleet: fleet.key_id })
            }
            _ => Ok(()),
        }
    }

    async fn check_prefix(&self) -> Result<(), StoreError> {
        let mut slot = self.session.lock().await;
        let mut session = slot.take().ok_or_else(lost)?;
        let fleet = bounded(ANSWER_TIMEOUT, fleet(&mut session.connection)).await?;
        *slot = Some(session);
        self.compare_prefix(fleet.as_ref())
    }

    fn compare_prefix(&self, fleet: Option<&Fleet>) -> Result<(), StoreError> {
        let own = self.identity.topic_prefix.clone();
        match fleet.map(|fleet| fleet.topic_prefix.clone()) {
            Some(fleet) if fleet != own => Err(StoreError::ForeignPrefix { own, fleet }),
            _ => Ok(()),
        }
    }

    async fn claim(&self) -> Result<(), StoreError> {
        let mut slot = self.session.lock().await;
        let Some(mut session) = slot.take().filter(|session| session.has_lock) else {
            return Err(lost().into());
        };
        let connection = &mut session.connection;
        let fleet = bounded(ANSWER_TIMEOUT, join_fleet(connection, &self.identity)).await?;
        match self.identity.sharing {
            Sharing::Alone => {
                self.check_key(fleet)?;
                bounded(CLAIM_TIMEOUT, set_holder(connection, Some(&self.identity.run))).await?;
            }
            Sharing::Cluster => {
                self.compare_prefix(fleet.as_ref())?;
                self.check_key(fleet)?;
                if bounded(ANSWER_TIMEOUT, holder(&mut *connection)).await?.run.is_some() {
                    bounded(CLAIM_TIMEOUT, set_holder(connection, None)).await?;
                }
            }
        }
        // Not before, because bringing the tables up to date may take longer.
        bounded(ANSWER_TIMEOUT, execute(connection, IDLE_TIMEOUT)).await?;
        *slot = Some(session);
        Ok(())
    }

    /// Keeps the lock until another server has taken over. Without its connection, as after a
    /// restart of the database, the server goes on: the holder's name protects its writes.
    async fn keep(self: Arc<Self>) {
        loop {
            tokio::time::sleep(TOUCH_INTERVAL).await;
            let Err(error) = self.touch().await else { continue };
            tracing::warn!(%error, "the database's lock is lost with its connection; taking it again");
            if let Some(holder) = self.regain().await {
                return self.state.record_takeover(&holder);
            }
            tracing::info!("this server holds the database's lock again");
        }
    }

    async fn touch(&self) -> Result<(), Error> {
        let mut slot = self.session.lock().await;
        let mut session = slot.take().ok_or_else(lost)?;
        bounded(ANSWER_TIMEOUT, execute(&mut session.connection, "SELECT 1")).await?;
        *slot = Some(session);
        Ok(())
    }

    /// Takes the lost lock again, or finds the server that has taken over meanwhile. The lock may
    /// stay taken for some seconds by this server's own lost session.
    async fn regain(&self) -> Option<Holder> {
        loop {
            // Without an answer, the database is away.
            if let Ok(attempt) = self.try_take().await
                && let Ok(holder) = self.watched_holder().await
            {
                if holder.run.as_ref().is_some_and(|run| *run != self.identity.run) {
                    return Some(holder);
                }
                if let LockAttempt::Held(found) = &attempt
                    && found.is_cluster
                {
                    return Some(found.clone());
                }
                if attempt == LockAttempt::Taken {
                    return None;
                }
            }
            tokio::time::sleep(RETRY_INTERVAL).await;
        }
    }

    /// The present holder, read on a session that ends when this server falls silent.
    async fn watched_holder(&self) -> Result<Holder, Error> {
        let mut slot = self.session.lock().await;
        let mut session = slot.take().ok_or_else(lost)?;
        bounded(ANSWER_TIMEOUT, execute(&mut session.connection, IDLE_TIMEOUT)).await?;
        let holder = bounded(ANSWER_TIMEOUT, holder(&mut session.connection)).await?;
        *slot = Some(session);
        Ok(holder)
    }
}

/// The values that all servers of a fleet share.
struct Fleet {
    key_id: String,
    topic_prefix: String,
}

/// The server that holds the lock of the Postgres database at `url`; `None`: no server does.
pub async fn lock_holder(url: &str) -> Result<Option<Holder>, StoreError> {
    sqlx::any::install_default_drivers();
    let NewConnection { mut connection, .. } = first_connection(url)
        .await
        .map_err(|source| StoreError::Open { url: without_password(url), source })?;
    let found = bounded(ANSWER_TIMEOUT, lock_users(&mut connection)).await?;
    bounded(ANSWER_TIMEOUT, connection.close()).await?;
    Ok(found)
}

/// The server or the servers that hold the lock; `None`: it is free.
async fn lock_users(connection: &mut AnyConnection) -> Result<Option<Holder>, Error> {
    const MODE: &str = "SELECT mode FROM pg_locks
        WHERE locktype = 'advisory' AND granted AND objsubid = 1
        AND database = (SELECT oid FROM pg_database WHERE datname = current_database())
        AND CAST(classid AS BIGINT) = $1 AND CAST(objid AS BIGINT) = $2 LIMIT 1";
    let query = sqlx::query_scalar(MODE).bind(LOCK_KEY >> 32).bind(LOCK_KEY & 0xffff_ffff);
    let mode: Option<String> = query.fetch_optional(&mut *connection).await?;
    match mode.as_deref() {
        None => Ok(None),
        Some("ShareLock") => Ok(Some(Holder { is_cluster: true, ..Holder::default() })),
        Some(_) => holder(connection).await.map(Some),
    }
}

/// Takes the lock for the session of `connection`, which holds it until it is closed. If the lock
/// does not become free within some seconds, returns the holder.
pub(in crate::store) async fn take_lock(
    connection: &mut AnyConnection,
) -> Result<Option<Holder>, Error> {
    for _ in 0..MAX_ATTEMPTS {
        if bounded(ANSWER_TIMEOUT, try_lock(connection, Sharing::Alone)).await? {
            return Ok(None);
        }
        tokio::time::sleep(RETRY_INTERVAL).await;
    }
    let holder = bounded(ANSWER_TIMEOUT, lock_users(connection)).await?;
    Ok(Some(holder.unwrap_or_default()))
}

/// The server that may write.
pub(in crate::store) async fn holder<'c>(
    connection: impl Executor<'c, Database = Any>,
) -> Result<Holder, Error> {
    let query = "SELECT holder, held_since_ms FROM write_lock WHERE id = 1";
    let found = sqlx::query_as(query).fetch_optional(connection).await;
    let (run, since_ms) = match found {
        Err(error) if is_missing(&error) => (None, None),
        found => found?.unwrap_or_default(),
    };
    Ok(Holder { run, since_ms: since_ms.map(rows::number), is_cluster: false })
}

async fn try_lock(connection: &mut AnyConnection, sharing: Sharing) -> Result<bool, Error> {
    let sql = match sharing {
        Sharing::Alone => "SELECT CAST(pg_try_advisory_lock($1) AS INT)",
        Sharing::Cluster => "SELECT CAST(pg_try_advisory_lock_shared($1) AS INT)",
    };
    let locked: i32 = sqlx::query_scalar(sql).bind(LOCK_KEY).fetch_one(connection).await?;
    Ok(locked == 1)
}

async fn fleet(connection: &mut AnyConnection) -> Result<Option<Fleet>, Error> {
    let query = sqlx::query_as("SELECT key_id, topic_prefix FROM fleet WHERE id = 1");
    match query.fetch_optional(connection).await {
        Err(error) if is_missing(&error) => Ok(None),
        found => Ok(found?.map(|(key_id, topic_prefix)| Fleet { key_id, topic_prefix })),
    }
}

/// Stores the values that all servers of a fleet share, unless the fleet has another key. A server
/// alone may change the prefix.
async fn join_fleet(
    connection: &mut AnyConnection,
    identity: &ServerIdentity,
) -> Result<Option<Fleet>, Error> {
    let sql = match identity.sharing {
        Sharing::Alone => {
            "INSERT INTO fleet (id, key_id, topic_prefix) VALUES (1, $1, $2)
             ON CONFLICT (id) DO UPDATE SET topic_prefix = excluded.topic_prefix
             WHERE fleet.key_id = excluded.key_id"
        }
        Sharing::Cluster => {
            "INSERT INTO fleet (id, key_id, topic_prefix) VALUES (1, $1, $2)
             ON CONFLICT (id) DO NOTHING"
        }
    };
    sqlx::query(sql)
        .bind(&identity.key_id)
        .bind(&identity.topic_prefix)
        .execute(&mut *connection)
        .await?;
    fleet(connection).await
}

/// Names the holder, by the database's clock, after the writes of the holder before: these have
/// passed the condition of their first statement already. `None`: every server may write.
async fn set_holder(connection: &mut AnyConnection, run: Option<&str>) -> Result<(), Error> {
    execute(connection, POSTGRES_LOCKS.exclusive).await?;
    sqlx::query(
        "UPDATE write_lock SET holder = $1,
         held_since_ms = CAST(EXTRACT(EPOCH FROM now()) * 1000 AS BIGINT) WHERE id = 1",
    )
    .bind(run)
    .execute(&mut *connection)
    .await?;
    execute(connection, "COMMIT").await
}

async fn execute(connection: &mut AnyConnection, sql: &'static str) -> Result<(), Error> {
    sqlx::raw_sql(sql).execute(connection).await.map(drop)
}

/// Whether the tables are older than this module: a table or a column is missing.
fn is_missing(error: &Error) -> bool {
    let Error::Database(error) = error else { return false };
    matches!(error.code().as_deref(), Some("42P01" | "42703"))
}

fn lost() -> Error {
    let text = "the connection of the database's lock is lost";
    Error::Io(std::io::Error::new(std::io::ErrorKind::NotConnected, text))
}
