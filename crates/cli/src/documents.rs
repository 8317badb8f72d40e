//! Owns the documents that a packager installs beside the program, completion scripts and man
//! pages; it never names an option.
//!
//! `taskd completions` and `taskd man` generate them from the command line itself, so they can't
//! describe missing options.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use clap_complete::env::Shells;

use crate::api::complete::VARIABLE;
use crate::display::output::{say, stream_text};
use crate::{CommandError, Outcome};

/// The shell to complete for.
#[derive(Debug, Args)]
pub struct CompletionsArgs {
    /// Shell to complete for
    shell: Shell,
}

/// A shell whose words can be completed.
#[derive(Debug, Clone, Copy, ValueEnum)]
enum Shell {
    /// source <(taskd completions bash)
    Bash,
    /// source <(taskd completions zsh), after compinit
    Zsh,
    /// taskd completions fish | source
    Fish,
}

/// The directory of the pages.
#[derive(Debug, Args)]
pub struct ManArgs {
    /// Directory, created if missing; for MANPATH, name it man1 and list its parent
    directory: PathBuf,
}

/// Prints the script for a shell. The script calls this program, by its name in PATH, at each
/// completion.
pub(super) fn completions(args: &CompletionsArgs) -> Result<Outcome, CommandError> {
    let name = match args.shell {
        Shell::Bash => "bash",
        Shell::Zsh => "zsh",
        Shell::Fish => "fish",
    };
    let failed = |source| CommandError::Io { what: "can't write the script".to_owned(), source };
    let shells = Shells::builtins();
    let shell = shells
        .completer(name)
        .ok_or_else(|| CommandError::Usage(format!("{name}: unsupported shell")))?;
    let mut script = Vec::new();
    shell.write_registration(VARIABLE, "taskd", "taskd", "taskd", &mut script).map_err(failed)?;
    stream_text(&String::from_utf8_lossy(&script))?;
    Ok(Outcome::Succeeded)
}

/// Writes a page for each command.
pub(super) fn man(args: &ManArgs, command_line: clap::Command) -> Result<Outcome, CommandError> {
    let directory = &args.directory;
    let failed = |source| CommandError::Io {
        what: format!("can't write to {}", directory.display()),
        source,
    };
    std::fs::create_dir_all(directory).map_err(failed)?;
    clap_mangen::generate_to(command_line, directory).map_err(failed)?;
    say(&format!("read the pages with: man {}", directory.join("taskd.1").display()));
    Ok(Outcome::Succeeded)
}
