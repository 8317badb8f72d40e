//! Who may come in over MQTT: the broker's question, answered from the database for each connection, so that a token
//! that was revoked a moment ago no longer opens anything. A robot that comes in by a new token thereby ends its old one;
//! the session that came by that one is taken over.

use futures_util::FutureExt as _;
use futures_util::future::BoxFuture;
use task_proto::person::Permission;
use task_proto::token::Token;

use crate::broker::{Gatekeeper, Login, Principal, Refusal};
use crate::clock::Clock;
use crate::store::{Store, StoreError, TokenHolder};

/// Answers by the tokens in the database.
pub struct StoreGatekeeper {
    /// The database.
    pub store: Store,
    /// The time.
    pub clock: Clock,
}

impl StoreGatekeeper {
    async fn decide(&self, login: Login) -> Result<Principal, Refusal> {
        let password = login.password.as_deref().ok_or(Refusal::BadCredentials)?;
        let token: Token = password.parse().map_err(|_| Refusal::BadCredentials)?;
        let unchecked = |error: StoreError| {
            tracing::warn!(error = &error as &dyn std::error::Error, "a login over MQTT could not be checked");
            Refusal::Unavailable
        };
        let admitted = self.store.admit(&token, &login.proof, self.clock.now_ms()).await.map_err(unchecked)?;
        match admitted.map(|admitted| admitted.holder) {
            Some(TokenHolder::Robot { robot, token_number, .. }) => {
                let is_itself = login.client_id == robot.as_str() && login.user_name.as_deref() == Some(robot.as_str());
                if is_itself { Ok(Principal::Robot { robot, token_number }) } else { Err(Refusal::NotAuthorised) }
            }
            // Over MQTT one hears every robot, so it is not for who is limited to some.
            Some(TokenHolder::Person(person)) if person.may(Permission::Read) && person.scope.is_everything() => {
                Ok(Principal::Operator(person.name))
            }
            Some(TokenHolder::Person(_)) => Err(Refusal::NotAuthorised),
            Some(TokenHolder::Enrolment | TokenHolder::Pending { .. }) => Err(Refusal::NotAuthorised),
            None if self.store.is_of_revoked_robot(&token).await.map_err(unchecked)? => Err(Refusal::NotAuthorised),
            None => Err(Refusal::BadCredentials),
        }
    }
}

impl Gatekeeper for StoreGatekeeper {
    fn admit(&self, login: Login) -> BoxFuture<'_, Result<Principal, Refusal>> {
        self.decide(login).boxed()
    }
}
