//! Robots' pulls of blobs over HTTP: how many at once, how fast together, and in which order. A
//! robot that must wait does so for a moment. Then it is told when to come back, and keeps its
//! place. A robot that makes almost no progress while others wait is cut off. This module knows no
//! blobs and no HTTP responses.

mod body;
mod pace;
mod queue;

use std::collections::{HashMap, VecDeque};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use task_proto::id::{LabelKey, LabelValue, Labels};
use task_proto::{Digest, RobotId};
use tokio::sync::oneshot;
use tokio::time::{Instant, timeout};

pub use body::TransferBody;
use pace::Pace;
pub use queue::Claim;
use queue::{Asking, Place, Progress, Queue, Turn, jittered};

use crate::config::TransferLimits;
use crate::net::http_connections::Connection;

/// How long a request waits for its turn.
const PATIENCE: Duration = Duration::from_secs(2);
/// Number of samples for the displayed speed.
const LOOKS: usize = 6;
/// When a robot should retry if the queue had no place.
const NO_PLACE_MS: u64 = 30_000;

/// All transfers of robots. Clones share the same state.
#[derive(Clone)]
pub struct Transfers {
    shared: Arc<Shared>,
}

struct Shared {
    started: Instant,
    site_label: LabelKey,
    turns: Mutex<Turns>,
    paces: Mutex<Paces>,
    /// Bytes sent to robots.
    sent: AtomicU64,
    /// Samples of the sent bytes, with their times.
    looks: Mutex<VecDeque<(Instant, u64)>>,
}

struct Turns {
    queue: Queue,
    /// Channels to the pending requests.
    asking: HashMap<Asking, oneshot::Sender<Transfer>>,
    /// Transfers whose bytes are being sent.
    carried: HashMap<u64, Carried>,
    last_number: u64,
}

/// A transfer and its connection.
struct Carried {
    robot: RobotId,
    connection: Connection,
    progress: Progress,
}

struct Paces {
    all: Option<Pace>,
    sites: HashMap<LabelValue, Pace>,
}

/// The robot's turn has not come.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("other robots come first; come back in {retry_after_s} s")]
pub struct NotYet {
    /// Seconds after which to retry.
    pub retry_after_s: u64,
}

/// A robot's turn, which ends when this is dropped.
pub struct Transfer {
    shared: Arc<Shared>,
    turn: Turn,
    begun_ms: u64,
    /// The number among the carried transfers.
    number: Option<u64>,
}

impl Transfers {
    /// Starts without transfers, bounded by `limits`. The value of `site_label` names a robot's
    /// site.
    pub fn new(limits: &TransferLimits, site_label: LabelKey) -> Self {
        let now = Instant::now();
        let pace =
            |bytes_per_s: Option<u64>| bytes_per_s.map(|bytes_per_s| Pace::new(bytes_per_s, now));
        let sites = limits
            .sites
            .iter()
            .filter_map(|(site, limits)| Some((site.clone(), pace(limits.bytes_per_s)?)));
        let paces = Paces { all: pace(limits.all.bytes_per_s), sites: sites.collect() };
        let turns = Turns {
            queue: Queue::new(limits),
            asking: HashMap::new(),
            carried: HashMap::new(),
            last_number: 0,
        };
        let (turns, paces) = (Mutex::new(turns), Mutex::new(paces));
        let (sent, looks) = (AtomicU64::new(0), Mutex::default());
        Self { shared: Arc::new(Shared { started: now, site_label, turns, paces, sent, looks }) }
    }

    /// The site of a robot with these labels.
    pub fn site_of(&self, labels: &Labels) -> Option<LabelValue> {
        labels.get(&self.shared.site_label).cloned()
    }

    /// The number of running transfers.
    pub fn running(&self) -> u64 {
        self.shared.turns().queue.running()
    }

    /// The number of waiting robots.
    pub fn waiting(&self) -> u64 {
        self.shared.turns().queue.waiting()
    }

