//! External brokers: the server is a client of one of them. When its session ends, a new one begins
//! after a jittered pause, at the same broker or the next. MQTT 3.1.1 does not tell a client the
//! broker's subscribers, admitted clients or addresses, so they are unknown here. Presence follows
//! from robots' messages, and we cannot close robots' sessions. A message proves only as much as
//! the broker's access control list does: the robot that its topic names. Reports never use this
//! path (see docs/decisions).

mod fan_out;
mod online_robots;
mod outbox;
mod session;

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use task_proto::api::MqttTraffic;
use task_proto::messages::topic::{Topic, TopicPrefix};
use task_proto::{CaPin, Digest, RobotId};
use task_transport::{Route, Trust};
use tokio::sync::{Notify, Semaphore, watch};
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use super::{Health, Inbox, NotConnected, NotSent, PartQos};
use crate::domain::broker_url::{BrokerUrl, BrokerUrls};
use crate::system::clock::Clock;
pub(super) use fan_out::ExternalFanOut;
use online_robots::OnlineRobots;
use outbox::{Outbox, OutgoingMessage};

/// The last level of the topic on which the server receives its own message.
pub const CANARY_LEVEL: &str = "server";
/// KiB of packages' parts that the broker has not acknowledged; a larger part is sent alone.
const WINDOW_KIB: u32 = 4 * 1024;
/// How long the broker may leave a full window unacknowledged.
const PART_PATIENCE: Duration = Duration::from_secs(30);
/// Maximum wait for room of a caller that rings many robots; a stalled session ends by itself.
const ROOM_PATIENCE: Duration = Duration::from_secs(60);
/// Maximum pause between two connection attempts.
const MAX_PAUSE: Duration = Duration::from_secs(30);
/// Maximum pause before the second attempt.
const FIRST_PAUSE: Duration = Duration::from_millis(500);
/// A session of this length proves the connection good: the backoff starts again.
const GOOD_SESSION: Duration = Duration::from_secs(30);

/// The external brokers and the server's account there.
#[derive(Debug, Clone)]
pub struct ExternalConfig {
    /// The brokers' URLs, with the server's user and password. One broker is used at a time; on
    /// failure the next one.
    pub brokers: BrokerUrls,
    /// The broker of the last live session; announced to robots.
    pub current: Arc<AtomicUsize>,
    /// The pinned authority of the brokers' certificates; absent: the system's roots.
    pub pin: Option<CaPin>,
    /// The MQTT client id; the broker ends an older session of the same id.
    pub client_id: String,
    /// The prefix of all topics.
    pub prefix: TopicPrefix,
}

/// The route to the broker at `url`.
pub fn external_route(url: &BrokerUrl, pin: Option<CaPin>) -> Route {
    let tls = || Arc::new(Trust::by(pin).client_config(Clock::for_certificates()));
    Route { host: url.host.clone(), port: url.port, tls: url.tls.then(tls), websocket: None }
}

/// One of the brokers.
pub(super) struct BrokerEndpoint {
    /// Its number in the list.
    number: usize,
    url: BrokerUrl,
    /// The route to the broker.
    route: Route,
}

/// The connection to the broker, for as long as the server runs.
pub(super) struct External {
    config: ExternalConfig,
    inbox: Arc<dyn Inbox>,
    outbox: Mutex<Outbox>,
    /// A message was put into the outbox.
    filled: Notify,
    /// A message was taken out of the outbox.
    taken: Notify,
    /// Free KiB of the window.
    window: Arc<Semaphore>,
    online: Mutex<OnlineRobots>,
    traffic: Mutex<MqttTraffic>,
    stop: CancellationToken,
    sessions: TaskTracker,
}

impl External {
    /// Begins to connect, and reconnects until [`External::shutdown`]. The receiver always has the
    /// current health.
    pub(super) fn start(
        config: ExternalConfig,
        inbox: Arc<dyn Inbox>,
    ) -> (Arc<Self>, watch::Receiver<Health>) {
        let (sender, health) = watch::channel(Health::Recovering(format!(
            "the server has not connected to the broker at {} yet",
            config.brokers.first().address()
        )));
        let external = Arc::new(Self {
            config,
            inbox,
            outbox: Mutex::default(),
            filled: Notify::new(),
            taken: Notify::new(),
            window: Arc::new(Semaphore::new(WINDOW_KIB as usize)),
            online: Mutex::default(),
            traffic: Mutex::default(),
            stop: CancellationToken::new(),
            sessions: TaskTracker::new(),
        });
        external.sessions.spawn(external.clone().run(sender));
        external.sessions.close();
        (external, health)
    }

    /// Runs one session after another.
    async fn run(self: Arc<Self>, health: watch::Sender<Health>) {
        let endpoints = self.endpoints();
        let (mut failures, mut number) = (0u32, 0);
        // The last error of each broker: an unchanged error is not logged again.
        let mut logged = vec![None; endpoints.len()];
        loop {
            let (endpoint, begun) = (&endpoints[number], tokio::time::Instant::now());
            let ended = session::run(&self, endpoint, &health).await;
            let was_up = self.end_session();
            let Some(ended) = ended else { return };
            lock(&self.traffic).connections_refused += u64::from(ended.is_refusal());
            failures = if begun.elapsed() >= GOOD_SESSION { 0 } else { failures.saturating_add(1) };
            let seen = ended.text(&endpoint.url);
            if was_up {
                logged.fill(None);
            }
            if logged[number].as_ref() != Some(&seen) {
                tracing::warn!("{seen}; robots poll until it is back");
            }
            let new = Health::Recovering(seen.clone());
            health.send_if_modified(|health| std::mem::replace(health, new.clone()) != new);
            logged[number] = Some(seen);
            if !was_up {
                number = (number + 1) % endpoints.len();
            }
            // The pause grows with each round of all brokers.
            let rounds = failures / endpoints.len() as u32;
            tokio::select! {
                () = tokio::time::sleep(pause(rounds, rand::random())) => {}
                () = self.stop.cancelled() => return,
            }
        }
    }

