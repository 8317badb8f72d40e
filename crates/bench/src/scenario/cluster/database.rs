//! The run's own statements on the servers' database: it reads rows and locks, ends sessions and
//! promotes the standby. It never writes to a table.
#![expect(clippy::disallowed_methods, reason = "the run compares the database with the robots")]

use std::collections::BTreeMap;
use std::time::Duration;

use anyhow::Context as _;
use sqlx::postgres::{PgListener, PgRow};
use sqlx::{Connection as _, PgConnection, Row as _};
use task_proto::DeploymentId;

/// Time limit of a query.
const QUERY_TIMEOUT: Duration = Duration::from_secs(20);
/// Pause before a query is asked again.
const AGAIN: Duration = Duration::from_millis(100);
/// The channel on which the servers notify each other.
const CHANNEL: &str = "taskd";

/// Why a query has no answer.
enum AskError {
    /// There is no primary, or the connection was lost.
    Away,
    Refused(sqlx::Error),
}

/// Whether the server ends the session, instead of refusing the query: class 57 of its codes.
fn is_shutdown(error: &dyn sqlx::error::DatabaseError) -> bool {
    error.code().is_some_and(|code| code.starts_with("57"))
}

/// A connection to the primary, opened again when it is lost.
pub struct Database {
    urls: Vec<String>,
    connection: Option<PgConnection>,
}

/// A robot's row.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RobotRow {
    pub generation: u64,
    pub observed: u64,
    /// Start and number of the last stored report.
    pub position: (u64, u64),
}

/// An assignment, of a robot by its name.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AssignmentRow {
    pub phase: String,
    pub run: u64,
}

/// A blob's row.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BlobRow {
    pub object: String,
    pub bytes: u64,
}

/// The progress of a rollout at one moment.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Progress {
    pub waiting: u64,
    /// Their turn has come, and they have not settled.
    pub busy: u64,
    pub failed: u64,
}

/// Counters of the database server.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Counters {
    pub wal_bytes: f64,
    pub rows_written: f64,
    pub commits: f64,
}

impl Database {
    /// The database with these URLs, of which one leads to the primary.
    pub fn new(urls: Vec<String>) -> Self {
        Self { urls, connection: None }
    }

    /// A connection to the first server that is a primary.
    async fn connect(urls: &[String]) -> Option<PgConnection> {
        for url in urls {
            let Ok(mut connection) = PgConnection::connect(url).await else { continue };
            let asked = sqlx::query_scalar::<_, bool>("SELECT pg_is_in_recovery()");
            if matches!(asked.fetch_one(&mut connection).await, Ok(false)) {
                return Some(connection);
            }
        }
        None
    }

    /// The answer to a query. It is asked again while the database is away, as in a failover.
    async fn rows(&mut self, sql: &'static str, parameter: &str) -> anyhow::Result<Vec<PgRow>> {
        let asking = async {
            loop {
                match self.ask(sql, parameter).await {
                    Err(AskError::Away) => tokio::time::sleep(AGAIN).await,
                    Err(AskError::Refused(error)) => return Err(error),
                    Ok(rows) => return Ok(rows),
                }
            }
        };
        let answer = tokio::time::timeout(QUERY_TIMEOUT, asking).await;
        answer.context("the database does not answer")?.context("the database")
    }

    async fn ask(&mut self, sql: &'static str, parameter: &str) -> Result<Vec<PgRow>, AskError> {
        let mut open = match self.connection.take() {
            Some(open) => open,
            None => Self::connect(&self.urls).await.ok_or(AskError::Away)?,
        };
        let query = sqlx::query(sql);
        let query = if parameter.is_empty() { query } else { query.bind(parameter) };
        match query.fetch_all(&mut open).await {
            Ok(rows) => {
                // A connection that failed is not used again.
                self.connection = Some(open);
                Ok(rows)
            }
            Err(sqlx::Error::Database(error)) if !is_shutdown(error.as_ref()) => {
                Err(AskError::Refused(sqlx::Error::Database(error)))
            }
            Err(_) => Err(AskError::Away),
        }
    }

    async fn number(&mut self, sql: &'static str) -> anyhow::Result<u64> {
        let rows = self.rows(sql, "").await?;
        integer(rows.first().context("no row")?, 0)
    }

    /// All robots, by name.
    pub async fn robots(&mut self) -> anyhow::Result<BTreeMap<String, RobotRow>> {
        let sql = "SELECT name, generation, observed_generation, report_start, report_seq
            FROM robots WHERE removed_at_ms IS NULL";
        let robot = |row: &PgRow| {
            let position = (integer(row, 3)?, integer(row, 4)?);
            let (generation, observed) = (integer(row, 1)?, integer(row, 2)?);
            anyhow::Ok((row.try_get(0)?, RobotRow { generation, observed, position }))
        };
        self.rows(sql, "").await?.iter().map(robot).collect()
    }

    /// All assignments, by robot's name and deployment.
    pub async fn assignments(
        &mut self,
    ) -> anyhow::Result<BTreeMap<(String, String), AssignmentRow>> {
        let sql = "SELECT r.name, a.deployment_id, a.phase, a.run
            FROM assignments a JOIN robots r ON r.id = a.robot_id";
        let assignment = |row: &PgRow| {
            let key = (row.try_get(0)?, row.try_get(1)?);
            anyhow::Ok((key, AssignmentRow { phase: row.try_get(2)?, run: integer(row, 3)? }))
        };
        self.rows(sql, "").await?.iter().map(assignment).collect()
    }

