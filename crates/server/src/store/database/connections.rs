//! Connections to the database, with time limits for their answers. A connection with a lost or
//! stalled peer would block its user until the kernel gives up, and the writer's connection would
//! block every user. Here such a connection is dropped, and the next user gets another.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use std::{fmt, io};

use futures_util::future::BoxFuture;
use futures_util::stream::{self, BoxStream};
use futures_util::{StreamExt as _, TryStreamExt as _};
use sqlx::any::{Any, AnyQueryResult, AnyRow, AnyStatement, AnyTypeInfo};
use sqlx::{
    AnyConnection, AssertSqlSafe, Connection as _, Either, Error, Execute, Executor, SqlStr,
};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::timeout;

use super::fault::Fault;
use super::state::DatabaseState;

/// The settings shared by one set of connections.
pub(in crate::store) struct Terms {
    pub(in crate::store) url: String,
    /// Statements that prepare a new connection.
    pub(in crate::store) session: String,
    pub(in crate::store) count: u32,
    /// The most connections that [`with_shared_reads`] may use at once.
    pub(in crate::store) shared: u32,
    /// Time limit for each part of a statement's answer.
    pub(in crate::store) answer: Duration,
    /// Time limit for an idle connection to show that it is alive.
    pub(in crate::store) greeting: Duration,
    /// Time limit for opening a connection.
    pub(in crate::store) connect: Duration,
    /// Time limit for waiting until a connection in use becomes free.
    pub(in crate::store) wait: Duration,
    /// Receives the outcome of statements. No connection is lent before the database is open.
    pub(in crate::store) state: DatabaseState,
}

tokio::task_local! {
    /// Set in tasks without urgent reads.
    static SHARES_READS: ();
}

/// Runs work that is not urgent. This work gets only a part of each set of connections, so that the
/// rest stays free for urgent work. Tasks that it spawns are urgent again.
pub async fn with_shared_reads<F: Future>(future: F) -> F::Output {
    SHARES_READS.scope((), future).await
}

/// A set of connections to one database, each lent to one user at a time. Clones share the set.
#[derive(Debug, Clone)]
pub(in crate::store) struct Connections {
    terms: Arc<Terms>,
    places: Arc<Semaphore>,
    shared: Arc<Semaphore>,
    idle: Arc<Mutex<Vec<AnyConnection>>>,
}

/// A lent connection. Dropping it cancels unfinished work: a transaction is rolled back before
/// another user gets the connection.
pub(in crate::store) struct Lent {
    /// `None` once the connection was given back.
    held: Option<Held>,
    terms: Arc<Terms>,
    in_transaction: bool,
}

struct Held {
    connection: AnyConnection,
    /// Whether the connection has not failed.
    is_sound: bool,
    idle: Arc<Mutex<Vec<AnyConnection>>>,
    _place: OwnedSemaphorePermit,
    _shared: Option<OwnedSemaphorePermit>,
}

impl fmt::Debug for Terms {
    /// The URL is left out, because it may hold a password.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Terms").field("count", &self.count).finish_non_exhaustive()
    }
}

impl Connections {
    /// Creates an empty set: no connection is open yet.
    pub(in crate::store) fn new(terms: Terms) -> Self {
        let places = Arc::new(Semaphore::new(terms.count as usize));
        let shared = Arc::new(Semaphore::new(terms.shared as usize));
        Self { terms: Arc::new(terms), places, shared, idle: Arc::default() }
    }

    /// Lends a connection that has just answered.
    pub(in crate::store) async fn lend(&self) -> Result<Lent, Error> {
        let Terms { greeting, wait, connect, ref state, .. } = *self.terms;
        if !state.is_open() {
            return Err(Error::Io(io::Error::new(
                io::ErrorKind::NotConnected,
                "the database is not open yet",
            )));
        }
        let shared = match SHARES_READS.try_with(|()| ()) {
            Ok(()) => Some(
                timeout(wait, self.shared.clone().acquire_owned())
                    .await
                    .map_err(|_| Error::PoolTimedOut)?,
            ),
            Err(_) => None,
        };
        let shared = shared.transpose().map_err(|_| Error::PoolClosed)?;
        let place = timeout(wait, self.places.clone().acquire_owned())
            .await
            .map_err(|_| Error::PoolTimedOut)?;
        let place = place.map_err(|_| Error::PoolClosed)?;
        let connection = loop {
            let Some(mut known) = lock(&self.idle).pop() else {
                break bounded(connect, self.connect())
                    .await
                    .inspect_err(|error| state.note(error))?;
            };
            match bounded(greeting, known.ping()).await {
                Ok(()) => break known,
                Err(error) => tracing::debug!(%error, "a connection to the database is given up"),
            }
        };
        state.answers();
        let held = Held {
            connection,
            is_sound: true,
            idle: self.idle.clone(),
            _place: place,
            _shared: shared,
        };
        Ok(Lent { held: Some(held), terms: self.terms.clone(), in_transaction: false })
    }

