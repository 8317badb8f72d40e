//! The state machine of one package's fan-out: when to publish which parts, and which robots to
//! give up on. This module only decides; time and events are passed in.
//!
//! ```text
//! gathering ──all subscribed, or timeout──► publishing ──all sent──► collecting ──none left──► over
//!                                               ▲                        │
//!                                               └──── missing parts ─────┘
//! ```

use std::collections::{BTreeMap, BTreeSet};
use std::ops::RangeInclusive;

use task_proto::RobotId;
use task_proto::messages::part::PartRange;

/// How long to wait for more subscribers after the last one, and in total.
const GATHER_MS: u64 = 2_000;
const MAX_GATHER_MS: u64 = 10_000;
/// How long a robot may be away before the fan-out gives up on it.
const AWAY_MS: u64 = 10_000;
/// How long to wait for slower robots once the first has reported missing parts. Robots report 2 s
/// after the last part.
const COLLECT_MS: u64 = 3_000;
/// How long a subscriber may neither have all parts nor report missing ones.
const SILENT_MS: u64 = 30_000;
/// Maximum repeats to one robot, and maximum consecutive repeats without progress.
const MAX_ROUNDS: u32 = 10;
const MAX_WITHOUT_PROGRESS: u32 = 2;

/// One package in fan-out.
#[derive(Debug)]
pub(super) struct FanOutState {
    parts: u32,
    stage: Stage,
    robots: BTreeMap<RobotId, RobotState>,
    given_up: Vec<(RobotId, GiveUpReason)>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Stage {
    Gathering {
        since_ms: u64,
        joined_ms: u64,
    },
    Publishing,
    Collecting {
        since_ms: u64,
        /// When the first robot reported missing parts.
        first_report_ms: Option<u64>,
    },
}

/// The state of one robot.
#[derive(Debug, Clone, Default)]
struct RobotState {
    is_subscribed: bool,
    /// Start of the current subscribed or unsubscribed period.
    since_ms: u64,
    /// Missing parts reported since the last parts were sent.
    missing: Option<Vec<PartRange>>,
    /// Missing parts reported before that.
    missing_before: Option<Vec<PartRange>>,
    rounds: u32,
    without_progress: u32,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Step {
    /// Publish these parts, then call `sent`.
    Publish(Vec<RangeInclusive<u32>>),
    /// Call again after an event, or soon.
    Wait,
    /// No robots are left.
    Over,
}

/// The reason why a robot gets its bytes in another way.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum GiveUpReason {
    /// The robot held up the others.
    HeldUp,
    /// The robot does not subscribe.
    Away,
    /// The robot received repeats too often.
    TooManyRounds,
    /// The repeats brought no progress.
    NoProgress,
    /// The robot reports nothing.
    Silent,
}

impl GiveUpReason {
    /// A description for people.
    pub(super) fn as_str(self) -> &'static str {
        match self {
            Self::HeldUp => "the robot held up the others",
            Self::Away => "the robot did not subscribe for 10 s",
            Self::TooManyRounds => "the robot still lacked parts after 10 repeats",
            Self::NoProgress => "repeated parts did not arrive",
            Self::Silent => "the robot reported nothing for 30 s",
        }
    }
}

impl FanOutState {
    /// Begins a package of this many parts.
    pub(super) fn begin(parts: u32, now_ms: u64) -> Self {
        let stage = Stage::Gathering { since_ms: now_ms, joined_ms: now_ms };
        Self { parts, stage, robots: BTreeMap::new(), given_up: Vec::new() }
    }

