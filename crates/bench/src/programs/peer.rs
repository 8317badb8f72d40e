//! The programs that taskd is compared with, in their fastest settings. If a program is not
//! installed, the run says so and goes on without the program.

use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context as _, bail};
use task_proto::CaPin;
use tokio::net::{TcpListener, TcpStream};
use tokio::time::Instant;

use crate::programs::encryption::Certificate;
use crate::system::process::{Process, Program, Usage};

/// Directories of programs outside an ordinary user's `PATH`.
const SYSTEM_DIRECTORIES: [&str; 2] = ["/usr/sbin", "/usr/local/sbin"];
/// Time limit for a program to accept connections.
const START_TIMEOUT: Duration = Duration::from_secs(20);
/// Interval between connection attempts.
const POLL_INTERVAL: Duration = Duration::from_millis(20);

/// A running program. Dropping the handle kills the program.
pub struct Peer {
    process: Process,
    /// The address the program listens on.
    pub address: SocketAddr,
    /// Pin of the certificate's authority; `None` without encryption.
    pub pin: Option<CaPin>,
    pub version: String,
}

impl Peer {
    /// nginx, which serves the files in `root`, with OpenSSL if a certificate is given. `None` if
    /// nginx is not installed.
    pub async fn nginx(
        dir: &Path,
        root: &Path,
        certificate: Option<&Certificate>,
    ) -> anyhow::Result<Option<Self>> {
        let Some(path) = find("nginx") else { return Ok(None) };
        let address = free_address().await?;
        let workers = std::thread::available_parallelism().map_or(1, usize::from);
        let prefix = dir.join("nginx");
        std::fs::create_dir_all(&prefix).context("nginx's directory")?;
        let tls = match certificate {
            Some(certificate) => {
                std::fs::write(prefix.join("nginx.pem"), &certificate.chain)
                    .context("nginx's certificate")?;
                std::fs::write(prefix.join("nginx.key"), &certificate.key)
                    .context("nginx's key")?;
                "ssl_certificate nginx.pem; ssl_certificate_key nginx.key; ssl_protocols TLSv1.3;"
            }
            None => "",
        };
        let ssl = if certificate.is_some() { "ssl" } else { "" };
        let configuration = format!(
            "daemon off; user root; worker_processes {workers}; pid nginx.pid; error_log error.log crit;
             worker_rlimit_nofile 20000;
             events {{ worker_connections 8192; multi_accept on; }}
             http {{
                 access_log off; etag on; sendfile on; sendfile_max_chunk 0; tcp_nopush on; tcp_nodelay on;
                 keepalive_requests 1000000000; open_file_cache max=1000 inactive=600s; open_file_cache_valid 600s;
                 default_type application/octet-stream;
                 client_body_temp_path .; proxy_temp_path .; fastcgi_temp_path .; uwsgi_temp_path .; scgi_temp_path .;
                 server {{ listen {address} {ssl} backlog=4096; {tls} root {}; }}
             }}\n",
            root.display()
        );
        let file = prefix.join("nginx.conf");
        std::fs::write(&file, configuration).context("nginx's configuration")?;
        let program = Program::named(path).args([Path::new("-p"), &prefix, Path::new("-c"), &file]);
        // nginx prints its version on stderr; the relevant version is that of the Debian package or
        // the upstream release.
        let nginx = Self::start(program, &dir.join("nginx.log"), address, "nginx").await?;
        Ok(Some(Self { pin: certificate.map(|certificate| certificate.pin), ..nginx }))
    }

    /// mosquitto, without authentication and without limits. `None` if mosquitto is not installed.
    pub async fn mosquitto(dir: &Path) -> anyhow::Result<Option<Self>> {
        let Some(path) = find("mosquitto") else { return Ok(None) };
        let address = free_address().await?;
        let configuration = format!(
            "listener {} {}\nallow_anonymous true\nmax_connections -1\nmax_inflight_messages 0\nmax_queued_messages 0\n\
             set_tcp_nodelay true\nlog_type error\npersistence false\n",
            address.port(),
            address.ip()
        );
        let file = dir.join("mosquitto.conf");
        std::fs::write(&file, configuration).context("mosquitto's configuration")?;
        let program = Program::named(path).args([Path::new("-c"), &file]);
        Self::start(program, &dir.join("mosquitto.log"), address, "mosquitto").await.map(Some)
    }

    async fn start(
        program: Program,
        log: &Path,
        address: SocketAddr,
        name: &str,
    ) -> anyhow::Result<Self> {
        let mut process = program.start(log)?;
        let deadline = Instant::now() + START_TIMEOUT;
        let mut tick = tokio::time::interval(POLL_INTERVAL);
        loop {
            tick.tick().await;
            if TcpStream::connect(address).await.is_ok() {
                return Ok(Self { process, address, pin: None, version: version(name).await });
            }
            if let Some(how) = process.ended() {
                bail!("{how}: {}", std::fs::read_to_string(log).unwrap_or_default().trim());
            }
            if Instant::now() >= deadline {
                bail!("{name} accepts no connection within {START_TIMEOUT:?}");
            }
        }
    }

    /// Resource usage of the program and its workers until now.
    pub fn usage(&self) -> Usage {
        self.process.family_usage()
    }

    pub async fn end(self) {
        self.process.end().await;
    }
}

/// The program on the `PATH` or in the system directories.
fn find(name: &str) -> Option<PathBuf> {
    let path = std::env::var_os("PATH").unwrap_or_default();
    let directories = std::env::split_paths(&path).chain(SYSTEM_DIRECTORIES.map(PathBuf::from));
    directories.map(|directory| directory.join(name)).find(|path| path.is_file())
}

/// The version of the program's package, if dpkg knows the package.
async fn version(name: &str) -> String {
    let query = Program::named("dpkg-query").args(["-W", "-f", "${Version}", name]);
    query.output().await.unwrap_or_else(|_| "unknown".to_owned())
}

/// A loopback address that was free a moment ago, for programs that can't report their port.
async fn free_address() -> anyhow::Result<SocketAddr> {
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).await.context("no free port")?;
    listener.local_addr().context("no free port")
}
