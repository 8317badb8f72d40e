//! Signing in by the OpenID provider: the browser is sent to the provider and comes back with a
//! code, which is exchanged for an ordinary session. In every case the browser ends at the page,
//! which shows the result in its own words.

use std::error::Error;
use std::net::{IpAddr, SocketAddr};

use axum::extract::{ConnectInfo, State};
use axum::response::{AppendHeaders, IntoResponse, Response};
use http::{HeaderMap, StatusCode, header};
use serde::Deserialize;
use task_proto::UserName;
use utoipa::IntoParams;

use super::session::{begin_session, cookie, set_cookie};
use crate::auth::oidc::{Attempt, OidcError, Provider};
use crate::http::App;
use crate::http::error::ApiError;
use crate::http::extract::QueryParams;
use crate::orders::actions::ActionError;
use crate::orders::actions::sign_in::ProviderUser;

/// The cookie of a browser that is away at the provider. The cookie has to be sent when the
/// provider redirects the browser back.
const COOKIE: &str = "taskd_sign_in";
const COOKIE_ATTRIBUTES: &str = "HttpOnly; SameSite=Lax; Path=/api/v1/oidc";
/// How long the browser may be away, in seconds.
const AWAY_S: u64 = 600;

/// Redirects the browser to the OpenID provider.
#[utoipa::path(get, path = "/api/v1/oidc/sign-in", tag = "session",
    responses((status = 303, description = "To the provider; or to the page, which says what is wrong."),
        (status = 404, description = "No provider is configured.")))]
pub(in crate::http) async fn begin(State(app): State<App>) -> Result<Response, ApiError> {
    let provider = configured(&app)?;
    let attempt = Attempt::random();
    Ok(match provider.address(&attempt, app.clock.now_ms()).await {
        Ok(address) => sent_to(&address, &[kept(&app, &attempt.reveal(), AWAY_S)]),
        Err(error) => problem(&app, failed(&error)),
    })
}

/// The provider's authorization response, delivered by the browser. Other parameters are allowed.
#[derive(Deserialize, IntoParams)]
pub(in crate::http) struct Answered {
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
#[utoipa::path(get, path = "/api/v1/oidc/callback", tag = "session",
    responses((status = 303, description = "To the page, signed in or told why not."),
        (status = 404, description = "No provider is configured.")))]
pub(in crate::http) async fn finish(
    State(app): State<App>,
    ConnectInfo(peer): ConnectInfo<SocketAddr>,
    headers: HeaderMap,
    QueryParams(answered): QueryParams<Answered>,
) -> Result<Response, ApiError> {
    let provider = configured(&app)?;
    let address = peer.ip().to_canonical();
    Ok(match sign_in(&app, provider, &headers, answered, address).await {
        Ok(session) => sent_to("/", &[kept(&app, "", 0), session]),
        Err(code) => problem(&app, code),
    })
}

fn configured(app: &App) -> Result<&Provider, ApiError> {
    app.provider
        .as_deref()
        .ok_or_else(|| ApiError::not_found("no provider is configured to sign in by"))
}

/// The session's cookie, or the error code for the page to explain.
async fn sign_in(
    app: &App,
    provider: &Provider,
    headers: &HeaderMap,
    answered: Answered,
    address: IpAddr,
) -> Result<String, &'static str> {
    // An answer is valid only once and only in the browser that began the sign-in: no user can sign
    // another person in.
    let attempt = cookie(headers, COOKIE).and_then(Attempt::kept);
    let is_own =
        |attempt: &Attempt| answered.state.as_deref().is_some_and(|state| attempt.has_state(state));
    let attempt = attempt.filter(is_own).ok_or("expired")?;
    // Counted only after this check: otherwise a foreign page could get its visitors' address
    // blocked.
    app.actions.begin_provider_sign_in(address).await.map_err(|error| refused(app, error))?;
    if answered.iss.is_some_and(|issuer| issuer != provider.settings().issuer) {
        return Err(failed(&OidcError::Unusable {
            what: "answer",
            reason: "it is another issuer's".to_owned(),
        }));
    }
    let code = match (answered.code, answered.error) {
        (Some(code), None) => code,
        _ => return Err("refused"),
    };
    let now_ms = app.clock.now_ms();
    let claims = provider.who(&attempt, &code, now_ms).await.map_err(|error| failed(&error))?;
    let name = claims.get(&provider.settings().name_claim).and_then(|name| name.as_str());
    let name: Option<UserName> = name.and_then(|name| name.to_lowercase().parse().ok());
    let who = ProviderUser {
        subject: format!("{} {}", provider.settings().issuer, claims.subject()),
        name,
    };
    let signed_in =
        app.actions.sign_in_by_provider(&who, provider.rule_for(&claims), address).await;
    let signed_in = signed_in.map_err(|error| refused(app, error))?;
    if signed_in.has_other_rights {
        app.broker.disconnect_person(&signed_in.user);
    }
    app.actions.provider_sign_in_succeeded(address);
    Ok(begin_session(app, headers, signed_in.token, signed_in.user, now_ms))
}

fn failed(error: &OidcError) -> &'static str {
    tracing::warn!(error = error as &dyn Error, "somebody could not be signed in by the provider");
    "failed"
}

fn refused(app: &App, error: ActionError) -> &'static str {
    if let ActionError::NoRole { removed: Some(user) } = &error {
        app.broker.disconnect_person(user);
    }
    match error {
        ActionError::SignInBlocked { .. } => "blocked",
        ActionError::NoRole { .. } => "no_role",
        ActionError::NoName => "no_name",
        ActionError::UserExists(_) => "name_taken",
        error => {
            tracing::error!(
                error = &error as &dyn Error,
                "somebody could not be signed in by the provider"
            );
            "failed"
        }
    }
}

fn problem(app: &App, code: &str) -> Response {
    sent_to(&format!("/#problem={code}"), &[kept(app, "", 0)])
}

fn kept(app: &App, value: &str, max_age_s: u64) -> String {
    set_cookie(app, COOKIE, value, COOKIE_ATTRIBUTES, max_age_s)
}

fn sent_to(address: &str, cookies: &[String]) -> Response {
    let cookies = cookies.iter().map(|cookie| (header::SET_COOKIE, cookie.clone()));
    let headers: Vec<_> =
        [(header::LOCATION, address.to_owned())].into_iter().chain(cookies).collect();
    (StatusCode::SEE_OTHER, AppendHeaders(headers)).into_response()
}
