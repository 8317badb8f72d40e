//! Owns the guard before every route: authentication and authorization of callers; never decides
//! the effect of an order.
//!
//! Every route names its [`Access`]; the guard finds the [`Caller`] and refuses all others.

pub mod attempts;
pub mod person_limits;
pub(super) mod robot_limits;

use std::net::SocketAddr;
use std::time::Duration;

use axum::body::Body;
use axum::extract::rejection::RawPathParamsRejection;
use axum::extract::{ConnectInfo, FromRequestParts, RawPathParams, Request, State};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use futures_util::{StreamExt as _, stream};
use http::request::Parts;
use http::{HeaderMap, HeaderName, HeaderValue, Method, StatusCode, header};
use http_body::Body as _;
use task_proto::people::roles::Permission;
use task_proto::trust::token::Token;
use task_proto::{Digest, RobotId, UserName};
use tokio::time::{Instant, timeout_at};

use self::person_limits::{RequestKind, RequestPermit};
use self::robot_limits::throttle;
use super::App;
use super::error::{ApiError, ROBOT_REVOKED};
use super::peers::Proven;
use crate::domain::limits::robot_limiter::Channel;
use crate::domain::person::Person;
use crate::link::gatekeeper::announce_new_token;
use crate::net::http_connections::{Connection, Holder};
use crate::net::tls::ClientProof;
use crate::store::{Admitted, Fault, StoreError, TokenHolder, with_shared_reads};

/// The name of the session cookie.
pub(super) const COOKIE: &str = "taskd_session";

/// The callers that a route admits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Access {
    /// Every caller, authenticated or not.
    Anyone,
    /// A person with this permission, by a token or a signed-in page. The handler checks for which
    /// robots the permission holds.
    Person(Permission),
    /// Only the robot that the path's `{robot}` names.
    OwnRobot,
    /// A machine with a valid enrollment token.
    Enrollment,
    /// A person or any robot; the handler narrows the access of each.
    PersonOrRobot,
    /// Another server of the cluster.
    Peer,
}

/// The number of the token that a robot called with. Handlers for robots may take this as an
/// extension.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TokenNumber(pub u64);

/// The authenticated caller, as found by the guard. Handlers take this as an argument.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Caller {
    /// An unauthenticated caller: only on routes for anyone.
    Anyone,
    Person(Person),
    Robot(RobotId),
    /// The holder of an enrollment token.
    Enrollment(Box<Token>),
    /// Another server of the cluster.
    Peer,
}

impl Caller {
    /// The calling robot; `None` for all other callers.
    pub fn robot(&self) -> Option<&RobotId> {
        match self {
            Self::Robot(robot) => Some(robot),
            _ => None,
        }
    }

    /// The calling person; `None` for all other callers.
    pub fn person(&self) -> Option<&Person> {
        match self {
            Self::Person(person) => Some(person),
            _ => None,
        }
    }

    /// The holder for which the connection of this caller counts; `None` for unauthenticated
    /// callers and enrollments.
    fn holder(&self) -> Option<Holder> {
        match self {
            Self::Anyone | Self::Peer => None,
            Self::Person(person) => Some(Holder::Person(person.name.clone())),
            Self::Robot(robot) => Some(Holder::Robot(robot.clone())),
            Self::Enrollment(token) => Some(Holder::Enrollment(token.id())),
        }
    }

    fn may(&self, access: Access, own: Option<&str>) -> bool {
        match access {
            Access::Anyone => true,
            Access::Person(permission) => {
                matches!(self, Self::Person(person) if person.may(permission))
            }
            Access::OwnRobot => self.robot().is_some_and(|robot| own == Some(robot.as_str())),
            Access::Enrollment => matches!(self, Self::Enrollment(_)),
            Access::PersonOrRobot => matches!(self, Self::Person(_) | Self::Robot(_)),
            Access::Peer => *self == Self::Peer,
        }
    }
}

