//! Who is there: which robot is connected over MQTT or polls over HTTP, from where and since when, and which robots have
//! two instances that displace each other. Kept in memory only; it never talks to anyone and never reads a clock.

use std::collections::{HashMap, VecDeque};
use std::net::SocketAddr;
use std::sync::{Mutex, MutexGuard, PoisonError};

use task_proto::{InstanceId, RobotId};

/// Within this time two returns of a displaced instance mean a duplicate, and after this much quiet it is over.
pub const DUPLICATE_WINDOW_MS: u64 = 10 * 60 * 1000;
/// Robots remembered at most; beyond it whoever was silent for longest is forgotten.
const MAX_ROBOTS: usize = 100_000;
/// Changes of instance remembered for each robot.
const MAX_CHANGES: usize = 8;

/// Everyone who was seen by this process.
pub struct Presence {
    window_ms: u64,
    /// Robots that were not seen since are offline since then.
    started_ms: u64,
    robots: Mutex<HashMap<RobotId, Sightings>>,
}

/// What is known of one robot.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Sighting {
    /// Connected over MQTT, or heard over HTTP within the window.
    pub online: bool,
    /// Where it was last heard from, as far as that is known.
    pub address: Option<SocketAddr>,
    /// Since when it is connected over MQTT, if it is.
    pub connected_since_ms: Option<u64>,
    /// The number of that connection.
    pub connection: Option<u64>,
    /// When it was last heard.
    pub last_seen_ms: u64,
    /// Two instances of it keep displacing each other.
    pub duplicate: bool,
}

struct Sightings {
    address: Option<SocketAddr>,
    connection: Option<Connection>,
    last_seen_ms: u64,
    /// When it was last heard over HTTP. The end of a connection takes it back: who hangs up is away until it asks.
    polled_ms: Option<u64>,
    instances: InstanceHistory,
}

#[derive(Clone, Copy)]
struct Connection {
    number: u64,
    since_ms: u64,
}

impl Presence {
    /// Nobody seen yet. A robot that polls is online for `window_ms` after it was heard.
    pub fn new(window_ms: u64, now_ms: u64) -> Self {
        Self { window_ms, started_ms: now_ms, robots: Mutex::default() }
    }

    /// The robot's MQTT session number `connection` began.
    pub fn connected(&self, robot: &RobotId, address: Option<SocketAddr>, connection: u64, now_ms: u64) {
        let mut robots = self.robots();
        let sightings = heard(&mut robots, robot, address, now_ms);
        if sightings.connection.is_none_or(|known| known.number < connection) {
            sightings.connection = Some(Connection { number: connection, since_ms: now_ms });
            sightings.address = address.or(sightings.address);
        }
    }

    /// The robot's MQTT session number `connection` ended. An end that comes after the next beginning changes nothing.
    pub fn disconnected(&self, robot: &RobotId, connection: u64, now_ms: u64) {
        if let Some(sightings) = self.robots().get_mut(robot)
            && sightings.connection.is_some_and(|known| known.number == connection)
        {
            sightings.connection = None;
            sightings.polled_ms = None;
            sightings.last_seen_ms = sightings.last_seen_ms.max(now_ms);
        }
    }

    /// The robot was heard over HTTP.
    pub fn seen(&self, robot: &RobotId, address: SocketAddr, now_ms: u64) {
        heard(&mut self.robots(), robot, Some(address), now_ms).polled_ms = Some(now_ms);
    }

    /// The robot named its instance. Returns whether it is a duplicate identity now.
    pub fn instance_seen(
        &self,
        robot: &RobotId,
        address: Option<SocketAddr>,
        instance: &InstanceId,
        now_ms: u64,
    ) -> bool {
        let mut robots = self.robots();
        let sightings = heard(&mut robots, robot, address, now_ms);
        sightings.instances.observe(instance, now_ms);
        sightings.instances.is_duplicate(now_ms)
    }

    /// The start of its agent that was heard last.
    pub fn instance(&self, robot: &RobotId) -> Option<InstanceId> {
        self.robots().get(robot)?.instances.changes.back().map(|last| last.instance.clone())
    }

    /// What is known of the robot; `None` if it was not seen by this process.
    pub fn get(&self, robot: &RobotId, now_ms: u64) -> Option<Sighting> {
        self.robots().get(robot).map(|sightings| sightings.view(self.window_ms, now_ms))
    }

    /// Whether the robot is online.
    pub fn is_online(&self, robot: &RobotId, now_ms: u64) -> bool {
        self.get(robot, now_ms).is_some_and(|sighting| sighting.online)
    }

