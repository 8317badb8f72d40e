//! The `task-agent` binary: parses the command line and hands over. It never holds logic of its
//! own.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::{CommandFactory as _, Parser, Subcommand};
use task_agent::commands;

/// Run task packages on this robot, as its server orders
#[derive(Parser)]
#[command(name = "task-agent", version, max_term_width = 110)]
struct CommandLine {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Register this robot with a server
    Enroll(commands::enroll::Arguments),
    /// Prompt for this robot's settings and write them to agent.toml
    Configure(commands::configure::Arguments),
    /// Check a property file, and list all keys
    #[command(subcommand)]
    Config(commands::config::ConfigCommand),
    /// Run the agent until SIGINT or SIGTERM; tasks keep running afterwards
    Run(commands::run::Arguments),
    /// Show the state of this robot's tasks; works without a server or a running agent
    Status(commands::status::Arguments),
    /// Block starts and switches of tasks until `release`; running tasks continue
    Hold(commands::hold::Arguments),
    /// Release a hold: starts and switches of tasks continue
    Release(commands::hold::Arguments),
    /// Check this robot for common problems and suggest remedies
    Doctor(commands::doctor::Arguments),
    /// Write man pages to a directory
    Man(commands::man::Arguments),
    /// Supervise one task for the agent; called only by the agent
    #[command(hide = true)]
    Shim {
        /// Directory of the run
        #[arg(long)]
        dir: PathBuf,
    },
    /// Join the ROS graph for the agent; called only by the agent
    #[command(hide = true)]
    Graph,
}

fn main() -> ExitCode {
    let outcome = match CommandLine::parse().command {
        Command::Enroll(arguments) => commands::enroll::run(arguments),
        Command::Configure(arguments) => commands::configure::run(arguments),
        Command::Config(command) => commands::config::run(command),
        Command::Run(arguments) => commands::run::run(arguments),
        Command::Status(arguments) => commands::status::run(arguments),
        Command::Hold(arguments) => commands::hold::hold(arguments),
        Command::Release(arguments) => commands::hold::release(arguments),
        Command::Doctor(arguments) => commands::doctor::run(arguments),
        Command::Man(arguments) => commands::man::run(&arguments, CommandLine::command()),
        Command::Shim { dir } => commands::shim::run(&dir),
        Command::Graph => commands::graph::run(),
    };
    outcome.unwrap_or_else(|error| {
        commands::print_error(&error);
        ExitCode::FAILURE
    })
}
