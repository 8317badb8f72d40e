//! Permissions to subscribe to a package's parts, the few parts in flight, and the progress of each
//! subscriber. The parts are held once, whatever the number of subscribers, and at most one window
//! of them. A publisher waits for the slowest subscriber, and removes subscribers that hold up the
//! others. This module never touches a socket.

mod laggard;

use std::collections::{BTreeSet, HashMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use rumqttd::protocol::QoS;
use task_proto::{Digest, RobotId};
use tokio::sync::Notify;
use tokio::time::Instant;

use self::laggard::{LagTimer, WaitTime};
use crate::broker::Part;

/// Maximum parts among the messages in flight of a session: a new desired state never waits behind
/// parts.
pub(super) const MAX_PARTS_IN_FLIGHT: usize = 24;
/// Maximum packages in fan-out at the same time.
const MAX_FAN_OUTS: usize = 4;
/// Maximum lag of the slowest subscriber in parts, and the bytes of these parts, unless it is a
/// single part. Fewer than the in-flight messages of a session, so that there is always room for a
/// new desired state.
const WINDOW_PARTS: u64 = MAX_PARTS_IN_FLIGHT as u64;
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
    progressed: Notify,
    joined: Notify,
}

struct Progress {
    /// The number of the last part that was sent; the first is 1.
    sent: u64,
    /// The last parts, up to a window.
    parts: VecDeque<Part>,
    robots: HashMap<RobotId, Permit>,
    subscribers: usize,
    /// Subscribers that are a whole window behind.
    behind: usize,
    /// Subscribers that have finished all parts sent so far.
    idle: usize,
    /// How long the finished subscribers have waited for the slow ones.
    wait_time: WaitTime,
    /// Total time for which the subscribers, one after another, have held up the rest.
    all: LagTimer,
    /// Robots that were removed and not yet returned by `take_evicted`.
    evicted: Vec<RobotId>,
}

/// A robot's permission to subscribe.
#[derive(Default)]
struct Permit {
    /// The subscriber's progress, if the robot subscribes.
    subscriber: Option<Subscriber>,
    /// How long the robot had held up the others when it last left; after a return the count
    /// continues from there.
    past_timer: Option<LagTimer>,
}

/// The progress of a subscriber.
struct Subscriber {
    /// The last part that the subscriber's session took.
    taken: u64,
    /// Parts that the session took and the robot has not acknowledged.
    open: BTreeSet<u64>,
    timer: LagTimer,
    /// Wakes the subscriber's session for news.
    news: Arc<Notify>,
}

impl Subscriber {
    /// The number of sent parts that are not finished.
    fn lag(&self, sent: u64) -> u64 {
        sent - self.open.first().map_or(self.taken, |first| first - 1)
    }
}

/// The reason for refusing a grant.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::broker) enum NotGranted {
    /// This package is already in fan-out.
    AlreadyOpen,
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
            return Err(NotGranted::AlreadyOpen);
        }
        if table.len() >= MAX_FAN_OUTS {
            return Err(NotGranted::Full);
        }
        let window = (WINDOW_BYTES / part_bytes.max(1) as u64).clamp(1, WINDOW_PARTS);
        let progress = Progress::begin(robots, now);
        let (progressed, joined) = (Notify::new(), Notify::new());
        let grant = Arc::new(Grant {
            digest,
            qos,
            window,
            progress: Mutex::new(progress),
            progressed,
            joined,
        });
        table.insert(digest, grant.clone());
        Ok(grant)
    }

    /// Closes the package to all robots.
    pub(in crate::broker) fn close(&self, grant: &Grant) {
        lock(&self.0).remove(&grant.digest);
        let mut progress = grant.progress();
        progress.parts.clear();
        for subscriber in std::mem::take(&mut progress.robots)
            .into_values()
            .filter_map(|permit| permit.subscriber)
        {
            subscriber.news.notify_one();
        }
        (progress.subscribers, progress.behind, progress.idle) = (0, 0, 0);
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
        self.progressed.notify_one();
    }

    /// The number of robots that subscribe now.
    pub(in crate::broker) fn subscribers(&self) -> usize {
        self.progress().subscribers
    }

    /// Whether the robot subscribes now.
    pub(in crate::broker) fn is_subscribed(&self, robot: &RobotId) -> bool {
        self.progress().robots.get(robot).is_some_and(|permit| permit.subscriber.is_some())
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
            self.progressed.notified().await;
        }
    }

    /// Waits until no subscriber lacks any part. For one caller at a time; cancel-safe.
    pub(in crate::broker) async fn all_idle(&self) {
        loop {
            {
                let progress = self.progress();
                if progress.idle == progress.subscribers {
                    return;
                }
            }
            self.progressed.notified().await;
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
        let Progress { sent, wait_time, .. } = *progress;
        let mut behind = 0;
        for subscriber in
            progress.robots.values_mut().filter_map(|permit| permit.subscriber.as_mut())
        {
            subscriber.news.notify_one();
            if subscriber.lag(sent) >= self.window {
                subscriber.timer.set(true, &wait_time, now);
                behind += 1;
            }
        }
        (progress.behind, progress.idle) = (behind, 0);
        progress.update_wait_time(now);
    }

    /// Closes the package to robots that have held up all others for too long, and returns them.
    pub(in crate::broker) fn evict_laggards(&self, now: Instant) -> Vec<RobotId> {
        let mut progress = self.progress();
        let Progress { all, wait_time, .. } = *progress;
        let is_laggard =
            |subscriber: &Subscriber| subscriber.timer.is_exceeded(&all, &wait_time, now);
        let slow = progress
            .robots
            .iter()
            .filter(|(_, permit)| permit.subscriber.as_ref().is_some_and(is_laggard));
        let laggards: Vec<RobotId> = slow.map(|(robot, _)| robot.clone()).collect();
        for robot in &laggards {
            progress.remove(robot, self.window, now);
        }
        progress.evicted.extend(laggards.iter().cloned());
        laggards
    }

    /// The robots removed since the last call.
    pub(in crate::broker) fn take_evicted(&self) -> Vec<RobotId> {
        std::mem::take(&mut self.progress().evicted)
    }

    fn progress(&self) -> MutexGuard<'_, Progress> {
        lock(&self.progress)
    }
}

