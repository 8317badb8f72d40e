//! One server of the cluster under measurement, at a fixed address: it can be killed, stopped,
//! paused and started again.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context as _, bail};
use nix::sys::signal::Signal;
use task_proto::trust::token::Token;
use tokio::time::Instant;

use crate::programs::server::Server;
use crate::system::process::{Process, Program, Usage};

/// Time limit for a server to become ready. A busy machine takes long.
const START_TIMEOUT: Duration = Duration::from_secs(60);
const POLL_INTERVAL: Duration = Duration::from_millis(50);
/// Files that all servers share, as far as they exist.
const SHARED: [&str; 5] = ["signing.key", "ca.key", "ca.pem", "broker.secret", "operator.token"];
/// Bytes of the log's end shown when the server does not start.
const LOG_TAIL_BYTES: usize = 2000;

/// A server. Dropping it kills the server.
pub struct Node {
    pub name: String,
    program: Program,
    directory: PathBuf,
    process: Option<Process>,
    pub http: SocketAddr,
    pub mqtt: SocketAddr,
    /// Processor seconds of earlier processes.
    spent_s: f64,
}

impl Node {
    /// The server `name` with its data in `directory`; it is not started yet.
    pub fn new(
        taskd: Program,
        name: &str,
        directory: PathBuf,
        (http, mqtt): (SocketAddr, SocketAddr),
        settings: &[(&str, String)],
    ) -> Self {
        let mut program = taskd
            .args(["serve", "--http", &http.to_string(), "--mqtt", &mqtt.to_string()])
            .args([Path::new("--data"), &directory])
            .variable("TASKD_CLUSTER_NAME", name)
            .variable("TASKD_CLUSTER_URL", &format!("http://{http}"));
        for (name, value) in settings {
            program = program.variable(name, value);
        }
        Self { name: name.to_owned(), program, directory, process: None, http, mqtt, spent_s: 0.0 }
    }

    /// Gives this server the keys of another.
    pub fn copy_keys(&self, first: &Node) -> anyhow::Result<()> {
        std::fs::create_dir_all(&self.directory).context("a server's directory")?;
        for name in SHARED {
            let from = first.directory.join(name);
            if from.exists() {
                std::fs::copy(&from, self.directory.join(name)).with_context(|| name.to_owned())?;
            }
        }
        Ok(())
    }

    /// The first operator's token, once the first server has started.
    pub fn token(&self) -> anyhow::Result<Token> {
        let text = std::fs::read_to_string(self.directory.join("operator.token"));
        text.context("operator.token")?.trim().parse().context("operator.token")
    }

    /// Starts the server; `wait_ready` waits for it.
    pub fn start(&mut self) -> anyhow::Result<()> {
        // The addresses of an earlier start.
        let _ = std::fs::remove_file(self.directory.join("addresses.json"));
        self.process = Some(self.program.start(&self.log())?);
        Ok(())
    }

    /// Waits until the server serves.
    pub async fn wait_ready(&mut self) -> anyhow::Result<Arc<Server>> {
        let deadline = Instant::now() + START_TIMEOUT;
        let mut tick = tokio::time::interval(POLL_INTERVAL);
        loop {
            tick.tick().await;
            if self.directory.join("addresses.json").exists() {
                let base = format!("http://{}", self.http).parse().context("an address")?;
                let server = Server::new(base, &self.token()?, None)?;
                if server.is_ready().await {
                    return Ok(Arc::new(server));
                }
            }
            if let Some(how) = self.process.as_mut().and_then(Process::ended) {
                bail!("{how}: {}", self.log_tail());
            }
            if Instant::now() >= deadline {
                bail!("{} was not ready within {START_TIMEOUT:?}: {}", self.name, self.log_tail());
            }
        }
    }

    pub async fn kill(&mut self) {
        self.spent_s = self.usage().cpu_s;
        if let Some(process) = self.process.take() {
            process.kill().await;
        }
    }

    /// Ends the server in order.
    pub async fn end(&mut self) {
        self.spent_s = self.usage().cpu_s;
        if let Some(process) = self.process.take() {
            process.end().await;
        }
    }

    pub fn pause(&self) {
        self.process.as_ref().map(|process| process.signal(Signal::SIGSTOP));
    }

    pub fn go_on(&self) {
        self.process.as_ref().map(|process| process.signal(Signal::SIGCONT));
    }

    /// How the server ended, if that was not asked of it.
    pub fn ended(&mut self) -> Option<String> {
        let how = self.process.as_mut()?.ended()?;
        self.process = None;
        Some(format!("{}: {how}: {}", self.name, self.log_tail()))
    }

    /// Resources until now, those of earlier processes included.
    pub fn usage(&self) -> Usage {
        let now = self.process.as_ref().map(Process::usage).unwrap_or_default();
        Usage { cpu_s: now.cpu_s + self.spent_s, ..now }
    }

    /// Panics in the log, which no test may overlook.
    pub fn panics(&self) -> usize {
        let log = std::fs::read_to_string(self.log()).unwrap_or_default();
        log.lines().filter(|line| line.contains("panicked at")).count()
    }

    fn log(&self) -> PathBuf {
        self.directory.with_extension("log")
    }

    fn log_tail(&self) -> String {
        let text = std::fs::read_to_string(self.log()).unwrap_or_default();
        let from = text.char_indices().rev().nth(LOG_TAIL_BYTES).map_or(0, |(at, _)| at);
        text[from..].trim().to_owned()
    }
}
