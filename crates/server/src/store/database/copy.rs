//! Copies all rows of a database into an empty one, of either kind. Both databases are closed to
//! servers meanwhile: a Postgres by the lock of its server, a SQLite file by SQLite's own lock. One
//! transaction holds the whole copy and its comparison with the source, so an interrupted copy
//! leaves an empty database.

use std::collections::BTreeSet;

use futures_util::TryStreamExt as _;
use futures_util::stream::TryChunksError;
use sha2::{Digest as _, Sha256};
use sqlx::any::AnyRow;
use sqlx::{AnyConnection, AssertSqlSafe, Connection as _, Error, Row as _};

use super::fault::Fault;
use super::guard::{Holder, take_lock};
use super::migrate;
use super::primary::{NewConnection, connect};
use super::probe::probe;
use super::sessions::{
    CONNECT_TIMEOUT, CONNECTION_WAIT, POSTGRES_SESSION, SQLITE_SESSION, make_file,
};
use super::write_locks::{POSTGRES_LOCKS, SQLITE_LOCKS};
use crate::domain::database_url::{is_postgres, without_password};
use crate::store::StoreError;
use crate::store::rows::{groups, values};

/// The rows that are in memory at once.
const BATCH: usize = 1000;
/// The table of the migrations that were applied.
const VERSIONS: &str = "_sqlx_migrations";
/// The table that has one row in every migrated database.
const WRITE_LOCK: &str = "write_lock";
/// Makes SQLite refuse a file that another process has open, and keep other processes out.
const SQLITE_EXCLUSIVE: &str = "PRAGMA locking_mode = EXCLUSIVE;";
/// While one database sorts a table, the session of the other one is idle in its transaction.
const POSTGRES_PATIENCE: &str =
    "SET idle_in_transaction_session_timeout = 0; SET tcp_user_timeout = 0;";
/// Every statement of a source reads the same state.
const POSTGRES_READ: &str = "BEGIN ISOLATION LEVEL REPEATABLE READ READ ONLY";

/// An error of a copy. The target is unchanged, except that its tables may be up to date.
#[derive(Debug, thiserror::Error)]
pub enum CopyError {
    /// A database can't be opened or migrated.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// A SQLite file is open elsewhere.
    #[error(
        "database {url} is in use by another program: stop the server that uses it, then copy again"
    )]
    FileInUse { url: String },
    /// A server, or another copy, holds the lock of a Postgres.
    #[error("database {url} is in use by {holder}: stop that server, then copy again")]
    InUse {
        /// The database, without its password.
        url: String,
        holder: Holder,
    },
    /// The source has no tables of a server.
    #[error("database {url} is not the database of a server: it has no table {VERSIONS}")]
    NoTables {
        /// The database, without its password.
        url: String,
    },
    /// The source's tables lack migrations of this program.
    #[error(
        "database {url} was last used by an older taskd (its tables are at {version}, those of this version at \
         {newest}): start this version on it once and stop it, then copy again", newest = migrate::NEWEST
    )]
    Older {
        /// The database, without its password.
        url: String,
        version: i64,
    },
    /// The target has rows.
    #[error("database {url} is in use already: its table {table} has rows; name an empty database")]
    NotEmpty {
        /// The database, without its password.
        url: String,
        table: String,
    },
    /// A statement about a table failed.
    #[error("table {table} of database {url} can't be copied")]
    Table {
        /// The source, without its password.
        url: String,
        table: String,
        source: Error,
    },
    /// The comparison of source and copy failed.
    #[error("the copy of table {table} differs from its source, so nothing was copied")]
    Different { table: String },
}