    /// For how long each of these robots has been offline, as far as this process knows; `None`: it is online.
    pub fn offline_ms<'a>(&self, robots: impl IntoIterator<Item = &'a RobotId>, now_ms: u64) -> Vec<Option<u64>> {
        let known = self.robots();
        let offline_ms = |robot: &RobotId| {
            let since_ms = match known.get(robot).map(|sightings| sightings.view(self.window_ms, now_ms)) {
                Some(sighting) if sighting.online => return None,
                Some(sighting) => sighting.last_seen_ms.max(self.started_ms),
                None => self.started_ms,
            };
            Some(now_ms.saturating_sub(since_ms))
        };
        robots.into_iter().map(offline_ms).collect()
    }

    /// Whether it is connected over MQTT.
    pub fn is_connected(&self, robot: &RobotId) -> bool {
        self.robots().get(robot).is_some_and(|sightings| sightings.connection.is_some())
    }

    /// Robots without a connection that were online at `since_ms` and no longer are at `now_ms`, because they were not
    /// heard for the window.
    pub fn fell_silent(&self, since_ms: u64, now_ms: u64) -> Vec<RobotId> {
        let robots = self.robots();
        let fell = robots.iter().filter(|(_, sightings)| {
            let ends_ms = sightings.polled_ms.map(|polled_ms| polled_ms.saturating_add(self.window_ms));
            sightings.connection.is_none() && ends_ms.is_some_and(|ends_ms| since_ms < ends_ms && ends_ms <= now_ms)
        });
        fell.map(|(robot, _)| robot.clone()).collect()
    }

    /// Whether two instances of the robot keep displacing each other.
    pub fn is_duplicate(&self, robot: &RobotId, now_ms: u64) -> bool {
        self.robots().get(robot).is_some_and(|sightings| sightings.instances.is_duplicate(now_ms))
    }

    /// Its other tokens have ended, so that nobody else is let in by them any more.
    pub fn ended_others(&self, robot: &RobotId) {
        if let Some(sightings) = self.robots().get_mut(robot) {
            sightings.instances = InstanceHistory::default();
        }
    }

    /// The robot was removed.
    pub fn forget(&self, robot: &RobotId) {
        self.robots().remove(robot);
    }

    fn robots(&self) -> MutexGuard<'_, HashMap<RobotId, Sightings>> {
        // Every change under this lock is complete in itself, so a panic elsewhere leaves nothing half-done.
        self.robots.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn heard<'a>(
    robots: &'a mut HashMap<RobotId, Sightings>,
    robot: &RobotId,
    address: Option<SocketAddr>,
    now_ms: u64,
) -> &'a mut Sightings {
    if robots.len() >= MAX_ROBOTS && !robots.contains_key(robot) {
        make_room(robots);
    }
    let sightings = robots.entry(robot.clone()).or_insert_with(|| Sightings {
        address,
        connection: None,
        last_seen_ms: now_ms,
        polled_ms: None,
        instances: InstanceHistory::default(),
    });
    let is_elsewhere = address.map(|address| address.ip()) != sightings.address.map(|address| address.ip());
    // While there is a session its port is the robot's: each HTTP request may have another one.
    if address.is_some() && (sightings.connection.is_none() || is_elsewhere) {
        sightings.address = address;
    }
    sightings.last_seen_ms = sightings.last_seen_ms.max(now_ms);
    sightings
}

/// Forgets the sixteenth that was silent for longest, so that the next scan is far off.
fn make_room(robots: &mut HashMap<RobotId, Sightings>) {
    let mut silent: Vec<(bool, u64, RobotId)> = robots
        .iter()
        .map(|(robot, sightings)| (sightings.connection.is_some(), sightings.last_seen_ms, robot.clone()))
        .collect();
    silent.sort_unstable();
    for (_, _, robot) in silent.into_iter().take(MAX_ROBOTS / 16) {
        robots.remove(&robot);
    }
}

impl Sightings {
    fn view(&self, window_ms: u64, now_ms: u64) -> Sighting {
        Sighting {
            online: self.connection.is_some()
                || self.polled_ms.is_some_and(|polled_ms| now_ms.saturating_sub(polled_ms) < window_ms),
            address: self.address,
            connected_since_ms: self.connection.map(|connection| connection.since_ms),
            connection: self.connection.map(|connection| connection.number),
            last_seen_ms: self.last_seen_ms,
            duplicate: self.instances.is_duplicate(now_ms),
        }
    }
}

