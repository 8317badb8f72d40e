//! Postgres servers of a test's own, in a temporary directory and on a free port: alone, or as a
//! primary and its standby; and PgBouncer in front of one. As root they run under the account
//! `postgres`, because Postgres refuses to run as root.

#![expect(clippy::disallowed_methods, reason = "the test starts and stops database servers")]

use std::fs::Permissions;
use std::net::{Ipv4Addr, TcpListener, TcpStream};
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use nix::sys::signal::{Signal, kill};
use nix::unistd::{Pid, User, chown, geteuid};
use tempfile::TempDir;

/// Time limit for everything that a server does by itself.
const PATIENCE: Duration = Duration::from_secs(60);
/// The account of the servers, in the system and in the databases.
const ACCOUNT: &str = "postgres";

/// A Postgres server. It is stopped and deleted on drop.
pub struct Postgres {
    directory: TempDir,
    pub port: u16,
    /// Options of the server's command line, such as `-c ssl=on`.
    options: String,
}

/// The program of the newest installed Postgres.
fn program(name: &str) -> PathBuf {
    let versions = std::fs::read_dir("/usr/lib/postgresql")
        .expect("Postgres is installed: run ./scripts/test");
    let version =
        |path: &PathBuf| path.file_name().and_then(|name| name.to_str()?.parse::<u32>().ok());
    let newest =
        versions.flatten().map(|entry| entry.path()).max_by_key(version).expect("a version");
    newest.join("bin").join(name)
}

/// The program under the servers' account.
fn command(program: &Path, arguments: &[&str]) -> Command {
    let is_root = geteuid().is_root();
    let mut command = Command::new(if is_root { Path::new("setpriv") } else { program });
    if is_root {
        command.args(["--reuid", ACCOUNT, "--regid", ACCOUNT, "--init-groups"]).arg(program);
    }
    command.args(arguments).current_dir("/").stdin(Stdio::null()).stdout(Stdio::null());
    command
}

fn run(program: &Path, arguments: &[&str]) -> bool {
    command(program, arguments).status().is_ok_and(|status| status.success())
}

/// A directory that belongs to the servers' account.
fn directory() -> TempDir {
    let directory = TempDir::new().expect("a directory");
    give_away(directory.path());
    directory
}

/// Makes the servers' account the owner.
fn give_away(path: &Path) {
    if geteuid().is_root() {
        let account = User::from_name(ACCOUNT).expect("known").expect("Postgres has an account");
        chown(path, Some(account.uid), Some(account.gid)).expect("given away");
    }
}

/// A port on which nothing listens.
pub fn free_port() -> u16 {
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).expect("a port");
    listener.local_addr().expect("bound").port()
}

/// Repeats the check until it succeeds.
fn wait_until(what: &str, mut is_so: impl FnMut() -> bool) {
    let end = Instant::now() + PATIENCE;
    while !is_so() {
        assert!(Instant::now() < end, "{what}: not within {PATIENCE:?}");
        std::thread::yield_now();
    }
}

impl Postgres {
    /// A new server, not started yet, that admits everybody on this machine.
    pub fn create() -> Self {
        let created = Self { directory: directory(), port: free_port(), options: String::new() };
        let data = created.data();
        let arguments = ["-D", &data, "-U", ACCOUNT, "-A", "trust", "--no-sync", "-E", "UTF8"];
        assert!(run(&program("initdb"), &arguments), "initdb fails");
        created
    }

    /// A new server that admits only connections by TLS and shows this certificate, in PEM.
    pub fn create_with_tls(certificate: &str, key: &str) -> Self {
        let mut created = Self::create();
        let key_path = created.write("server.key", key);
        let certificate_path = created.write("server.crt", certificate);
        std::fs::write(
            Path::new(&created.data()).join("pg_hba.conf"),
            "hostssl all all 127.0.0.1/32 trust\n",
        )
        .expect("written");
        created.options =
            format!("-c ssl=on -c ssl_cert_file={certificate_path} -c ssl_key_file={key_path}");
        created
    }

    /// A standby of this running server, started. From now on this server confirms a write when the
    /// standby has it too.
    pub fn start_standby(&self) -> Self {
        let standby = Self { directory: directory(), port: free_port(), options: String::new() };
        let (data, port) = (standby.data(), self.port.to_string());
        let source = ["-h", "127.0.0.1", "-p", &port, "-U", ACCOUNT];
        let arguments = [&["-D", &data, "-R", "-c", "fast", "--no-sync"], &source[..]].concat();
        assert!(run(&program("pg_basebackup"), &arguments), "pg_basebackup fails");
        standby.start();
        self.query("ALTER SYSTEM SET synchronous_standby_names = '*'");
        self.query("ALTER SYSTEM SET synchronous_commit = 'remote_apply'");
        self.query("SELECT pg_reload_conf()");
        wait_until("the standby follows synchronously", || {
            self.query("SELECT sync_state FROM pg_stat_replication") == "sync"
        });
        standby
    }

