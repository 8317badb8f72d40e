//! Opens connections: to a SQLite file, or to the one of several Postgres servers that takes writes.
//! This module keeps no connection.

use std::io;
use std::time::Duration;

use futures_util::StreamExt as _;
use futures_util::stream::FuturesUnordered;
use rustls::CertificateError;
use sqlx::{AnyConnection, AssertSqlSafe, Connection as _, Error, Row as _};
use tokio::time::timeout;

use super::fault::Fault;
use crate::domain::database_url::{is_postgres, root_certificate, servers, without_password};

/// Head start of a server before the next one of the list is tried in parallel, so that a lost host
/// delays nothing by the whole time limit.
const HEAD_START: Duration = Duration::from_millis(500);
/// The beginning of sqlx's error where the other side closes the connection before its first byte,
/// as balancers and poolers without a server do: the zero is that of sqlx's own buffer.
const CLOSED_BEFORE_ANSWER: &str = "unexpected response from SSLRequest: 0x00";
/// Selects why a Postgres server takes no writes; NULL if it does.
const REFUSAL: &str = "SELECT CASE WHEN pg_is_in_recovery() THEN 'the server is a standby'
    WHEN current_setting('transaction_read_only') = 'on' THEN 'the server is read-only' END";

/// A connection that was just opened.
pub(in crate::store) struct NewConnection {
    pub(in crate::store) connection: AnyConnection,
    /// The URL, of those in the setting, that the connection was made to.
    pub(in crate::store) url: String,
}

/// Connects to the SQLite file or to the primary among the Postgres servers of `database`. The
/// servers are tried in their order, each for at most `limit`. `session` are statements that prepare
/// the connection.
pub(in crate::store) async fn connect(
    database: &str,
    session: &str,
    limit: Duration,
) -> Result<NewConnection, Error> {
    let urls = servers(database);
    let mut untried = urls.iter().enumerate();
    let mut tries = FuturesUnordered::new();
    let mut failures = Vec::new();
    loop {
        if let Some((place, &url)) = untried.next() {
            tries.push(async move { (place, url, bounded(limit, connect_to(url, session)).await) });
        }
        let head_start = if untried.len() > 0 { HEAD_START } else { Duration::MAX };
        match timeout(head_start, tries.next()).await {
            Ok(Some((_, url, Ok(connection)))) => {
                return Ok(NewConnection { connection, url: url.to_owned() });
            }
            Ok(Some((place, url, Err(error)))) => failures.push((place, url, error)),
            Ok(None) => return Err(without_primary(failures)),
            // The head start is over.
            Err(_) => {}
        }
    }
}

/// Connects to one server, if it takes writes.
async fn connect_to(url: &str, session: &str) -> Result<AnyConnection, Error> {
    if let Some(file) = root_certificate(url).filter(|root| !root.starts_with("-----BEGIN")) {
        tokio::fs::metadata(&file).await.map_err(|error| {
            Error::Configuration(format!("sslrootcert {file} can't be read: {error}").into())
        })?;
    }
    let mut connection = AnyConnection::connect(url).await.map_err(with_cause)?;
    match prepare(&mut connection, url, session).await {
        Ok(()) => Ok(connection),
        Err(error) => {
            // A SQLite file is closed before it is opened again in another mode.
            let _ = connection.close().await;
            Err(error)
        }
    }
}

async fn prepare(connection: &mut AnyConnection, url: &str, session: &str) -> Result<(), Error> {
    sqlx::raw_sql(AssertSqlSafe(session)).execute(&mut *connection).await?;
    if !is_postgres(url) {
        return Ok(());
    }
    let row = sqlx::raw_sql(REFUSAL).fetch_one(connection).await?;
    match row.try_get::<Option<String>, _>(0)? {
        Some(refusal) => Err(Error::Io(io::Error::new(io::ErrorKind::NotConnected, refusal))),
        None => Ok(()),
    }
}

/// Turns a closed connection into an error of the network, and a refused certificate into one of the
/// settings: waiting mends only the first.
fn with_cause(error: Error) -> Error {
    if let Error::Protocol(text) = &error
        && text.starts_with(CLOSED_BEFORE_ANSWER)
    {
        let text = "the connection was closed before an answer: by a balancer without a server?";
        return Error::Io(io::Error::new(io::ErrorKind::UnexpectedEof, text));
    }
    let Error::Io(failed) = &error else { return error };
    let tls = failed.get_ref().and_then(|source| source.downcast_ref::<rustls::Error>());
    let Some(rustls::Error::InvalidCertificate(found)) = tls else { return error };
    let reason = match found {
        // The second: another authority has the name of a known one.
        CertificateError::UnknownIssuer | CertificateError::BadSignature => {
            "it is signed by no known authority; name the file of its authority with sslrootcert"
                .to_owned()
        }
        found => found.to_string(),
    };
    Error::Tls(format!("the database server's certificate is not accepted: {reason}").into())
}

/// The error for servers none of which takes writes. With several servers the error has the reason
/// of each. It is a passing fault if that of one server is.
fn without_primary(mut failures: Vec<(usize, &str, Error)>) -> Error {
    if failures.len() == 1 {
        return failures.remove(0).2;
    }
    failures.sort_by_key(|&(place, ..)| place);
    let reasons = failures
        .iter()
        .map(|(_, url, error)| format!("{}: {}", without_password(url), Fault::description(error)));
    let text = format!("no server takes writes: {}", reasons.collect::<Vec<_>>().join("; "));
    match failures.iter().any(|(.., error)| Fault::of(error).is_some()) {
        true => Error::Io(io::Error::new(io::ErrorKind::NotConnected, text)),
        false => Error::Configuration(text.into()),
    }
}

/// The database's answer, or an error if the time limit passes first.
pub(in crate::store) async fn bounded<T>(
    time: Duration,
    answer: impl Future<Output = Result<T, Error>>,
) -> Result<T, Error> {
    let silent =
        |_| Error::Io(io::Error::new(io::ErrorKind::TimedOut, "the database does not answer"));
    timeout(time, answer).await.map_err(silent)?
}
