//! A real `taskd serve` as a child, with its own directory, on free ports. The child is ended by
//! its pid, and its directory is removed with the child.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context as _, bail};
use clap::Args;
use reqwest::Url;
use serde::Deserialize;
use task_proto::CaPin;
use task_proto::trust::token::Token;
use tempfile::TempDir;
use tokio::time::Instant;

use crate::programs::server::Server;
use crate::system::process::{Process, Program, Usage};

/// Time limit for the server to become ready.
const START_TIMEOUT: Duration = Duration::from_secs(60);
/// Poll interval for readiness, and for memory afterwards.
const POLL_INTERVAL: Duration = Duration::from_millis(20);
/// Bytes of the log's end shown when the server does not start.
const LOG_TAIL_BYTES: usize = 2000;

/// Which server to measure.
#[derive(Debug, Clone, Args)]
pub struct TaskdFlags {
    /// The taskd to measure [default: the one beside taskbench; build both with cargo build
    /// --release --bins]
    #[arg(long, value_name = "PATH")]
    pub taskd: Option<PathBuf>,
    /// Where servers have their data; a disk, because they sync to it [default: the system's
    /// temporary directory]
    #[arg(long, value_name = "DIR")]
    pub data: Option<PathBuf>,
}

/// Start options of a server.
#[derive(Debug, Clone)]
pub struct TaskdArgs {
    /// The address of both listeners.
    pub listen: IpAddr,
    /// The configuration file's text.
    pub configuration: String,
    pub settings: Vec<(String, String)>,
}

impl TaskdArgs {
    /// The same options with encryption.
    pub fn encrypted(mut self) -> Self {
        self.settings.push(("TASKD_TLS_PRIVATE_CA".to_owned(), "true".to_owned()));
        self
    }
}

impl Default for TaskdArgs {
    fn default() -> Self {
        // A fleet under measurement enrolls all at once.
        let settings = vec![("TASKD_ENROLMENT_PER_MINUTE".to_owned(), "1000000".to_owned())];
        Self { listen: Ipv4Addr::LOCALHOST.into(), configuration: String::new(), settings }
    }
}

/// A running server. Dropping the handle kills the server.
pub struct Taskd {
    process: Process,
    program: Program,
    dir: TempDir,
    /// Address of the HTTP listener.
    pub http: SocketAddr,
    /// Address of the MQTT listener.
    pub mqtt: SocketAddr,
    /// Pin of the server's certificate authority; `None` without encryption.
    pub pin: Option<CaPin>,
    pub token: Token,
    /// Its API, as the operator.
    pub server: Server,
    pub version: String,
}

#[derive(Deserialize)]
struct Addresses {
    http: SocketAddr,
    mqtt: SocketAddr,
    ca_pin: Option<CaPin>,
}

impl Taskd {
    /// Starts a server and waits until it is ready.
    pub async fn start(flags: &TaskdFlags, order: &TaskdArgs) -> anyhow::Result<Self> {
        let mut builder = tempfile::Builder::new();
        builder.prefix("taskbench-");
        let dir = match &flags.data {
            Some(dir) => {
                builder.tempdir_in(dir).with_context(|| format!("--data {}", dir.display()))?
            }
            None => builder.tempdir().context("a temporary directory")?,
        };
        let data = dir.path().join("data");
        let configuration = dir.path().join("taskd.toml");
        std::fs::write(&configuration, &order.configuration)
            .context("the server's configuration file")?;
        let any = SocketAddr::new(order.listen, 0).to_string();
        let mut program = Program::beside("taskd", flags.taskd.as_deref())?
            .args(["serve", "--http", &any, "--mqtt", &any]);
        program = program.args([Path::new("--data"), &data, Path::new("--config"), &configuration]);
        for (name, value) in &order.settings {
            program = program.variable(name, value);
        }
        Self::launch(program, dir).await
    }

    /// Ends the server and starts a new process on the same data, with empty memory and different
    /// ports.
    pub async fn restart(self) -> anyhow::Result<Self> {
        let Self { process, program, dir, .. } = self;
        process.end().await;
        Self::launch(program, dir).await
    }

