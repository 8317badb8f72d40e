//! Owns the database, the truth about robots, packages, orders and tokens; it never decides what
//! should happen and never reads the clock.
//!
//! Decisions are [`crate::domain::deployment`]'s and [`crate::domain::rollout`]'s. One SQL text
//! serves SQLite and Postgres.

#![expect(clippy::disallowed_methods, reason = "SQL is at home here")]

mod database;
mod deliveries;
mod fleet;
mod orders;
mod people;
mod registry;
mod rows;
mod timelines;

use std::fmt;
use std::fs::File;
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::Path;
use std::str::FromStr as _;
use std::sync::Arc;
use std::time::Duration;

use sqlx::migrate::MigrateError;
use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{AnyConnection, Connection as _};

pub use database::connections::with_shared_reads;
use database::connections::{Connections, Lent, Statement, Terms, bounded};
pub use database::fault::Fault;
pub use database::integrity::check_at_rest;
use database::integrity::{Checked, check_quickly, postgres_guard};
pub use database::state::DatabaseState;
pub use deliveries::{Decided, DeliveryOrder, RobotFacts};
pub use fleet::matching::Matching;
pub use fleet::reports::{OpenAssignment, ReportedBy, ReportedRobot};
pub use fleet::robot_pages::RobotPage;
pub use fleet::robots::{BrokerCredential, DesiredTasks, FetchedBy, KnownRobot};
pub use orders::assignments::{Released, TaskOrder};
pub use orders::deployments::{DeploymentPage, NewDeployment, OpenRobot, OpenRollout};
pub use orders::earlier::{EarlierPackage, Unsuccessful};
pub use orders::idempotency::PastOrder;
pub use orders::still_running::StillRunning;
pub use orders::taking_back::Revocable;
use people::access::{Access, Ending};
use people::audit::everybodys_pace;
pub use people::audit::{Act, Deed};
use people::first_use::FirstUses;
pub use people::tokens::{Admitted, EnrolmentTerms, TokenHolder};
pub use people::users::{NewToken, User};
pub use registry::outputs::NewOutput;
pub use registry::package_use::{Deletion, PackageUsers};
pub use registry::packages::{NewManifest, PutManifest, Reference, StoredManifest};
pub use registry::publishers::SignedDocument;
pub use registry::referrers::ReferrersPage;
pub use registry::robot_blobs::bytes_taken;
pub use timelines::{HistoryPage, HistoryQuery};

use crate::domain::person::Person;
use crate::limits::pace::Pace;

/// The page cache of the SQLite writer: 16 MiB.
const WRITER_CACHE: &str = "PRAGMA cache_size = -16384";
/// The page cache of each SQLite reader: 4 MiB. The system's page cache holds the rest.
const READER_CACHE: &str = "PRAGMA cache_size = -4096";
/// Number of connections for concurrent reads.
const READERS: u32 = 6;
/// Number of these connections that people's reads may use at once. The rest stay free for robots
/// and orders.
const SHARED_READERS: u32 = 4;
/// Time limit of a statement's wait for a connection or for another process's write.
const PATIENCE: Duration = Duration::from_secs(30);
/// The same wait for a connection to Postgres. It is shorter than a request's time limit, so that
/// the client is told why there is no answer.
const POSTGRES_PATIENCE: Duration = Duration::from_secs(20);
/// Time limit for connecting to a database server. It is short enough for the client to hear in
/// time that there is no connection.
const CONNECT: Duration = Duration::from_secs(5);
/// Part of a SQLite URL: the file belongs to this process alone. The process then keeps in memory
/// the index that it would otherwise share through a file.
const WITHOUT_SHARED_MEMORY: &str = "vfs=unix-excl";

