//! Owns the database, the truth about robots, packages, orders and tokens; it never decides what
//! should happen and never reads the clock.
//!
//! Decisions are [`crate::domain::deployment`]'s and [`crate::domain::rollout`]'s. One SQL text
//! serves SQLite and Postgres. Each noun has a repository (`repositories`), which the [`Store`]
//! lends for reads and whole writes, and a [`Transaction`] for the statements of one write.

#![expect(clippy::disallowed_methods, reason = "SQL is at home here")]

mod cluster;
mod database;
mod deliveries;
mod feed;
mod fleet;
mod orders;
mod people;
mod registry;
mod repositories;
mod rows;
mod timelines;

use std::collections::BTreeSet;
use std::fmt;
use std::path::Path;
use std::sync::Arc;

use sqlx::Connection as _;
use task_proto::RobotId;
use tokio::sync::watch;

pub use cluster::nodes::{NewNode, Node, NodeLoad};
pub use cluster::notifications::NotificationListener;
pub use cluster::robot_sessions::{
    LeftSession, NewRobotSession, RobotSession, SessionNode, SessionPosition,
};
pub use database::connections::with_shared_reads;
use database::connections::{ConnectionPool, PooledConnection, Statement};
pub use database::copy::{CopyError, copy_database};
use database::dialect::{Dialect, POSTGRES, SQLITE};
pub use database::fault::Fault;
use database::guard::{Guard, LAST_TURN, NEXT_TURN, holder};
pub use database::guard::{Holder, LockAttempt, ServerIdentity, Sharing, lock_holder};
pub use database::integrity::check_at_rest;
use database::integrity::{Checked, check_quickly, postgres_page_protection};
use database::primary::NewConnection;
pub use database::probe::check_postgres;
use database::probe::probe;
use database::sessions::{cluster_pool_options, first_connection, make_file, pool_options};
pub use database::state::DatabaseState;
use database::write_locks::{POSTGRES_LOCKS, SQLITE_LOCKS, WriteLocks};
pub use deliveries::{DeliveryRequest, RobotDecision, RobotFacts};
pub use feed::{FeedAudience, NewFeedEntry};
pub use fleet::matching::{MatchingRobots, SelectedRobot};
pub use fleet::needed_packages::FetchGrant;
pub use fleet::reports::{OpenAssignment, ReportTransaction, ReportedRobot, ReportingAgent};
pub use fleet::robot_pages::RobotPage;
pub use fleet::robots::{BrokerCredential, DesiredTasks, KnownRobot, RobotRow};
pub use orders::assignments::{ReleasedBatch, TaskOrder};
pub use orders::chunks::OrderChunk;
pub use orders::deployments::{
    AssignmentRow, DeploymentPage, DeploymentRow, NewDeployment, OpenRobot, OpenRollout,
};
pub use orders::idempotency::IdempotencyRecord;
pub use orders::past_assignments::{PreviousPackage, UnsuccessfulRobot};
pub use orders::revert::Revocable;
pub use orders::still_running::StillRunning;
use people::audit::new_audit_limit;
pub use people::audit::{AuditAction, AuditEvent};
use people::auth_cache::{AuthCache, InvalidationGuard};
use people::first_use::FirstUses;
pub use people::page_sessions::{NewPageSession, PageSession};
pub use people::tokens::{Admitted, EnrollmentTerms, TokenHolder};
pub use people::users::{NewToken, User};
pub use registry::outputs::NewOutput;
pub use registry::package_use::{Deletion, PackageUsers};
pub use registry::packages::{NewManifest, PutManifest, Reference, StoredManifest};
pub use registry::publishers::SignedDocument;
pub use registry::referrers::ReferrersPage;
pub use registry::robot_blobs::disk_usage;
pub use registry::stored_blobs::StoredBlob;
pub use timelines::{HistoryPage, HistoryQuery};

use crate::domain::database_url::{is_postgres, without_password};
use crate::domain::limits::keyed_rate_limit::KeyedRateLimit;
use crate::domain::person::Person;

