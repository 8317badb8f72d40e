//! Bodies about how robots may come in.

use serde::{Deserialize, Serialize};

use crate::id::Labels;
use crate::{MacAddress, RobotId, RobotName, TokenId};

/// `GET /enrollment-tokens` (administer): those that are still good for something.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct EnrollmentTokenList {
    /// The newest first, at most 1,000.
    pub tokens: Vec<EnrollmentTokenView>,
}

/// An enrolment token, without its secret.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct EnrollmentTokenView {
    /// By which it is revoked.
    pub id: TokenId,
    /// The only robot that may use it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub robot: Option<RobotName>,
    /// Labels that each robot gets which uses it.
    #[serde(default)]
    #[cfg_attr(feature = "openapi", schema(inline))]
    pub labels: Labels,
    /// Enrolments left; absent: any number. With none left it is only good for one whose answer was
    /// lost.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub uses_left: Option<u64>,
    /// Whether a robot that comes by it waits to be approved.
    #[serde(default)]
    pub approval: bool,
    /// When it was made.
    pub created_at_ms: u64,
    /// When it ends.
    pub expires_at_ms: u64,
}

/// The code of a robot's refusal while it waits to be approved.
pub const AWAITS_APPROVAL: &str = "awaits_approval";

/// `GET /pending-robots` (administer): robots that wait to be approved.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct PendingRobotList {
    /// Who has waited for longest first.
    pub robots: Vec<PendingRobot>,
}

/// A robot that waits to be approved. Name, MAC and labels are what it says of itself, but for the
/// token's labels.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct PendingRobot {
    /// Its identity.
    pub id: RobotId,
    /// Its name.
    pub name: RobotName,
    /// Its MAC.
    pub mac: MacAddress,
    /// Its labels.
    #[cfg_attr(feature = "openapi", schema(inline))]
    pub labels: Labels,
    /// Since when it waits.
    pub since_ms: u64,
    /// The enrolment token it came by.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub token: Option<TokenId>,
    /// Where it came from.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub address: Option<String>,
}

/// `POST /enrollment-tokens` (administer).
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct CreateEnrollmentToken {
    /// Only for this robot, by id or name, which may register again with it.
    #[serde(default)]
    pub robot: Option<String>,
    /// How many enrolments it is good for; absent: as many as the server's setting `enrolment.uses`
    /// says.
    #[serde(default)]
    pub uses: Option<u64>,
    /// Whether it is good for any number of them; not with `uses`.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub unlimited: bool,
    /// Lifetime in seconds; the server's default is a day.
    #[serde(default)]
    pub ttl_s: Option<u64>,
    /// Labels each robot that uses it gets.
    #[serde(default)]
    #[cfg_attr(feature = "openapi", schema(inline))]
    pub labels: Labels,
    /// Whether a robot that comes by it waits to be approved, also where the server does not ask
    /// that of all.
    #[serde(default)]
    pub approval: bool,
}

/// A new enrolment token. The secret is shown this once.
#[derive(Clone, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct EnrollmentToken {
    /// The public part of it.
    pub id: String,
    /// The whole token.
    pub token: String,
    /// How many enrolments it is good for; absent: any number.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub uses_left: Option<u64>,
    /// When it ends.
    pub expires_at_ms: u64,
}
