//! Sends robots their desired state: the whole signed document if it fits into a message, with the
//! inline blobs that still fit; otherwise only its generation. An unreachable robot is no error,
//! because both sides compare again when it connects.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use task_proto::desired::{
    BlobRef, DesiredNotice, Inline, MAX_DESIRED_NOTICE_BYTES, MAX_PUSHED_ENVELOPE_BYTES,
};
use task_proto::{Digest, RobotId};
use tokio_util::sync::CancellationToken;

use crate::blobs::Blobs;
use crate::broker::Broker;
use crate::fleet::presence::Presence;
use crate::orders::changes::{Changes, RobotsToNotify};
use crate::orders::desired_states::{DesiredStates, SignedState};
use crate::system::clock::Clock;

/// States that are read together and signed without a pause.
const BATCH: usize = 64;
/// Maximum cached blobs while many robots are notified: usually all robots wait for the same ones.
const MAX_CACHED_BLOBS: usize = 32;
/// Time limit for an inline blob, which may first have to come from a common store.
const READ_TIMEOUT: Duration = Duration::from_secs(2);
/// Overhead of a blob in a message besides its base64: its digest, quotes, colon and comma.
const INLINE_OVERHEAD_BYTES: usize = 80;

/// The dependencies for notifying robots.
pub struct Downlink {
    pub desired_states: DesiredStates,
    /// The source of inline blobs.
    pub blobs: Blobs,
    pub broker: Broker,
    /// The presence of robots.
    pub presence: Arc<Presence>,
    pub clock: Clock,
}

impl Downlink {
    /// Notifies the robots that `changes` names, until `stop`.
    pub async fn run(self, changes: Changes, stop: CancellationToken) {
        let notifying = async {
            loop {
                let mut robots = self.robots_to_notify(changes.take_robots_to_notify().await).await;
                robots.retain(|robot| self.should_notify(robot));
                let mut cache = HashMap::new();
                for robots in robots.chunks(BATCH) {
                    self.broker.room().await;
                    self.notify(robots, &mut cache).await;
                }
            }
        };
        // If this is cut off half-way, the remaining robots are notified on their next connect.
        tokio::select! {
            () = stop.cancelled() => {}
            () = notifying => {}
        }
    }

    async fn robots_to_notify(&self, waiting: RobotsToNotify) -> Vec<RobotId> {
        if waiting.all {
            match self.desired_states.robot_ids().await {
                Ok(robots) => return robots,
                Err(error) => tracing::warn!(
                    error = &error as &dyn std::error::Error,
                    "the robots could not be read; they get their state when they ask"
                ),
            }
        }
        waiting.robots.into_iter().collect()
    }

    /// Reads an inline blob. If it is missing, the robot pulls.
    async fn fetch(&self, blob: &BlobRef, cache: &mut BlobCache) {
        if blob.size > MAX_DESIRED_NOTICE_BYTES as u64 || cache.contains_key(&blob.digest) {
            return;
        }
        let read = async {
            match self.blobs.get(blob.digest).await? {
                Some(found) => found.read().await.map(Some),
                None => Ok(None),
            }
        };
        // A common store that does not answer must not keep other robots waiting.
        let Ok(read) = tokio::time::timeout(READ_TIMEOUT, read).await else {
            tracing::warn!(digest = %blob.digest, "an inline blob does not come; robots pull it");
            return;
        };
        match read {
            Ok(Some(bytes)) => {
                if cache.len() >= MAX_CACHED_BLOBS {
                    cache.clear();
                }
                cache.insert(blob.digest, bytes);
            }
            Ok(None) => {
                tracing::warn!(digest = %blob.digest, "an inline blob is missing; robots pull it")
            }
            Err(error) => tracing::warn!(
                digest = %blob.digest,
                error = &error as &dyn std::error::Error,
                "an inline blob can't be read; robots pull it"
            ),
        }
    }

    fn should_notify(&self, robot: &RobotId) -> bool {
        let is_known = self.presence.accepts_downlink(robot) || self.broker.is_external();
        self.broker.may_reach(robot)
            && is_known
            && !self.presence.is_duplicate(robot, self.clock.now_ms())
    }