/// Copies the database at the URL `from` into the empty one at `to`, whose tables are made. Reports
/// each table and the number of its rows as soon as the table is copied and compared. No table is
/// visible to others before all are.
///
/// # Errors
///
/// A database is in use; the source has no tables or older ones; the target has rows; a statement
/// or the comparison failed.
pub async fn copy_database(
    from: &str,
    to: &str,
    copied: impl FnMut(&str, u64),
) -> Result<(), CopyError> {
    sqlx::any::install_default_drivers();
    let tables = tables().await?;
    let mut source = Side::open(from).await?;
    let outcome = match source.check().await {
        Ok(()) => copy_from(&mut source, to, &tables, copied).await,
        Err(error) => Err(error),
    };
    source.close().await;
    outcome
}

async fn copy_from(
    source: &mut Side,
    to: &str,
    tables: &[Table],
    copied: impl FnMut(&str, u64),
) -> Result<(), CopyError> {
    let to = with_creation(to);
    make_file(&to);
    let mut target = Side::open(&to).await?;
    let outcome = copy_all(source, &mut target, tables, copied).await;
    target.close().await;
    outcome
}

async fn copy_all(
    source: &mut Side,
    target: &mut Side,
    tables: &[Table],
    mut copied: impl FnMut(&str, u64),
) -> Result<(), CopyError> {
    target.check_empty(tables).await?;
    if target.is_postgres {
        probe(&target.url, &mut target.connection).await?;
    }
    migrate::run(&target.url, &mut target.connection).await?;
    source.execute(if source.is_postgres { POSTGRES_READ } else { "BEGIN" }).await?;
    let write = if target.is_postgres { &POSTGRES_LOCKS } else { &SQLITE_LOCKS };
    target.execute(write.exclusive).await?;
    target.execute("DELETE FROM write_lock").await?;
    let url = without_password(&source.url);
    for table in tables {
        let failed =
            |source| CopyError::Table { url: url.clone(), table: table.name.clone(), source };
        let read = copy_table(source, target, table).await.map_err(failed)?;
        let written = target.summary(table).await.map_err(failed)?;
        if read != written {
            return Err(CopyError::Different { table: table.name.clone() });
        }
        copied(&table.name, read.rows);
    }
    target.execute("UPDATE write_lock SET holder = NULL, held_since_ms = NULL").await?;
    target.execute("COMMIT").await
}

async fn copy_table(source: &mut Side, target: &mut Side, table: &Table) -> Result<Summary, Error> {
    let mut summary = Summary::default();
    let select = table.select(source.is_postgres);
    let mut batches =
        sqlx::query(AssertSqlSafe(select)).fetch(&mut source.connection).try_chunks(BATCH);
    while let Some(batch) = batches.try_next().await.map_err(|TryChunksError(_, error)| error)? {
        let batch = batch.iter().map(|row| table.read(row)).collect::<Result<Vec<_>, _>>()?;
        batch.iter().for_each(|row| summary.add(row));
        for group in groups(&batch) {
            let mut insert = sqlx::query(AssertSqlSafe(table.insert(group.len())));
            for value in group.iter().flatten() {
                insert = match value {
                    Value::Number(number) => insert.bind(*number),
                    Value::Text(text) => insert.bind(text.as_deref()),
                };
            }
            insert.execute(&mut target.connection).await?;
        }
    }
    Ok(summary)
}

/// One of the two databases, which no server can use until it is closed.
struct Side {
    /// The URL that the connection was made to. It may hold a password.
    url: String,
    connection: AnyConnection,
    is_postgres: bool,
}

impl Side {
    async fn open(url: &str) -> Result<Self, CopyError> {
        let is_postgres = is_postgres(url);
        let (session, limit) = match is_postgres {
            true => ([POSTGRES_SESSION, POSTGRES_PATIENCE], CONNECT_TIMEOUT),
            false => ([SQLITE_EXCLUSIVE, SQLITE_SESSION], CONNECTION_WAIT),
        };
        let shown = without_password(url);
        let connected = connect(url, &session.concat(), limit).await;
        let NewConnection { mut connection, url } = match connected {
            Err(error) if !is_postgres && Fault::of(&error) == Some(Fault::Busy) => {
                return Err(CopyError::FileInUse { url: shown });
            }
            connected => connected.map_err(|source| StoreError::Open { url: shown, source })?,
        };
        if is_postgres
            && let Some(holder) = take_lock(&mut connection).await.map_err(StoreError::from)?
        {
            return Err(CopyError::InUse { url: without_password(&url), holder });
        }
        Ok(Self { url, connection, is_postgres })
    }

