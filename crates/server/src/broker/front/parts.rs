//! Permissions to subscribe to a package's parts, the few parts in flight, and the progress of each
//! subscriber. The parts are held once, whatever the number of subscribers, and at most one window
//! of them. A publisher waits for the slowest subscriber, and removes subscribers that hold up the
//! others. This module never touches a socket.

use std::collections::{BTreeSet, HashMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use rumqttd::protocol::QoS;
use task_proto::{Digest, RobotId};
use tokio::sync::Notify;
use tokio::time::Instant;

use super::laggard::{Hold, Waiting};
use crate::broker::Part;

/// Maximum packages in fan-out at the same time.
const MAX_FAN_OUTS: usize = 4;
/// Maximum lag of the slowest subscriber in parts, and the bytes of these parts, unless it is a
/// single part. Fewer than the in-flight messages of a session, so that there is always room for a
/// new desired state.
const WINDOW_PARTS: u64 = super::outgoing::MAX_PARTS_IN_FLIGHT as u64;
const WINDOW_BYTES: u64 = 4 * 1024 * 1024;

/// All packages in fan-out.
#[derive(Default)]
pub(in crate::broker) struct Grants(Mutex<HashMap<Digest, Arc<Grant>>>);

/// One package, and the robots that may subscribe to its parts.
pub(in crate::broker) struct Grant {
    digest: Digest,
    qos: QoS,
    window: u64,
    progress: Mutex<Progress>,
    moved: Notify,
    joined: Notify,
}

struct Progress {
    /// The number of the last part that was sent; the first is 1.
    sent: u64,
    /// The last parts, up to a window.
    parts: VecDeque<Part>,
    robots: HashMap<RobotId, Permit>,
    listeners: usize,
    /// Subscribers that are a whole window behind.
    behind: usize,
    /// Subscribers that have finished all parts sent so far.
    idle: usize,
    /// How long the finished subscribers have waited for the slow ones.
    waiting: Waiting,
    /// Total time for which the subscribers, one after another, have held up the rest.
    all: Hold,
    /// Robots that were removed and not yet returned by `take_put_out`.
    put_out: Vec<RobotId>,
}

/// A robot's permission to subscribe.
#[derive(Default)]
struct Permit {
    /// The subscriber's progress, if the robot subscribes.
    listening: Option<Listening>,
    /// How long the robot had held up the others when it last left; after a return the count
    /// continues from there.
    held: Option<Hold>,
}

/// The progress of a subscriber.
struct Listening {
    /// The last part that the subscriber's session took.
    taken: u64,
    /// Parts that the session took and the robot has not acknowledged.
    open: BTreeSet<u64>,
    hold: Hold,
    /// Wakes the subscriber's session for news.
    news: Arc<Notify>,
}

impl Listening {
    /// The number of sent parts that are not finished.
    fn lacks(&self, sent: u64) -> u64 {
        sent - self.open.first().map_or(self.taken, |first| first - 1)
    }
}

/// The reason for refusing a grant.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::broker) enum NotGranted {
    /// This package is already in fan-out.
    UnderWay,
    /// The maximum number of packages is in fan-out.
    Full,
}

impl Grants {
    /// Opens the package, in parts of `part_bytes`, to the robots.
    pub(in crate::broker) fn open(
        &self,
        digest: Digest,
        part_bytes: usize,
        qos: QoS,
        robots: Vec<RobotId>,
        now: Instant,
    ) -> Result<Arc<Grant>, NotGranted> {
        let mut table = lock(&self.0);
        if table.contains_key(&digest) {
            return Err(NotGranted::UnderWay);
        }
        if table.len() >= MAX_FAN_OUTS {
            return Err(NotGranted::Full);
        }
        let window = (WINDOW_BYTES / part_bytes.max(1) as u64).clamp(1, WINDOW_PARTS);
        let progress = Progress::begin(robots, now);
        let (moved, joined) = (Notify::new(), Notify::new());
        let grant =
            Arc::new(Grant { digest, qos, window, progress: Mutex::new(progress), moved, joined });
        table.insert(digest, grant.clone());
        Ok(grant)
    }

    /// Closes the package to all robots.
    pub(in crate::broker) fn close(&self, grant: &Grant) {
        lock(&self.0).remove(&grant.digest);
        let mut progress = grant.progress();
        progress.parts.clear();
        for listening in
            std::mem::take(&mut progress.robots).into_values().filter_map(|permit| permit.listening)
        {
            listening.news.notify_one();
        }
        (progress.listeners, progress.behind, progress.idle) = (0, 0, 0);
    }