    /// A file of the server's own, which only its account can read.
    pub fn write(&self, name: &str, text: &str) -> String {
        let path = self.directory.path().join(name);
        std::fs::write(&path, text).expect("written");
        std::fs::set_permissions(&path, Permissions::from_mode(0o600)).expect("permissions");
        give_away(&path);
        path.to_str().expect("text").to_owned()
    }

    fn data(&self) -> String {
        self.directory.path().join("data").to_str().expect("text").to_owned()
    }

    /// Starts the server; returns when it takes connections.
    pub fn start(&self) {
        let options = format!(
            "-c listen_addresses=127.0.0.1 -c port={} -c unix_socket_directories= -c fsync=off {}",
            self.port, self.options
        );
        let log = self.directory.path().join("log").to_str().expect("text").to_owned();
        let arguments = ["-D", &self.data(), "-s", "-w", "-l", &log, "-o", &options, "start"];
        assert!(
            run(&program("pg_ctl"), &arguments),
            "it does not start: {}",
            std::fs::read_to_string(&log).unwrap_or_default()
        );
    }

    pub fn stop(&self) -> bool {
        run(&program("pg_ctl"), &["-D", &self.data(), "-s", "-w", "-m", "fast", "stop"])
    }

    /// Turns a standby into a primary.
    pub fn promote(&self) {
        assert!(
            run(&program("pg_ctl"), &["-D", &self.data(), "-s", "-w", "promote"]),
            "it is not promoted"
        );
    }

    /// Ends the server by SIGKILL. Its sessions end by themselves when they notice.
    pub fn kill(&self) {
        let file = Path::new(&self.data()).join("postmaster.pid");
        let text = std::fs::read_to_string(&file).expect("it runs");
        let lines: Vec<&str> = text.lines().collect();
        let process = Pid::from_raw(lines[0].parse().expect("a process"));
        kill(process, Signal::SIGKILL).expect("killed");
        std::fs::remove_file(&file).expect("removed");
        // Nobody else would remove its segment of shared memory, of which the line has key and id.
        let segment = lines[6].split_whitespace().nth(1).expect("an id");
        assert!(run(Path::new("ipcrm"), &["-m", segment]), "ipcrm fails");
    }

    /// The result of a statement, as psql prints it.
    pub fn query(&self, sql: &str) -> String {
        let port = self.port.to_string();
        let arguments =
            ["-h", "127.0.0.1", "-p", &port, "-U", ACCOUNT, "-X", "-q", "-A", "-t", "-c", sql];
        let output = command(&program("psql"), &arguments)
            .stdout(Stdio::piped())
            .output()
            .expect("psql starts");
        assert!(output.status.success(), "{sql}: {}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8_lossy(&output.stdout).trim().to_owned()
    }

    pub fn url(&self) -> String {
        url(self.port)
    }
}

/// The URL of a server on this machine, with a password that no message may show.
pub fn url(port: u16) -> String {
    format!("postgres://{ACCOUNT}:swordfish@127.0.0.1:{port}/postgres")
}

impl Drop for Postgres {
    fn drop(&mut self) {
        if Path::new(&self.data()).join("postmaster.pid").exists() {
            self.stop();
        }
    }
}

/// A PgBouncer in front of a Postgres server. It is stopped on drop.
pub struct PgBouncer {
    process: Child,
    port: u16,
    _directory: TempDir,
}

impl PgBouncer {
    /// Starts it; returns when it takes connections. `settings` are lines of its file.
    pub fn start(postgres: &Postgres, settings: &str) -> Self {
        let (directory, port) = (directory(), free_port());
        let file = directory.path().join("pgbouncer.ini");
        let text = format!(
            "[databases]\npostgres = host=127.0.0.1 port={} user={ACCOUNT}\n\
             [pgbouncer]\nlisten_addr = 127.0.0.1\nlisten_port = {port}\nunix_socket_dir =\n\
             auth_type = any\n{settings}\n",
            postgres.port
        );
        std::fs::write(&file, text).expect("written");
        give_away(&file);
        let process =
            command(Path::new("/usr/sbin/pgbouncer"), &["-q", file.to_str().expect("text")])
                .spawn()
                .expect("pgbouncer is installed: run ./scripts/test");
        let bouncer = Self { process, port, _directory: directory };
        wait_until("pgbouncer listens", || TcpStream::connect((Ipv4Addr::LOCALHOST, port)).is_ok());
        bouncer
    }

    pub fn url(&self) -> String {
        url(self.port)
    }
}

impl Drop for PgBouncer {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}
