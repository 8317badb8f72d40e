//! Trims a report to the fields that are stored: texts and lists within their bounds, without
//! control characters.

use super::{Condition, HostFacts, MAX_CODE_BYTES, Report};

/// The most conditions of a robot, or entries of another list of its own, that we store.
const MAX_ENTRIES: usize = 32;
/// The longest text of a failure, of a condition and of a fact about the machine, in characters.
pub(super) const MAX_FAILURE_CHARS: usize = 4096;
const MAX_CONDITION_CHARS: usize = 500;
const MAX_FACT_CHARS: usize = 200;

impl Report {
    /// The report as we store it: texts without control characters and within their maximum length,
    /// lists cut to their first entries. The stored report is shown to all users who may see the
    /// robot, at each change.
    #[must_use]
    pub fn tidied(mut self) -> Self {
        self.boot_id = fact(&self.boot_id);
        self.host.tidy();
        self.conditions.truncate(MAX_ENTRIES);
        for Condition { code, text } in &mut self.conditions {
            (*code, *text) = (clean(code, MAX_CODE_BYTES), clean(text, MAX_CONDITION_CHARS));
        }
        for task in &mut self.tasks {
            for failure in [&mut task.failure, &mut task.degraded].into_iter().flatten() {
                failure.text = clean(&failure.text, MAX_FAILURE_CHARS);
            }
        }
        self
    }
}

impl HostFacts {
    fn tidy(&mut self) {
        for text in [&mut self.agent_version, &mut self.hostname, &mut self.arch] {
            *text = fact(text);
        }
        tidy_list(&mut self.ros_distros);
        if let Some(ros) = &mut self.ros {
            ros.distro = fact(&ros.distro);
            ros.rmw = ros.rmw.as_deref().map(fact);
        }
        if let Some(settings) = &mut self.settings {
            tidy_list(&mut settings.own);
            tidy_list(&mut settings.refused);
        }
    }
}

fn tidy_list(texts: &mut Vec<String>) {
    texts.truncate(MAX_ENTRIES);
    texts.iter_mut().for_each(|text| *text = fact(text));
}

fn fact(text: &str) -> String {
    clean(text, MAX_FACT_CHARS)
}

/// The first `max_chars` characters of a text. Control characters, which a package could smuggle
/// in, become spaces.
pub(super) fn clean(text: &str, max_chars: usize) -> String {
    text.chars()
        .map(|c| if c.is_control() && c != '\n' { ' ' } else { c })
        .take(max_chars)
        .collect()
}

#[cfg(test)]
mod tests {
    use super::super::{Failure, FailureCode};
    use super::*;

    #[test]
    fn failure_from_a_robot_is_cleaned() {
        let mut report: Report =
            serde_json::from_str(include_str!("../../../tests/golden/report.json"))
                .expect("a report");
        let text = "a\u{1b}[31mb\n".repeat(MAX_FAILURE_CHARS);
        let said = Failure { code: FailureCode::BUILD_FAILED, text };
        (report.tasks[0].failure, report.tasks[0].degraded) =
            (Some(said.clone()), Some(said.clone()));
        let kept = Failure::new(said.code, said.text);
        assert!(
            kept.text.starts_with("a [31mb\n") && kept.text.chars().count() == MAX_FAILURE_CHARS
        );
        let task = report.tidied().tasks.swap_remove(0);
        assert_eq!((task.failure, task.degraded), (Some(kept.clone()), Some(kept)));
    }
}