impl<S: Sync> FromRequestParts<S> for Caller {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, _state: &S) -> Result<Self, ApiError> {
        // Absent only if a handler was mounted without the guard: then every caller is refused.
        parts
            .extensions
            .get::<Self>()
            .cloned()
            .ok_or_else(|| ApiError::unauthorized("this route has no guard"))
    }
}

impl<S: Sync> FromRequestParts<S> for Person {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, ApiError> {
        match Caller::from_request_parts(parts, state).await? {
            Caller::Person(person) => Ok(person),
            _ => Err(ApiError::forbidden("this route is for people")),
        }
    }
}

/// State of one route's guard.
#[derive(Clone)]
pub(super) struct GuardState {
    pub(super) app: App,
    pub(super) access: Access,
    pub(super) deadline: Option<Duration>,
    pub(super) waits_for_robot: bool,
}

/// Runs before every handler: authenticates the caller, refuses callers without access, and
/// enforces the route's deadline.
pub(super) async fn guard(
    State(guard_state): State<GuardState>,
    ConnectInfo(peer): ConnectInfo<SocketAddr>,
    params: Result<RawPathParams, RawPathParamsRejection>,
    mut request: Request,
    next: Next,
) -> Response {
    let is_oci = request.uri().path().starts_with("/v2");
    // A path that is not text names no robot; the handler answers with "not found".
    let own = params.iter().flatten().find(|(name, _)| *name == "robot").map(|(_, value)| value);
    let proof = request.extensions().get::<ClientProof>().cloned().unwrap_or_default();
    let proven = guard_state.app.peers.proven(&request);
    let peer = match proven {
        Proven::Client(address) => SocketAddr::new(address, peer.port()),
        Proven::Nothing | Proven::Peer => peer,
    };
    let admitted_request =
        match admit(&guard_state, peer, own, Credentials::of(&request, &proof, proven)).await {
            Ok((caller, token_number)) => check_limits(&guard_state, caller, request.method())
                .await
                .map(|admitted_request| (admitted_request, token_number)),
            Err(error) => Err(error),
        };
    let (AdmittedRequest { mut caller, counted_request }, token_number) = match admitted_request {
        Ok(admitted_request) => admitted_request,
        Err(error) if is_oci => return error.into_oci_response(),
        Err(error) => return error.into_response(),
    };
    if let Caller::Person(person) = &mut caller {
        person.address = Some(peer.ip().to_canonical());
    }
    request.extensions_mut().insert(caller);
    request.extensions_mut().insert(token_number);
    let answer = run_with_deadline(
        request,
        next,
        guard_state.deadline,
        counted_request.map(|counted_request| (guard_state.app.clone(), counted_request)),
    );
    let Some(deadline) = guard_state.deadline else { return answer.await };
    tokio::time::timeout(deadline, answer).await.unwrap_or_else(|_| {
        if !guard_state.app.store.state().is_available() {
            return ApiError::from(Fault::Unreachable).into_response();
        }
        let message = "the request took too long";
        ApiError::new(StatusCode::REQUEST_TIMEOUT, "timeout", message).into_response()
    })
}

/// A request that passed the rate limits.
struct AdmittedRequest {
    caller: Caller,
    counted_request: Option<CountedRequest>,
}

/// A person's request, counted while under way.
struct CountedRequest {
    person: UserName,
    kind: RequestKind,
    permit: RequestPermit,
}

/// Delays or refuses a caller that exceeds a rate limit.
async fn check_limits(
    guard_state: &GuardState,
    caller: Caller,
    method: &Method,
) -> Result<AdmittedRequest, ApiError> {
    let counted_request = match &caller {
        Caller::Person(person) => {
            let kind = match guard_state.waits_for_robot {
                true => RequestKind::Question,
                false => {
                    RequestKind::of(guard_state.access, method, guard_state.deadline.is_none())
                }
            };
            let permit = guard_state.app.people.begin(&person.name, kind).await?;
            Some(CountedRequest { person: person.name.clone(), kind, permit })
        }
        Caller::Robot(robot) => {
            if let Some(channel) = rate_limited_as(guard_state.access, method) {
                throttle(&guard_state.app, robot, channel, method).await?;
            }
            None
        }
        Caller::Anyone | Caller::Enrollment(_) | Caller::Peer => None,
    };
    Ok(AdmittedRequest { caller, counted_request })
}

