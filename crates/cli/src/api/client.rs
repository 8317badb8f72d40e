//! The commands' client of the server's API: one method per call. The client retries transient
//! failures (a lost connection, a 5xx), always with the same idempotency key, and turns every
//! refusal into an error with the server's own words.

use std::cell::Cell;
use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::time::Duration;

use reqwest::header::RETRY_AFTER;
use reqwest::{Method, RequestBuilder, Response, StatusCode};
use serde::Serialize;
use serde::de::DeserializeOwned;
use task_proto::api::{BASE, ErrorBody, IDEMPOTENCY_KEY};
use task_proto::data_directory::{OPERATOR_TOKEN, default_data_directory};
use task_proto::messages::request::{Answer, Ask};
use task_proto::trust::token::{InvalidToken, Token};
use task_proto::{CaPin, RobotName};
use task_transport::Trust;

use super::credentials::{last_server, stored_pin, stored_token};
use crate::display::output::printable;
use crate::{CommandError, Connection, Outcome, clock, local_server};

/// How often a request is tried.
const MAX_TRIES: u32 = 6;
/// The longest pause between two tries.
const MAX_PAUSE: Duration = Duration::from_secs(2);
/// Longest Retry-After the client honours. Above this limit the refusal is shown at once.
const MAX_RETRY_AFTER: Duration = Duration::from_secs(15);
/// Time limit of one answer, uploads excepted.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(60);
/// The largest answer that is read: the list of a large fleet.
const MAX_ANSWER_BYTES: usize = 256 * 1024 * 1024;

/// Why a request to the server failed.
#[derive(Debug, thiserror::Error)]
pub enum ClientError {
    /// The server answered with an error.
    #[error("{message} ({code})")]
    Refused { status: StatusCode, code: String, message: String },
    /// The server could not be reached, or the connection was lost.
    #[error("can't reach the server at {url}{hint}")]
    Unreachable {
        /// Base URL of the server.
        url: String,
        /// A suggestion for the user, in brackets; empty if there is none.
        hint: &'static str,
        source: reqwest::Error,
    },
    /// The answer did not come from taskd.
    #[error("the server at {url} is not taskd (status {status})")]
    NotTaskd { url: String, status: StatusCode },
    /// No server runs on the directory that would contain its address.
    #[error("no server is running on {}: start it with taskd serve, or use --server to select another", data.display())]
    ServerNotRunning { data: PathBuf },
    /// Whether a server runs on the directory can't be determined.
    #[error("can't determine whether a server is running on {}", data.display())]
    DataDirectory { data: PathBuf, source: std::io::Error },
    /// No token was given.
    #[error(
        "no token for {url}: sign in with taskd login NAME, use --token, --token-file or TASKD_TOKEN, or, on the server's \
         machine, --data with its data directory"
    )]
    NoToken { url: String },
    /// The token file can't be read.
    #[error("can't read the token file {}", path.display())]
    TokenFile { path: PathBuf, source: std::io::Error },
    /// The token is malformed.
    #[error("{origin}")]
    Token {
        /// Where the URL came from: a flag, the environment or a file.
        origin: String,
        source: InvalidToken,
    },
    /// The URL is malformed.
    #[error("--server: {url:?} is not an http:// or https:// URL")]
    Url {
        /// The URL as given.
        url: String,
    },
    /// A pin for a server that would be spoken to unencrypted.
    #[error("--pin requires TLS: use https:// in place of {url}")]
    PinWithoutTls {
        /// The URL as given.
        url: String,
    },
}

