//! `taskd database`: what an operator does with the database of a stopped server.

use std::io::{self, Write as _};

use clap::Subcommand;

use crate::domain::database_url;
use crate::store::{CopyError, copy_database};

#[derive(Debug, Subcommand)]
pub enum DatabaseCommand {
    /// Copy all rows to an empty database, from SQLite to Postgres or back
    ///
    /// Stop the servers of both databases first. TO stays empty until all rows are copied and
    /// compared; after an interruption, run the command again. The password for Postgres is read
    /// from PGPASSWORD or ~/.pgpass.
    Copy {
        /// URL of the database to copy: sqlite:/DIR/taskd.sqlite or postgres://USER@HOST/NAME
        from: String,
        /// URL of an empty database; a SQLite file is created
        to: String,
    },
}

impl DatabaseCommand {
    /// Refuses an invalid URL, and one with a password. The text never repeats a URL.
    pub fn check(&self) -> Result<(), String> {
        let Self::Copy { from, to } = self;
        for (name, url) in [("FROM", from), ("TO", to)] {
            database_url::check(url).map_err(|error| format!("{name}: {error}"))?;
            if database_url::has_password(url) {
                return Err(format!(
                    "{name}: every user of this machine can read a command line; put the password into PGPASSWORD or \
                     ~/.pgpass"
                ));
            }
        }
        Ok(())
    }

    /// Runs the command. Results are on stdout.
    pub async fn run(&self) -> Result<(), CopyError> {
        let Self::Copy { from, to } = self;
        // A closed stdout does not stop the copy.
        let mut stdout = io::stdout();
        let mut total = 0;
        copy_database(from, to, |table, rows| {
            total += rows;
            let _ = writeln!(stdout, "{table:<20} {rows:>12}");
        })
        .await?;
        // The URL has no password.
        let _ = write!(
            stdout,
            "\n{total} rows copied and compared. Next, name the copy in the server's settings and start the server:\n\
             \n\
             \x20   database = \"{to}\"\n"
        );
        Ok(())
    }
}
