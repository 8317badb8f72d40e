//! The queue of pulls: running transfers, waiting robots, and their order. This module only
//! decides; time and randomness are overtaken in, and it neither waits nor sends.
//!
//! A place in the queue belongs to a robot and a blob, whether the robot's request is pending or
//! the robot was told to come back later. If the next robot in line is away, a present robot behind
//! it goes first. After a few such passes a transfer is reserved for the absent robot.
//!
//! A robot with a running transfer gets another one only while there is more room than all other
//! waiting robots would take. It loses a transfer that makes almost no progress while others wait.

use std::cmp::Reverse;
use std::collections::{BTreeMap, HashMap, HashSet};

use task_proto::ids::LabelValue;
use task_proto::{Digest, RobotId};

use crate::config::{SiteLimits, TransferLimits};

/// Maximum places in the queue; a further robot is told to come back later without a place.
const MAX_PLACES: usize = 20_000;
/// How often others may pass an absent robot.
const MAX_OVERTAKEN: u32 = 8;
/// Grace period after the announced return time, after which the robot loses its place.
const GRACE_MS: u64 = 30_000;
/// Interval between checks for lost places.
const CHECK_INTERVAL_MS: u64 = 1_000;
/// The minimum and the maximum time to stay away.
const MIN_AWAY_MS: u64 = 1_000;
const MAX_AWAY_MS: u64 = 60_000;
/// Minimum progress of a transfer and the period for it, the same that robots demand of the server.
/// A slower transfer ends when others wait.
const MIN_BYTES: u64 = 16 * 1024;
const MIN_BYTES_PERIOD_MS: u64 = 30_000;
/// Assumed duration of a transfer before any has ended.
const FIRST_GUESS_MS: u64 = 1_000;

/// A robot and the blob that it requests.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(super) struct Place {
    pub(super) robot: RobotId,
    pub(super) blob: Digest,
}

/// The attributes that determine the order of a place.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct TransferRequest {
    /// The deployment's priority: higher comes first.
    pub priority: i32,
    /// The deployment's number: lower, which means older, comes first.
    pub deployment: u64,
    /// The robot's site, if known.
    pub site: Option<LabelValue>,
}

/// A request that waits for its turn.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) struct RequestId(u64);

#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Permit {
    pub(super) robot: RobotId,
    pub(super) site: Option<LabelValue>,
}

/// Recent progress of a transfer.
#[derive(Debug, Clone, Copy)]
pub(super) struct Progress {
    since_ms: u64,
    taken_before: u64,
}

impl Progress {
    /// Starts measuring now, with this many bytes already taken.
    pub(super) fn from(now_ms: u64, taken_before: u64) -> Self {
        Self { since_ms: now_ms, taken_before }
    }

    /// Whether the transfer was too slow while others waited for the whole period. `taken`: total
    /// bytes.
    pub(super) fn is_too_slow(&mut self, taken: u64, others_wait: bool, now_ms: u64) -> bool {
        let is_enough = taken.saturating_sub(self.taken_before) >= MIN_BYTES;
        if is_enough || !others_wait {
            *self = Self::from(now_ms, taken);
        }
        now_ms.saturating_sub(self.since_ms) >= MIN_BYTES_PERIOD_MS
    }
}

/// The order of places: priority, age of the deployment, arrival.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Rank {
    priority: Reverse<i32>,
    deployment: u64,
    arrival: u64,
}

#[derive(Debug)]
struct WaitingPlace {
    place: Place,
    site: Option<LabelValue>,
    /// The pending request; `None`: the robot is away.
    request: Option<RequestId>,
    /// When an absent robot loses its place.
    expires_at_ms: u64,
    /// How often others went first.
    overtaken: u32,
}

/// Running transfers, in total or on one site.
#[derive(Debug, Clone, Copy, Default)]
struct Load {
    limits: SiteLimits,
    running: u64,
}

impl Load {
    fn free(&self) -> u64 {
        self.limits.max_transfers().map_or(u64::MAX, |max| max.saturating_sub(self.running))
    }
}

