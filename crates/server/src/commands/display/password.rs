//! Reads passwords: from the terminal without echo, or from standard input. Passwords are never
//! arguments or variables, and never printed.

use std::io::{self, BufRead as _, IsTerminal as _};

use clap::Args;
use nix::sys::termios::{LocalFlags, SetArg, Termios, tcgetattr, tcsetattr};

use super::output::say;
use crate::commands::CommandError;

/// The longest line that is read.
const MOST_BYTES: usize = 4 * 1024;

/// Where a password is read. It is never an argument, which others could read.
#[derive(Debug, Clone, Copy, Args)]
pub struct PasswordFrom {
    /// Read the password from standard input, a line each (for one's own: the old one, then the new
    /// one)
    #[arg(long)]
    pub password_stdin: bool,
}

/// A password on its way to the server.
pub(in crate::commands) struct Secret(String);

impl Secret {
    pub(in crate::commands) fn reveal(self) -> String {
        self.0
    }
}

/// Asks for an existing password.
pub(in crate::commands) fn ask(from_stdin: bool, what: &str) -> Result<Secret, CommandError> {
    if !from_stdin && !io::stdin().is_terminal() {
        return Err(CommandError::Usage(format!(
            "{what}: there is no terminal to ask at, give --password-stdin"
        )));
    }
    if !from_stdin {
        say(&format!("{what}:"));
    }
    let quiet = Quiet::begin(from_stdin)?;
    let mut line = Vec::new();
    let read = io::Read::take(io::stdin().lock(), MOST_BYTES as u64).read_until(b'\n', &mut line);
    drop(quiet);
    let failed = |source| CommandError::Io { what: "can't read the password".to_owned(), source };
    read.map_err(failed)?;
    let text = String::from_utf8(line)
        .map_err(|_| CommandError::Usage(format!("{what}: it is not UTF-8")))?;
    let text = text.strip_suffix('\n').unwrap_or(&text);
    let text = text.strip_suffix('\r').unwrap_or(text);
    if text.is_empty() {
        return Err(CommandError::Usage(format!("{what}: nothing was given")));
    }
    Ok(Secret(text.to_owned()))
}

/// Asks for a new password, at a terminal twice.
pub(in crate::commands) fn new_one(from_stdin: bool, what: &str) -> Result<Secret, CommandError> {
    let first = ask(from_stdin, what)?;
    if !from_stdin && ask(false, "once more")?.0 != first.0 {
        return Err(CommandError::Usage(format!("{what}: the two are not the same")));
    }
    Ok(first)
}

/// A terminal without echo until this value is dropped.
struct Quiet(Option<Termios>);

impl Quiet {
    fn begin(from_stdin: bool) -> Result<Self, CommandError> {
        if from_stdin {
            return Ok(Self(None));
        }
        let failed = |error: nix::errno::Errno| CommandError::Io {
            what: "the terminal can't be told not to show the password".to_owned(),
            source: error.into(),
        };
        let before = tcgetattr(io::stdin()).map_err(failed)?;
        let mut quiet = before.clone();
        quiet.local_flags.remove(LocalFlags::ECHO);
        quiet.local_flags.insert(LocalFlags::ECHONL);
        tcsetattr(io::stdin(), SetArg::TCSAFLUSH, &quiet).map_err(failed)?;
        Ok(Self(Some(before)))
    }
}

impl Drop for Quiet {
    fn drop(&mut self) {
        if let Some(before) = &self.0 {
            // Nothing is left to be done if that fails.
            let _ = tcsetattr(io::stdin(), SetArg::TCSAFLUSH, before);
        }
    }
}
