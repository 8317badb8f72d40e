//! The invariants of every run, with any fault: comparisons of the database with the robots' own
//! logs and with the load's record. Each returns its violations.

use std::collections::{BTreeMap, BTreeSet};

use serde::Deserialize;
use task_proto::DeploymentId;
use task_proto::api::FeedKind;

use super::database::{AssignmentRow, BlobRow, RobotRow};
use super::load::RolloutSample;
use super::robot_logs::{Acknowledged, RobotLogs};
use crate::simulated::fleet::name;

/// Phases that orders set, independent of the robot's reports.
const SET_BY_ORDERS: [&str; 3] = ["superseded", "cancelled", "expired"];

/// The database at the end of a run.
#[derive(Debug, Default)]
pub struct Stored {
    pub robots: BTreeMap<String, RobotRow>,
    pub assignments: BTreeMap<(String, String), AssignmentRow>,
}

/// I1: no acknowledged report is lost, and the phases in the last one are the stored ones.
pub fn lost_reports(logs: &RobotLogs, stored: &Stored) -> Vec<String> {
    let mut found = Vec::new();
    for (robot, last) in &logs.last {
        let robot = name(*robot);
        let Some(row) = stored.robots.get(&robot) else {
            found.push(format!("{robot} has reported and is not in the database"));
            continue;
        };
        if row.position < last.position {
            let (stored, last) = (row.position, last.position);
            found.push(format!("{robot}: report {last:?} was acknowledged, stored is {stored:?}"));
        } else if row.position == last.position {
            found.extend(other_phases(&robot, last, stored));
        }
    }
    found
}

/// I1 at a failover: the standby had all reports that were acknowledged before the primary was
/// lost.
pub fn lost_at_failover(
    logs: &RobotLogs,
    lost_ns: u64,
    promoted: &BTreeMap<String, RobotRow>,
) -> Vec<String> {
    let mut newest: BTreeMap<usize, (u64, u64)> = BTreeMap::new();
    for report in logs.stored.iter().filter(|report| report.at_ns < lost_ns) {
        let position = newest.entry(report.robot).or_default();
        *position = report.position.max(*position);
    }
    let lost = newest.into_iter().filter_map(|(robot, position)| {
        let robot = name(robot);
        let has = promoted.get(&robot).map(|row| row.position);
        (has < Some(position)).then(|| {
            format!("{robot}: report {position:?} was acknowledged, the standby had {has:?}")
        })
    });
    lost.collect()
}

fn other_phases<'a>(
    robot: &'a str,
    last: &'a Acknowledged,
    stored: &'a Stored,
) -> impl Iterator<Item = String> + 'a {
    last.tasks.iter().filter_map(move |task| {
        let key = (robot.to_owned(), task.deployment.to_string());
        let row = stored.assignments.get(&key)?;
        let is_newer = row.run > task.run || SET_BY_ORDERS.contains(&row.phase.as_str());
        (!is_newer && row.phase != task.phase.as_str()).then(|| {
            let (reported, phase) = (task.phase.as_str(), &row.phase);
            format!("{robot}: {} is {reported} there and {phase} in the database", task.task)
        })
    })
}

/// I2: each robot keeps to the database's generation, by its own account too.
pub fn other_generations(logs: &RobotLogs, stored: &Stored, robots: usize) -> Vec<String> {
    let mut found = Vec::new();
    for number in 0..robots {
        let robot = name(number);
        let (row, last) = (stored.robots.get(&robot), logs.last.get(&number));
        let (Some(row), Some(last)) = (row, last) else {
            found.push(format!("{robot} has never reported"));
            continue;
        };
        if row.observed != row.generation || last.generation != row.generation {
            found.push(format!(
                "{robot}: generation {} was ordered, {} is stored as observed, the robot has {}",
                row.generation, row.observed, last.generation
            ));
        }
    }
    found
}

/// I3: no run of an order was started twice.
pub fn repeated_runs(logs: &RobotLogs) -> Vec<String> {
    let repeated = logs.started.iter().filter(|(_, count)| **count > 1);
    let text = |((robot, deployment, run), count): (&(usize, String, u64), &u64)| {
        format!("{} has started run {run} of {deployment} {count} times", name(*robot))
    };
    repeated.map(text).collect()
}

/// I4: a rollout never had more than its batch busy, nor more failures than its limit.
pub fn exceeded_limits(samples: &[RolloutSample]) -> Vec<String> {
    let most = |of: fn(&RolloutSample) -> u64, limit: fn(&RolloutSample) -> u64, state: &str| {
        let beyond = samples.iter().filter(|sample| of(sample) > limit(sample));
        let worst = beyond.max_by_key(|sample| of(sample))?;
        Some(format!("{} robots of a rollout {state}, allowed are {}", of(worst), limit(worst)))
    };
    let busy = most(|sample| sample.progress.busy, |sample| sample.batch, "were busy");
    let failed = most(|sample| sample.progress.failed, |sample| sample.max_failures, "failed");
    busy.into_iter().chain(failed).collect()
}

