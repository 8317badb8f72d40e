//! Asks for confirmation before many robots are changed, and before irreversible actions. The
//! module decides nothing else.

use std::io::IsTerminal as _;

use super::output::say;
use crate::CommandError;

/// Up to this many robots an order is carried out without asking.
const ASK_ABOVE: usize = 10;

/// Whether the order may go on: the order affects few robots, `--yes` was given, or the user at the
/// terminal agrees.
pub(crate) fn confirm(what: &str, robots: usize, yes: bool) -> Result<(), CommandError> {
    if robots <= ASK_ABOVE || yes {
        return Ok(());
    }
    if !std::io::stdin().is_terminal() {
        return Err(CommandError::Usage(format!(
            "{what} affects {robots} robots: confirm with --yes (required above {ASK_ABOVE})"
        )));
    }
    prompt(&format!("{what} affects {robots} robots. Continue? [y/N]"))
}

/// Confirmation of an irreversible action, for any number of robots.
pub(crate) fn confirm_irreversible(what: &str, yes: bool) -> Result<(), CommandError> {
    if yes {
        return Ok(());
    }
    if !std::io::stdin().is_terminal() {
        return Err(CommandError::Usage(format!(
            "{what}: this can't be undone; confirm with --yes"
        )));
    }
    prompt(&format!("{what}? This can't be undone. [y/N]"))
}

fn prompt(question: &str) -> Result<(), CommandError> {
    say(question);
    let mut answer = String::new();
    std::io::stdin()
        .read_line(&mut answer)
        .map_err(|source| CommandError::Io { what: "can't read the answer".to_owned(), source })?;
    match answer.trim().to_lowercase().as_str() {
        "y" | "yes" => Ok(()),
        _ => Err(CommandError::Usage("not confirmed; nothing was changed".to_owned())),
    }
}
