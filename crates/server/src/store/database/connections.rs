//! The pool of connections to the database, with time limits for their answers. A connection with a
//! lost or stalled peer would block its user until the kernel gives up, and the writer's connection
//! would block every user. Here such a connection is dropped, and the next user gets another. With
//! it go all others that were open at that moment: after a failover they lead to the wrong server.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use std::{fmt, io};

use futures_util::future::BoxFuture;
use futures_util::stream::{self, BoxStream};
use futures_util::{StreamExt as _, TryStreamExt as _};
use sqlx::any::{Any, AnyQueryResult, AnyRow, AnyStatement, AnyTypeInfo};
use sqlx::{AnyConnection, Connection as _, Either, Error, Execute, Executor, SqlStr};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::timeout;

use super::fault::Fault;
use super::primary::{NewConnection, bounded, connect};
use super::state::DatabaseState;

/// The settings of a connection pool.
pub(in crate::store) struct PoolOptions {
    /// The setting `database`: one URL, or several of Postgres servers.
    pub(in crate::store) url: String,
    /// Statements that prepare a new connection.
    pub(in crate::store) session: String,
    pub(in crate::store) count: u32,
    /// The most connections that [`with_shared_reads`] may use at once.
    pub(in crate::store) shared: u32,
    /// Time limit for each part of a statement's answer.
    pub(in crate::store) answer_timeout: Duration,
    /// Time limit for an idle connection to show that it is alive.
    pub(in crate::store) ping_timeout: Duration,
    /// Time limit for opening a connection to one server.
    pub(in crate::store) connect_timeout: Duration,
    /// Time limit for waiting until a connection in use becomes free.
    pub(in crate::store) acquire_timeout: Duration,
    /// Receives the outcome of statements. No connection is given out before the database is open.
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

/// A pool of connections to one database, each used by one caller at a time. Clones share the pool.
#[derive(Debug, Clone)]
pub(in crate::store) struct ConnectionPool {
    options: Arc<PoolOptions>,
    permits: Arc<Semaphore>,
    shared: Arc<Semaphore>,
    idle: Arc<Mutex<Vec<OpenConnection>>>,
}

#[derive(Debug)]
struct OpenConnection {
    connection: AnyConnection,
    /// [`DatabaseState::losses`] before the connection was opened.
    losses: u64,
}

/// A connection in use. Dropping it cancels unfinished work: a transaction is rolled back before
/// another caller gets the connection.
pub(in crate::store) struct PooledConnection {
    /// `None` once the connection was returned to the pool.
    lease: Option<Lease>,
    options: Arc<PoolOptions>,
    in_transaction: bool,
}

struct Lease {
    open: OpenConnection,
    /// Whether the connection has not failed.
    is_sound: bool,
    idle: Arc<Mutex<Vec<OpenConnection>>>,
    _permit: OwnedSemaphorePermit,
    _shared_permit: Option<OwnedSemaphorePermit>,
}

impl fmt::Debug for PoolOptions {
    /// The URL is left out, because it may hold a password.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("PoolOptions").field("count", &self.count).finish_non_exhaustive()
    }
}

impl ConnectionPool {
    /// Creates an empty pool: no connection is open yet.
    pub(in crate::store) fn new(options: PoolOptions) -> Self {
        let permits = Arc::new(Semaphore::new(options.count as usize));
        let shared = Arc::new(Semaphore::new(options.shared as usize));
        Self { options: Arc::new(options), permits, shared, idle: Arc::default() }
    }

    /// Returns a connection that has just answered.
    pub(in crate::store) async fn acquire(&self) -> Result<PooledConnection, Error> {
        let PoolOptions { ping_timeout, acquire_timeout, ref state, .. } = *self.options;
        if !state.is_open() {
            return Err(Error::Io(io::Error::new(
                io::ErrorKind::NotConnected,
                "the database is not open yet",
            )));
        }
        let shared = match SHARES_READS.try_with(|()| ()) {
            Ok(()) => Some(
                timeout(acquire_timeout, self.shared.clone().acquire_owned())
                    .await
                    .map_err(|_| Error::PoolTimedOut)?,
            ),
            Err(_) => None,
        };
        let shared = shared.transpose().map_err(|_| Error::PoolClosed)?;
        let permit = timeout(acquire_timeout, self.permits.clone().acquire_owned())
            .await
            .map_err(|_| Error::PoolTimedOut)?;
        let permit = permit.map_err(|_| Error::PoolClosed)?;
        let open = loop {
            let Some(mut known) = lock(&self.idle).pop() else {
                break self.connect().await.inspect_err(|error| state.record_error(error))?;
            };
            if known.losses != state.losses() {
                continue;
            }
            match bounded(ping_timeout, known.connection.ping()).await {
                Ok(()) => break known,
                Err(error) => {
                    state.record_loss();
                    tracing::debug!(%error, "dropped a broken database connection");
                }
            }
        };
        state.mark_available();
        let lease = Lease {
            open,
            is_sound: true,
            idle: self.idle.clone(),
            _permit: permit,
            _shared_permit: shared,
        };
        Ok(PooledConnection {
            lease: Some(lease),
            options: self.options.clone(),
            in_transaction: false,
        })
    }