    /// The package's grant, if `robot` has one.
    pub(super) fn of(&self, digest: &Digest, robot: &RobotId) -> Option<Arc<Grant>> {
        lock(&self.0)
            .get(digest)
            .filter(|grant| grant.progress().robots.contains_key(robot))
            .cloned()
    }

    /// The bytes of the parts in flight.
    pub(in crate::broker) fn queued_bytes(&self) -> usize {
        lock(&self.0).values().map(|grant| grant.queued_bytes()).sum()
    }
}

impl Grant {
    pub(in crate::broker) fn digest(&self) -> Digest {
        self.digest
    }

    pub(super) fn qos(&self) -> QoS {
        self.qos
    }

    /// Opens the package to further robots.
    pub(in crate::broker) fn admit(&self, robots: impl IntoIterator<Item = RobotId>) {
        let mut progress = self.progress();
        for robot in robots {
            progress.robots.entry(robot).or_default();
        }
    }

    /// Closes the package to one robot.
    pub(in crate::broker) fn withdraw(&self, robot: &RobotId, now: Instant) {
        self.progress().remove(robot, self.window, now);
        self.moved.notify_one();
    }

    /// The number of robots that subscribe now.
    pub(in crate::broker) fn listeners(&self) -> usize {
        self.progress().listeners
    }

    /// Whether the robot subscribes now.
    pub(in crate::broker) fn is_listening(&self, robot: &RobotId) -> bool {
        self.progress().robots.get(robot).is_some_and(|permit| permit.listening.is_some())
    }

    /// The bytes of the parts that are held for subscribers.
    pub(in crate::broker) fn queued_bytes(&self) -> usize {
        self.progress().parts.iter().map(Part::len).sum()
    }

    /// Waits until a robot has subscribed since the last call. For one caller at a time;
    /// cancel-safe.
    pub(in crate::broker) async fn joined(&self) {
        self.joined.notified().await;
    }

    /// Waits until no subscriber is a whole window behind. For one caller at a time; cancel-safe.
    pub(in crate::broker) async fn room(&self) {
        while self.progress().behind > 0 {
            self.moved.notified().await;
        }
    }

    /// Waits until no subscriber lacks any part. For one caller at a time; cancel-safe.
    pub(in crate::broker) async fn all_idle(&self) {
        loop {
            {
                let progress = self.progress();
                if progress.idle == progress.listeners {
                    return;
                }
            }
            self.moved.notified().await;
        }
    }

    /// Hands the next part to all subscribers. Call this when there is room.
    pub(in crate::broker) fn send(&self, part: Part, now: Instant) {
        let mut progress = self.progress();
        progress.sent += 1;
        if progress.parts.len() as u64 >= self.window {
            progress.parts.pop_front();
        }
        progress.parts.push_back(part);
        let Progress { sent, waiting, .. } = *progress;
        let mut behind = 0;
        for listening in progress.robots.values_mut().filter_map(|permit| permit.listening.as_mut())
        {
            listening.news.notify_one();
            if listening.lacks(sent) >= self.window {
                listening.hold.set(true, &waiting, now);
                behind += 1;
            }
        }
        (progress.behind, progress.idle) = (behind, 0);
        progress.measure(now);
    }

    /// Closes the package to robots that have held up all others for too long, and returns them.
    pub(in crate::broker) fn put_out_laggards(&self, now: Instant) -> Vec<RobotId> {
        let mut progress = self.progress();
        let Progress { all, waiting, .. } = *progress;
        let is_laggard = |listening: &Listening| listening.hold.is_too_long(&all, &waiting, now);
        let slow = progress
            .robots
            .iter()
            .filter(|(_, permit)| permit.listening.as_ref().is_some_and(is_laggard));
        let laggards: Vec<RobotId> = slow.map(|(robot, _)| robot.clone()).collect();
        for robot in &laggards {
            progress.remove(robot, self.window, now);
        }
        progress.put_out.extend(laggards.iter().cloned());
        laggards
    }

    /// The robots removed since the last call.
    pub(in crate::broker) fn take_put_out(&self) -> Vec<RobotId> {
        std::mem::take(&mut self.progress().put_out)
    }

    fn progress(&self) -> MutexGuard<'_, Progress> {
        lock(&self.progress)
    }
}

impl Progress {
    fn begin(robots: Vec<RobotId>, now: Instant) -> Self {
        let waiting = Waiting::default();
        let mut all = Hold::new(&waiting, now);
        all.set(true, &waiting, now);
        Self {
            sent: 0,
            parts: VecDeque::new(),
            robots: robots.into_iter().map(|robot| (robot, Permit::default())).collect(),
            listeners: 0,
            behind: 0,
            idle: 0,
            waiting,
            all,
            put_out: Vec::new(),
        }
    }

