//! The `task-agent` binary: parses the command line and hands over. It never holds logic of its
//! own.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::{CommandFactory as _, Parser, Subcommand};
use task_agent::commands;

/// Runs task packages on this robot, as its server orders.
#[derive(Parser)]
#[command(name = "task-agent", version, max_term_width = 110)]
struct CommandLine {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Register this robot at a server
    Enroll(commands::enroll::Arguments),
    /// Ask for this robot's settings and write them to its property file
    Configure(commands::configure::Arguments),
    /// Run this robot's tasks, until a signal; tasks go on running afterwards
    Run(commands::run::Arguments),
    /// Say where this robot's tasks stand; works without server and without a running agent
    Status(commands::status::Arguments),
    /// Let nothing be started or switched on this robot, until `release`; running tasks go on
    Hold(commands::hold::Arguments),
    /// Take a `hold` back
    Release(commands::hold::Arguments),
    /// Look for what commonly goes wrong on this robot, and say how to mend it
    Doctor(commands::doctor::Arguments),
    /// Write man pages
    Man(commands::man::Arguments),
    /// Stand between the agent and one task; only the agent itself calls this
    #[command(hide = true)]
    Shim {
        /// The run's directory
        #[arg(long)]
        dir: PathBuf,
    },
    /// Take part in the ROS graph for the agent; only the agent itself calls this
    #[command(hide = true)]
    Graph,
}

fn main() -> ExitCode {
    let outcome = match CommandLine::parse().command {
        Command::Enroll(arguments) => commands::enroll::run(arguments),
        Command::Configure(arguments) => commands::configure::run(arguments),
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