/// The database. Clones share its connections.
#[derive(Clone)]
pub struct Store {
    reads: Connections,
    writes: Connections,
    access: Access,
    first_uses: FirstUses,
    everybodys: Arc<Pace>,
    state: DatabaseState,
    url: Arc<str>,
    is_postgres: bool,
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
        "database {url} was last used by a newer taskd (its tables are at {version}): install that one again"
    )]
    Newer {
        /// The database, without its password.
        url: String,
        /// The migration that this program does not have.
        version: i64,
    },
    /// The integrity check found damaged pages.
    #[error(
        "database {url} is corrupt ({finding}): stop whatever uses it and put back a copy of the data directory, or save what \
         can be read with sqlite3's .recover; docs/server.md says how"
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
    NoRoom {
        /// The database, without its password.
        url: String,
    },
    /// The database was found corrupt while it was in use.
    #[error("the database is corrupt, so nothing is changed until it is mended")]
    Corrupt,
    #[error("the database refused a statement")]
    Statement(#[from] sqlx::Error),
    /// A write that serves several robots failed.
    #[error("a write for several robots failed")]
    Together(#[source] Arc<StoreError>),
    /// The caller's rights ended after the request began.
    #[error("your rights have changed since this request began; sign in, or send it again")]
    RightsEnded,
    /// The person has reached the limit of audited acts on their own account.
    #[error(
        "{who} has signed in, made tokens or set a password so often that the next time is in {seconds} s"
    )]
    TooManyActs {
        who: String,
        /// Seconds until the next act is allowed.
        seconds: u64,
    },
    /// A row holds a value that this version can't read.
    #[error("column {column} of the database holds what this version of taskd can't read")]
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
            Self::Together(error) => error.fault(),
            Self::Damaged { .. } | Self::Corrupt => Some(Fault::Corrupt),
            Self::NoRoom { .. } => Some(Fault::Full),
            _ => None,
        }
    }

    /// Logs that `what` was not done, unless the change of the database's state that explains it
    /// was logged already.
    pub fn log(&self, what: &'static str) {
        match self.fault() {
            Some(Fault::Away | Fault::Corrupt | Fault::Full) => {
                tracing::debug!(error = self as &dyn std::error::Error, "{what}")
            }
            _ => tracing::warn!(error = self as &dyn std::error::Error, "{what}"),
        }
    }
}

/// A write transaction in progress. The write lock admits one at a time. Dropping the transaction
/// without [`Write::commit`] rolls it back.
pub struct Write {
    lent: Lent,
    turn: u64,
    ending: Ending,
    /// The person whose rights this write has checked.
    vouched_for: Option<Person>,
    /// The rate limit for acts that every person may do.
    everybodys: Arc<Pace>,
}

impl Write {
    /// The sequence number of this write; a later write has a higher one.
    pub fn turn(&self) -> u64 {
        self.turn
    }

    /// Commits the write. The commit runs to its end even if the caller does not wait for it.
    pub async fn commit(self) -> Result<(), StoreError> {
        let Self { lent, ending, .. } = self;
        let committing = tokio::spawn(async move {
            let committed = lent.commit().await;
            drop(ending);
            committed
        });
        match committing.await {
            Ok(committed) => Ok(committed?),
            Err(panic) => std::panic::resume_unwind(panic.into_panic()),
        }
    }

    /// Marks this write as one that may change access rights.
    fn changes_access(&mut self) {
        self.ending.is_due = true;
    }

