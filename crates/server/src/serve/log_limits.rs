//! Limits log lines per minute: of one kind about one robot, and of one kind in total. So lines
//! that robots, people or strangers cause repeatedly can't fill the disk. Suppressed lines are
//! counted and summarized once a minute.

use std::collections::HashMap;
use std::fmt;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use tokio_util::sync::CancellationToken;
use tracing::callsite::Identifier;
use tracing::field::{Field, Visit};
use tracing::{Event, Subscriber};
use tracing_subscriber::layer::{Context, Layer};

/// Maximum lines of one kind about one robot in a period.
const MAX_PER_ROBOT: u64 = 10;
/// Maximum lines of one kind in a period.
const MAX_PER_KIND: u64 = 300;
/// Maximum robots that a summary of suppressed lines names.
const MAX_NAMED: usize = 10;
/// The length of a period.
const PERIOD: Duration = Duration::from_secs(60);

/// Decides which events are logged. Clones count together.
#[derive(Debug, Clone, Default)]
pub struct LogLimits(Arc<Mutex<HashMap<Identifier, Kind>>>);

/// The lines of one statement in this period.
#[derive(Debug, Default)]
struct Kind {
    lines: u64,
    /// For each robot, the counts of written and suppressed lines.
    robots: HashMap<String, (u64, u64)>,
    /// Lines suppressed about robots without a count of their own, or about no robot.
    suppressed: u64,
    /// The message of the first suppressed line.
    message: String,
}

/// A summary of suppressed lines.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Suppressed {
    lines: u64,
    robot: Option<String>,
    message: String,
}

/// The fields of an event that count here.
#[derive(Default)]
struct LogFields {
    robot: Option<String>,
    message: String,
}

impl Visit for LogFields {
    fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
        match field.name() {
            "robot" => self.robot = Some(format!("{value:?}")),
            "message" => self.message = format!("{value:?}"),
            _ => {}
        }
    }
}

impl LogLimits {
    /// Logs a summary of suppressed lines once a minute, until `stop`.
    pub async fn run(self, stop: CancellationToken) {
        let mut ticks = tokio::time::interval(PERIOD);
        loop {
            tokio::select! {
                () = stop.cancelled() => return,
                _ = ticks.tick() => {}
            }
            for Suppressed { lines, robot, message } in self.next_period() {
                match robot {
                    Some(robot) => {
                        tracing::warn!(robot, lines, "suppressed similar log lines: {message}")
                    }
                    None => tracing::warn!(lines, "suppressed similar log lines: {message}"),
                }
            }
        }
    }

    /// Begins a new period; returns the lines suppressed in the previous one.
    fn next_period(&self) -> Vec<Suppressed> {
        let kinds = std::mem::take(&mut *self.0.lock().unwrap_or_else(PoisonError::into_inner));
        let mut all = Vec::new();
        for Kind { robots, mut suppressed, message, .. } in kinds.into_values() {
            let mut robots: Vec<(String, u64)> =
                robots.into_iter().map(|(robot, (_, suppressed))| (robot, suppressed)).collect();
            robots.retain(|(_, suppressed)| *suppressed > 0);
            robots.sort_by_key(|(_, suppressed)| std::cmp::Reverse(*suppressed));
            for (at, (robot, lines)) in robots.into_iter().enumerate() {
                match at < MAX_NAMED {
                    true => {
                        all.push(Suppressed { lines, robot: Some(robot), message: message.clone() })
                    }
                    false => suppressed += lines,
                }
            }
            if suppressed > 0 {
                all.push(Suppressed { lines: suppressed, robot: None, message });
            }
        }
        all
    }

    /// Whether one more line may be written.
    fn admit(&self, kind: Identifier, fields: LogFields) -> bool {
        let mut kinds = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let kind = kinds.entry(kind).or_default();
        let is_full = kind.lines >= MAX_PER_KIND;
        let robot = match fields.robot {
            Some(robot) if is_full => kind.robots.get_mut(&robot),
            Some(robot) => Some(kind.robots.entry(robot).or_default()),
            None => None,
        };
        let suppressed = match robot {
            Some((lines, _)) if !is_full && *lines < MAX_PER_ROBOT => {
                *lines += 1;
                kind.lines += 1;
                return true;
            }
            Some((_, suppressed)) => suppressed,
            None if !is_full => {
                kind.lines += 1;
                return true;
            }
            None => &mut kind.suppressed,
        };
        *suppressed += 1;
        if kind.message.is_empty() {
            kind.message = fields.message;
        }
        false
    }
}

impl<S: Subscriber> Layer<S> for LogLimits {
    fn event_enabled(&self, event: &Event<'_>, _context: Context<'_, S>) -> bool {
        let mut fields = LogFields::default();
        event.record(&mut fields);
        self.admit(event.metadata().callsite(), fields)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

    use tracing_subscriber::layer::SubscriberExt as _;

    use super::*;

    /// Counts the events that pass.
    struct Counter(Arc<AtomicU64>);

    impl<S: Subscriber> Layer<S> for Counter {
        fn on_event(&self, _event: &Event<'_>, _context: Context<'_, S>) {
            self.0.fetch_add(1, Relaxed);
        }
    }

    fn log_about(robot: u64) {
        tracing::warn!(%robot, "an invalid report");
    }

    #[test]
    fn lines_about_one_robot_are_bounded_and_counted() {
        let (limits, count) = (LogLimits::default(), Arc::<AtomicU64>::default());
        let subscriber =
            tracing_subscriber::registry().with(Counter(count.clone())).with(limits.clone());
        tracing::subscriber::with_default(subscriber, || {
            (0..1000).for_each(|_| log_about(1));
            assert_eq!(count.swap(0, Relaxed), MAX_PER_ROBOT);
            log_about(2);
            tracing::warn!("something else");
            assert_eq!(count.swap(0, Relaxed), 2, "others and other kinds have their own");
            let suppressed = Suppressed {
                lines: 1000 - MAX_PER_ROBOT,
                robot: Some("1".to_owned()),
                message: "an invalid report".to_owned(),
            };
            assert_eq!(limits.next_period(), [suppressed]);
            log_about(1);
            assert_eq!(count.swap(0, Relaxed), 1);
            assert_eq!(limits.next_period(), []);
        });
    }

    #[test]
    fn lines_of_one_kind_are_bounded_however_many_robots_cause_them() {
        let (limits, count) = (LogLimits::default(), Arc::<AtomicU64>::default());
        let subscriber =
            tracing_subscriber::registry().with(Counter(count.clone())).with(limits.clone());
        tracing::subscriber::with_default(subscriber, || {
            (0..10_000).for_each(log_about);
            assert_eq!(count.swap(0, Relaxed), MAX_PER_KIND);
            let suppressed = limits.next_period();
            assert_eq!(
                (suppressed.len(), suppressed[0].lines, &suppressed[0].robot),
                (1, 10_000 - MAX_PER_KIND, &None)
            );
            // The same limit holds without a robot.
            (0..1000).for_each(|_| tracing::warn!("the database is away"));
            assert_eq!(count.load(Relaxed), MAX_PER_KIND);
            assert_eq!(limits.next_period()[0].lines, 1000 - MAX_PER_KIND);
        });
    }
}
