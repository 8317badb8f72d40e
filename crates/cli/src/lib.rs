//! The operator's commands, the arguments they take and the exit codes they end with. They need
//! nothing of a server's own code, so the program hands in the parts of `taskd doctor` that do.
//!
//! Each command talks to the server over its public API only. The published address and the first
//! token are the exceptions that are read from the data directory.

#![warn(missing_docs)]

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::{Args, Subcommand};
use task_package::PackageError;
use task_proto::CaPin;
use task_proto::checkup::Checkup;

use self::keys::key_file::KeyError;
use api::client::{Client, ClientError};
use display::output::{Format, Output};

mod api;
mod clock;
mod display;
mod documents;
mod keys;
pub mod local_server;
mod orders;
mod packages;
mod people;
mod robots;
mod service;

pub use api::complete::complete;
use display::output;
use keys::key;
use orders::{deploy, push, run, task};
use packages::{outputs, package};
use people::{audit, login, token, user};
use robots::{enroll_token, logs, robot, ros};
pub use service::doctor::INTEGRITY_REMEDY;
use service::{broker, cluster, doctor, server, status, version};

/// The operator's commands, those of every day first; `serve` is added to them.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Pack and upload a directory; with --to, deploy it
    Push(push::PushArgs),
    /// Run a launch file of a package on one robot, like ros2 launch
    Run(run::RunArgs),
    /// Start a task on robots that have it
    Start(task::TaskArgs),
    /// Stop a task; it stays installed
    Stop(task::TaskArgs),
    /// Restart a task; start it where it is stopped
    Restart(task::TaskArgs),
    /// Return a task to the version that ran before the current one
    Rollback(task::TaskArgs),
    /// Stop a task and remove it from robots
    Remove(task::RemoveArgs),
    /// Show or follow the logs of a robot's tasks and nodes
    Logs(logs::LogsArgs),
    /// List, approve, label, configure, revoke and remove robots
    #[command(subcommand)]
    Robot(robot::Action),
    /// List, inspect, compare, export and delete packages
    #[command(subcommand)]
    Package(package::Action),
    /// List, watch, cancel, resume and retry deployments
    #[command(subcommand)]
    Deploy(deploy::Action),
    /// List and download the output files of tasks
    #[command(subcommand)]
    Output(outputs::Action),
    /// Show the nodes on a robot's ROS graph
    #[command(subcommand)]
    Node(ros::NodeAction),
    /// Show the topics on a robot's ROS graph
    #[command(subcommand)]
    Topic(ros::TopicAction),
    /// Show or set the parameters of a node
    #[command(subcommand)]
    Param(ros::ParamAction),
    /// Request a transition of a lifecycle node
    Lifecycle(ros::LifecycleArgs),
    /// Show the health of the server and of its links to robots
    Status,
    /// Show the server's version, traffic, sessions and rules
    #[command(subcommand)]
    Server(server::Action),
    /// List and drain the servers of a cluster, export their keys
    #[command(subcommand)]
    Cluster(cluster::Action),
    /// Sign in with a user name and a password
    Login(login::LoginArgs),
    /// Sign out of a server
    Logout,
    /// Show the user and the permissions of the current token
    Whoami,
    /// Manage users and their roles
    #[command(subcommand)]
    User(user::Action),
    /// Create, list and revoke access tokens
    #[command(subcommand)]
    Token(token::Action),
    /// Create, list and revoke the tokens that robots enroll with
    #[command(subcommand)]
    EnrollToken(enroll_token::Action),
    /// Show, export or verify the audit log
    Audit(audit::AuditArgs),
    /// Manage publishers' keys and the list of trusted publishers
    #[command(subcommand)]
    Key(key::Action),
    /// Print configuration files for an external broker
    #[command(subcommand)]
    Broker(broker::Action),
    /// Pack a directory and print its digests, without a server
    Pack(push::PackArgs),
    /// Check for common problems and suggest remedies
    Doctor,
    /// Show the version of taskd and of the server
    Version,
    /// Print a shell completion script
    Completions(documents::CompletionsArgs),
    /// Write man pages to a directory
    Man(documents::ManArgs),
}

/// Server and credentials. Each option may precede or follow the command.
#[derive(Debug, Args)]
#[command(next_help_heading = "Connection")]
pub struct Connection {
    /// URL of the server [default: the server of --data, then that of the last taskd login, then
    /// http://127.0.0.1:8080]
    #[arg(long, env = "TASKD_SERVER", value_name = "URL", global = true)]
    pub server: Option<String>,
    /// Pin of the server's certificate authority [default: the pin of taskd login or of the server
    /// of --data, then the system's root certificates]
    #[arg(long, env = "TASKD_PIN", value_name = "PIN", global = true)]
    pub pin: Option<CaPin>,
    /// Access token [default: operator.token in the directory of --data, then the token of taskd
    /// login]
    #[arg(long, env = "TASKD_TOKEN", value_name = "TOKEN", hide_env_values = true, global = true)]
    pub token: Option<String>,
    /// File that contains the token
    #[arg(long, value_name = "FILE", global = true)]
    pub token_file: Option<PathBuf>,
    /// Data directory of a server on this machine
    #[arg(long, env = "TASKD_DATA", value_name = "DIR", global = true)]
    // A string, like the same option of `serve`: clap treats both as one option.
    pub data: Option<String>,
    /// Output format
    #[arg(short, long, value_enum, default_value_t = Format::Table, value_name = "FORMAT", global = true)]
    pub output: Format,
}

/// The result of a command.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outcome {
    /// The whole request succeeded.
    Succeeded,
    /// The command failed, or no robot succeeded.
    Failed,
    /// The command line or the package is invalid, or no robot is selected.
    Usage,
    /// Some robots succeeded, others failed.
    SomeFailed,
    /// The server does not let this token do that.
    NotAllowed,
    /// The time limit was reached.
    TimedOut,
    /// Ctrl-C during a wait.
    Interrupted,
}

