//! The `taskd` binary: parses the command line and hands over. It never holds logic of its own.

use std::io::{IsTerminal as _, Write as _};
use std::process::ExitCode;
use std::time::Duration;

use anyhow::Context as _;
use nix::sys::stat::{Mode, umask};
use task_proto::line::SingleLineWriter;
use task_proto::log_format::LogFormat;
use taskd::config::{Config, ConfigError, ServeFlags};
use taskd::net::open_files;
use taskd::serve::Server;
use taskd::serve::command_line::{BlobsCommandError, Command, CommandLine, check_server};
use taskd::serve::log_limits::LogLimits;
use taskd::system::clock::Clock;
use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio_util::sync::CancellationToken;
use tracing_subscriber::EnvFilter;
use tracing_subscriber::layer::SubscriberExt as _;
use tracing_subscriber::util::SubscriberInitExt as _;

/// The C library's allocator took a quarter of the time of a short answer, because memory is often
/// allocated by one thread and freed by another; see docs/measurements.md.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// Time limit for blocking threads when everything else has ended.
const SHUTDOWN_TIMEOUT: Duration = Duration::from_millis(500);
/// Tasks that tokio runs between two polls for I/O: an eighth of its default.
const EVENT_INTERVAL: u32 = 7;

fn main() -> ExitCode {
    task_cli::complete(CommandLine::describe);
    let CommandLine { connection, command } =
        CommandLine::read(std::env::args_os()).unwrap_or_else(|error| error.exit());
    // Tasks that send blobs take long, so I/O is polled more often than by default.
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .event_interval(EVENT_INTERVAL)
        .build();
    let runtime = match runtime {
        Ok(runtime) => runtime,
        Err(error) => {
            return report_error(
                &anyhow::Error::new(error).context("cannot start the runtime's threads"),
            );
        }
    };
    let code = match command {
        Command::Serve(flags) => {
            runtime.block_on(serve(&flags)).unwrap_or_else(|error| report_error(&error))
        }
        Command::Config(command) => match command.run() {
            Ok(true) => ExitCode::SUCCESS,
            Ok(false) => task_cli::Outcome::Usage.into(),
            Err(error) => report_error(&error.into()),
        },
        Command::Database(command) => match runtime.block_on(command.run()) {
            Ok(()) => ExitCode::SUCCESS,
            Err(error) => report_error(&error.into()),
        },
        Command::Blobs(command) => {
            make_files_private();
            match runtime.block_on(command.run()) {
                Ok(()) => ExitCode::SUCCESS,
                Err(BlobsCommandError::Config(error)) => report_error(&error.into()),
                Err(error) => report_error(&error.into()),
            }
        }
        Command::Operator(command) => runtime.block_on(task_cli::run(
            &connection,
            command,
            CommandLine::describe,
            check_server,
        )),
    };
    runtime.shutdown_timeout(SHUTDOWN_TIMEOUT);
    code
}

/// All files of the server are private, including those that SQLite makes beside its database.
fn make_files_private() {
    umask(Mode::from_bits_truncate(0o077));
}

async fn serve(flags: &ServeFlags) -> anyhow::Result<ExitCode> {
    make_files_private();
    let mut config = Config::load(flags, std::env::vars_os())?;
    let limits = LogLimits::default();
    start_logging(config.log_format, &limits);
    let stop = CancellationToken::new();
    let _stopped = stop.clone().drop_guard();
    tokio::spawn(limits.run(stop));
    match open_files::raise() {
        Ok(allowed) => open_files::fit(&mut config, allowed)?,
        Err(error) => tracing::warn!(%error, "the limit on open files can't be raised"),
    }
    // Installed before anything is started, so that an early signal stops the server gracefully.
    let mut signals = Signals::install().context("signals can't be caught")?;
    let mut hangup = signal(SignalKind::hangup()).context("signals can't be caught")?;
    let is_broker_embedded = config.broker.is_none();
    let server = tokio::select! {
        started = Server::start(config, Clock::system()) => started?,
        // A standby may wait for weeks, and a server that has not started holds nothing.
        () = signals.next() => return Ok(ExitCode::SUCCESS),
    };
    print_next_steps(&server, is_broker_embedded);
    let code = loop {
        tokio::select! {
            () = signals.next() => break ExitCode::SUCCESS,
            _ = hangup.recv() => reload(&server),
            failure = server.failure() => {
                tracing::error!("{failure}");
                break ExitCode::FAILURE;
            }
        }
    };
    tracing::info!("stopping; a second signal exits immediately");
    let stopping = async {
        if code == ExitCode::SUCCESS {
            server.drain().await;
        }
        server.stop().await;
    };
    tokio::select! {
        () = stopping => Ok(code),
        () = signals.next() => Ok(ExitCode::FAILURE),
    }
}