    /// Closes the connection, and so frees the lock. An open transaction is rolled back.
    async fn close(self) {
        if let Err(error) = self.connection.close().await {
            tracing::debug!(%error, "closing a database connection failed");
        }
    }

    async fn execute(&mut self, sql: &'static str) -> Result<(), CopyError> {
        let executed = sqlx::raw_sql(sql).execute(&mut self.connection).await;
        Ok(executed.map(drop).map_err(StoreError::from)?)
    }

    async fn existing_tables(&mut self) -> Result<BTreeSet<String>, StoreError> {
        let list = match self.is_postgres {
            true => {
                "SELECT CAST(tablename AS TEXT) FROM pg_tables WHERE schemaname = current_schema()"
            }
            false => "SELECT name FROM sqlite_schema WHERE type = 'table'",
        };
        let names: Vec<String> = sqlx::query_scalar(list).fetch_all(&mut self.connection).await?;
        Ok(names.into_iter().collect())
    }

    /// Refuses a source whose tables are not those of this program, or are damaged: a damaged index
    /// may hide rows.
    async fn check(&mut self) -> Result<(), CopyError> {
        let url = without_password(&self.url);
        if !self.existing_tables().await?.contains(VERSIONS) {
            return Err(CopyError::NoTables { url });
        }
        let newest = "SELECT COALESCE(MAX(version), 0) FROM _sqlx_migrations";
        let version: i64 = sqlx::query_scalar(newest)
            .fetch_one(&mut self.connection)
            .await
            .map_err(StoreError::from)?;
        if version > migrate::NEWEST {
            return Err(StoreError::Newer { url, version }.into());
        }
        if version < migrate::NEWEST {
            return Err(CopyError::Older { url, version });
        }
        if self.is_postgres {
            return Ok(());
        }
        let check = "PRAGMA integrity_check(1)";
        let finding: String = sqlx::query_scalar(check)
            .fetch_one(&mut self.connection)
            .await
            .map_err(StoreError::from)?;
        match finding.as_str() {
            "ok" => Ok(()),
            _ => Err(StoreError::Damaged { url, finding }.into()),
        }
    }

    /// Refuses a target with rows, before anything is changed there.
    async fn check_empty(&mut self, tables: &[Table]) -> Result<(), CopyError> {
        let existing = self.existing_tables().await?;
        let written = |table: &&Table| existing.contains(&table.name) && table.name != WRITE_LOCK;
        for table in tables.iter().filter(written) {
            let any = format!("SELECT 1 FROM \"{}\" LIMIT 1", table.name);
            let found = sqlx::query(AssertSqlSafe(any)).fetch_optional(&mut self.connection).await;
            if found.map_err(StoreError::from)?.is_some() {
                let url = without_password(&self.url);
                return Err(CopyError::NotEmpty { url, table: table.name.clone() });
            }
        }
        Ok(())
    }

    async fn summary(&mut self, table: &Table) -> Result<Summary, Error> {
        let mut summary = Summary::default();
        let select = table.select(self.is_postgres);
        let mut rows = sqlx::query(AssertSqlSafe(select)).fetch(&mut self.connection);
        while let Some(row) = rows.try_next().await? {
            summary.add(&table.read(&row)?);
        }
        Ok(summary)
    }
}

/// A table of the newest version. All its columns are BIGINT or TEXT.
struct Table {
    name: String,
    columns: Vec<Column>,
}

struct Column {
    name: String,
    is_text: bool,
    /// The place of the column in the primary key, from 1; 0: it is not part of the key.
    place_in_key: i64,
}