impl ClientError {
    /// The exit code's meaning.
    pub fn outcome(&self) -> Outcome {
        match self {
            Self::Refused { status: StatusCode::UNAUTHORIZED | StatusCode::FORBIDDEN, .. } => {
                Outcome::NotAllowed
            }
            Self::Refused {
                status: StatusCode::BAD_REQUEST | StatusCode::UNPROCESSABLE_ENTITY,
                ..
            }
            | Self::NoToken { .. }
            | Self::DataDirectory { .. }
            | Self::TokenFile { .. }
            | Self::Token { .. }
            | Self::Url { .. }
            | Self::PinWithoutTls { .. } => Outcome::Usage,
            Self::Refused { code, .. }
                if ["no_robots_match", "unknown_robots"].contains(&code.as_str()) =>
            {
                Outcome::Usage
            }
            Self::Refused { .. }
            | Self::Unreachable { .. }
            | Self::NotTaskd { .. }
            | Self::ServerNotRunning { .. } => Outcome::Failed,
        }
    }

    /// Turns an unknown-robot refusal for `robot` into the message that all commands share.
    pub(crate) fn for_robot(self, robot: &RobotName) -> CommandError {
        match self {
            Self::Refused { status: StatusCode::NOT_FOUND, .. } => unknown_robot(robot),
            error => error.into(),
        }
    }
}

/// Client for one server with one token.
pub(crate) struct Client {
    http: reqwest::Client,
    base: String,
    token: Option<Token>,
    trust: Trust,
}

impl Client {
    /// Finds server and token; nothing is sent yet.
    pub(crate) fn connect(connection: &Connection) -> Result<Self, CommandError> {
        let client = Self::anonymous(connection)?;
        let token = find_token(connection, data_directory(connection).as_deref(), &client.base)?;
        Ok(Self { token: Some(token), ..client })
    }

    /// The same server with the token that is stored for that server.
    pub(crate) fn with_token(self, token: &str) -> Result<Self, ClientError> {
        let token = token.parse().map_err(|source| ClientError::Token {
            origin: "the stored token".to_owned(),
            source,
        })?;
        Ok(Self { token: Some(token), ..self })
    }

    /// Finds the server alone, to ask for a token.
    pub(crate) fn anonymous(connection: &Connection) -> Result<Self, CommandError> {
        let (base, known_pin) = find_server(connection, data_directory(connection).as_deref())?;
        let url = reqwest::Url::parse(&base).ok();
        let is_http = |url: &reqwest::Url| {
            matches!(url.scheme(), "http" | "https") && url.has_host() && url.query().is_none()
        };
        let Some(url) = url.filter(is_http) else {
            return Err(ClientError::Url { url: base }.into());
        };
        if connection.pin.is_some() && url.scheme() == "http" {
            return Err(ClientError::PinWithoutTls { url: base }.into());
        }
        let trust = Trust::by(connection.pin.or(known_pin).or_else(|| stored_pin(&base)));
        let http = reqwest::Client::builder()
            .tls_backend_preconfigured(trust.client_config(clock::for_certificates()))
            .connect_timeout(Duration::from_secs(10))
            .redirect(reqwest::redirect::Policy::none())
            .user_agent(concat!("taskd/", env!("CARGO_PKG_VERSION")))
            .build()
            .map_err(|source| ClientError::Unreachable { url: base.clone(), hint: "", source })?;
        Ok(Self { http, base, token: None, trust })
    }

    pub(crate) fn base(&self) -> &str {
        &self.base
    }

    /// Host and port of the server's URL.
    pub(crate) fn host_and_port(&self) -> (String, u16) {
        let url = reqwest::Url::parse(&self.base).ok();
        let host = url.as_ref().and_then(|url| url.host_str()).unwrap_or_default().to_owned();
        (host, url.and_then(|url| url.port_or_known_default()).unwrap_or_default())
    }

    /// The request path on the server, including the path prefix of the server's URL.
    pub(crate) fn path(&self, path: &str) -> String {
        let own =
            reqwest::Url::parse(&self.base).map(|url| url.path().trim_end_matches('/').to_owned());
        format!("{}{path}", own.unwrap_or_default())
    }

    /// How the client authenticates the server.
    pub(crate) fn trust(&self) -> Trust {
        self.trust
    }

