//! Decides when a deployment's next batch begins and when the deployment pauses. These are pure
//! functions; [`crate::orders::advance`] carries out their decisions.
//!
//! A batched rollout waits for robots that can act. A robot that is offline when its turn comes
//! keeps its place, and the rollout passes it over until the robot is back. If a robot goes offline
//! after its batch began, the rollout waits [`OFFLINE_GRACE_MS`], or [`LOST_AFTER_MS`] if the robot
//! has begun to work on the package. After that time the rollout goes on without the robot. A robot
//! that was lost while it worked on the package counts as a failure until it is back. A package
//! that takes robots off the network therefore stops at `max_failures`.

/// Time that a robot which has not begun may be offline before its batch goes on without it. A
/// reconnect or the restart of the agent takes less.
pub const OFFLINE_GRACE_MS: u64 = 60_000;
/// Time that a robot which has begun to work on the package may be offline before it counts as
/// lost. A reboot takes less.
pub const LOST_AFTER_MS: u64 = 10 * 60_000;

/// The pace that the order asked for, and the decisions since.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Rollout {
    /// Robots at a time; `None`: all at once.
    pub batch: Option<u64>,
    /// The number of failures that the order tolerates; `None`: any number.
    pub max_failures: Option<u64>,
    /// Failures that the operator has accepted by resuming the deployment.
    pub forgiven: u64,
    /// Whether the rollout waits for the operator.
    pub paused: bool,
    /// Whether the order is still to be placed for some of its robots: more will wait for a batch.
    pub is_placing: bool,
}

/// The progress of a robot with an unsettled assignment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RobotProgress {
    /// The robot's batch has not begun.
    Waiting,
    /// The robot's batch has begun, and the robot has not begun to work on the package.
    Released,
    /// The robot works on the package.
    Begun,
}

/// The part of an unsettled robot in the rollout.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Part {
    /// The robot may begin with the next batch.
    Ready,
    /// The robot is offline and begins when it is back.
    Offline,
    /// The next batch waits for the robot.
    Busy,
    /// The robot went offline while it worked on the package, and has not come back in time.
    Lost,
    /// The rollout does not wait for the robot.
    Ignored,
}

impl Part {
    /// The part of a robot that has been offline for `offline_ms`; `None`: the robot is online.
    pub fn of(progress: RobotProgress, offline_ms: Option<u64>) -> Self {
        match (progress, offline_ms) {
            (RobotProgress::Waiting, None) => Self::Ready,
            (RobotProgress::Waiting, Some(_)) => Self::Offline,
            (RobotProgress::Released, Some(OFFLINE_GRACE_MS..)) => Self::Ignored,
            (RobotProgress::Begun, Some(LOST_AFTER_MS..)) => Self::Lost,
            (RobotProgress::Released | RobotProgress::Begun, _) => Self::Busy,
        }
    }
}

/// Counts of a deployment's robots by part.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Tally {
    /// Online, and their batch has not begun.
    pub ready: u64,
    /// Offline, and their batch has not begun.
    pub offline: u64,
    /// Released, not settled, and waited for.
    pub busy: u64,
    /// Lost while they worked on the package.
    pub lost: u64,
    pub failed: u64,
}

impl Tally {
    /// Counts the unsettled robots by part; `failed` counts those that failed.
    pub fn of(failed: u64, parts: impl IntoIterator<Item = Part>) -> Self {
        let mut tally = Self { failed, ..Self::default() };
        for part in parts {
            match part {
                Part::Ready => tally.ready += 1,
                Part::Offline => tally.offline += 1,
                Part::Busy => tally.busy += 1,
                Part::Lost => tally.lost += 1,
                Part::Ignored => {}
            }
        }
        tally
    }

    /// The number that `max_failures` limits.
    pub fn failures(&self) -> u64 {
        self.failed + self.lost
    }
}

/// The next step of a rollout.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Move {
    /// Do nothing until an assignment settles, a robot comes or goes, or the operator resumes.
    Wait,
    /// Begin a batch of this many robots: those that are ready or, without batches, all that are
    /// left.
    Release(u64),
    /// Only offline robots are left: let their time run.
    AwaitOffline,
    /// Begin no more robots: too many have failed.
    Pause,
}