    async fn connect(&self) -> Result<OpenConnection, Error> {
        let PoolOptions { ref url, ref session, connect_timeout, ref state, .. } = *self.options;
        let losses = state.losses();
        let NewConnection { connection, url } = connect(url, session, connect_timeout).await?;
        state.record_server(&url);
        Ok(OpenConnection { connection, losses })
    }

    /// Closes all connections once those in use have come back. No connection is given out any
    /// more.
    pub(in crate::store) async fn close(&self) {
        let all = self.permits.acquire_many(self.options.count).await;
        self.permits.close();
        drop(all);
        let idle = std::mem::take(&mut *lock(&self.idle));
        for OpenConnection { connection, .. } in idle {
            if let Err(error) = bounded(self.options.answer_timeout, connection.close()).await {
                tracing::debug!(%error, "closing a database connection failed");
            }
        }
    }
}

impl PooledConnection {
    /// The connection on which the next statement runs.
    pub(in crate::store) fn connection(&mut self) -> Statement<'_> {
        let lease = self.lease.as_mut().expect("the connection is returned only on drop");
        Statement {
            connection: &mut lease.open.connection,
            is_sound: &mut lease.is_sound,
            options: &self.options,
        }
    }

    /// Begins a transaction with `statements`, of which `BEGIN` is the first.
    pub(in crate::store) async fn begin(&mut self, statements: &'static str) -> Result<(), Error> {
        self.in_transaction = true;
        sqlx::raw_sql(statements).execute(self.connection()).await.map(drop)
    }

    pub(in crate::store) async fn commit(mut self) -> Result<(), Error> {
        sqlx::raw_sql("COMMIT").execute(self.connection()).await?;
        self.in_transaction = false;
        self.options.state.record_commit();
        Ok(())
    }
}

impl Drop for PooledConnection {
    fn drop(&mut self) {
        let Some(mut lease) = self.lease.take() else { return };
        if !self.in_transaction {
            return lease.return_to_pool();
        }
        let answer_timeout = self.options.answer_timeout;
        tokio::spawn(async move {
            if lease.is_sound
                && bounded(
                    answer_timeout,
                    sqlx::raw_sql("ROLLBACK").execute(&mut lease.open.connection),
                )
                .await
                .is_ok()
            {
                lease.return_to_pool();
            }
        });
    }
}

impl Lease {
    /// Makes the connection available to others. A failed connection ends here, and its permit
    /// becomes free.
    fn return_to_pool(self) {
        if self.is_sound {
            lock(&self.idle).push(self.open);
        }
    }
}

/// Runs one statement, and notices when the connection fails.
#[derive(Debug)]
pub(in crate::store) struct Statement<'c> {
    connection: &'c mut AnyConnection,
    is_sound: &'c mut bool,
    options: &'c PoolOptions,
}

