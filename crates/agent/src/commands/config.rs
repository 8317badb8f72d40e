//! `task-agent config`: checks a property file and lists the keys. Starts and writes nothing.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::Subcommand;

use super::say;
use crate::config;

/// Exit code for a file that the agent would refuse.
const INVALID: u8 = 2;

#[derive(Debug, Subcommand)]
pub enum ConfigCommand {
    /// Check a property file as task-agent run would read it
    ///
    /// Names file, line and key of each error and exits with 2. The TASK_AGENT_* variables count as
    /// for task-agent run.
    Check {
        /// The property file, such as /var/lib/task-agent/agent.toml
        file: PathBuf,
    },
    /// Print all keys of agent.toml with their defaults, in Markdown
    Reference,
}

/// Runs the command.
pub fn run(command: ConfigCommand) -> anyhow::Result<ExitCode> {
    match command {
        ConfigCommand::Check { file } => Ok(check(&file)),
        ConfigCommand::Reference => {
            say(format_args!("## The agent: agent.toml\n\n{}", config::reference().trim_end()));
            Ok(ExitCode::SUCCESS)
        }
    }
}

fn check(file: &std::path::Path) -> ExitCode {
    let name = file.display().to_string();
    let problems = match config::check_file(file, std::env::vars_os()) {
        Ok(problems) => problems.iter().map(|problem| problem.at(&name)).collect(),
        Err(error) => vec![task_proto::error_chain::chain(&error)],
    };
    if problems.is_empty() {
        say(format_args!("{name} is valid"));
        return ExitCode::SUCCESS;
    }
    for problem in problems {
        super::print_line_of_error(&problem);
    }
    ExitCode::from(INVALID)
}
