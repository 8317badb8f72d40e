//! The part of the HTTP API about people: users, sign-in, access tokens and the audit.

use serde::{Deserialize, Serialize};

use crate::ids::selector::Selector;
use crate::people::audit::AuditRecord;
use crate::people::roles::{Permission, Roles};
use crate::{TokenId, UserName};

/// `GET /users` (administer).
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct UserList {
    /// Sorted by name.
    pub users: Vec<UserView>,
}

/// A user as administrators see them.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct UserView {
    /// The name to sign in with.
    pub name: UserName,
    /// The user's roles.
    pub roles: Roles,
    /// Selector of the robots that the user is limited to; absent: all robots.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scope: Option<Selector>,
    /// Whether the user can sign in with a password.
    pub has_password: bool,
    /// The user's subject at the OpenID provider, prefixed by its issuer; absent: no sign-in by a
    /// provider.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub subject: Option<String>,
    /// When the user was added.
    pub created_at_ms: u64,
}

/// `POST /users` (administer).
#[derive(Clone, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct AddUser {
    /// The name to sign in with.
    pub name: UserName,
    /// The user's roles.
    pub roles: Roles,
    /// Selector of the robots that the user is limited to; absent or `*`: all robots.
    #[serde(default)]
    pub scope: Option<Selector>,
    /// The first password; without one, the user can't sign in with a password.
    #[serde(default)]
    pub password: Option<String>,
}

/// `PATCH /users/{user}` (administer): absent fields stay unchanged.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct EditUser {
    /// The new roles.
    #[serde(default)]
    pub roles: Option<Roles>,
    /// The new selector of the robots that the user is limited to; `*`: all robots.
    #[serde(default)]
    pub scope: Option<Selector>,
}

/// `PUT /users/{user}/password` (administer). Ends sessions and logins made with the old password.
#[derive(Clone, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct SetPassword {
    /// The new password.
    pub password: String,
}

/// `PUT /password` (any user): changes the caller's password. Ends sessions and logins made with
/// the old one.
#[derive(Clone, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ChangePassword {
    /// The current password.
    pub old: String,
    /// The new password.
    pub new: String,
}

/// `POST /login` (anyone): exchanges name and password for an access token.
#[derive(Clone, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct LogIn {
    /// The user's name.
    pub user: UserName,
    /// The user's password.
    pub password: String,
    /// Lifetime of the token in seconds; absent: 30 days, which is also the maximum.
    #[serde(default)]
    pub ttl_s: Option<u64>,
}

/// `POST /session` (anyone): exchanges an operator token, or a name and a password, for a cookie.
#[derive(Clone, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct SignIn {
    /// The operator token.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub token: Option<String>,
    /// The user's name, together with `password`, in place of a token.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub user: Option<UserName>,
    /// The user's password.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub password: Option<String>,
}

/// Answer to a sign-in, and `GET /session` (anyone).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct SessionView {
    /// When the caller's session ends; absent: not signed in.
    pub expires_at_ms: Option<u64>,
    /// The provider for sign-in without a password; absent: none configured.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub provider: Option<ProviderView>,
}

/// A provider that users may sign in with.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ProviderView {
    /// The provider's display name.
    pub title: String,
    /// URL that the browser must open to sign in.
    pub url: String,
}

/// `GET /me` (any person): the caller's identity and permissions.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Me {
    /// The user's name, `operator.token` for the first token.
    pub name: UserName,
    /// The roles that the token allows.
    pub roles: Roles,
    /// The permissions of these roles, one by one.
    pub permissions: Vec<Permission>,
    /// Selectors that a robot must match, all of them; empty: all robots.
    pub scope: Vec<Selector>,
    /// Id of the token in this request.
    pub token: TokenId,
}

/// Origin of a user's token.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum TokenOrigin {
    /// From the server's data directory.
    First,
    /// Made with another token.
    Token,
    /// From `taskd login`.
    Login,
    /// From signing in on the page.
    Page,
}

/// `GET /tokens` (any person): the caller's tokens; with `?all=true` (administer) those of all
/// users.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct TokenList {
    /// The newest first.
    pub tokens: Vec<TokenView>,
}

/// A user's access token, without its secret.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct TokenView {
    /// The token's id, used to revoke the token.
    pub id: TokenId,
    /// The token's user.
    pub user: UserName,
    /// The token's origin.
    pub origin: TokenOrigin,
    /// Description of the token's purpose, by its creator.
    pub title: String,
    /// The roles that the token is limited to; absent: its user's roles.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub roles: Option<Roles>,
    /// The robots that the token is limited to; absent: its user's robots.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scope: Option<Selector>,
    /// When the token was made.
    pub created_at_ms: u64,
    /// When the token expires.
    pub expires_at_ms: Option<u64>,
    /// When the token was revoked; afterwards, only the first token is listed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub revoked_at_ms: Option<u64>,
}

/// `POST /tokens` (any user who signed in with a password): creates a token with the caller's
/// permissions or fewer.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct CreateToken {
    /// The token's user; absent: the caller. A token for another user requires an administrator.
    #[serde(default)]
    pub user: Option<UserName>,
    /// Description of the token's purpose.
    #[serde(default)]
    pub title: String,
    /// The roles that the token is limited to; absent: all of its user's.
    #[serde(default)]
    pub roles: Option<Roles>,
    /// The robots that the token is limited to; absent: all of its user's.
    #[serde(default)]
    pub scope: Option<Selector>,
    /// Lifetime of the token in seconds; absent: 90 days.
    #[serde(default)]
    pub ttl_s: Option<u64>,
}

/// A new access token. The secret is shown this once.
#[derive(Clone, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct AccessToken {
    /// The public part of the token.
    pub id: TokenId,
    /// The whole token.
    pub token: String,
    /// The token's user.
    pub user: UserName,
    /// When the token expires.
    pub expires_at_ms: u64,
}

/// The query of `GET /audit` (administer). Without `after` the newest come first.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::IntoParams))]
#[serde(deny_unknown_fields)]
pub struct AuditQuery {
    /// Only entries with a higher number, the lowest first.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub after: Option<u64>,
    /// Only entries with a lower number.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub before: Option<u64>,
    /// Maximum number of entries, up to 1,000; absent: 1,000.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub limit: Option<u64>,
    /// Only actions by this actor.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub who: Option<String>,
    /// Only actions on this target.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub target: Option<String>,
    /// Only actions with this prefix, such as `robot.`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub act: Option<String>,
}

/// Answer of `GET /audit`.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct AuditPage {
    /// The matching entries.
    pub records: Vec<AuditRecord>,
    /// The number of the last entry in the log; 0 if the log is empty.
    pub last: u64,
}