    async fn notify(&self, robots: &[RobotId], cache: &mut BlobCache) {
        let states = match self.desired_states.get_many(robots).await {
            Ok(states) => states,
            Err(error) => {
                let robots = robots.len();
                tracing::warn!(
                    robots,
                    error = &error as &dyn std::error::Error,
                    "desired states could not be read; the robots ask again"
                );
                return;
            }
        };
        for (robot, desired) in states {
            for blob in &desired.bundled_blobs {
                self.fetch(blob, cache).await;
            }
            let payload = match self.presence.accepts_downlink(&robot) {
                true => payload(&desired, cache),
                // Only notifying shows which robots are connected to an external broker. A robot
                // that is present over HTTP has to identify itself to get more.
                false if self.broker.is_external() => notice(&desired),
                // Another agent has appeared meanwhile, and has not identified itself yet.
                false => continue,
            };
            match payload {
                // The robot may have disconnected meanwhile.
                Ok(payload) => drop(self.broker.send_desired(&robot, payload)),
                Err(error) => {
                    tracing::error!(%robot, %error, "a desired state could not be written")
                }
            }
        }
    }
}

/// Cached blobs, by digest.
type BlobCache = HashMap<Digest, Bytes>;

fn payload(desired: &SignedState, cache: &BlobCache) -> Result<Bytes, serde_json::Error> {
    let message = |inline| DesiredNotice::State { envelope: desired.envelope.clone(), inline };
    let whole = serde_json::to_vec(&message(Inline::default()))?;
    if whole.len() <= MAX_PUSHED_ENVELOPE_BYTES {
        let mut room = MAX_DESIRED_NOTICE_BYTES - whole.len() - INLINE_OVERHEAD_BYTES;
        let mut inline = Inline::default();
        for blob in &desired.bundled_blobs {
            let Some(bytes) = cache.get(&blob.digest) else { continue };
            let taken = bytes.len().div_ceil(3) * 4 + INLINE_OVERHEAD_BYTES;
            // Blobs that do not fit are pulled.
            if let Some(rest) = room.checked_sub(taken) {
                room = rest;
                inline.insert(blob.digest, bytes.to_vec());
            }
        }
        return if inline.is_empty() {
            Ok(whole.into())
        } else {
            serde_json::to_vec(&message(inline)).map(Bytes::from)
        };
    }
    notice(desired)
}

fn notice(desired: &SignedState) -> Result<Bytes, serde_json::Error> {
    serde_json::to_vec(&DesiredNotice::Notice { generation: desired.generation }).map(Bytes::from)
}

#[cfg(test)]
mod tests {
    use super::*;
    use task_proto::Generation;
    use task_proto::trust::envelope::{DESIRED_STATE_TYPE, Envelope, SigningKey};

    fn desired(state_bytes: usize, bundled_blobs: &[&[u8]]) -> SignedState {
        let key = SigningKey::from_bytes([7; 32]);
        SignedState {
            generation: Generation(12),
            envelope: Envelope::seal(DESIRED_STATE_TYPE, &vec![b' '; state_bytes], &key),
            bundled_blobs: bundled_blobs.iter().map(|bytes| blob(bytes)).collect(),
        }
    }

    fn blob(bytes: &[u8]) -> BlobRef {
        BlobRef { digest: Digest::of(bytes), size: bytes.len() as u64 }
    }

    fn pushed(desired: &SignedState, cache: &[&[u8]]) -> (usize, DesiredNotice) {
        let cache =
            cache.iter().map(|bytes| (Digest::of(bytes), Bytes::copy_from_slice(bytes))).collect();
        let payload = payload(desired, &cache).expect("json");
        (payload.len(), serde_json::from_slice(&payload).expect("a notice"))
    }

    #[test]
    fn state_above_the_message_limit_becomes_a_notice() {
        assert!(matches!(pushed(&desired(40_000, &[]), &[]).1, DesiredNotice::State { .. }));
        let notice = pushed(&desired(MAX_PUSHED_ENVELOPE_BYTES, &[]), &[]).1;
        assert_eq!(notice, DesiredNotice::Notice { generation: Generation(12) });
    }

    #[test]
    fn inline_blobs_fill_the_remaining_space() {
        let (small, large, absent) = (&[1; 1000][..], &[2; 70_000][..], &[3; 1000][..]);
        let inlined = |state_bytes, cache: &[&[u8]]| {
            let (length, message) = pushed(&desired(state_bytes, &[large, small, absent]), cache);
            assert!(length <= MAX_DESIRED_NOTICE_BYTES, "{length}");
            let DesiredNotice::State { inline, .. } = message else { panic!("the state fits") };
            [small, large, absent].map(|bytes| inline.get(&blob(bytes)).is_some())
        };
        assert_eq!(inlined(100, &[small, large]), [true, true, false]);
        assert_eq!(inlined(40_000, &[small, large]), [true, false, false]);
        assert_eq!(inlined(100, &[]), [false, false, false]);
    }
}