    /// Recent bytes per second of all transfers together; see [`Transfers::look`].
    pub fn bytes_per_s(&self) -> u64 {
        let looks = self.shared.looks.lock().unwrap_or_else(PoisonError::into_inner);
        let (Some((from, sent_before)), Some((to, sent))) = (looks.front(), looks.back()) else {
            return 0;
        };
        let seconds = to.duration_since(*from).as_secs_f64();
        if seconds > 0.0 { (sent.saturating_sub(*sent_before) as f64 / seconds) as u64 } else { 0 }
    }

    /// Samples the sent bytes, and ends transfers that make almost no progress while others wait.
    /// Call this about every second: the displayed speed covers the last samples.
    pub fn look(&self) {
        self.shared.end_too_slow(self.shared.now_ms());
        let mut looks = self.shared.looks.lock().unwrap_or_else(PoisonError::into_inner);
        if looks.len() >= LOOKS {
            looks.pop_front();
        }
        looks.push_back((Instant::now(), self.shared.sent.load(Ordering::Relaxed)));
    }

    /// Waits for `robot`'s turn to pull `blob`, for a moment.
    pub async fn admit(
        &self,
        robot: &RobotId,
        blob: Digest,
        claim: &Claim,
    ) -> Result<Transfer, NotYet> {
        let place = Place { robot: robot.clone(), blob };
        let (tell, mut told) = oneshot::channel();
        let asking = {
            let mut turns = self.shared.turns();
            let Some(asking) = turns.queue.ask(place, claim, self.shared.now_ms()) else {
                return Err(come_back(jittered(NO_PLACE_MS, rand::random())));
            };
            turns.asking.insert(asking, tell);
            asking
        };
        let mut request = Request { shared: &self.shared, asking: Some(asking) };
        self.shared.begin_what_may();
        if let Ok(Ok(transfer)) = timeout(PATIENCE, &mut told).await {
            request.asking = None;
            return Ok(transfer);
        }
        match request.leave() {
            Some(away_ms) => Err(come_back(away_ms)),
            // The turn has come just now, or the robot sent a second request meanwhile.
            None => told.await.map_err(|_| come_back(jittered(0, rand::random()))),
        }
    }
}

fn come_back(away_ms: u64) -> NotYet {
    NotYet { retry_after_s: away_ms.div_ceil(1000) }
}

/// A waiting request. When its client disconnects, the value is dropped and the request stops
/// waiting.
struct Request<'a> {
    shared: &'a Arc<Shared>,
    asking: Option<Asking>,
}

impl Request<'_> {
    /// How long the robot should stay away; `None` if the request no longer waits.
    fn leave(&mut self) -> Option<u64> {
        let asking = self.asking.take()?;
        let mut turns = self.shared.turns();
        turns.asking.remove(&asking);
        turns.queue.send_away(asking, self.shared.now_ms(), rand::random())
    }
}

impl Drop for Request<'_> {
    fn drop(&mut self) {
        self.leave();
    }
}

impl Shared {
    fn end_too_slow(&self, now_ms: u64) {
        let Turns { queue, carried, .. } = &mut *self.turns();
        for Carried { robot, connection, progress } in carried.values_mut() {
            if progress.is_too_slow(connection.bytes_out(), queue.others_wait(robot), now_ms) {
                tracing::debug!(%robot, "it takes next to nothing, and others wait: its connection is cut");
                connection.end();
            }
        }
    }

    /// Begins the permitted transfers. A request that has ended meanwhile returns its turn by
    /// dropping the transfer.
    fn begin_what_may(self: &Arc<Self>) {
        let now_ms = self.now_ms();
        let told: Vec<_> = {
            let mut turns = self.turns();
            let Turns { queue, asking, .. } = &mut *turns;
            let begun = queue.begin(now_ms).into_iter();
            begun.map(|(request, turn)| (asking.remove(&request), turn)).collect()
        };
        for (tell, turn) in told {
            let transfer = Transfer { shared: self.clone(), turn, begun_ms: now_ms, number: None };
            // Without a receiver the transfer is dropped, and its turn passes to another robot.
            drop(tell.map(|tell| tell.send(transfer)));
        }
    }