/// I5: the numbers of deployments are unique, and those of the audit have no gap.
pub fn wrong_numbers(deployments: &[u64], audit: &[u64]) -> Vec<String> {
    let unique: BTreeSet<u64> = deployments.iter().copied().collect();
    let entries: BTreeSet<u64> = audit.iter().copied().collect();
    let mut found = Vec::new();
    if unique.len() != deployments.len() {
        found.push(format!("{} deployments have {} numbers", deployments.len(), unique.len()));
    }
    let expected = 1..=entries.len() as u64;
    if !entries.iter().copied().eq(expected) || entries.len() != audit.len() {
        let (count, last) = (audit.len(), entries.last().copied().unwrap_or_default());
        found.push(format!("the audit has {count} entries, the last has number {last}"));
    }
    found
}

/// I7: an order that is repeated with its key at another server gives the same deployment.
pub fn other_answers(repeated: &[(DeploymentId, DeploymentId)]) -> Vec<String> {
    let different = repeated.iter().filter(|(first, again)| first != again);
    different.map(|(first, again)| format!("{first} was given {again} when repeated")).collect()
}

/// I8: no object is missing that a manifest needs. `size` is that of an object, if it exists.
pub fn missing_objects(
    needed: &[String],
    blobs: &BTreeMap<String, BlobRow>,
    size: impl Fn(&str) -> Option<u64>,
) -> Vec<String> {
    let problem = |digest: &String| match blobs.get(digest) {
        None => Some(format!("{digest} is needed and not stored")),
        Some(row) => match size(&row.object) {
            None => Some(format!("{digest} is stored, and {} does not exist", row.object)),
            Some(bytes) if bytes != row.bytes => {
                Some(format!("{} has {bytes} bytes instead of {}", row.object, row.bytes))
            }
            Some(_) => None,
        },
    };
    needed.iter().filter_map(problem).collect()
}

/// The part of a feed's entry that happens once.
#[derive(Debug, PartialEq, Eq, PartialOrd, Ord, Deserialize)]
struct FeedFact {
    #[serde(default)]
    deployment: Option<String>,
    #[serde(default)]
    robot: Option<String>,
    text: String,
}

/// I9: the feed tells each event of a deployment once, and a reader gets each entry once.
pub fn repeated_feed(entries: &[String], feeds: &[Vec<u64>]) -> Vec<String> {
    let mut found = Vec::new();
    let mut told = BTreeSet::new();
    for entry in entries {
        let (Ok(fact), Ok(kind)) =
            (serde_json::from_str::<FeedFact>(entry), serde_json::from_str::<Kind>(entry))
        else {
            found.push(format!("an entry of the feed can't be read: {entry}"));
            continue;
        };
        let happens_once = matches!(
            kind.kind,
            FeedKind::DeploymentBegun | FeedKind::DeploymentSettled | FeedKind::RobotEnrolled
        );
        let text = fact.text.clone();
        if happens_once && !told.insert((fact.deployment, fact.robot, fact.text)) {
            found.push(format!("the feed tells this again: {text}"));
        }
    }
    for feed in feeds {
        let unique: BTreeSet<&u64> = feed.iter().collect();
        if unique.len() != feed.len() {
            let (all, unique) = (feed.len(), unique.len());
            found.push(format!("a reader got {all} entries of the feed, {unique} of them once"));
        }
    }
    found
}

#[derive(Debug, Deserialize)]
struct Kind {
    kind: FeedKind,
}

#[cfg(test)]
mod tests {
    use task_proto::messages::report::Phase;

    use super::*;
    use crate::scenario::cluster::database::Progress;
    use crate::scenario::cluster::robot_logs::StoredReport;
    use crate::simulated::robots::log::LoggedTask;

    /// A robot that has reported `running` at (1, 4) and generation 3, as the database has it.
    fn agreeing() -> (RobotLogs, Stored) {
        let deployment = DeploymentId::random();
        let task = LoggedTask {
            task: "job".parse().expect("a name"),
            deployment: deployment.clone(),
            run: 1,
            phase: Phase::Running,
        };
        let last = Acknowledged { position: (1, 4), generation: 3, tasks: vec![task] };
        let logs = RobotLogs { last: [(0, last)].into(), ..RobotLogs::default() };
        let robot = RobotRow { generation: 3, observed: 3, position: (1, 4) };
        let assignment = AssignmentRow { phase: "running".to_owned(), run: 1 };
        let stored = Stored {
            robots: [(name(0), robot)].into(),
            assignments: [((name(0), deployment.to_string()), assignment)].into(),
        };
        (logs, stored)
    }

    #[test]
    fn lost_report_and_another_phase_are_found() {
        let (logs, mut stored) = agreeing();
        assert_eq!(lost_reports(&logs, &stored), Vec::<String>::new());
        let change = |stored: &mut Stored, phase: &str| {
            for row in stored.assignments.values_mut() {
                row.phase = phase.to_owned();
            }
        };
        change(&mut stored, "superseded");
        assert_eq!(lost_reports(&logs, &stored), Vec::<String>::new());
        change(&mut stored, "assigned");
        assert_eq!(
            lost_reports(&logs, &stored),
            ["r00000: job is running there and assigned in the database"]
        );
        stored.robots.values_mut().for_each(|row| row.position = (1, 3));
        assert!(lost_reports(&logs, &stored)[0].contains("(1, 4) was acknowledged"));
        stored.robots.clear();
        assert!(lost_reports(&logs, &stored)[0].contains("not in the database"));
    }