    /// Reads from the API.
    pub(crate) async fn get<T: DeserializeOwned>(
        &self,
        path: &str,
        query: &[(&str, String)],
    ) -> Result<T, ClientError> {
        self.answer(|| self.request(Method::GET, &format!("{BASE}{path}")).query(query)).await
    }

    /// Reads JSON from any path of the server.
    pub(crate) async fn get_path<T: DeserializeOwned>(&self, path: &str) -> Result<T, ClientError> {
        self.answer(|| self.request(Method::GET, path)).await
    }

    /// GET with a query of this type.
    pub(crate) async fn get_with<Q: Serialize, T: DeserializeOwned>(
        &self,
        path: &str,
        query: &Q,
    ) -> Result<T, ClientError> {
        self.answer(|| self.request(Method::GET, &format!("{BASE}{path}")).query(query)).await
    }

    /// Opens a stream, without retries and without a time limit.
    pub(crate) async fn stream<Q: Serialize>(
        &self,
        path: &str,
        query: &Q,
    ) -> Result<Response, ClientError> {
        const NO_LIMIT: Duration = Duration::from_secs(10 * 365 * 24 * 60 * 60);
        let request =
            self.request(Method::GET, &format!("{BASE}{path}")).query(query).timeout(NO_LIMIT);
        let response = request.send().await.map_err(|source| self.unreachable(source))?;
        match response.status().is_success() {
            true => Ok(response),
            false => Err(self.refusal(response).await),
        }
    }

    /// Deletes; the answer's body does not matter.
    pub(crate) async fn delete(&self, path: &str) -> Result<(), ClientError> {
        let (path, tried) = (format!("{BASE}{path}"), Cell::new(0));
        let request = || {
            tried.set(tried.get() + 1);
            self.request(Method::DELETE, &path)
        };
        match self.send(request).await {
            // The first try, whose answer was lost, has deleted the resource.
            Err(ClientError::Refused { status: StatusCode::NOT_FOUND, .. }) if tried.get() > 1 => {
                Ok(())
            }
            sent => sent.map(drop),
        }
    }

    /// Sends an idempotent request without a body; the answer's body is ignored.
    pub(crate) async fn post(&self, path: &str) -> Result<(), ClientError> {
        let path = format!("{BASE}{path}");
        self.send(|| self.request(Method::POST, &path)).await.map(drop)
    }

    /// Replaces a resource; the answer's body is ignored.
    pub(crate) async fn put<B: Serialize>(&self, path: &str, body: &B) -> Result<(), ClientError> {
        let path = format!("{BASE}{path}");
        self.send(|| self.request(Method::PUT, &path).json(body)).await.map(drop)
    }

    /// Sends an idempotent change with this body; safe to retry.
    pub(crate) async fn patch<B: Serialize, T: DeserializeOwned>(
        &self,
        path: &str,
        body: &B,
    ) -> Result<T, ClientError> {
        self.answer(|| self.request(Method::PATCH, &format!("{BASE}{path}")).json(body)).await
    }

    /// Sends a request that is not idempotent, and therefore never retries.
    pub(crate) async fn post_once<B: Serialize, T: DeserializeOwned>(
        &self,
        path: &str,
        body: &B,
    ) -> Result<T, ClientError> {
        let request = self.request(Method::POST, &format!("{BASE}{path}")).json(body);
        let response = request.send().await.map_err(|source| self.unreachable(source))?;
        match response.status().is_success() {
            true => self.body(response).await,
            false => Err(self.refusal(response).await),
        }
    }

    /// Sends an order. Retries are safe: `key` is the idempotency key, so the order is carried out
    /// once.
    pub(crate) async fn post_with_key<B: Serialize, T: DeserializeOwned>(
        &self,
        path: &str,
        body: &B,
        key: &str,
    ) -> Result<T, ClientError> {
        self.answer(|| {
            self.request(Method::POST, &format!("{BASE}{path}"))
                .header(IDEMPOTENCY_KEY, key)
                .json(body)
        })
        .await
    }

