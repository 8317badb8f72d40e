//! Rate limits of robots. A robot above its limits is slowed, on its own connection only. A robot
//! that stays above them, or that breaks the protocol, is cut off for a backoff that doubles each
//! time. Records live in memory and are forgotten after a period of good behaviour. This module
//! touches no socket and reads no clock.

use std::collections::{BTreeSet, HashMap};
use std::fmt;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use task_proto::RobotId;
use task_proto::api::PenaltyTotals;
use tokio::sync::Notify;
use tokio::time::Instant;

use super::rate_limit::{BURST, MAX_DELAY, TokenBucket};

/// Maximum doublings of the backoff.
const MAX_DOUBLINGS: u32 = 6;
/// Factor on the request rate for output uploads: a run has up to 256 files, each of which takes
/// several requests.
const OUTPUT_REQUESTS: u64 = 10;
/// Cost of beginning a session, in messages.
pub const SESSION_COST: u64 = 10;

/// The limits of a robot.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RobotLimits {
    /// Sustained messages per second over MQTT; acknowledgements don't count.
    pub messages_per_s: u64,
    /// Sustained bytes per second over MQTT; all bytes count.
    pub bytes_per_s: u64,
    /// Sustained requests per second, without requests for a package's bytes. Output uploads have a
    /// separate limit of ten times this rate.
    pub requests_per_s: u64,
    /// How long a robot is slowed before the server cuts it off.
    pub patience: Duration,
    /// The first backoff after a cut.
    pub backoff: Duration,
    /// Period of good behaviour after which a robot's record is cleared.
    pub penalty_lifetime: Duration,
}