    /// The connection on which the store's own statements run.
    fn connection(&mut self) -> Statement<'_> {
        self.lent.connection()
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
                let no_room = |error: StoreError| match error.fault() {
                    Some(Fault::Full) => StoreError::NoRoom { url: without_password(url) },
                    _ => error,
                };
                let store = store.map_err(no_room)?;
                tracing::warn!(
                    "the disk is full: what is there can be read; until the next start no other program can open the database"
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

    /// A database that refuses everything until [`Self::prepare`] has succeeded.
    pub fn unopened(url: &str) -> Self {
        sqlx::any::install_default_drivers();
        let state = DatabaseState::unknown();
        Self {
            // One writer: its transactions queue for this connection instead of failing each other.
            writes: Connections::new(terms(url, 1, 1, WRITER_CACHE, &state)),
            reads: Connections::new(terms(url, READERS, SHARED_READERS, READER_CACHE, &state)),
            access: Access::default(),
            first_uses: FirstUses::default(),
            everybodys: Arc::new(everybodys_pace()),
            state,
            url: url.into(),
            is_postgres: is_postgres(url),
        }
    }

    /// Checks for damage and migrates the tables. After that the database can be used.
    pub async fn prepare(&self) -> Result<(), StoreError> {
        make_file(&self.url);
        let first = first_connection(&self.url).await.inspect_err(|error| self.state.note(error));
        let mut first = first.map_err(|error| self.open_error(error))?;
        let prepared = self.prepare_by(&mut first).await;
        let closed = first.close().await;
        prepared?;
        self.state.opened();
        for connections in [&self.writes, &self.reads] {
            connections.lend().await.map_err(|error| self.open_error(error))?;
        }
        closed.map_err(|error| self.open_error(error))
    }

    async fn prepare_by(&self, connection: &mut AnyConnection) -> Result<(), StoreError> {
        let url = || without_password(&self.url);
        if self.is_postgres {
            self.state.guarded(postgres_guard(connection).await);
        } else {
            match check_quickly(&self.url).await.map_err(|error| self.open_error(error))? {
                Checked::Sound => {}
                Checked::Damaged(finding) => {
                    return Err(StoreError::Damaged { url: url(), finding });
                }
                Checked::Interrupted => {
                    tracing::info!("the database is large: the check goes on while it is served")
                }
            }
        }
        database::migrate::run(connection).await.map_err(|source| match source {
            MigrateError::VersionMissing(version) => StoreError::Newer { url: url(), version },
            source => StoreError::Migrate { url: url(), source },
        })
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

    /// Closes all connections after the writes that are under way.
    pub async fn close(&self) {
        self.writes.close().await;
        self.reads.close().await;
    }

    /// Whether the database answers.
    pub async fn ping(&self) -> Result<(), StoreError> {
        Ok(self.reads.lend().await.map(drop)?)
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

    /// Begins a write. Its first statement updates one row that every write updates. On both
    /// databases a second write therefore waits here, before it has read anything, until the first
    /// has ended.
    pub async fn begin(&self) -> Result<Write, StoreError> {
        let mut write = self.begin_keeping_rights().await?;
        write.changes_access();
        Ok(write)
    }

    /// Begins a write that changes no access rights, such as a robot's report, or that is never
    /// committed.
    pub async fn begin_keeping_rights(&self) -> Result<Write, StoreError> {
        if self.state.corruption().is_some() {
            return Err(StoreError::Corrupt);
        }
        let mut lent = self.writes.lend().await?;
        lent.begin().await?;
        let turn: i64 =
            sqlx::query_scalar("UPDATE write_lock SET turn = turn + 1 WHERE id = 1 RETURNING turn")
                .fetch_one(lent.connection())
                .await?;
        let ending = self.access.until_ended();
        let everybodys = self.everybodys.clone();
        Ok(Write { lent, turn: rows::number(turn), ending, vouched_for: None, everybodys })
    }
}

/// Creates the file of a new SQLite database so that only its owner can read it. SQLite gives the
/// files beside it the same mode. A failure is reported later, by the code that opens the file.
fn make_file(url: &str) {
    if !url.contains("mode=rwc") {
        return;
    }
    if let Ok(options) = SqliteConnectOptions::from_str(url) {
        let _ =
            File::options().write(true).create_new(true).mode(0o600).open(options.get_filename());
    }
}

/// Opens a separate connection for work without a time limit. There is one attempt only, so that an
/// error is reported at once.
async fn first_connection(url: &str) -> Result<AnyConnection, sqlx::Error> {
    let mut connection = match is_postgres(url) {
        true => bounded(CONNECT, AnyConnection::connect(url)).await?,
        false => AnyConnection::connect(url).await?,
    };
    // SQLite does not read its file before the first statement.
    let first = if is_postgres(url) { POSTGRES_SESSION } else { SQLITE_SESSION };
    if let Err(error) = sqlx::raw_sql(first).execute(&mut connection).await {
        // The files are closed before they are opened again in another mode.
        let _ = connection.close().await;
        return Err(error);
    }
    Ok(connection)
}

fn is_postgres(url: &str) -> bool {
    url.starts_with("postgres")
}

/// The pragmas of every SQLite session. FULL: a commit survives a power cut.
const SQLITE_SESSION: &str =
    "PRAGMA journal_mode = WAL; PRAGMA synchronous = FULL; PRAGMA foreign_keys = ON;
     PRAGMA busy_timeout = 30000;";
/// Makes Postgres end a session whose server vanished without closing its connection. Such a
/// session may hold the write lock, for which the next write waits. By default Postgres keeps it
/// for hours.
const POSTGRES_SESSION: &str =
    "SET idle_in_transaction_session_timeout = '60s'; SET lock_timeout = '30s';
     SET tcp_keepalives_idle = 30; SET tcp_keepalives_interval = 10; SET tcp_keepalives_count = 3;";
/// Makes Postgres end a statement before the server gives up waiting for its answer.
const POSTGRES_STATEMENT: &str = "SET statement_timeout = '50s';";

/// The settings of a store's connections.
fn terms(url: &str, count: u32, shared: u32, cache: &str, state: &DatabaseState) -> Terms {
    let (url, state) = (url.to_owned(), state.clone());
    if is_postgres(&url) {
        let session = [POSTGRES_SESSION, POSTGRES_STATEMENT].concat();
        let (answer, greeting) = (Duration::from_secs(60), Duration::from_secs(5));
        let (connect, wait) = (CONNECT, POSTGRES_PATIENCE);
        return Terms { url, session, count, shared, answer, greeting, connect, wait, state };
    }
    // A file does not stop answering: a slow answer is not a lost connection.
    let session = [SQLITE_SESSION, cache].concat();
    let forever = Duration::MAX;
    Terms {
        url,
        session,
        count,
        shared,
        answer: forever,
        greeting: forever,
        connect: PATIENCE,
        wait: PATIENCE,
        state,
    }
}

/// A URL that is safe to show: without `user:password@`, and without the query, which may hold a
/// password too.
fn without_password(url: &str) -> String {
    let shown = match (url.find("://"), url.rfind('@')) {
        (Some(scheme), Some(at)) if scheme + 3 < at => {
            format!("{}{}", &url[..scheme + 3], &url[at + 1..])
        }
        _ => url.to_owned(),
    };
    shown.split('?').next().unwrap_or_default().to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_shown_url_has_no_password() {
        assert_eq!(without_password("postgres://u:p@ss@host/db"), "postgres://host/db");
        assert_eq!(without_password("postgres://u:p?ss@host/db"), "postgres://host/db");
        assert_eq!(without_password("postgres://host/db?password=secret"), "postgres://host/db");
        assert_eq!(without_password("sqlite:///a.db"), "sqlite:///a.db");
    }

    #[tokio::test]
    async fn a_database_that_is_none_or_of_a_newer_program_is_called_so_at_once() {
        let directory = tempfile::tempdir().expect("a directory");
        let refused = async |name: &str| {
            let url = sqlite_url(&directory.path().join(name));
            // Far below the time that a pool would wait.
            let opened =
                tokio::time::timeout(PATIENCE / 3, Store::open(&url)).await.expect("at once");
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
    async fn a_database_and_what_lies_beside_it_are_for_their_owner_alone() {
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
    }

    #[test]
    fn a_path_may_hold_any_character() {
        assert_eq!(sqlite_url(Path::new("/a b?/c%.db")), "sqlite:///a%20b%3F/c%25.db?mode=rwc");
    }
}
