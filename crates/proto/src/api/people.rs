//! The part of the HTTP API that is about people: who they are, how they sign in, their tokens, and
//! what they did.

use serde::{Deserialize, Serialize};

use crate::audit::AuditRecord;
use crate::person::{Permission, Roles};
use crate::selector::Selector;
use crate::{TokenId, UserName};

/// `GET /users` (administer).
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct UserList {
    /// Sorted by name.
    pub users: Vec<UserView>,
}

/// A person as an administrator sees them.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct UserView {
    /// What they sign in with.
    pub name: UserName,
    /// What they may do.
    pub roles: Roles,
    /// To which robots they are limited; absent: to none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scope: Option<Selector>,
    /// Whether they can sign in with a password.
    pub has_password: bool,
    /// Who they are at the provider by which they sign in, behind its issuer; absent: they don't.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub subject: Option<String>,
    /// When they were added.
    pub created_at_ms: u64,
}

/// `POST /users` (administer).
#[derive(Clone, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct AddUser {
    /// What they sign in with.
    pub name: UserName,
    /// What they may do.
    pub roles: Roles,
    /// To which robots they are limited; absent or `*`: to none.
    #[serde(default)]
    pub scope: Option<Selector>,
    /// Their first password; without one they can't sign in by a password.
    #[serde(default)]
    pub password: Option<String>,
}

/// `PATCH /users/{user}` (administer): absent fields stay.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct EditUser {
    /// What they may do from now on.
    #[serde(default)]
    pub roles: Option<Roles>,
    /// To which robots they are limited from now on; `*`: to none.
    #[serde(default)]
    pub scope: Option<Selector>,
}

/// `PUT /users/{user}/password` (administer). Ends what was signed in with the old one.
#[derive(Clone, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct SetPassword {
    /// The new one.
    pub password: String,
}

/// `PUT /password` (any user): one's own. Ends what was signed in with the old one.
#[derive(Clone, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ChangePassword {
    /// The one there is.
    pub old: String,
    /// The new one.
    pub new: String,
}

/// `POST /login` (anyone): exchanges name and password for an access token.
#[derive(Clone, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct LogIn {
    /// Who.
    pub user: UserName,
    /// Their password.
    pub password: String,
    /// How long it should live, in seconds; absent: 30 days, which is also the most.
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
    /// Or who,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub user: Option<UserName>,
    /// with their password.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub password: Option<String>,
}

/// Answer to a sign-in, and `GET /session` (anyone).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct SessionView {
    /// When the caller's session ends; absent: not signed in.
    pub expires_at_ms: Option<u64>,
    /// Another way to sign in than with a password; absent: there is none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub provider: Option<ProviderView>,
    /// The caller was signed in until the server was restarted, which ends all sessions.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub ended_by_restart: bool,
}

/// A provider by which people may sign in.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ProviderView {
    /// What it is called.
    pub title: String,
    /// Where the browser has to go.
    pub url: String,
}

/// `GET /me` (any person): who the caller is and what they may.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Me {
    /// The user's name, `operator.token` for the first token.
    pub name: UserName,
    /// What the token allows.
    pub roles: Roles,
    /// The same, one by one.
    pub permissions: Vec<Permission>,
    /// The selectors that a robot has to match, every one; none: all robots.
    pub scope: Vec<Selector>,
    /// The token that was shown.
    pub token: TokenId,
}

/// Where a person's token came from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum TokenOrigin {
    /// From the server's data directory.
    First,
    /// It was made with another.
    Token,
    /// From `taskd login`.
    Login,
    /// From signing in at the page.
    Page,
}

/// `GET /tokens` (any person): one's own; with `?all=true` (administer) everybody's.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct TokenList {
    /// The newest first.
    pub tokens: Vec<TokenView>,
}

/// A person's access token, without its secret.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct TokenView {
    /// By which it is revoked.
    pub id: TokenId,
    /// Whose it is.
    pub user: UserName,
    /// Where it came from.
    pub origin: TokenOrigin,
    /// What it is for, in its maker's words.
    pub title: String,
    /// The roles it is limited to; absent: its user's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub roles: Option<Roles>,
    /// The robots it is limited to; absent: its user's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scope: Option<Selector>,
    /// When it was made.
    pub created_at_ms: u64,
    /// When it ends.
    pub expires_at_ms: Option<u64>,
    /// When it was revoked; only the first token is listed after that.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub revoked_at_ms: Option<u64>,
}

/// `POST /tokens` (any user who signed in with a password): a token of one's own that may do as
/// much or less.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct CreateToken {
    /// Whose it is; absent: one's own. Another's takes an administrator.
    #[serde(default)]
    pub user: Option<UserName>,
    /// What it is for.
    #[serde(default)]
    pub title: String,
    /// The roles it is limited to; absent: all of its user's.
    #[serde(default)]
    pub roles: Option<Roles>,
    /// The robots it is limited to; absent: all of its user's.
    #[serde(default)]
    pub scope: Option<Selector>,
    /// How long it lives, in seconds; absent: 90 days.
    #[serde(default)]
    pub ttl_s: Option<u64>,
}

/// A new access token. The secret is shown this once.
#[derive(Clone, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct AccessToken {
    /// The public part of it.
    pub id: TokenId,
    /// The whole token.
    pub token: String,
    /// Whose it is.
    pub user: UserName,
    /// When it ends.
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
    /// At most so many; absent: 1,000, which is also the most.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub limit: Option<u64>,
    /// Only what this one did.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub who: Option<String>,
    /// Only what was done to this.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub target: Option<String>,
    /// Only acts that begin so, like `robot.`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub act: Option<String>,
}

/// Answer of `GET /audit`.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct AuditPage {
    /// What was found.
    pub records: Vec<AuditRecord>,
    /// The number of the last entry there is; 0 if there is none.
    pub last: u64,
}