    /// Sends a request to a robot. Never retried: the robot may have acted although no answer
    /// arrived.
    pub(crate) async fn query_robot(
        &self,
        robot: &RobotName,
        ask: &Ask,
    ) -> Result<Answer, CommandError> {
        self.post_once(&format!("/robots/{robot}/ask"), ask)
            .await
            .map_err(|error: ClientError| error.for_robot(robot))
    }

    /// A request with the token, to a path below the server's URL or to a whole URL of the same
    /// server.
    pub(crate) fn request(&self, method: Method, path: &str) -> RequestBuilder {
        let url =
            if path.starts_with('/') { format!("{}{path}", self.base) } else { path.to_owned() };
        let request = self.http.request(method, url).timeout(ANSWER_TIMEOUT);
        match &self.token {
            Some(token) => request.bearer_auth(token.reveal()),
            None => request,
        }
    }

    async fn answer<T: DeserializeOwned>(
        &self,
        request: impl Fn() -> RequestBuilder,
    ) -> Result<T, ClientError> {
        let response = self.send(request).await?;
        self.body(response).await
    }

    async fn body<T: DeserializeOwned>(&self, mut response: Response) -> Result<T, ClientError> {
        let status = response.status();
        let mut body = Vec::new();
        while let Some(chunk) = response.chunk().await.map_err(|source| self.unreachable(source))? {
            if body.len() + chunk.len() > MAX_ANSWER_BYTES {
                return Err(self.not_taskd(status));
            }
            body.extend_from_slice(&chunk);
        }
        serde_json::from_slice(&body).map_err(|_| self.not_taskd(status))
    }

    /// Sends until the answer is final: success, or a refusal that a retry does not change.
    pub(crate) async fn send(
        &self,
        request: impl Fn() -> RequestBuilder,
    ) -> Result<Response, ClientError> {
        let mut tried = 0;
        loop {
            tried += 1;
            let (error, wait) = match request().send().await {
                Ok(response) if response.status().is_success() => return Ok(response),
                Ok(response) => {
                    let (status, wait) = (response.status(), retry_after(&response));
                    // A server with a 5xx may recover sooner than its Retry-After says; a
                    // deliberate refusal knows its own time.
                    let wait = if status.is_server_error() {
                        wait.map(|wait| wait.min(MAX_PAUSE))
                    } else {
                        wait
                    };
                    let error = self.refusal(response).await;
                    if !(status.is_server_error() || status == StatusCode::TOO_MANY_REQUESTS) {
                        return Err(error);
                    }
                    (error, wait)
                }
                Err(source) if source.is_builder() => return Err(self.unreachable(source)),
                Err(source) => (self.unreachable(source), None),
            };
            if tried >= MAX_TRIES || wait.is_some_and(|wait| wait > MAX_RETRY_AFTER) {
                return Err(error);
            }
            tokio::time::sleep(wait.unwrap_or_else(|| pause(tried, rand::random()))).await;
        }
    }

    /// Reads the error out of an unsuccessful response.
    pub(crate) async fn refusal(&self, response: Response) -> ClientError {
        const MAX_ERROR_BYTES: usize = 64 * 1024;
        let status = response.status();
        let mut response = response;
        let mut body = Vec::new();
        while let Ok(Some(chunk)) = response.chunk().await {
            body.extend_from_slice(&chunk);
            if body.len() > MAX_ERROR_BYTES {
                break;
            }
        }
        if body.is_empty() {
            // The answer to a HEAD has only its status.
            let message = status.canonical_reason().unwrap_or("refused").to_lowercase();
            return ClientError::Refused { status, code: status.as_str().to_owned(), message };
        }
        // The server's message may contain a robot's own words.
        let refused = |code: &str, message: &str| ClientError::Refused {
            status,
            code: printable(code),
            message: printable(message),
        };
        if let Ok(ErrorBody { error }) = serde_json::from_slice(&body) {
            return refused(&error.code, &error.message);
        }
        match serde_json::from_slice::<RegistryErrors>(&body)
            .ok()
            .and_then(|errors| errors.errors.into_iter().next())
        {
            Some(error) => refused(&error.code.to_lowercase(), &error.message),
            None => self.not_taskd(status),
        }
    }