    async fn connect(&self) -> Result<AnyConnection, Error> {
        let mut connection = AnyConnection::connect(&self.terms.url).await?;
        sqlx::raw_sql(AssertSqlSafe(self.terms.session.clone())).execute(&mut connection).await?;
        Ok(connection)
    }

    /// Closes all connections once the lent ones have come back. No connection is lent any more.
    pub(in crate::store) async fn close(&self) {
        let all = self.places.acquire_many(self.terms.count).await;
        self.places.close();
        drop(all);
        let idle = std::mem::take(&mut *lock(&self.idle));
        for connection in idle {
            if let Err(error) = bounded(self.terms.answer, connection.close()).await {
                tracing::debug!(%error, "a connection to the database did not end well");
            }
        }
    }
}

impl Lent {
    /// The connection on which the next statement runs.
    pub(in crate::store) fn connection(&mut self) -> Statement<'_> {
        let held = self.held.as_mut().expect("it is given back when it is dropped");
        Statement {
            connection: &mut held.connection,
            is_sound: &mut held.is_sound,
            terms: &self.terms,
        }
    }

    pub(in crate::store) async fn begin(&mut self) -> Result<(), Error> {
        self.in_transaction = true;
        sqlx::raw_sql("BEGIN").execute(self.connection()).await.map(drop)
    }

    pub(in crate::store) async fn commit(mut self) -> Result<(), Error> {
        sqlx::raw_sql("COMMIT").execute(self.connection()).await?;
        self.in_transaction = false;
        self.terms.state.committed();
        Ok(())
    }
}

impl Drop for Lent {
    fn drop(&mut self) {
        let Some(mut held) = self.held.take() else { return };
        if !self.in_transaction {
            return held.give_back();
        }
        let answer = self.terms.answer;
        tokio::spawn(async move {
            if held.is_sound
                && bounded(answer, sqlx::raw_sql("ROLLBACK").execute(&mut held.connection))
                    .await
                    .is_ok()
            {
                held.give_back();
            }
        });
    }
}

impl Held {
    /// Makes the connection available to others. A failed connection ends here, and its place is
    /// free.
    fn give_back(self) {
        if self.is_sound {
            lock(&self.idle).push(self.connection);
        }
    }
}

/// Runs one statement, and notices when the connection fails.
#[derive(Debug)]
pub(in crate::store) struct Statement<'c> {
    connection: &'c mut AnyConnection,
    is_sound: &'c mut bool,
    terms: &'c Terms,
}

impl Statement<'_> {
    /// Records an error. A connection whose database is away is not used again.
    fn failed(terms: &Terms, is_sound: &mut bool, error: &Error) {
        terms.state.note(error);
        *is_sound &= is_refusal(error);
    }
}