impl Progress {
    fn begin(robots: Vec<RobotId>, now: Instant) -> Self {
        let wait_time = WaitTime::default();
        let mut all = LagTimer::new(&wait_time, now);
        all.set(true, &wait_time, now);
        Self {
            sent: 0,
            parts: VecDeque::new(),
            robots: robots.into_iter().map(|robot| (robot, Permit::default())).collect(),
            subscribers: 0,
            behind: 0,
            idle: 0,
            wait_time,
            all,
            evicted: Vec::new(),
        }
    }

    fn subscriber(&mut self, robot: &RobotId) -> Option<&mut Subscriber> {
        self.robots.get_mut(robot)?.subscriber.as_mut()
    }

    /// Removes the robot's permission and tells its session.
    fn remove(&mut self, robot: &RobotId, window: u64, now: Instant) {
        if let Some(subscriber) = self.robots.remove(robot).and_then(|permit| permit.subscriber) {
            subscriber.news.notify_one();
            self.uncount(&subscriber, window, now);
        }
    }

    /// The robot's subscription ends, if there is one. The robot may come back.
    fn leave(&mut self, robot: &RobotId, window: u64, now: Instant) {
        let wait_time = self.wait_time;
        let Some(permit) = self.robots.get_mut(robot) else { return };
        let Some(mut subscriber) = permit.subscriber.take() else { return };
        subscriber.timer.leave(&wait_time, now);
        permit.past_timer = Some(subscriber.timer);
        self.uncount(&subscriber, window, now);
    }

    /// Removes the subscriber from the counts.
    fn uncount(&mut self, subscriber: &Subscriber, window: u64, now: Instant) {
        let lag = subscriber.lag(self.sent);
        self.subscribers -= 1;
        self.behind -= usize::from(lag >= window);
        self.idle -= usize::from(lag == 0);
        self.update_wait_time(now);
    }

    /// Updates whether the other subscribers wait from now on.
    fn update_wait_time(&mut self, now: Instant) {
        self.wait_time.set(self.behind > 0 && self.idle * 2 >= self.subscribers, now);
    }
}

/// A robot's session that subscribes; it counts as behind until this is dropped.
pub(super) struct PartSubscription {
    grant: Arc<Grant>,
    robot: RobotId,
}

/// The next action of a subscriber's session.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Due {
    /// Send this part, and call `PartSubscription::take`.
    Part(u64, Part),
    End,
    Nothing,
}

impl PartSubscription {
    /// The robot receives all parts from now on; `news` wakes its session. `None` if the grant was
    /// withdrawn meanwhile.
    pub(super) fn join(grant: Arc<Grant>, robot: &RobotId, news: Arc<Notify>) -> Option<Self> {
        let (now, mut progress) = (Instant::now(), grant.progress());
        progress.leave(robot, grant.window, now);
        let Progress { sent, wait_time, .. } = *progress;
        let permit = progress.robots.get_mut(robot)?;
        let timer = permit.past_timer.take().unwrap_or_else(|| LagTimer::new(&wait_time, now));
        permit.subscriber = Some(Subscriber { taken: sent, open: BTreeSet::new(), timer, news });
        (progress.subscribers, progress.idle) = (progress.subscribers + 1, progress.idle + 1);
        progress.update_wait_time(now);
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
        let Some(subscriber) = permit.and_then(|permit| permit.subscriber.as_ref()) else {
            return Due::End;
        };
        let number = subscriber.taken + 1;
        let from_the_end =
            progress.sent.checked_sub(number).and_then(|distance| usize::try_from(distance).ok());
        let part = from_the_end.and_then(|distance| progress.parts.iter().rev().nth(distance));
        part.map_or(Due::Nothing, |part| Due::Part(number, part.clone()))
    }

