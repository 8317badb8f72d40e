//! The start-up probe of a Postgres server: whether its sessions have the properties that the store
//! relies on. A pooler that lends a session for one transaction only lacks them, and so may a
//! database that only speaks Postgres' protocol.

use std::time::Duration;

use sqlx::postgres::PgListener;
use sqlx::{
    AnyConnection, AssertSqlSafe, ColumnIndex, Connection as _, Database, Decode, Error, Executor,
    Row as _, Type,
};
use tokio::time::timeout;

use super::fault::Fault;
use super::primary::{NewConnection, bounded, connect};
use super::sessions::{CONNECT_TIMEOUT, POSTGRES_SESSION};
use crate::domain::database_url::without_password;
use crate::store::StoreError;

/// Time limit of the whole probe.
const PROBE_TIMEOUT: Duration = Duration::from_secs(10);
/// Time limit for the arrival of a notification.
const NOTIFICATION_TIMEOUT: Duration = Duration::from_secs(5);
/// The first key of the probe's advisory lock. The second is the session's process id.
const LOCK_CLASS: i32 = i32::from_be_bytes(*b"task");

/// Connects to the primary among the servers of `database` and probes it. Returns its URL without
/// the password.
pub async fn check_postgres(database: &str) -> Result<String, StoreError> {
    sqlx::any::install_default_drivers();
    let NewConnection { mut connection, url } =
        connect(database, POSTGRES_SESSION, CONNECT_TIMEOUT)
            .await
            .map_err(|source| StoreError::Open { url: without_password(database), source })?;
    let probed = probe(&url, &mut connection).await;
    // The probe has its result already.
    let _ = connection.close().await;
    probed.map(|()| without_password(&url))
}

/// Refuses a server whose sessions lack a property. `connection` is one to the server at `url`; after
/// an error it may be in a transaction.
pub(in crate::store) async fn probe(
    url: &str,
    connection: &mut AnyConnection,
) -> Result<(), StoreError> {
    let reason = match bounded(PROBE_TIMEOUT, missing_property(url, connection)).await {
        Ok(None) => return Ok(()),
        Ok(Some(missing)) => missing.to_owned(),
        Err(error @ Error::Database(_)) if Fault::of(&error).is_none() => {
            format!("a statement of the probe failed: {}", Fault::description(&error))
        }
        Err(source) => return Err(StoreError::Open { url: without_password(url), source }),
    };
    Err(StoreError::Unsuitable { url: without_password(url), reason })
}

/// The first property that the server's sessions lack. The statements use the simple protocol,
/// because a pooler mixes up prepared ones.
async fn missing_property(
    url: &str,
    other: &mut AnyConnection,
) -> Result<Option<&'static str>, Error> {
    const PROCESS: &str = "SELECT pg_backend_pid()";
    let mut listener = PgListener::connect(url).await?;
    let process: i32 = scalar(&mut listener, PROCESS).await?;
    let channel = format!("taskd_probe_{process}");
    listener.listen(&channel).await?;
    // A pooler lends the listener's session to the other connection, or if it has several, another
    // session than before to the listener.
    sqlx::raw_sql("BEGIN").execute(&mut *other).await?;
    let other_process: i32 = scalar(&mut *other, PROCESS).await?;
    let mut has_own_session = other_process != process;
    if has_own_session {
        let process_later: i32 = scalar(&mut listener, PROCESS).await?;
        has_own_session = process_later == process;
    }
    if !has_own_session {
        return Ok(Some(
            "a connection does not keep its session (pg_backend_pid) between transactions",
        ));
    }
    let lock = format!("SELECT pg_try_advisory_lock({LOCK_CLASS}, {process})");
    let is_locked: bool = scalar(&mut listener, &lock).await?;
    let is_locked_twice: bool = scalar(&mut *other, &lock).await?;
    if !is_locked || is_locked_twice {
        return Ok(Some("an advisory lock does not exclude another session"));
    }
    let notify = format!("NOTIFY {channel}; COMMIT");
    sqlx::raw_sql(AssertSqlSafe(notify)).execute(other).await?;
    match timeout(NOTIFICATION_TIMEOUT, listener.recv()).await {
        Ok(received) => received.map(|_| None),
        Err(_) => Ok(Some("a notification (LISTEN, NOTIFY) does not arrive")),
    }
}

/// The only value of the only row.
async fn scalar<'e, DB: Database, T>(
    executor: impl Executor<'e, Database = DB>,
    sql: &str,
) -> Result<T, Error>
where
    T: for<'r> Decode<'r, DB> + Type<DB>,
    usize: ColumnIndex<DB::Row>,
{
    sqlx::raw_sql(AssertSqlSafe(sql)).fetch_one(executor).await?.try_get(0)
}
