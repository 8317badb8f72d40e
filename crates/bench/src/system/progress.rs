//! Progress on stderr: a bar with the current step, or plain lines without a terminal.

use std::io::{IsTerminal as _, Write as _};

use indicatif::{ProgressBar, ProgressFinish, ProgressStyle};

/// Maximum percentage of steps between two printed lines without a terminal.
const LINE_EVERY_PERCENT: u64 = 10;

/// Progress of a run.
pub struct RunProgress {
    bar: Option<ProgressBar>,
    steps: u64,
    done: u64,
}

impl RunProgress {
    /// A run of `steps` steps.
    pub fn new(steps: usize) -> Self {
        let steps = steps as u64;
        let bar = std::io::stderr().is_terminal().then(|| {
            let bar = ProgressBar::new(steps).with_finish(ProgressFinish::AndClear);
            let style =
                ProgressStyle::with_template("{bar:30} {pos}/{len} {elapsed}, {eta} left  {msg}");
            if let Ok(style) = style {
                bar.set_style(style);
            }
            bar
        });
        Self { bar, steps, done: 0 }
    }

    /// Sets the current step.
    pub fn set_message(&self, text: &str) {
        match &self.bar {
            Some(bar) => bar.set_message(text.to_owned()),
            None if self.steps <= 100 / LINE_EVERY_PERCENT => print_line(text),
            None => {}
        }
    }

    /// A step is done.
    pub fn step(&mut self) {
        self.done += 1;
        match &self.bar {
            Some(bar) => bar.inc(1),
            None => {
                let tenth = |done: u64| done * 100 / self.steps.max(1) / LINE_EVERY_PERCENT;
                if tenth(self.done) != tenth(self.done - 1) {
                    print_line(&format!("{} of {}", self.done, self.steps));
                }
            }
        }
    }
}

/// A line on stderr; a broken stderr is no reason to stop.
pub fn print_line(text: &str) {
    let _ = writeln!(std::io::stderr(), "{text}");
}
