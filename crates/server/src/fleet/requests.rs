//! Pending requests to robots: each waits here for its reply, only for as long as an answer is
//! useful. Nothing is stored: the caller waits, and may repeat a request that was lost with a
//! connection.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use task_proto::RobotId;
use task_proto::envelope::Envelope;
use task_proto::id::RequestId;
use task_proto::request::{Action, Answer, Ask, MAX_TTL_MS, Outcome, Refusal, Reply, Request};
use tokio::sync::oneshot;

use crate::broker::{Broker, NotAsked};

/// Maximum pending requests to all robots together.
const MAX_UNDER_WAY: usize = 1024;

/// The reason why there is no answer.
#[derive(Debug, thiserror::Error)]
pub enum RequestError {
    /// The robot is not connected.
    #[error("the robot is not connected over MQTT, so it can't be asked")]
    NotConnected,
    /// The robot, or the server, has too many pending requests.
    #[error("too many questions are under way; try again")]
    Busy,
    /// The robot did not answer in time.
    #[error("the robot did not answer within {} s", .patience.as_secs_f64())]
    TimedOut { patience: Duration },
    /// The robot refused, with a reason.
    #[error("{}", .0.text)]
    Refused(Refusal),
    /// The request could not be serialized.
    #[error("the question can't be written")]
    Unwritable(#[from] serde_json::Error),
}

/// The pending requests; clones share them.
#[derive(Clone, Default)]
pub struct Requests {
    waiting: Arc<Mutex<HashMap<RequestId, Waiting>>>,
}

struct Waiting {
    robot: RobotId,
    reply: oneshot::Sender<Outcome>,
}

impl Requests {
    /// Sends a request to `robot` and waits for the answer, at most for `patience` or the
    /// protocol's limit.
    pub async fn ask(
        &self,
        broker: &Broker,
        robot: &RobotId,
        ask: Ask,
        patience: Duration,
    ) -> Result<Answer, RequestError> {
        let request =
            Request { id: RequestId::random(), ttl_ms: ttl_ms(patience), ask, signed: None };
        self.put(broker, robot, request, patience).await
    }

    /// Like `ask`, for a signed request that changes something.
    pub async fn act(
        &self,
        broker: &Broker,
        action: Action,
        signed: Envelope,
        patience: Duration,
    ) -> Result<Answer, RequestError> {
        let Action { robot_id, id, ask, .. } = action;
        let request = Request { id, ttl_ms: ttl_ms(patience), ask, signed: Some(signed) };
        self.put(broker, &robot_id, request, patience).await
    }

    async fn put(
        &self,
        broker: &Broker,
        robot: &RobotId,
        request: Request,
        patience: Duration,
    ) -> Result<Answer, RequestError> {
        let patience = patience.min(Duration::from_millis(MAX_TTL_MS));
        let payload = serde_json::to_vec(&request)?;
        let (place, reply) = self.expect(robot, request.id)?;
        broker.ask(robot, payload.into()).map_err(|error| match error {
            NotAsked::NotConnected => RequestError::NotConnected,
            NotAsked::Busy => RequestError::Busy,
        })?;
        let outcome = tokio::time::timeout(patience, reply).await;
        drop(place);
        match outcome {
            Ok(Ok(Outcome::Answer(answer))) => Ok(answer),
            Ok(Ok(Outcome::Refusal(refusal))) => Err(RequestError::Refused(refusal)),
            Ok(Err(_)) | Err(_) => Err(RequestError::TimedOut { patience }),
        }
    }

    /// Handles a reply from `robot`. A reply without a pending request is dropped: it is late,
    /// duplicate or forged.
    pub fn replied(&self, robot: &RobotId, reply: Reply) {
        let mut waiting = self.waiting();
        // Another robot can't answer in this robot's place, even with a guessed id.
        if waiting.get(&reply.id).is_some_and(|waiting| waiting.robot == *robot)
            && let Some(waiting) = waiting.remove(&reply.id)
        {
            // The caller may have gone.
            let _ = waiting.reply.send(reply.outcome);
        }
    }

    fn expect(
        &self,
        robot: &RobotId,
        id: RequestId,
    ) -> Result<(Place, oneshot::Receiver<Outcome>), RequestError> {
        let mut waiting = self.waiting();
        if waiting.len() >= MAX_UNDER_WAY {
            return Err(RequestError::Busy);
        }
        let (sender, receiver) = oneshot::channel();
        waiting.insert(id.clone(), Waiting { robot: robot.clone(), reply: sender });
        drop(waiting);
        Ok((Place { requests: self.clone(), id }, receiver))
    }

    fn waiting(&self) -> MutexGuard<'_, HashMap<RequestId, Waiting>> {
        // Every change under this lock is complete in itself, so a panic elsewhere leaves nothing
        // half-done.
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn ttl_ms(patience: Duration) -> u64 {
    u64::try_from(patience.as_millis()).unwrap_or(MAX_TTL_MS).min(MAX_TTL_MS)
}

/// A pending request's place. It is freed whenever the wait ends, also when the caller hangs up.
struct Place {
    requests: Requests,
    id: RequestId,
}

impl Drop for Place {
    fn drop(&mut self) {
        self.requests.waiting().remove(&self.id);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn reply(id: &RequestId, robot: &RobotId) -> Reply {
        Reply {
            robot_id: robot.clone(),
            id: id.clone(),
            outcome: Outcome::Answer(Answer::Following),
        }
    }

    #[tokio::test]
    async fn only_the_robot_that_was_asked_can_answer() {
        let requests = Requests::default();
        let (asked, other) = (RobotId::random(), RobotId::random());
        let id = RequestId::random();
        let (_place, receiver) = requests.expect(&asked, id.clone()).expect("room");
        requests.replied(&other, reply(&id, &asked));
        requests.replied(&asked, reply(&RequestId::random(), &asked));
        requests.replied(&asked, reply(&id, &asked));
        requests.replied(&asked, reply(&id, &asked));
        assert_eq!(receiver.await.expect("answered"), Outcome::Answer(Answer::Following));
    }

    #[test]
    fn places_are_bounded_and_free_again_when_nobody_waits() {
        let requests = Requests::default();
        let robot = RobotId::random();
        let places: Vec<_> = (0..MAX_UNDER_WAY)
            .map(|_| requests.expect(&robot, RequestId::random()).expect("room"))
            .collect();
        assert!(matches!(requests.expect(&robot, RequestId::random()), Err(RequestError::Busy)));
        drop(places);
        assert!(requests.waiting().is_empty());
    }
}
