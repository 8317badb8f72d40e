//! Bodies about the enrollment and the tokens of robots.

use serde::{Deserialize, Serialize};

use crate::api::MqttEndpoint;
use crate::ids::Labels;
use crate::trust::envelope::PublicKey;
use crate::{MacAddress, RobotId, RobotName, TokenId};

/// `POST /enroll` (enrollment token).
#[derive(Debug, Clone, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct EnrollRequest {
    /// The robot's MAC address: its identity for people.
    pub mac: MacAddress,
    /// The robot's name; the server derives one from the MAC if absent.
    #[serde(default)]
    pub name: Option<RobotName>,
    /// The robot's labels.
    #[serde(default)]
    #[cfg_attr(feature = "openapi", schema(inline))]
    pub labels: Labels,
    /// The public key that the robot can prove by a client certificate.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub client_key: Option<PublicKey>,
}

/// Answer to an enrollment. The token is shown this once.
#[derive(Clone, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct EnrollResponse {
    /// The robot's new identity.
    pub robot_id: RobotId,
    /// The robot's name as registered.
    pub name: RobotName,
    /// The robot's bearer token and MQTT password.
    pub token: String,
    /// The MQTT endpoint to connect to.
    pub mqtt: MqttEndpoint,
    /// Whether the robot awaits approval: until approved, every request is refused with the code
    /// [`AWAITS_APPROVAL`].
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub awaits_approval: bool,
}

/// Answer to a robot's `POST /robots/{robot}/token`. The token is shown this once; its first use
/// revokes the previous token.
#[derive(Clone, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct RobotToken {
    /// The robot's next bearer token and MQTT password.
    pub token: String,
}

/// `GET /enrollment-tokens` (administer): the tokens that can still be used.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct EnrollmentTokenList {
    /// The newest first, at most 1,000.
    pub tokens: Vec<EnrollmentTokenView>,
}

/// An enrollment token, without its secret.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct EnrollmentTokenView {
    /// The token's id, used to revoke the token.
    pub id: TokenId,
    /// The only robot that may use it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub robot: Option<RobotName>,
    /// Labels of each robot that enrolls with this token.
    #[serde(default)]
    #[cfg_attr(feature = "openapi", schema(inline))]
    pub labels: Labels,
    /// Enrollments left; absent: any number. With none left, the token only serves a robot that
    /// retries because the answer was lost.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub uses_left: Option<u64>,
    /// Whether a robot that enrolls with this token must be approved.
    #[serde(default)]
    pub approval: bool,
    /// When the token was made.
    pub created_at_ms: u64,
    /// When the token expires.
    pub expires_at_ms: u64,
}

/// Code of the refusal that a robot receives while it awaits approval.
pub const AWAITS_APPROVAL: &str = "awaits_approval";

/// `GET /pending-robots` (administer): robots that await approval.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct PendingRobotList {
    /// Sorted by waiting time, the longest first.
    pub robots: Vec<PendingRobot>,
}

/// A robot that awaits approval. Name, MAC and labels are the robot's own claims, except the labels
/// from the token.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct PendingRobot {
    /// The robot's identity.
    pub id: RobotId,
    /// The robot's name.
    pub name: RobotName,
    /// The robot's MAC address.
    pub mac: MacAddress,
    /// The robot's labels.
    #[cfg_attr(feature = "openapi", schema(inline))]
    pub labels: Labels,
    /// When the wait began.
    pub since_ms: u64,
    /// The enrollment token that the robot used.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub token: Option<TokenId>,
    /// The address that the robot enrolled from.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub address: Option<String>,
}

/// `POST /enrollment-tokens` (administer).
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct CreateEnrollmentToken {
    /// The only robot that may use the token, by id or name; a known robot may register again with
    /// it.
    #[serde(default)]
    pub robot: Option<String>,
    /// Number of enrollments allowed; absent: the server's setting `enrolment.uses`.
    #[serde(default)]
    pub uses: Option<u64>,
    /// Whether the number of enrollments is unlimited; excludes `uses`.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub unlimited: bool,
    /// Lifetime in seconds; the server's default is a day.
    #[serde(default)]
    pub ttl_s: Option<u64>,
    /// Labels of each robot that enrolls with this token.
    #[serde(default)]
    #[cfg_attr(feature = "openapi", schema(inline))]
    pub labels: Labels,
    /// Whether a robot that enrolls with this token must be approved, even if the server does not
    /// require approval of all robots.
    #[serde(default)]
    pub approval: bool,
}

/// A new enrollment token. The secret is shown this once.
#[derive(Clone, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct EnrollmentToken {
    /// The public part of the token.
    pub id: String,
    /// The whole token.
    pub token: String,
    /// Number of enrollments left; absent: any number.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub uses_left: Option<u64>,
    /// When the token expires.
    pub expires_at_ms: u64,
}