    pub(crate) fn unreachable(&self, source: reqwest::Error) -> ClientError {
        // Our own message has the URL; reqwest's would repeat the URL.
        let hint = hint(&self.base, &source);
        ClientError::Unreachable { url: self.base.clone(), hint, source: source.without_url() }
    }

    pub(crate) fn not_taskd(&self, status: StatusCode) -> ClientError {
        ClientError::NotTaskd { url: self.base.clone(), status }
    }
}

/// A hint for requests with the wrong scheme, as far as the error shows.
fn hint(base: &str, error: &reqwest::Error) -> &'static str {
    let causes = std::iter::successors(std::error::Error::source(error), |cause| cause.source());
    let causes_text = causes.map(ToString::to_string).collect::<Vec<_>>().join(": ");
    match base.starts_with("https:") {
        false if causes_text.contains("invalid HTTP version") => {
            " (the server seems to use TLS: try https://)"
        }
        true if causes_text.contains("InvalidContentType") => {
            " (the server does not seem to use TLS: try http://)"
        }
        true if causes_text.contains("UnknownIssuer") => {
            " (its certificate is not trusted here: use --pin with the pin that taskd serve printed)"
        }
        _ => "",
    }
}

/// The error body of the OCI distribution API.
#[derive(serde::Deserialize)]
struct RegistryErrors {
    errors: Vec<RegistryError>,
}

#[derive(serde::Deserialize)]
struct RegistryError {
    code: String,
    #[serde(default)]
    message: String,
}

/// Full jitter: anything up to a bound that doubles with each try. `random` is any number.
fn pause(tried: u32, random: u32) -> Duration {
    let bound = Duration::from_millis(200).saturating_mul(1 << tried.min(10)).min(MAX_PAUSE);
    bound.mul_f64(f64::from(random) / f64::from(u32::MAX))
}

fn retry_after(response: &Response) -> Option<Duration> {
    let seconds: u64 = response.headers().get(RETRY_AFTER)?.to_str().ok()?.parse().ok()?;
    Some(Duration::from_secs(seconds))
}

/// Explicit options win, then a server on this machine, then the last login. A given directory
/// means the server of that directory and no other.
fn find_server(
    connection: &Connection,
    data: Option<&Path>,
) -> Result<(String, Option<CaPin>), ClientError> {
    if let Some(url) = &connection.server {
        return Ok((url.trim_end_matches('/').to_owned(), None));
    }
    let is_named = connection.data.is_some();
    let local = match data.map(|data| (data, local_server::addresses(data))) {
        Some((data, Err(source))) if is_named => {
            return Err(ClientError::DataDirectory { data: data.to_owned(), source });
        }
        Some((_, local)) => local.ok().flatten(),
        None => None,
    };
    let local = local.map(|addresses| (addresses.url(), addresses.ca_pin));
    if let Some(server) =
        local.or_else(|| if is_named { None } else { Some((last_server()?, None)) })
    {
        return Ok(server);
    }
    match data.filter(|data| is_named || data.join(OPERATOR_TOKEN).exists()) {
        Some(data) => Err(ClientError::ServerNotRunning { data: data.to_owned() }),
        None => Ok(("http://127.0.0.1:8080".to_owned(), None)),
    }
}

pub(crate) fn data_directory(connection: &Connection) -> Option<PathBuf> {
    let named = connection.data.as_ref().map(PathBuf::from);
    named.or_else(|| default_data_directory(|name| std::env::var_os(name)))
}

