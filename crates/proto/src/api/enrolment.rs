//! Bodies about how robots may come in.

use serde::{Deserialize, Serialize};

use crate::id::Labels;
use crate::{RobotName, TokenId};

/// `GET /enrollment-tokens` (administer): those that are still good for something.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct EnrollmentTokenList {
    /// The newest first, at most 1,000.
    pub tokens: Vec<EnrollmentTokenView>,
}

/// An enrolment token, without its secret.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct EnrollmentTokenView {
    /// By which it is revoked.
    pub id: TokenId,
    /// The only robot that may use it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub robot: Option<RobotName>,
    /// Labels that each robot gets which uses it.
    #[serde(default)]
    pub labels: Labels,
    /// Enrolments left; absent: any number. With none left it is only good for one whose answer was lost.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub uses_left: Option<u64>,
    /// When it was made.
    pub created_at_ms: u64,
    /// When it ends.
    pub expires_at_ms: u64,
}