impl<'c> Executor<'c> for Statement<'c> {
    type Database = Any;

    fn fetch_many<'e, 'q: 'e, E>(
        self,
        query: E,
    ) -> BoxStream<'e, Result<Either<AnyQueryResult, AnyRow>, Error>>
    where
        'c: 'e,
        E: 'q + Execute<'q, Any>,
    {
        let Self { connection, is_sound, terms } = self;
        let rest = Some((connection.fetch_many(query), is_sound));
        let answers = stream::unfold(rest, move |rest| async move {
            let (mut rows, is_sound) = rest?;
            match bounded(terms.answer, rows.try_next()).await {
                Ok(row) => row.map(|row| (Ok(row), Some((rows, is_sound)))),
                Err(error) => {
                    Self::failed(terms, is_sound, &error);
                    Some((Err(error), None))
                }
            }
        });
        answers.boxed()
    }

    fn fetch_optional<'e, 'q: 'e, E>(self, query: E) -> BoxFuture<'e, Result<Option<AnyRow>, Error>>
    where
        'c: 'e,
        E: 'q + Execute<'q, Any>,
    {
        Box::pin(async move {
            let fetched = bounded(self.terms.answer, self.connection.fetch_optional(query)).await;
            fetched.inspect_err(|error| Self::failed(self.terms, self.is_sound, error))
        })
    }

    fn prepare_with<'e>(
        self,
        sql: SqlStr,
        parameters: &'e [AnyTypeInfo],
    ) -> BoxFuture<'e, Result<AnyStatement, Error>>
    where
        'c: 'e,
    {
        self.connection.prepare_with(sql, parameters)
    }
}

/// Each statement runs on any free connection, which is lent until all rows have arrived.
impl<'c> Executor<'c> for &'c Connections {
    type Database = Any;

    fn fetch_many<'e, 'q: 'e, E>(
        self,
        query: E,
    ) -> BoxStream<'e, Result<Either<AnyQueryResult, AnyRow>, Error>>
    where
        'c: 'e,
        E: 'q + Execute<'q, Any>,
    {
        let rows = async move {
            self.lend().await?.connection().fetch_many(query).try_collect::<Vec<_>>().await
        };
        stream::once(rows).map_ok(|rows| stream::iter(rows).map(Ok)).try_flatten().boxed()
    }

    fn fetch_optional<'e, 'q: 'e, E>(self, query: E) -> BoxFuture<'e, Result<Option<AnyRow>, Error>>
    where
        'c: 'e,
        E: 'q + Execute<'q, Any>,
    {
        Box::pin(async move { self.lend().await?.connection().fetch_optional(query).await })
    }

    fn prepare_with<'e>(
        self,
        sql: SqlStr,
        parameters: &'e [AnyTypeInfo],
    ) -> BoxFuture<'e, Result<AnyStatement, Error>>
    where
        'c: 'e,
    {
        Box::pin(async move { self.lend().await?.connection().prepare_with(sql, parameters).await })
    }
}

