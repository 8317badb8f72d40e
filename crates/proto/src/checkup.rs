//! Owns the results of `taskd doctor` and `task-agent doctor`, each check with its verdict, finding
//! and remedy; it never checks anything.

use serde::{Deserialize, Serialize};

/// The results of all checks, in the order of the checks.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Checkup {
    /// The checks.
    pub checks: Vec<Check>,
}

/// The result of one check.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Check {
    /// Subject of the check, in a word.
    pub check: String,
    /// Verdict of the check.
    pub verdict: Verdict,
    /// Description of the result.
    pub found: String,
    /// How to repair the problem; absent without a problem.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mend: Option<String>,
}

/// Verdict of a check.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// The checked item is in order.
    Good,
    /// The checked item works, but perhaps not for long or not for all.
    Notice,
    /// The checked item does not work.
    Bad,
}

impl Verdict {
    /// The sign that precedes a line; the line's words say the same.
    pub fn sign(self) -> char {
        match self {
            Self::Good => '✓',
            Self::Notice => '!',
            Self::Bad => '✗',
        }
    }
}

impl Checkup {
    /// Adds a check with a good result.
    pub fn good(&mut self, check: &str, found: impl Into<String>) {
        self.add(check, Verdict::Good, found.into(), None);
    }

    /// Adds a check with a notice.
    pub fn notice(&mut self, check: &str, found: impl Into<String>, mend: impl Into<String>) {
        self.add(check, Verdict::Notice, found.into(), Some(mend.into()));
    }

    /// Adds a check with a bad result.
    pub fn bad(&mut self, check: &str, found: impl Into<String>, mend: impl Into<String>) {
        self.add(check, Verdict::Bad, found.into(), Some(mend.into()));
    }

    fn add(&mut self, check: &str, verdict: Verdict, found: String, mend: Option<String>) {
        self.checks.push(Check { check: check.to_owned(), verdict, found, mend });
    }

    /// Whether no check is bad.
    pub fn is_healthy(&self) -> bool {
        self.checks.iter().all(|check| check.verdict != Verdict::Bad)
    }

    /// Renders a line for each check, its repair below it, and at the end the number of checks that
    /// are not good. Control characters are left out; `paint` may put colours around a sign.
    pub fn text(&self, paint: impl Fn(Verdict) -> String) -> String {
        let one_line = |text: &str| text.replace(char::is_control, " ");
        let mut text = String::new();
        for Check { check, verdict, found, mend } in &self.checks {
            text.push_str(&format!("{} {check:<12} {}\n", paint(*verdict), one_line(found)));
            if let Some(mend) = mend {
                text.push_str(&format!("{:15}→ {}\n", "", one_line(mend)));
            }
        }
        let count = |verdict| self.checks.iter().filter(|check| check.verdict == verdict).count();
        let (bad, notices) = (count(Verdict::Bad), count(Verdict::Notice));
        text.push_str(&match (bad, notices) {
            (0, 0) => "no problems found\n".to_owned(),
            _ => format!("{bad} failed, {notices} to review, {} passed\n", count(Verdict::Good)),
        });
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_check_has_a_line_and_its_remedy_below() {
        let mut checkup = Checkup::default();
        checkup.good("http", "answers");
        assert_eq!(
            checkup.text(|v| v.sign().to_string()),
            "✓ http         answers\nno problems found\n"
        );
        checkup.notice("clock", "6 s\u{1b}[31m ahead", "set it");
        assert!(checkup.is_healthy());
        checkup.bad("disk", "full", "make room");
        assert!(!checkup.is_healthy());
        assert_eq!(
            checkup.text(|v| v.sign().to_string()),
            "✓ http         answers\n! clock        6 s [31m ahead\n               → set it\n\
             ✗ disk         full\n               → make room\n1 failed, 1 to review, 1 passed\n"
        );
    }
}
