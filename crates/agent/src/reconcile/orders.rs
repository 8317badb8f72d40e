//! Authenticates requests that change something. Such a request is accepted only if the server
//! signed it for this robot and this start of its agent, and only once: a broker could replay or
//! forge messages. This module never executes a request.

use std::sync::{Mutex, PoisonError};

use task_proto::RobotId;
use task_proto::envelope::PublicKey;
use task_proto::id::{InstanceId, RequestId};
use task_proto::request::{ACTION_TYPE, Action, Ask, Refusal, Request};

use crate::system::recent_set::Recent;

/// The number of executed request ids that are remembered; people send such requests one by one.
const KNOWN: usize = 10_000;

/// Verifies the requests that change something.
pub struct Orders {
    robot_id: RobotId,
    instance: InstanceId,
    server_key: PublicKey,
    done: Mutex<Recent<RequestId, KNOWN>>,
}

/// A refusal with `code` and `text`.
pub(crate) fn refusal(code: &str, text: impl Into<String>) -> Refusal {
    Refusal { code: code.to_owned(), text: text.into() }
}

impl Orders {
    /// Accepts requests signed with the key of `server_key`, for this start of the agent.
    pub fn new(robot_id: RobotId, instance: InstanceId, server_key: PublicKey) -> Self {
        Self { robot_id, instance, server_key, done: Mutex::default() }
    }

    /// The question to answer. For a request that changes something, this is the signed question.
    pub fn meant(&self, request: &Request) -> Result<Ask, Refusal> {
        if !request.ask.changes_something() {
            return Ok(request.ask.clone());
        }
        let unsigned = |text: &str| refusal("unsigned", text);
        let envelope = request.signed.as_ref();
        let envelope =
            envelope.ok_or_else(|| unsigned("the server has not signed it; it may be too old"))?;
        let payload = envelope.open(ACTION_TYPE, &self.server_key);
        let action =
            payload.ok().and_then(|payload| serde_json::from_slice::<Action>(&payload).ok());
        let action = action.ok_or_else(|| unsigned("it is not signed by this robot's server"))?;
        if action.robot_id != self.robot_id
            || action.instance != self.instance
            || action.id != request.id
        {
            return Err(unsigned(
                "it was signed for another robot, start of its agent, or question",
            ));
        }
        let mut done = self.done.lock().unwrap_or_else(PoisonError::into_inner);
        if !done.see(action.id) {
            return Err(unsigned("it was asked before"));
        }
        Ok(action.ask)
    }
}

#[cfg(test)]
mod tests {
    use task_proto::envelope::{Envelope, SigningKey};
    use task_proto::ros::Transition;

    use super::*;

    fn request(action: &Action, key: &SigningKey) -> Request {
        let payload = serde_json::to_vec(action).expect("JSON");
        let signed = Some(Envelope::seal(ACTION_TYPE, &payload, key));
        Request { id: action.id.clone(), ttl_ms: 1000, ask: action.ask.clone(), signed }
    }

    #[test]
    fn only_what_the_server_signed_for_this_start_is_done_and_once() {
        let key = SigningKey::random();
        let orders = Orders::new(RobotId::random(), InstanceId::random(), key.public_key());
        let ask = Ask::Lifecycle {
            node: "/camera".parse().expect("a name"),
            transition: Transition::Deactivate,
        };
        let action = || Action {
            robot_id: orders.robot_id.clone(),
            instance: orders.instance.clone(),
            id: RequestId::random(),
            ask: ask.clone(),
        };
        let good = request(&action(), &key);
        assert_eq!(orders.meant(&good), Ok(ask.clone()));
        let activate = Ask::Lifecycle {
            node: "/camera".parse().expect("a name"),
            transition: Transition::Activate,
        };
        let changed = Request { ask: activate, ..request(&action(), &key) };
        assert_eq!(orders.meant(&changed), Ok(ask.clone()), "what was signed counts");
        let refused = [
            good,
            Request { signed: None, ..request(&action(), &key) },
            request(&action(), &SigningKey::random()),
            request(&Action { robot_id: RobotId::random(), ..action() }, &key),
            request(&Action { instance: InstanceId::random(), ..action() }, &key),
            Request { id: RequestId::random(), ..request(&action(), &key) },
        ];
        for request in &refused {
            assert_eq!(orders.meant(request).expect_err("refused").code, "unsigned");
        }
        let look = Request { id: RequestId::random(), ttl_ms: 1000, ask: Ask::Nodes, signed: None };
        assert_eq!(orders.meant(&look), Ok(Ask::Nodes));
        assert_eq!(orders.meant(&look), Ok(Ask::Nodes));
    }
}
