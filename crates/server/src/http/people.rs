//! People: who they are, how they sign in by the command line, their tokens, and what they did. What concerns someone's
//! rights ends the MQTT sessions that they have by their old ones.

use std::net::SocketAddr;

use axum::Json;
use axum::extract::{ConnectInfo, State};
use http::StatusCode;
use serde::Deserialize;
use task_proto::api::{
    AccessToken, AddUser, AuditPage, AuditQuery, ChangePassword, CreateToken, EditUser, LogIn, Me, SetPassword,
    TokenList, TokenOrigin, UserList, UserView,
};
use task_proto::person::Permission;
use task_proto::{TokenId, UserName};

use super::App;
use super::auth::not_permitted;
use super::error::ApiError;
use super::extract::{JsonBody, PathParam, QueryParams};
use crate::person::Person;

/// `GET /me`: who is asking.
pub(super) async fn me(by: Person) -> Json<Me> {
    let permissions = Permission::ALL.into_iter().filter(|&permission| by.may(permission)).collect();
    let Person { name, roles, scope, token, .. } = by;
    Json(Me { name, roles, permissions, scope: scope.selectors().to_vec(), token })
}

/// `GET /users`: everybody.
pub(super) async fn users(State(app): State<App>) -> Result<Json<UserList>, ApiError> {
    let users = app.store.users().await?;
    Ok(Json(UserList { users: users.into_iter().map(crate::store::User::view).collect() }))
}

/// `POST /users`: adds one.
pub(super) async fn add_user(
    State(app): State<App>,
    by: Person,
    JsonBody(order): JsonBody<AddUser>,
) -> Result<(StatusCode, Json<UserView>), ApiError> {
    Ok((StatusCode::CREATED, Json(app.actions.add_user(&by, &order).await?)))
}

/// `PATCH /users/{user}`: changes what one may.
pub(super) async fn edit_user(
    State(app): State<App>,
    by: Person,
    PathParam(user): PathParam<UserName>,
    JsonBody(edit): JsonBody<EditUser>,
) -> Result<Json<UserView>, ApiError> {
    let view = app.actions.edit_user(&by, &user, &edit).await?;
    app.broker.disconnect_person(&user);
    Ok(Json(view))
}

/// `DELETE /users/{user}`: removes one.
pub(super) async fn remove_user(
    State(app): State<App>,
    by: Person,
    PathParam(user): PathParam<UserName>,
) -> Result<StatusCode, ApiError> {
    app.actions.remove_user(&by, &user).await?;
    app.broker.disconnect_person(&user);
    Ok(StatusCode::NO_CONTENT)
}

/// `PUT /users/{user}/password`: sets anybody's.
pub(super) async fn set_password(
    State(app): State<App>,
    by: Person,
    PathParam(user): PathParam<UserName>,
    JsonBody(order): JsonBody<SetPassword>,
) -> Result<StatusCode, ApiError> {
    app.actions.set_password(&by, &user, &order.password).await?;
    app.broker.disconnect_person(&user);
    Ok(StatusCode::NO_CONTENT)
}

/// `PUT /password`: sets one's own.
pub(super) async fn change_password(
    State(app): State<App>,
    by: Person,
    JsonBody(order): JsonBody<ChangePassword>,
) -> Result<StatusCode, ApiError> {
    app.actions.change_password(&by, &order).await?;
    app.broker.disconnect_person(&by.name);
    Ok(StatusCode::NO_CONTENT)
}

/// `POST /login`: exchanges name and password for a token.
pub(super) async fn log_in(
    State(app): State<App>,
    ConnectInfo(peer): ConnectInfo<SocketAddr>,
    JsonBody(order): JsonBody<LogIn>,
) -> Result<(StatusCode, Json<AccessToken>), ApiError> {
    let signed_in = app.actions.sign_in(&order, TokenOrigin::Login, peer.ip().to_canonical()).await?;
    let id = signed_in.token.id().parse().map_err(|error| ApiError::internal(&error))?;
    let (token, expires_at_ms) = (signed_in.token.reveal(), signed_in.expires_at_ms);
    Ok((StatusCode::CREATED, Json(AccessToken { id, token, user: signed_in.user, expires_at_ms })))
}

/// The query of `GET /tokens`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct TokensQuery {
    #[serde(default)]
    all: bool,
}

/// `GET /tokens`: one's own, or everybody's.
pub(super) async fn tokens(
    State(app): State<App>,
    by: Person,
    QueryParams(query): QueryParams<TokensQuery>,
) -> Result<Json<TokenList>, ApiError> {
    if query.all && !by.may(Permission::Administer) {
        return Err(not_permitted(&by, Permission::Administer));
    }
    Ok(Json(app.actions.tokens(&by, query.all).await?))
}

/// `POST /tokens`: makes one.
pub(super) async fn create_token(
    State(app): State<App>,
    by: Person,
    JsonBody(order): JsonBody<CreateToken>,
) -> Result<(StatusCode, Json<AccessToken>), ApiError> {
    Ok((StatusCode::CREATED, Json(app.actions.create_token(&by, &order).await?)))
}

/// `DELETE /tokens/{token}`: revokes one.
pub(super) async fn revoke_token(
    State(app): State<App>,
    by: Person,
    PathParam(token): PathParam<TokenId>,
) -> Result<StatusCode, ApiError> {
    let user = app.actions.revoke_token(&by, &token).await?;
    app.broker.disconnect_person(&user);
    Ok(StatusCode::NO_CONTENT)
}

/// `GET /audit`: what was done.
pub(super) async fn audit(
    State(app): State<App>,
    QueryParams(query): QueryParams<AuditQuery>,
) -> Result<Json<AuditPage>, ApiError> {
    let texts = [("who", &query.who), ("target", &query.target), ("act", &query.act)];
    if let Some((key, _)) = texts.iter().find(|(_, text)| text.as_ref().is_some_and(|text| text.contains('\0'))) {
        return Err(ApiError::invalid(format!("{key}: it has a control character")));
    }
    Ok(Json(app.store.audit(&query).await?))
}