    fn listening(&mut self, robot: &RobotId) -> Option<&mut Listening> {
        self.robots.get_mut(robot)?.listening.as_mut()
    }

    /// Removes the robot's permission and tells its session.
    fn remove(&mut self, robot: &RobotId, window: u64, now: Instant) {
        if let Some(listening) = self.robots.remove(robot).and_then(|permit| permit.listening) {
            listening.news.notify_one();
            self.discount(&listening, window, now);
        }
    }

    /// The robot's subscription ends, if there is one. The robot may come back.
    fn leave(&mut self, robot: &RobotId, window: u64, now: Instant) {
        let waiting = self.waiting;
        let Some(permit) = self.robots.get_mut(robot) else { return };
        let Some(mut listening) = permit.listening.take() else { return };
        listening.hold.leave(&waiting, now);
        permit.held = Some(listening.hold);
        self.discount(&listening, window, now);
    }

    /// Removes the subscriber from the counts.
    fn discount(&mut self, listening: &Listening, window: u64, now: Instant) {
        let lacks = listening.lacks(self.sent);
        self.listeners -= 1;
        self.behind -= usize::from(lacks >= window);
        self.idle -= usize::from(lacks == 0);
        self.measure(now);
    }

    /// Updates whether the other subscribers wait from now on.
    fn measure(&mut self, now: Instant) {
        self.waiting.set(self.behind > 0 && self.idle * 2 >= self.listeners, now);
    }
}

/// A robot's session that subscribes; it counts as behind until this is dropped.
pub(super) struct Member {
    grant: Arc<Grant>,
    robot: RobotId,
}

/// The next action of a member's session.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Due {
    /// Send this part, and call `Member::take`.
    Part(u64, Part),
    End,
    Nothing,
}

impl Member {
    /// The robot receives all parts from now on; `news` wakes its session. `None` if the grant was
    /// withdrawn meanwhile.
    pub(super) fn join(grant: Arc<Grant>, robot: &RobotId, news: Arc<Notify>) -> Option<Self> {
        let (now, mut progress) = (Instant::now(), grant.progress());
        progress.leave(robot, grant.window, now);
        let Progress { sent, waiting, .. } = *progress;
        let permit = progress.robots.get_mut(robot)?;
        let hold = permit.held.take().unwrap_or_else(|| Hold::new(&waiting, now));
        permit.listening = Some(Listening { taken: sent, open: BTreeSet::new(), hold, news });
        (progress.listeners, progress.idle) = (progress.listeners + 1, progress.idle + 1);
        progress.measure(now);
        drop(progress);
        grant.joined.notify_one();
        Some(Self { grant, robot: robot.clone() })
    }

    pub(super) fn qos(&self) -> QoS {
        self.grant.qos()
    }

    /// The next action. Changes nothing.
    pub(super) fn due(&self) -> Due {
        let progress = self.grant.progress();
        let permit = progress.robots.get(&self.robot);
        let Some(listening) = permit.and_then(|permit| permit.listening.as_ref()) else {
            return Due::End;
        };
        let number = listening.taken + 1;
        let from_the_end =
            progress.sent.checked_sub(number).and_then(|distance| usize::try_from(distance).ok());
        let part = from_the_end.and_then(|distance| progress.parts.iter().rev().nth(distance));
        part.map_or(Due::Nothing, |part| Due::Part(number, part.clone()))
    }

    /// Records that the session sends the part of this number.
    pub(super) fn take(&self, number: u64) {
        if let Some(listening) = self.grant.progress().listening(&self.robot) {
            listening.taken = number;
            listening.open.insert(number);
        }
    }

    /// Records that the robot has the part.
    pub(super) fn acknowledged(&self, number: u64) {
        let (now, mut progress) = (Instant::now(), self.grant.progress());
        let (window, sent, waiting) = (self.grant.window, progress.sent, progress.waiting);
        let Some(listening) = progress.listening(&self.robot) else { return };
        let before = listening.lacks(sent);
        listening.open.remove(&number);
        let after = listening.lacks(sent);
        if before == after {
            return;
        }
        let caught_up = before >= window && after < window;
        if after < window {
            listening.hold.set(false, &waiting, now);
        }
        progress.behind -= usize::from(caught_up);
        progress.idle += usize::from(after == 0);
        progress.measure(now);
        if caught_up || progress.idle == progress.listeners {
            drop(progress);
            self.grant.moved.notify_one();
        }
    }
}

