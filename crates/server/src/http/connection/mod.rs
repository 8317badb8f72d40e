//! Owns connections and bodies before a route is known; never knows routes or callers.

pub mod drain;
pub mod listener;
pub(super) mod proxy;
pub mod traffic;
