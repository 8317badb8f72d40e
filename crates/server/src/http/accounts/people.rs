//! People: their identity, sign-in at the command line, tokens and audit log. A change of a
//! person's rights ends the MQTT sessions that were opened with the old rights.

use std::net::SocketAddr;

use axum::Json;
use axum::extract::{ConnectInfo, State};
use axum::response::NoContent;
use serde::Deserialize;
use task_macros::operation;
use task_proto::api::{
    AccessToken, AddUser, AuditPage, AuditQuery, ChangePassword, CreateToken, EditUser, LogIn, Me,
    SetPassword, TokenList, TokenOrigin, UserList, UserView,
};
use task_proto::people::roles::Permission;
use task_proto::{TokenId, UserName};
use utoipa::IntoParams;

use super::person_sessions::PersonSessions;
use crate::domain::person::Person;
use crate::http::auth::not_permitted;
use crate::http::error::ApiError;
use crate::http::extract::{JsonBody, PathParam, QueryParams};
use crate::http::openapi::Created;
use crate::orders::actions::PersonActions;
use crate::store::Store;

/// Shows the caller's identity and permissions.
#[operation(tag = "people")]
pub(in crate::http) async fn me(by: Person) -> Json<Me> {
    let permissions =
        Permission::ALL.into_iter().filter(|&permission| by.may(permission)).collect();
    let Person { name, roles, scope, token, .. } = by;
    Json(Me { name, roles, permissions, scope: scope.selectors().to_vec(), token })
}

/// Lists all users, with their roles.
#[operation(tag = "people")]
pub(in crate::http) async fn users(State(store): State<Store>) -> Result<Json<UserList>, ApiError> {
    let users = store.users().list().await?;
    Ok(Json(UserList { users: users.into_iter().map(crate::store::User::view).collect() }))
}

/// Adds a user with roles.
#[operation(tag = "people",
    responses((status = 409, description = "`user_exists`: the name is taken.")))]
pub(in crate::http) async fn add_user(
    State(people): State<PersonActions>,
    by: Person,
    JsonBody(order): JsonBody<AddUser>,
) -> Result<Created<UserView>, ApiError> {
    Ok(Created(people.add_user(&by, &order).await?))
}

/// Changes a user's permissions.
#[operation(tag = "people",
    responses((status = 409, description = "`last_administrator`, or `of_provider`: the OpenID provider determines the user's permissions.")))]
pub(in crate::http) async fn edit_user(
    State(people): State<PersonActions>,
    State(sessions): State<PersonSessions>,
    by: Person,
    PathParam(user): PathParam<UserName>,
    JsonBody(edit): JsonBody<EditUser>,
) -> Result<Json<UserView>, ApiError> {
    let view = people.edit_user(&by, &user, &edit).await?;
    sessions.end(&user);
    Ok(Json(view))
}

/// Removes a user and ends their tokens and sessions.
#[operation(tag = "people",
    responses((status = 409, description = "`last_administrator`: one administrator must remain.")))]
pub(in crate::http) async fn remove_user(
    State(people): State<PersonActions>,
    State(sessions): State<PersonSessions>,
    by: Person,
    PathParam(user): PathParam<UserName>,
) -> Result<NoContent, ApiError> {
    people.remove_user(&by, &user).await?;
    sessions.end(&user);
    Ok(NoContent)
}

/// Sets any user's password and ends the sign-ins made with the old one.
#[operation(tag = "people",
    responses((status = 409, description = "`of_provider`: users who sign in by the OpenID provider have no password here.")))]
pub(in crate::http) async fn set_password(
    State(people): State<PersonActions>,
    State(sessions): State<PersonSessions>,
    by: Person,
    PathParam(user): PathParam<UserName>,
    JsonBody(order): JsonBody<SetPassword>,
) -> Result<NoContent, ApiError> {
    people.set_password(&by, &user, &order.password).await?;
    sessions.end(&user);
    Ok(NoContent)
}

/// Sets the caller's own password and ends the sign-ins made with the old one.
#[operation(tag = "people",
    responses((status = 409, description = "`of_provider`: users who sign in by the OpenID provider have no password here."),
        (status = 429, description = "The old password was wrong too often.")))]
pub(in crate::http) async fn change_password(
    State(people): State<PersonActions>,
    State(sessions): State<PersonSessions>,
    by: Person,
    JsonBody(order): JsonBody<ChangePassword>,
) -> Result<NoContent, ApiError> {
    people.change_password(&by, &order).await?;
    sessions.end(&by.name);
    Ok(NoContent)
}

/// Exchanges a name and a password for a token.
#[operation(tag = "session",
    responses((status = 401, description = "The name or the password is wrong."),
        (status = 429, description = "Too many failed attempts of this user or from this address.")))]
pub(in crate::http) async fn log_in(
    State(people): State<PersonActions>,
    ConnectInfo(peer): ConnectInfo<SocketAddr>,
    JsonBody(order): JsonBody<LogIn>,
) -> Result<Created<AccessToken>, ApiError> {
    let signed_in = people.sign_in(&order, TokenOrigin::Login, peer.ip().to_canonical()).await?;
    let id = signed_in.token.id().parse().map_err(|error| ApiError::internal(&error))?;
    let (token, expires_at_ms) = (signed_in.token.reveal(), signed_in.expires_at_ms);
    Ok(Created(AccessToken { id, token, user: signed_in.user, expires_at_ms }))
}

/// The query of `GET /tokens`.
#[derive(Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
pub(in crate::http) struct TokensQuery {
    /// Lists the tokens of all users. Requires the permission `administer`.
    #[serde(default)]
    all: bool,
}

/// Lists the caller's own tokens, or those of all users.
#[operation(tag = "people")]
pub(in crate::http) async fn tokens(
    State(people): State<PersonActions>,
    by: Person,
    QueryParams(query): QueryParams<TokensQuery>,
) -> Result<Json<TokenList>, ApiError> {
    if query.all && !by.may(Permission::Administer) {
        return Err(not_permitted(&by, Permission::Administer));
    }
    Ok(Json(people.tokens(&by, query.all).await?))
}

/// Creates a token with the caller's permissions or fewer.
#[operation(tag = "people",
    responses((status = 404, description = "There is no such user.")))]
pub(in crate::http) async fn create_token(
    State(people): State<PersonActions>,
    by: Person,
    JsonBody(order): JsonBody<CreateToken>,
) -> Result<Created<AccessToken>, ApiError> {
    Ok(Created(people.create_token(&by, &order).await?))
}

/// Revokes an access token.
#[operation(tag = "people")]
pub(in crate::http) async fn revoke_token(
    State(people): State<PersonActions>,
    State(sessions): State<PersonSessions>,
    by: Person,
    PathParam(token): PathParam<TokenId>,
) -> Result<NoContent, ApiError> {
    let user = people.revoke_token(&by, &token).await?;
    sessions.end(&user);
    Ok(NoContent)
}

/// Lists the audit log: actions with their user and source.
#[operation(tag = "people")]
pub(in crate::http) async fn audit(
    State(store): State<Store>,
    QueryParams(query): QueryParams<AuditQuery>,
) -> Result<Json<AuditPage>, ApiError> {
    let texts = [("who", &query.who), ("target", &query.target), ("act", &query.act)];
    if let Some((key, _)) =
        texts.iter().find(|(_, text)| text.as_ref().is_some_and(|text| text.contains('\0')))
    {
        return Err(ApiError::invalid(format!("{key}: contains a control character")));
    }
    Ok(Json(store.audit().page(&query).await?))
}