impl Drop for Member {
    fn drop(&mut self) {
        self.grant.progress().leave(&self.robot, self.grant.window, Instant::now());
        self.grant.moved.notify_one();
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // Every change under these locks is complete in itself, so a panic elsewhere leaves nothing
    // half-done.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use futures_util::FutureExt as _;

    use super::*;

    #[test]
    fn the_slowest_listener_holds_the_publisher_up_until_it_goes() {
        let (grants, now) = (Grants::default(), Instant::now());
        let (quick, slow) = (RobotId::random(), RobotId::random());
        let (digest, qos) = (Digest::of(b"package"), QoS::AtLeastOnce);
        let grant = grants.open(digest, 1024 * 1024, qos, vec![quick.clone()], now).expect("room");
        assert_eq!(grants.open(digest, 1, qos, Vec::new(), now).err(), Some(NotGranted::UnderWay));
        assert!(grants.of(&digest, &slow).is_none());
        grant.admit([slow.clone()]);
        let join = |robot| {
            let grant = grants.of(&digest, robot).expect("granted");
            Member::join(grant, robot, Arc::default()).expect("granted")
        };
        let part = |number: u8| Part {
            header: vec![number].into(),
            bytes: vec![0; 1024 * 1024 - 1].into(),
        };
        let mut last = 0;
        let mut send = || {
            let has_room = grant.room().now_or_never().is_some();
            if has_room {
                last += 1;
                grant.send(part(last), now);
            }
            has_room
        };
        let (first, second) = (join(&quick), join(&slow));
        assert_eq!((0..10).filter(|_| send()).count(), 4, "of a megabyte, four are on their way");
        for number in 1..=4 {
            assert_eq!(first.due(), Due::Part(u64::from(number), part(number)));
            first.take(number.into());
            first.acknowledged(number.into());
        }
        assert_eq!(first.due(), Due::Nothing);
        second.take(1);
        assert!(!send(), "the slow one has acknowledged nothing");
        second.acknowledged(1);
        assert!(send() && !send());
        assert_eq!(grants.queued_bytes(), 4 * 1024 * 1024);
        let later = now + std::time::Duration::from_secs(60);
        first.take(5);
        first.acknowledged(5);
        assert_eq!(grant.put_out_laggards(later), std::slice::from_ref(&slow));
        assert_eq!(grant.take_put_out(), [slow]);
        assert_eq!(second.due(), Due::End);
        assert!(send());
        drop(first);
        assert_eq!(
            (grant.listeners(), (0..100).filter(|_| send()).count()),
            (0, 100),
            "nobody to wait for"
        );
        grants.close(&grant);
        assert!(grants.of(&digest, &quick).is_none());
        assert_eq!(grants.queued_bytes(), 0);
    }

    #[test]
    fn who_subscribes_again_is_as_far_behind_as_before() {
        let seconds = std::time::Duration::from_secs;
        let (grants, now, robot) = (Grants::default(), Instant::now(), RobotId::random());
        let long_ago = now.checked_sub(seconds(20)).expect("the machine has run for that long");
        let digest = Digest::of(b"package");
        let grant = grants
            .open(digest, 64 * 1024, QoS::AtLeastOnce, vec![robot.clone()], long_ago)
            .expect("room");
        let join = || Member::join(grant.clone(), &robot, Arc::default()).expect("granted");
        let fill = |now| {
            for _ in 0..WINDOW_PARTS {
                grant.send(Part { header: Default::default(), bytes: Default::default() }, now);
            }
        };
        let member = join();
        fill(long_ago);
        drop(member);
        let _member = join();
        fill(now);
        assert!(grant.put_out_laggards(now + seconds(5)).is_empty());
        assert_eq!(grant.put_out_laggards(now + seconds(11)), std::slice::from_ref(&robot));
        assert!(grants.of(&digest, &robot).is_none(), "it has to get the rest in another way");
    }

    #[test]
    fn acknowledgements_may_come_in_any_order() {
        let (grants, now, robot) = (Grants::default(), Instant::now(), RobotId::random());
        let digest = Digest::of(b"package");
        let grant = grants
            .open(digest, 64 * 1024, QoS::ExactlyOnce, vec![robot.clone()], now)
            .expect("room");
        let member = Member::join(grant.clone(), &robot, Arc::default()).expect("granted");
        for number in 1..=WINDOW_PARTS {
            assert!(grant.room().now_or_never().is_some());
            grant.send(Part { header: Default::default(), bytes: Default::default() }, now);
            member.take(number);
        }
        for number in (2..=WINDOW_PARTS).rev() {
            member.acknowledged(number);
            assert!(
                grant.room().now_or_never().is_none() && grant.all_idle().now_or_never().is_none()
            );
        }
        member.acknowledged(1);
        assert!(grant.room().now_or_never().is_some() && grant.all_idle().now_or_never().is_some());
    }
}
