//! Pending requests to robots: each waits here for its reply, only for as long as an answer is
//! useful. Nothing is stored: the caller waits, and may repeat a request that was lost with a
//! connection.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use task_proto::RobotId;
use task_proto::ids::RequestId;
use task_proto::messages::request::{
    Action, Answer, Ask, MAX_TTL_MS, Outcome, Refusal, Reply, Request,
};
use task_proto::time::millis;
use task_proto::trust::envelope::Envelope;
use tokio::sync::oneshot;

use crate::broker::{Broker, NotSent};

/// Maximum pending requests to all robots together.
const MAX_PENDING: usize = 1024;

/// The reason why there is no answer.
#[derive(Debug, thiserror::Error)]
pub enum RequestError {
    /// The robot is not connected.
    #[error("the robot is not connected over MQTT, so it can't be asked")]
    NotConnected,
    /// The robot, or the server, has too many pending requests.
    #[error("too many requests are pending; try again")]
    Busy,
    /// The robot did not answer in time.
    #[error("the robot did not answer within {} s", .timeout.as_secs_f64())]
    TimedOut { timeout: Duration },
    /// The robot refused, with a reason.
    #[error("{}", .0.text)]
    Refused(Refusal),
    /// The request could not be serialized.
    #[error("the request can't be serialized")]
    Unserializable(#[from] serde_json::Error),
}

/// The pending requests; clones share them.
#[derive(Clone, Default)]
pub struct Requests {
    pending: Arc<Mutex<HashMap<RequestId, ReplySlot>>>,
}

struct ReplySlot {
    robot: RobotId,
    reply: oneshot::Sender<Outcome>,
}

impl Requests {
    /// Sends a request to `robot` and waits for the answer, at most for `timeout` or the
    /// protocol's limit.
    pub async fn send(
        &self,
        broker: &Broker,
        robot: &RobotId,
        ask: Ask,
        timeout: Duration,
    ) -> Result<Answer, RequestError> {
        let request =
            Request { id: RequestId::random(), ttl_ms: ttl_ms(timeout), ask, signed: None };
        self.deliver(broker, robot, request, timeout).await
    }

    /// Like `ask`, for a signed request that changes something.
    pub async fn send_signed(
        &self,
        broker: &Broker,
        action: Action,
        signed: Envelope,
        timeout: Duration,
    ) -> Result<Answer, RequestError> {
        let Action { robot_id, id, ask, .. } = action;
        let request = Request { id, ttl_ms: ttl_ms(timeout), ask, signed: Some(signed) };
        self.deliver(broker, &robot_id, request, timeout).await
    }

    async fn deliver(
        &self,
        broker: &Broker,
        robot: &RobotId,
        request: Request,
        timeout: Duration,
    ) -> Result<Answer, RequestError> {
        let timeout = timeout.min(Duration::from_millis(MAX_TTL_MS));
        let payload = serde_json::to_vec(&request)?;
        let (pending_request, reply) = self.register(robot, request.id)?;
        broker.send_request(robot, payload.into()).map_err(|error| match error {
            NotSent::NotConnected => RequestError::NotConnected,
            NotSent::Busy => RequestError::Busy,
        })?;
        let outcome = tokio::time::timeout(timeout, reply).await;
        drop(pending_request);
        match outcome {
            Ok(Ok(Outcome::Answer(answer))) => Ok(answer),
            Ok(Ok(Outcome::Refusal(refusal))) => Err(RequestError::Refused(refusal)),
            Ok(Err(_)) | Err(_) => Err(RequestError::TimedOut { timeout }),
        }
    }

    /// Handles a reply from `robot`. A reply without a pending request is dropped: it is late,
    /// duplicate or forged.
    pub fn handle_reply(&self, robot: &RobotId, reply: Reply) {
        let mut pending = self.pending();
        // Another robot can't answer in this robot's place, even with a guessed id.
        if pending.get(&reply.id).is_some_and(|pending| pending.robot == *robot)
            && let Some(pending) = pending.remove(&reply.id)
        {
            // The caller may have gone.
            let _ = pending.reply.send(reply.outcome);
        }
    }

    fn register(
        &self,
        robot: &RobotId,
        id: RequestId,
    ) -> Result<(PendingRequest, oneshot::Receiver<Outcome>), RequestError> {
        let mut pending = self.pending();
        if pending.len() >= MAX_PENDING {
            return Err(RequestError::Busy);
        }
        let (sender, receiver) = oneshot::channel();
        pending.insert(id.clone(), ReplySlot { robot: robot.clone(), reply: sender });
        drop(pending);
        Ok((PendingRequest { requests: self.clone(), id }, receiver))
    }

    fn pending(&self) -> MutexGuard<'_, HashMap<RequestId, ReplySlot>> {
        // Every change under this lock is complete in itself, so a panic elsewhere leaves nothing
        // half-done.
        self.pending.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn ttl_ms(timeout: Duration) -> u64 {
    millis(timeout).min(MAX_TTL_MS)
}

/// Guards a pending request. Its entry is removed whenever the wait ends, also when the caller
/// hangs up.
struct PendingRequest {
    requests: Requests,
    id: RequestId,
}

impl Drop for PendingRequest {
    fn drop(&mut self) {
        self.requests.pending().remove(&self.id);
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
        let (_pending_request, receiver) = requests.register(&asked, id.clone()).expect("room");
        requests.handle_reply(&other, reply(&id, &asked));
        requests.handle_reply(&asked, reply(&RequestId::random(), &asked));
        requests.handle_reply(&asked, reply(&id, &asked));
        requests.handle_reply(&asked, reply(&id, &asked));
        assert_eq!(receiver.await.expect("answered"), Outcome::Answer(Answer::Following));
    }

    #[test]
    fn pending_requests_are_bounded_and_freed_on_drop() {
        let requests = Requests::default();
        let robot = RobotId::random();
        let pending: Vec<_> = (0..MAX_PENDING)
            .map(|_| requests.register(&robot, RequestId::random()).expect("room"))
            .collect();
        assert!(matches!(requests.register(&robot, RequestId::random()), Err(RequestError::Busy)));
        drop(pending);
        assert!(requests.pending().is_empty());
    }
}