/// Remaining capacity, in total and on each site with limits.
struct Capacity<'a> {
    all: u64,
    sites: HashMap<&'a LabelValue, u64>,
}

impl<'a> Capacity<'a> {
    fn of(all: &Load, sites: &'a HashMap<LabelValue, Load>) -> Self {
        Self {
            all: all.free(),
            sites: sites.iter().map(|(site, load)| (site, load.free())).collect(),
        }
    }

    fn has_room(&self, site: Option<&LabelValue>) -> bool {
        self.all > 0 && site.and_then(|site| self.sites.get(site)) != Some(&0)
    }

    fn take(&mut self, site: Option<&LabelValue>) {
        self.all -= 1;
        if let Some(free) = site.and_then(|site| self.sites.get_mut(site)) {
            *free -= 1;
        }
    }
}

/// All transfers of robots.
#[derive(Debug)]
pub(super) struct Queue {
    all: Load,
    sites: HashMap<LabelValue, Load>,
    /// Number of running transfers of each robot.
    running_by_robot: HashMap<RobotId, u64>,
    waiting: BTreeMap<Rank, WaitingPlace>,
    ranks: HashMap<Place, Rank>,
    /// The rank of each pending request.
    requests: HashMap<RequestId, Rank>,
    /// Time of the last check for lost places.
    checked_at_ms: u64,
    last_number: u64,
    /// Moving average of transfer durations.
    average_ms: u64,
}

impl Queue {
    pub(super) fn new(limits: &TransferLimits) -> Self {
        let load = |limits: &SiteLimits| Load { limits: *limits, running: 0 };
        Self {
            all: load(&limits.all),
            sites: limits.sites.iter().map(|(site, limits)| (site.clone(), load(limits))).collect(),
            running_by_robot: HashMap::new(),
            waiting: BTreeMap::new(),
            ranks: HashMap::new(),
            requests: HashMap::new(),
            checked_at_ms: 0,
            last_number: 0,
            average_ms: FIRST_GUESS_MS,
        }
    }

    /// The number of running transfers.
    pub(super) fn running(&self) -> u64 {
        self.all.running
    }

    /// The number of robots that wait for their turn, present or away.
    pub(super) fn waiting(&self) -> u64 {
        self.waiting.len() as u64
    }

    /// Whether any other robot waits for its turn, present or away.
    pub(super) fn others_wait(&self, robot: &RobotId) -> bool {
        self.waiting.values().any(|waiting| waiting.place.robot != *robot)
    }

    /// Adds a robot's request. The request waits in the robot's existing place if there is one; an
    /// earlier request of the same place stops waiting. `None`: the queue has reached its maximum
    /// number of places.
    pub(super) fn enqueue(
        &mut self,
        place: Place,
        request: &TransferRequest,
        now_ms: u64,
    ) -> Option<RequestId> {
        self.remove_expired(now_ms);
        let before = self.ranks.remove(&place);
        if before.is_none() && self.waiting.len() >= MAX_PLACES {
            return None;
        }
        let id = RequestId(self.next_number());
        let waited = before.and_then(|rank| self.waiting.remove(&rank));
        if let Some(earlier) = waited.as_ref().and_then(|waited| waited.request) {
            self.requests.remove(&earlier);
        }
        let arrival = before.map_or(id.0, |rank| rank.arrival);
        let rank =
            Rank { priority: Reverse(request.priority), deployment: request.deployment, arrival };
        self.ranks.insert(place.clone(), rank);
        self.requests.insert(id, rank);
        let overtaken = waited.map_or(0, |waited| waited.overtaken);
        let site = request.site.clone();
        self.waiting.insert(
            rank,
            WaitingPlace { place, site, request: Some(id), expires_at_ms: u64::MAX, overtaken },
        );
        Some(id)
    }

