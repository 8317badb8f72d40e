//! Checks of a SQLite file: a quick one before the service starts, and a full one beside the
//! service. Each uses a separate read-only connection. Postgres checks its pages as it reads them,
//! if they have checksums: we ask whether they do.

use std::borrow::Cow;
use std::path::Path;
use std::time::{Duration, Instant};

use sqlx::sqlite::SqliteConnection;
use sqlx::{AnyConnection, AssertSqlSafe, Connection as _, Error, Row as _};
use tokio_util::sync::CancellationToken;

use super::fault::Fault;
use crate::store::{Store, StoreError, sqlite_url};

/// Time limit of the check at start. The rest is checked beside the service.
const QUICK_CHECK_LIMIT: Duration = Duration::from_secs(10);
/// Pages, or steps of SQLite's virtual machine, between two tests whether a check has to end.
const STEPS_PER_CANCEL_CHECK: i32 = 1000;
/// A full check works for this long, then leaves disk and processor to the service for as long.
const WORK_SLICE: Duration = Duration::from_millis(20);
/// SQLite's code for an interrupted statement.
const INTERRUPTED: &str = "9";

/// The outcome of a check.
#[derive(Debug, PartialEq, Eq)]
pub(in crate::store) enum Checked {
    /// The check found no damage in the pages that it read.
    Sound,
    /// The check found damage; holds the first finding.
    Damaged(String),
    /// The check was interrupted before its end.
    Interrupted,
}

/// Checks the structure of the file, for at most [`QUICK_CHECK_LIMIT`].
pub(in crate::store) async fn check_quickly(url: &str) -> Result<Checked, Error> {
    let mut connection = SqliteConnection::connect(url).await?;
    let end = Instant::now() + QUICK_CHECK_LIMIT;
    connection
        .lock_handle()
        .await?
        .set_progress_handler(STEPS_PER_CANCEL_CHECK, move || Instant::now() < end);
    let checked = run(&mut connection, "PRAGMA quick_check(1)").await;
    close(connection).await;
    checked
}

/// Checks a SQLite file that is not in use, quickly. Returns the first finding.
pub async fn check_at_rest(path: &Path) -> Result<Option<String>, StoreError> {
    match check_quickly(&sqlite_url(path)).await {
        Ok(Checked::Damaged(finding)) => Ok(Some(finding)),
        Ok(Checked::Sound | Checked::Interrupted) => Ok(None),
        Err(error) if Fault::of(&error) == Some(Fault::Corrupt) => Ok(Some(error.to_string())),
        Err(source) => Err(StoreError::Open { url: path.display().to_string(), source }),
    }
}

/// Checks all tables and indices of the file against each other, one table at a time so that no
/// read lasts for long.
async fn check_fully(url: &str, stop: CancellationToken) -> Result<Checked, Error> {
    let mut connection = SqliteConnection::connect(url).await?;
    let mut slice_began = Instant::now();
    connection.lock_handle().await?.set_progress_handler(STEPS_PER_CANCEL_CHECK, move || {
        if slice_began.elapsed() >= WORK_SLICE {
            pause();
            slice_began = Instant::now();
        }
        !stop.is_cancelled()
    });
    let checked = check_tables(&mut connection).await;
    close(connection).await;
    checked
}

/// Runs in the thread of the connection, which does nothing else.
#[expect(clippy::disallowed_methods, reason = "a statement that SQLite runs can't await")]
fn pause() {
    std::thread::sleep(WORK_SLICE);
}

async fn check_tables(connection: &mut SqliteConnection) -> Result<Checked, Error> {
    let list = "SELECT name FROM sqlite_schema WHERE type = 'table' ORDER BY name";
    let tables: Vec<String> = match sqlx::query_scalar(list).fetch_all(&mut *connection).await {
        Ok(tables) => tables,
        Err(error) => return classify_error(error),
    };
    for table in tables {
        let table = table.replace('\'', "''");
        for check in ["integrity_check", "foreign_key_check"] {
            let checked = run(connection, &format!("PRAGMA {check}('{table}')")).await?;
            if checked != Checked::Sound {
                return Ok(checked);
            }
        }
    }
    Ok(Checked::Sound)
}