impl From<Outcome> for ExitCode {
    fn from(outcome: Outcome) -> Self {
        Self::from(match outcome {
            Outcome::Succeeded => 0,
            Outcome::Failed => 1,
            Outcome::Usage => 2,
            Outcome::SomeFailed => 3,
            Outcome::NotAllowed => 4,
            Outcome::TimedOut => 5,
            // The exit code of a program ended by SIGINT, by the shell's convention.
            Outcome::Interrupted => 130,
        })
    }
}

/// Why a command could not do its work.
#[derive(Debug, thiserror::Error)]
pub enum CommandError {
    /// The server refused the request, or could not be reached.
    #[error(transparent)]
    Client(#[from] ClientError),
    /// The directory is not a package that could run.
    #[error(transparent)]
    Package(#[from] PackageError),
    /// A key can't be used.
    #[error(transparent)]
    Key(#[from] KeyError),
    /// The command line is inconsistent.
    #[error("{0}")]
    Usage(String),
    /// The audit's chain does not hold.
    #[error("audit verification failed: {0}")]
    Broken(String),
    /// A local file or stream.
    #[error("{what}")]
    Io {
        /// The sentence for people: the operation that failed.
        what: String,
        /// The operating system's error.
        source: std::io::Error,
    },
}

impl CommandError {
    fn outcome(&self) -> Outcome {
        match self {
            Self::Client(error) => error.outcome(),
            Self::Package(PackageError::Io { .. }) | Self::Io { .. } | Self::Broken(_) => {
                Outcome::Failed
            }
            Self::Package(_) | Self::Key(_) | Self::Usage(_) => Outcome::Usage,
        }
    }
}

/// Runs one command to its end. Results are on stdout, messages on stderr.
///
/// The rest of the program hands in `command_line`, its whole command line for the man pages, and
/// `check_server`: the checks of `taskd doctor` in a server's data directory that need the server's
/// own code. Its last argument is whether a server answers.
pub async fn run(
    connection: &Connection,
    command: Command,
    command_line: fn() -> clap::Command,
    check_server: impl AsyncFnOnce(&mut Checkup, &Path, bool),
) -> ExitCode {
    let outcome = match dispatch(connection, command, command_line, check_server).await {
        Ok(outcome) => outcome,
        Err(error) => {
            output::print_error(&error);
            error.outcome()
        }
    };
    outcome.into()
}

async fn dispatch(
    connection: &Connection,
    command: Command,
    command_line: fn() -> clap::Command,
    check_server: impl AsyncFnOnce(&mut Checkup, &Path, bool),
) -> Result<Outcome, CommandError> {
    let open = || connection.open();
    match command {
        Command::Push(args) => push::run(&open()?, args).await,
        Command::Run(args) => run::run(&open()?, args).await,
        Command::Start(args) => task::run(&open()?, task::Verb::Start, args).await,
        Command::Stop(args) => task::run(&open()?, task::Verb::Stop, args).await,
        Command::Restart(args) => task::run(&open()?, task::Verb::Restart, args).await,
        Command::Rollback(args) => task::rollback(&open()?, args).await,
        Command::Remove(args) => task::remove(&open()?, args).await,
        Command::Logs(args) => logs::run(&open()?, args).await,
        Command::Robot(action) => robot::run(&open()?, action).await,
        Command::Package(action) => package::run(&open()?, action).await,
        Command::Deploy(action) => deploy::run(&open()?, action).await,
        Command::Output(action) => outputs::run(&open()?, action).await,
        Command::Node(action) => ros::node(&open()?, action).await,
        Command::Topic(action) => ros::topic(&open()?, action).await,
        Command::Param(action) => ros::param(&open()?, action).await,
        Command::Lifecycle(args) => ros::lifecycle(&open()?, args).await,
        Command::Status => status::status(&open()?).await,
        Command::Server(action) => server::run(&open()?, action).await,
        Command::Cluster(action) => cluster::run(connection, action).await,
        Command::Login(args) => login::login(connection, args).await,
        Command::Logout => login::logout(connection).await,
        Command::Whoami => user::whoami(&open()?).await,
        Command::User(action) => user::run(&open()?, action).await,
        Command::Token(action) => token::run(&open()?, action).await,
        Command::EnrollToken(action) => enroll_token::run(&open()?, action).await,
        Command::Audit(args) => audit::run(connection, args).await,
        Command::Key(action) => key::run(connection, action).await,
        Command::Broker(action) => broker::run(&open()?, action).await,
        Command::Pack(args) => push::pack(&Output::new(connection.output), args).await,
        Command::Doctor => doctor::run(connection, check_server).await,
        Command::Version => version::run(connection).await,
        Command::Completions(args) => documents::completions(&args),
        Command::Man(args) => documents::man(&args, command_line()),
    }
}

/// State shared by all commands that use the server.
pub(crate) struct Session {
    client: Client,
    output: Output,
}

impl Connection {
    /// A `--data` on the command line selects that directory's server, not the one from the
    /// environment; the environment's token and pin belong to the latter and are dropped.
    pub fn prefer_typed_options(&mut self, is_typed: impl Fn(&str) -> bool) {
        if is_typed("data") && !is_typed("server") && self.server.take().is_some() {
            self.token.take_if(|_| !is_typed("token"));
            self.pin.take_if(|_| !is_typed("pin"));
        }
    }

    fn open(&self) -> Result<Session, CommandError> {
        Ok(Session { client: Client::connect(self)?, output: Output::new(self.output) })
    }
}
