//! Authenticates requests that change something. Such a request is accepted only if the server
//! signed it for this robot and this start of its agent, and only once: a broker could replay or
//! forge messages. This module never executes a request.

use std::sync::{Mutex, PoisonError};

use task_proto::RobotId;
use task_proto::ids::{InstanceId, RequestId};
use task_proto::messages::request::{ACTION_TYPE, Action, Ask, Refusal, Request};
use task_proto::trust::envelope::PublicKey;

use crate::system::recent_set::RecentSet;

/// The number of executed request ids that are remembered; people send such requests one by one.
const MAX_REMEMBERED: usize = 10_000;

/// Verifies the requests that change something.
pub struct RequestVerifier {
    robot_id: RobotId,
    instance: InstanceId,
    server_key: PublicKey,
    done: Mutex<RecentSet<RequestId, MAX_REMEMBERED>>,
}

/// A refusal with `code` and `text`.
pub(crate) fn refusal(code: &str, text: impl Into<String>) -> Refusal {
    Refusal { code: code.to_owned(), text: text.into() }
}

impl RequestVerifier {
    /// Accepts requests signed with the key of `server_key`, for this start of the agent.
    pub fn new(robot_id: RobotId, instance: InstanceId, server_key: PublicKey) -> Self {
        Self { robot_id, instance, server_key, done: Mutex::default() }
    }

    /// The question to answer. For a request that changes something, this is the signed question.
    pub fn verify(&self, request: &Request) -> Result<Ask, Refusal> {
        if !request.ask.changes_something() {
            return Ok(request.ask.clone());
        }
        let unsigned = |text: &str| refusal("unsigned", text);
        let envelope = request.signed.as_ref();
        let envelope = envelope
            .ok_or_else(|| unsigned("the server did not sign it; the server may be too old"))?;
        let payload = envelope.open(ACTION_TYPE, &self.server_key);
        let action =
            payload.ok().and_then(|payload| serde_json::from_slice::<Action>(&payload).ok());
        let action = action.ok_or_else(|| unsigned("it is not signed by this robot's server"))?;
        if action.robot_id != self.robot_id
            || action.instance != self.instance
            || action.id != request.id
        {
            return Err(unsigned("it was signed for another robot, agent start or request"));
        }
        let mut done = self.done.lock().unwrap_or_else(PoisonError::into_inner);
        if !done.insert(action.id) {
            return Err(unsigned("it was already used"));
        }
        Ok(action.ask)
    }
}

#[cfg(test)]
mod tests {
    use task_proto::telemetry::ros::Transition;
    use task_proto::trust::envelope::{Envelope, SigningKey};

    use super::*;

    fn request(action: &Action, key: &SigningKey) -> Request {
        let payload = serde_json::to_vec(action).expect("JSON");
        let signed = Some(Envelope::seal(ACTION_TYPE, &payload, key));
        Request { id: action.id.clone(), ttl_ms: 1000, ask: action.ask.clone(), signed }
    }

    #[test]
    fn request_runs_only_if_signed_for_this_start_and_only_once() {
        let key = SigningKey::random();
        let verifier =
            RequestVerifier::new(RobotId::random(), InstanceId::random(), key.public_key());
        let ask = Ask::Lifecycle {
            node: "/camera".parse().expect("a name"),
            transition: Transition::Deactivate,
        };
        let action = || Action {
            robot_id: verifier.robot_id.clone(),
            instance: verifier.instance.clone(),
            id: RequestId::random(),
            ask: ask.clone(),
        };
        let good = request(&action(), &key);
        assert_eq!(verifier.verify(&good), Ok(ask.clone()));
        let activate = Ask::Lifecycle {
            node: "/camera".parse().expect("a name"),
            transition: Transition::Activate,
        };
        let changed = Request { ask: activate, ..request(&action(), &key) };
        assert_eq!(verifier.verify(&changed), Ok(ask.clone()), "the signed question counts");
        let refused = [
            good,
            Request { signed: None, ..request(&action(), &key) },
            request(&action(), &SigningKey::random()),
            request(&Action { robot_id: RobotId::random(), ..action() }, &key),
            request(&Action { instance: InstanceId::random(), ..action() }, &key),
            Request { id: RequestId::random(), ..request(&action(), &key) },
        ];
        for request in &refused {
            assert_eq!(verifier.verify(request).expect_err("refused").code, "unsigned");
        }
        let look = Request { id: RequestId::random(), ttl_ms: 1000, ask: Ask::Nodes, signed: None };
        assert_eq!(verifier.verify(&look), Ok(Ask::Nodes));
        assert_eq!(verifier.verify(&look), Ok(Ask::Nodes));
    }
}
