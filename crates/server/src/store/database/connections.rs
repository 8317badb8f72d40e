//! Connections to the database, and how long one may be silent. One whose other end was lost, or
//! that stalls on its way, would keep whoever waits for it, and with the writer everybody, for as
//! long as the kernel hopes; here it is given up, and whoever comes next gets another.

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

/// What the connections of one set have in common.
pub(in crate::store) struct Terms {
    /// The database's URL.
    pub(in crate::store) url: String,
    /// Statements that prepare a new connection.
    pub(in crate::store) session: String,
    /// How many there may be.
    pub(in crate::store) count: u32,
    /// How many of them [`with_shared_reads`] may have at once.
    pub(in crate::store) shared: u32,
    /// How long each part of a statement's answer may take.
    pub(in crate::store) answer: Duration,
    /// How long an idle connection may take to show that it is alive.
    pub(in crate::store) greeting: Duration,
    /// How long a new connection may take.
    pub(in crate::store) connect: Duration,
    /// How long another's connection is waited for to become free.
    pub(in crate::store) wait: Duration,
    /// Where the outcome of statements is noted. Nothing is lent before the database is open.
    pub(in crate::store) state: DatabaseState,
}

tokio::task_local! {
    /// Set where reads are not urgent.
    static SHARES_READS: ();
}

/// Runs what is not urgent: of each set of connections it gets only a part, so that the rest is
/// free for what is. Tasks that it spawns are urgent again.
pub async fn with_shared_reads<F: Future>(future: F) -> F::Output {
    SHARES_READS.scope((), future).await
}

/// A set of connections to one database, each lent to one user at a time. Clones share them.
#[derive(Debug, Clone)]
pub(in crate::store) struct Connections {
    terms: Arc<Terms>,
    places: Arc<Semaphore>,
    shared: Arc<Semaphore>,
    idle: Arc<Mutex<Vec<AnyConnection>>>,
}

/// A connection while it is lent. What it was in the middle of when it is dropped is not done: a
/// transaction is rolled back before anybody else gets the connection.
pub(in crate::store) struct Lent {
    /// `None` once it was given back.
    held: Option<Held>,
    terms: Arc<Terms>,
    in_transaction: bool,
}

struct Held {
    connection: AnyConnection,
    /// It has not failed.
    is_sound: bool,
    idle: Arc<Mutex<Vec<AnyConnection>>>,
    _place: OwnedSemaphorePermit,
    _shared: Option<OwnedSemaphorePermit>,
}

impl fmt::Debug for Terms {
    /// The URL may hold a password.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Terms").field("count", &self.count).finish_non_exhaustive()
    }
}

impl Connections {
    /// None is made yet.
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

    /// Ends all connections, once those that are lent have come back. None is lent any more.
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
    /// Where the next statement runs.
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
    /// Another may have it. One that has failed ends here, and its place is free.
    fn give_back(self) {
        if self.is_sound {
            lock(&self.idle).push(self.connection);
        }
    }
}

/// What runs one statement, and notices when the connection fails.
#[derive(Debug)]
pub(in crate::store) struct Statement<'c> {
    connection: &'c mut AnyConnection,
    is_sound: &'c mut bool,
    terms: &'c Terms,
}

impl Statement<'_> {
    /// Takes note of an error. A connection whose database is away is not used again.
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

/// Statements that each run on whichever connection is free, which is lent until all their rows are
/// there.
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

/// What the database answers, if it does in time.
pub(in crate::store) async fn bounded<T>(
    time: Duration,
    answer: impl Future<Output = Result<T, Error>>,
) -> Result<T, Error> {
    let silent =
        |_| Error::Io(io::Error::new(io::ErrorKind::TimedOut, "the database does not answer"));
    timeout(time, answer).await.map_err(silent)?
}

fn lock(idle: &Mutex<Vec<AnyConnection>>) -> MutexGuard<'_, Vec<AnyConnection>> {
    // A list of connections is sound whatever a panic left.
    idle.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use futures_util::poll;
    use tokio::io::copy_bidirectional;
    use tokio::net::{TcpListener, TcpStream};
    use tokio::sync::watch;

    use super::*;

    /// Something between us and a real Postgres. What is told to stall passes nothing on any more,
    /// and ends nothing either.
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

        /// All connections that are there now.
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

        // Whoever asked is gone before it was noticed.
        let mut lent = connections.lend().await.expect("lent");
        lent.begin().await.expect("begun");
        between.stall();
        drop(lent);
        assert_eq!(answers(&connections).await.expect("another answers"), 1);

        // One that was idle.
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