/// The channel under which a robot's request is rate-limited. `None` for pulls of package bytes, which
/// have limits of their own.
fn rate_limited_as(access: Access, method: &Method) -> Option<Channel> {
    match access {
        Access::OwnRobot => Some(Channel::Http),
        Access::PersonOrRobot if *method != Method::GET => Some(Channel::Outputs),
        _ => None,
    }
}

/// Runs the handler. A request that changes state runs to its end even if the client disconnects,
/// because steps after the commit, such as cutting off callers without rights, belong to the
/// request. Only its body has to arrive within the deadline.
async fn run_with_deadline(
    request: Request,
    next: Next,
    deadline: Option<Duration>,
    counted_request: Option<(App, CountedRequest)>,
) -> Response {
    if request.method().is_safe() {
        return run(request, next, counted_request).await;
    }
    let request = match deadline {
        Some(deadline) => request.map(|body| with_body_deadline(deadline, body)),
        None => request,
    };
    match tokio::spawn(run(request, next, counted_request)).await {
        Ok(response) => response,
        Err(panic) => std::panic::resume_unwind(panic.into_panic()),
    }
}

/// Runs the handler. People's requests other than orders leave some of the database connections to
/// robots and orders.
async fn run(
    request: Request,
    next: Next,
    counted_request: Option<(App, CountedRequest)>,
) -> Response {
    let Some((app, CountedRequest { person, kind, permit })) = counted_request else {
        return next.run(request).await;
    };
    let response = match kind {
        RequestKind::Order => next.run(request).await,
        _ => with_shared_reads(next.run(request)).await,
    };
    if kind != RequestKind::Stream {
        app.people.charge_answer(&person, kind, response.body().size_hint().lower());
    }
    drop(permit);
    response
}

/// A body that fails when its end has not arrived by the deadline.
fn with_body_deadline(deadline: Duration, body: Body) -> Body {
    let end = Instant::now() + deadline;
    Body::from_stream(stream::unfold(body.into_data_stream(), move |mut chunks| async move {
        match timeout_at(end, chunks.next()).await {
            Ok(chunk) => chunk.map(|chunk| (chunk, chunks)),
            Err(late) => Some((Err(axum::Error::new(late)), chunks)),
        }
    }))
}

/// The parts of a request that identify its sender.
struct Credentials<'a> {
    method: &'a Method,
    headers: &'a HeaderMap,
    proof: &'a ClientProof,
    connection: Option<&'a Connection>,
    is_peer: bool,
}

impl<'a> Credentials<'a> {
    fn of(request: &'a Request, proof: &'a ClientProof, proven: Proven) -> Self {
        Self {
            method: request.method(),
            headers: request.headers(),
            is_peer: proven == Proven::Peer,
            proof,
            connection: request.extensions().get(),
        }
    }
}

