//! Asks for confirmation before many robots are changed, and before irreversible actions. The
//! module decides nothing else.

use std::io::IsTerminal as _;

use super::output::say;
use crate::commands::CommandError;

/// Up to this many robots an order is carried out without asking.
const ASK_ABOVE: usize = 10;

/// Whether the order may go on: the order affects few robots, `--yes` was given, or the user at the
/// terminal agrees.
pub(in crate::commands) fn confirm(
    what: &str,
    robots: usize,
    yes: bool,
) -> Result<(), CommandError> {
    if robots <= ASK_ABOVE || yes {
        return Ok(());
    }
    if !std::io::stdin().is_terminal() {
        return Err(CommandError::Usage(format!(
            "{what} means {robots} robots: give --yes for more than {ASK_ABOVE}"
        )));
    }
    ask(&format!("{what} means {robots} robots. Go on? [y/N]"))
}

/// Confirmation of an irreversible action, for any number of robots.
pub(in crate::commands) fn always(what: &str, yes: bool) -> Result<(), CommandError> {
    if yes {
        return Ok(());
    }
    if !std::io::stdin().is_terminal() {
        return Err(CommandError::Usage(format!("{what}: this can't be undone, give --yes")));
    }
    ask(&format!("{what}? This can't be undone. [y/N]"))
}

fn ask(question: &str) -> Result<(), CommandError> {
    say(question);
    let mut answer = String::new();
    std::io::stdin()
        .read_line(&mut answer)
        .map_err(|source| CommandError::Io { what: "can't read the answer".to_owned(), source })?;
    match answer.trim().to_lowercase().as_str() {
        "y" | "yes" => Ok(()),
        _ => Err(CommandError::Usage("not confirmed; nothing was ordered".to_owned())),
    }
}
