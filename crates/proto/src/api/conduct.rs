//! Bodies about robots that misbehave.

use serde::{Deserialize, Serialize};

/// Measures against robots that exceeded their limits or sent forbidden messages.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct ConductTotals {
    /// Number of times that a robot was slowed down.
    pub slowed: u64,
    /// Number of times that a robot was disconnected.
    pub cut: u64,
    /// Number of times that a disconnected robot came back too early, or asked for more than it was
    /// held up for.
    pub turned_away: u64,
}
