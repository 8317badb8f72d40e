//! Progress on stderr: a bar per robot for a few robots, one bar for many, plain lines without a
//! terminal.

use std::collections::HashMap;
use std::fmt;

use indicatif::{MultiProgress, ProgressBar, ProgressFinish, ProgressState, ProgressStyle};
use task_proto::RobotId;
use task_proto::api::{AssignmentView, DeploymentView, join_names};
use task_proto::messages::report::Phase;
use task_proto::size::{format_bytes, format_rate};
use tokio::time::Instant;

use super::output::{printable, say, stderr_is_terminal};
use super::transfer_eta::TransferEta;

/// Up to this many robots each gets its own bar.
const MAX_BARS: usize = 20;
/// Robots that are named behind the counts.
const MAX_NAMES: usize = 3;

/// A bar for an upload of `size` bytes.
pub(crate) fn upload_bar(size: u64) -> ProgressBar {
    if !stderr_is_terminal() {
        return ProgressBar::hidden();
    }
    let bar = ProgressBar::new(size).with_finish(ProgressFinish::AndClear);
    if let Ok(style) = ProgressStyle::with_template("uploading {bar:30} {transferred}") {
        bar.set_style(style.with_key("transferred", write_transferred));
    }
    bar
}

/// `12 MB of 40 MB, 3 MB/s`.
fn write_transferred(state: &ProgressState, text: &mut dyn fmt::Write) {
    let (done, total) = (format_bytes(state.pos()), format_bytes(state.len().unwrap_or_default()));
    // A text in memory takes everything.
    let _ = write!(text, "{done} of {total}, {}", format_rate(state.per_sec() as u64));
}

/// Progress display of one deployment.
pub(crate) struct DeploymentProgress {
    bars: MultiProgress,
    is_terminal: bool,
    robots: HashMap<RobotId, ProgressBar>,
    summary: Option<ProgressBar>,
    bytes: Option<ProgressBar>,
    transfer_eta: TransferEta,
    since: Instant,
    printed: HashMap<RobotId, Phase>,
    printed_summary: String,
}

impl DeploymentProgress {
    pub(crate) fn new() -> Self {
        Self {
            bars: MultiProgress::new(),
            is_terminal: stderr_is_terminal(),
            robots: HashMap::new(),
            summary: None,
            bytes: None,
            transfer_eta: TransferEta::default(),
            since: Instant::now(),
            printed: HashMap::new(),
            printed_summary: String::new(),
        }
    }

    /// Shows the deployment's present state.
    pub(crate) fn show(&mut self, view: &DeploymentView) {
        let assignments = view.assignments.as_deref().unwrap_or_default();
        self.show_bytes(view);
        if assignments.len() > MAX_BARS {
            self.show_summary(view, assignments);
        } else {
            for assignment in assignments {
                self.show_robot(assignment, assignment.phase.is_settled(view.kind));
            }
        }
    }

    /// Shows transferred bytes, rate and remaining time; only on a terminal.
    fn show_bytes(&mut self, view: &DeploymentView) {
        let estimate = self.transfer_eta.observe(view, self.since.elapsed());
        if !self.is_terminal || estimate.total == 0 {
            return;
        }
        let bars = &self.bars;
        let bar = self.bytes.get_or_insert_with(|| add_bar(bars));
        bar.set_length(estimate.total);
        bar.set_position(estimate.done);
        bar.set_message(estimate.text());
    }

    fn show_robot(&mut self, assignment: &AssignmentView, is_settled: bool) {
        if !self.is_terminal {
            if self.printed.insert(assignment.robot.clone(), assignment.phase)
                != Some(assignment.phase)
            {
                say(&robot_line(assignment));
            }
            return;
        }
        let bars = &self.bars;
        let bar = self.robots.entry(assignment.robot.clone()).or_insert_with(|| add_bar(bars));
        match assignment.progress {
            Some(progress) => {
                bar.set_length(progress.total);
                bar.set_position(progress.done);
            }
            // A bar of no length would be full.
            None => {
                bar.set_length(1);
                bar.set_position(u64::from(is_settled));
            }
        }
        bar.set_message(robot_line(assignment));
    }

    fn show_summary(&mut self, view: &DeploymentView, assignments: &[AssignmentView]) {
        let counts: Vec<_> =
            view.counts.iter().map(|count| format!("{} {}", count.count, count.phase)).collect();
        let unsettled = view.unsettled_robots();
        let mut text = counts.join(", ");
        for (title, robots) in [("waiting for", &unsettled.busy), ("offline", &unsettled.offline)] {
            if !robots.is_empty() {
                text.push_str(&printable(&format!("; {title}: {}", join_names(robots, MAX_NAMES))));
            }
        }
        if !self.is_terminal {
            if self.printed_summary != text {
                say(&text);
                self.printed_summary = text;
            }
            return;
        }
        let bars = &self.bars;
        let bar = self.summary.get_or_insert_with(|| add_bar(bars));
        bar.set_length(assignments.len() as u64);
        bar.set_position(
            assignments.iter().filter(|assignment| assignment.phase.is_settled(view.kind)).count()
                as u64,
        );
        bar.set_message(text);
    }

    /// Removes the bars, so that the result stands alone.
    pub(crate) fn finish(self) {
        for bar in self.robots.into_values().chain(self.summary).chain(self.bytes) {
            bar.finish_and_clear();
        }
    }
}

fn add_bar(bars: &MultiProgress) -> ProgressBar {
    let bar = bars.add(ProgressBar::new(0));
    if let Ok(style) = ProgressStyle::with_template("{bar:20} {msg}") {
        bar.set_style(style);
    }
    bar
}

fn robot_line(assignment: &AssignmentView) -> String {
    let offline = if assignment.online { "" } else { " (offline)" };
    let reason =
        assignment.failure.as_ref().map_or_else(String::new, |failure| format!(": {failure}"));
    printable(&format!("{} {}{offline}{reason}", assignment.name, assignment.phase))
}
