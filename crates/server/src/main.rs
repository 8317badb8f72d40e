//! The `taskd` binary: parses the command line and hands over. It never holds logic of its own.

use std::io::{IsTerminal as _, Write as _};
use std::process::ExitCode;
use std::time::Duration;

use anyhow::Context as _;
use nix::sys::stat::{Mode, umask};
use task_proto::line::OneLineEach;
use taskd::commands;
use taskd::commands::command_line::{Command, CommandLine};
use taskd::config::{Config, ConfigError, ServeFlags};
use taskd::limits::log_limits::LogLimits;
use taskd::net::open_files;
use taskd::serve::Server;
use taskd::system::clock::Clock;
use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio_util::sync::CancellationToken;
use tracing_subscriber::EnvFilter;
use tracing_subscriber::layer::SubscriberExt as _;
use tracing_subscriber::util::SubscriberInitExt as _;

/// The C library's allocator took a quarter of the time of a short answer, where memory is taken by
/// one thread and given back by another all the time; see docs/measurements.md.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// What may still run on a blocking thread when everything else has ended.
const LEFTOVER_PATIENCE: Duration = Duration::from_millis(500);
/// An eighth of what tokio takes if it is not told.
const TASKS_PER_LOOK: u32 = 7;

fn main() -> ExitCode {
    commands::complete(CommandLine::describe);
    let CommandLine { connection, command } =
        CommandLine::read(std::env::args_os()).unwrap_or_else(|error| error.exit());
    // Sockets are looked at after so many tasks: those that hand out blobs take long, and would
    // keep everybody waiting.
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .event_interval(TASKS_PER_LOOK)
        .build();
    let runtime = match runtime {
        Ok(runtime) => runtime,
        Err(error) => return complain(&anyhow::Error::new(error).context("no threads to run on")),
    };
    let code = match command {
        Command::Serve(flags) => {
            runtime.block_on(serve(&flags)).unwrap_or_else(|error| complain(&error))
        }
        Command::Operator(command) => {
            runtime.block_on(commands::run(&connection, command, CommandLine::describe))
        }
    };
    runtime.shutdown_timeout(LEFTOVER_PATIENCE);
    code
}

async fn serve(flags: &ServeFlags) -> anyhow::Result<ExitCode> {
    // All that a server keeps is its own: also what SQLite makes beside its database.
    umask(Mode::from_bits_truncate(0o077));
    let filter = EnvFilter::try_from_env("TASKD_LOG")
        .unwrap_or_else(|_| EnvFilter::new("info,sqlx=warn,rumqttd=error"));
    let (limits, has_colours) = (LogLimits::default(), std::io::stderr().is_terminal());
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(move || OneLineEach::new(std::io::stderr(), has_colours))
        .with_ansi(has_colours)
        .finish()
        .with(limits.clone())
        .init();
    let stop = CancellationToken::new();
    let _stopped = stop.clone().drop_guard();
    tokio::spawn(limits.run(stop));
    let mut config = Config::load(flags, std::env::vars_os())?;
    match open_files::raise() {
        Ok(allowed) => open_files::fit(&mut config, allowed)?,
        Err(error) => tracing::warn!(%error, "the limit on open files can't be raised"),
    }
    // Installed before anything is started, so that an early signal stops it softly as well.
    let mut signals = Signals::install().context("signals can't be caught")?;
    let mut hangup = signal(SignalKind::hangup()).context("signals can't be caught")?;
    let has_own_broker = config.broker.is_none();
    let server = Server::start(config, Clock::system()).await?;
    say_what_next(&server, has_own_broker);
    let code = loop {
        tokio::select! {
            () = signals.next() => break ExitCode::SUCCESS,
            _ = hangup.recv() => reload(&server),
            seen = server.broken() => {
                tracing::error!(seen, "the server can't go on, so it ends; start it again");
                break ExitCode::FAILURE;
            }
        }
    };
    tracing::info!("stopping; a second signal ends it at once");
    tokio::select! {
        () = server.stop() => Ok(code),
        () = signals.next() => Ok(ExitCode::FAILURE),
    }
}

/// SIGHUP: looks for a new certificate now. The server looks by itself every few seconds.
fn reload(server: &Server) {
    if let Err(error) = server.reload_certificate() {
        tracing::warn!(
            error = &error as &dyn std::error::Error,
            "the certificate stays what it was"
        );
    }
}

/// On stdout: where the server is, and the first three things to do with it.
fn say_what_next(server: &Server, has_own_broker: bool) {
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
        mqtt = match has_own_broker {
            true => format!("and MQTT on {}", addresses.mqtt),
            false => format!("and uses the broker at {}", addresses.mqtt),
        },
        elsewhere = addresses
            .ca_pin
            .map(|pin| format!("Commands from elsewhere: taskd --pin {pin} --server …\n"))
            .unwrap_or_default(),
        token = token.display(),
    );
    // Nobody may be reading; the server serves all the same.
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

/// Says on stderr what went wrong, with all causes. A broken stderr is no reason to panic.
fn complain(error: &anyhow::Error) -> ExitCode {
    let _ = writeln!(std::io::stderr(), "taskd: {error:#}");
    let outcome = if error.is::<ConfigError>() {
        commands::Outcome::Usage
    } else {
        commands::Outcome::Failed
    };
    outcome.into()
}
