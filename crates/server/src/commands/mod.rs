//! Owns the operator's commands, what they take and the exit codes they end with; it never opens
//! the files of a server that runs.
//!
//! Each command talks to the server over its public API only. The published address and the first
//! token are the exceptions that are read from the data directory.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Args, Subcommand};
use task_proto::CaPin;

use self::keys::key_file::KeyError;
use crate::package::PackageError;
use api::client::{Client, ClientError};
use display::output::{Format, Output};

mod api;
pub mod command_line;
mod display;
mod documents;
mod keys;
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
use service::{broker, doctor, server, status, version};

/// The operator's commands, those of every day first; `serve` is added to them.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Pack a directory, upload it and, with --to, deploy it
    Push(push::Push),
    /// Run a launch file of a package on one robot, as ros2 launch does here
    Run(run::RunOrder),
    /// Start a task on robots that have it
    Start(task::TaskOrder),
    /// Stop a task; it stays installed
    Stop(task::TaskOrder),
    /// Stop a task where it runs, and start it
    Restart(task::TaskOrder),
    /// Go back to the version of a task that ran before the one there is now
    Rollback(task::TaskOrder),
    /// Stop a task and remove it from robots
    Remove(task::RemoveOrder),
    /// Show what a robot's tasks and their nodes said, or follow it
    Logs(logs::LogsOrder),
    /// Look at robots, let them in, label, rename, revoke or remove them
    Robot {
        /// What to do.
        #[command(subcommand)]
        action: robot::Action,
    },
    /// Look into packages, delete or export them
    Package {
        /// What to do.
        #[command(subcommand)]
        action: package::Action,
    },
    /// Look at deployments, follow, cancel, resume or retry one
    Deploy {
        /// What to do.
        #[command(subcommand)]
        action: deploy::Action,
    },
    /// Look at the files that tasks brought back, or fetch them
    Output {
        /// What to do.
        #[command(subcommand)]
        action: outputs::Action,
    },
    /// Look at the nodes on a robot's ROS graph
    Node {
        /// What to do.
        #[command(subcommand)]
        action: ros::NodeAction,
    },
    /// Look at the topics on a robot's ROS graph
    Topic {
        /// What to do.
        #[command(subcommand)]
        action: ros::TopicAction,
    },
    /// Look at a node's parameters, or set one
    Param {
        /// What to do.
        #[command(subcommand)]
        action: ros::ParamAction,
    },
    /// Ask a lifecycle node for a transition
    Lifecycle(ros::LifecycleOrder),
    /// Show how the server and the ways to the robots do
    Status,
    /// Look at the server, its sessions and its rules
    Server {
        /// What to do.
        #[command(subcommand)]
        action: server::Action,
    },
    /// Sign in with a name and a password
    Login(login::LoginOrder),
    /// Sign out where taskd login signed in
    Logout,
    /// Show whom the token stands for, and what it allows
    Whoami,
    /// Say who may use the server, and what for
    User {
        /// What to do.
        #[command(subcommand)]
        action: user::Action,
    },
    /// Make, list or revoke access tokens
    Token {
        /// What to do.
        #[command(subcommand)]
        action: token::Action,
    },
    /// Make, list or revoke the tokens that robots enroll with
    EnrollToken {
        /// What to do.
        #[command(subcommand)]
        action: enroll_token::Action,
    },
    /// Show who did what, export or verify it
    Audit(audit::AuditOrder),
    /// Make publishers' keys, and the list of those that robots trust
    Key {
        /// What to do.
        #[command(subcommand)]
        action: key::Action,
    },
    /// Print what an external broker's own files must say
    Broker {
        /// Which file.
        #[command(subcommand)]
        action: broker::Action,
    },
    /// Pack a directory and print its digests; talks to no server
    Pack(push::Pack),
    /// Look for what commonly goes wrong, and say how to mend it
    Doctor,
    /// Show the version of this program, and of the server if it can be asked
    Version,
    /// Print the script by which a shell completes commands, and names live from the server
    Completions(documents::CompletionsOrder),
    /// Write man pages
    Man(documents::ManOrder),
}