/// Explicit options win, then the last login, then the file where a server on this machine would
/// store the token.
fn find_token(
    connection: &Connection,
    data: Option<&Path>,
    base: &str,
) -> Result<Token, ClientError> {
    // The token in a directory is sent only to the server of that directory.
    let data = data.filter(|data| serves_from(data, base));
    let is_given = connection.token.is_some() || connection.token_file.is_some();
    let names_data = connection.data.is_some() && data.is_some();
    if !is_given
        && !names_data
        && let Some(token) = stored_token(base)
    {
        return Ok(token);
    }
    let (text, origin) = match (&connection.token_file, &connection.token, data) {
        (Some(path), _, _) => (read_token(path)?, path.display().to_string()),
        (None, Some(token), _) => (token.clone(), "--token or TASKD_TOKEN".to_owned()),
        (None, None, Some(data)) => {
            let path = data.join(OPERATOR_TOKEN);
            if connection.data.is_none() && !path.exists() {
                return Err(ClientError::NoToken { url: base.to_owned() });
            }
            (read_token(&path)?, path.display().to_string())
        }
        (None, None, None) => return Err(ClientError::NoToken { url: base.to_owned() }),
    };
    text.parse().map_err(|source| ClientError::Token { origin, source })
}

/// Whether the server at `base` is the server of directory `data`.
fn serves_from(data: &Path, base: &str) -> bool {
    let Ok(Some(addresses)) = local_server::addresses(data) else { return false };
    let local = addresses.url();
    let port =
        |url: &str| reqwest::Url::parse(url).ok().and_then(|url| url.port_or_known_default());
    let is_here = reqwest::Url::parse(base).is_ok_and(|url| {
        let host = url.host_str().unwrap_or_default().trim_matches(['[', ']']);
        host == "localhost" || host.parse::<IpAddr>().is_ok_and(|address| address.is_loopback())
    });
    local == base || (is_here && port(&local) == port(base))
}

fn read_token(path: &Path) -> Result<String, ClientError> {
    std::fs::read_to_string(path)
        .map_err(|source| ClientError::TokenFile { path: path.to_owned(), source })
}

/// An idempotency key for an order without a given one.
pub(crate) fn random_key() -> String {
    format!("{:032x}", rand::random::<u128>())
}

/// No robot has this name: a mistake in the command.
pub(crate) fn unknown_robot(name: &RobotName) -> CommandError {
    CommandError::Usage(no_such_robots(std::slice::from_ref(name)))
}

/// The error for robot names that do not exist.
pub(crate) fn no_such_robots(names: &[RobotName]) -> String {
    let names: Vec<&str> = names.iter().map(RobotName::as_str).collect();
    format!("no robot has the name or id {}", names.join(", "))
}

#[cfg(test)]
mod tests {
    use task_proto::data_directory::Addresses;

    use super::*;
    use crate::local_server::tests::RunningServer;

    fn empty_connection() -> Connection {
        let output = crate::Format::Json;
        Connection { server: None, token: None, pin: None, token_file: None, data: None, output }
    }

    #[test]
    fn pauses_grow_to_a_bound() {
        assert_eq!(pause(1, u32::MAX), Duration::from_millis(400));
        assert_eq!(pause(30, u32::MAX), MAX_PAUSE);
        assert_eq!(pause(3, 0), Duration::ZERO);
    }

    #[test]
    fn exit_codes_follow_the_status() {
        let refused = |status, code: &str| {
            ClientError::Refused { status, code: code.to_owned(), message: String::new() }.outcome()
        };
        assert_eq!(refused(StatusCode::UNAUTHORIZED, "unauthorized"), Outcome::NotAllowed);
        assert_eq!(refused(StatusCode::FORBIDDEN, "forbidden"), Outcome::NotAllowed);
        assert_eq!(refused(StatusCode::CONFLICT, "no_robots_match"), Outcome::Usage);
        assert_eq!(refused(StatusCode::NOT_FOUND, "not_found"), Outcome::Failed);
        assert_eq!(refused(StatusCode::BAD_REQUEST, "invalid_request"), Outcome::Usage);
    }

