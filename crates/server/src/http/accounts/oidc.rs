//! Signing in by the OpenID provider: the browser is sent to the provider and comes back with a
//! code, which is exchanged for an ordinary session. In every case the browser ends at the page,
//! which shows the result in its own words.

use std::error::Error;
use std::net::{IpAddr, SocketAddr};

use axum::extract::{ConnectInfo, State};
use axum::response::{AppendHeaders, IntoResponse, Response};
use http::{HeaderMap, StatusCode, header};
use serde::Deserialize;
use task_macros::operation;
use task_proto::UserName;
use utoipa::IntoParams;

use super::person_sessions::PersonSessions;
use super::session::{PageCookies, PageSignIn};
use crate::auth::oidc::{OidcError, Provider, SignInAttempt};
use crate::http::auth::cookie;
use crate::http::error::ApiError;
use crate::http::extract::QueryParams;
use crate::orders::actions::{PersonActions, PersonError, ProviderUser};

/// The cookie of a browser that is away at the provider. The cookie has to be sent when the
/// provider redirects the browser back.
const COOKIE: &str = "taskd_sign_in";
const COOKIE_ATTRIBUTES: &str = "HttpOnly; SameSite=Lax; Path=/api/v1/oidc";
/// How long the browser may be away, in seconds.
const ATTEMPT_LIFETIME_S: u64 = 600;

/// Redirects the browser to the OpenID provider.
#[operation(tag = "session",
    responses((status = 303, description = "Redirect to the provider, or to the page with a problem code."),
        (status = 404, description = "No provider is configured.")))]
pub(in crate::http) async fn begin(State(page): State<PageSignIn>) -> Result<Response, ApiError> {
    let (provider, cookies) = (configured_provider(&page)?, page.cookies);
    let attempt = SignInAttempt::random();
    Ok(match provider.authorization_url(&attempt, page.clock.now_ms()).await {
        Ok(address) => {
            redirect(&address, &[sign_in_cookie(cookies, &attempt.reveal(), ATTEMPT_LIFETIME_S)])
        }
        Err(error) => redirect_with_problem(cookies, provider_failure(&error)),
    })
}

/// The provider's authorization response, delivered by the browser. Other parameters are allowed.
#[derive(Deserialize, IntoParams)]
pub(in crate::http) struct AuthorizationResponse {
    /// The state sent with the authorization request.
    state: Option<String>,
    /// Authorization code, exchanged for the user's identity.
    code: Option<String>,
    /// Error code, if the provider issued no authorization code.
    error: Option<String>,
    /// Issuer identifier of the provider (RFC 9207).
    iss: Option<String>,
}

/// Completes the sign-in when the provider redirects the browser back.
#[operation(tag = "session",
    responses((status = 303, description = "Redirect to the page, with a session or a problem code."),
        (status = 404, description = "No provider is configured.")))]
pub(in crate::http) async fn finish(
    State(page): State<PageSignIn>,
    State(people): State<PersonActions>,
    State(sessions): State<PersonSessions>,
    ConnectInfo(peer): ConnectInfo<SocketAddr>,
    headers: HeaderMap,
    QueryParams(answer): QueryParams<AuthorizationResponse>,
) -> Result<Response, ApiError> {
    let (provider, cookies) = (configured_provider(&page)?, page.cookies);
    let address = peer.ip().to_canonical();
    let signed_in = sign_in(&page, &people, &sessions, provider, &headers, answer, address).await;
    Ok(match signed_in {
        Ok(session) => redirect("/", &[sign_in_cookie(cookies, "", 0), session]),
        Err(code) => redirect_with_problem(cookies, code),
    })
}

fn configured_provider(page: &PageSignIn) -> Result<&Provider, ApiError> {
    page.provider.as_deref().ok_or_else(|| ApiError::not_found("no OpenID provider is configured"))
}

/// The session's cookie, or the error code for the page to explain.
async fn sign_in(
    page: &PageSignIn,
    people: &PersonActions,
    sessions: &PersonSessions,
    provider: &Provider,
    headers: &HeaderMap,
    answer: AuthorizationResponse,
    address: IpAddr,
) -> Result<String, &'static str> {
    // An answer is valid only once and only in the browser that began the sign-in: no user can sign
    // another person in.
    let attempt = cookie(headers, COOKIE).and_then(SignInAttempt::from_cookie);
    let is_own = |attempt: &SignInAttempt| {
        answer.state.as_deref().is_some_and(|state| attempt.has_state(state))
    };
    let attempt = attempt.filter(is_own).ok_or("expired")?;
    // Counted only after this check: otherwise a foreign page could get its visitors' address
    // blocked.
    people.begin_provider_sign_in(address).await.map_err(|error| refusal_code(sessions, error))?;
    if answer.iss.is_some_and(|issuer| issuer != provider.settings().issuer) {
        return Err(provider_failure(&OidcError::Unusable {
            resource: "answer",
            reason: "unexpected issuer".to_owned(),
        }));
    }
    let code = match (answer.code, answer.error) {
        (Some(code), None) => code,
        _ => return Err("refused"),
    };
    let now_ms = page.clock.now_ms();
    let claims = provider
        .authenticate(&attempt, &code, now_ms)
        .await
        .map_err(|error| provider_failure(&error))?;
    let name = claims.get(&provider.settings().name_claim).and_then(|name| name.as_str());
    let name: Option<UserName> = name.and_then(|name| name.to_lowercase().parse().ok());
    let user = ProviderUser {
        subject: format!("{} {}", provider.settings().issuer, claims.subject()),
        name,
    };
    let signed_in =
        people.sign_in_through_provider(&user, provider.rule_for(&claims), address).await;
    let signed_in = signed_in.map_err(|error| refusal_code(sessions, error))?;
    if signed_in.rights_changed {
        sessions.end(&signed_in.user);
    }
    people.provider_sign_in_succeeded(address);
    let cookie = page.begin_session(headers, &signed_in.token, &signed_in.user, now_ms).await;
    cookie.map_err(|error| refusal_code(sessions, error.into()))
}

fn provider_failure(error: &OidcError) -> &'static str {
    tracing::warn!(error = error as &dyn Error, "sign-in by the OpenID provider failed");
    "failed"
}

fn refusal_code(sessions: &PersonSessions, error: PersonError) -> &'static str {
    if let PersonError::NoRole { removed: Some(user) } = &error {
        sessions.end(user);
    }
    match error {
        PersonError::SignInBlocked { .. } => "blocked",
        PersonError::NoRole { .. } => "no_role",
        PersonError::NoName => "no_name",
        PersonError::UserExists(_) => "name_taken",
        error => {
            tracing::error!(error = &error as &dyn Error, "sign-in by the OpenID provider failed");
            "failed"
        }
    }
}

fn redirect_with_problem(cookies: PageCookies, code: &str) -> Response {
    redirect(&format!("/#problem={code}"), &[sign_in_cookie(cookies, "", 0)])
}

fn sign_in_cookie(cookies: PageCookies, value: &str, max_age_s: u64) -> String {
    cookies.set(COOKIE, value, COOKIE_ATTRIBUTES, max_age_s)
}

fn redirect(address: &str, cookies: &[String]) -> Response {
    let cookies = cookies.iter().map(|cookie| (header::SET_COOKIE, cookie.clone()));
    let headers: Vec<_> =
        [(header::LOCATION, address.to_owned())].into_iter().chain(cookies).collect();
    (StatusCode::SEE_OTHER, AppendHeaders(headers)).into_response()
}
