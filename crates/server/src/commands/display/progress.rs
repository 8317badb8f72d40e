//! Progress on stderr: a bar per robot for a few robots, one bar for many, plain lines without a
//! terminal.

use std::collections::HashMap;

use indicatif::{MultiProgress, ProgressBar, ProgressFinish, ProgressStyle};
use task_proto::RobotId;
use task_proto::api::{AssignmentView, DeploymentView, names};
use task_proto::report::Phase;
use tokio::time::Instant;

use super::course::Course;
use super::output::{printable, say, stderr_is_terminal};

/// Up to this many robots each gets its own bar.
const MAX_BARS: usize = 20;
/// Robots that are named behind the counts.
const MAX_NAMES: usize = 3;

/// A bar for an upload of `size` bytes.
pub(in crate::commands) fn upload_bar(size: u64) -> ProgressBar {
    if !stderr_is_terminal() {
        return ProgressBar::hidden();
    }
    let style = ProgressStyle::with_template(
        "uploading {bar:30} {bytes}/{total_bytes} {binary_bytes_per_sec}",
    );
    let bar = ProgressBar::new(size).with_finish(ProgressFinish::AndClear);
    if let Ok(style) = style {
        bar.set_style(style);
    }
    bar
}

/// Progress display of one deployment.
pub(in crate::commands) struct DeploymentProgress {
    bars: MultiProgress,
    moving: bool,
    robots: HashMap<RobotId, ProgressBar>,
    summary: Option<ProgressBar>,
    bytes: Option<ProgressBar>,
    course: Course,
    since: Instant,
    said: HashMap<RobotId, Phase>,
    said_summary: String,
}

impl DeploymentProgress {
    pub(in crate::commands) fn new() -> Self {
        Self {
            bars: MultiProgress::new(),
            moving: stderr_is_terminal(),
            robots: HashMap::new(),
            summary: None,
            bytes: None,
            course: Course::default(),
            since: Instant::now(),
            said: HashMap::new(),
            said_summary: String::new(),
        }
    }

    /// Shows the deployment's present state.
    pub(in crate::commands) fn show(&mut self, view: &DeploymentView) {
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
        let estimate = self.course.look(view, self.since.elapsed());
        if !self.moving || estimate.total == 0 {
            return;
        }
        let bars = &self.bars;
        let bar = self.bytes.get_or_insert_with(|| styled(bars));
        bar.set_length(estimate.total);
        bar.set_position(estimate.done);
        bar.set_message(estimate.text());
    }

    fn show_robot(&mut self, assignment: &AssignmentView, is_settled: bool) {
        if !self.moving {
            if self.said.insert(assignment.robot.clone(), assignment.phase)
                != Some(assignment.phase)
            {
                say(&line(assignment));
            }
            return;
        }
        let bars = &self.bars;
        let bar = self.robots.entry(assignment.robot.clone()).or_insert_with(|| styled(bars));
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
        bar.set_message(line(assignment));
    }

    fn show_summary(&mut self, view: &DeploymentView, assignments: &[AssignmentView]) {
        let counts: Vec<_> =
            view.counts.iter().map(|count| format!("{} {}", count.count, count.phase)).collect();
        let awaited = view.awaited();
        let mut text = counts.join(", ");
        for (title, robots) in [("waits for", &awaited.busy), ("offline", &awaited.offline)] {
            if !robots.is_empty() {
                text.push_str(&printable(&format!("; {title}: {}", names(robots, MAX_NAMES))));
            }
        }
        if !self.moving {
            if self.said_summary != text {
                say(&text);
                self.said_summary = text;
            }
            return;
        }
        let bars = &self.bars;
        let bar = self.summary.get_or_insert_with(|| styled(bars));
        bar.set_length(assignments.len() as u64);
        bar.set_position(
            assignments.iter().filter(|assignment| assignment.phase.is_settled(view.kind)).count()
                as u64,
        );
        bar.set_message(text);
    }

    /// Removes the bars, so that the result stands alone.
    pub(in crate::commands) fn finish(self) {
        for bar in self.robots.into_values().chain(self.summary).chain(self.bytes) {
            bar.finish_and_clear();
        }
    }
}

fn styled(bars: &MultiProgress) -> ProgressBar {
    let bar = bars.add(ProgressBar::new(0));
    if let Ok(style) = ProgressStyle::with_template("{bar:20} {msg}") {
        bar.set_style(style);
    }
    bar
}

fn line(assignment: &AssignmentView) -> String {
    let offline = if assignment.online { "" } else { " (offline)" };
    let reason =
        assignment.failure.as_ref().map_or_else(String::new, |failure| format!(": {failure}"));
    printable(&format!("{} {}{offline}{reason}", assignment.name, assignment.phase))
}