    /// A server that answers 503 twice and then lists the idempotency keys of the requests.
    async fn busy_server() -> std::net::SocketAddr {
        use std::sync::{Arc, Mutex};

        use axum::http::HeaderMap;
        use axum::response::IntoResponse as _;
        let keys = Arc::new(Mutex::new(Vec::new()));
        let order = move |headers: HeaderMap| async move {
            let mut keys = keys.lock().unwrap();
            keys.push(headers[IDEMPOTENCY_KEY].to_str().unwrap().to_owned());
            match keys.len() {
                3 => axum::Json(keys.clone()).into_response(),
                _ => {
                    (StatusCode::SERVICE_UNAVAILABLE, [(RETRY_AFTER, "0")], "busy").into_response()
                }
            }
        };
        let router = axum::Router::new()
            .route("/api/v1/orders", axum::routing::post(order))
            .route("/api/v1/there", axum::routing::delete(gone_with_the_answer))
            .route("/api/v1/refused", axum::routing::get(hostile_refusal))
            .route(
                "/api/v1/page",
                axum::routing::get(|| async { "<html>sign in to the hotel's network</html>" }),
            );
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        tokio::spawn(async move { axum::serve(listener, router).await });
        address
    }

    /// Deletes, then answers as a proxy that lost its server; the deleted resource is gone.
    async fn gone_with_the_answer() -> axum::response::Response {
        use std::sync::atomic::{AtomicBool, Ordering};

        use axum::response::IntoResponse as _;
        static WAS_ASKED: AtomicBool = AtomicBool::new(false);
        let error =
            serde_json::json!({ "error": { "code": "not_found", "message": "there is none" } });
        match WAS_ASKED.swap(true, Ordering::SeqCst) {
            false => (StatusCode::BAD_GATEWAY, [(RETRY_AFTER, "0")], "").into_response(),
            true => (StatusCode::NOT_FOUND, axum::Json(error)).into_response(),
        }
    }

    async fn hostile_refusal() -> impl axum::response::IntoResponse {
        let error = serde_json::json!({ "code": "rejected", "message": "no\u{1b}[2J\nway" });
        (StatusCode::CONFLICT, axum::Json(serde_json::json!({ "error": error })))
    }

    fn client(address: std::net::SocketAddr) -> Client {
        let token = Token::random(task_proto::trust::token::TokenKind::Operator).reveal();
        let server = Some(format!("http://{address}/"));
        Client::connect(&Connection { server, token: Some(token), ..empty_connection() }).unwrap()
    }

    #[tokio::test]
    async fn order_is_retried_with_the_same_key() {
        let client = client(busy_server().await);
        let keys: Vec<String> =
            client.post_with_key("/orders", &serde_json::json!({}), "k1").await.unwrap();
        assert_eq!(keys, ["k1", "k1", "k1"]);
    }

    #[tokio::test]
    async fn delete_succeeds_although_its_answer_was_lost() {
        let client = client(busy_server().await);
        client.delete("/there").await.expect("it was there at the first try");
        let missing = client.delete("/there").await.expect_err("it was not there at all");
        assert_eq!(missing.to_string(), "there is none (not_found)");
    }

    #[tokio::test]
    async fn refusal_has_no_terminal_control_characters() {
        let client = client(busy_server().await);
        let error = client.get::<String>("/refused", &[]).await.unwrap_err();
        assert_eq!(error.to_string(), "no [2J way (rejected)");
    }

    #[tokio::test]
    async fn answer_of_another_program_is_an_error() {
        let client = client(busy_server().await);
        let answer = client.get::<Vec<String>>("/page", &[]).await;
        assert!(matches!(answer, Err(ClientError::NotTaskd { .. })), "{answer:?}");
    }