    /// Records that the session sends the part of this number.
    pub(super) fn take(&self, number: u64) {
        if let Some(subscriber) = self.grant.progress().subscriber(&self.robot) {
            subscriber.taken = number;
            subscriber.open.insert(number);
        }
    }

    /// Records that the robot has the part.
    pub(super) fn acknowledged(&self, number: u64) {
        let (now, mut progress) = (Instant::now(), self.grant.progress());
        let (window, sent, wait_time) = (self.grant.window, progress.sent, progress.wait_time);
        let Some(subscriber) = progress.subscriber(&self.robot) else { return };
        let before = subscriber.lag(sent);
        subscriber.open.remove(&number);
        let after = subscriber.lag(sent);
        if before == after {
            return;
        }
        let caught_up = before >= window && after < window;
        if after < window {
            subscriber.timer.set(false, &wait_time, now);
        }
        progress.behind -= usize::from(caught_up);
        progress.idle += usize::from(after == 0);
        progress.update_wait_time(now);
        if caught_up || progress.idle == progress.subscribers {
            drop(progress);
            self.grant.progressed.notify_one();
        }
    }
}

impl Drop for PartSubscription {
    fn drop(&mut self) {
        self.grant.progress().leave(&self.robot, self.grant.window, Instant::now());
        self.grant.progressed.notify_one();
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
    fn publisher_waits_for_the_slowest_subscriber_until_it_leaves() {
        let (grants, now) = (Grants::default(), Instant::now());
        let (quick, slow) = (RobotId::random(), RobotId::random());
        let (digest, qos) = (Digest::of(b"package"), QoS::AtLeastOnce);
        let grant = grants.open(digest, 1024 * 1024, qos, vec![quick.clone()], now).expect("room");
        assert_eq!(
            grants.open(digest, 1, qos, Vec::new(), now).err(),
            Some(NotGranted::AlreadyOpen)
        );
        assert!(grants.of(&digest, &slow).is_none());
        grant.admit([slow.clone()]);
        let join = |robot| {
            let grant = grants.of(&digest, robot).expect("granted");
            PartSubscription::join(grant, robot, Arc::default()).expect("granted")
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
        assert_eq!(grant.evict_laggards(later), std::slice::from_ref(&slow));
        assert_eq!(grant.take_evicted(), [slow]);
        assert_eq!(second.due(), Due::End);
        assert!(send());
        drop(first);
        assert_eq!(
            (grant.subscribers(), (0..100).filter(|_| send()).count()),
            (0, 100),
            "no subscriber to wait for"
        );
        grants.close(&grant);
        assert!(grants.of(&digest, &quick).is_none());
        assert_eq!(grants.queued_bytes(), 0);
    }

    #[test]
    fn resubscribe_keeps_the_backlog() {
        let seconds = std::time::Duration::from_secs;
        let (grants, now, robot) = (Grants::default(), Instant::now(), RobotId::random());
        let long_ago = now.checked_sub(seconds(20)).expect("the machine has run for that long");
        let digest = Digest::of(b"package");
        let grant = grants
            .open(digest, 64 * 1024, QoS::AtLeastOnce, vec![robot.clone()], long_ago)
            .expect("room");
        let join =
            || PartSubscription::join(grant.clone(), &robot, Arc::default()).expect("granted");
        let fill = |now| {
            for _ in 0..WINDOW_PARTS {
                grant.send(Part { header: Default::default(), bytes: Default::default() }, now);
            }
        };
        let subscription = join();
        fill(long_ago);
        drop(subscription);
        let _member = join();
        fill(now);
        assert!(grant.evict_laggards(now + seconds(5)).is_empty());
        assert_eq!(grant.evict_laggards(now + seconds(11)), std::slice::from_ref(&robot));
        assert!(grants.of(&digest, &robot).is_none(), "it has to get the rest in another way");
    }

    #[test]
    fn acknowledgements_in_any_order_are_accepted() {
        let (grants, now, robot) = (Grants::default(), Instant::now(), RobotId::random());
        let digest = Digest::of(b"package");
        let grant = grants
            .open(digest, 64 * 1024, QoS::ExactlyOnce, vec![robot.clone()], now)
            .expect("room");
        let subscription =
            PartSubscription::join(grant.clone(), &robot, Arc::default()).expect("granted");
        for number in 1..=WINDOW_PARTS {
            assert!(grant.room().now_or_never().is_some());
            grant.send(Part { header: Default::default(), bytes: Default::default() }, now);
            subscription.take(number);
        }
        for number in (2..=WINDOW_PARTS).rev() {
            subscription.acknowledged(number);
            assert!(
                grant.room().now_or_never().is_none() && grant.all_idle().now_or_never().is_none()
            );
        }
        subscription.acknowledged(1);
        assert!(grant.room().now_or_never().is_some() && grant.all_idle().now_or_never().is_some());
    }
}