    async fn launch(program: Program, dir: TempDir) -> anyhow::Result<Self> {
        let data = dir.path().join("data");
        let log = dir.path().join("taskd.log");
        let addresses = data.join("addresses.json");
        // The addresses of an earlier start.
        let _ = std::fs::remove_file(&addresses);
        let mut process = program.start(&log)?;
        let Addresses { http, mqtt, ca_pin: pin } =
            wait_for_addresses(&mut process, &addresses, &log).await?;
        let token = std::fs::read_to_string(data.join("operator.token"))
            .context("the server's operator.token")?;
        let token: Token = token.trim().parse().context("the server's operator.token")?;
        let base: Url = url(http, pin).parse().context("the server's address")?;
        let server = Server::new(base, &token, pin)?;
        let version = server.info().await.context("the server does not answer")?.version;
        Ok(Self { process, program, dir, http, mqtt, pin, token, server, version })
    }

    pub fn url(&self) -> String {
        url(self.http, self.pin)
    }

    /// Directory of the server's blobs, each named by the hexadecimal digits of its digest.
    pub fn blobs(&self) -> PathBuf {
        self.dir.path().join("data/blobs/sha256")
    }

    /// The server's directory, for further files of a scenario.
    pub fn dir(&self) -> &Path {
        self.dir.path()
    }

    /// Resource usage of the server until now.
    pub fn usage(&self) -> Usage {
        self.process.usage()
    }

    /// Begins to watch the server's memory; the returned watch ends the sampling.
    pub fn watch_memory(&self) -> PeakMemory {
        let pid = self.process.pid();
        let (stop, mut stopped) = tokio::sync::oneshot::channel();
        let watching = tokio::spawn(async move {
            let mut most = Usage::default();
            let mut tick = tokio::time::interval(POLL_INTERVAL);
            loop {
                tokio::select! {
                    _ = tick.tick() => {}
                    _ = &mut stopped => return most,
                }
                let now = pid.and_then(Usage::of).unwrap_or_default();
                most.anonymous_bytes = most.anonymous_bytes.max(now.anonymous_bytes);
                most.resident_bytes = most.resident_bytes.max(now.resident_bytes);
            }
        });
        PeakMemory { stop, watching }
    }

    /// Why the server ended; `None` while the server runs.
    pub fn ended(&mut self) -> Option<String> {
        let how = self.process.ended()?;
        Some(format!("{how}: {}", tail(&self.dir.path().join("taskd.log"))))
    }

    /// Ends the server gracefully and removes its directory.
    pub async fn end(self) -> anyhow::Result<()> {
        self.process.end().await;
        self.dir.close().context("the server's directory can't be removed")
    }
}

/// Samples a server's memory and keeps the maximum.
pub struct PeakMemory {
    stop: tokio::sync::oneshot::Sender<()>,
    watching: tokio::task::JoinHandle<Usage>,
}

impl PeakMemory {
    /// The maximum seen of each kind of memory.
    pub async fn peak(self) -> Usage {
        let _ = self.stop.send(());
        self.watching.await.unwrap_or_default()
    }
}

fn url(http: SocketAddr, pin: Option<CaPin>) -> String {
    let scheme = if pin.is_some() { "https" } else { "http" };
    format!("{scheme}://{http}")
}

async fn wait_for_addresses(
    process: &mut Process,
    path: &Path,
    log: &Path,
) -> anyhow::Result<Addresses> {
    let deadline = Instant::now() + START_TIMEOUT;
    let mut tick = tokio::time::interval(POLL_INTERVAL);
    loop {
        tick.tick().await;
        if let Some(addresses) =
            std::fs::read(path).ok().and_then(|bytes| serde_json::from_slice(&bytes).ok())
        {
            return Ok(addresses);
        }
        if let Some(how) = process.ended() {
            bail!("{how}: {}", tail(log));
        }
        if Instant::now() >= deadline {
            bail!("taskd was not ready within {START_TIMEOUT:?}: {}", tail(log));
        }
    }
}

/// The end of a log.
fn tail(log: &Path) -> String {
    let text = String::from_utf8_lossy(&std::fs::read(log).unwrap_or_default()).into_owned();
    let from = text.char_indices().rev().nth(LOG_TAIL_BYTES).map_or(0, |(at, _)| at);
    text[from..].trim().to_owned()
}