/// The page cache of the SQLite writer: 16 MiB.
const WRITER_CACHE: &str = "PRAGMA cache_size = -16384";
/// The page caches of all SQLite readers together: 16 MiB. The system's page cache holds the rest.
const READER_CACHES_KIB: u32 = 16 * 1024;
/// Number of connections for concurrent reads.
const READERS: u32 = 6;
/// Number of these connections that people's reads may use at once. The rest stay free for robots
/// and orders.
const SHARED_READERS: u32 = 4;
/// Part of a SQLite URL: the file belongs to this process alone. The process then keeps in memory
/// the index that it would otherwise share through a file.
const WITHOUT_SHARED_MEMORY: &str = "vfs=unix-excl";

/// The database. Clones share its connections.
#[derive(Clone)]
pub struct Store {
    reads: ConnectionPool,
    writes: ConnectionPool,
    /// Writes of the cluster's own tables, which wait for no order. No connection is open unless
    /// the server is in a cluster.
    cluster_writes: ConnectionPool,
    auth_cache: AuthCache,
    first_uses: FirstUses,
    audit_limit: Arc<KeyedRateLimit>,
    state: DatabaseState,
    url: Arc<str>,
    is_postgres: bool,
    /// The lock that a server holds while it uses a Postgres.
    guard: Option<Guard>,
    locks: &'static WriteLocks,
    dialect: &'static Dialect,
}

impl fmt::Debug for Store {
    /// The URL may hold a password.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Store").field("state", &self.state).finish_non_exhaustive()
    }
}

/// The kind of the database, and its size.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DatabaseSize {
    pub kind: &'static str,
    /// The size, if the database reports one.
    pub bytes: Option<u64>,
}

/// An error of the database.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// The database can't be opened.
    #[error("database {url} can't be opened")]
    Open {
        /// The database, without its password.
        url: String,
        source: sqlx::Error,
    },
    /// The tables can't be brought up to date.
    #[error("database {url} can't be migrated")]
    Migrate {
        /// The database, without its password.
        url: String,
        source: sqlx::migrate::MigrateError,
    },
    /// A later version of this program has migrated the tables further.
    #[error(
        "database {url} was last used by a newer taskd (its tables are at {version}): install that version again"
    )]
    Newer {
        /// The database, without its password.
        url: String,
        /// The migration that this program does not have.
        version: i64,
    },
    /// The sessions of the Postgres server lack a property that the store relies on.
    #[error(
        "database {url} can't be used: {reason}; the setting `database` has to name a Postgres server itself: a pooler in \
         transaction mode (PgBouncer with pool_mode = transaction) or a look-alike of Postgres can't be used"
    )]
    Unsuitable {
        /// The database, without its password.
        url: String,
        /// The property that the server lacks.
        reason: String,
    },
    /// The integrity check found damaged pages.
    #[error(
        "database {url} is corrupt ({finding}): stop every program that uses it and restore a copy of the data directory, \
         or recover the readable part with sqlite3's .recover; see docs/server.md"
    )]
    Damaged {
        /// The database, without its password.
        url: String,
        finding: String,
    },
    /// Opening the database takes a write, and the disk is full.
    #[error(
        "database {url} can't be opened on a full disk: make at least 16 MB free on its file system"
    )]
    DiskFull {
        /// The database, without its password.
        url: String,
    },
    /// Another server holds the database's lock.
    #[error(
        "database {url} is in use by {holder}: stop that server, name another database in `database`, \
         or set `standby = true`, so that this server waits and takes over"
    )]
    InUse {
        /// The database, without its password.
        url: String,
        holder: Holder,
    },
    /// The servers of a cluster hold the database's lock, and this server is in none.
    #[error(
        "database {url} is in use by a cluster of servers: make this server a part of it with [cluster], \
         or stop the others; see docs/cluster.md"
    )]
    InUseByCluster {
        /// The database, without its password.
        url: String,
    },
    /// A server without a cluster holds the database's lock, and this server is in one.
    #[error(
        "database {url} is in use by {holder}, which is in no cluster: give that server [cluster] too, or stop it; \
         see docs/cluster.md"
    )]
    InUseAlone {
        /// The database, without its password.
        url: String,
        holder: Holder,
    },
    /// Another server has become the holder, so this one may not write any more.
    #[error("{successor} has taken over the database; this server has stopped writing to it")]
    TakenOver { successor: Holder },
    /// Robots would refuse the orders of this server.
    #[error(
        "this server's signing key {own} is not the fleet's, {fleet}: copy signing.key from the data directory of \
         the server that used this database before; see docs/cluster.md"
    )]
    ForeignKey {
        /// The id of this server's key.
        own: String,
        /// The id of the key that robots know.
        fleet: String,
    },
    /// Robots would miss the messages of this server.
    #[error(
        "topic_prefix is {own} here and {fleet} on the servers that use the database: this server needs the same"
    )]
    ForeignPrefix { own: String, fleet: String },
    /// The database was found corrupt while it was in use.
    #[error("the database is corrupt; changes are refused until it is repaired")]
    Corrupt,
    #[error("the database refused a statement")]
    Statement(#[from] sqlx::Error),
    /// A write that serves several robots failed.
    #[error("a write for several robots failed")]
    Batch(#[source] Arc<StoreError>),
    /// The caller's rights ended after the request began.
    #[error("your permissions have changed since this request began; sign in again or retry")]
    RightsEnded,
    /// The person has reached the limit of audited acts on their own account.
    #[error(
        "{user} has signed in, created tokens or set a password too often; try again in {seconds} s"
    )]
    TooManyActs {
        user: String,
        /// Seconds until the next act is allowed.
        seconds: u64,
    },
    /// A row holds a value that this version can't read.
    #[error("column {column} of the database holds a value that this version of taskd can't read")]
    Unreadable { column: &'static str },
}

