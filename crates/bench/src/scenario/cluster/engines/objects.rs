//! The common store of packages: a directory, or two S3 servers (versitygw) over one directory with
//! a relay in front.

use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context as _, bail};
use tokio::net::TcpStream;
use tokio::time::Instant;

use super::addresses::free_ports;
use super::relay::Relay;
use crate::system::process::{Process, Program};

const BUCKET: &str = "taskd";
const ACCESS: &str = "taskbench";
const SECRET: &str = "of-this-run";
const REGION: &str = "us-east-1";
const START_TIMEOUT: Duration = Duration::from_secs(20);
const POLL_INTERVAL: Duration = Duration::from_millis(20);

/// The store. Dropping it ends its servers.
pub struct Objects {
    /// The value of `blobs.store`.
    pub url: String,
    /// The directory with the objects.
    pub directory: PathBuf,
    servers: Vec<Gateway>,
    _relay: Option<Relay>,
}

struct Gateway {
    program: Program,
    log: PathBuf,
    port: u16,
    process: Option<Process>,
}

impl Objects {
    /// A shared directory.
    pub fn directory(parent: &Path) -> anyhow::Result<Self> {
        let directory = parent.join("packages");
        std::fs::create_dir(&directory).context("the directory of packages")?;
        let url = format!("file://{}", directory.display());
        Ok(Self { url, directory, servers: Vec::new(), _relay: None })
    }

    /// Two gateways over one directory.
    pub async fn gateways(program: &Path, parent: &Path) -> anyhow::Result<Self> {
        let buckets = parent.join("buckets");
        let directory = buckets.join(BUCKET);
        std::fs::create_dir_all(&directory).context("the directory of packages")?;
        let credentials = parent.join("s3.key");
        let keys = format!("aws_access_key_id = {ACCESS}\naws_secret_access_key = {SECRET}\n");
        std::fs::write(&credentials, keys).context("the key of the store")?;
        let ports: [u16; 2] = free_ports(Ipv4Addr::LOCALHOST)?;
        let mut servers = Vec::new();
        for port in ports {
            let program = Program::named(program)
                .args(["--access", ACCESS, "--secret", SECRET, "--region", REGION])
                .args(["--port", &format!("127.0.0.1:{port}"), "--quiet", "posix"])
                .args([&buckets]);
            let log = parent.join(format!("versitygw-{port}.log"));
            let mut gateway = Gateway { program, log, port, process: None };
            gateway.start().await?;
            servers.push(gateway);
        }
        let target = |port: u16| SocketAddr::from((Ipv4Addr::LOCALHOST, port));
        let relay = Relay::start(ports.map(target).to_vec()).await?;
        let url = format!(
            "s3://{BUCKET}?endpoint=http://127.0.0.1:{}&region={REGION}&credentials={}",
            relay.port,
            credentials.display()
        );
        Ok(Self { url, directory, servers, _relay: Some(relay) })
    }

    /// Kills the first gateway, which has all connections.
    pub async fn kill_one(&mut self) -> anyhow::Result<()> {
        let gateway = self.servers.first_mut().context("F5 needs --versitygw")?;
        if let Some(process) = gateway.process.take() {
            process.kill().await;
        }
        Ok(())
    }

    pub async fn start_again(&mut self) -> anyhow::Result<()> {
        for gateway in self.servers.iter_mut().filter(|gateway| gateway.process.is_none()) {
            gateway.start().await?;
        }
        Ok(())
    }
}

impl Gateway {
    async fn start(&mut self) -> anyhow::Result<()> {
        let mut process = self.program.start(&self.log)?;
        let deadline = Instant::now() + START_TIMEOUT;
        let mut tick = tokio::time::interval(POLL_INTERVAL);
        while TcpStream::connect((Ipv4Addr::LOCALHOST, self.port)).await.is_err() {
            if let Some(how) = process.ended() {
                bail!("{how}: {}", std::fs::read_to_string(&self.log).unwrap_or_default().trim());
            }
            if Instant::now() >= deadline {
                bail!("versitygw accepts no connection within {START_TIMEOUT:?}");
            }
            tick.tick().await;
        }
        self.process = Some(process);
        Ok(())
    }
}
