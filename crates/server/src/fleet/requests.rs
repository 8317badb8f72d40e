//! Questions to robots that are under way: each waits here for its reply, for as long as an answer
//! is of use and no longer. Nothing is stored: who asks waits, and a question lost with a
//! connection is asked again by whoever wants to.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use task_proto::RobotId;
use task_proto::envelope::Envelope;
use task_proto::id::RequestId;
use task_proto::request::{Action, Answer, Ask, MAX_TTL_MS, Outcome, Refusal, Reply, Request};
use tokio::sync::oneshot;

use crate::broker::{Broker, NotAsked};

/// Questions under way at a time, to all robots together.
const MAX_UNDER_WAY: usize = 1024;

/// Why there is no answer.
#[derive(Debug, thiserror::Error)]
pub enum RequestError {
    /// The robot is not there to be asked.
    #[error("the robot is not connected over MQTT, so it can't be asked")]
    NotConnected,
    /// It, or the server, has enough to answer already.
    #[error("too many questions are under way; try again")]
    Busy,
    /// It said nothing in time.
    #[error("the robot did not answer within {} s", .patience.as_secs_f64())]
    TimedOut {
        /// How long it had.
        patience: Duration,
    },
    /// It said why not.
    #[error("{}", .0.text)]
    Refused(Refusal),
    /// The question could not be written.
    #[error("the question can't be written")]
    Unwritable(#[from] serde_json::Error),
}

/// The questions under way; clones share them.
#[derive(Clone, Default)]
pub struct Requests {
    waiting: Arc<Mutex<HashMap<RequestId, Waiting>>>,
}

struct Waiting {
    robot: RobotId,
    reply: oneshot::Sender<Outcome>,
}

impl Requests {
    /// Asks `robot` and waits for the answer, at most for `patience` or what the protocol allows.
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

    /// The same for what changes something, as it was signed.
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

    /// A reply came from `robot`. One that nobody waits for is dropped: it is late, doubled or made
    /// up.
    pub fn replied(&self, robot: &RobotId, reply: Reply) {
        let mut waiting = self.waiting();
        // Another robot can't answer in this one's place, even if it guessed the id.
        if waiting.get(&reply.id).is_some_and(|waiting| waiting.robot == *robot)
            && let Some(waiting) = waiting.remove(&reply.id)
        {
            // Whoever asked may have gone.
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

/// Keeps a question's place; it is free again however the wait ends, also when whoever asked hangs
/// up.
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