/// Decides the next step of a rollout.
pub fn next_move(rollout: &Rollout, tally: &Tally) -> Move {
    let waiting = tally.ready + tally.offline;
    if rollout.paused || waiting == 0 {
        return Move::Wait;
    }
    let failures = tally.failures().saturating_sub(rollout.forgiven);
    if rollout.max_failures.is_some_and(|most| failures > most) {
        return Move::Pause;
    }
    match rollout.batch {
        None => Move::Release(waiting),
        Some(_) if tally.busy > 0 => Move::Wait,
        Some(_) if tally.ready == 0 && rollout.is_placing => Move::Wait,
        Some(_) if tally.ready == 0 => Move::AwaitOffline,
        Some(batch) => Move::Release(batch.clamp(1, tally.ready)),
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// A rollout without limits.
    const UNLIMITED: Rollout =
        Rollout { batch: None, max_failures: None, forgiven: 0, paused: false, is_placing: false };

    /// A robot of the model: its outcome, and its time offline.
    #[derive(Debug, Clone)]
    struct Robot {
        fails: bool,
        /// Offline from the first minute until the second.
        offline: Option<(u64, u64)>,
        progress: RobotProgress,
        has_settled: bool,
    }

    fn arbitrary_robot() -> impl Strategy<Value = Robot> {
        let offline = proptest::option::of(
            (0u64..60, 1u64..120).prop_map(|(from, minutes)| (from, from + minutes)),
        );
        (any::<bool>(), offline).prop_map(|(fails, offline)| Robot {
            fails,
            offline,
            progress: RobotProgress::Waiting,
            has_settled: false,
        })
    }

    impl Robot {
        fn offline_ms(&self, minute: u64) -> Option<u64> {
            self.offline
                .filter(|(from, until)| (*from..*until).contains(&minute))
                .map(|(from, _)| (minute - from) * 60_000)
        }

        fn part(&self, minute: u64) -> Option<Part> {
            (!self.has_settled).then(|| Part::of(self.progress, self.offline_ms(minute)))
        }
    }

    fn tally(robots: &[Robot], minute: u64) -> Tally {
        let failed = robots.iter().filter(|robot| robot.has_settled && robot.fails).count() as u64;
        Tally::of(failed, robots.iter().filter_map(|robot| robot.part(minute)))
    }

    proptest! {
        /// A whole rollout, minute by minute: each online robot takes a step.
        #[test]
        fn batches_of_online_robots_never_overlap_and_failures_stop_them(
            mut robots in proptest::collection::vec(arbitrary_robot(), 1..40),
            batch in proptest::option::of(1u64..9),
            max_failures in proptest::option::of(0u64..6),
        ) {
            let mut rollout = Rollout { batch, max_failures, ..UNLIMITED };
            // After three hours all robots are online for good. A batch of one takes two minutes,
            // and at most ten of waiting.
            for minute in 0..(180 + 12 * robots.len() as u64) {
                loop {
                    let now = tally(&robots, minute);
                    match next_move(&rollout, &now) {
                        Move::Release(count) => {
                            prop_assert!(count >= 1 && max_failures.is_none_or(|most| now.failures() <= most));
                            prop_assert!(batch.is_none_or(|batch| now.busy == 0 && count <= batch.min(now.ready)));
                            let waiting = robots.iter_mut().filter(|robot| match batch {
                                Some(_) => robot.part(minute) == Some(Part::Ready),
                                None => !robot.has_settled,
                            });
                            waiting.take(count as usize).for_each(|robot| robot.progress = RobotProgress::Released);
                        }
                        Move::Pause => {
                            prop_assert!(max_failures.is_some_and(|most| now.failures() > most));
                            rollout.paused = true;
                        }
                        Move::AwaitOffline => {
                            prop_assert!(now.busy == 0 && now.ready == 0 && now.offline > 0);
                            break;
                        }
                        Move::Wait => {
                            prop_assert!(rollout.paused || now.busy > 0 || now.ready + now.offline == 0);
                            break;
                        }
                    }
                }
                for robot in &mut robots {
                    match robot.progress {
                        _ if robot.has_settled || robot.offline_ms(minute).is_some() => {}
                        RobotProgress::Waiting => {}
                        RobotProgress::Released => robot.progress = RobotProgress::Begun,
                        RobotProgress::Begun => robot.has_settled = true,
                    }
                }
            }
            // The rollout only ends when all robots have had their turn, or when it was paused.
            prop_assert!(rollout.paused || robots.iter().all(|robot| robot.has_settled));
        }

        /// However long the others stay away, online robots have their turn within the hour that
        /// the absence of one batch can cost.
        #[test]
        fn offline_robots_never_hold_back_the_others(absent in 1u64..50, online in 1u64..50, batch in 1u64..9) {
            let rollout = Rollout { batch: Some(batch), max_failures: Some(0), ..UNLIMITED };
            let tally = Tally { ready: online, offline: absent, ..Tally::default() };
            prop_assert_eq!(next_move(&rollout, &tally), Move::Release(batch.min(online)));
            let none_ready = Tally { ready: 0, ..tally };
            prop_assert_eq!(next_move(&rollout, &none_ready), Move::AwaitOffline);
            // Those that the order is not placed for yet may be online.
            let placing = Rollout { is_placing: true, ..rollout };
            prop_assert_eq!(next_move(&placing, &none_ready), Move::Wait);
        }
    }

    #[test]
    fn rollout_waits_for_a_robot_until_it_is_offline_for_long() {
        use RobotProgress::{Begun, Released, Waiting};
        let cases = [
            (Waiting, None, Part::Ready),
            (Waiting, Some(0), Part::Offline),
            (Released, None, Part::Busy),
            (Released, Some(OFFLINE_GRACE_MS - 1), Part::Busy),
            (Released, Some(OFFLINE_GRACE_MS), Part::Ignored),
            (Begun, None, Part::Busy),
            (Begun, Some(LOST_AFTER_MS - 1), Part::Busy),
            (Begun, Some(LOST_AFTER_MS), Part::Lost),
        ];
        for (progress, offline_ms, part) in cases {
            assert_eq!(Part::of(progress, offline_ms), part, "{progress:?}, {offline_ms:?}");
        }
    }

    #[test]
    fn lost_robot_counts_as_a_failure() {
        let rollout = Rollout { batch: Some(2), max_failures: Some(0), ..UNLIMITED };
        let tally = Tally { ready: 5, lost: 1, ..Tally::default() };
        assert_eq!(next_move(&rollout, &tally), Move::Pause);
        assert_eq!(
            next_move(&Rollout { max_failures: Some(1), ..rollout }, &tally),
            Move::Release(2)
        );
        assert_eq!(next_move(&Rollout { max_failures: None, ..rollout }, &tally), Move::Release(2));
    }

    #[test]
    fn resumed_rollout_tolerates_max_failures_again() {
        let rollout = Rollout { batch: Some(2), max_failures: Some(1), forgiven: 2, ..UNLIMITED };
        let tally = Tally { ready: 5, failed: 3, ..Tally::default() };
        assert_eq!(next_move(&rollout, &tally), Move::Release(2));
        assert_eq!(next_move(&rollout, &Tally { failed: 4, ..tally }), Move::Pause);
    }
}