/// Logs to stderr, as lines for people or as JSON.
fn start_logging(format: LogFormat, limits: &LogLimits) {
    let filter = EnvFilter::try_from_env("TASKD_LOG")
        .unwrap_or_else(|_| EnvFilter::new("info,sqlx=warn,rumqttd=error"));
    let is_json = format.is_json_on_stderr();
    let has_colours = !is_json && std::io::stderr().is_terminal();
    let log = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(move || SingleLineWriter::new(std::io::stderr(), has_colours))
        .with_ansi(has_colours);
    if is_json {
        log.json().with_current_span(false).finish().with(limits.clone()).init();
    } else {
        log.finish().with(limits.clone()).init();
    }
}

/// SIGHUP: reloads the certificate now. The server checks for a new one every few seconds.
fn reload(server: &Server) {
    if let Err(error) = server.reload_certificate() {
        tracing::warn!(
            error = &error as &dyn std::error::Error,
            "the certificate could not be reloaded; the old one stays in use"
        );
    }
}

/// Prints the server's addresses and the first three commands to stdout.
fn print_next_steps(server: &Server, is_broker_embedded: bool) {
    let addresses = server.addresses();
    let url = addresses.url();
    let data = server.data().path().display();
    let token = server.data().operator_token_path();
    let text = format!(
        "taskd serves HTTP on {url} {mqtt}, all its state is in {data}\n\
         \n\
         The page:        {url}/   (sign in with the token in {token})\n\
         A robot:         taskd enroll-token create --data {data}\n\
         \x20                task-agent enroll --server {url} --token TOKEN\n\
         A first package: taskd push DIR --to '*' --wait --data {data}\n\
         {elsewhere}",
        mqtt = match is_broker_embedded {
            true => format!("and MQTT on {}", addresses.mqtt),
            false => format!("and uses the broker at {}", addresses.mqtt),
        },
        elsewhere = addresses
            .ca_pin
            .map(|pin| format!("Commands from elsewhere: taskd --pin {pin} --server …\n"))
            .unwrap_or_default(),
        token = token.display(),
    );
    // A closed stdout does not stop the server.
    let _ = std::io::stdout().write_all(text.as_bytes()).and_then(|()| std::io::stdout().flush());
}

struct Signals {
    terminate: Signal,
    interrupt: Signal,
}

impl Signals {
    fn install() -> std::io::Result<Self> {
        Ok(Self {
            terminate: signal(SignalKind::terminate())?,
            interrupt: signal(SignalKind::interrupt())?,
        })
    }

    async fn next(&mut self) {
        tokio::select! {
            _ = self.terminate.recv() => {}
            _ = self.interrupt.recv() => {}
        }
    }
}

/// Prints the error with all causes to stderr. A closed stderr is no reason to panic.
fn report_error(error: &anyhow::Error) -> ExitCode {
    let _ = writeln!(std::io::stderr(), "taskd: {error:#}");
    let outcome = if error.is::<ConfigError>() {
        task_cli::Outcome::Usage
    } else {
        task_cli::Outcome::Failed
    };
    outcome.into()
}
