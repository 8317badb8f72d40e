//! Bodies of what is done to many robots at once: it is done to all that are meant, or to none.

use serde::{Deserialize, Serialize};

use crate::id::{LabelKey, Labels};
use crate::selector::Selector;

/// `POST /bulk/labels` (maintain): what is neither set nor removed stays. The answer is
/// [`super::MatchedRobots`].
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct BulkLabels {
    /// Which robots.
    pub selector: Selector,
    /// Labels that each gets, in the place of what it has under the same key.
    #[serde(default)]
    #[cfg_attr(feature = "openapi", schema(inline))]
    pub set: Labels,
    /// Keys of labels that each loses, if it has them.
    #[serde(default)]
    pub remove: Vec<LabelKey>,
    /// Only say which robots it would be.
    #[serde(default)]
    pub dry_run: bool,
}

/// `POST /bulk/remove` (maintain): like `DELETE /robots/{robot}` for each. The answer is
/// [`super::MatchedRobots`].
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct BulkRemove {
    /// Which robots.
    pub selector: Selector,
    /// Only say which robots it would be.
    #[serde(default)]
    pub dry_run: bool,
}