    /// Replaces the set of robots that still need the package. Returns the new robots and those
    /// that no longer need it.
    pub(super) fn set_robots(
        &mut self,
        robots: &BTreeSet<RobotId>,
        now_ms: u64,
    ) -> (Vec<RobotId>, Vec<RobotId>) {
        let gone: Vec<RobotId> =
            self.robots.keys().filter(|robot| !robots.contains(*robot)).cloned().collect();
        self.robots.retain(|robot, _| robots.contains(robot));
        let new: Vec<RobotId> =
            robots.iter().filter(|robot| !self.robots.contains_key(*robot)).cloned().collect();
        for robot in &new {
            self.robots
                .insert(robot.clone(), RobotState { since_ms: now_ms, ..RobotState::default() });
        }
        (new, gone)
    }

    /// Updates which robots subscribe now.
    pub(super) fn set_subscribed(&mut self, is_subscribed: impl Fn(&RobotId) -> bool, now_ms: u64) {
        for (robot, robot_state) in &mut self.robots {
            let subscribes = is_subscribed(robot);
            if subscribes == robot_state.is_subscribed {
                continue;
            }
            (robot_state.is_subscribed, robot_state.since_ms) = (subscribes, now_ms);
            if let Stage::Gathering { joined_ms, .. } = &mut self.stage {
                *joined_ms = now_ms;
            }
        }
    }

    /// A robot reports missing parts.
    pub(super) fn report_missing(&mut self, robot: &RobotId, missing: Vec<PartRange>, now_ms: u64) {
        let Some(robot_state) = self.robots.get_mut(robot).filter(|_| !missing.is_empty()) else {
            return;
        };
        robot_state.missing = Some(missing);
        if let Stage::Collecting { first_report_ms, .. } = &mut self.stage {
            first_report_ms.get_or_insert(now_ms);
        }
    }

    /// A robot was removed from the fan-out.
    pub(super) fn evicted(&mut self, robot: RobotId) {
        self.give_up(robot, GiveUpReason::HeldUp);
    }

    /// All parts of the last step are sent.
    pub(super) fn sent(&mut self, now_ms: u64) {
        self.stage = Stage::Collecting { since_ms: now_ms, first_report_ms: None };
        for robot_state in self.robots.values_mut() {
            // The robot reports again once no more parts arrive, with newer information.
            robot_state.missing = None;
        }
    }

    /// Whether no robots are left to publish for.
    pub(super) fn is_over(&self) -> bool {
        self.robots.is_empty()
    }

    /// Robots given up on since the last call.
    pub(super) fn take_given_up(&mut self) -> Vec<(RobotId, GiveUpReason)> {
        std::mem::take(&mut self.given_up)
    }

    /// The next action now.
    pub(super) fn next(&mut self, now_ms: u64) -> Step {
        self.give_up_on_absent(now_ms);
        if self.robots.is_empty() || self.parts == 0 {
            for robot in self.robots.keys().cloned().collect::<Vec<_>>() {
                self.give_up(robot, GiveUpReason::NoProgress);
            }
            return Step::Over;
        }
        let subscribers = self.robots.values().filter(|robot_state| robot_state.is_subscribed);
        let (subscribed, reported) =
            subscribers.fold((0, 0), |(subscribed, reported), robot_state| {
                (subscribed + 1, reported + usize::from(robot_state.missing.is_some()))
            });
        let is_time = subscribed > 0
            && match self.stage {
                Stage::Gathering { since_ms, joined_ms } => {
                    let all = subscribed == self.robots.len();
                    all || now_ms >= joined_ms + GATHER_MS || now_ms >= since_ms + MAX_GATHER_MS
                }
                Stage::Publishing => false,
                Stage::Collecting { first_report_ms, .. } => {
                    reported == subscribed
                        || first_report_ms
                            .is_some_and(|first_report_ms| now_ms >= first_report_ms + COLLECT_MS)
                }
            };
        if !is_time {
            return Step::Wait;
        }
        let parts = match self.stage {
            Stage::Gathering { .. } => vec![0..=self.parts - 1],
            _ => self.repeated(),
        };
        self.stage = Stage::Publishing;
        if parts.is_empty() { self.next(now_ms) } else { Step::Publish(parts) }
    }