async fn admit(
    guard_state: &GuardState,
    peer: SocketAddr,
    own: Option<&str>,
    credentials: Credentials<'_>,
) -> Result<(Caller, TokenNumber), ApiError> {
    if guard_state.access == Access::Anyone {
        return Ok((Caller::Anyone, TokenNumber(0)));
    }
    if guard_state.access == Access::Peer && credentials.is_peer {
        if let Some(connection) = credentials.connection {
            connection.authenticate();
        }
        return Ok((Caller::Peer, TokenNumber(0)));
    }
    match identify_on_connection(&guard_state.app, &credentials).await {
        Ok((caller, token_number)) if caller.may(guard_state.access, own) => {
            Ok((caller, token_number))
        }
        Ok((Caller::Anyone, _)) => {
            Err(ApiError::unauthorized("a token is required: Authorization: Bearer …"))
        }
        Ok((Caller::Person(person), _)) if let Access::Person(permission) = guard_state.access => {
            Err(not_permitted(&person, permission))
        }
        Ok(_) => Err(ApiError::forbidden("this token does not permit the request")),
        // The robot's token was known, so this is no guessing attempt.
        Err(error) if error.code == ROBOT_REVOKED => Err(error),
        Err(error) if error.status == StatusCode::UNAUTHORIZED => {
            let is_too_many =
                guard_state.app.attempts.record(peer.ip(), guard_state.app.clock.now_ms());
            Err(if is_too_many {
                ApiError::too_many("too many invalid tokens from this address")
            } else {
                error
            })
        }
        Err(error) => Err(error),
    }
}

/// Names the missing permission, so that people know which right to ask for.
pub(super) fn not_permitted(person: &Person, permission: Permission) -> ApiError {
    let (name, roles) = (&person.name, &person.roles);
    ApiError::forbidden(if person.roles.allow(permission) {
        format!(
            "{name} is limited to the robots {:?}, and this request concerns all robots",
            person.scope.to_string()
        )
    } else {
        format!("{name} has no permission to {permission} (roles: {roles})")
    })
}

/// Identifies the caller and assigns the connection to this caller; a robot's connection is cut
/// when the robot is removed or revoked. A request without a token changes nothing: the connection
/// stays with the last token shown.
async fn identify_on_connection(
    app: &App,
    credentials: &Credentials<'_>,
) -> Result<(Caller, TokenNumber), ApiError> {
    let arrival = app.http_connections.arrival();
    let identified = identify(app, credentials).await?;
    let (Some(connection), Some(holder)) = (credentials.connection, identified.0.holder()) else {
        return Ok(identified);
    };
    let is_still_good = arrival.identified(&holder, connection);
    if is_still_good || !matches!(holder, Holder::Robot(_)) {
        Ok(identified)
    } else {
        identify(app, credentials).await
    }
}

/// Identifies the sender of a request. `Anyone` without credentials; an error for invalid
/// credentials.
async fn identify(
    app: &App,
    credentials: &Credentials<'_>,
) -> Result<(Caller, TokenNumber), ApiError> {
    let &Credentials { method, headers, .. } = credentials;
    let now_ms = app.clock.now_ms();
    let is_read = matches!(*method, Method::GET | Method::HEAD);
    let token = if let Some(value) = headers.get(header::AUTHORIZATION) {
        let PresentedToken { text, is_from_browser } = parse_authorization(value)?;
        // Browsers keep a site's password and attach it to requests that another page triggers.
        // Programs send no origin.
        if is_from_browser && !is_read && is_from_browser_page(headers) {
            require_same_origin(headers)?;
        }
        parse_token(&text)?
    } else {
        let person = find_session(app, credentials, now_ms).await?;
        if person.is_some() && !is_read {
            require_same_origin(headers)?;
        }
        return Ok((person.map_or(Caller::Anyone, Caller::Person), TokenNumber(0)));
    };
    let Some(holder) = authenticate(app, &token, credentials, now_ms).await? else {
        if app.store.tokens().belongs_to_revoked_robot(&token).await? {
            return Err(ApiError::robot_revoked());
        }
        return Err(ApiError::unauthorized("the token is unknown, expired or revoked"));
    };
    Ok(match holder {
        TokenHolder::Person(person) => (Caller::Person(person), TokenNumber(0)),
        TokenHolder::Enrollment => (Caller::Enrollment(Box::new(token)), TokenNumber(0)),
        TokenHolder::Pending { .. } => return Err(ApiError::awaits_approval()),
        TokenHolder::Robot { robot, token_number, .. } => {
            (Caller::Robot(robot), TokenNumber(token_number))
        }
    })
}

