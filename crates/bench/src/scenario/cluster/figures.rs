//! The figures of a run: how soon orders arrive and reports are stored, before, during and after
//! the fault, how soon robots are back, and the resources for that. It never judges a figure.

use std::time::Duration;

use super::database::Counters;
use super::engines::Engines;
use super::faults::FaultTimes;
use super::load::Record;
use super::robot_logs::RobotLogs;
use crate::results::run::{Point, Unit};
use crate::system::process::Usage;

/// The time after the beginning of a fault that counts as its first moments.
const FIRST: Duration = Duration::from_secs(10);

/// The resources of all engines at one moment.
#[derive(Debug, Clone, Default)]
pub struct Resources {
    /// Of each server.
    pub nodes: Vec<Usage>,
    /// Of all database servers together.
    pub postgres: Usage,
    pub counters: Counters,
    pub notifications: u64,
    pub at_ns: u64,
}

impl Resources {
    pub fn now(engines: &Engines, counters: Counters, notifications: u64) -> Self {
        let standby = engines.standby.as_ref().map(|standby| standby.usage()).unwrap_or_default();
        Self {
            nodes: engines.nodes.iter().map(super::engines::Node::usage).collect(),
            postgres: engines.primary.usage().plus(standby),
            counters,
            notifications,
            at_ns: crate::system::clock::monotonic_ns(),
        }
    }

    /// The use of resources since `from`.
    pub fn minus(&self, from: &Self) -> Used {
        let cpu_s = |of: &Self| of.nodes.iter().map(|usage| usage.cpu_s).sum::<f64>();
        let (counters, before) = (self.counters, from.counters);
        Used {
            seconds: self.at_ns.saturating_sub(from.at_ns) as f64 / 1e9,
            servers_cpu_s: cpu_s(self) - cpu_s(from),
            postgres_cpu_s: self.postgres.cpu_s - from.postgres.cpu_s,
            wal_bytes: counters.wal_bytes - before.wal_bytes,
            rows_written: counters.rows_written - before.rows_written,
            commits: counters.commits - before.commits,
            notifications: self.notifications.saturating_sub(from.notifications) as f64,
        }
    }

    pub fn nodes_resident_bytes(&self) -> f64 {
        self.nodes.iter().map(|usage| usage.resident_bytes as f64).sum()
    }
}

/// The engines' use of resources between two moments.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Used {
    pub seconds: f64,
    pub servers_cpu_s: f64,
    pub postgres_cpu_s: f64,
    pub wal_bytes: f64,
    /// Negative after a failover: another primary counts from zero.
    pub rows_written: f64,
    pub commits: f64,
    pub notifications: f64,
}

/// The part of a run in which something began.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Part {
    Before,
    /// Within ten seconds after the beginning of the fault.
    First,
    /// Later, while the fault lasted.
    During,
    After,
}

impl Part {
    const ALL: [Self; 4] = [Self::Before, Self::First, Self::During, Self::After];

    fn of(at_ns: u64, times: FaultTimes) -> Self {
        let first_ns = FIRST.as_nanos() as u64;
        match at_ns {
            at_ns if at_ns < times.began_ns => Self::Before,
            at_ns if at_ns < times.began_ns + first_ns => Self::First,
            at_ns if at_ns < times.ended_ns => Self::During,
            _ => Self::After,
        }
    }

    fn name(self) -> &'static str {
        match self {
            Self::Before => "before",
            Self::First => "first_10s",
            Self::During => "during",
            Self::After => "after",
        }
    }
}

/// Adds how soon orders arrived at robots, and reports were stored.
pub fn measure_latencies(point: &mut Point, logs: &RobotLogs, record: &Record, times: FaultTimes) {
    let mut unseen = 0;
    let mut pushes = Vec::new();
    for order in &record.orders {
        for robot in &order.robots {
            match logs.received.get(&(*robot, order.deployment.to_string())) {
                Some(at_ns) => {
                    let ms = at_ns.saturating_sub(order.ordered_ns) as f64 / 1e6;
                    pushes.push((Part::of(order.ordered_ns, times), ms));
                }
                // The next order for this robot came first.
                None => unseen += 1,
            }
        }
    }
    for part in Part::ALL {
        let of_part = pushes.iter().filter(|(of, _)| *of == part).map(|(_, ms)| *ms);
        point.measure(&format!("push_{}", part.name()), Unit::Milliseconds, of_part);
        let sent = |at_ns: u64, took_ms: f64| at_ns.saturating_sub((took_ms * 1e6) as u64);
        let stored = logs
            .stored
            .iter()
            .filter(|report| Part::of(sent(report.at_ns, report.took_ms), times) == part);
        let stored = stored.map(|report| report.took_ms);
        point.measure(&format!("stored_{}", part.name()), Unit::Milliseconds, stored);
    }
    point.measure("orders", Unit::Number, [record.orders.len() as f64]);
    point.measure("orders_superseded_unseen", Unit::Number, [f64::from(unseen)]);
    point.measure("answers", Unit::Milliseconds, record.answers_ms.iter().copied());
    let unanswered: u64 = record.unanswered.values().sum();
    point.measure("unanswered", Unit::Number, [unanswered as f64]);
    point.measure("pushed", Unit::Number, [record.pushed as f64]);
    let most = record.samples.iter().map(|sample| sample.progress.busy).max();
    point.measure("most_busy", Unit::Number, most.map(|most| most as f64));
}