    #[test]
    fn token_of_a_directory_is_sent_to_its_own_server_only() {
        let dir = tempfile::tempdir().unwrap();
        let token = Token::random(task_proto::trust::token::TokenKind::Operator).reveal();
        std::fs::write(dir.path().join("operator.token"), token).unwrap();
        let server = RunningServer::start(dir.path());
        let (http, mqtt) = ("10.0.0.7:8081".to_owned(), "10.0.0.7:1884".to_owned());
        server.publish(&Addresses { http, mqtt, ca_pin: None });
        let mut connection =
            Connection { data: Some(dir.path().display().to_string()), ..empty_connection() };
        let mut finds = |server: Option<&str>| {
            connection.server = server.map(str::to_owned);
            match Client::connect(&connection) {
                Ok(client) => client.token.is_some(),
                Err(CommandError::Client(
                    ClientError::NoToken { .. } | ClientError::ServerNotRunning { .. },
                )) => false,
                Err(other) => panic!("{other}"),
            }
        };
        for own in [
            None,
            Some("http://10.0.0.7:8081"),
            Some("http://localhost:8081"),
            Some("http://[::1]:8081/"),
        ] {
            assert!(finds(own), "{own:?}");
        }
        for other in
            ["https://10.0.0.8:8081", "http://localhost.example:8081", "http://127.0.0.1:9"]
        {
            assert!(!finds(Some(other)), "{other}");
        }
        // A killed server leaves its address file behind; any listener there now is another
        // process.
        drop(server);
        for anyone in [
            None,
            Some("http://10.0.0.7:8081"),
            Some("http://localhost:8081"),
            Some("http://127.0.0.1:9"),
        ] {
            assert!(!finds(anyone), "{anyone:?}");
        }
    }

    #[tokio::test]
    async fn wrong_scheme_gets_a_hint() {
        let plain = busy_server().await;
        let client = |url: String, pin: Option<CaPin>| {
            let token = Some(Token::random(task_proto::trust::token::TokenKind::Operator).reveal());
            Client::connect(&Connection { server: Some(url), token, pin, ..empty_connection() })
        };
        let error =
            client(format!("https://{plain}"), None).unwrap().delete("/refused").await.unwrap_err();
        assert!(
            error.to_string().ends_with("(the server does not seem to use TLS: try http://)"),
            "{error}"
        );
        let refused = client(format!("http://{plain}"), Some(CaPin::of(b"an authority's key")))
            .err()
            .unwrap();
        assert!(refused.to_string().ends_with(&format!("in place of http://{plain}")), "{refused}");
        assert_eq!(refused.outcome(), Outcome::Usage);
    }

    #[test]
    fn local_server_is_found_by_its_data_directory() {
        let dir = tempfile::tempdir().unwrap();
        let connection =
            Connection { data: Some(dir.path().display().to_string()), ..empty_connection() };
        let found = || find_server(&connection, Some(dir.path()));
        let down = found().unwrap_err();
        assert!(
            down.to_string()
                .starts_with(&format!("no server is running on {}", dir.path().display()))
        );
        assert_eq!(down.outcome(), Outcome::Failed);
        let server = RunningServer::start(dir.path());
        let mut addresses =
            Addresses { http: "127.0.0.1:8081".to_owned(), mqtt: String::new(), ca_pin: None };
        server.publish(&addresses);
        assert_eq!(found().unwrap(), ("http://127.0.0.1:8081".to_owned(), None));
        addresses.ca_pin = Some(CaPin::of(b"an authority's key"));
        server.publish(&addresses);
        assert_eq!(found().unwrap(), ("https://127.0.0.1:8081".to_owned(), addresses.ca_pin));
        drop(server);
        assert!(dir.path().join("addresses.json").exists() && found().is_err(), "it was killed");
        let _next = RunningServer::start(dir.path());
        assert!(
            matches!(found(), Err(ClientError::ServerNotRunning { .. })),
            "it does not listen yet"
        );
    }
}
