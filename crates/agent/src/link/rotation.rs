//! Rotates the robot's token from time to time, so that a leaked token does not stay valid forever.
//! The new token is written to the disk before its first use, because that use invalidates the old
//! token. The old token is kept beside the new one until the new one is known to work. So after a
//! power cut at any moment, one of the two tokens in `identity.json` works.

use std::path::PathBuf;
use std::time::Duration;

use task_proto::error_chain::chain;
use tokio::time::sleep;

use crate::link::state::LinkState;
use crate::system::clock::PROGRAM_EXISTS_SINCE_MS;
use crate::system::identity::Identity;
use crate::transfer::credential::Credential;
use crate::transfer::server::{Server, ServerError};

/// Interval between checks of the token's age.
const CHECK: Duration = Duration::from_secs(3600);
/// Wait after a failed write to the disk or a failed attempt to use the new token.
const RETRY: Duration = Duration::from_secs(60);

/// Task that replaces the token.
pub struct Rotation {
    /// Client for requests to the server.
    pub server: Server,
    /// The token shared by all other users of the server.
    pub credential: Credential,
    /// The robot's identity, with its tokens.
    pub identity: Identity,
    /// File of the identity.
    pub path: PathBuf,
    /// Age at which a token is replaced.
    pub lifetime: Duration,
}

impl Rotation {
    /// Rotates the token until the agent ends.
    pub async fn run(mut self, link_state: LinkState, wall_ms: impl Fn() -> u64) {
        // Random wait: robots that were enrolled together must not ask together.
        let mut wait =
            if self.identity.next_token.is_some() { Duration::ZERO } else { spread(CHECK) };
        loop {
            tokio::select! {
                // Cancel-safe: the timer is recreated on each iteration.
                () = sleep(wait) => {}
                // Cancel-safe: a permit that was not taken stays.
                () = link_state.token_refused.notified(), if self.identity.next_token.is_some() => {}
                // Cancel-safe: a token can be awaited again.
                () = link_state.shutdown.cancelled() => return,
            }
            // A request dropped at the agent's end is repeated after the next start.
            wait = tokio::select! {
                wait = self.step(wall_ms()) => wait,
                () = link_state.shutdown.cancelled() => return,
            };
        }
    }

    /// Performs the step due at `wall_ms` by the robot's clock. Returns the wait until the next
    /// step.
    pub async fn step(&mut self, wall_ms: u64) -> Duration {
        if self.identity.next_token.is_some() {
            return self.switch_token(wall_ms).await;
        }
        // The clock was ahead when the token was issued: restart the token's age.
        if (PROGRAM_EXISTS_SINCE_MS..self.identity.token_since_ms).contains(&wall_ms) {
            self.store_identity(Identity { token_since_ms: wall_ms, ..self.identity.clone() });
        }
        let age_ms = wall_ms.saturating_sub(self.identity.token_since_ms);
        if u128::from(age_ms) < self.lifetime.as_millis() {
            return spread(CHECK);
        }
        match self.server.next_token().await {
            Ok(token) => {
                let identity = Identity { next_token: Some(token), ..self.identity.clone() };
                if self.store_identity(identity) { Duration::ZERO } else { spread(RETRY) }
            }
            Err(error) => {
                tracing::info!(error = %chain(&error), "cannot get a new token");
                spread(CHECK)
            }
        }
    }

    /// Uses the prepared token. The server's answer shows whether the token is valid.
    async fn switch_token(&mut self, wall_ms: u64) -> Duration {
        let Some(next) = self.identity.next_token.clone() else { return Duration::ZERO };
        match self.server.with_token(next.clone()).desired(None).await {
            Ok(_) | Err(ServerError::Refused { .. }) => {
                self.credential.replace(next.clone());
                let identity = Identity {
                    token: next,
                    next_token: None,
                    token_since_ms: wall_ms,
                    ..self.identity.clone()
                };
                if !self.store_identity(identity) {
                    return spread(RETRY);
                }
                tracing::info!("switched to a new token");
                spread(CHECK)
            }
            Err(ServerError::TokenRefused(_)) => {
                tracing::info!("the server does not accept the new token");
                // The prepared token was issued in vain, so the next one is not urgent.
                let identity =
                    Identity { next_token: None, token_since_ms: wall_ms, ..self.identity.clone() };
                if self.store_identity(identity) { spread(CHECK) } else { spread(RETRY) }
            }
            Err(error) => {
                tracing::info!(error = %chain(&error), "the new token could not be tried");
                spread(RETRY)
            }
        }
    }

    /// Writes the identity, unless the robot was registered anew meanwhile. That new identity must
    /// not be overwritten.
    fn store_identity(&mut self, identity: Identity) -> bool {
        let is_another = |known: Identity| {
            known.robot_id != identity.robot_id || known.token != self.identity.token
        };
        if Identity::read(&self.path).is_ok_and(is_another) {
            tracing::warn!("this robot was registered again: restart the agent");
            return false;
        }
        match identity.write(&self.path) {
            Ok(()) => self.identity = identity,
            Err(error) => {
                tracing::warn!(error = %chain(&error), "cannot store the token");
                return false;
            }
        }
        true
    }
}

/// Random duration between half of `time` and all of `time`.
fn spread(time: Duration) -> Duration {
    time.mul_f64(0.5 + 0.5 * rand::random::<f64>())
}
