//! Sends robots their desired state: the whole signed document if it fits into a message, with the
//! inline blobs that still fit; otherwise only its generation. An unreachable robot is no error,
//! because both sides compare again when it connects.

use std::collections::HashMap;
use std::sync::Arc;

use bytes::Bytes;
use task_proto::desired::{
    BlobRef, Doorbell, Inline, MAX_DOORBELL_BYTES, MAX_PUSHED_ENVELOPE_BYTES,
};
use task_proto::{Digest, RobotId};
use tokio_util::sync::CancellationToken;

use crate::blobs::Blobs;
use crate::broker::Broker;
use crate::fleet::presence::Presence;
use crate::orders::actions::{Actions, Desired};
use crate::orders::changes::{Changes, Rings};
use crate::system::clock::Clock;

/// States that are read together and signed without a pause.
const AT_ONCE: usize = 64;
/// Maximum cached blobs while many robots are rung: usually all robots wait for the same ones.
const MAX_RIDERS: usize = 32;
/// Overhead of a blob in a message besides its base64: its digest, quotes, colon and comma.
const RIDER_OVERHEAD: usize = 80;

/// The dependencies for ringing robots.
pub struct Downlink {
    /// The source of desired states.
    pub actions: Actions,
    /// The source of inline blobs.
    pub blobs: Blobs,
    pub broker: Broker,
    /// The presence of robots.
    pub presence: Arc<Presence>,
    pub clock: Clock,
}

impl Downlink {
    /// Rings the robots that `changes` names, until `stop`.
    pub async fn run(self, changes: Changes, stop: CancellationToken) {
        let ringing = async {
            loop {
                let mut robots = self.who(changes.take_rings().await).await;
                robots.retain(|robot| self.is_to_be_told(robot));
                let mut riders = HashMap::new();
                for robots in robots.chunks(AT_ONCE) {
                    self.broker.room().await;
                    self.ring(robots, &mut riders).await;
                }
            }
        };
        // If this is cut off half-way, the remaining robots are rung on their next connect.
        tokio::select! {
            () = stop.cancelled() => {}
            () = ringing => {}
        }
    }

    async fn who(&self, rings: Rings) -> Vec<RobotId> {
        if rings.everyone {
            match self.actions.every_robot().await {
                Ok(robots) => return robots,
                Err(error) => tracing::warn!(
                    error = &error as &dyn std::error::Error,
                    "the robots could not be read; they are rung when they ask"
                ),
            }
        }
        rings.robots.into_iter().collect()
    }

    /// Reads an inline blob. If it is missing, the robot pulls.
    async fn fetch(&self, blob: &BlobRef, riders: &mut Riders) {
        if blob.size > MAX_DOORBELL_BYTES as u64 || riders.contains_key(&blob.digest) {
            return;
        }
        let read = match self.blobs.get(blob.digest).await {
            Ok(Some(found)) => found.read().await.map(Some),
            Ok(None) => Ok(None),
            Err(error) => Err(error),
        };
        match read {
            Ok(Some(bytes)) => {
                if riders.len() >= MAX_RIDERS {
                    riders.clear();
                }
                riders.insert(blob.digest, bytes);
            }
            Ok(None) => {
                tracing::warn!(digest = %blob.digest, "a blob that is to ride along is not there")
            }
            Err(error) => tracing::warn!(
                digest = %blob.digest,
                error = &error as &dyn std::error::Error,
                "a blob that is to ride along can't be read"
            ),
        }
    }

    fn is_to_be_told(&self, robot: &RobotId) -> bool {
        let is_known = self.presence.may_be_told(robot) || self.broker.is_external();
        self.broker.may_reach(robot)
            && is_known
            && !self.presence.is_duplicate(robot, self.clock.now_ms())
    }