/// Adds how soon robots were back that lost their session from the fault on.
pub fn measure_reconnects(point: &mut Point, logs: &RobotLogs, times: FaultTimes) {
    let lost = logs.gaps.iter().filter(|gap| gap.from_ns >= times.began_ns);
    let ended = lost.clone().filter_map(|gap| Some((gap, gap.until_ns?)));
    let reconnects = ended.clone().map(|(gap, until_ns)| (until_ns - gap.from_ns) as f64 / 1e6);
    point.measure("reconnect", Unit::Milliseconds, reconnects);
    let first = ended.filter(|(gap, _)| gap.from_ns <= times.ended_ns);
    let back = first.map(|(_, until_ns)| (until_ns - times.began_ns) as f64 / 1e6);
    point.measure("back_after_fault", Unit::Milliseconds, back);
    point.measure("sessions_lost", Unit::Number, [lost.count() as f64]);
    for _ in logs.gaps.iter().filter(|gap| gap.until_ns.is_none()) {
        point.fail("a robot has no session in the end");
    }
}

/// Adds the longest time in which no report was stored after the fault began.
pub fn measure_pause(point: &mut Point, logs: &RobotLogs, began_ns: u64, ended_ns: u64) {
    let mut times: Vec<u64> = logs.stored.iter().map(|report| report.at_ns).collect();
    times.retain(|at_ns| (began_ns..ended_ns).contains(at_ns));
    times.extend([began_ns, ended_ns]);
    times.sort_unstable();
    let pauses = times.windows(2).map(|pair| pair[1] - pair[0]);
    let longest = pauses.max().map(|longest_ns| longest_ns as f64 / 1e6);
    point.measure("longest_pause", Unit::Milliseconds, longest);
}

/// Adds the engines' use of resources between two moments.
pub fn measure_resources(point: &mut Point, logs: &RobotLogs, from: &Resources, to: &Resources) {
    let used = to.minus(from);
    let within = from.at_ns..=to.at_ns;
    let reports = logs.stored.iter().filter(|report| within.contains(&report.at_ns)).count() as f64;
    let nodes = from.nodes.iter().zip(&to.nodes);
    point.measure("node_cpu", Unit::Seconds, nodes.map(|(from, to)| to.cpu_s - from.cpu_s));
    let resident = to.nodes.iter().map(|usage| usage.resident_bytes as f64);
    point.measure("node_resident", Unit::Bytes, resident);
    point.measure("postgres_cpu", Unit::Seconds, [used.postgres_cpu_s]);
    point.measure("postgres_anonymous", Unit::Bytes, [to.postgres.anonymous_bytes as f64]);
    let rate = |value: f64| (value >= 0.0).then_some(value / used.seconds);
    point.measure("reports", Unit::PerSecond, rate(reports));
    point.measure("notifications", Unit::PerSecond, rate(used.notifications));
    point.measure("wal", Unit::BytesPerSecond, rate(used.wal_bytes));
    point.measure("rows_written", Unit::PerSecond, rate(used.rows_written));
    point.measure("commits", Unit::PerSecond, rate(used.commits));
    if reports > 0.0 {
        // Orders, rollouts and all else included.
        point.measure("wal_per_report", Unit::Bytes, [used.wal_bytes / reports]);
        let cpu_ms = |seconds: f64| [seconds * 1000.0 / reports];
        point.measure("server_cpu_per_report", Unit::Milliseconds, cpu_ms(used.servers_cpu_s));
        point.measure("postgres_cpu_per_report", Unit::Milliseconds, cpu_ms(used.postgres_cpu_s));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn orders_are_sorted_into_the_parts_of_a_run() {
        let second = 1_000_000_000;
        let times = FaultTimes { began_ns: 100 * second, ended_ns: 130 * second };
        let parts = [99, 100, 109, 110, 129, 130].map(|at| Part::of(at * second, times));
        assert_eq!(
            parts,
            [Part::Before, Part::First, Part::First, Part::During, Part::During, Part::After]
        );
        // A short fault has first moments, and nothing between them and the end.
        let times = FaultTimes { began_ns: 100 * second, ended_ns: 101 * second };
        assert_eq!(Part::of(109 * second, times), Part::First);
        assert_eq!(Part::of(110 * second, times), Part::After);
    }
}
