//! Admission over MQTT: answers the broker from the database for each connection, so that a token
//! revoked a moment ago is no longer valid. When a robot first uses a new token, over MQTT or HTTP,
//! its old token ends. This module performs the consequences for both channels.

use std::sync::Arc;

use futures_util::FutureExt as _;
use futures_util::future::BoxFuture;
use task_proto::RobotId;
use task_proto::people::roles::Permission;
use task_proto::trust::token::Token;

use crate::broker::{Gatekeeper, Login, Principal, Refusal};
use crate::fleet::presence::Presence;
use crate::net::http_connections::HttpConnections;
use crate::orders::changes::{Change, Changes};
use crate::store::{Admitted, Store, StoreError, TokenHolder};
use crate::system::clock::Clock;

/// Decides by the tokens in the database.
pub struct StoreGatekeeper {
    store: Store,
    clock: Clock,
    presence: Arc<Presence>,
    http_connections: Arc<HttpConnections>,
    changes: Changes,
}

impl StoreGatekeeper {
    /// A gatekeeper on this database, which notifies the other parts when a robot switches to a new
    /// token.
    pub fn new(
        store: Store,
        clock: Clock,
        presence: Arc<Presence>,
        http_connections: Arc<HttpConnections>,
        changes: Changes,
    ) -> Self {
        Self { store, clock, presence, http_connections, changes }
    }

    async fn decide(&self, login: Login) -> Result<Principal, Refusal> {
        let password = login.password.as_deref().ok_or(Refusal::BadCredentials)?;
        let token: Token = password.parse().map_err(|_| Refusal::BadCredentials)?;
        let unavailable = |error: StoreError| {
            error.log("a login over MQTT could not be checked");
            Refusal::Unavailable
        };
        let admitted = self
            .store
            .tokens()
            .admit(&token, &login.proof, self.clock.now_ms())
            .await
            .map_err(unavailable)?;
        let Some(Admitted { holder, is_first_use }) = admitted else {
            let is_revoked =
                self.store.tokens().belongs_to_revoked_robot(&token).await.map_err(unavailable)?;
            return Err(if is_revoked { Refusal::NotAuthorised } else { Refusal::BadCredentials });
        };
        match holder {
            TokenHolder::Robot { robot, token_number, .. } => {
                if is_first_use {
                    announce_new_token(
                        &self.presence,
                        &self.http_connections,
                        &self.changes,
                        &robot,
                        token_number,
                    );
                }
                Ok(Principal::Robot { robot, token_number, is_first_use })
            }
            // Over MQTT a person receives all robots' messages, so a person limited to some robots
            // is refused.
            TokenHolder::Person(person)
                if person.may(Permission::Read) && person.scope.is_everything() =>
            {
                Ok(Principal::Operator(person.name))
            }
            TokenHolder::Person(_) | TokenHolder::Enrollment | TokenHolder::Pending { .. } => {
                Err(Refusal::NotAuthorised)
            }
        }
    }
}

impl Gatekeeper for StoreGatekeeper {
    fn admit(&self, login: Login) -> BoxFuture<'_, Result<Principal, Refusal>> {
        self.decide(login).boxed()
    }
}

/// The robot has used a token for the first time, which ended its other tokens. Its HTTP
/// connections are cut, no other instance can displace the robot any more, and the robot receives
/// its state. The broker ends its MQTT session.
pub fn announce_new_token(
    presence: &Presence,
    http_connections: &HttpConnections,
    changes: &Changes,
    robot: &RobotId,
    token_number: u64,
) {
    presence.end_other_instances_everywhere(robot);
    http_connections.end(robot);
    changes.end_robot_elsewhere(robot, Some(token_number));
    changes.announce(Change::Robot(robot.clone()));
    changes.notify_robots_here([robot.clone()]);
}