/// The holder of this token, if valid. Runs to the end even if the client disconnects: a robot's
/// first use of a token has then ended its other tokens, and connections made with those have to be
/// closed.
async fn authenticate(
    app: &App,
    token: &Token,
    credentials: &Credentials<'_>,
    now_ms: u64,
) -> Result<Option<TokenHolder>, StoreError> {
    let (app, token, proof) = (app.clone(), token.clone(), credentials.proof.clone());
    let connection = credentials.connection.cloned();
    let _lookup = match &connection {
        Some(connection) => Some(connection.lookup().await),
        None => None,
    };
    let admitting = tokio::spawn(async move {
        let Some(Admitted { holder, is_first_use }) =
            app.store.tokens().admit(&token, &proof, now_ms).await?
        else {
            return Ok(None);
        };
        if let Some(connection) =
            connection.as_ref().filter(|_| !matches!(holder, TokenHolder::Pending { .. }))
        {
            connection.authenticate();
        }
        if let TokenHolder::Robot { robot, token_number, .. } = &holder
            && is_first_use
        {
            // Existing connections used the token that has just ended. This request's own
            // connection stays.
            app.broker.disconnect(robot);
            if let Some(connection) = connection {
                connection.release();
            }
            let (presence, connections) = (&app.presence, &app.http_connections);
            announce_new_token(presence, connections, &app.changes, robot, *token_number);
        }
        Ok(Some(holder))
    });
    match admitting.await {
        Ok(admitted) => admitted,
        Err(panic) => std::panic::resume_unwind(panic.into_panic()),
    }
}

/// The person of the page session whose cookie the request has, if any.
async fn find_session(
    app: &App,
    credentials: &Credentials<'_>,
    now_ms: u64,
) -> Result<Option<Person>, StoreError> {
    let Some(session) = session_digest(credentials.headers) else { return Ok(None) };
    let _lookup = match credentials.connection {
        Some(connection) => Some(connection.lookup().await),
        None => None,
    };
    let person = app.store.page_sessions().admit(&session, now_ms).await?;
    if person.is_some()
        && let Some(connection) = credentials.connection
    {
        connection.authenticate();
    }
    Ok(person)
}

/// The digest of a request's session cookie, under which the session is stored.
pub(super) fn session_digest(headers: &HeaderMap) -> Option<Digest> {
    let id = cookie(headers, COOKIE).filter(|id| !id.is_empty())?;
    Some(Digest::of(id.as_bytes()))
}

/// The value of a request's cookie.
pub(super) fn cookie<'a>(headers: &'a HeaderMap, wanted: &str) -> Option<&'a str> {
    let lines = headers.get_all(header::COOKIE).iter().filter_map(|value| value.to_str().ok());
    let mut pairs =
        lines.flat_map(|line| line.split(';')).filter_map(|pair| pair.trim().split_once('='));
    pairs.find(|(name, _)| *name == wanted).map(|(_, value)| value)
}

/// The token in these headers.
pub(super) fn authorization_token(headers: &HeaderMap) -> Result<Token, ApiError> {
    let value = headers.get(header::AUTHORIZATION);
    let value =
        value.ok_or_else(|| ApiError::unauthorized("Authorization: the header is missing"))?;
    parse_token(&parse_authorization(value)?.text)
}

fn parse_token(token: &str) -> Result<Token, ApiError> {
    token.parse().map_err(|error| ApiError::unauthorized(format!("Authorization: {error}")))
}

/// The token in an `Authorization` header.
#[derive(Debug, PartialEq, Eq)]
struct PresentedToken {
    text: String,
    /// True for a password (`Basic`), which a browser attaches by itself once the user has entered
    /// one.
    is_from_browser: bool,
}

fn parse_authorization(value: &HeaderValue) -> Result<PresentedToken, ApiError> {
    let token = value.to_str().ok().and_then(parse_credentials);
    token.ok_or_else(|| {
        ApiError::unauthorized("Authorization: expected Bearer or Basic and a token")
    })
}

