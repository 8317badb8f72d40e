//! Tells robots of their desired state: the whole signed document where it fits into a message, else only its
//! generation. A robot that can't be reached is no error, for both sides compare again when it connects.

use std::sync::Arc;

use bytes::Bytes;
use task_proto::RobotId;
use task_proto::desired::{Doorbell, Inline, MAX_PUSHED_ENVELOPE_BYTES};
use tokio_util::sync::CancellationToken;

use crate::actions::{Actions, Desired};
use crate::broker::Broker;
use crate::changes::{Changes, Rings};
use crate::clock::Clock;
use crate::presence::Presence;

/// States read in one go and signed without a pause.
const AT_ONCE: usize = 64;

/// What ringing needs.
pub struct Downlink {
    /// Where desired states come from.
    pub actions: Actions,
    /// Who delivers them.
    pub broker: Broker,
    /// Who is there.
    pub presence: Arc<Presence>,
    /// The time.
    pub clock: Clock,
}

impl Downlink {
    /// Rings whoever `changes` names, until `stop`.
    pub async fn run(self, changes: Changes, stop: CancellationToken) {
        let ringing = async {
            loop {
                let mut robots = self.who(changes.take_rings().await).await;
                robots.retain(|robot| self.is_to_be_told(robot));
                for robots in robots.chunks(AT_ONCE) {
                    self.broker.room().await;
                    self.ring(robots).await;
                }
            }
        };
        // Cut off half-way, the rest is rung on its next connect.
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

    fn is_to_be_told(&self, robot: &RobotId) -> bool {
        self.broker.may_reach(robot) && !self.presence.is_duplicate(robot, self.clock.now_ms())
    }

    async fn ring(&self, robots: &[RobotId]) {
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
            match payload(&desired) {
                // It may have left meanwhile.
                Ok(payload) => drop(self.broker.ring(&robot, payload)),
                Err(error) => tracing::error!(%robot, %error, "a desired state could not be written"),
            }
        }
    }
}

fn payload(desired: &Desired) -> Result<Bytes, serde_json::Error> {
    let whole = serde_json::to_vec(&Doorbell::State { envelope: desired.envelope.clone(), inline: Inline::default() })?;
    if whole.len() <= MAX_PUSHED_ENVELOPE_BYTES {
        return Ok(whole.into());
    }
    serde_json::to_vec(&Doorbell::Notice { generation: desired.generation }).map(Bytes::from)
}

#[cfg(test)]
mod tests {
    use super::*;
    use task_proto::Generation;
    use task_proto::envelope::{DESIRED_STATE_TYPE, Envelope, SigningKey};

    #[test]
    fn what_does_not_fit_into_a_message_is_only_announced() {
        let key = SigningKey::from_bytes([7; 32]);
        let desired = |bytes: usize| Desired {
            generation: Generation(12),
            envelope: Envelope::seal(DESIRED_STATE_TYPE, &vec![b' '; bytes], &key),
        };
        let parsed = |desired: &Desired| serde_json::from_slice::<Doorbell>(&payload(desired).expect("json"));
        assert!(matches!(parsed(&desired(40_000)).expect("json"), Doorbell::State { .. }));
        let notice = parsed(&desired(MAX_PUSHED_ENVELOPE_BYTES)).expect("json");
        assert_eq!(notice, Doorbell::Notice { generation: Generation(12) });
    }
}
