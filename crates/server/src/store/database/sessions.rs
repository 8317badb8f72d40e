//! The sessions of a store's connections: their settings and time limits on each kind of database.
//! This module runs no statement on a table.

use std::fs::File;
use std::os::unix::fs::OpenOptionsExt as _;
use std::str::FromStr as _;
use std::time::Duration;

use sqlx::sqlite::SqliteConnectOptions;

use super::connections::PoolOptions;
use super::primary::{NewConnection, connect};
use super::state::DatabaseState;
use crate::domain::database_url::is_postgres;

/// Time limit of a statement's wait for a connection or for another process's write.
pub(in crate::store) const CONNECTION_WAIT: Duration = Duration::from_secs(30);
/// The same wait for a connection to Postgres. It is shorter than a request's time limit, so that
/// the client is told why there is no answer.
const POSTGRES_CONNECTION_WAIT: Duration = Duration::from_secs(20);
/// Time limit for connecting to one database server. It is short enough for the client to hear in
/// time that there is no connection.
pub(in crate::store) const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);

/// Creates the file of a new SQLite database, also behind a link, so that only its owner can read
/// it. SQLite gives the files beside it the same mode. A failure is reported later, by the code that
/// opens the file.
pub(in crate::store) fn make_file(url: &str) {
    if !url.contains("mode=rwc") {
        return;
    }
    if let Ok(options) = SqliteConnectOptions::from_str(url) {
        let mut private = File::options();
        private.write(true).create(true).truncate(false).mode(0o600);
        let _ = private.open(options.get_filename());
    }
}

/// Opens a separate connection for work without a time limit. There is one attempt only, so that an
/// error is reported at once.
pub(in crate::store) async fn first_connection(url: &str) -> Result<NewConnection, sqlx::Error> {
    // SQLite does not read its file before the first statement.
    match is_postgres(url) {
        true => connect(url, POSTGRES_SESSION, CONNECT_TIMEOUT).await,
        false => connect(url, SQLITE_SESSION, Duration::MAX).await,
    }
}

/// The pragmas of every SQLite session. FULL: a commit survives a power cut.
pub(in crate::store) const SQLITE_SESSION: &str =
    "PRAGMA journal_mode = WAL; PRAGMA synchronous = FULL; PRAGMA foreign_keys = ON;
     PRAGMA busy_timeout = 30000;";
/// Makes Postgres end, within about six seconds, a session whose server was stopped, or vanished
/// without closing its connection. Such a session may hold the write lock, for which the next write
/// waits, as does a standby. By default Postgres keeps it for hours. Our writes compute between two
/// statements for milliseconds; an order for 10,000 robots for a fraction of a second.
pub(in crate::store) const POSTGRES_SESSION: &str =
    "SET idle_in_transaction_session_timeout = '5s'; SET lock_timeout = '30s';
     SET tcp_keepalives_idle = 2; SET tcp_keepalives_interval = 2; SET tcp_keepalives_count = 2;
     SET tcp_user_timeout = 5000;";
/// Makes Postgres end a statement before the server gives up waiting for its answer.
const POSTGRES_STATEMENT: &str = "SET statement_timeout = '50s';";

/// Makes commits answer before they are on disk.
const POSTGRES_ASYNCHRONOUS: &str = "SET synchronous_commit = off;";
/// Time limit for the answer to a statement on the cluster's own tables. Other servers count this
/// one as lost soon after.
const CLUSTER_ANSWER_TIMEOUT: Duration = Duration::from_secs(8);

/// The settings of a store's connections.
pub(in crate::store) fn pool_options(
    url: &str,
    count: u32,
    shared: u32,
    cache: &str,
    state: &DatabaseState,
) -> PoolOptions {
    let of_file = PoolOptions {
        url: url.to_owned(),
        session: [SQLITE_SESSION, cache].concat(),
        count,
        shared,
        // A file does not stop answering: a slow answer is not a lost connection.
        answer_timeout: Duration::MAX,
        ping_timeout: Duration::MAX,
        connect_timeout: CONNECTION_WAIT,
        acquire_timeout: CONNECTION_WAIT,
        state: state.clone(),
    };
    if !is_postgres(url) {
        return of_file;
    }
    PoolOptions {
        session: [POSTGRES_SESSION, POSTGRES_STATEMENT].concat(),
        answer_timeout: Duration::from_secs(60),
        ping_timeout: Duration::from_secs(5),
        connect_timeout: CONNECT_TIMEOUT,
        acquire_timeout: POSTGRES_CONNECTION_WAIT,
        ..of_file
    }
}

/// The settings of the connection for the cluster's own tables. A crash of the database may lose
/// the last of these writes; the server then writes them again.
pub(in crate::store) fn cluster_pool_options(url: &str, state: &DatabaseState) -> PoolOptions {
    let options = pool_options(url, 1, 1, "", state);
    if !is_postgres(url) {
        return options;
    }
    PoolOptions {
        session: [&options.session, POSTGRES_ASYNCHRONOUS].concat(),
        answer_timeout: CLUSTER_ANSWER_TIMEOUT,
        ..options
    }
}