/// Runs a check up to its first finding.
async fn run(connection: &mut SqliteConnection, check: &str) -> Result<Checked, Error> {
    let row = match sqlx::query(AssertSqlSafe(check)).fetch_optional(connection).await {
        Ok(Some(row)) => row,
        Ok(None) => return Ok(Checked::Sound),
        Err(error) => return classify_error(error),
    };
    let text: String = row.try_get(0)?;
    Ok(match text.as_str() {
        "ok" => Checked::Sound,
        // A row of foreign_key_check has the table, the row, the referenced table, and the number
        // of the key.
        table if row.len() > 1 => {
            Checked::Damaged(format!("a row of {table} refers to a missing row"))
        }
        // A line that names the database may come first.
        _ => Checked::Damaged(text.lines().last().unwrap_or(&text).to_owned()),
    })
}

/// A check that ends at an unreadable page has found damage.
fn classify_error(error: Error) -> Result<Checked, Error> {
    let code = error.as_database_error().and_then(|error| error.code().map(Cow::into_owned));
    match Fault::of(&error) {
        Some(Fault::Corrupt) => Ok(Checked::Damaged(error.to_string())),
        _ if code.as_deref() == Some(INTERRUPTED) => Ok(Checked::Interrupted),
        _ => Err(error),
    }
}

async fn close(connection: SqliteConnection) {
    if let Err(error) = connection.close().await {
        tracing::debug!(%error, "closing the connection of the database check failed");
    }
}

/// Asks Postgres how it protects its pages.
pub(in crate::store) async fn postgres_page_protection(
    connection: &mut AnyConnection,
) -> &'static str {
    match sqlx::query_scalar::<_, String>("SHOW data_checksums")
        .fetch_one(connection)
        .await
        .as_deref()
    {
        Ok("on") => "Postgres checks its pages as it reads them (data_checksums is on)",
        _ => "its pages are not checked: data_checksums is off in this Postgres",
    }
}

impl Store {
    /// Checks a SQLite file in full, slowly, unless `stop` comes first.
    /// [`crate::store::DatabaseState`] holds the outcome.
    pub async fn check(&self, now_ms: u64, stop: CancellationToken) -> Result<(), StoreError> {
        if self.is_postgres || !self.state.is_available() {
            return Ok(());
        }
        match check_fully(&self.url, stop).await? {
            Checked::Damaged(finding) => self.state.record_corruption(finding),
            Checked::Sound => self.state.record_full_check(now_ms),
            Checked::Interrupted => {}
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn full_check_stops_on_request_and_finds_only_real_damage() {
        let directory = tempfile::tempdir().expect("a directory");
        let path = directory.path().join("taskd.sqlite");
        let store = Store::open(&sqlite_url(&path)).await.expect("opens");
        let fill = "CREATE TABLE filler (number BIGINT, text TEXT);
            WITH RECURSIVE numbers (n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM numbers WHERE n < 20000)
            INSERT INTO filler SELECT n, 'some text of number ' || n FROM numbers;
            CREATE INDEX filler_by_text ON filler (text)";
        let mut connection = store.writes.acquire().await.expect("acquired");
        sqlx::raw_sql(fill).execute(connection.connection()).await.expect("filled");
        drop(connection);
        let stop = CancellationToken::new();
        stop.cancel();
        store.check(7, stop).await.expect("checked");
        assert_eq!(store.state().fully_checked_at_ms(), None, "the check was cancelled");
        store.check(8, CancellationToken::new()).await.expect("checked");
        assert_eq!((store.state().fully_checked_at_ms(), store.state().problem()), (Some(8), None));
        assert_eq!(check_at_rest(&path).await.expect("checked"), None);

        let orphan = "INSERT INTO tokens (id, kind, digest, robot_id, created_at_ms) VALUES ('t', 'r', 'd', 'nobody', 1)";
        let mut other = SqliteConnection::connect(&sqlite_url(&path)).await.expect("opens");
        sqlx::raw_sql("PRAGMA foreign_keys = OFF").execute(&mut other).await.expect("set");
        sqlx::raw_sql(orphan).execute(&mut other).await.expect("written");
        store.check(9, CancellationToken::new()).await.expect("checked");
        assert_eq!(store.state().corruption(), Some("a row of tokens refers to a missing row"));
        assert!(matches!(store.begin().await.err(), Some(StoreError::Corrupt)));
        // A row that can't be found does not mean that the blob is unused.
        let collected =
            store.blobs().drop_unreferenced(vec![task_proto::Digest::of(b"a blob")]).await;
        assert!(matches!(collected, Err(StoreError::Corrupt)));
    }
}