    fn now_ms(&self) -> u64 {
        u64::try_from(self.started.elapsed().as_millis()).unwrap_or(u64::MAX)
    }

    fn turns(&self) -> MutexGuard<'_, Turns> {
        // Every change under these locks is complete in itself, so a panic elsewhere leaves nothing
        // half-done.
        self.turns.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn paces(&self) -> MutexGuard<'_, Paces> {
        self.paces.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Transfer {
    /// Uses this connection, which is cut if the transfer is too slow while others wait.
    pub fn by(mut self, connection: Option<&Connection>) -> Self {
        let Some(connection) = connection.cloned() else { return self };
        let progress = Progress::from(self.shared.now_ms(), connection.bytes_out());
        let mut turns = self.shared.turns();
        turns.last_number += 1;
        let number = turns.last_number;
        turns
            .carried
            .insert(number, Carried { robot: self.turn.robot.clone(), connection, progress });
        drop(turns);
        self.number = Some(number);
        self
    }

    fn sent(&self, bytes: u64) {
        self.shared.sent.fetch_add(bytes, Ordering::Relaxed);
    }

    /// How many of `bytes` may be sent next, and when; `None`: all, and now.
    fn reserve(&self, bytes: u64) -> Option<(u64, Instant)> {
        let mut paces = self.shared.paces();
        let Paces { all, sites } = &mut *paces;
        let site = self.turn.site.as_ref().and_then(|site| sites.get_mut(site));
        let mut limits: Vec<&mut Pace> = all.as_mut().into_iter().chain(site).collect();
        let running = self.shared.turns().queue.running();
        let piece = limits.iter().map(|pace| pace.piece(running)).min()?.min(bytes);
        let now = Instant::now();
        let at = limits.iter_mut().map(|pace| pace.reserve(piece, now)).max()?;
        Some((piece, at))
    }
}

impl Drop for Transfer {
    fn drop(&mut self) {
        let lasted_ms = self.shared.now_ms().saturating_sub(self.begun_ms);
        let mut turns = self.shared.turns();
        turns.queue.end(&self.turn, lasted_ms);
        self.number.and_then(|number| turns.carried.remove(&number));
        drop(turns);
        self.shared.begin_what_may();
    }
}

#[cfg(test)]
mod tests {
    use futures_util::{FutureExt as _, poll};

    use super::*;
    use crate::config::SiteLimits;

    #[tokio::test]
    async fn the_connection_of_a_stalled_transfer_is_cut_for_another_robot() {
        let all = SiteLimits { max: Some(1), bytes_per_s: None };
        let limits = TransferLimits { all, ..TransferLimits::default() };
        let transfers = Transfers::new(&limits, "site".parse().expect("valid"));
        let (robot, other, claim) = (RobotId::random(), RobotId::random(), Claim::default());
        let (blob, connection) = (Digest::of(b"x"), Connection::default());
        let stalled =
            transfers.admit(&robot, blob, &claim).await.expect("its turn").by(Some(&connection));
        let mut again = Box::pin(transfers.admit(&robot, Digest::of(b"y"), &claim));
        assert!(poll!(again.as_mut()).is_pending());
        transfers.shared.end_too_slow(60_000);
        assert_eq!(connection.cut().now_or_never(), None, "no other robot waits");
        let mut waits = Box::pin(transfers.admit(&other, blob, &claim));
        assert!(poll!(waits.as_mut()).is_pending());
        transfers.shared.end_too_slow(89_999);
        connection.wrote(16 * 1024);
        transfers.shared.end_too_slow(90_000);
        assert_eq!(connection.cut().now_or_never(), None, "it takes something");
        transfers.shared.end_too_slow(120_000);
        assert_eq!(connection.cut().now_or_never(), Some(()));
        drop((again, stalled));
        waits.await.expect("its turn");
        assert!(transfers.shared.turns().carried.is_empty());
    }
}