impl StoreError {
    /// Whether a unique index refused the row: another row has the name or the key.
    pub fn is_unique_violation(&self) -> bool {
        matches!(self, Self::Statement(sqlx::Error::Database(error)) if error.is_unique_violation())
    }

    /// The database fault that this error shows; `None` if the statement itself is wrong or
    /// refused.
    pub fn fault(&self) -> Option<Fault> {
        match self {
            Self::Open { source, .. } | Self::Statement(source) => Fault::of(source),
            Self::Migrate { source, .. } => Fault::of_migration(source),
            Self::Batch(error) => error.fault(),
            Self::Damaged { .. } | Self::Corrupt => Some(Fault::Corrupt),
            Self::DiskFull { .. } => Some(Fault::Full),
            // The database is another server's: it takes no statements of this one.
            Self::TakenOver { .. } => Some(Fault::Unreachable),
            _ => None,
        }
    }

    /// Logs that `what` was not done, unless the change of the database's state that explains it
    /// was logged already.
    pub fn log(&self, what: &'static str) {
        match self.fault() {
            Some(Fault::Unreachable | Fault::Corrupt | Fault::Full) => {
                tracing::debug!(error = self as &dyn std::error::Error, "{what}")
            }
            _ => tracing::warn!(error = self as &dyn std::error::Error, "{what}"),
        }
    }
}

/// A write transaction in progress, beside which nothing else is written. Dropping the transaction
/// without [`Transaction::commit`] rolls it back.
pub struct Transaction {
    connection: PooledConnection,
    /// The turn of this write among the exclusive ones; in a write of reports, the turn of the last
    /// exclusive write.
    sequence: u64,
    invalidation: InvalidationGuard,
    /// The person whose rights this write has checked.
    verified_person: Option<Person>,
    /// The rate limit for acts that every person may do.
    audit_limit: Arc<KeyedRateLimit>,
    dialect: &'static Dialect,
}

impl Transaction {
    /// The sequence number of this write; a later write has a higher one.
    pub fn sequence(&self) -> u64 {
        self.sequence
    }

    /// Commits the write. The commit runs to its end even if the caller does not wait for it.
    pub async fn commit(self) -> Result<(), StoreError> {
        let Self { connection, invalidation, .. } = self;
        let committing = tokio::spawn(async move {
            let committed = connection.commit().await;
            drop(invalidation);
            committed
        });
        match committing.await {
            Ok(committed) => Ok(committed?),
            Err(panic) => std::panic::resume_unwind(panic.into_panic()),
        }
    }

    /// Marks this write as one that may change access rights.
    fn mark_auth_change(&mut self) {
        self.invalidation.invalidates = true;
    }

