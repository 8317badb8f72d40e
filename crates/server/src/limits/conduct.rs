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
use task_proto::api::ConductTotals;
use tokio::sync::Notify;
use tokio::time::Instant;

use super::rate_limit::{BURST, MAX_HELD, TokenBucket};

/// Maximum doublings of the backoff.
const MAX_DOUBLINGS: u32 = 6;
/// Factor on the request rate for output uploads: a run has up to 256 files, each of which takes
/// several requests.
const OUTPUT_REQUESTS: u64 = 10;
/// Cost of beginning a session, in messages.
pub const SESSION_COST: u64 = 10;

/// The limits of a robot.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ConductLimits {
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
    pub forgive_after: Duration,
}

impl Default for ConductLimits {
    fn default() -> Self {
        Self {
            messages_per_s: 100,
            bytes_per_s: 1 << 20,
            requests_per_s: 20,
            patience: Duration::from_secs(30),
            backoff: Duration::from_secs(10),
            forgive_after: Duration::from_secs(600),
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Offence {
    /// The robot exceeds its MQTT limits.
    Messages,
    /// The robot exceeds its HTTP request rate.
    Requests,
    /// The robot sent a packet that is not MQTT, is too large, or is not allowed; contains the
    /// description.
    Violation(&'static str),
    /// The robot sent a packet of this many bytes.
    TooLarge(usize),
}

/// The channel that a robot uses. A robot that is cut off on one channel may still use the others,
/// because the robot must be able to receive the instruction to stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Way {
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
pub struct Conduct {
    limits: ConductLimits,
    robots: Mutex<HashMap<RobotId, Arc<Mutex<Record>>>>,
    /// Robots whose displayed state has changed.
    news: Mutex<BTreeSet<RobotId>>,
    has_news: Notify,
    slowed: AtomicU64,
    cut: AtomicU64,
    turned_away: AtomicU64,
}

/// One robot on one channel.
#[derive(Debug)]
pub struct Watched {
    conduct: Arc<Conduct>,
    robot: RobotId,
    way: Way,
    record: Arc<Mutex<Record>>,
}

#[derive(Debug)]
struct Record {
    mqtt: Allowance,
    http: Allowance,
    outputs: Allowance,
    trouble: Option<Trouble>,
}

/// A robot's remaining allowance on one channel.
#[derive(Debug)]
struct Allowance {
    messages: TokenBucket,
    bytes: Option<TokenBucket>,
    /// Start of the slowed period. A pause long enough to refill half of the burst allowance resets
    /// this field.
    slowed_since: Option<Instant>,
    barred_until: Option<Instant>,
}

/// The violations of a robot.
#[derive(Debug)]
struct Trouble {
    offence: Offence,
    cuts: u32,
    /// The last backoff; zero: the robot was only slowed.
    away: Duration,
    last_at: Instant,
}

impl Allowance {
    fn take(&mut self, messages: u64, bytes: u64, now: Instant) -> Instant {
        let until = self.messages.take(messages, now);
        self.bytes.as_mut().map_or(until, |bucket| until.max(bucket.take(bytes, now)))
    }

    /// Whether the robot has been slowed for longer than the patience. `until`: when the data sent
    /// so far is due.
    fn is_tried(&mut self, until: Instant, patience: Duration, now: Instant) -> bool {
        if until + BURST / 2 <= now {
            self.slowed_since = None;
        }
        until > now && now.duration_since(*self.slowed_since.get_or_insert(now)) >= patience
    }

    fn is_at_rest(&self, now: Instant) -> bool {
        let has_rested = |bucket: &TokenBucket| bucket.has_rested(now);
        has_rested(&self.messages)
            && self.bytes.as_ref().is_none_or(has_rested)
            && self.barred_until.is_none_or(|until| until <= now)
    }
}

impl Record {
    fn new(limits: &ConductLimits, now: Instant) -> Self {
        let allowance = |per_s, bytes_per_s: Option<u64>| Allowance {
            messages: TokenBucket::new(per_s, now),
            bytes: bytes_per_s.map(|per_s| TokenBucket::new(per_s, now)),
            slowed_since: None,
            barred_until: None,
        };
        Self {
            mqtt: allowance(limits.messages_per_s, Some(limits.bytes_per_s)),
            http: allowance(limits.requests_per_s, None),
            outputs: allowance(limits.requests_per_s.saturating_mul(OUTPUT_REQUESTS), None),
            trouble: None,
        }
    }

    fn on(&mut self, way: Way) -> &mut Allowance {
        match way {
            Way::Mqtt => &mut self.mqtt,
            Way::Http => &mut self.http,
            Way::Outputs => &mut self.outputs,
        }
    }

    fn ways(&self) -> impl Iterator<Item = &Allowance> {
        [&self.mqtt, &self.http, &self.outputs].into_iter()
    }

    /// Records that the robot was slowed. Returns whether that is news.
    fn slow(&mut self, offence: Offence, now: Instant) -> bool {
        match &mut self.trouble {
            Some(trouble) => {
                trouble.last_at = now;
                false
            }
            None => {
                self.trouble =
                    Some(Trouble { offence, cuts: 0, away: Duration::ZERO, last_at: now });
                true
            }
        }
    }

    /// Cuts the robot off on one channel. Returns the end of the backoff.
    fn cut(&mut self, way: Way, offence: Offence, limits: &ConductLimits, now: Instant) -> Instant {
        let cuts = self.trouble.as_ref().map_or(0, |trouble| trouble.cuts).saturating_add(1);
        let away = limits.backoff * (1 << (cuts - 1).min(MAX_DOUBLINGS));
        self.trouble = Some(Trouble { offence, cuts, away, last_at: now + away });
        let until = now + away;
        let allowance = self.on(way);
        (allowance.barred_until, allowance.slowed_since) = (Some(until), None);
        until
    }
}

impl Conduct {
    pub fn new(limits: ConductLimits) -> Arc<Self> {
        Arc::new(Self {
            limits,
            robots: Mutex::default(),
            news: Mutex::default(),
            has_news: Notify::new(),
            slowed: AtomicU64::new(0),
            cut: AtomicU64::new(0),
            turned_away: AtomicU64::new(0),
        })
    }

    /// Watches an authenticated robot on one channel.
    pub fn watch(self: &Arc<Self>, robot: &RobotId, way: Way, now: Instant) -> Watched {
        let new = || Arc::new(Mutex::new(Record::new(&self.limits, now)));
        let record = lock(&self.robots).entry(robot.clone()).or_insert_with(new).clone();
        Watched { conduct: self.clone(), robot: robot.clone(), way, record }
    }

    /// A description of the robot's violations for operators, if there are any.
    pub fn trouble(&self, robot: &RobotId) -> Option<String> {
        let record = lock(&self.robots).get(robot).cloned()?;
        let record = lock(&record);
        record.trouble.as_ref().map(|trouble| trouble.to_string())
    }

    /// Totals of the measures taken so far.
    pub fn totals(&self) -> ConductTotals {
        let read = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        ConductTotals {
            slowed: read(&self.slowed),
            cut: read(&self.cut),
            turned_away: read(&self.turned_away),
        }
    }

    /// Waits until the displayed state of some robots has changed, and returns them. Dropping the
    /// future loses none.
    pub async fn news(&self) -> BTreeSet<RobotId> {
        loop {
            let news = std::mem::take(&mut *lock(&self.news));
            if !news.is_empty() {
                return news;
            }
            self.has_news.notified().await;
        }
    }

    /// Clears violations after enough good behaviour, and drops empty records.
    pub fn forgive(&self, now: Instant) {
        let mut forgiven = Vec::new();
        lock(&self.robots).retain(|robot, shared| {
            let mut record = lock(shared);
            let is_over = |trouble: &Trouble| trouble.last_at + self.limits.forgive_after <= now;
            if record.trouble.as_ref().is_some_and(is_over) {
                record.trouble = None;
                forgiven.push(robot.clone());
            }
            let is_nothing = record.trouble.is_none()
                && record.ways().all(|allowance| allowance.is_at_rest(now));
            drop(record);
            // A holder of the record would continue with a copy that is no longer in the map.
            !(is_nothing && Arc::strong_count(shared) == 1)
        });
        forgiven.iter().for_each(|robot| self.tell(robot));
    }

    fn tell(&self, robot: &RobotId) {
        lock(&self.news).insert(robot.clone());
        self.has_news.notify_one();
    }
}

impl Watched {
    /// End of the backoff; `None`: the robot may connect.
    pub fn barred_until(&self, now: Instant) -> Option<Instant> {
        let until = lock(&self.record).on(self.way).barred_until.filter(|until| *until > now);
        if until.is_some() {
            self.conduct.turned_away.fetch_add(1, Ordering::Relaxed);
        }
        until
    }

    /// Counts messages or requests, and bytes. All connections of the robot count together.
    pub fn sent(&self, messages: u64, bytes: u64, now: Instant) -> Verdict {
        let mut record = lock(&self.record);
        let (way, limits) = (self.way, &self.conduct.limits);
        let allowance = record.on(way);
        let until = allowance.take(messages, bytes, now);
        if allowance.is_tried(until, limits.patience, now) {
            drop(record);
            return Verdict::Cut(self.offends(self.flood(), now));
        }
        if until <= now {
            return Verdict::Fine;
        }
        if record.slow(self.flood(), now) {
            drop(record);
            self.conduct.slowed.fetch_add(1, Ordering::Relaxed);
            tracing::warn!(robot = %self.robot, "a robot is slowed: it {}", self.flood());
            self.conduct.tell(&self.robot);
        }
        Verdict::Slow(until)
    }

    /// Counts a request: [`Verdict::Slow`] contains the time until which to delay the request,
    /// [`Verdict::Cut`] the time at which the robot should retry.
    pub fn asks(&self, now: Instant) -> Verdict {
        match self.sent(1, 0, now) {
            Verdict::Slow(until) if until > now + MAX_HELD => {
                // A rejected request is not served and does not count. So the next permitted time
                // stays near, however many requests the robot sends at once.
                let mut record = lock(&self.record);
                record.on(self.way).messages.give_back(1);
                drop(record);
                self.conduct.turned_away.fetch_add(1, Ordering::Relaxed);
                Verdict::Cut(until)
            }
            verdict => verdict,
        }
    }

    /// Records a violation that gets the robot cut off. Returns the end of the backoff.
    pub fn offends(&self, offence: Offence, now: Instant) -> Instant {
        let until = lock(&self.record).cut(self.way, offence, &self.conduct.limits, now);
        self.conduct.cut.fetch_add(1, Ordering::Relaxed);
        tracing::warn!(robot = %self.robot, "a robot is cut off: it {offence}");
        self.conduct.tell(&self.robot);
        until
    }

    fn flood(&self) -> Offence {
        match self.way {
            Way::Mqtt => Offence::Messages,
            Way::Http | Way::Outputs => Offence::Requests,
        }
    }
}

impl fmt::Display for Offence {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Messages => f.write_str("sends more over MQTT than a robot may"),
            Self::Requests => f.write_str("asks or reports more often than a robot may"),
            Self::Violation(what) => f.write_str(what),
            Self::TooLarge(bytes) => {
                write!(f, "sends a packet of {bytes} bytes, which is too large")
            }
        }
    }
}

impl fmt::Display for Trouble {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { offence, cuts, away, .. } = self;
        match cuts {
            0 => write!(f, "it {offence}, and is slowed"),
            1 => write!(f, "it {offence}, and was cut off for {} s", away.as_secs_f64()),
            cuts => write!(
                f,
                "it {offence}, and was cut off {cuts} times, the last time for {} s",
                away.as_secs_f64()
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

    fn conduct() -> Arc<Conduct> {
        Conduct::new(ConductLimits {
            messages_per_s: 10,
            bytes_per_s: 1000,
            requests_per_s: 10,
            ..Default::default()
        })
    }

    #[test]
    fn a_flood_is_slowed_to_the_rate_then_cut_and_a_burst_is_not() {
        let (conduct, robot, now) = (conduct(), RobotId::random(), Instant::now());
        let watched = conduct.watch(&robot, Way::Mqtt, now);
        for _ in 0..100 {
            assert_eq!(
                watched.sent(1, 1, now),
                Verdict::Fine,
                "ten seconds' worth may come at once"
            );
        }
        assert_eq!(conduct.trouble(&robot), None);
        let mut at = now;
        let mut sent = 0;
        let until = loop {
            match watched.sent(1, 1, at) {
                Verdict::Slow(until) => at = until,
                Verdict::Cut(until) => break until,
                Verdict::Fine => {}
            }
            sent += 1;
            assert!(sent < 1_000, "it is never cut off");
        };
        assert_eq!(until, at + Duration::from_secs(10));
        assert!((299..=301).contains(&sent), "{sent} messages in half a minute");
        assert!(
            watched.barred_until(at + 9 * SECOND).is_some()
                && watched.barred_until(until).is_none()
        );
        // A large packet counts by its bytes; the allowance of the other channel is separate.
        let other = conduct.watch(&RobotId::random(), Way::Mqtt, now);
        assert_eq!(other.sent(1, 10_000, now), Verdict::Fine);
        assert_eq!(other.sent(0, 500, now), Verdict::Slow(now + SECOND / 2));
        assert_eq!(conduct.watch(&other.robot, Way::Http, now).asks(now), Verdict::Fine);
    }

    #[test]
    fn who_rests_between_bursts_is_never_cut() {
        let (conduct, robot, mut now) = (conduct(), RobotId::random(), Instant::now());
        for _ in 0..100 {
            // A new connection brings no new allowance.
            let watched = conduct.watch(&robot, Way::Mqtt, now);
            for _ in 0..105 {
                assert!(!matches!(watched.sent(1, 0, now), Verdict::Cut(_)));
            }
            now += 11 * SECOND;
        }
        assert_eq!(conduct.totals(), ConductTotals { slowed: 1, cut: 0, turned_away: 0 });
    }

    #[test]
    fn time_away_doubles_and_is_forgotten() {
        let (conduct, robot, mut now) = (conduct(), RobotId::random(), Instant::now());
        let watched = conduct.watch(&robot, Way::Mqtt, now);
        let mut away = Vec::new();
        for _ in 0..9 {
            let until = watched.offends(Offence::TooLarge(7), now);
            away.push((until - now).as_secs());
            now = until;
        }
        assert_eq!(away, [10, 20, 40, 80, 160, 320, 640, 640, 640]);
        let text = conduct.trouble(&robot).expect("shown");
        assert!(
            text.contains("packet of 7 bytes")
                && text.contains("9 times")
                && text.contains("640 s"),
            "{text}"
        );
        assert_eq!(
            conduct.watch(&robot, Way::Http, now).barred_until(now - SECOND),
            None,
            "the other way stays open"
        );
        conduct.forgive(now + 599 * SECOND);
        assert!(conduct.trouble(&robot).is_some());
        conduct.forgive(now + 600 * SECOND);
        assert_eq!(conduct.trouble(&robot), None);
        let until = watched.offends(Offence::Violation("publishes where it may not"), now);
        assert_eq!(until - now, 10 * SECOND, "the count begins anew");
        drop(watched);
        conduct.forgive(until + 600 * SECOND);
        assert!(lock(&conduct.robots).is_empty());
    }

    #[test]
    fn what_changes_is_told_once() {
        let (conduct, robot, now) = (conduct(), RobotId::random(), Instant::now());
        let watched = conduct.watch(&robot, Way::Mqtt, now);
        watched.sent(101, 0, now);
        watched.sent(1, 0, now);
        assert_eq!(conduct.news().now_or_never(), Some(BTreeSet::from([robot.clone()])));
        conduct.forgive(now + 3600 * SECOND);
        assert_eq!(conduct.news().now_or_never(), Some(BTreeSet::from([robot])));
    }

    #[test]
    fn requests_are_held_up_or_refused_and_served_at_the_rate() {
        let (conduct, robot, start) = (conduct(), RobotId::random(), Instant::now());
        let watched = conduct.watch(&robot, Way::Http, start);
        let (mut served, mut refused) = (0, 0);
        for tenth in 0..100 {
            for _ in 0..50 {
                match watched.asks(start + Duration::from_millis(100) * tenth) {
                    Verdict::Cut(_) => refused += 1,
                    Verdict::Fine | Verdict::Slow(_) => served += 1,
                }
            }
        }
        assert_eq!(served + refused, 5_000);
        assert!(
            (215..=225).contains(&served),
            "{served}: the burst, ten seconds' worth, and who is held up"
        );
    }
}
