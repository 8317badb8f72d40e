//! The command line of `taskd` as a whole: `serve` beside the operator's commands, the checks of
//! the server that they need, and the commands about the database and the blobs of a stopped
//! server.

mod blobs;
mod config;
mod database;
mod doctor;

use std::ffi::OsString;

use clap::error::ErrorKind;
use clap::parser::ValueSource;
use clap::{CommandFactory as _, FromArgMatches as _, Parser, Subcommand};

pub use self::blobs::{BlobsCommand, BlobsCommandError};
pub use self::config::ConfigCommand;
pub use self::database::DatabaseCommand;
pub use self::doctor::check_server;
use crate::config::ServeFlags;

const EXIT_CODES: &str = "Exit codes: 0 success, 1 failure, 2 invalid command line, setting or package, or no robot \
                          matches, 3 some robots failed, 4 not allowed, 5 timed out";

/// Distribute task packages to robots and run them there
#[derive(Debug, Parser)]
#[command(name = "taskd", version, propagate_version = true, after_help = EXIT_CODES)]
pub struct CommandLine {
    #[command(flatten)]
    pub connection: task_cli::Connection,
    #[command(subcommand)]
    pub command: Command,
}

#[derive(Debug, Subcommand)]
pub enum Command {
    /// Run the server
    Serve(ServeFlags),
    /// One of the operator's commands, of the crate `cli`.
    #[command(flatten)]
    Operator(task_cli::Command),
    /// Check a configuration file, and list all keys
    #[command(subcommand)]
    Config(ConfigCommand),
    /// Copy the database of a stopped server
    #[command(subcommand)]
    Database(DatabaseCommand),
    /// Move the packages of a stopped server to a common store
    #[command(subcommand)]
    Blobs(BlobsCommand),
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
        read.connection.prefer_typed_options(is_typed);
        if let Command::Database(command) = &read.command {
            let invalid = |text| Self::command().error(ErrorKind::ValueValidation, text);
            command.check().map_err(invalid)?;
        }
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
    fn command_line_is_consistent() {
        CommandLine::describe().debug_assert();
    }

    #[test]
    fn data_option_may_precede_or_follow_the_command() {
        for line in [["taskd", "--data", "/d", "serve"], ["taskd", "serve", "--data", "/d"]] {
            let Command::Serve(flags) = CommandLine::try_parse_from(line).expect("parses").command
            else {
                panic!("{line:?}")
            };
            assert_eq!(flags.settings, [("data", "/d".to_owned())]);
        }
    }
}