impl Default for RobotLimits {
    fn default() -> Self {
        Self {
            messages_per_s: 100,
            bytes_per_s: 1 << 20,
            requests_per_s: 20,
            patience: Duration::from_secs(30),
            backoff: Duration::from_secs(10),
            penalty_lifetime: Duration::from_secs(600),
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Violation {
    /// The robot exceeds its MQTT limits.
    MessageRate,
    /// The robot exceeds its HTTP request rate.
    RequestRate,
    /// The robot sent a packet that is not MQTT, is too large, or is not allowed; contains the
    /// description.
    Protocol(&'static str),
    /// The robot sent a packet of this many bytes.
    TooLarge(usize),
}

/// The channel that a robot uses. A robot that is cut off on one channel may still use the others,
/// because the robot must be able to receive the instruction to stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Channel {
    Mqtt,
    Http,
    /// HTTP requests that upload the outputs of the robot's runs.
    Outputs,
}

/// The decision about a robot that has just sent data.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    Fine,
    /// Read nothing more from the robot before this time.
    Slow(Instant),
    /// Cut the robot off: it was slowed for too long, or its backoff still runs. The robot may come
    /// back at this time.
    Cut(Instant),
}

/// The records of all robots. A robot without violations has a record only while connected, or
/// shortly after.
#[derive(Debug)]
pub struct RobotLimiter {
    limits: RobotLimits,
    robots: Mutex<HashMap<RobotId, Arc<Mutex<Record>>>>,
    /// Robots whose displayed state has changed.
    changed: Mutex<BTreeSet<RobotId>>,
    change_notify: Notify,
    slowed: AtomicU64,
    cut: AtomicU64,
    turned_away: AtomicU64,
}

/// One robot on one channel.
#[derive(Debug)]
pub struct RobotChannel {
    limiter: Arc<RobotLimiter>,
    robot: RobotId,
    channel: Channel,
    record: Arc<Mutex<Record>>,
}

#[derive(Debug)]
struct Record {
    mqtt: Allowance,
    http: Allowance,
    outputs: Allowance,
    penalty: Option<Penalty>,
}

/// A robot's remaining allowance on one channel.
#[derive(Debug)]
struct Allowance {
    messages: TokenBucket,
    bytes: Option<TokenBucket>,
    /// Start of the slowed period. A pause long enough to refill half of the burst allowance resets
    /// this field.
    slowed_since: Option<Instant>,
    backoff_until: Option<Instant>,
}

/// The violations of a robot.
#[derive(Debug)]
struct Penalty {
    violation: Violation,
    cuts: u32,
    /// The last backoff; zero: the robot was only slowed.
    backoff: Duration,
    /// The last violation, or the end of the last backoff: the penalty's lifetime begins here.
    lifetime_starts_at: Instant,
}

impl Allowance {
    fn take(&mut self, messages: u64, bytes: u64, now: Instant) -> Instant {
        let until = self.messages.take(messages, now);
        self.bytes.as_mut().map_or(until, |bucket| until.max(bucket.take(bytes, now)))
    }

    /// Whether the robot has been slowed for longer than the patience. `until`: when the data sent
    /// so far is due.
    fn exceeds_patience(&mut self, until: Instant, patience: Duration, now: Instant) -> bool {
        if until + BURST / 2 <= now {
            self.slowed_since = None;
        }
        until > now && now.duration_since(*self.slowed_since.get_or_insert(now)) >= patience
    }

    fn is_idle(&self, now: Instant) -> bool {
        let is_full = |bucket: &TokenBucket| bucket.is_full(now);
        is_full(&self.messages)
            && self.bytes.as_ref().is_none_or(is_full)
            && self.backoff_until.is_none_or(|until| until <= now)
    }
}

impl Record {
    fn new(limits: &RobotLimits, now: Instant) -> Self {
        let allowance = |per_s, bytes_per_s: Option<u64>| Allowance {
            messages: TokenBucket::new(per_s, now),
            bytes: bytes_per_s.map(|per_s| TokenBucket::new(per_s, now)),
            slowed_since: None,
            backoff_until: None,
        };
        Self {
            mqtt: allowance(limits.messages_per_s, Some(limits.bytes_per_s)),
            http: allowance(limits.requests_per_s, None),
            outputs: allowance(limits.requests_per_s.saturating_mul(OUTPUT_REQUESTS), None),
            penalty: None,
        }
    }

    fn allowance(&mut self, channel: Channel) -> &mut Allowance {
        match channel {
            Channel::Mqtt => &mut self.mqtt,
            Channel::Http => &mut self.http,
            Channel::Outputs => &mut self.outputs,
        }
    }

    fn channels(&self) -> impl Iterator<Item = &Allowance> {
        [&self.mqtt, &self.http, &self.outputs].into_iter()
    }

    /// Records that the robot was slowed. Returns whether that is new.
    fn slow(&mut self, violation: Violation, now: Instant) -> bool {
        match &mut self.penalty {
            Some(penalty) => {
                penalty.lifetime_starts_at = now;
                false
            }
            None => {
                self.penalty = Some(Penalty {
                    violation,
                    cuts: 0,
                    backoff: Duration::ZERO,
                    lifetime_starts_at: now,
                });
                true
            }
        }
    }

    /// Cuts the robot off on one channel. Returns the end of the backoff.
    fn cut(
        &mut self,
        channel: Channel,
        violation: Violation,
        limits: &RobotLimits,
        now: Instant,
    ) -> Instant {
        let cuts = self.penalty.as_ref().map_or(0, |penalty| penalty.cuts).saturating_add(1);
        let backoff = limits.backoff * (1 << (cuts - 1).min(MAX_DOUBLINGS));
        self.penalty =
            Some(Penalty { violation, cuts, backoff, lifetime_starts_at: now + backoff });
        let until = now + backoff;
        let allowance = self.allowance(channel);
        (allowance.backoff_until, allowance.slowed_since) = (Some(until), None);
        until
    }
}

impl RobotLimiter {
    pub fn new(limits: RobotLimits) -> Arc<Self> {
        Arc::new(Self {
            limits,
            robots: Mutex::default(),
            changed: Mutex::default(),
            change_notify: Notify::new(),
            slowed: AtomicU64::new(0),
            cut: AtomicU64::new(0),
            turned_away: AtomicU64::new(0),
        })
    }

    /// The limits of an authenticated robot on one channel.
    pub fn channel(
        self: &Arc<Self>,
        robot: &RobotId,
        channel: Channel,
        now: Instant,
    ) -> RobotChannel {
        let new = || Arc::new(Mutex::new(Record::new(&self.limits, now)));
        let record = lock(&self.robots).entry(robot.clone()).or_insert_with(new).clone();
        RobotChannel { limiter: self.clone(), robot: robot.clone(), channel, record }
    }

    /// A description of the robot's violations for operators, if there are any.
    pub fn penalty(&self, robot: &RobotId) -> Option<String> {
        let record = lock(&self.robots).get(robot).cloned()?;
        let record = lock(&record);
        record.penalty.as_ref().map(|penalty| penalty.to_string())
    }

    /// Totals of the measures taken so far.
    pub fn totals(&self) -> PenaltyTotals {
        let read = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        PenaltyTotals {
            slowed: read(&self.slowed),
            cut: read(&self.cut),
            turned_away: read(&self.turned_away),
        }
    }

    /// Waits until the displayed state of some robots has changed, and returns them. Dropping the
    /// future loses none.
    pub async fn changed(&self) -> BTreeSet<RobotId> {
        loop {
            let changed = std::mem::take(&mut *lock(&self.changed));
            if !changed.is_empty() {
                return changed;
            }
            self.change_notify.notified().await;
        }
    }

    /// Clears violations after enough good behaviour, and drops empty records.
    pub fn expire_penalties(&self, now: Instant) {
        let mut expired = Vec::new();
        lock(&self.robots).retain(|robot, shared| {
            let mut record = lock(shared);
            let is_expired = |penalty: &Penalty| {
                penalty.lifetime_starts_at + self.limits.penalty_lifetime <= now
            };
            if record.penalty.as_ref().is_some_and(is_expired) {
                record.penalty = None;
                expired.push(robot.clone());
            }
            let is_empty = record.penalty.is_none()
                && record.channels().all(|allowance| allowance.is_idle(now));
            drop(record);
            // A holder of the record would continue with a copy that is no longer in the map.
            !(is_empty && Arc::strong_count(shared) == 1)
        });
        expired.iter().for_each(|robot| self.mark_changed(robot));
    }

    fn mark_changed(&self, robot: &RobotId) {
        lock(&self.changed).insert(robot.clone());
        self.change_notify.notify_one();
    }
}

impl RobotChannel {
    /// End of the backoff; `None`: the robot may connect.
    pub fn backoff_until(&self, now: Instant) -> Option<Instant> {
        let until =
            lock(&self.record).allowance(self.channel).backoff_until.filter(|until| *until > now);
        if until.is_some() {
            self.limiter.turned_away.fetch_add(1, Ordering::Relaxed);
        }
        until
    }

    /// Counts messages or requests, and bytes. All connections of the robot count together.
    pub fn count(&self, messages: u64, bytes: u64, now: Instant) -> Verdict {
        let mut record = lock(&self.record);
        let (channel, limits) = (self.channel, &self.limiter.limits);
        let allowance = record.allowance(channel);
        let until = allowance.take(messages, bytes, now);
        if allowance.exceeds_patience(until, limits.patience, now) {
            drop(record);
            return Verdict::Cut(self.cut_off(self.rate_violation(), now));
        }
        if until <= now {
            return Verdict::Fine;
        }
        if record.slow(self.rate_violation(), now) {
            drop(record);
            self.limiter.slowed.fetch_add(1, Ordering::Relaxed);
            tracing::warn!(robot = %self.robot, "robot slowed: it {}", self.rate_violation());
            self.limiter.mark_changed(&self.robot);
        }
        Verdict::Slow(until)
    }

    /// Counts a request: [`Verdict::Slow`] contains the time until which to delay the request,
    /// [`Verdict::Cut`] the time at which the robot should retry.
    pub fn count_request(&self, now: Instant) -> Verdict {
        match self.count(1, 0, now) {
            Verdict::Slow(until) if until > now + MAX_DELAY => {
                // A rejected request is not served and does not count. So the next permitted time
                // stays near, however many requests the robot sends at once.
                let mut record = lock(&self.record);
                record.allowance(self.channel).messages.refund(1);
                drop(record);
                self.limiter.turned_away.fetch_add(1, Ordering::Relaxed);
                Verdict::Cut(until)
            }
            verdict => verdict,
        }
    }

    /// Records a violation that gets the robot cut off. Returns the end of the backoff.
    pub fn cut_off(&self, violation: Violation, now: Instant) -> Instant {
        let until = lock(&self.record).cut(self.channel, violation, &self.limiter.limits, now);
        self.limiter.cut.fetch_add(1, Ordering::Relaxed);
        tracing::warn!(robot = %self.robot, "robot cut off: it {violation}");
        self.limiter.mark_changed(&self.robot);
        until
    }

    fn rate_violation(&self) -> Violation {
        match self.channel {
            Channel::Mqtt => Violation::MessageRate,
            Channel::Http | Channel::Outputs => Violation::RequestRate,
        }
    }
}

impl fmt::Display for Violation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::MessageRate => f.write_str("exceeds its MQTT rate limit"),
            Self::RequestRate => f.write_str("exceeds its HTTP request rate limit"),
            Self::Protocol(text) => f.write_str(text),
            Self::TooLarge(bytes) => {
                write!(f, "sends a packet of {bytes} bytes, which is too large")
            }
        }
    }
}

