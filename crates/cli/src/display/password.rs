//! Reads passwords: from the terminal without echo, or from standard input. Passwords are never
//! arguments or variables, and never printed.

use std::io::{self, BufRead as _, IsTerminal as _};

use clap::Args;
use nix::sys::termios::{LocalFlags, SetArg, Termios, tcgetattr, tcsetattr};

use super::output::say;
use crate::CommandError;

/// The longest line that is read.
const MAX_LINE_BYTES: usize = 4 * 1024;

/// The source of a password. Never an argument: other users could read it.
#[derive(Debug, Clone, Copy, Args)]
pub struct PasswordSource {
    /// Read the password from standard input; to change your own, give the current and the new
    /// password on a line each
    #[arg(long)]
    pub password_stdin: bool,
}

/// A password on its way to the server.
pub(crate) struct Secret(String);

impl Secret {
    pub(crate) fn reveal(self) -> String {
        self.0
    }
}

/// Asks for an existing password.
pub(crate) fn prompt(from_stdin: bool, what: &str) -> Result<Secret, CommandError> {
    if !from_stdin && !io::stdin().is_terminal() {
        return Err(CommandError::Usage(format!("{what}: not a terminal; use --password-stdin")));
    }
    if !from_stdin {
        say(&format!("{what}:"));
    }
    let no_echo = NoEcho::begin(from_stdin)?;
    let mut line = Vec::new();
    let read =
        io::Read::take(io::stdin().lock(), MAX_LINE_BYTES as u64).read_until(b'\n', &mut line);
    drop(no_echo);
    let failed = |source| CommandError::Io { what: "can't read the password".to_owned(), source };
    read.map_err(failed)?;
    let text =
        String::from_utf8(line).map_err(|_| CommandError::Usage(format!("{what}: not UTF-8")))?;
    let text = text.strip_suffix('\n').unwrap_or(&text);
    let text = text.strip_suffix('\r').unwrap_or(text);
    if text.is_empty() {
        return Err(CommandError::Usage(format!("{what}: empty")));
    }
    Ok(Secret(text.to_owned()))
}

/// Asks for a new password, at a terminal twice.
pub(crate) fn prompt_new(from_stdin: bool, what: &str) -> Result<Secret, CommandError> {
    let first = prompt(from_stdin, what)?;
    if !from_stdin && prompt(false, "repeat the password")?.0 != first.0 {
        return Err(CommandError::Usage(format!("{what}: the passwords don't match")));
    }
    Ok(first)
}

/// A terminal without echo until this value is dropped.
struct NoEcho(Option<Termios>);

impl NoEcho {
    fn begin(from_stdin: bool) -> Result<Self, CommandError> {
        if from_stdin {
            return Ok(Self(None));
        }
        let failed = |error: nix::errno::Errno| CommandError::Io {
            what: "can't turn off the terminal's echo".to_owned(),
            source: error.into(),
        };
        let before = tcgetattr(io::stdin()).map_err(failed)?;
        let mut no_echo = before.clone();
        no_echo.local_flags.remove(LocalFlags::ECHO);
        no_echo.local_flags.insert(LocalFlags::ECHONL);
        tcsetattr(io::stdin(), SetArg::TCSAFLUSH, &no_echo).map_err(failed)?;
        Ok(Self(Some(before)))
    }
}

impl Drop for NoEcho {
    fn drop(&mut self) {
        if let Some(before) = &self.0 {
            // Nothing is left to be done if that fails.
            let _ = tcsetattr(io::stdin(), SetArg::TCSAFLUSH, before);
        }
    }
}