/// The token of `Bearer TOKEN` or `Basic base64(anything:TOKEN)`.
fn parse_credentials(value: &str) -> Option<PresentedToken> {
    let (scheme, rest) = value.trim().split_once(' ')?;
    if scheme.eq_ignore_ascii_case("bearer") {
        return Some(PresentedToken { text: rest.trim().to_owned(), is_from_browser: false });
    }
    if !scheme.eq_ignore_ascii_case("basic") {
        return None;
    }
    let decoded = String::from_utf8(STANDARD.decode(rest.trim()).ok()?).ok()?;
    let (_, password) = decoded.split_once(':')?;
    Some(PresentedToken { text: password.to_owned(), is_from_browser: true })
}

const SEC_FETCH_SITE: HeaderName = HeaderName::from_static("sec-fetch-site");

/// True if a browser sent this request for a page.
pub(super) fn is_from_browser_page(headers: &HeaderMap) -> bool {
    headers.contains_key(SEC_FETCH_SITE) || headers.contains_key(header::ORIGIN)
}

/// Refuses requests that a foreign page could have triggered in a signed-in browser.
pub(super) fn require_same_origin(headers: &HeaderMap) -> Result<(), ApiError> {
    let text = |name| headers.get(name).and_then(|value: &http::HeaderValue| value.to_str().ok());
    let is_same = match (text(SEC_FETCH_SITE), text(header::ORIGIN)) {
        (Some(site), _) => site == "same-origin",
        (None, Some(origin)) => {
            origin.split_once("://").map(|(_, host)| host) == text(header::HOST)
        }
        (None, None) => false,
    };
    if is_same {
        Ok(())
    } else {
        Err(ApiError::forbidden("Origin: a page may only call its own server"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn token_is_read_from_bearer_and_basic() {
        let token = |text: &str, is_from_browser| {
            Some(PresentedToken { text: text.to_owned(), is_from_browser })
        };
        assert_eq!(parse_credentials("Bearer abc"), token("abc", false));
        assert_eq!(parse_credentials("bearer  abc "), token("abc", false));
        let basic = format!("Basic {}", STANDARD.encode("anyone:a:b"));
        assert_eq!(parse_credentials(&basic), token("a:b", true));
        for bad in
            ["", "Bearer", "Basic !", "Digest abc", &format!("Basic {}", STANDARD.encode("abc"))]
        {
            assert_eq!(parse_credentials(bad), None, "{bad:?}");
        }
    }

    #[test]
    fn session_digest_is_of_the_cookies_value() {
        let with = |text: &'static str| {
            HeaderMap::from_iter([(header::COOKIE, HeaderValue::from_static(text))])
        };
        let digest = Some(Digest::of(b"abc"));
        assert_eq!(session_digest(&with("theme=dark; taskd_session=abc")), digest);
        for none in ["theme=dark", "taskd_session=", "xtaskd_session=abc"] {
            assert_eq!(session_digest(&with(none)), None, "{none}");
        }
        assert_eq!(session_digest(&HeaderMap::new()), None);
    }

    #[test]
    fn changes_require_the_same_origin() {
        let check = |pairs: &[(&'static str, &'static str)]| {
            let headers: HeaderMap = pairs
                .iter()
                .map(|(name, value)| {
                    (http::HeaderName::from_static(name), http::HeaderValue::from_static(value))
                })
                .collect();
            require_same_origin(&headers).is_ok()
        };
        let host = ("host", "fleet.example:8080");
        assert!(check(&[host, ("origin", "http://fleet.example:8080")]));
        assert!(check(&[host, ("sec-fetch-site", "same-origin")]));
        assert!(!check(&[host]));
        assert!(!check(&[host, ("origin", "null")]));
        assert!(!check(&[host, ("origin", "http://evil.example")]));
        assert!(!check(&[host, ("origin", "http://fleet.example:9090")]));
        assert!(!check(&[
            host,
            ("origin", "http://fleet.example:8080"),
            ("sec-fetch-site", "cross-site")
        ]));
    }
}