    #[test]
    fn report_that_the_standby_did_not_have_is_found() {
        let report =
            |seq, at_ns| StoredReport { robot: 0, position: (1, seq), at_ns, took_ms: 1.0 };
        let logs = RobotLogs { stored: vec![report(4, 10), report(5, 20)], ..RobotLogs::default() };
        let (_, stored) = agreeing();
        // The newest before the loss is stored, as report 4 of start 1.
        assert_eq!(lost_at_failover(&logs, 20, &stored.robots), Vec::<String>::new());
        assert_eq!(lost_at_failover(&logs, 21, &stored.robots).len(), 1);
        assert_eq!(lost_at_failover(&logs, 20, &BTreeMap::new()).len(), 1);
    }

    #[test]
    fn robot_behind_its_generation_is_found() {
        let (logs, mut stored) = agreeing();
        assert_eq!(other_generations(&logs, &stored, 1), Vec::<String>::new());
        assert_eq!(other_generations(&logs, &stored, 2), ["r00001 has never reported"]);
        stored.robots.values_mut().for_each(|row| row.generation = 4);
        assert_eq!(other_generations(&logs, &stored, 1).len(), 1);
        let (mut logs, stored) = agreeing();
        logs.last.values_mut().for_each(|last| last.generation = 2);
        assert_eq!(other_generations(&logs, &stored, 1).len(), 1);
    }

    #[test]
    fn second_start_of_a_run_is_found() {
        let started = |count| RobotLogs {
            started: [((1, "d-1".to_owned(), 1), count)].into(),
            ..RobotLogs::default()
        };
        assert_eq!(repeated_runs(&started(1)), Vec::<String>::new());
        assert_eq!(repeated_runs(&started(2)), ["r00001 has started run 1 of d-1 2 times"]);
    }

    #[test]
    fn batch_and_failures_beyond_their_limits_are_found() {
        let sample = |busy, failed| RolloutSample {
            progress: Progress { waiting: 0, busy, failed },
            batch: 5,
            max_failures: 1,
        };
        assert_eq!(exceeded_limits(&[sample(5, 1), sample(0, 0)]), Vec::<String>::new());
        assert_eq!(
            exceeded_limits(&[sample(6, 2), sample(7, 0)]),
            [
                "7 robots of a rollout were busy, allowed are 5",
                "2 robots of a rollout failed, allowed are 1"
            ]
        );
    }

    #[test]
    fn repeated_number_and_gap_are_found() {
        assert_eq!(wrong_numbers(&[1, 2, 5], &[2, 1, 3]), Vec::<String>::new());
        assert_eq!(wrong_numbers(&[1, 2, 2], &[1, 2]).len(), 1);
        assert_eq!(wrong_numbers(&[1], &[1, 3]).len(), 1);
        assert_eq!(wrong_numbers(&[1], &[1, 2, 2]).len(), 1);
    }

    #[test]
    fn another_answer_to_a_repeated_order_is_found() {
        let (one, other) = (DeploymentId::random(), DeploymentId::random());
        assert_eq!(other_answers(&[(one.clone(), one.clone())]), Vec::<String>::new());
        assert_eq!(other_answers(&[(one, other)]).len(), 1);
    }

    #[test]
    fn missing_and_truncated_objects_are_found() {
        let blobs = [("a", 3), ("b", 5), ("c", 7)]
            .map(|(name, bytes)| (name.to_owned(), BlobRow { object: format!("o/{name}"), bytes }));
        let size = |object: &str| match object {
            "o/a" => Some(3),
            "o/b" => Some(4),
            _ => None,
        };
        let needed = ["a", "b", "c", "d"].map(str::to_owned);
        assert_eq!(
            missing_objects(&needed, &blobs.into(), size),
            [
                "o/b has 4 bytes instead of 5",
                "c is stored, and o/c does not exist",
                "d is needed and not stored"
            ]
        );
    }

    #[test]
    fn repeated_entry_of_the_feed_is_found() {
        let entry = |kind: &str, number: u64| {
            format!(r#"{{"number":{number},"kind":"{kind}","deployment":"d-1","text":"x"}}"#)
        };
        let told = [entry("deployment_begun", 1), entry("robot_offline", 2)];
        assert_eq!(repeated_feed(&told, &[vec![1, 2], vec![1, 2]]), Vec::<String>::new());
        let online = [entry("robot_online", 1), entry("robot_online", 2)];
        assert_eq!(repeated_feed(&online, &[vec![1, 2], vec![2]]), Vec::<String>::new());
        assert_eq!(repeated_feed(&online, &[vec![1, 2, 2]]).len(), 1);
        let twice = [entry("deployment_begun", 1), entry("deployment_begun", 2)];
        assert_eq!(repeated_feed(&twice, &[]), ["the feed tells this again: x"]);
    }
}
