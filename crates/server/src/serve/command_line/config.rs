//! `taskd config`: checks a configuration file and lists the keys. Starts and creates nothing.

use std::io::{self, Write as _};
use std::path::PathBuf;

use clap::Subcommand;

use crate::config::{Config, ConfigError, reference};

#[derive(Debug, Subcommand)]
pub enum ConfigCommand {
    /// Check a configuration file as taskd serve would read it
    ///
    /// Names file, line and key of each error and exits with 2. The TASKD_* variables count as for
    /// taskd serve: run it with those of the service.
    Check {
        /// The configuration file, such as /etc/taskd/taskd.toml
        file: PathBuf,
    },
    /// Print all keys of taskd.toml and task.toml with their defaults, in Markdown
    Reference,
}

impl ConfigCommand {
    /// Runs the command; whether the file is valid.
    pub fn run(&self) -> Result<bool, ConfigError> {
        match self {
            Self::Check { file } => {
                let problems = Config::check_file(file, std::env::vars_os())?;
                let name = file.display().to_string();
                for problem in &problems {
                    let _ = writeln!(io::stderr(), "{}", problem.at(&name));
                }
                if problems.is_empty() {
                    let _ = writeln!(io::stdout(), "{name} is valid");
                }
                Ok(problems.is_empty())
            }
            Self::Reference => {
                let _ = write!(
                    io::stdout(),
                    "## The server: taskd.toml\n\n{}\n## Packages: task.toml\n\n{}",
                    reference(),
                    task_package::task_toml::reference()
                );
                Ok(true)
            }
        }
    }
}