    /// Begins the transfers that may begin now. Call this after every change that may have made
    /// room.
    pub(super) fn start_next(&mut self, now_ms: u64) -> Vec<(RequestId, Permit)> {
        if self.all.free() == 0 {
            return Vec::new();
        }
        self.remove_expired(now_ms);
        let mut free = Capacity::of(&self.all, &self.sites);
        let (mut begun, mut away, mut further) = (Vec::new(), Vec::new(), Vec::new());
        let (mut served, mut reserved_for): (HashSet<&RobotId>, HashSet<&RobotId>) =
            Default::default();
        for (rank, waiting) in &self.waiting {
            if free.all == 0 {
                break;
            }
            if !free.has_room(waiting.site.as_ref()) {
                continue;
            }
            let robot = &waiting.place.robot;
            if self.running_by_robot.contains_key(robot) || served.contains(robot) {
                further.push(*rank);
                continue;
            }
            match waiting.request {
                Some(_) => {
                    begun.push((*rank, away.len()));
                    served.insert(robot);
                }
                // A robot that others have overtaken too often gets a reserved transfer, in one of
                // its places.
                None if waiting.overtaken >= MAX_OVERTAKEN && reserved_for.insert(robot) => {}
                None => {
                    away.push(*rank);
                    continue;
                }
            }
            free.take(waiting.site.as_ref());
        }
        // Absent robots would take as much, each robot once.
        for waiting in away.iter().filter_map(|rank| self.waiting.get(rank)) {
            let robot = &waiting.place.robot;
            if free.has_room(waiting.site.as_ref())
                && !served.contains(robot)
                && reserved_for.insert(robot)
            {
                free.take(waiting.site.as_ref());
            }
        }
        for rank in further {
            let Some(waiting) = self.waiting.get(&rank).filter(|waiting| waiting.request.is_some())
            else {
                continue;
            };
            if free.has_room(waiting.site.as_ref()) {
                free.take(waiting.site.as_ref());
                begun.push((rank, 0));
            }
        }
        for (index, rank) in away.iter().enumerate() {
            let overtakers = begun.iter().filter(|(_, away_before)| *away_before > index).count();
            if let Some(waiting) = self.waiting.get_mut(rank) {
                waiting.overtaken =
                    waiting.overtaken.saturating_add(u32::try_from(overtakers).unwrap_or(u32::MAX));
            }
        }
        begun.into_iter().filter_map(|(rank, _)| self.start(rank)).collect()
    }

    /// Removes the pending request and keeps the robot's place. Returns how long the robot should
    /// stay away; `None` if the request does not wait. `chance` is from 0 to 1.
    pub(super) fn defer(&mut self, request: RequestId, now_ms: u64, chance: f64) -> Option<u64> {
        let rank = self.requests.remove(&request)?;
        let on_site = self.waiting.get(&rank)?.site.as_ref().and_then(|site| self.sites.get(site));
        let at_once = [Some(&self.all), on_site]
            .into_iter()
            .flatten()
            .filter_map(|load| load.limits.max_transfers())
            .min();
        let (at_once, average_ms) = (at_once.unwrap_or(1).max(1), self.average_ms.max(1));
        // Beyond the maximum time to stay away the exact number does not matter.
        let enough = usize::try_from((MAX_AWAY_MS / average_ms + 1).saturating_mul(at_once))
            .unwrap_or(usize::MAX);
        let ahead = self.waiting.range(..rank).take(enough).count() as u64;
        let away_ms = jittered((ahead + 1).div_ceil(at_once).saturating_mul(average_ms), chance);
        let waiting = self.waiting.get_mut(&rank)?;
        waiting.request = None;
        waiting.expires_at_ms = now_ms + away_ms + GRACE_MS;
        Some(away_ms)
    }

    /// Ends a transfer after this duration.
    pub(super) fn finish(&mut self, permit: &Permit, lasted_ms: u64) {
        self.all.running -= 1;
        if let Some(load) = permit.site.as_ref().and_then(|site| self.sites.get_mut(site)) {
            load.running -= 1;
        }
        if let Some(running) = self.running_by_robot.get_mut(&permit.robot) {
            *running -= 1;
            if *running == 0 {
                self.running_by_robot.remove(&permit.robot);
            }
        }
        self.average_ms = (self.average_ms * 7 + lasted_ms) / 8;
    }