    /// The missing parts of all robots, each part once, in order.
    fn repeated(&mut self) -> Vec<RangeInclusive<u32>> {
        let mut ranges: Vec<RangeInclusive<u32>> = Vec::new();
        let mut given_up = Vec::new();
        for (robot, robot_state) in &mut self.robots {
            let Some(missing) = robot_state.missing.take() else { continue };
            robot_state.rounds += 1;
            robot_state.without_progress = if robot_state.missing_before.as_ref() == Some(&missing)
            {
                robot_state.without_progress + 1
            } else {
                0
            };
            if robot_state.rounds > MAX_ROUNDS {
                given_up.push((robot.clone(), GiveUpReason::TooManyRounds));
            } else if robot_state.without_progress >= MAX_WITHOUT_PROGRESS {
                given_up.push((robot.clone(), GiveUpReason::NoProgress));
            } else {
                ranges.extend(missing.iter().filter_map(|range| range.within(self.parts)));
            }
            robot_state.missing_before = Some(missing);
        }
        for (robot, why) in given_up {
            self.give_up(robot, why);
        }
        ranges.sort_by_key(|range| *range.start());
        let mut joined: Vec<RangeInclusive<u32>> = Vec::new();
        for range in ranges {
            match joined.last_mut() {
                Some(last) if *range.start() <= last.end().saturating_add(1) => {
                    *last = *last.start()..=*last.end().max(range.end());
                }
                _ => joined.push(range),
            }
        }
        joined
    }

    fn give_up_on_absent(&mut self, now_ms: u64) {
        let is_silent = match self.stage {
            Stage::Collecting { since_ms, .. } => now_ms >= since_ms + SILENT_MS,
            Stage::Gathering { .. } | Stage::Publishing => false,
        };
        let why = |robot_state: &RobotState| match robot_state.is_subscribed {
            false if now_ms >= robot_state.since_ms + AWAY_MS => Some(GiveUpReason::Away),
            true if is_silent && robot_state.missing.is_none() => Some(GiveUpReason::Silent),
            _ => None,
        };
        let absent: Vec<_> = self
            .robots
            .iter()
            .filter_map(|(robot, robot_state)| Some((robot.clone(), why(robot_state)?)))
            .collect();
        for (robot, why) in absent {
            self.give_up(robot, why);
        }
    }