impl fmt::Display for Penalty {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { violation, cuts, backoff, .. } = self;
        match cuts {
            0 => write!(f, "it {violation} and is slowed"),
            1 => write!(f, "it {violation} and was cut off for {} s", backoff.as_secs_f64()),
            cuts => write!(
                f,
                "it {violation} and was cut off {cuts} times, last for {} s",
                backoff.as_secs_f64()
            ),
        }
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

    const SECOND: Duration = Duration::from_secs(1);

    fn limiter() -> Arc<RobotLimiter> {
        RobotLimiter::new(RobotLimits {
            messages_per_s: 10,
            bytes_per_s: 1000,
            requests_per_s: 10,
            ..Default::default()
        })
    }

    #[test]
    fn flood_is_slowed_then_cut_off_and_a_burst_is_not() {
        let (limiter, robot, now) = (limiter(), RobotId::random(), Instant::now());
        let channel = limiter.channel(&robot, Channel::Mqtt, now);
        for _ in 0..100 {
            assert_eq!(
                channel.count(1, 1, now),
                Verdict::Fine,
                "ten seconds' worth may come at once"
            );
        }
        assert_eq!(limiter.penalty(&robot), None);
        let mut at = now;
        let mut count = 0;
        let until = loop {
            match channel.count(1, 1, at) {
                Verdict::Slow(until) => at = until,
                Verdict::Cut(until) => break until,
                Verdict::Fine => {}
            }
            count += 1;
            assert!(count < 1_000, "it is never cut off");
        };
        assert_eq!(until, at + Duration::from_secs(10));
        assert!((299..=301).contains(&count), "{count} messages in half a minute");
        assert!(
            channel.backoff_until(at + 9 * SECOND).is_some()
                && channel.backoff_until(until).is_none()
        );
        // A large packet counts by its bytes; the allowance of the other channel is separate.
        let other = limiter.channel(&RobotId::random(), Channel::Mqtt, now);
        assert_eq!(other.count(1, 10_000, now), Verdict::Fine);
        assert_eq!(other.count(0, 500, now), Verdict::Slow(now + SECOND / 2));
        assert_eq!(
            limiter.channel(&other.robot, Channel::Http, now).count_request(now),
            Verdict::Fine
        );
    }

