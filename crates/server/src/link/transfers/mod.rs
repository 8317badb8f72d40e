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

use task_proto::ids::{LabelKey, LabelValue, Labels};
use task_proto::{Digest, RobotId};
use tokio::sync::oneshot;
use tokio::time::{Instant, timeout};

pub use body::TransferBody;
use pace::Pace;
pub use queue::TransferRequest;
use queue::{Permit, Place, Progress, Queue, RequestId, jittered};
use task_proto::time::millis;

use crate::config::TransferLimits;
use crate::net::http_connections::Connection;

/// How long a request waits for its turn.
const WAIT_TIMEOUT: Duration = Duration::from_secs(2);
/// Number of samples for the displayed speed.
const SAMPLES: usize = 6;
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
    state: Mutex<State>,
    paces: Mutex<Paces>,
    /// Bytes sent to robots.
    sent: AtomicU64,
    /// Samples of the sent bytes, with their times.
    samples: Mutex<VecDeque<(Instant, u64)>>,
}

struct State {
    queue: Queue,
    /// Channels to the pending requests.
    senders: HashMap<RequestId, oneshot::Sender<Transfer>>,
    /// Transfers whose bytes are being sent.
    active: HashMap<u64, ActiveTransfer>,
    last_number: u64,
}

/// A transfer and its connection.
struct ActiveTransfer {
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
#[error("other robots come first; try again in {retry_after_s} s")]
pub struct RetryLater {
    /// Seconds after which to retry.
    pub retry_after_s: u64,
}

/// A running transfer, which ends when this is dropped.
pub struct Transfer {
    shared: Arc<Shared>,
    permit: Permit,
    begun_ms: u64,
    /// The number among the active transfers.
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
        let state = State {
            queue: Queue::new(limits),
            senders: HashMap::new(),
            active: HashMap::new(),
            last_number: 0,
        };
        let (state, paces) = (Mutex::new(state), Mutex::new(paces));
        let (sent, samples) = (AtomicU64::new(0), Mutex::default());
        Self { shared: Arc::new(Shared { started: now, site_label, state, paces, sent, samples }) }
    }

    /// The site of a robot with these labels.
    pub fn site_of(&self, labels: &Labels) -> Option<LabelValue> {
        labels.get(&self.shared.site_label).cloned()
    }

    /// The number of running transfers.
    pub fn running(&self) -> u64 {
        self.shared.state().queue.running()
    }

    /// The number of waiting robots.
    pub fn waiting(&self) -> u64 {
        self.shared.state().queue.waiting()
    }

    /// Recent bytes per second of all transfers together; see [`Transfers::sample`].
    pub fn bytes_per_s(&self) -> u64 {
        let samples = self.shared.samples.lock().unwrap_or_else(PoisonError::into_inner);
        let (Some((from, sent_before)), Some((to, sent))) = (samples.front(), samples.back())
        else {
            return 0;
        };
        let seconds = to.duration_since(*from).as_secs_f64();
        if seconds > 0.0 { (sent.saturating_sub(*sent_before) as f64 / seconds) as u64 } else { 0 }
    }

    /// Samples the sent bytes, and ends transfers that make almost no progress while others wait.
    /// Call this about every second: the displayed speed covers the last samples.
    pub fn sample(&self) {
        self.shared.end_too_slow(self.shared.now_ms());
        let mut samples = self.shared.samples.lock().unwrap_or_else(PoisonError::into_inner);
        if samples.len() >= SAMPLES {
            samples.pop_front();
        }
        samples.push_back((Instant::now(), self.shared.sent.load(Ordering::Relaxed)));
    }

    /// Waits for `robot`'s turn to pull `blob`, for a moment.
    pub async fn admit(
        &self,
        robot: &RobotId,
        blob: Digest,
        request: &TransferRequest,
    ) -> Result<Transfer, RetryLater> {
        let place = Place { robot: robot.clone(), blob };
        let (sender, mut receiver) = oneshot::channel();
        let id = {
            let mut state = self.shared.state();
            let Some(id) = state.queue.enqueue(place, request, self.shared.now_ms()) else {
                return Err(retry_later(jittered(NO_PLACE_MS, rand::random())));
            };
            state.senders.insert(id, sender);
            id
        };
        let mut waiting = WaitingRequest { shared: &self.shared, id: Some(id) };
        self.shared.start_permitted();
        if let Ok(Ok(transfer)) = timeout(WAIT_TIMEOUT, &mut receiver).await {
            waiting.id = None;
            return Ok(transfer);
        }
        match waiting.withdraw() {
            Some(away_ms) => Err(retry_later(away_ms)),
            // The turn has come just now, or the robot sent a second request meanwhile.
            None => receiver.await.map_err(|_| retry_later(jittered(0, rand::random()))),
        }
    }
}

fn retry_later(away_ms: u64) -> RetryLater {
    RetryLater { retry_after_s: away_ms.div_ceil(1000) }
}