    fn endpoints(&self) -> Vec<BrokerEndpoint> {
        let endpoint = |(number, url): (usize, &BrokerUrl)| BrokerEndpoint {
            number,
            url: url.clone(),
            route: external_route(url, self.config.pin),
        };
        self.config.brokers.all().iter().enumerate().map(endpoint).collect()
    }

    /// Marks the session as ended: no robot is reachable, and the next session determines presence
    /// anew. Returns whether there was a session.
    fn end_session(&self) -> bool {
        let was_up = {
            let mut outbox = lock(&self.outbox);
            let was_up = outbox.is_open();
            outbox.close();
            was_up
        };
        self.taken.notify_waiters();
        let gone = lock(&self.online).clear();
        for (robot, number) in gone {
            self.inbox.disconnected(&robot, number);
        }
        was_up
    }

    pub(super) fn send_desired(&self, robot: &RobotId, payload: Bytes) -> Result<(), NotConnected> {
        lock(&self.outbox).set_desired(robot, payload)?;
        self.filled.notify_one();
        Ok(())
    }

    pub(super) fn send_request(&self, robot: &RobotId, payload: Bytes) -> Result<(), NotSent> {
        if !lock(&self.online).contains(robot) {
            return Err(NotSent::NotConnected);
        }
        lock(&self.outbox).add_request(robot, payload)?;
        self.filled.notify_one();
        Ok(())
    }

    /// Whether the session is live. Any robot may be subscribed then, known to be online or not.
    pub(super) fn is_up(&self) -> bool {
        lock(&self.outbox).is_open()
    }

    /// Waits until almost all earlier notifications have been sent.
    pub(super) async fn room(&self) {
        let room = async {
            loop {
                let mut taken = std::pin::pin!(self.taken.notified());
                taken.as_mut().enable();
                if lock(&self.outbox).has_room() {
                    return;
                }
                taken.await;
            }
        };
        // After the timeout the outbox is longer than intended, once.
        let _ = tokio::time::timeout(ROOM_PATIENCE, room).await;
    }

    /// Publishes a part once there is room in the window of unacknowledged parts.
    async fn publish_part(
        &self,
        digest: Digest,
        payload: Bytes,
        qos: PartQos,
    ) -> Result<(), NotConnected> {
        let kib = u32::try_from(payload.len().div_ceil(1024))
            .map_or(WINDOW_KIB, |kib| kib.min(WINDOW_KIB));
        let permit =
            tokio::time::timeout(PART_PATIENCE, self.window.clone().acquire_many_owned(kib)).await;
        let permit = permit.map_err(|_| NotConnected)?.map_err(|_| NotConnected)?;
        let topic = Topic::Package(digest);
        lock(&self.outbox).add_part(OutgoingMessage {
            topic,
            payload,
            qos,
            permit: Some(permit),
        })?;
        self.filled.notify_one();
        Ok(())
    }

    /// Waits until the broker has acknowledged all parts, at most for `patience`.
    async fn parts_acknowledged(&self, patience: Duration) {
        let _ = tokio::time::timeout(patience, self.window.acquire_many(WINDOW_KIB)).await;
    }

    /// The used part of the window.
    pub(super) fn queued_part_bytes(&self) -> usize {
        (WINDOW_KIB as usize).saturating_sub(self.window.available_permits()) * 1024
    }

    /// Marks the robot as gone. Its session remains: an MQTT 3.1.1 client can't end another
    /// client's session.
    pub(super) fn disconnect(&self, robot: &RobotId) {
        let number = lock(&self.online).remove(robot);
        if let Some(number) = number {
            self.inbox.disconnected(robot, number);
        }
    }

    pub(super) fn traffic(&self) -> MqttTraffic {
        MqttTraffic { robots_connected: self.connected_count() as u64, ..*lock(&self.traffic) }
    }

    pub(super) fn connected_count(&self) -> usize {
        lock(&self.online).count()
    }

    pub(super) fn address(&self) -> String {
        let brokers = self.config.brokers.all();
        let current = self.config.current.load(Ordering::Relaxed).min(brokers.len() - 1);
        brokers[current].address()
    }

    pub(super) async fn shutdown(&self, patience: Duration) {
        self.stop.cancel();
        if tokio::time::timeout(patience, self.sessions.wait()).await.is_err() {
            tracing::warn!("the session at the MQTT broker did not end in time");
        }
    }
}

/// Exponential backoff with full jitter; `jitter` is uniform from 0 to 1.
fn pause(failures: u32, jitter: f64) -> Duration {
    FIRST_PAUSE.saturating_mul(1 << failures.min(10)).min(MAX_PAUSE).mul_f64(jitter.clamp(0.0, 1.0))
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // Every change under these locks is complete in itself, so a panic elsewhere leaves nothing
    // half-done.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pauses_grow_to_a_bound_and_are_spread() {
        assert_eq!(pause(0, 1.0), FIRST_PAUSE);
        assert_eq!(pause(3, 0.5), FIRST_PAUSE * 4);
        assert_eq!(pause(u32::MAX, 1.0), MAX_PAUSE);
        assert_eq!(pause(7, 0.0), Duration::ZERO);
    }
}