    #[test]
    fn robot_that_pauses_between_bursts_is_never_cut_off() {
        let (limiter, robot, mut now) = (limiter(), RobotId::random(), Instant::now());
        for _ in 0..100 {
            // A new connection brings no new allowance.
            let channel = limiter.channel(&robot, Channel::Mqtt, now);
            for _ in 0..105 {
                assert!(!matches!(channel.count(1, 0, now), Verdict::Cut(_)));
            }
            now += 11 * SECOND;
        }
        assert_eq!(limiter.totals(), PenaltyTotals { slowed: 1, cut: 0, turned_away: 0 });
    }

    #[test]
    fn backoff_doubles_and_expires() {
        let (limiter, robot, mut now) = (limiter(), RobotId::random(), Instant::now());
        let channel = limiter.channel(&robot, Channel::Mqtt, now);
        let mut backoff = Vec::new();
        for _ in 0..9 {
            let until = channel.cut_off(Violation::TooLarge(7), now);
            backoff.push((until - now).as_secs());
            now = until;
        }
        assert_eq!(backoff, [10, 20, 40, 80, 160, 320, 640, 640, 640]);
        let text = limiter.penalty(&robot).expect("shown");
        assert!(
            text.contains("packet of 7 bytes")
                && text.contains("9 times")
                && text.contains("640 s"),
            "{text}"
        );
        assert_eq!(
            limiter.channel(&robot, Channel::Http, now).backoff_until(now - SECOND),
            None,
            "the other channel stays open"
        );
        limiter.expire_penalties(now + 599 * SECOND);
        assert!(limiter.penalty(&robot).is_some());
        limiter.expire_penalties(now + 600 * SECOND);
        assert_eq!(limiter.penalty(&robot), None);
        let until =
            channel.cut_off(Violation::Protocol("publishes to a topic that it may not write"), now);
        assert_eq!(until - now, 10 * SECOND, "the count begins anew");
        drop(channel);
        limiter.expire_penalties(until + 600 * SECOND);
        assert!(lock(&limiter.robots).is_empty());
    }

    #[test]
    fn each_change_is_reported_once() {
        let (limiter, robot, now) = (limiter(), RobotId::random(), Instant::now());
        let channel = limiter.channel(&robot, Channel::Mqtt, now);
        channel.count(101, 0, now);
        channel.count(1, 0, now);
        assert_eq!(limiter.changed().now_or_never(), Some(BTreeSet::from([robot.clone()])));
        limiter.expire_penalties(now + 3600 * SECOND);
        assert_eq!(limiter.changed().now_or_never(), Some(BTreeSet::from([robot])));
    }

    #[test]
    fn requests_are_delayed_or_refused_and_served_at_the_rate() {
        let (limiter, robot, start) = (limiter(), RobotId::random(), Instant::now());
        let channel = limiter.channel(&robot, Channel::Http, start);
        let (mut served, mut refused) = (0, 0);
        for tenth in 0..100 {
            for _ in 0..50 {
                match channel.count_request(start + Duration::from_millis(100) * tenth) {
                    Verdict::Cut(_) => refused += 1,
                    Verdict::Fine | Verdict::Slow(_) => served += 1,
                }
            }
        }
        assert_eq!(served + refused, 5_000);
        assert!(
            (215..=225).contains(&served),
            "{served}: the burst, ten seconds' worth, and delayed requests"
        );
    }
}
