//! Several real servers on one Postgres: one serves, a second is refused, and a standby takes over
//! from a server that was killed or stopped.

#![expect(clippy::disallowed_methods, reason = "making a test's database takes SQL")]

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use nix::sys::signal::Signal;
use sqlx::Connection as _;
use tempfile::TempDir;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;

use crate::harness::{Server, eventually, required, write_package};

/// A takeover takes one or two seconds; a busy machine more.
const TAKEOVER_TIMEOUT: Duration = Duration::from_secs(30);

/// A new database, and a directory for the data of its servers.
pub struct Cluster {
    pub directory: TempDir,
    pub database: String,
    /// The URL of a store of packages for servers that serve at the same time.
    pub packages: String,
}

impl Cluster {
    pub async fn new() -> Self {
        sqlx::any::install_default_drivers();
        let server = required("TASKD_TEST_POSTGRES");
        let name = format!("taskd_test_{:016x}", rand::random::<u64>());
        let directory = TempDir::new().expect("a directory");
        let packages = directory.path().join("packages");
        std::fs::create_dir(&packages).expect("a directory");
        let packages = format!("file://{}", packages.display());
        let cluster = Self { directory, database: format!("{server}/postgres"), packages };
        cluster.execute(&format!("CREATE DATABASE {name}")).await;
        Self { database: format!("{server}/{name}"), ..cluster }
    }

    async fn connect(&self) -> sqlx::AnyConnection {
        sqlx::AnyConnection::connect(&self.database).await.expect("the database answers")
    }

    pub async fn execute(&self, sql: &str) {
        let sql = sqlx::AssertSqlSafe(sql.to_owned());
        sqlx::query(sql).execute(&mut self.connect().await).await.expect("executed");
    }

    /// The process ids of the database sessions that hold an advisory lock here.
    async fn lock_holders(&self) -> Vec<i32> {
        let holders = "SELECT pid FROM pg_locks WHERE locktype = 'advisory' AND granted
            AND database = (SELECT oid FROM pg_database WHERE datname = current_database())";
        let query = sqlx::query_scalar(holders);
        query.fetch_all(&mut self.connect().await).await.expect("answers")
    }

    /// A server's own data directory, in which the two for packages are shared.
    pub fn data(&self, name: &str) -> PathBuf {
        let data = self.directory.path().join(name);
        if !data.exists() {
            std::fs::create_dir(&data).expect("a directory");
            for shared in ["blobs", "uploads"] {
                let place = self.directory.path().join("shared").join(shared);
                std::fs::create_dir_all(&place).expect("a directory");
                std::os::unix::fs::symlink(place, data.join(shared)).expect("linked");
            }
        }
        data
    }

    async fn start(&self, name: &str) -> Server {
        Server::start_with(&self.data(name), &[("TASKD_DATABASE", &self.database)]).await
    }

    /// Starts a standby that has the keys of `active`, and waits until it waits.
    async fn start_standby(&self, name: &str, active: &Server) -> Server {
        let data = self.data(name);
        copy_keys(active.data(), &data);
        let standby = Server::start_unready(&data, &self.standby_settings()).await;
        eventually("the standby to wait", async || {
            let readiness = standby.readiness().await?;
            let reason = readiness["database"].as_str()?.to_owned();
            (readiness["status"] == "standby" && reason.ends_with("uses the database"))
                .then_some(())
        })
        .await;
        standby
    }

    fn standby_settings(&self) -> [(&str, &str); 2] {
        [("TASKD_DATABASE", &self.database), ("TASKD_STANDBY", "true")]
    }
}

pub fn copy_keys(from: &Path, to: &Path) {
    for name in ["signing.key", "operator.token"] {
        std::fs::copy(from.join(name), to.join(name)).expect("copied");
    }
}

async fn add_user(server: &Server, name: &str) {
    server.operate(["user", "add", name, "--role", "viewer", "--no-password"]).await;
}

async fn has_user(server: &Server, name: &str) -> bool {
    server.operate(["user", "list"]).await.contains(name)
}