/// All tables, in the order in which migrations made them: a table refers to older ones only. They
/// are read from the catalogue of a SQLite database in memory.
async fn tables() -> Result<Vec<Table>, StoreError> {
    const URL: &str = "sqlite::memory:";
    const CATALOGUE: &str = "SELECT tables.name, columns.name, columns.type, columns.pk
         FROM sqlite_schema tables, pragma_table_info(tables.name) columns
         WHERE tables.type = 'table' AND tables.name <> $1
         ORDER BY tables.rowid, columns.cid";
    let mut connection = AnyConnection::connect(URL).await?;
    migrate::run(URL, &mut connection).await?;
    let found: Vec<(String, String, String, i64)> =
        sqlx::query_as(CATALOGUE).bind(VERSIONS).fetch_all(&mut connection).await?;
    connection.close().await?;
    let mut tables: Vec<Table> = Vec::new();
    for (table, name, kind, place_in_key) in found {
        if tables.last().is_none_or(|last| last.name != table) {
            tables.push(Table { name: table, columns: Vec::new() });
        }
        let column = Column { name, is_text: kind == "TEXT", place_in_key };
        tables.last_mut().expect("just pushed").columns.push(column);
    }
    Ok(tables)
}

impl Table {
    /// Selects all rows, in the order of the primary key and of the bytes of texts, which is the
    /// same on both kinds of database.
    fn select(&self, is_postgres: bool) -> String {
        let mut key: Vec<&Column> =
            self.columns.iter().filter(|column| column.place_in_key > 0).collect();
        key.sort_by_key(|column| column.place_in_key);
        let order = key.iter().map(|column| match is_postgres && column.is_text {
            true => format!("\"{}\" COLLATE \"C\"", column.name),
            false => format!("\"{}\"", column.name),
        });
        let order = order.collect::<Vec<_>>().join(", ");
        format!("SELECT {} FROM \"{}\" ORDER BY {order}", self.column_names(), self.name)
    }

    fn insert(&self, rows: usize) -> String {
        let types: Vec<&str> = self
            .columns
            .iter()
            .map(|column| if column.is_text { "TEXT" } else { "BIGINT" })
            .collect();
        let (names, values) = (self.column_names(), values(1, rows, &types));
        format!("INSERT INTO \"{}\" ({names}) {values}", self.name)
    }

    fn column_names(&self) -> String {
        let names = self.columns.iter().map(|column| format!("\"{}\"", column.name));
        names.collect::<Vec<_>>().join(", ")
    }

    fn read(&self, row: &AnyRow) -> Result<Vec<Value>, Error> {
        let read = |(at, column): (usize, &Column)| match column.is_text {
            true => row.try_get(at).map(Value::Text),
            false => row.try_get(at).map(Value::Number),
        };
        self.columns.iter().enumerate().map(read).collect()
    }
}

/// A column's value in one row; `None` is NULL.
enum Value {
    Number(Option<i64>),
    Text(Option<String>),
}

/// The number of a table's rows, and the digest of their values in order.
#[derive(Default)]
struct Summary {
    rows: u64,
    digest: Sha256,
}

impl Summary {
    fn add(&mut self, row: &[Value]) {
        self.rows += 1;
        for value in row {
            match value {
                Value::Number(None) | Value::Text(None) => self.digest.update([0]),
                Value::Number(Some(number)) => {
                    self.digest.update([1]);
                    self.digest.update(number.to_be_bytes());
                }
                Value::Text(Some(text)) => {
                    self.digest.update([2]);
                    self.digest.update((text.len() as u64).to_be_bytes());
                    self.digest.update(text);
                }
            }
        }
    }
}

impl PartialEq for Summary {
    fn eq(&self, other: &Self) -> bool {
        self.rows == other.rows && self.digest.clone().finalize() == other.digest.clone().finalize()
    }
}

/// The URL, by which a missing SQLite file is created.
fn with_creation(url: &str) -> String {
    if is_postgres(url) || url.contains("mode=") {
        return url.to_owned();
    }
    let separator = if url.contains('?') { '&' } else { '?' };
    format!("{url}{separator}mode=rwc")
}
