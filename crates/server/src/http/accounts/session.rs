//! Sessions of the web page: a name and a password, or a person's token, is exchanged for a cookie
//! that scripts can't read. Sessions live in memory only, so a restart of the server signs all
//! people out.

use std::collections::HashMap;
use std::net::SocketAddr;
use std::sync::{Mutex, MutexGuard, PoisonError};

use axum::Json;
use axum::extract::{ConnectInfo, State};
use axum::response::{IntoResponse, Response};
use http::{HeaderMap, HeaderName, StatusCode, header};
use task_proto::api::{LogIn, ProviderView, SessionView, SignIn, TokenOrigin};
use task_proto::token::Token;
use task_proto::{Digest, UserName};
use tokio_util::sync::{CancellationToken, DropGuard};

use crate::domain::person::Person;
use crate::http::App;
use crate::http::auth::{COOKIE, require_same_origin};
use crate::http::error::ApiError;
use crate::http::extract::JsonBody;
use crate::orders::actions::sign_in::PAGE_LIFETIME_MS;
use crate::store::TokenHolder;

/// Unreadable for scripts, and not sent with requests from other sites.
const COOKIE_ATTRIBUTES: &str = "HttpOnly; SameSite=Strict; Path=/";
/// Lifetime of a session, in milliseconds.
const LIFETIME_MS: u64 = PAGE_LIFETIME_MS;
/// The most sessions at a time; one more ends the oldest.
const MOST_SESSIONS: usize = 1_024;
/// The most sessions of one person at a time; one more ends the person's oldest. One person
/// therefore can't sign the others out.
const MOST_OF_ONE: usize = 32;

/// The live sessions, keyed by the SHA-256 of the session id.
#[derive(Debug)]
pub struct Sessions {
    /// Random prefix of the ids of this server run, which tells them from ids of earlier runs.
    run: String,
    entries: Mutex<HashMap<Digest, Entry>>,
}

impl Default for Sessions {
    fn default() -> Self {
        Self { run: format!("{:016x}", rand::random::<u64>()), entries: Mutex::default() }
    }
}

/// A live session: its streams end when the entry is dropped.
#[derive(Debug)]
struct Entry {
    session: Session,
    _end: DropGuard,
}

#[derive(Debug, Clone)]
pub struct Session {
    /// The token that began the session: a session ends with its token.
    pub token: Token,
    pub user: UserName,
    /// Expiry time, in milliseconds.
    pub expires_at_ms: u64,
    /// Cancelled when the session ends before its expiry.
    pub ended: CancellationToken,
}

impl Sessions {
    /// Begins a session and returns the cookie's value.
    fn begin(&self, token: Token, user: UserName, now_ms: u64) -> String {
        let id =
            format!("{}.{:032x}{:032x}", self.run, rand::random::<u128>(), rand::random::<u128>());
        let mut sessions = self.lock();
        sessions.retain(|_, entry| entry.session.expires_at_ms > now_ms);
        let is_own = |entry: &Entry| entry.session.user == user;
        let own = sessions.values().filter(|entry| is_own(entry)).count();
        if own >= MOST_OF_ONE || sessions.len() >= MOST_SESSIONS {
            let candidates =
                sessions.iter().filter(|(_, entry)| own < MOST_OF_ONE || is_own(entry));
            let oldest = candidates
                .min_by_key(|(_, entry)| entry.session.expires_at_ms)
                .map(|(key, _)| *key);
            oldest.map(|key| sessions.remove(&key));
        }
        let ended = CancellationToken::new();
        let session =
            Session { token, user, expires_at_ms: now_ms + LIFETIME_MS, ended: ended.clone() };
        sessions.insert(Digest::of(id.as_bytes()), Entry { session, _end: ended.drop_guard() });
        id
    }

    /// The live session of a request's cookie, if any.
    pub fn find(&self, headers: &HeaderMap, now_ms: u64) -> Option<Session> {
        let key = Digest::of(cookie(headers, COOKIE)?.as_bytes());
        self.lock()
            .get(&key)
            .map(|entry| &entry.session)
            .filter(|session| session.expires_at_ms > now_ms)
            .cloned()
    }

    /// True if a request's cookie belongs to a session of an earlier server run.
    fn is_of_earlier_run(&self, headers: &HeaderMap) -> bool {
        let run = cookie(headers, COOKIE)
            .filter(|id| !id.is_empty())
            .map(|id| id.split_once('.').unwrap_or_default().0);
        run.is_some_and(|run| run != self.run)
    }