/// Sends the order of a new user and does not wait for the answer.
async fn order_user(server: &Server, name: &str) -> TcpStream {
    let body = format!(r#"{{"name":"{name}","roles":["viewer"]}}"#);
    let order = format!(
        "POST /api/v1/users HTTP/1.1\r\nhost: x\r\nauthorization: Bearer {}\r\n\
         content-type: application/json\r\ncontent-length: {}\r\n\r\n{body}",
        server.operator_token(),
        body.len()
    );
    let mut stream = TcpStream::connect(server.http).await.expect("the kernel accepts");
    stream.write_all(order.as_bytes()).await.expect("the kernel takes it");
    stream
}

#[tokio::test(flavor = "multi_thread")]
async fn second_server_on_a_database_is_refused() {
    let cluster = Cluster::new().await;
    let mut first = cluster.start("a").await;
    let data = cluster.data("b");
    copy_keys(first.data(), &data);
    let (code, log) = Server::start_refused(&data, &[("TASKD_DATABASE", &cluster.database)]).await;
    assert_eq!(code, 1, "{log}");
    let host = std::fs::read_to_string("/proc/sys/kernel/hostname").expect("a name");
    for words in [
        &format!("is in use by server {}-", host.trim()),
        "(since 2",
        "`database`",
        "`standby = true`",
    ] {
        assert!(log.contains(words), "{words}: {log}");
    }
    add_user(&first, "eve").await;
    // A server that has ended leaves the database to the next at once.
    assert_eq!(first.terminate(), Some(0));
    let second = cluster.start("b").await;
    assert!(has_user(&second, "eve").await);
}

#[tokio::test(flavor = "multi_thread")]
async fn standby_takes_over_from_a_killed_server() {
    let cluster = Cluster::new().await;
    let mut active = cluster.start("a").await;
    let mut standby = cluster.start_standby("b", &active).await;
    add_user(&active, "eve").await;
    let package = cluster.directory.path().join("talker");
    write_package(&package, "talker", "1.0.0", "service", "exec sleep 1000\n");
    active.operate(["push", package.to_str().expect("text")]).await;
    let refused = standby.try_operate(["user", "list"]).await;
    let message = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(message.contains("this server is a standby: server "), "{message}");
    let doctor = standby.try_operate(["doctor"]).await;
    let found = String::from_utf8_lossy(&doctor.stdout).into_owned();
    assert!(found.contains("✓ standby") && !found.contains('✗'), "{found}");

    let killed = Instant::now();
    active.kill();
    standby.wait_ready().await;
    let elapsed = killed.elapsed();
    println!("the standby was ready after {elapsed:?}");
    assert!(elapsed < TAKEOVER_TIMEOUT, "{elapsed:?}");
    assert!(has_user(&standby, "eve").await);
    let exported = cluster.directory.path().join("exported");
    standby.operate(["package", "export", "talker", exported.to_str().expect("text")]).await;
    assert!(exported.join("main.sh").exists());
    add_user(&standby, "mallory").await;

    // The other way round, and a standby that waits ends at once.
    let mut next = cluster.start_standby("a", &standby).await;
    assert_eq!(next.terminate(), Some(0));
    assert_eq!(standby.terminate(), Some(0));
}

#[tokio::test(flavor = "multi_thread")]
async fn stopped_server_that_wakes_up_writes_nothing() {
    let cluster = Cluster::new().await;
    let mut active = cluster.start("a").await;
    let standby = cluster.start_standby("b", &active).await;
    let stopped = Instant::now();
    active.signal(Signal::SIGSTOP);
    standby.wait_ready().await;
    let elapsed = stopped.elapsed();
    println!("the standby was ready after {elapsed:?}");
    assert!(elapsed < TAKEOVER_TIMEOUT, "{elapsed:?}");

    // Orders that the stopped server reads when it wakes up.
    let mut orders = Vec::new();
    for number in 0..20 {
        orders.push(order_user(&active, &format!("late-{number}")).await);
    }
    active.signal(Signal::SIGCONT);
    assert_eq!(active.wait_ended().await, 1);
    let log = active.log();
    let last = log.lines().find(|line| line.contains("has taken over the database"));
    assert!(last.is_some_and(|line| line.contains("server ") && line.contains("ERROR")), "{log}");
    assert!(!log.contains("panicked"), "{log}");
    assert!(!has_user(&standby, "late-").await);
    // The same order counts where it is accepted.
    let mut answer = [0; 12];
    order_user(&standby, "late-1").await.read_exact(&mut answer).await.expect("an answer");
    assert_eq!(&answer, b"HTTP/1.1 201");
    assert!(has_user(&standby, "late-1").await);
}

#[tokio::test(flavor = "multi_thread")]
async fn server_with_another_signing_key_does_not_start() {
    let cluster = Cluster::new().await;
    let mut first = cluster.start("a").await;
    let refused = "this server's signing key ";
    let (code, log) = Server::start_refused(&cluster.data("b"), &cluster.standby_settings()).await;
    assert!(code == 1 && log.contains(refused), "{code}: {log}");
    assert_eq!(first.terminate(), Some(0));
    let database = [("TASKD_DATABASE", cluster.database.as_str())];
    let (code, log) = Server::start_refused(&cluster.data("c"), &database).await;
    assert!(code == 1 && log.contains(refused), "{code}: {log}");
    first.restart().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn guard_survives_a_restarted_database_connection() {
    let cluster = Cluster::new().await;
    let mut server = cluster.start("a").await;
    for round in ["first", "second"] {
        let before = cluster.lock_holders().await;
        assert_eq!(before.len(), 1, "{before:?}");
        cluster.execute(&format!("SELECT pg_terminate_backend({})", before[0])).await;
        // Protected by the holder's name alone.
        add_user(&server, round).await;
        eventually("the lock to be held again", async || {
            let holders = cluster.lock_holders().await;
            (holders.len() == 1 && holders != before).then_some(())
        })
        .await;
    }
    assert!(has_user(&server, "first").await && has_user(&server, "second").await);
    assert_eq!(server.terminate(), Some(0));
}
