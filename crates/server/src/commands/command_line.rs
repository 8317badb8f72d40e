//! The command line of `taskd` as a whole: the input of `main`, of shell completion and of the man
//! pages.

use std::ffi::OsString;

use clap::parser::ValueSource;
use clap::{CommandFactory as _, FromArgMatches as _, Parser, Subcommand};

use crate::commands;
use crate::config::ServeFlags;

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
    /// The typed arguments, with defaults from the environment.
    pub fn read(
        words: impl IntoIterator<Item = impl Into<OsString> + Clone>,
    ) -> Result<Self, clap::Error> {
        let matches = Self::command().try_get_matches_from(words)?;
        let mut read = Self::from_arg_matches(&matches)?;
        let is_typed =
            |option: &str| matches.value_source(option) == Some(ValueSource::CommandLine);
        read.connection.prefer_what_is_typed(is_typed);
        Ok(read)
    }

    /// The command line as clap's own description.
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
            let Command::Serve(flags) = CommandLine::try_parse_from(line).expect("parses").command
            else {
                panic!("{line:?}")
            };
            assert_eq!(flags.settings, [("data", "/d".to_owned())]);
        }
    }
}
