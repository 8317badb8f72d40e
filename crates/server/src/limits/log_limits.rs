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
const MOST_OF_ROBOT: u64 = 10;
/// Maximum lines of one kind in a period.
const MOST_OF_KIND: u64 = 300;
/// Maximum robots that a summary of suppressed lines names.
const MOST_NAMED: usize = 10;
/// The length of a period.
const TURN: Duration = Duration::from_secs(60);

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
    left_out: u64,
    /// The message of the first suppressed line.
    message: String,
}

/// A summary of suppressed lines.
#[derive(Debug, Clone, PartialEq, Eq)]
struct LeftOut {
    lines: u64,
    robot: Option<String>,
    message: String,
}

/// The fields of an event that count here.
#[derive(Default)]
struct Said {
    robot: Option<String>,
    message: String,
}

impl Visit for Said {
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
        let mut ticks = tokio::time::interval(TURN);
        loop {
            tokio::select! {
                () = stop.cancelled() => return,
                _ = ticks.tick() => {}
            }
            for LeftOut { lines, robot, message } in self.turn() {
                match robot {
                    Some(robot) => {
                        tracing::warn!(robot, lines, "lines were left out like: {message}")
                    }
                    None => tracing::warn!(lines, "lines were left out like: {message}"),
                }
            }
        }
    }

    /// Begins a new period; returns the lines suppressed in the previous one.
    fn turn(&self) -> Vec<LeftOut> {
        let kinds = std::mem::take(&mut *self.0.lock().unwrap_or_else(PoisonError::into_inner));
        let mut all = Vec::new();
        for Kind { robots, mut left_out, message, .. } in kinds.into_values() {
            let mut robots: Vec<(String, u64)> =
                robots.into_iter().map(|(robot, (_, out))| (robot, out)).collect();
            robots.retain(|(_, out)| *out > 0);
            robots.sort_by_key(|(_, out)| std::cmp::Reverse(*out));
            for (at, (robot, lines)) in robots.into_iter().enumerate() {
                match at < MOST_NAMED {
                    true => {
                        all.push(LeftOut { lines, robot: Some(robot), message: message.clone() })
                    }
                    false => left_out += lines,
                }
            }
            if left_out > 0 {
                all.push(LeftOut { lines: left_out, robot: None, message });
            }
        }
        all
    }

    /// Whether one more line may be written.
    fn admit(&self, kind: Identifier, said: Said) -> bool {
        let mut kinds = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let kind = kinds.entry(kind).or_default();
        let is_full = kind.lines >= MOST_OF_KIND;
        let robot = match said.robot {
            Some(robot) if is_full => kind.robots.get_mut(&robot),
            Some(robot) => Some(kind.robots.entry(robot).or_default()),
            None => None,
        };
        let left_out = match robot {
            Some((lines, _)) if !is_full && *lines < MOST_OF_ROBOT => {
                *lines += 1;
                kind.lines += 1;
                return true;
            }
            Some((_, left_out)) => left_out,
            None if !is_full => {
                kind.lines += 1;
                return true;
            }
            None => &mut kind.left_out,
        };
        *left_out += 1;
        if kind.message.is_empty() {
            kind.message = said.message;
        }
        false
    }
}

impl<S: Subscriber> Layer<S> for LogLimits {
    fn event_enabled(&self, event: &Event<'_>, _context: Context<'_, S>) -> bool {
        let mut said = Said::default();
        event.record(&mut said);
        self.admit(event.metadata().callsite(), said)
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

    fn complain(robot: u64) {
        tracing::warn!(%robot, "it says nothing of use");
    }

    #[test]
    fn lines_about_one_robot_are_bounded_and_counted() {
        let (limits, count) = (LogLimits::default(), Arc::<AtomicU64>::default());
        let subscriber =
            tracing_subscriber::registry().with(Counter(count.clone())).with(limits.clone());
        tracing::subscriber::with_default(subscriber, || {
            (0..1000).for_each(|_| complain(1));
            assert_eq!(count.swap(0, Relaxed), MOST_OF_ROBOT);
            complain(2);
            tracing::warn!("something else");
            assert_eq!(count.swap(0, Relaxed), 2, "others and other kinds have their own");
            let left_out = LeftOut {
                lines: 1000 - MOST_OF_ROBOT,
                robot: Some("1".to_owned()),
                message: "it says nothing of use".to_owned(),
            };
            assert_eq!(limits.turn(), [left_out]);
            complain(1);
            assert_eq!(count.swap(0, Relaxed), 1);
            assert_eq!(limits.turn(), []);
        });
    }

    #[test]
    fn lines_of_one_kind_are_bounded_however_many_robots_cause_them() {
        let (limits, count) = (LogLimits::default(), Arc::<AtomicU64>::default());
        let subscriber =
            tracing_subscriber::registry().with(Counter(count.clone())).with(limits.clone());
        tracing::subscriber::with_default(subscriber, || {
            (0..10_000).for_each(complain);
            assert_eq!(count.swap(0, Relaxed), MOST_OF_KIND);
            let left_out = limits.turn();
            assert_eq!(
                (left_out.len(), left_out[0].lines, &left_out[0].robot),
                (1, 10_000 - MOST_OF_KIND, &None)
            );
            // The same limit holds without a robot.
            (0..1000).for_each(|_| tracing::warn!("the database is away"));
            assert_eq!(count.load(Relaxed), MOST_OF_KIND);
            assert_eq!(limits.turn()[0].lines, 1000 - MOST_OF_KIND);
        });
    }
}