    fn give_up(&mut self, robot: RobotId, why: GiveUpReason) {
        if self.robots.remove(&robot).is_some() {
            self.given_up.push((robot, why));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn robots(count: u8) -> Vec<RobotId> {
        (0..count).map(|number| format!("r{number:016x}").parse().expect("valid")).collect()
    }

    fn state(robots: &[RobotId]) -> FanOutState {
        let mut state = FanOutState::begin(100, 0);
        let (new, gone) = state.set_robots(&robots.iter().cloned().collect(), 0);
        assert_eq!((new, gone), (robots.to_vec(), Vec::new()));
        state
    }

    fn range(from: u32, to: u32) -> PartRange {
        PartRange { from, to }
    }

    #[test]
    fn publishing_starts_when_all_subscribe_or_after_the_wait() {
        let robots = robots(3);
        let mut state = state(&robots);
        state.set_subscribed(|robot| *robot == robots[0], 500);
        assert_eq!(state.next(2_499), Step::Wait);
        assert_eq!(state.next(2_500), Step::Publish(vec![0..=99]));
        assert_eq!(state.next(2_501), Step::Wait, "already publishing");

        let mut state = self::state(&robots);
        state.set_subscribed(|_| true, 100);
        assert_eq!(state.next(100), Step::Publish(vec![0..=99]));

        let mut state = self::state(&robots);
        assert_eq!(state.next(9_999), Step::Wait, "no subscriber");
        assert_eq!(state.next(10_000), Step::Over);
        let away: Vec<_> = robots.iter().map(|robot| (robot.clone(), GiveUpReason::Away)).collect();
        assert_eq!(state.take_given_up(), away);
    }

    #[test]
    fn parts_missing_on_several_robots_are_repeated_once() {
        let robots = robots(3);
        let mut state = state(&robots);
        state.set_subscribed(|_| true, 0);
        assert_eq!(state.next(0), Step::Publish(vec![0..=99]));
        state.report_missing(&robots[0], vec![range(0, 99)], 500);
        state.sent(1_000);
        assert_eq!(state.next(1_000), Step::Wait, "reports before the last part are outdated");
        state.report_missing(&robots[0], vec![range(3, 5), range(90, 200)], 3_000);
        state.report_missing(&robots[1], vec![range(4, 9), range(20, 20)], 3_100);
        state.report_missing(&robots[2], Vec::new(), 3_200);
        assert_eq!(state.next(5_999), Step::Wait);
        assert_eq!(state.next(6_000), Step::Publish(vec![3..=9, 20..=20, 90..=99]));
        state.sent(7_000);
        let (_, gone) = state.set_robots(&[robots[1].clone()].into(), 7_500);
        assert_eq!(gone, [robots[0].clone(), robots[2].clone()]);
        state.report_missing(&robots[1], vec![range(20, 20)], 9_000);
        assert_eq!(
            state.next(9_000),
            Step::Publish(vec![20..=20]),
            "all subscribers have reported"
        );
        state.sent(9_100);
        state.set_robots(&BTreeSet::new(), 9_500);
        assert_eq!((state.next(9_500), state.take_given_up()), (Step::Over, Vec::new()));
    }

    #[test]
    fn robot_without_progress_is_given_up_and_late_joiner_is_kept() {
        let all = robots(4);
        let mut state = state(&all[..3]);
        state.set_subscribed(|_| true, 0);
        assert_eq!(state.next(0), Step::Publish(vec![0..=99]));
        state.evicted(all[0].clone());
        state.sent(100);
        let (new, _) = state.set_robots(&all[1..].iter().cloned().collect(), 200);
        assert_eq!(new, [all[3].clone()]);
        let mut now_ms = 200;
        for turn in 0..4 {
            now_ms += 3_000;
            state.set_subscribed(|_| true, now_ms);
            state.report_missing(&all[1], vec![range(1, 1)], now_ms);
            state.report_missing(&all[3], vec![range(turn, 99)], now_ms);
            now_ms += COLLECT_MS;
            let step = state.next(now_ms);
            let expected = if turn == 0 { 0 } else { turn.min(if turn < 2 { 1 } else { turn }) };
            assert_eq!(step, Step::Publish(vec![expected..=99]), "turn {turn}");
            state.sent(now_ms);
        }
        assert_eq!(
            state.take_given_up(),
            [(all[0].clone(), GiveUpReason::HeldUp), (all[1].clone(), GiveUpReason::NoProgress)]
        );
        assert_eq!(state.next(now_ms + SILENT_MS), Step::Over);
        let silent =
            [(all[2].clone(), GiveUpReason::Silent), (all[3].clone(), GiveUpReason::Silent)];
        assert_eq!(state.take_given_up(), silent);
    }

    #[test]
    fn rounds_are_bounded() {
        let robots = robots(1);
        let mut state = state(&robots);
        state.set_subscribed(|_| true, 0);
        assert_eq!(state.next(0), Step::Publish(vec![0..=99]));
        for round in 0..=MAX_ROUNDS {
            state.sent(u64::from(round));
            state.report_missing(&robots[0], vec![range(round, round)], u64::from(round));
            let over = round == MAX_ROUNDS;
            let expected = if over { Step::Over } else { Step::Publish(vec![round..=round]) };
            assert_eq!(state.next(u64::from(round)), expected);
        }
        assert_eq!(state.take_given_up(), [(robots[0].clone(), GiveUpReason::TooManyRounds)]);
    }
}