    /// The connection on which the store's own statements run.
    fn connection(&mut self) -> Statement<'_> {
        self.connection.connection()
    }
}

/// The URL of a SQLite database in a file, which is created if it is missing.
pub fn sqlite_url(path: &Path) -> String {
    let mut url = String::from("sqlite://");
    for &byte in path.as_os_str().as_encoded_bytes() {
        if byte.is_ascii_alphanumeric() || matches!(byte, b'/' | b'.' | b'_' | b'-' | b'~') {
            url.push(char::from(byte));
        } else {
            url.push_str(&format!("%{byte:02X}"));
        }
    }
    url.push_str("?mode=rwc");
    url
}

impl Store {
    /// Opens the database at a `sqlite:` or `postgres:` URL, checks for damage and migrates the
    /// tables.
    pub async fn open(url: &str) -> Result<Self, StoreError> {
        match Self::open_at(url).await {
            Err(error) if error.fault() == Some(Fault::Full) && !is_postgres(url) => {
                let separator = if url.contains('?') { '&' } else { '?' };
                let store =
                    Self::open_at(&format!("{url}{separator}{WITHOUT_SHARED_MEMORY}")).await;
                let disk_full = |error: StoreError| match error.fault() {
                    Some(Fault::Full) => StoreError::DiskFull { url: without_password(url) },
                    _ => error,
                };
                let store = store.map_err(disk_full)?;
                tracing::warn!(
                    "the disk is full: existing data can be read; until the next start no other program can open the database"
                );
                Ok(store)
            }
            opened => opened,
        }
    }

    async fn open_at(url: &str) -> Result<Self, StoreError> {
        let store = Self::unopened(url);
        store.prepare().await?;
        Ok(store)
    }

    /// The same as [`Self::unopened`] for a server that needs the database for itself: before
    /// [`Self::prepare`] opens a Postgres, it takes the database's lock.
    pub fn guarded(url: &str, identity: ServerIdentity) -> Self {
        let mut store = Self::unopened(url);
        if store.is_postgres {
            store.guard = Some(Guard::new(url, identity, store.state.clone()));
        }
        store
    }

    /// A database that refuses everything until [`Self::prepare`] has succeeded.
    pub fn unopened(url: &str) -> Self {
        sqlx::any::install_default_drivers();
        let state = DatabaseState::unknown();
        let reader_cache = format!("PRAGMA cache_size = -{}", READER_CACHES_KIB / READERS);
        Self {
            // One writer: its transactions queue for this connection instead of failing each other.
            writes: ConnectionPool::new(pool_options(url, 1, 1, WRITER_CACHE, &state)),
            reads: ConnectionPool::new(pool_options(
                url,
                READERS,
                SHARED_READERS,
                &reader_cache,
                &state,
            )),
            cluster_writes: ConnectionPool::new(cluster_pool_options(url, &state)),
            auth_cache: AuthCache::default(),
            first_uses: FirstUses::default(),
            audit_limit: Arc::new(new_audit_limit()),
            state,
            url: url.into(),
            is_postgres: is_postgres(url),
            guard: None,
            locks: if is_postgres(url) { &POSTGRES_LOCKS } else { &SQLITE_LOCKS },
            dialect: if is_postgres(url) { &POSTGRES } else { &SQLITE },
        }
    }

    /// Opens the connection on which a standby waits for the database's lock.
    pub async fn connect_to_lock(&self) -> Result<(), StoreError> {
        match &self.guard {
            Some(guard) => guard.connect().await,
            None => Ok(()),
        }
    }

    /// Takes the database's lock from a server that has ended. A standby calls this until the lock
    /// is taken, before [`Self::prepare`].
    pub async fn try_succeed(&self) -> Result<LockAttempt, StoreError> {
        match &self.guard {
            Some(guard) => guard.try_succeed().await,
            None => Ok(LockAttempt::Taken),
        }
    }

