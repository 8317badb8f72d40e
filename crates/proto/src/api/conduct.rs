//! Bodies about robots that misbehave.

use serde::{Deserialize, Serialize};

/// What was done about robots that sent more than they may, or what they may not.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct ConductTotals {
    /// How often one was slowed.
    pub slowed: u64,
    /// How often one was cut off.
    pub cut: u64,
    /// How often one that was cut off came too early, or asked for more than it was held up for.
    pub turned_away: u64,
}
