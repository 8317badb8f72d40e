//! Sessions of the web page: a name and a password, or a person's token, is exchanged for a cookie
//! that scripts can't read. The database has a row for each session, so that sessions survive a
//! restart of the server.

use std::net::SocketAddr;
use std::sync::Arc;

use axum::Json;
use axum::extract::{ConnectInfo, State};
use axum::response::{IntoResponse, Response};
use http::{HeaderMap, HeaderName, StatusCode, header};
use task_macros::operation;
use task_proto::api::{LogIn, ProviderView, SessionView, SignIn, TokenOrigin};
use task_proto::trust::token::Token;
use task_proto::{Digest, UserName};

use super::person_sessions::PersonSessions;
use crate::auth::oidc::Provider;
use crate::domain::person::Person;
use crate::http::auth::{COOKIE, is_from_browser_page, require_same_origin, session_digest};
use crate::http::error::ApiError;
use crate::http::extract::JsonBody;
use crate::orders::actions::{PAGE_LIFETIME_MS, PersonActions};
use crate::orders::changes::Changes;
use crate::store::{NewPageSession, Store, StoreError, TokenHolder};
use crate::system::clock::Clock;

/// Unreadable for scripts, and not sent with requests from other sites.
const COOKIE_ATTRIBUTES: &str = "HttpOnly; SameSite=Strict; Path=/";
/// Lifetime of a session, in milliseconds.
const LIFETIME_MS: u64 = PAGE_LIFETIME_MS;

/// The form of the page's cookies.
#[derive(Debug, Clone, Copy)]
pub struct PageCookies {
    /// Whether browsers may send the cookies over TLS only.
    pub is_secure: bool,
}

impl PageCookies {
    /// The value of a `Set-Cookie` header.
    pub(super) fn set(self, name: &str, value: &str, attributes: &str, max_age_s: u64) -> String {
        let secure = if self.is_secure { "; Secure" } else { "" };
        format!("{name}={value}; {attributes}; Max-Age={max_age_s}{secure}")
    }
}

/// The parts that sign a person in to the page.
#[derive(Clone)]
pub struct PageSignIn {
    pub(in crate::http) cookies: PageCookies,
    /// The OpenID provider, if one is configured.
    pub(in crate::http) provider: Option<Arc<Provider>>,
    pub(in crate::http) store: Store,
    pub(in crate::http) changes: Changes,
    pub(in crate::http) clock: Clock,
}

impl PageSignIn {
    /// Begins a session in place of the one in these headers, if any, and returns its cookie.
    pub(super) async fn begin_session(
        &self,
        headers: &HeaderMap,
        token: &Token,
        user: &UserName,
        now_ms: u64,
    ) -> Result<String, StoreError> {
        let id = format!("{:032x}{:032x}", rand::random::<u128>(), rand::random::<u128>());
        let (digest, expires_at_ms) = (Digest::of(id.as_bytes()), now_ms + LIFETIME_MS);
        let new = NewPageSession { digest, token, user, expires_at_ms };
        if self.store.page_sessions().begin(&new, session_digest(headers).as_ref()).await? {
            // The streams of the sessions that ended for this one end as well.
            self.changes.announce_rights();
        }
        Ok(self.cookies.set(COOKIE, &id, COOKIE_ATTRIBUTES, LIFETIME_MS / 1000))
    }

    /// The person's token in this text, and its user.
    async fn known_token(&self, text: &str, now_ms: u64) -> Result<(Token, UserName), ApiError> {
        let token: Token =
            text.parse().map_err(|error| ApiError::unauthorized(format!("token: {error}")))?;
        match self.store.tokens().holder(&token, now_ms).await? {
            Some(TokenHolder::Person(person)) => Ok((token, person.name)),
            _ => {
                Err(ApiError::unauthorized("token: unknown, expired or revoked, or not a person's"))
            }
        }
    }

    /// The provider's sign-in link, for people without a session.
    fn provider_view(&self) -> Option<ProviderView> {
        let settings = self.provider.as_ref()?.settings();
        let url = format!("{}/api/v1/oidc/sign-in", settings.public_url);
        Some(ProviderView { title: settings.title.clone(), url })
    }
}

/// Signs in to the page: exchanges a name and a password, or a token, for a session cookie.
#[operation(tag = "session",
    responses((status = 200, description = "The session; its cookie is in `Set-Cookie`.", body = SessionView),
        (status = 401, description = "The name, the password or the token is wrong."),
        (status = 403, description = "The request comes from a page of another origin."),
        (status = 429, description = "Too many failed attempts of this user or from this address.")))]
pub(in crate::http) async fn sign_in(
    State(page): State<PageSignIn>,
    State(people): State<PersonActions>,
    ConnectInfo(peer): ConnectInfo<SocketAddr>,
    headers: HeaderMap,
    JsonBody(request): JsonBody<SignIn>,
) -> Result<Response, ApiError> {
    // A foreign page must not sign its visitor in as another user. Programs send neither header and
    // are not affected.
    if is_from_browser_page(&headers) {
        require_same_origin(&headers)?;
    }
    let now_ms = page.clock.now_ms();
    let (token, user) = match request {
        SignIn { token: Some(token), user: None, password: None } => {
            page.known_token(&token, now_ms).await?
        }
        SignIn { token: None, user: Some(user), password: Some(password) } => {
            let order = LogIn { user, password, ttl_s: None };
            let signed_in =
                people.sign_in(&order, TokenOrigin::Page, peer.ip().to_canonical()).await?;
            (signed_in.token, order.user)
        }
        _ => {
            return Err(ApiError::invalid("user: expected a user and a password, or a token"));
        }
    };
    let cookie = page.begin_session(&headers, &token, &user, now_ms).await?;
    let view = SessionView { expires_at_ms: Some(now_ms + LIFETIME_MS), provider: None };
    Ok(([(header::SET_COOKIE, cookie)], Json(view)).into_response())
}

/// Shows when the caller's session expires.
#[operation(tag = "session")]
pub(in crate::http) async fn show(
    State(page): State<PageSignIn>,
    headers: HeaderMap,
) -> Result<Json<SessionView>, ApiError> {
    let session = match session_digest(&headers) {
        Some(digest) => page.store.page_sessions().get(&digest, page.clock.now_ms()).await?,
        None => None,
    };
    let expires_at_ms = session.map(|session| session.expires_at_ms);
    Ok(Json(SessionView { expires_at_ms, provider: page.provider_view() }))
}

/// Signs out the page's session or the command line's sign-in.
#[operation(tag = "session",
    responses((status = 204, description = "Signed out; the cookie is cleared.")))]
pub(in crate::http) async fn sign_out(
    State(page): State<PageSignIn>,
    State(people): State<PersonActions>,
    State(sessions): State<PersonSessions>,
    by: Person,
    headers: HeaderMap,
) -> Result<Response, ApiError> {
    people.sign_out(&by, session_digest(&headers).as_ref()).await?;
    sessions.end(&by.name);
    let cookie = (header::SET_COOKIE, page.cookies.set(COOKIE, "", COOKIE_ATTRIBUTES, 0));
    // The browser's cache must not be available to its next user.
    let forget = (HeaderName::from_static("clear-site-data"), "\"cache\"".to_owned());
    Ok((StatusCode::NO_CONTENT, [cookie, forget]).into_response())
}