/// Whether the connection did its part: the database refused a statement, and goes on.
fn is_refusal(error: &Error) -> bool {
    matches!(error, Error::Database(_)) && Fault::of(error) != Some(Fault::Away)
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

fn lock(idle: &Mutex<Vec<AnyConnection>>) -> MutexGuard<'_, Vec<AnyConnection>> {
    // A list of connections is sound after a panic elsewhere.
    idle.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use futures_util::poll;
    use tokio::io::copy_bidirectional;
    use tokio::net::{TcpListener, TcpStream};
    use tokio::sync::watch;

    use super::*;

    /// A proxy in front of a real Postgres. A stalled connection passes nothing on, and is not
    /// closed either.
    struct Between {
        url: String,
        stalled: watch::Sender<()>,
    }

    impl Between {
        async fn start() -> Self {
            let server =
                std::env::var("TASKD_TEST_POSTGRES").expect("run the tests with ./scripts/test");
            let (scheme, host) = server.rsplit_once('@').expect("postgres://user@host:port");
            let (host, listener) =
                (host.to_owned(), TcpListener::bind("127.0.0.1:0").await.expect("a port"));
            let url = format!("{scheme}@{}/postgres", listener.local_addr().expect("bound"));
            let (stalled, known) = watch::channel(());
            tokio::spawn(async move {
                while let Ok((mut near, _)) = listener.accept().await {
                    let (mut stalled, host) = (known.clone(), host.clone());
                    stalled.mark_unchanged();
                    tokio::spawn(async move {
                        let mut far =
                            TcpStream::connect(host).await.expect("the test server answers");
                        tokio::select! {
                            _ = copy_bidirectional(&mut near, &mut far) => return,
                            _ = stalled.changed() => {}
                        }
                        // Both stay open until the test is over.
                        while stalled.changed().await.is_ok() {}
                    });
                }
            });
            Self { url, stalled }
        }

        async fn one_connection(&self) -> Connections {
            sqlx::any::install_default_drivers();
            let (few, session) = (
                Duration::from_secs(2),
                "SET idle_in_transaction_session_timeout = '60s'".to_owned(),
            );
            let wait = Duration::from_secs(60);
            let (url, connect, state) = (self.url.clone(), wait, DatabaseState::unknown());
            state.opened();
            let (count, shared, answer, greeting) = (1, 1, few, few);
            let connections = Connections::new(Terms {
                url,
                session,
                count,
                shared,
                answer,
                greeting,
                connect,
                wait,
                state,
            });
            connections.lend().await.expect("opens");
            connections
        }

        /// Stalls all present connections.
        fn stall(&self) {
            self.stalled.send_replace(());
        }
    }

    async fn answers(connections: &Connections) -> Result<i32, Error> {
        sqlx::query_scalar("SELECT 1").fetch_one(connections).await
    }

    #[tokio::test]
    async fn a_connection_that_falls_silent_is_given_up() {
        let between = Between::start().await;
        let connections = between.one_connection().await;

        let mut lent = connections.lend().await.expect("lent");
        lent.begin().await.expect("begun");
        between.stall();
        let silent = sqlx::query("SELECT 1").execute(lent.connection()).await.expect_err("silent");
        assert_eq!(
            silent.to_string(),
            "error communicating with database: the database does not answer"
        );
        drop(lent);
        assert_eq!(answers(&connections).await.expect("another answers"), 1);

        // The user is gone before the failure was noticed.
        let mut lent = connections.lend().await.expect("lent");
        lent.begin().await.expect("begun");
        between.stall();
        drop(lent);
        assert_eq!(answers(&connections).await.expect("another answers"), 1);

        // An idle connection.
        between.stall();
        assert_eq!(answers(&connections).await.expect("another answers"), 1);
    }

    #[tokio::test]
    async fn shared_reads_leave_connections_to_urgent_ones() {
        sqlx::any::install_default_drivers();
        let directory = tempfile::tempdir().expect("a directory");
        let (url, session) =
            (crate::store::sqlite_url(&directory.path().join("database")), String::new());
        let long = Duration::from_secs(60);
        let state = DatabaseState::unknown();
        state.opened();
        let (answer, greeting, connect, wait) = (long, long, long, long);
        let terms =
            Terms { url, session, count: 3, shared: 1, answer, greeting, connect, wait, state };
        let connections = Connections::new(terms);
        let shared = with_shared_reads(connections.lend()).await.expect("lent");
        let mut next = Box::pin(with_shared_reads(connections.lend()));
        assert!(poll!(next.as_mut()).is_pending());
        let urgent =
            [connections.lend().await.expect("lent"), connections.lend().await.expect("lent")];
        drop(shared);
        next.await.expect("lent");
        drop(urgent);
    }

    #[tokio::test]
    async fn a_transaction_that_is_dropped_is_rolled_back_and_its_connection_used_again() {
        let between = Between::start().await;
        let connections = between.one_connection().await;
        let session = async || {
            let pid = sqlx::query_scalar::<_, i32>("SELECT pg_backend_pid()")
                .fetch_one(&connections)
                .await;
            pid.expect("answers")
        };
        let before = session().await;
        let mut lent = connections.lend().await.expect("lent");
        lent.begin().await.expect("begun");
        sqlx::query("CREATE TEMPORARY TABLE made (id INT)")
            .execute(lent.connection())
            .await
            .expect("made");
        let refused =
            sqlx::query("SELECT 1 / 0").execute(lent.connection()).await.expect_err("refused");
        assert!(is_refusal(&refused), "{refused}");
        drop(lent);
        let made =
            sqlx::query("SELECT * FROM made").execute(&connections).await.expect_err("rolled back");
        assert!(is_refusal(&made), "{made}");
        assert_eq!(session().await, before);

        let mut lent = connections.lend().await.expect("lent");
        lent.begin().await.expect("begun");
        sqlx::query("CREATE TEMPORARY TABLE made (id INT)")
            .execute(lent.connection())
            .await
            .expect("made");
        lent.commit().await.expect("committed");
        sqlx::query("SELECT * FROM made").execute(&connections).await.expect("is there");
        assert_eq!(session().await, before);

        connections.close().await;
        assert!(matches!(answers(&connections).await, Err(Error::PoolClosed)));
    }
}