    fn start(&mut self, rank: Rank) -> Option<(RequestId, Permit)> {
        let waiting = self.waiting.remove(&rank)?;
        self.ranks.remove(&waiting.place);
        if let Some(request) = waiting.request {
            self.requests.remove(&request);
        }
        self.all.running += 1;
        if let Some(load) = waiting.site.as_ref().and_then(|site| self.sites.get_mut(site)) {
            load.running += 1;
        }
        *self.running_by_robot.entry(waiting.place.robot.clone()).or_default() += 1;
        Some((waiting.request?, Permit { robot: waiting.place.robot, site: waiting.site }))
    }

    fn remove_expired(&mut self, now_ms: u64) {
        if now_ms < self.checked_at_ms + CHECK_INTERVAL_MS {
            return;
        }
        self.checked_at_ms = now_ms;
        let ranks = &mut self.ranks;
        self.waiting.retain(|_, waiting| {
            let is_kept = waiting.request.is_some() || now_ms < waiting.expires_at_ms;
            if !is_kept {
                ranks.remove(&waiting.place);
            }
            is_kept
        });
    }

    fn next_number(&mut self) -> u64 {
        self.last_number += 1;
        self.last_number
    }
}

/// A time to stay away: at least the expected wait, up to half as much again, so that robots sent
/// away together come back one by one.
pub(super) fn jittered(expected_ms: u64, chance: f64) -> u64 {
    let expected_ms = expected_ms.clamp(MIN_AWAY_MS, MAX_AWAY_MS);
    expected_ms + (expected_ms as f64 / 2.0 * chance.clamp(0.0, 1.0)) as u64
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn limits(max: u64) -> TransferLimits {
        TransferLimits {
            all: SiteLimits { max: Some(max), bytes_per_s: None },
            ..TransferLimits::default()
        }
    }

    fn place(number: u8) -> Place {
        Place { robot: format!("r{number:016x}").parse().expect("valid"), blob: Digest::of(b"x") }
    }

    fn request(priority: i32) -> TransferRequest {
        TransferRequest { priority, ..TransferRequest::default() }
    }

    fn permit(number: u8) -> Permit {
        Permit { robot: place(number).robot, site: None }
    }

    #[test]
    fn priority_comes_before_age_and_age_before_arrival() {
        let mut queue = Queue::new(&limits(1));
        let first = queue.enqueue(place(0), &request(0), 0);
        assert_eq!(queue.start_next(0), [(first.expect("room"), permit(0))]);
        let mut ask = |number, priority, deployment| {
            queue
                .enqueue(place(number), &TransferRequest { priority, deployment, site: None }, 0)
                .expect("room")
        };
        let (late, early, old, high) = (ask(1, 0, 7), ask(2, 0, 7), ask(3, 0, 6), ask(4, 1, 9));
        let mut before = 0;
        for (next, number) in [(high, 4), (old, 3), (late, 1), (early, 2)] {
            assert_eq!(queue.start_next(0), []);
            queue.finish(&permit(before), 1_000);
            assert_eq!(queue.start_next(0), [(next, permit(number))]);
            before = number;
        }
    }

    #[test]
    fn bandwidth_limits_the_number_of_transfers() {
        let most =
            |max, bytes_per_s| SiteLimits { max, bytes_per_s: Some(bytes_per_s) }.max_transfers();
        assert_eq!(
            [most(None, 1 << 20), most(Some(3), 1 << 20), most(Some(3), 1000)],
            [Some(256), Some(3), Some(1)]
        );
        assert_eq!(SiteLimits::default().max_transfers(), None);
        let all = SiteLimits { max: None, bytes_per_s: Some(8 << 10) };
        let mut queue = Queue::new(&TransferLimits { all, ..TransferLimits::default() });
        for number in 0..3 {
            queue.enqueue(place(number), &request(0), 0).expect("room");
        }
        assert_eq!(queue.start_next(0).len(), 2);
    }

    #[test]
    fn site_limit_does_not_hold_up_other_sites() {
        let site: LabelValue = "hall-3".parse().expect("valid");
        let mut queue = Queue::new(&TransferLimits {
            sites: [(site.clone(), SiteLimits { max: Some(1), bytes_per_s: None })].into(),
            ..limits(3)
        });
        let there = TransferRequest { site: Some(site.clone()), ..TransferRequest::default() };
        for number in 0..3 {
            queue.enqueue(place(number), &there, 0);
        }
        for number in 3..6 {
            queue.enqueue(place(number), &request(-1), 0);
        }
        let begun: Vec<_> = queue.start_next(0).into_iter().map(|(_, turn)| turn).collect();
        assert_eq!(begun, [Permit { site: Some(site), ..permit(0) }, permit(3), permit(4)]);
        queue.finish(&begun[0], 1_000);
        assert_eq!(queue.start_next(0).len(), 1);
    }

    #[test]
    fn deferred_robot_keeps_its_place_and_waits_by_position() {
        let mut queue = Queue::new(&limits(2));
        let ids: Vec<RequestId> = (0..8)
            .map(|number| queue.enqueue(place(number), &request(0), 0).expect("room"))
            .collect();
        assert_eq!(queue.start_next(0).len(), 2);
        assert_eq!(queue.defer(ids[0], 0, 0.0), None, "it is under way");
        assert_eq!(queue.defer(ids[2], 0, 0.0), Some(1_000));
        assert_eq!(queue.defer(ids[7], 0, 0.0), Some(3_000));
        assert_eq!(queue.defer(ids[7], 0, 0.0), None, "it is away already");
        assert_eq!(queue.defer(ids[6], 0, 1.0), Some(4_500));
        queue.enqueue(place(7), &request(0), 3_000);
        let again = queue.enqueue(place(2), &request(0), 3_000).expect("room");
        queue.finish(&permit(0), 1_000);
        assert_eq!(queue.start_next(3_000), [(again, permit(2))], "first in its old place");
        // A robot that does not come back loses its place.
        queue.finish(&permit(1), 1_000);
        queue.finish(&permit(2), 1_000);
        assert_eq!(queue.start_next(3_000).len(), 2);
        assert_eq!(queue.waiting.len(), 3);
        queue.remove_expired(4_500 + GRACE_MS);
        assert_eq!((queue.waiting.len(), queue.ranks.len()), (2, 2));
    }

    #[test]
    fn places_are_bounded() {
        let mut queue = Queue::new(&limits(1));
        let place = |number: usize| Place {
            robot: format!("r{number:016x}").parse().expect("valid"),
            blob: Digest::of(b"x"),
        };
        for number in 0..MAX_PLACES {
            assert!(queue.enqueue(place(number), &request(0), 0).is_some());
        }
        assert_eq!(queue.enqueue(place(MAX_PLACES), &request(9), 0), None);
        assert!(queue.enqueue(place(0), &request(0), 0).is_some(), "it has one");
    }

    proptest! {
        /// For any order of robots and newcomers: never more transfers than the limit. A robot that
        /// returns on time gets its turn after at most the robots before it, each of which may be
        /// overtaken a few times.
        #[test]
        fn no_robot_starves(max in 1u64..5, others in 1u8..20, newcomers in proptest::collection::vec(0u64..3, 300), seed in any::<u64>()) {
            let mut queue = Queue::new(&limits(max));
            let mut chance = seed;
            let mut random = move |below: u64| {
                chance = chance.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                (chance >> 33) % below
            };
            for number in 0..others {
                queue.enqueue(place(number), &request(0), 0);
            }
            let mut mine = queue.enqueue(place(100), &request(0), 0);
            let (mut now_ms, mut back_at_ms, mut begun_in_all) = (0, u64::MAX, 0_u64);
            let mut is_done = false;
            let mut running = Vec::new();
            for (turn, count) in newcomers.iter().enumerate() {
                now_ms += 1_000;
                for index in 0..*count {
                    let robot = format!("r{:016x}", 1_000 + turn as u64 * 10 + index).parse().expect("valid");
                    queue.enqueue(Place { robot, blob: Digest::of(b"x") }, &request(0), now_ms);
                }
                if mine.is_none() && now_ms >= back_at_ms {
                    mine = queue.enqueue(place(100), &request(0), now_ms);
                }
                for _ in 0..random(max + 1).min(running.len() as u64) {
                    queue.finish(&running.pop().expect("it runs"), 1_000);
                }
                for (request, turn) in queue.start_next(now_ms) {
                    is_done |= Some(request) == mine;
                    running.push(turn);
                    begun_in_all += u64::from(!is_done);
                }
                prop_assert!(running.len() as u64 <= max && queue.running() == running.len() as u64);
                if is_done {
                    break;
                }
                // Sometimes the robot is absent when its turn could have come.
                if let Some(request) = mine.filter(|_| random(2) == 0) {
                    back_at_ms = now_ms + queue.defer(request, now_ms, 0.5).expect("waits");
                    mine = None;
                }
            }
            prop_assert!(begun_in_all <= u64::from(others) + u64::from(MAX_OVERTAKEN) + max);
        }

        /// For any number of requested blobs: a robot gets more than one turn only from capacity
        /// that no robot without a turn could have used, and all requests are served in the end.
        #[test]
        fn robot_with_many_blobs_does_not_displace_others(max in 1u64..5, acts in proptest::collection::vec((0u8..4, 0u8..6, 0u8..6), 1..200)) {
            let mut queue = Queue::new(&limits(max));
            let place = |robot, blob: u8| Place { blob: Digest::of(&[blob]), ..place(robot) };
            let mut pending: HashMap<RequestId, Place> = HashMap::new();
            let mut away: HashSet<Place> = HashSet::new();
            let mut running: Vec<Permit> = Vec::new();
            let mut ends = acts.clone();
            ends.extend(std::iter::repeat_n((3, 0, 0), 100));
            for (act, robot, blob) in ends {
                match act {
                    0 | 1 => {
                        let wanted = place(robot, blob);
                        pending.retain(|_, other| *other != wanted);
                        away.remove(&wanted);
                        pending.insert(queue.enqueue(wanted.clone(), &request(0), 0).expect("room"), wanted);
                    }
                    2 => {
                        if let Some(one) = pending.keys().next().copied() {
                            prop_assert!(queue.defer(one, 0, 0.5).is_some());
                            away.extend(pending.remove(&one));
                        }
                    }
                    _ => {
                        if let Some(turn) = running.pop() {
                            queue.finish(&turn, 1_000);
                        }
                    }
                }
                let had: HashSet<RobotId> = running.iter().map(|turn| turn.robot.clone()).collect();
                let begun = queue.start_next(0);
                let mut has_further = false;
                let mut first = had.clone();
                for (one, turn) in begun {
                    has_further |= !first.insert(turn.robot.clone());
                    pending.remove(&one).expect("pending");
                    running.push(turn);
                }
                prop_assert!(running.len() as u64 <= max);
                if has_further {
                    let without = |place: &&Place| !first.contains(&place.robot);
                    let wait: HashSet<_> = away.iter().filter(without).map(|place| place.robot.clone()).collect();
                    prop_assert!(pending.values().all(|place| first.contains(&place.robot)), "one that is there waits");
                    prop_assert!(running.len() + wait.len() <= usize::try_from(max).expect("few"));
                }
            }
            prop_assert!(pending.is_empty() || !away.is_empty(), "all requests were served");
            prop_assert_eq!(queue.running_by_robot.values().sum::<u64>(), running.len() as u64);
        }
    }

    #[test]
    fn slow_transfer_ends_only_while_others_wait() {
        let mut progress = Progress::from(0, 0);
        assert!(!progress.is_too_slow(0, false, 10 * MIN_BYTES_PERIOD_MS), "no other robot waits");
        let from = 10 * MIN_BYTES_PERIOD_MS;
        assert!(!progress.is_too_slow(MIN_BYTES - 1, true, from + MIN_BYTES_PERIOD_MS - 1));
        assert!(
            !progress.is_too_slow(MIN_BYTES, true, from + MIN_BYTES_PERIOD_MS),
            "it took enough"
        );
        assert!(!progress.is_too_slow(2 * MIN_BYTES - 1, true, from + 2 * MIN_BYTES_PERIOD_MS - 1));
        assert!(progress.is_too_slow(2 * MIN_BYTES - 1, true, from + 2 * MIN_BYTES_PERIOD_MS));
    }
}
