//! The robot's token as everything that talks to the server holds it: one value, which may change
//! while the agent runs. It reads and writes no file.

use std::sync::{Arc, PoisonError, RwLock};

/// The robot's token. Clones are the same.
#[derive(Clone)]
pub struct Credential(Arc<RwLock<String>>);

impl Credential {
    /// The token that is good now.
    pub fn current(&self) -> String {
        self.0.read().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// From now on this one is.
    pub fn replace(&self, token: String) {
        *self.0.write().unwrap_or_else(PoisonError::into_inner) = token;
    }
}

impl From<String> for Credential {
    fn from(token: String) -> Self {
        Self(Arc::new(RwLock::new(token)))
    }
}
