//! The command line of `taskd` as a whole: what `main` parses, what shells complete and what the man pages are made of.

use clap::{CommandFactory as _, Parser, Subcommand};

use crate::commands;
use crate::config::ServeFlags;

/// See [`commands::Outcome`].
const EXIT_CODES: &str = "Exit codes: 0 done, 1 failed, 2 the command line, a setting or the package is wrong or no robot \
                          is meant, 3 some robots failed, 4 not allowed, 5 not done in time";

/// Distributes task packages to robots and runs them there
#[derive(Debug, Parser)]
#[command(name = "taskd", version, propagate_version = true, after_help = EXIT_CODES)]
pub struct CommandLine {
    /// Where the server is and who asks.
    #[command(flatten)]
    pub connection: commands::Connection,
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

/// What `taskd` does.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Run the server
    Serve(ServeFlags),
    /// One of the operator's commands.
    #[command(flatten)]
    Operator(commands::Command),
}

impl CommandLine {
    /// The same as clap's own description of it.
    pub fn describe() -> clap::Command {
        Self::command()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_line_is_consistent() {
        CommandLine::describe().debug_assert();
    }

    #[test]
    fn the_data_directory_may_be_named_before_the_command_or_after_it() {
        for line in [["taskd", "--data", "/d", "serve"], ["taskd", "serve", "--data", "/d"]] {
            let Command::Serve(flags) = CommandLine::try_parse_from(line).expect("parses").command else {
                panic!("{line:?}")
            };
            assert_eq!(flags.settings, [("data", "/d".to_owned())]);
        }
    }
}