    async fn ring(&self, robots: &[RobotId], riders: &mut Riders) {
        let states = match self.actions.desired_of(robots).await {
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
            for blob in &desired.along {
                self.fetch(blob, riders).await;
            }
            let payload = match self.presence.may_be_told(&robot) {
                true => payload(&desired, riders),
                // Only ringing shows which robots are connected to an external broker. A robot that
                // is present over HTTP has to identify itself to get more.
                false if self.broker.is_external() => notice(&desired),
                // Another agent has appeared meanwhile, and has not identified itself yet.
                false => continue,
            };
            match payload {
                // The robot may have disconnected meanwhile.
                Ok(payload) => drop(self.broker.ring(&robot, payload)),
                Err(error) => {
                    tracing::error!(%robot, %error, "a desired state could not be written")
                }
            }
        }
    }
}

/// Cached blobs, by digest.
type Riders = HashMap<Digest, Bytes>;

fn payload(desired: &Desired, riders: &Riders) -> Result<Bytes, serde_json::Error> {
    let doorbell = |inline| Doorbell::State { envelope: desired.envelope.clone(), inline };
    let whole = serde_json::to_vec(&doorbell(Inline::default()))?;
    if whole.len() <= MAX_PUSHED_ENVELOPE_BYTES {
        let mut room = MAX_DOORBELL_BYTES - whole.len() - RIDER_OVERHEAD;
        let mut inline = Inline::default();
        for blob in &desired.along {
            let Some(bytes) = riders.get(&blob.digest) else { continue };
            let taken = bytes.len().div_ceil(3) * 4 + RIDER_OVERHEAD;
            // Blobs that do not fit are pulled.
            if let Some(rest) = room.checked_sub(taken) {
                room = rest;
                inline.insert(blob.digest, bytes.to_vec());
            }
        }
        return if inline.is_empty() {
            Ok(whole.into())
        } else {
            serde_json::to_vec(&doorbell(inline)).map(Bytes::from)
        };
    }
    notice(desired)
}

fn notice(desired: &Desired) -> Result<Bytes, serde_json::Error> {
    serde_json::to_vec(&Doorbell::Notice { generation: desired.generation }).map(Bytes::from)
}

#[cfg(test)]
mod tests {
    use super::*;
    use task_proto::Generation;
    use task_proto::envelope::{DESIRED_STATE_TYPE, Envelope, SigningKey};

    fn desired(state_bytes: usize, along: &[&[u8]]) -> Desired {
        let key = SigningKey::from_bytes([7; 32]);
        Desired {
            generation: Generation(12),
            envelope: Envelope::seal(DESIRED_STATE_TYPE, &vec![b' '; state_bytes], &key),
            along: along.iter().map(|bytes| blob(bytes)).collect(),
        }
    }

    fn blob(bytes: &[u8]) -> BlobRef {
        BlobRef { digest: Digest::of(bytes), size: bytes.len() as u64 }
    }

    fn pushed(desired: &Desired, riders: &[&[u8]]) -> (usize, Doorbell) {
        let riders =
            riders.iter().map(|bytes| (Digest::of(bytes), Bytes::copy_from_slice(bytes))).collect();
        let payload = payload(desired, &riders).expect("json");
        (payload.len(), serde_json::from_slice(&payload).expect("a doorbell"))
    }

    #[test]
    fn what_does_not_fit_into_a_message_is_only_announced() {
        assert!(matches!(pushed(&desired(40_000, &[]), &[]).1, Doorbell::State { .. }));
        let notice = pushed(&desired(MAX_PUSHED_ENVELOPE_BYTES, &[]), &[]).1;
        assert_eq!(notice, Doorbell::Notice { generation: Generation(12) });
    }

    #[test]
    fn blobs_ride_along_as_far_as_there_is_room() {
        let (small, large, absent) = (&[1; 1000][..], &[2; 70_000][..], &[3; 1000][..]);
        let riding = |state_bytes, riders: &[&[u8]]| {
            let (length, doorbell) = pushed(&desired(state_bytes, &[large, small, absent]), riders);
            assert!(length <= MAX_DOORBELL_BYTES, "{length}");
            let Doorbell::State { inline, .. } = doorbell else { panic!("the state fits") };
            [small, large, absent].map(|bytes| inline.get(&blob(bytes)).is_some())
        };
        assert_eq!(riding(100, &[small, large]), [true, true, false]);
        assert_eq!(riding(40_000, &[small, large]), [true, false, false]);
        assert_eq!(riding(100, &[]), [false, false, false]);
    }
}
