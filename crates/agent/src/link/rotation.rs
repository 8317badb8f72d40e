//! Goes over to a new token now and then, so that one that leaked is not good for ever. A new token
//! is on the disk before it is used, for its first use ends the old one; until that is seen to have
//! worked the old one is kept beside it. So whenever the power goes, one of the two in
//! `identity.json` works.

use std::path::PathBuf;
use std::time::Duration;

use tokio::time::sleep;

use crate::link::state::Shared;
use crate::system::clock::PROGRAM_EXISTS_SINCE_MS;
use crate::system::error_chain::chain;
use crate::system::identity::Identity;
use crate::transfer::credential::Credential;
use crate::transfer::server::{Server, ServerError};

/// How often the token's age is looked at.
const CHECK: Duration = Duration::from_secs(3600);
/// How long to wait when the server could not be asked, or the disk not written.
const RETRY: Duration = Duration::from_secs(60);

/// What goes over from one token to the next.
pub struct Rotation {
    /// The server.
    pub server: Server,
    /// What everything else talks to the server with.
    pub credential: Credential,
    /// Who the robot is.
    pub identity: Identity,
    /// Where that is written.
    pub path: PathBuf,
    /// The age at which a token is replaced.
    pub lifetime: Duration,
}

impl Rotation {
    /// Looks after the token until the agent ends.
    pub async fn run(mut self, shared: Shared, wall_ms: impl Fn() -> u64) {
        // A fleet that was enrolled together does not ask together.
        let mut wait =
            if self.identity.next_token.is_some() { Duration::ZERO } else { spread(CHECK) };
        loop {
            tokio::select! {
                // Cancel-safe: a timer that is made anew each time.
                () = sleep(wait) => {}
                // Cancel-safe: a permit that was not taken stays.
                () = shared.token_refused.notified(), if self.identity.next_token.is_some() => {}
                // Cancel-safe: a token can be awaited again.
                () = shared.shutdown.cancelled() => return,
            }
            // A request that is dropped at the agent's end is repeated after its start.
            wait = tokio::select! {
                wait = self.step(wall_ms()) => wait,
                () = shared.shutdown.cancelled() => return,
            };
        }
    }

    /// Does what is due at `wall_ms` by the robot's clock, and says when to look again.
    pub async fn step(&mut self, wall_ms: u64) -> Duration {
        if self.identity.next_token.is_some() {
            return self.go_over(wall_ms).await;
        }
        // The clock was ahead when the token came: it begins anew.
        if (PROGRAM_EXISTS_SINCE_MS..self.identity.token_since_ms).contains(&wall_ms) {
            self.keep(Identity { token_since_ms: wall_ms, ..self.identity.clone() });
        }
        let age_ms = wall_ms.saturating_sub(self.identity.token_since_ms);
        if u128::from(age_ms) < self.lifetime.as_millis() {
            return spread(CHECK);
        }
        match self.server.next_token().await {
            Ok(token) => {
                let identity = Identity { next_token: Some(token), ..self.identity.clone() };
                if self.keep(identity) { Duration::ZERO } else { spread(RETRY) }
            }
            Err(error) => {
                tracing::info!(error = %chain(&error), "no new token");
                spread(CHECK)
            }
        }
    }

    /// Uses the token that lies ready. The server's answer says whether it is good.
    async fn go_over(&mut self, wall_ms: u64) -> Duration {
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
                if !self.keep(identity) {
                    return spread(RETRY);
                }
                tracing::info!("went over to a new token");
                spread(CHECK)
            }
            Err(ServerError::TokenRefused(_)) => {
                tracing::info!("the server does not accept the token that lay ready");
                // With one that was made for nothing there is no hurry to ask for another.
                let identity =
                    Identity { next_token: None, token_since_ms: wall_ms, ..self.identity.clone() };
                if self.keep(identity) { spread(CHECK) } else { spread(RETRY) }
            }
            Err(error) => {
                tracing::info!(error = %chain(&error), "the new token could not be tried");
                spread(RETRY)
            }
        }
    }

    /// Writes the identity, unless somebody registered the robot anew meanwhile: that must not be
    /// lost.
    fn keep(&mut self, identity: Identity) -> bool {
        let is_another = |known: Identity| {
            known.robot_id != identity.robot_id || known.token != self.identity.token
        };
        if Identity::read(&self.path).is_ok_and(is_another) {
            tracing::warn!("this robot was registered anew: restart the agent");
            return false;
        }
        match identity.write(&self.path) {
            Ok(()) => self.identity = identity,
            Err(error) => {
                tracing::warn!(error = %chain(&error), "the token can't be written down");
                return false;
            }
        }
        true
    }
}

/// Between half of it and all of it.
fn spread(time: Duration) -> Duration {
    time.mul_f64(0.5 + 0.5 * rand::random::<f64>())
}
