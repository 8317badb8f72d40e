//! The state machine of one package's fan-out: when to publish which parts, and which robots to
//! give up on. This module only decides; time and events are passed in.
//!
//! ```text
//! gathering ──all listen, or enough waited──► publishing ──all sent──► collecting ──nobody is left──► over
//!                                                  ▲                       │
//!                                                  └──── what they lack ───┘
//! ```

use std::collections::{BTreeMap, BTreeSet};
use std::ops::RangeInclusive;

use task_proto::RobotId;
use task_proto::part::PartRange;

/// How long to wait for more subscribers after the last one, and in total.
const GATHER_MS: u64 = 2_000;
const GATHER_MOST_MS: u64 = 10_000;
/// How long a robot may be away before the fan-out gives up on it.
const AWAY_MS: u64 = 10_000;
/// How long to wait for slower robots once the first has reported missing parts. Robots report 2 s
/// after the last part.
const COLLECT_MS: u64 = 3_000;
/// How long a subscriber may neither have all parts nor report missing ones.
const SILENT_MS: u64 = 30_000;
/// Maximum repeats to one robot, and maximum consecutive repeats without progress.
const MAX_ROUNDS: u32 = 10;
const MAX_USELESS: u32 = 2;

/// One package in fan-out.
#[derive(Debug)]
pub(super) struct Course {
    parts: u32,
    stage: Stage,
    robots: BTreeMap<RobotId, Standing>,
    given_up: Vec<(RobotId, GivenUp)>,
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
        asked_ms: Option<u64>,
    },
}

/// The state of one robot.
#[derive(Debug, Clone, Default)]
struct Standing {
    is_listening: bool,
    /// Start of the current subscribed or unsubscribed period.
    since_ms: u64,
    /// Missing parts reported since the last parts were sent.
    lacks: Option<Vec<PartRange>>,
    /// Missing parts reported before that.
    lacked: Option<Vec<PartRange>>,
    rounds: u32,
    useless: u32,
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
pub(super) enum GivenUp {
    /// The robot held up the others.
    HeldUp,
    /// The robot does not subscribe.
    Away,
    /// The robot received repeats too often.
    Rounds,
    /// The repeats brought no progress.
    Useless,
    /// The robot reports nothing.
    Silent,
}

impl GivenUp {
    /// A description for people.
    pub(super) fn as_str(self) -> &'static str {
        match self {
            Self::HeldUp => "it held up the others",
            Self::Away => "it did not listen for 10 s",
            Self::Rounds => "it lacked parts after 10 repetitions",
            Self::Useless => "repeated parts did not arrive",
            Self::Silent => "it said nothing for 30 s",
        }
    }
}

