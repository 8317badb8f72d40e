//! The subcommands of `task-agent`: each turns its arguments into one call and the outcome into an
//! exit code. Only they and `main` use `anyhow` and print.

use std::io::IsTerminal as _;
use std::path::PathBuf;

use anyhow::{anyhow, ensure};
use clap::ValueEnum;
use rustls::ClientConfig;
use task_proto::CaPin;
use task_proto::line::SingleLineWriter;
use task_proto::log_format::LogFormat;
use task_transport::{ClientKey, Trust};
use tracing_subscriber::EnvFilter;

use crate::system::clock;

mod approval;
pub mod config;
pub mod configure;
pub mod doctor;
pub mod enroll;
pub mod graph;
pub mod hold;
pub mod man;
pub mod run;
pub mod shim;
pub mod status;

/// The variable that chooses the form of the log.
const LOG_FORMAT_VARIABLE: &str = "TASK_AGENT_LOG_FORMAT";
/// Default directory of all data of a robot, overridden by `--data` or `TASK_AGENT_DATA`.
pub const DEFAULT_DATA_DIR: &str = "/var/lib/task-agent";

/// The data directory, which every subcommand takes.
#[derive(Debug, Clone, clap::Args)]
pub struct DataDir {
    /// Directory of the robot's identity, settings, ledger and tasks
    #[arg(long, env = "TASK_AGENT_DATA", value_name = "DIR", default_value = DEFAULT_DATA_DIR)]
    pub data: PathBuf,
}

/// The format of a result.
#[derive(Debug, Clone, Copy, ValueEnum)]
enum Output {
    /// A table, for reading
    Table,
    /// One JSON document, for programs
    Json,
}

/// Logs to stderr: as JSON if stderr is systemd's journal, else as lines for people.
/// `TASK_AGENT_LOG_FORMAT` chooses the form, `TASK_AGENT_LOG` filters, instead of `filter`.
fn start_logging(filter: &str) -> anyhow::Result<()> {
    let format = match std::env::var(LOG_FORMAT_VARIABLE) {
        Ok(text) => text.parse().map_err(|reason| anyhow!("{LOG_FORMAT_VARIABLE}: {reason}"))?,
        Err(_) => LogFormat::Auto,
    };
    let filter =
        EnvFilter::try_from_env("TASK_AGENT_LOG").unwrap_or_else(|_| EnvFilter::new(filter));
    let is_json = format.is_json_on_stderr();
    let colours = !is_json && std::io::stderr().is_terminal();
    let log = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_ansi(colours)
        .with_writer(move || SingleLineWriter::new(std::io::stderr(), colours));
    if is_json {
        log.json().with_current_span(false).init();
    } else {
        log.init();
    }
    Ok(())
}

/// Refuses plain text where the server is identified by a pin. `setting` is the source of the
/// server's address.
fn refuse_plain_text(
    pin: Option<CaPin>,
    server: &reqwest::Url,
    setting: &str,
) -> anyhow::Result<()> {
    let is_plain = pin.is_some() && server.scheme() != "https";
    ensure!(
        !is_plain,
        "{setting}: the token requires an encrypted server: use https:// instead of {}://",
        server.scheme()
    );
    Ok(())
}

/// The agent's TLS configuration: the trusted certificates for the server, and the agent's key for
/// servers that request a client certificate.
fn tls(pin: Option<CaPin>, key: Option<&ClientKey>) -> anyhow::Result<ClientConfig> {
    let mut config = Trust::by(pin).client_config(clock::for_certificates());
    if let Some(key) = key {
        key.show_in(&mut config)?;
    }
    Ok(config)
}

/// Prints an error and its whole chain of causes on stderr.
#[expect(clippy::print_stderr, reason = "this is where the binary reports its failure to a person")]
pub fn print_error(error: &anyhow::Error) {
    eprintln!("task-agent: {error:#}");
}

/// Prints a line on stderr. A closed reader is no error.
fn print_line_of_error(line: &str) {
    use std::io::Write as _;
    let _ = writeln!(std::io::stderr(), "{line}");
}

/// Prints a line on stdout. A closed reader is no error.
fn say(line: std::fmt::Arguments<'_>) {
    use std::io::Write as _;
    let _ = writeln!(std::io::stdout(), "{line}");
}