/// The instances of one robot, by when each took the place of another.
///
/// A restarted agent is a new instance and an old one never comes back, except for a message that was late. So two
/// *returns* within [`DUPLICATE_WINDOW_MS`] (A, B, A again, B again) mean that two machines share the identity.
#[derive(Debug, Clone, Default)]
pub struct InstanceHistory {
    changes: VecDeque<Change>,
    /// The last return that made, or kept, the robot a duplicate.
    duplicate_at_ms: Option<u64>,
}

#[derive(Debug, Clone)]
struct Change {
    instance: InstanceId,
    at_ms: u64,
    is_return: bool,
}

impl InstanceHistory {
    /// `instance` was heard.
    pub fn observe(&mut self, instance: &InstanceId, now_ms: u64) {
        if self.changes.back().is_some_and(|last| last.instance == *instance) {
            return;
        }
        let is_return = self.changes.iter().any(|change| change.instance == *instance);
        self.changes.push_back(Change { instance: instance.clone(), at_ms: now_ms, is_return });
        if self.changes.len() > MAX_CHANGES {
            self.changes.pop_front();
        }
        let recent = |change: &&Change| now_ms.saturating_sub(change.at_ms) < DUPLICATE_WINDOW_MS;
        let returns = self.changes.iter().filter(recent).filter(|change| change.is_return).count();
        if is_return && (returns >= 2 || self.is_duplicate(now_ms)) {
            self.duplicate_at_ms = Some(now_ms);
        }
    }