    fn end(&self, headers: &HeaderMap) {
        if let Some(id) = cookie(headers, COOKIE) {
            self.lock().remove(&Digest::of(id.as_bytes()));
        }
    }

    fn lock(&self) -> MutexGuard<'_, HashMap<Digest, Entry>> {
        self.entries.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The value of a request's cookie.
pub(in crate::http) fn cookie<'a>(headers: &'a HeaderMap, wanted: &str) -> Option<&'a str> {
    let lines = headers.get_all(header::COOKIE).iter().filter_map(|value| value.to_str().ok());
    let mut pairs =
        lines.flat_map(|line| line.split(';')).filter_map(|pair| pair.trim().split_once('='));
    pairs.find(|(name, _)| *name == wanted).map(|(_, value)| value)
}

/// The `Set-Cookie` header. Where the page is served over TLS, the cookie is marked as secure.
pub(in crate::http) fn set_cookie(
    app: &App,
    name: &str,
    value: &str,
    attributes: &str,
    max_age_s: u64,
) -> String {
    let is_behind_tls =
        app.provider.as_ref().is_some_and(|it| it.settings().public_url.starts_with("https:"));
    let secure = if app.ca_pin.is_some() || is_behind_tls { "; Secure" } else { "" };
    format!("{name}={value}; {attributes}; Max-Age={max_age_s}{secure}")
}

/// Begins a session in place of the one in these headers, if any, and returns its cookie.
pub(in crate::http) fn begin_session(
    app: &App,
    headers: &HeaderMap,
    token: Token,
    user: UserName,
    now_ms: u64,
) -> String {
    app.sessions.end(headers);
    let id = app.sessions.begin(token, user, now_ms);
    set_cookie(app, COOKIE, &id, COOKIE_ATTRIBUTES, LIFETIME_MS / 1000)
}

/// Signs in to the page: exchanges a name and a password, or a token, for a session cookie.
#[utoipa::path(post, path = "/api/v1/session", tag = "session",
    responses((status = 200, description = "The session; its cookie is in `Set-Cookie`.", body = SessionView),
        (status = 401, description = "Name, password or token are not right."),
        (status = 403, description = "The request comes from a foreign page."),
        (status = 429, description = "Too many attempts failed, of this user or from this address.")))]
pub(in crate::http) async fn sign_in(
    State(app): State<App>,
    ConnectInfo(peer): ConnectInfo<SocketAddr>,
    headers: HeaderMap,
    JsonBody(request): JsonBody<SignIn>,
) -> Result<Response, ApiError> {
    // A foreign page must not sign its visitor in as another user. Programs send no Origin and are
    // not affected.
    if headers.contains_key(header::ORIGIN) {
        require_same_origin(&headers)?;
    }
    let now_ms = app.clock.now_ms();
    let (token, user) = match request {
        SignIn { token: Some(token), user: None, password: None } => {
            known_token(&app, &token, now_ms).await?
        }
        SignIn { token: None, user: Some(user), password: Some(password) } => {
            let order = LogIn { user, password, ttl_s: None };
            let signed_in =
                app.actions.sign_in(&order, TokenOrigin::Page, peer.ip().to_canonical()).await?;
            (signed_in.token, order.user)
        }
        _ => {
            return Err(ApiError::invalid("user: expected a user and a password, or else a token"));
        }
    };
    let cookie = begin_session(&app, &headers, token, user, now_ms);
    let expires_at_ms = Some(now_ms + LIFETIME_MS);
    let view = SessionView { expires_at_ms, provider: None, ended_by_restart: false };
    Ok(([(header::SET_COOKIE, cookie)], Json(view)).into_response())
}

async fn known_token(app: &App, text: &str, now_ms: u64) -> Result<(Token, UserName), ApiError> {
    let token: Token =
        text.parse().map_err(|error| ApiError::unauthorized(format!("token: {error}")))?;
    match app.store.token_holder(&token, now_ms).await? {
        Some(TokenHolder::Person(person)) => Ok((token, person.name)),
        _ => Err(ApiError::unauthorized(
            "token: it is unknown, expired or revoked, or not a person's",
        )),
    }
}

/// The provider's sign-in link, for people without a session.
fn provider_view(app: &App) -> Option<ProviderView> {
    let settings = app.provider.as_ref()?.settings();
    let url = format!("{}/api/v1/oidc/sign-in", settings.public_url);
    Some(ProviderView { title: settings.title.clone(), url })
}

