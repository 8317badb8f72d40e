//! A PostgreSQL of the run's own: a primary, and a synchronous standby that can be promoted. It
//! refuses to run as root, so root starts it as the account `postgres`.

use std::net::Ipv4Addr;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context as _, bail};
use nix::sys::signal::Signal;
use tokio::net::TcpStream;
use tokio::time::Instant;

use super::addresses::free_ports;
use crate::system::process::{Process, Program, Usage};

/// Where Debian has the programs of each version.
const VERSIONS: &str = "/usr/lib/postgresql";
const ACCOUNT: &str = "postgres";
/// The database of the servers.
pub const DATABASE: &str = "taskd";
/// Time limit for a server to accept connections.
const START_TIMEOUT: Duration = Duration::from_secs(60);
const POLL_INTERVAL: Duration = Duration::from_millis(50);
/// Connections of all servers together, with those of the run.
const CONNECTIONS: u32 = 200;

/// A running server. Dropping it kills the server.
pub struct Postgres {
    process: Option<Process>,
    programs: PathBuf,
    directory: PathBuf,
    pub port: u16,
    /// Processor seconds of an earlier process.
    spent_s: f64,
}

impl Postgres {
    /// Makes a new database server in `parent`, which only this account may enter.
    pub async fn primary(parent: &Path) -> anyhow::Result<Self> {
        let programs = programs()?;
        let directory = parent.join("primary");
        own(parent).await?;
        let options = ["-U", ACCOUNT, "-A", "trust", "--no-sync", "-E", "UTF8", "--locale=C", "-D"];
        let init = Program::named(programs.join("initdb")).args(options).args([&directory]);
        as_account(init).output().await.context("initdb")?;
        let primary = Self::start(programs, directory).await?;
        let create = Program::named(primary.programs.join("createdb"));
        let create = create.args(["-h", "127.0.0.1", "-U", ACCOUNT, "-p"]);
        let create = create.args([primary.port.to_string()]).args([DATABASE]);
        create.output().await.context("createdb")?;
        Ok(primary)
    }

    /// A copy of this server that follows it.
    pub async fn standby(&self) -> anyhow::Result<Self> {
        let directory = self.directory.with_file_name("standby");
        let from = format!("host=127.0.0.1 port={} user={ACCOUNT}", self.port);
        let copy = Program::named(self.programs.join("pg_basebackup"))
            .args(["-R", "--checkpoint=fast", "--no-sync", "-d", &from, "-D"])
            .args([&directory]);
        as_account(copy).output().await.context("pg_basebackup")?;
        Self::start(self.programs.clone(), directory).await
    }

    async fn start(programs: PathBuf, directory: PathBuf) -> anyhow::Result<Self> {
        let [port] = free_ports(Ipv4Addr::LOCALHOST)?;
        let program = Program::named(programs.join("postgres"))
            .args(["-c", "listen_addresses=127.0.0.1", "-c", "unix_socket_directories="])
            .args(["-c", &format!("port={port}"), "-c", &format!("max_connections={CONNECTIONS}")])
            .args([Path::new("-D"), &directory]);
        let log = directory.with_extension("log");
        let mut process = as_account(program).start(&log)?;
        let deadline = Instant::now() + START_TIMEOUT;
        let mut tick = tokio::time::interval(POLL_INTERVAL);
        let is_ready = Program::named(programs.join("pg_isready"));
        let is_ready = is_ready.args(["-q", "-h", "127.0.0.1", "-p", &port.to_string()]);
        loop {
            tick.tick().await;
            if TcpStream::connect((Ipv4Addr::LOCALHOST, port)).await.is_ok()
                && is_ready.output().await.is_ok()
            {
                return Ok(Self {
                    process: Some(process),
                    programs,
                    directory,
                    port,
                    spent_s: 0.0,
                });
            }
            let log = || std::fs::read_to_string(&log).unwrap_or_default().trim().to_owned();
            if let Some(how) = process.ended() {
                bail!("{how}: {}", log());
            }
            if Instant::now() >= deadline {
                bail!("Postgres was not ready within {START_TIMEOUT:?}: {}", log());
            }
        }
    }

    /// The URL of the servers' database, through `port`.
    pub fn url_at(port: u16) -> String {
        format!("postgres://{ACCOUNT}@127.0.0.1:{port}/{DATABASE}")
    }

    /// Kills the server: its own processes end with it.
    pub async fn kill(&mut self) {
        self.spent_s = self.usage().cpu_s;
        if let Some(process) = self.process.take() {
            process.kill().await;
        }
    }

    /// Resources of the server and its processes until now.
    pub fn usage(&self) -> Usage {
        let now = self.process.as_ref().map(Process::family_usage).unwrap_or_default();
        Usage { cpu_s: now.cpu_s + self.spent_s, ..now }
    }

    /// Ends the server at once: its data is not needed any more.
    pub async fn end(mut self) {
        if let Some(process) = self.process.take() {
            process.signal(Signal::SIGQUIT);
            process.end().await;
        }
    }
}

/// The directory of the newest installed version's programs, or the one in the `PATH`.
fn programs() -> anyhow::Result<PathBuf> {
    let versions = std::fs::read_dir(VERSIONS).into_iter().flatten().flatten();
    let version = |path: &Path| path.file_name()?.to_str()?.parse::<u32>().ok();
    let newest = versions.map(|entry| entry.path()).filter(|path| version(path).is_some());
    let newest = newest.max_by_key(|path| version(path)).map(|path| path.join("bin"));
    let path = std::env::var_os("PATH").unwrap_or_default();
    let in_path = std::env::split_paths(&path).collect::<Vec<_>>();
    let found = newest.into_iter().chain(in_path).find(|dir| dir.join("initdb").is_file());
    found.with_context(|| {
        format!("PostgreSQL is not installed: there is no {VERSIONS}/*/bin/initdb and no initdb in the PATH")
    })
}

/// The program under an account that Postgres accepts. It still dies with this process.
fn as_account(program: Program) -> Program {
    if !nix::unistd::geteuid().is_root() {
        return program;
    }
    let other = ["--reuid", ACCOUNT, "--regid", ACCOUNT, "--init-groups", "--pdeathsig", "KILL"];
    program.within(Program::named("setpriv").args(other))
}

/// Gives the directory to the account.
async fn own(directory: &Path) -> anyhow::Result<()> {
    if nix::unistd::geteuid().is_root() {
        let own = Program::named("chown").args([Path::new(ACCOUNT), directory]);
        own.output().await.context("the database's directory")?;
    }
    Ok(())
}