    /// Takes the database's lock, if it needs one, checks for damage and migrates the tables. After
    /// that the database can be used.
    pub async fn prepare(&self) -> Result<(), StoreError> {
        if let Some(guard) = &self.guard {
            guard.take().await?;
        }
        make_file(&self.url);
        let first =
            first_connection(&self.url).await.inspect_err(|error| self.state.record_error(error));
        let mut first = first.map_err(|error| self.open_error(error))?;
        let prepared = self.prepare_by(&mut first).await;
        let closed = first.connection.close().await;
        prepared?;
        if let Some(guard) = &self.guard {
            guard.claim().await?;
        }
        self.state.mark_open();
        for connections in [&self.writes, &self.reads] {
            connections.acquire().await.map_err(|error| self.open_error(error))?;
        }
        closed.map_err(|error| self.open_error(error))
    }

    async fn prepare_by(&self, first: &mut NewConnection) -> Result<(), StoreError> {
        let url = || without_password(&self.url);
        let connection = &mut first.connection;
        if self.is_postgres {
            probe(&first.url, connection).await?;
            self.state.set_page_protection(postgres_page_protection(connection).await);
        } else {
            match check_quickly(&self.url).await.map_err(|error| self.open_error(error))? {
                Checked::Sound => {}
                Checked::Damaged(finding) => {
                    return Err(StoreError::Damaged { url: url(), finding });
                }
                Checked::Interrupted => {
                    tracing::info!("the database is large: the check continues in the background")
                }
            }
        }
        database::migrate::run(&self.url, connection).await
    }

    fn open_error(&self, source: sqlx::Error) -> StoreError {
        let url = without_password(&self.url);
        match Fault::of(&source) {
            Some(Fault::Corrupt) => StoreError::Damaged { url, finding: source.to_string() },
            _ => StoreError::Open { url, source },
        }
    }

    /// The known state of the database.
    pub fn state(&self) -> &DatabaseState {
        &self.state
    }

    /// Closes all connections after the writes that are under way, and frees the database's lock.
    pub async fn close(&self) {
        self.writes.close().await;
        self.cluster_writes.close().await;
        self.reads.close().await;
        if let Some(guard) = &self.guard {
            guard.release().await;
        }
    }

    /// The name of this start of the server, if it is in a cluster.
    pub fn cluster_run(&self) -> Option<&str> {
        self.guard.as_ref().filter(|guard| guard.is_shared()).map(Guard::run)
    }

    /// The number of connections to the database that were lost so far.
    pub fn lost_connections(&self) -> u64 {
        self.state.losses()
    }

    /// Forgets all cached admissions, because another server may have changed them.
    pub fn forget_admissions(&self) {
        self.auth_cache.forget();
    }

    /// Changes each time that a write of this server may have changed admissions.
    pub fn changed_admissions(&self) -> watch::Receiver<()> {
        self.auth_cache.changed()
    }

    /// Records that another server has taken this one's place, so that this one has to end.
    pub fn record_takeover(&self, successor: &str) {
        self.state.record_takeover(&successor);
    }

    /// Whether the database answers.
    pub async fn ping(&self) -> Result<(), StoreError> {
        Ok(self.reads.acquire().await.map(drop)?)
    }

    /// The kind of the database, and its size.
    pub async fn size(&self) -> Result<DatabaseSize, StoreError> {
        let (kind, sql) = match self.is_postgres {
            true => ("postgres", "SELECT pg_database_size(current_database())"),
            false => (
                "sqlite",
                "SELECT page_count * page_size FROM pragma_page_count(), pragma_page_size()",
            ),
        };
        // A refusal of this query is harmless: the size stays unknown.
        let bytes: Option<i64> =
            sqlx::query_scalar(sql).fetch_optional(&self.reads).await.unwrap_or_default();
        Ok(DatabaseSize { kind, bytes: bytes.map(rows::number) })
    }

    /// Begins a write, alone: it waits here, before it has read anything, until all others have
    /// ended, and others wait until this one has.
    pub async fn begin(&self) -> Result<Transaction, StoreError> {
        let mut write = self.begin_without_auth_invalidation().await?;
        write.mark_auth_change();
        Ok(write)
    }

    /// Begins a write, alone, that changes no access rights or is never committed.
    pub async fn begin_without_auth_invalidation(&self) -> Result<Transaction, StoreError> {
        self.begin_locked(self.locks.exclusive, NEXT_TURN).await
    }

