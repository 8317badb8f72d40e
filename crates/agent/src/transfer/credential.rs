//! The robot's token, shared by all clients of the server. The value may change while the agent
//! runs. This module reads and writes no file.

use std::sync::{Arc, PoisonError, RwLock};

/// The robot's token. Clones share one value.
#[derive(Clone)]
pub struct Credential(Arc<RwLock<String>>);

impl Credential {
    pub fn current(&self) -> String {
        self.0.read().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Replaces the current token.
    pub fn replace(&self, token: String) {
        *self.0.write().unwrap_or_else(PoisonError::into_inner) = token;
    }
}

impl From<String> for Credential {
    fn from(token: String) -> Self {
        Self(Arc::new(RwLock::new(token)))
    }
}