/// Where the server is and who asks. Each option may stand before the command or after it.
#[derive(Debug, Args)]
#[command(next_help_heading = "Asking the server")]
pub struct Connection {
    /// The server's URL [default: the server of --data, else that of the last taskd login, else
    /// http://127.0.0.1:8080]
    #[arg(long, env = "TASKD_SERVER", value_name = "URL", global = true)]
    pub server: Option<String>,
    /// The pin of the server's certificate authority [default: that of taskd login or of the server
    /// of --data, else the system's roots]
    #[arg(long, env = "TASKD_PIN", value_name = "PIN", global = true)]
    pub pin: Option<CaPin>,
    /// A person's token [default: operator.token of the server that --data names, else that of
    /// taskd login]
    #[arg(long, env = "TASKD_TOKEN", value_name = "TOKEN", hide_env_values = true, global = true)]
    pub token: Option<String>,
    /// A file that holds the token
    #[arg(long, value_name = "FILE", global = true)]
    pub token_file: Option<PathBuf>,
    /// The data directory of a server on this machine
    #[arg(long, env = "TASKD_DATA", value_name = "DIR", global = true)]
    // A text, as `serve` has it: both are one option to clap.
    pub data: Option<String>,
    /// How to print the result
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
    #[error("the audit does not hold: {0}")]
    Broken(String),
    /// A local file or stream.
    #[error("{what}")]
    Io { what: String, source: std::io::Error },
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
pub async fn run(
    connection: &Connection,
    command: Command,
    command_line: fn() -> clap::Command,
) -> ExitCode {
    let outcome = match dispatch(connection, command, command_line).await {
        Ok(outcome) => outcome,
        Err(error) => {
            output::complain(&error);
            error.outcome()
        }
    };
    outcome.into()
}

async fn dispatch(
    connection: &Connection,
    command: Command,
    command_line: fn() -> clap::Command,
) -> Result<Outcome, CommandError> {
    let open = || connection.open();
    match command {
        Command::Push(push) => push::run(&open()?, push).await,
        Command::Run(order) => run::run(&open()?, order).await,
        Command::Start(order) => task::run(&open()?, task::Verb::Start, order).await,
        Command::Stop(order) => task::run(&open()?, task::Verb::Stop, order).await,
        Command::Restart(order) => task::run(&open()?, task::Verb::Restart, order).await,
        Command::Rollback(order) => task::roll_back(&open()?, order).await,
        Command::Remove(order) => task::remove(&open()?, order).await,
        Command::Logs(order) => logs::run(&open()?, order).await,
        Command::Robot { action } => robot::run(&open()?, action).await,
        Command::Package { action } => package::run(&open()?, action).await,
        Command::Deploy { action } => deploy::run(&open()?, action).await,
        Command::Output { action } => outputs::run(&open()?, action).await,
        Command::Node { action } => ros::node(&open()?, action).await,
        Command::Topic { action } => ros::topic(&open()?, action).await,
        Command::Param { action } => ros::param(&open()?, action).await,
        Command::Lifecycle(order) => ros::lifecycle(&open()?, order).await,
        Command::Status => status::status(&open()?).await,
        Command::Server { action } => server::run(&open()?, action).await,
        Command::Login(order) => login::log_in(connection, order).await,
        Command::Logout => login::log_out(connection).await,
        Command::Whoami => user::who_am_i(&open()?).await,
        Command::User { action } => user::run(&open()?, action).await,
        Command::Token { action } => token::run(&open()?, action).await,
        Command::EnrollToken { action } => enroll_token::run(&open()?, action).await,
        Command::Audit(order) => audit::run(connection, order).await,
        Command::Key { action } => key::run(connection, action).await,
        Command::Broker { action } => broker::run(&open()?, action).await,
        Command::Pack(pack) => push::pack(&Output::new(connection.output), pack).await,
        Command::Doctor => doctor::run(connection).await,
        Command::Version => version::run(connection).await,
        Command::Completions(order) => documents::completions(&order),
        Command::Man(order) => documents::man(&order, command_line()),
    }
}

/// State shared by all commands that use the server.
pub(crate) struct Session {
    client: Client,
    output: Output,
}

impl Connection {
    /// A typed directory means that directory's server, not the one from the environment; the
    /// environment's token and pin belong to the latter and are dropped.
    pub(crate) fn prefer_what_is_typed(&mut self, is_typed: impl Fn(&str) -> bool) {
        if is_typed("data") && !is_typed("server") && self.server.take().is_some() {
            self.token.take_if(|_| !is_typed("token"));
            self.pin.take_if(|_| !is_typed("pin"));
        }
    }

    fn open(&self) -> Result<Session, CommandError> {
        Ok(Session { client: Client::connect(self)?, output: Output::new(self.output) })
    }
}