/// A waiting request. When its client disconnects, the value is dropped and the request stops
/// waiting.
struct WaitingRequest<'a> {
    shared: &'a Arc<Shared>,
    id: Option<RequestId>,
}

impl WaitingRequest<'_> {
    /// How long the robot should stay away; `None` if the request no longer waits.
    fn withdraw(&mut self) -> Option<u64> {
        let id = self.id.take()?;
        let mut state = self.shared.state();
        state.senders.remove(&id);
        state.queue.defer(id, self.shared.now_ms(), rand::random())
    }
}

impl Drop for WaitingRequest<'_> {
    fn drop(&mut self) {
        self.withdraw();
    }
}

impl Shared {
    fn end_too_slow(&self, now_ms: u64) {
        let State { queue, active, .. } = &mut *self.state();
        for ActiveTransfer { robot, connection, progress } in active.values_mut() {
            if progress.is_too_slow(connection.bytes_out(), queue.others_wait(robot), now_ms) {
                tracing::debug!(%robot, "the transfer makes almost no progress while others wait; its connection is closed");
                connection.end();
            }
        }
    }

    /// Begins the permitted transfers. A request that has ended meanwhile returns its permit by
    /// dropping the transfer.
    fn start_permitted(self: &Arc<Self>) {
        let now_ms = self.now_ms();
        let started: Vec<_> = {
            let mut state = self.state();
            let State { queue, senders, .. } = &mut *state;
            let started = queue.start_next(now_ms).into_iter();
            started.map(|(id, permit)| (senders.remove(&id), permit)).collect()
        };
        for (sender, permit) in started {
            let transfer =
                Transfer { shared: self.clone(), permit, begun_ms: now_ms, number: None };
            // Without a receiver the transfer is dropped, and its permit passes to another robot.
            drop(sender.map(|sender| sender.send(transfer)));
        }
    }

    fn now_ms(&self) -> u64 {
        millis(self.started.elapsed())
    }

    fn state(&self) -> MutexGuard<'_, State> {
        // Every change under these locks is complete in itself, so a panic elsewhere leaves nothing
        // half-done.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
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
        let mut state = self.shared.state();
        state.last_number += 1;
        let number = state.last_number;
        state.active.insert(
            number,
            ActiveTransfer { robot: self.permit.robot.clone(), connection, progress },
        );
        drop(state);
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
        let site = self.permit.site.as_ref().and_then(|site| sites.get_mut(site));
        let mut limits: Vec<&mut Pace> = all.as_mut().into_iter().chain(site).collect();
        let running = self.shared.state().queue.running();
        let piece = limits.iter().map(|pace| pace.piece(running)).min()?.min(bytes);
        let now = Instant::now();
        let at = limits.iter_mut().map(|pace| pace.reserve(piece, now)).max()?;
        Some((piece, at))
    }
}

impl Drop for Transfer {
    fn drop(&mut self) {
        let lasted_ms = self.shared.now_ms().saturating_sub(self.begun_ms);
        let mut state = self.shared.state();
        state.queue.finish(&self.permit, lasted_ms);
        self.number.and_then(|number| state.active.remove(&number));
        drop(state);
        self.shared.start_permitted();
    }
}

#[cfg(test)]
mod tests {
    use futures_util::{FutureExt as _, poll};

    use super::*;
    use crate::config::SiteLimits;

    #[tokio::test]
    async fn stalled_transfer_is_cut_while_another_robot_waits() {
        let all = SiteLimits { max: Some(1), bytes_per_s: None };
        let limits = TransferLimits { all, ..TransferLimits::default() };
        let transfers = Transfers::new(&limits, "site".parse().expect("valid"));
        let (robot, other, request) =
            (RobotId::random(), RobotId::random(), TransferRequest::default());
        let (blob, connection) = (Digest::of(b"x"), Connection::default());
        let stalled =
            transfers.admit(&robot, blob, &request).await.expect("its turn").by(Some(&connection));
        let mut again = Box::pin(transfers.admit(&robot, Digest::of(b"y"), &request));
        assert!(poll!(again.as_mut()).is_pending());
        transfers.shared.end_too_slow(60_000);
        assert_eq!(connection.cut().now_or_never(), None, "no other robot waits");
        let mut waits = Box::pin(transfers.admit(&other, blob, &request));
        assert!(poll!(waits.as_mut()).is_pending());
        transfers.shared.end_too_slow(89_999);
        connection.wrote(16 * 1024);
        transfers.shared.end_too_slow(90_000);
        assert_eq!(connection.cut().now_or_never(), None, "it takes something");
        transfers.shared.end_too_slow(120_000);
        assert_eq!(connection.cut().now_or_never(), Some(()));
        drop((again, stalled));
        waits.await.expect("its turn");
        assert!(transfers.shared.state().active.is_empty());
    }
}