    /// Robots that are behind their state, and assignments that have not settled.
    pub async fn unsettled(&mut self) -> anyhow::Result<u64> {
        let behind = "SELECT COUNT(*) FROM robots
            WHERE removed_at_ms IS NULL AND generation > observed_generation";
        let open = "SELECT COUNT(*) FROM assignments a JOIN deployments d ON d.id = a.deployment_id
            WHERE a.ended = 0 AND NOT (a.phase = 'running' AND d.kind = 'service')";
        Ok(self.number(behind).await? + self.number(open).await?)
    }

    pub async fn progress(&mut self, rollout: &DeploymentId) -> anyhow::Result<Progress> {
        let sql = "SELECT COUNT(*) FILTER (WHERE released = 0 AND ended = 0),
                COUNT(*) FILTER (WHERE released = 1 AND ended = 0 AND phase <> 'running'),
                COUNT(*) FILTER (WHERE phase IN ('failed', 'unmet', 'rolled_back'))
            FROM assignments WHERE deployment_id = $1";
        let rows = self.rows(sql, rollout.as_str()).await?;
        let row = rows.first().context("no row")?;
        Ok(Progress { waiting: integer(row, 0)?, busy: integer(row, 1)?, failed: integer(row, 2)? })
    }

    /// The numbers of all deployments.
    pub async fn deployment_numbers(&mut self) -> anyhow::Result<Vec<u64>> {
        let rows = self.rows("SELECT number FROM deployments", "").await?;
        rows.iter().map(|row| integer(row, 0)).collect()
    }

    /// The numbers of the audit's entries.
    pub async fn audit_numbers(&mut self) -> anyhow::Result<Vec<u64>> {
        let rows = self.rows("SELECT number FROM audit", "").await?;
        rows.iter().map(|row| integer(row, 0)).collect()
    }

    /// The feed's entries, JSON.
    pub async fn feed(&mut self) -> anyhow::Result<Vec<String>> {
        let rows = self.rows("SELECT entry FROM feed ORDER BY number", "").await?;
        rows.iter().map(|row| Ok(row.try_get(0)?)).collect()
    }

    /// The digests of all manifests and of their parts.
    pub async fn needed_blobs(&mut self) -> anyhow::Result<Vec<String>> {
        let sql = "SELECT digest FROM manifests UNION SELECT digest FROM manifest_parts";
        self.rows(sql, "").await?.iter().map(|row| Ok(row.try_get(0)?)).collect()
    }

    /// The blobs of the common store, by digest.
    pub async fn blobs(&mut self) -> anyhow::Result<BTreeMap<String, BlobRow>> {
        let rows = self.rows("SELECT digest, object, bytes FROM blobs", "").await?;
        let blob = |row: &PgRow| {
            let (object, bytes) = (row.try_get(1)?, integer(row, 2)?);
            anyhow::Ok((row.try_get(0)?, BlobRow { object, bytes }))
        };
        rows.iter().map(blob).collect()
    }

    pub async fn counters(&mut self) -> anyhow::Result<Counters> {
        let sql = "SELECT CAST(pg_current_wal_lsn() - '0/0' AS FLOAT8),
                CAST(tup_inserted + tup_updated + tup_deleted AS FLOAT8), CAST(xact_commit AS FLOAT8)
            FROM pg_stat_database WHERE datname = current_database()";
        let rows = self.rows(sql, "").await?;
        let row = rows.first().context("no row")?;
        Ok(Counters {
            wal_bytes: row.try_get(0)?,
            rows_written: row.try_get(1)?,
            commits: row.try_get(2)?,
        })
    }

    /// The name of the server that holds the exclusive lock at this moment.
    pub async fn lock_holder(&mut self) -> anyhow::Result<Option<String>> {
        let sql = "SELECT a.application_name FROM pg_locks l JOIN pg_stat_activity a USING (pid)
            WHERE l.locktype = 'advisory' AND l.mode = 'ExclusiveLock' AND l.granted";
        let rows = self.rows(sql, "").await?;
        rows.first().map(|row| Ok(row.try_get(0)?)).transpose()
    }

    /// Ends the session of every server's listener; returns how many there were.
    pub async fn end_listeners(&mut self) -> anyhow::Result<u64> {
        let sql = "SELECT COUNT(pg_terminate_backend(pid)) FROM pg_stat_activity
            WHERE application_name = 'taskd listener'";
        self.number(sql).await
    }

    /// From now on a commit waits for the standby.
    pub async fn wait_for_standby(&mut self) -> anyhow::Result<()> {
        self.rows("ALTER SYSTEM SET synchronous_standby_names = '*'", "").await?;
        self.rows("SELECT pg_reload_conf()", "").await?;
        Ok(())
    }
}

/// Makes the standby at this URL the primary.
pub async fn promote(url: &str) -> anyhow::Result<()> {
    let mut connection = PgConnection::connect(url).await.context("the standby")?;
    let promoted = sqlx::query_scalar::<_, bool>("SELECT pg_promote(true, 60)");
    anyhow::ensure!(promoted.fetch_one(&mut connection).await?, "the standby was not promoted");
    Ok(())
}

/// Counts notifications until it is cancelled or the connection is lost.
pub async fn count_notifications(url: &str, count: &std::sync::atomic::AtomicU64) {
    let Ok(mut listener) = PgListener::connect(url).await else { return };
    if listener.listen(CHANNEL).await.is_err() {
        return;
    }
    while let Ok(Some(_)) = listener.try_recv().await {
        count.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
    }
}

fn integer(row: &PgRow, column: usize) -> anyhow::Result<u64> {
    let value: i64 = row.try_get(column)?;
    u64::try_from(value).context("a negative number")
}