impl Course {
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
            self.robots.insert(robot.clone(), Standing { since_ms: now_ms, ..Standing::default() });
        }
        (new, gone)
    }

    /// Updates which robots subscribe now.
    pub(super) fn set_listening(&mut self, is_listening: impl Fn(&RobotId) -> bool, now_ms: u64) {
        for (robot, standing) in &mut self.robots {
            let listens = is_listening(robot);
            if listens == standing.is_listening {
                continue;
            }
            (standing.is_listening, standing.since_ms) = (listens, now_ms);
            if let Stage::Gathering { joined_ms, .. } = &mut self.stage {
                *joined_ms = now_ms;
            }
        }
    }

    /// A robot reports missing parts.
    pub(super) fn lacks(&mut self, robot: &RobotId, missing: Vec<PartRange>, now_ms: u64) {
        let Some(standing) = self.robots.get_mut(robot).filter(|_| !missing.is_empty()) else {
            return;
        };
        standing.lacks = Some(missing);
        if let Stage::Collecting { asked_ms, .. } = &mut self.stage {
            asked_ms.get_or_insert(now_ms);
        }
    }

    /// A robot was removed from the fan-out.
    pub(super) fn put_out(&mut self, robot: RobotId) {
        self.give_up(robot, GivenUp::HeldUp);
    }

    /// All parts of the last step are sent.
    pub(super) fn sent(&mut self, now_ms: u64) {
        self.stage = Stage::Collecting { since_ms: now_ms, asked_ms: None };
        for standing in self.robots.values_mut() {
            // The robot reports again once no more parts arrive, with newer information.
            standing.lacks = None;
        }
    }

    /// Whether no robots are left to publish for.
    pub(super) fn is_over(&self) -> bool {
        self.robots.is_empty()
    }

    /// Robots given up on since the last call.
    pub(super) fn take_given_up(&mut self) -> Vec<(RobotId, GivenUp)> {
        std::mem::take(&mut self.given_up)
    }

    /// The next action now.
    pub(super) fn next(&mut self, now_ms: u64) -> Step {
        self.give_up_on_the_absent(now_ms);
        if self.robots.is_empty() || self.parts == 0 {
            for robot in self.robots.keys().cloned().collect::<Vec<_>>() {
                self.give_up(robot, GivenUp::Useless);
            }
            return Step::Over;
        }
        let listeners = self.robots.values().filter(|standing| standing.is_listening);
        let (listening, asking) = listeners.fold((0, 0), |(listening, asking), standing| {
            (listening + 1, asking + usize::from(standing.lacks.is_some()))
        });
        let is_time = listening > 0
            && match self.stage {
                Stage::Gathering { since_ms, joined_ms } => {
                    let all = listening == self.robots.len();
                    all || now_ms >= joined_ms + GATHER_MS || now_ms >= since_ms + GATHER_MOST_MS
                }
                Stage::Publishing => false,
                Stage::Collecting { asked_ms, .. } => {
                    asking == listening
                        || asked_ms.is_some_and(|asked_ms| now_ms >= asked_ms + COLLECT_MS)
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
        let mut wanted: Vec<RangeInclusive<u32>> = Vec::new();
        let mut tired = Vec::new();
        for (robot, standing) in &mut self.robots {
            let Some(lacks) = standing.lacks.take() else { continue };
            standing.rounds += 1;
            standing.useless =
                if standing.lacked.as_ref() == Some(&lacks) { standing.useless + 1 } else { 0 };
            if standing.rounds > MAX_ROUNDS {
                tired.push((robot.clone(), GivenUp::Rounds));
            } else if standing.useless >= MAX_USELESS {
                tired.push((robot.clone(), GivenUp::Useless));
            } else {
                wanted.extend(lacks.iter().filter_map(|range| range.within(self.parts)));
            }
            standing.lacked = Some(lacks);
        }
        for (robot, why) in tired {
            self.give_up(robot, why);
        }
        wanted.sort_by_key(|range| *range.start());
        let mut joined: Vec<RangeInclusive<u32>> = Vec::new();
        for range in wanted {
            match joined.last_mut() {
                Some(last) if *range.start() <= last.end().saturating_add(1) => {
                    *last = *last.start()..=*last.end().max(range.end());
                }
                _ => joined.push(range),
            }
        }
        joined
    }

    fn give_up_on_the_absent(&mut self, now_ms: u64) {
        let is_silent = match self.stage {
            Stage::Collecting { since_ms, .. } => now_ms >= since_ms + SILENT_MS,
            Stage::Gathering { .. } | Stage::Publishing => false,
        };
        let why = |standing: &Standing| match standing.is_listening {
            false if now_ms >= standing.since_ms + AWAY_MS => Some(GivenUp::Away),
            true if is_silent && standing.lacks.is_none() => Some(GivenUp::Silent),
            _ => None,
        };
        let absent: Vec<_> = self
            .robots
            .iter()
            .filter_map(|(robot, standing)| Some((robot.clone(), why(standing)?)))
            .collect();
        for (robot, why) in absent {
            self.give_up(robot, why);
        }
    }

    fn give_up(&mut self, robot: RobotId, why: GivenUp) {
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

    fn course(robots: &[RobotId]) -> Course {
        let mut course = Course::begin(100, 0);
        let (new, gone) = course.set_robots(&robots.iter().cloned().collect(), 0);
        assert_eq!((new, gone), (robots.to_vec(), Vec::new()));
        course
    }

    fn range(from: u32, to: u32) -> PartRange {
        PartRange { from, to }
    }

    #[test]
    fn parts_go_out_when_all_listen_or_enough_was_waited() {
        let robots = robots(3);
        let mut course = course(&robots);
        course.set_listening(|robot| *robot == robots[0], 500);
        assert_eq!(course.next(2_499), Step::Wait);
        assert_eq!(course.next(2_500), Step::Publish(vec![0..=99]));
        assert_eq!(course.next(2_501), Step::Wait, "they are on their way");

        let mut course = self::course(&robots);
        course.set_listening(|_| true, 100);
        assert_eq!(course.next(100), Step::Publish(vec![0..=99]));

        let mut course = self::course(&robots);
        assert_eq!(course.next(9_999), Step::Wait, "nobody would hear them");
        assert_eq!(course.next(10_000), Step::Over);
        let away: Vec<_> = robots.iter().map(|robot| (robot.clone(), GivenUp::Away)).collect();
        assert_eq!(course.take_given_up(), away);
    }

    #[test]
    fn what_many_lack_goes_out_once_for_all() {
        let robots = robots(3);
        let mut course = course(&robots);
        course.set_listening(|_| true, 0);
        assert_eq!(course.next(0), Step::Publish(vec![0..=99]));
        course.lacks(&robots[0], vec![range(0, 99)], 500);
        course.sent(1_000);
        assert_eq!(course.next(1_000), Step::Wait, "what was said before is out of date");
        course.lacks(&robots[0], vec![range(3, 5), range(90, 200)], 3_000);
        course.lacks(&robots[1], vec![range(4, 9), range(20, 20)], 3_100);
        course.lacks(&robots[2], Vec::new(), 3_200);
        assert_eq!(course.next(5_999), Step::Wait);
        assert_eq!(course.next(6_000), Step::Publish(vec![3..=9, 20..=20, 90..=99]));
        course.sent(7_000);
        let (_, gone) = course.set_robots(&[robots[1].clone()].into(), 7_500);
        assert_eq!(gone, [robots[0].clone(), robots[2].clone()]);
        course.lacks(&robots[1], vec![range(20, 20)], 9_000);
        assert_eq!(course.next(9_000), Step::Publish(vec![20..=20]), "all that listen have asked");
        course.sent(9_100);
        course.set_robots(&BTreeSet::new(), 9_500);
        assert_eq!((course.next(9_500), course.take_given_up()), (Step::Over, Vec::new()));
    }

    #[test]
    fn who_makes_no_progress_is_given_up_on_and_who_joins_late_is_not() {
        let all = robots(4);
        let mut course = course(&all[..3]);
        course.set_listening(|_| true, 0);
        assert_eq!(course.next(0), Step::Publish(vec![0..=99]));
        course.put_out(all[0].clone());
        course.sent(100);
        let (new, _) = course.set_robots(&all[1..].iter().cloned().collect(), 200);
        assert_eq!(new, [all[3].clone()]);
        let mut now_ms = 200;
        for turn in 0..4 {
            now_ms += 3_000;
            course.set_listening(|_| true, now_ms);
            course.lacks(&all[1], vec![range(1, 1)], now_ms);
            course.lacks(&all[3], vec![range(turn, 99)], now_ms);
            now_ms += COLLECT_MS;
            let step = course.next(now_ms);
            let expected = if turn == 0 { 0 } else { turn.min(if turn < 2 { 1 } else { turn }) };
            assert_eq!(step, Step::Publish(vec![expected..=99]), "turn {turn}");
            course.sent(now_ms);
        }
        assert_eq!(
            course.take_given_up(),
            [(all[0].clone(), GivenUp::HeldUp), (all[1].clone(), GivenUp::Useless)]
        );
        assert_eq!(course.next(now_ms + SILENT_MS), Step::Over);
        let silent = [(all[2].clone(), GivenUp::Silent), (all[3].clone(), GivenUp::Silent)];
        assert_eq!(course.take_given_up(), silent);
    }

    #[test]
    fn rounds_are_bounded() {
        let robots = robots(1);
        let mut course = course(&robots);
        course.set_listening(|_| true, 0);
        assert_eq!(course.next(0), Step::Publish(vec![0..=99]));
        for round in 0..=MAX_ROUNDS {
            course.sent(u64::from(round));
            course.lacks(&robots[0], vec![range(round, round)], u64::from(round));
            let over = round == MAX_ROUNDS;
            let expected = if over { Step::Over } else { Step::Publish(vec![round..=round]) };
            assert_eq!(course.next(u64::from(round)), expected);
        }
        assert_eq!(course.take_given_up(), [(robots[0].clone(), GivenUp::Rounds)]);
    }
}