    /// Whether instances displaced each other and have not been quiet since.
    pub fn is_duplicate(&self, now_ms: u64) -> bool {
        self.duplicate_at_ms.is_some_and(|at_ms| now_ms.saturating_sub(at_ms) < DUPLICATE_WINDOW_MS)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MINUTE_MS: u64 = 60_000;

    fn address() -> SocketAddr {
        "127.0.0.1:4000".parse().expect("an address")
    }

    fn history(sightings: &[(&InstanceId, u64)]) -> InstanceHistory {
        let mut history = InstanceHistory::default();
        for (instance, at_ms) in sightings {
            history.observe(instance, *at_ms);
        }
        history
    }

    #[test]
    fn two_returns_within_the_window_are_a_duplicate() {
        let (a, b) = (InstanceId::random(), InstanceId::random());
        let three = history(&[(&a, 0), (&b, 1), (&b, 2), (&a, 3)]);
        assert!(!three.is_duplicate(3), "one return may be a late message");
        let mut four = three;
        four.observe(&b, 4);
        assert!(four.is_duplicate(4));
        assert!(four.is_duplicate(4 + DUPLICATE_WINDOW_MS - 1));
        assert!(!four.is_duplicate(4 + DUPLICATE_WINDOW_MS), "ten quiet minutes clear it");
    }

    #[test]
    fn returns_keep_a_duplicate_alive_and_repeats_do_not() {
        let (a, b) = (InstanceId::random(), InstanceId::random());
        let mut both = history(&[(&a, 0), (&b, 1), (&a, 2), (&b, 3)]);
        both.observe(&a, 9 * MINUTE_MS);
        both.observe(&a, 18 * MINUTE_MS);
        assert!(both.is_duplicate(18 * MINUTE_MS));
        assert!(!both.is_duplicate(19 * MINUTE_MS));
    }

    #[test]
    fn restarts_and_slow_alternation_are_no_duplicate() {
        let fresh: Vec<InstanceId> = (0..40).map(|_| InstanceId::random()).collect();
        let mut restarts = InstanceHistory::default();
        for (second, instance) in (0..).zip(&fresh) {
            restarts.observe(instance, second * 1000);
            assert!(!restarts.is_duplicate(second * 1000));
        }
        let (a, b) = (&fresh[0], &fresh[1]);
        let slow = history(&[(a, 0), (b, 8 * MINUTE_MS), (a, 16 * MINUTE_MS), (b, 27 * MINUTE_MS)]);
        assert!(!slow.is_duplicate(27 * MINUTE_MS));
    }

    #[test]
    fn three_clones_are_a_duplicate_too() {
        let (a, b, c) = (InstanceId::random(), InstanceId::random(), InstanceId::random());
        assert!(history(&[(&a, 0), (&b, 1), (&c, 2), (&a, 3), (&b, 4)]).is_duplicate(4));
    }

    #[test]
    fn a_connection_or_a_recent_poll_is_online() {
        let presence = Presence::new(1000, 0);
        let robot = RobotId::random();
        assert_eq!(presence.get(&robot, 0), None);
        presence.seen(&robot, address(), 10);
        assert!(presence.is_online(&robot, 1009));
        assert!(!presence.is_online(&robot, 1010));
        presence.connected(&robot, Some(address()), 7, 2000);
        let sighting = presence.get(&robot, 90_000).expect("seen");
        assert!(sighting.online);
        assert_eq!((sighting.connection, sighting.connected_since_ms), (Some(7), Some(2000)));
        presence.disconnected(&robot, 7, 100_000);
        assert!(!presence.is_online(&robot, 100_000), "who hangs up is away at once");
        presence.connected(&robot, None, 8, 100_000);
        let sighting = presence.get(&robot, 100_000).expect("seen");
        assert_eq!((sighting.connection, sighting.address), (Some(8), Some(address())), "known from before");
        presence.disconnected(&robot, 8, 100_000);
        presence.seen(&robot, address(), 100_001);
        assert!(presence.is_online(&robot, 100_500));
        presence.forget(&robot);
        assert_eq!(presence.get(&robot, 100_000), None);
    }

    #[test]
    fn an_absence_is_counted_from_the_last_word_or_the_start() {
        let presence = Presence::new(1000, 500);
        let (unseen, polls, hung_up) = (RobotId::random(), RobotId::random(), RobotId::random());
        presence.seen(&polls, address(), 600);
        presence.connected(&hung_up, None, 1, 600);
        let robots = [unseen, polls, hung_up.clone()];
        assert_eq!(presence.offline_ms(&robots, 1500), [Some(1000), None, None]);
        presence.disconnected(&hung_up, 1, 1500);
        assert_eq!(presence.offline_ms(&robots, 1700), [Some(1200), Some(1100), Some(200)]);
    }

    #[test]
    fn a_duplicate_ends_when_only_one_is_let_in() {
        let presence = Presence::new(1000, 0);
        let (robot, a, b) = (RobotId::random(), InstanceId::random(), InstanceId::random());
        for instance in [&a, &b, &a, &b] {
            presence.instance_seen(&robot, None, instance, 1);
        }
        assert!(presence.is_duplicate(&robot, 2));
        presence.ended_others(&robot);
        assert!(!presence.instance_seen(&robot, None, &InstanceId::random(), 2));
    }

    #[test]
    fn silence_is_noticed_once_and_only_of_robots_that_poll() {
        let presence = Presence::new(1000, 0);
        let (polls, connected) = (RobotId::random(), RobotId::random());
        presence.seen(&polls, address(), 500);
        presence.seen(&connected, address(), 500);
        presence.connected(&connected, Some(address()), 1, 600);
        assert!(presence.fell_silent(0, 1499).is_empty());
        assert_eq!(presence.fell_silent(1499, 1500), [polls]);
        assert!(presence.fell_silent(1500, 9000).is_empty());
    }

    #[test]
    fn a_late_end_of_the_old_connection_leaves_the_new_one() {
        let presence = Presence::new(1000, 0);
        let robot = RobotId::random();
        presence.connected(&robot, Some(address()), 2, 0);
        presence.connected(&robot, Some(address()), 1, 1);
        presence.disconnected(&robot, 1, 2);
        assert_eq!(presence.get(&robot, 50_000).and_then(|sighting| sighting.connection), Some(2));
    }

    #[test]
    fn a_sessions_port_stays_while_requests_come_from_others() {
        let presence = Presence::new(1000, 0);
        let robot = RobotId::random();
        let shown = || presence.get(&robot, 0)?.address.map(|address| address.to_string());
        presence.seen(&robot, "10.0.0.7:5000".parse().expect("valid"), 0);
        presence.connected(&robot, "10.0.0.7:4000".parse().ok(), 1, 0);
        presence.seen(&robot, "10.0.0.7:5001".parse().expect("valid"), 0);
        assert_eq!(shown().as_deref(), Some("10.0.0.7:4000"));
        presence.seen(&robot, "10.0.9.9:5002".parse().expect("valid"), 0);
        assert_eq!(shown().as_deref(), Some("10.0.9.9:5002"), "it has moved, and its session has not noticed yet");
        presence.connected(&robot, "10.0.9.9:4001".parse().ok(), 2, 0);
        assert_eq!(shown().as_deref(), Some("10.0.9.9:4001"));
        presence.disconnected(&robot, 2, 0);
        presence.seen(&robot, "10.0.9.9:5003".parse().expect("valid"), 0);
        assert_eq!(shown().as_deref(), Some("10.0.9.9:5003"));
    }

    #[test]
    fn memory_is_bounded() {
        let mut robots = HashMap::new();
        let silent = RobotId::random();
        heard(&mut robots, &silent, Some(address()), 1);
        for at_ms in 2..=MAX_ROBOTS as u64 + 1 {
            heard(&mut robots, &RobotId::random(), Some(address()), at_ms);
        }
        assert!(robots.len() <= MAX_ROBOTS);
        assert!(!robots.contains_key(&silent));
    }
}