    /// Begins a write of reports of `robots`. On Postgres it runs beside others of its kind that
    /// are about other robots.
    pub async fn begin_report(
        &self,
        robots: &BTreeSet<&RobotId>,
    ) -> Result<ReportTransaction, StoreError> {
        let write = self.begin_locked(self.locks.shared, LAST_TURN).await?;
        ReportTransaction::lock(write, robots, self.locks.robots).await
    }

    async fn begin_locked(
        &self,
        lock: &'static str,
        turn: &'static str,
    ) -> Result<Transaction, StoreError> {
        if self.state.corruption().is_some() {
            return Err(StoreError::Corrupt);
        }
        let mut connection = self.writes.acquire().await?;
        connection.begin(lock).await?;
        let run = self.guard.as_ref().map_or("", Guard::run);
        let turn = sqlx::query_scalar(turn).bind(run);
        let Some(sequence) = turn.fetch_optional(connection.connection()).await? else {
            let successor = holder(connection.connection()).await?;
            self.state.record_takeover(&successor);
            return Err(StoreError::TakenOver { successor });
        };
        let invalidation = self.auth_cache.invalidation_guard();
        let audit_limit = self.audit_limit.clone();
        Ok(Transaction {
            connection,
            sequence: rows::number(sequence),
            invalidation,
            verified_person: None,
            audit_limit,
            dialect: self.dialect,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::database::sessions::CONNECTION_WAIT;
    use super::*;

    #[tokio::test]
    async fn torn_missing_or_newer_database_is_refused_at_once() {
        let directory = tempfile::tempdir().expect("a directory");
        let refused = async |name: &str| {
            let url = sqlite_url(&directory.path().join(name));
            // Far below the time that a pool would wait.
            let opened = tokio::time::timeout(CONNECTION_WAIT / 3, Store::open(&url))
                .await
                .expect("at once");
            let error = opened.expect_err("refused");
            format!(
                "{error}: {}",
                std::error::Error::source(&error).map(ToString::to_string).unwrap_or_default()
            )
        };
        std::fs::write(directory.path().join("torn"), vec![7; 8192]).expect("written");
        let torn = refused("torn").await;
        assert!(torn.contains("/torn is corrupt") && torn.contains("not a database"), "{torn}");
        let missing = refused("no/such").await;
        assert!(missing.contains("/no/such can't be opened"), "{missing}");
        let url = sqlite_url(&directory.path().join("newer"));
        let store = Store::open(&url).await.expect("opens");
        let newer =
            "INSERT INTO _sqlx_migrations (version, description, success, checksum, execution_time)
                     VALUES (9999, 'later', TRUE, x'00', 0)";
        sqlx::query(newer).execute(&store.reads).await.expect("written");
        store.close().await;
        let newer = refused("newer").await;
        assert!(newer.contains("a newer taskd (its tables are at 9999)"), "{newer}");
    }

    #[tokio::test]
    async fn database_files_are_readable_only_by_their_owner() {
        use std::os::unix::fs::PermissionsExt as _;
        let directory = tempfile::tempdir().expect("a directory");
        let store =
            Store::open(&sqlite_url(&directory.path().join("a b.sqlite"))).await.expect("opens");
        store.begin().await.expect("begins").commit().await.expect("written");
        let files = std::fs::read_dir(directory.path())
            .expect("there")
            .map(|entry| entry.expect("an entry"));
        let modes: Vec<_> = files
            .map(|file| file.metadata().expect("there").permissions().mode() & 0o777)
            .collect();
        assert_eq!(modes, [0o600; 3], "the database, its log and the index of that");
        store.close().await;
        let (link, target) = (directory.path().join("link"), directory.path().join("target"));
        std::os::unix::fs::symlink(&target, &link).expect("a link");
        Store::open(&sqlite_url(&link)).await.expect("opens").close().await;
        let mode = target.metadata().expect("there").permissions().mode();
        assert_eq!(mode & 0o777, 0o600, "the target of a link");
    }

    #[test]
    fn sqlite_url_escapes_any_character() {
        assert_eq!(sqlite_url(Path::new("/a b?/c%.db")), "sqlite:///a%20b%3F/c%25.db?mode=rwc");
    }
}