impl Statement<'_> {
    /// Records an error. A connection whose database is away is not used again.
    fn failed(options: &PoolOptions, is_sound: &mut bool, error: &Error) {
        options.state.record_error(error);
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
        let Self { connection, is_sound, options } = self;
        let rest = Some((connection.fetch_many(query), is_sound));
        let answers = stream::unfold(rest, move |rest| async move {
            let (mut rows, is_sound) = rest?;
            match bounded(options.answer_timeout, rows.try_next()).await {
                Ok(row) => row.map(|row| (Ok(row), Some((rows, is_sound)))),
                Err(error) => {
                    Self::failed(options, is_sound, &error);
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
            let fetched =
                bounded(self.options.answer_timeout, self.connection.fetch_optional(query)).await;
            fetched.inspect_err(|error| Self::failed(self.options, self.is_sound, error))
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

/// Each statement runs on any free connection, which is in use until all rows have arrived.
impl<'c> Executor<'c> for &'c ConnectionPool {
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
            self.acquire().await?.connection().fetch_many(query).try_collect::<Vec<_>>().await
        };
        stream::once(rows).map_ok(|rows| stream::iter(rows).map(Ok)).try_flatten().boxed()
    }

    fn fetch_optional<'e, 'q: 'e, E>(self, query: E) -> BoxFuture<'e, Result<Option<AnyRow>, Error>>
    where
        'c: 'e,
        E: 'q + Execute<'q, Any>,
    {
        Box::pin(async move { self.acquire().await?.connection().fetch_optional(query).await })
    }

    fn prepare_with<'e>(
        self,
        sql: SqlStr,
        parameters: &'e [AnyTypeInfo],
    ) -> BoxFuture<'e, Result<AnyStatement, Error>>
    where
        'c: 'e,
    {
        Box::pin(
            async move { self.acquire().await?.connection().prepare_with(sql, parameters).await },
        )
    }
}

/// Whether the connection did its part: the database refused a statement, and goes on.
fn is_refusal(error: &Error) -> bool {
    matches!(error, Error::Database(_)) && Fault::of(error) != Some(Fault::Unreachable)
}

fn lock(idle: &Mutex<Vec<OpenConnection>>) -> MutexGuard<'_, Vec<OpenConnection>> {
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
    struct StallingProxy {
        url: String,
        stalled: watch::Sender<()>,
    }

    impl StallingProxy {
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

        async fn one_connection(&self) -> ConnectionPool {
            sqlx::any::install_default_drivers();
            let (short, session) = (
                Duration::from_secs(2),
                "SET idle_in_transaction_session_timeout = '60s'".to_owned(),
            );
            let acquire_timeout = Duration::from_secs(60);
            let (url, connect_timeout, state) =
                (self.url.clone(), acquire_timeout, DatabaseState::unknown());
            state.mark_open();
            let (count, shared, answer_timeout, ping_timeout) = (1, 1, short, short);
            let connections = ConnectionPool::new(PoolOptions {
                url,
                session,
                count,
                shared,
                answer_timeout,
                ping_timeout,
                connect_timeout,
                acquire_timeout,
                state,
            });
            connections.acquire().await.expect("opens");
            connections
        }

        /// Stalls all present connections.
        fn stall(&self) {
            self.stalled.send_replace(());
        }
    }

    async fn answers(connections: &ConnectionPool) -> Result<i32, Error> {
        sqlx::query_scalar("SELECT 1").fetch_one(connections).await
    }

    #[tokio::test]
    async fn silent_connection_is_replaced() {
        let proxy = StallingProxy::start().await;
        let connections = proxy.one_connection().await;

        let mut connection = connections.acquire().await.expect("acquired");
        connection.begin("BEGIN").await.expect("begun");
        proxy.stall();
        let silent =
            sqlx::query("SELECT 1").execute(connection.connection()).await.expect_err("silent");
        assert_eq!(
            silent.to_string(),
            "error communicating with database: the database does not answer"
        );
        drop(connection);
        assert_eq!(answers(&connections).await.expect("another answers"), 1);

        // The user is gone before the failure was noticed.
        let mut connection = connections.acquire().await.expect("acquired");
        connection.begin("BEGIN").await.expect("begun");
        proxy.stall();
        drop(connection);
        assert_eq!(answers(&connections).await.expect("another answers"), 1);

        // An idle connection.
        proxy.stall();
        assert_eq!(answers(&connections).await.expect("another answers"), 1);
    }

    #[tokio::test]
    async fn shared_reads_leave_connections_for_urgent_reads() {
        sqlx::any::install_default_drivers();
        let directory = tempfile::tempdir().expect("a directory");
        let (url, session) =
            (crate::store::sqlite_url(&directory.path().join("database")), String::new());
        let long = Duration::from_secs(60);
        let state = DatabaseState::unknown();
        state.mark_open();
        let (answer_timeout, ping_timeout, connect_timeout, acquire_timeout) =
            (long, long, long, long);
        let options = PoolOptions {
            url,
            session,
            count: 3,
            shared: 1,
            answer_timeout,
            ping_timeout,
            connect_timeout,
            acquire_timeout,
            state,
        };
        let connections = ConnectionPool::new(options);
        let shared = with_shared_reads(connections.acquire()).await.expect("acquired");
        let mut next = Box::pin(with_shared_reads(connections.acquire()));
        assert!(poll!(next.as_mut()).is_pending());
        let urgent = [
            connections.acquire().await.expect("acquired"),
            connections.acquire().await.expect("acquired"),
        ];
        drop(shared);
        next.await.expect("acquired");
        drop(urgent);
    }

    #[tokio::test]
    async fn dropped_transaction_is_rolled_back_and_its_connection_reused() {
        let proxy = StallingProxy::start().await;
        let connections = proxy.one_connection().await;
        let session = async || {
            let pid = sqlx::query_scalar::<_, i32>("SELECT pg_backend_pid()")
                .fetch_one(&connections)
                .await;
            pid.expect("answers")
        };
        let before = session().await;
        let mut connection = connections.acquire().await.expect("acquired");
        connection.begin("BEGIN").await.expect("begun");
        sqlx::query("CREATE TEMPORARY TABLE made (id INT)")
            .execute(connection.connection())
            .await
            .expect("made");
        let refused = sqlx::query("SELECT 1 / 0")
            .execute(connection.connection())
            .await
            .expect_err("refused");
        assert!(is_refusal(&refused), "{refused}");
        drop(connection);
        let made =
            sqlx::query("SELECT * FROM made").execute(&connections).await.expect_err("rolled back");
        assert!(is_refusal(&made), "{made}");
        assert_eq!(session().await, before);

        let mut connection = connections.acquire().await.expect("acquired");
        connection.begin("BEGIN").await.expect("begun");
        sqlx::query("CREATE TEMPORARY TABLE made (id INT)")
            .execute(connection.connection())
            .await
            .expect("made");
        connection.commit().await.expect("committed");
        sqlx::query("SELECT * FROM made").execute(&connections).await.expect("is there");
        assert_eq!(session().await, before);

        connections.close().await;
        assert!(matches!(answers(&connections).await, Err(Error::PoolClosed)));
    }
}
