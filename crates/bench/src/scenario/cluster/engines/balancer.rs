//! HAProxy in front of the servers, with the settings of examples/cluster, one process for each
//! entrance.

use std::net::Ipv4Addr;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context as _, bail};
use tokio::net::TcpStream;
use tokio::time::Instant;

use super::addresses::Addresses;
use super::node::Node;
use crate::system::process::{Process, Program};

/// Where Debian has the program.
const SYSTEM_DIRECTORY: &str = "/usr/sbin";
const START_TIMEOUT: Duration = Duration::from_secs(20);
const POLL_INTERVAL: Duration = Duration::from_millis(20);

/// A balancer. Dropping it kills the process.
pub struct Balancer {
    program: Program,
    log: PathBuf,
    address: Ipv4Addr,
    port: u16,
    process: Option<Process>,
}

impl Balancer {
    /// The program, if it is installed.
    pub fn program() -> Option<PathBuf> {
        let path = std::env::var_os("PATH").unwrap_or_default();
        let directories = std::env::split_paths(&path).chain([PathBuf::from(SYSTEM_DIRECTORY)]);
        directories.map(|dir| dir.join("haproxy")).find(|path| path.is_file())
    }

    /// Starts the balancer of this number in front of all nodes.
    pub async fn start(
        program: &Path,
        directory: &Path,
        number: usize,
        addresses: &Addresses,
        nodes: &[Node],
    ) -> anyhow::Result<Self> {
        let address = addresses.balancer(number);
        let file = directory.join(format!("haproxy-{number}.cfg"));
        std::fs::write(&file, configuration(address, addresses, nodes)).context("haproxy.cfg")?;
        let program = Program::named(program).args([Path::new("-f"), &file]);
        let log = file.with_extension("log");
        let port = addresses.http(address).port();
        let mut balancer = Self { program, log, address, port, process: None };
        balancer.start_again().await?;
        Ok(balancer)
    }

    pub async fn start_again(&mut self) -> anyhow::Result<()> {
        let mut process = self.program.start(&self.log)?;
        let deadline = Instant::now() + START_TIMEOUT;
        let mut tick = tokio::time::interval(POLL_INTERVAL);
        while TcpStream::connect((self.address, self.port)).await.is_err() {
            if let Some(how) = process.ended() {
                bail!("{how}: {}", std::fs::read_to_string(&self.log).unwrap_or_default().trim());
            }
            if Instant::now() >= deadline {
                bail!("HAProxy accepts no connection within {START_TIMEOUT:?}");
            }
            tick.tick().await;
        }
        self.process = Some(process);
        Ok(())
    }

    pub async fn kill(&mut self) {
        if let Some(process) = self.process.take() {
            process.kill().await;
        }
    }
}

/// As examples/cluster/haproxy.cfg, for servers without TLS. The limit of connections follows from
/// that of open files.
fn configuration(address: Ipv4Addr, addresses: &Addresses, nodes: &[Node]) -> String {
    let servers = |port: fn(&Node) -> std::net::SocketAddr| -> String {
        let line = |node: &Node| format!("    server {} {}\n", node.name, port(node));
        nodes.iter().map(line).collect()
    };
    let (http, mqtt) = (addresses.http(address), addresses.mqtt(address));
    let mqtt_servers = servers(|node| node.mqtt);
    let http_servers = servers(|node| node.http);
    format!(
        "defaults
    mode tcp
    option redispatch
    timeout connect 3s
    timeout client 1h
    timeout server 1h
    option httpchk GET /readyz
    source {address}
    default-server send-proxy-v2 check port {} check-send-proxy
    default-server inter 1s fall 2 rise 1 on-marked-down shutdown-sessions

listen taskd-mqtt
    bind {mqtt}
    balance leastconn
{mqtt_servers}
listen taskd-http
    bind {http}
    balance source
    hash-type consistent
{http_servers}",
        http.port()
    )
}
