//! Bodies of changes to many robots at once: a change applies to all matched robots, or to none.

use serde::{Deserialize, Serialize};

use crate::ids::selector::Selector;
use crate::ids::{LabelKey, Labels};

/// `POST /bulk/labels` (maintain): labels that are neither set nor removed stay. The answer is
/// `MatchedRobots`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct BulkLabels {
    /// The robots to change.
    pub selector: Selector,
    /// Labels to set on each robot; they replace labels with the same key.
    #[serde(default)]
    #[cfg_attr(feature = "openapi", schema(inline))]
    pub set: Labels,
    /// Keys of labels to remove from each robot that has them.
    #[serde(default)]
    pub remove: Vec<LabelKey>,
    /// Only list the robots that match.
    #[serde(default)]
    pub dry_run: bool,
}

/// `POST /bulk/remove` (maintain): like `DELETE /robots/{robot}` for each. The answer is
/// `MatchedRobots`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct BulkRemove {
    /// The robots to remove.
    pub selector: Selector,
    /// Only list the robots that match.
    #[serde(default)]
    pub dry_run: bool,
}