/// Shows when the caller's session expires, or else whether a server restart ended the session.
#[utoipa::path(get, path = "/api/v1/session", tag = "session")]
pub(in crate::http) async fn show(
    State(app): State<App>,
    headers: HeaderMap,
) -> Result<Json<SessionView>, ApiError> {
    let now_ms = app.clock.now_ms();
    let provider = provider_view(&app);
    let Some(session) = app.sessions.find(&headers, now_ms) else {
        let ended_by_restart = app.sessions.is_of_earlier_run(&headers);
        return Ok(Json(SessionView { expires_at_ms: None, provider, ended_by_restart }));
    };
    let is_good = app.store.token_holder(&session.token, now_ms).await?.is_some();
    let expires_at_ms = is_good.then_some(session.expires_at_ms);
    Ok(Json(SessionView { expires_at_ms, provider, ended_by_restart: false }))
}

/// Signs out the page's session or the command line's sign-in.
#[utoipa::path(delete, path = "/api/v1/session", tag = "session",
    responses((status = 204, description = "Signed out; the cookie is taken back.")))]
pub(in crate::http) async fn sign_out(
    State(app): State<App>,
    by: Person,
    headers: HeaderMap,
) -> Result<Response, ApiError> {
    app.sessions.end(&headers);
    app.actions.sign_out(&by).await?;
    app.broker.disconnect_person(&by.name);
    let cookie = (header::SET_COOKIE, set_cookie(&app, COOKIE, "", COOKIE_ATTRIBUTES, 0));
    // The browser's cache must not be available to its next user.
    let forget = (HeaderName::from_static("clear-site-data"), "\"cache\"".to_owned());
    Ok((StatusCode::NO_CONTENT, [cookie, forget]).into_response())
}

#[cfg(test)]
mod tests {
    use task_proto::token::TokenKind;

    use super::*;

    fn user(name: &str) -> UserName {
        name.parse().expect("a name")
    }

    fn with_cookie(text: String) -> HeaderMap {
        HeaderMap::from_iter([(header::COOKIE, text.parse().expect("a header"))])
    }

    #[test]
    fn a_session_is_found_until_it_expires_or_ends() {
        let sessions = Sessions::default();
        let id = sessions.begin(Token::random(TokenKind::Operator), user("alice"), 1_000);
        let headers = with_cookie(format!("theme=dark; {COOKIE}={id}"));
        let found = sessions.find(&headers, 1_001).expect("it lives");
        assert!(sessions.find(&headers, 1_000 + LIFETIME_MS).is_none());
        assert!(sessions.find(&with_cookie(format!("{COOKIE}=guess")), 1_001).is_none());
        assert!(!found.ended.is_cancelled());
        sessions.end(&headers);
        assert!(sessions.find(&headers, 1_001).is_none());
        assert!(found.ended.is_cancelled());
    }

    #[test]
    fn session_of_an_earlier_run_is_known_as_such() {
        let [before, now] = [(); 2].map(|()| Sessions::default());
        let id = before.begin(Token::random(TokenKind::Operator), user("alice"), 1_000);
        let headers = with_cookie(format!("{COOKIE}={id}"));
        assert!(now.is_of_earlier_run(&headers) && !before.is_of_earlier_run(&headers));
        before.end(&headers);
        assert!(!before.is_of_earlier_run(&headers), "it ended otherwise");
        assert!(
            !now.is_of_earlier_run(&HeaderMap::new())
                && !now.is_of_earlier_run(&with_cookie(format!("{COOKIE}=")))
        );
    }

    #[test]
    fn sessions_are_bounded() {
        let sessions = Sessions::default();
        let bob = sessions.begin(Token::random(TokenKind::Operator), user("bob"), 0);
        for now_ms in 1..2 * MOST_SESSIONS as u64 {
            sessions.begin(Token::random(TokenKind::Operator), user("alice"), now_ms);
        }
        assert_eq!(sessions.lock().len(), MOST_OF_ONE + 1);
        assert!(
            sessions.find(&with_cookie(format!("{COOKIE}={bob}")), 1).is_some(),
            "nobody signs others out"
        );
        for now_ms in 0..2 * MOST_SESSIONS as u64 {
            sessions.begin(
                Token::random(TokenKind::Operator),
                user(&format!("user{now_ms}")),
                now_ms,
            );
        }
        assert_eq!(sessions.lock().len(), MOST_SESSIONS);
    }
}
