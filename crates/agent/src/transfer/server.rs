//! The HTTP half of the link: enrolls the robot, requests the desired state, and delivers reports.
//! It distinguishes a refusal by the server from an answer by another system (a captive portal, a
//! proxy). It never retries and decides nothing.

use std::time::Duration;

use reqwest::header::{ETAG, HeaderMap, HeaderValue, IF_NONE_MATCH, RETRY_AFTER};
use reqwest::{Method, StatusCode, Url};
use rustls::ClientConfig;
use serde::Serialize;
use serde::de::DeserializeOwned;
use task_proto::api::{
    EnrollRequest, EnrollResponse, ErrorBody, INSTANCE_HEADER, MqttEndpoint, PLACE_HEADER,
    ReportReply, RobotToken,
};
use task_proto::messages::report::Report;
use task_proto::telemetry::vitals::Telemetry;
use task_proto::trust::envelope::Envelope;
use task_proto::{Digest, InstanceId, RobotId};

use crate::transfer::credential::Credential;

/// Longest answer that is read.
const MAX_ANSWER_BYTES: usize = 8 * 1024 * 1024;
/// Timeout for opening a connection.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(10);
/// Timeout for a whole request.
const REQUEST_TIMEOUT: Duration = Duration::from_secs(30);
/// How long an idle connection is kept for the next request. A pull makes several requests in a row
/// and then none for minutes. A fleet's idle connections would cost the server more than its
/// sessions.
pub const IDLE_CONNECTION_TIMEOUT: Duration = Duration::from_secs(3);

/// Reasons for a missing or unusable answer.
#[derive(Debug, thiserror::Error)]
pub enum ServerError {
    /// The connection failed or broke.
    #[error("the server can't be reached")]
    Unreachable(#[source] reqwest::Error),
    /// The answer does not come from taskd.
    #[error("another program answers at the server's address: {0}")]
    NotTheServer(String),
    /// The token is not accepted.
    #[error("the server does not accept the token: {0}")]
    TokenRefused(String),
    /// The server is overloaded, restarting or broken.
    #[error("the server answered {status}")]
    Busy {
        status: u16,
        /// Wait that the server requests.
        retry_after: Option<Duration>,
    },
    /// The server refused the request.
    #[error("the server refused: {message} ({code})")]
    Refused { code: String, message: String },
}

/// Client of the server for one registered robot.
#[derive(Clone)]
pub struct Server {
    client: reqwest::Client,
    base: Url,
    robot: RobotId,
    token: Credential,
    /// Headers of every request that identify the agent.
    identity_headers: HeaderMap,
}

/// A desired state as the server sent it.
#[derive(Debug)]
pub struct DesiredResponse {
    pub envelope: Envelope,
    /// The server's entity tag for exactly these bytes, opaque to the agent.
    pub tag: Option<HeaderValue>,
}

/// Creates the agent's only HTTP client, with this TLS configuration.
pub fn client(tls: ClientConfig) -> Result<reqwest::Client, reqwest::Error> {
    reqwest::Client::builder()
        .tls_backend_preconfigured(tls)
        .connect_timeout(CONNECT_TIMEOUT)
        .timeout(REQUEST_TIMEOUT)
        .pool_idle_timeout(IDLE_CONNECTION_TIMEOUT)
        .redirect(reqwest::redirect::Policy::none())
        .user_agent(concat!("task-agent/", env!("CARGO_PKG_VERSION")))
        .build()
}

pub async fn enroll(
    client: &reqwest::Client,
    base: &Url,
    token: &str,
    request: &EnrollRequest,
) -> Result<EnrollResponse, ServerError> {
    let answer =
        send(client, Method::POST, at(base, "enroll"), token, Some(request), HeaderMap::new())
            .await?;
    parse(&answer.body)
}

impl Server {
    /// A client of the server at `base`, for the robot with this token.
    pub fn new(
        client: reqwest::Client,
        base: Url,
        robot: RobotId,
        token: impl Into<Credential>,
    ) -> Self {
        Self { client, base, robot, token: token.into(), identity_headers: HeaderMap::new() }
    }

    /// Identifies this client as the agent `instance` that runs at `place`. For a while the server
    /// gives nothing to another agent.
    pub fn with_instance(mut self, instance: &InstanceId, place: Option<Digest>) -> Self {
        let identity_headers = [
            (INSTANCE_HEADER, Some(instance.to_string())),
            (PLACE_HEADER, place.map(|place| place.to_string())),
        ];
        for (name, value) in identity_headers {
            if let Some(value) = value.and_then(|value| HeaderValue::try_from(value).ok()) {
                self.identity_headers.insert(name, value);
            }
        }
        self
    }

    /// Copies this client with another token.
    pub fn with_token(&self, token: String) -> Self {
        Self { token: token.into(), ..self.clone() }
    }

    /// Returns the signed desired state; `None` if it has not changed since the answer with the tag
    /// `known`.
    pub async fn desired(
        &self,
        known: Option<&HeaderValue>,
    ) -> Result<Option<DesiredResponse>, ServerError> {
        let url = at(&self.base, &format!("robots/{}/desired", self.robot));
        let answer = self.send_authorized::<()>(Method::GET, url, None, known).await?;
        if answer.status == StatusCode::NOT_MODIFIED {
            return Ok(None);
        }
        Ok(Some(DesiredResponse {
            envelope: parse(&answer.body)?,
            tag: answer.headers.get(ETAG).cloned(),
        }))
    }

    /// Delivers a report. On return the server has stored the report.
    pub async fn report(&self, report: &Report) -> Result<ReportReply, ServerError> {
        let url = at(&self.base, &format!("robots/{}/report", self.robot));
        let answer = self.send_authorized(Method::POST, url, Some(report), None).await?;
        parse(&answer.body)
    }

    /// Sends the vitals of the robot's machine.
    pub async fn telemetry(&self, telemetry: &Telemetry) -> Result<(), ServerError> {
        let url = at(&self.base, &format!("robots/{}/telemetry", self.robot));
        self.send_authorized(Method::POST, url, Some(telemetry), None).await.map(drop)
    }

    /// Requests the endpoint of the robot's MQTT session.
    pub async fn mqtt_endpoint(&self) -> Result<MqttEndpoint, ServerError> {
        let url = at(&self.base, &format!("robots/{}/mqtt", self.robot));
        let answer = self.send_authorized::<()>(Method::GET, url, None, None).await?;
        parse(&answer.body)
    }

    /// Requests the next token. Its first use invalidates the current one.
    pub async fn next_token(&self) -> Result<String, ServerError> {
        let url = at(&self.base, &format!("robots/{}/token", self.robot));
        let answer = self.send_authorized::<()>(Method::POST, url, None, None).await?;
        let RobotToken { token } = parse(&answer.body)?;
        Ok(token)
    }

    /// Sends a request, and repeats it once if the token was replaced meanwhile.
    async fn send_authorized<B: Serialize>(
        &self,
        method: Method,
        url: Url,
        body: Option<&B>,
        known: Option<&HeaderValue>,
    ) -> Result<Answer, ServerError> {
        let token = self.token.current();
        let mut headers = self.identity_headers.clone();
        headers.extend(known.map(|tag| (IF_NONE_MATCH, tag.clone())));
        match send(&self.client, method.clone(), url.clone(), &token, body, headers.clone()).await {
            Err(ServerError::TokenRefused(_)) if self.token.current() != token => {
                send(&self.client, method, url, &self.token.current(), body, headers).await
            }
            answer => answer,
        }
    }
}

struct Answer {
    status: StatusCode,
    headers: HeaderMap,
    body: Vec<u8>,
}

fn at(base: &Url, path: &str) -> Url {
    let mut url = base.clone();
    url.set_path(&format!("{}{}/{path}", base.path().trim_end_matches('/'), task_proto::api::BASE));
    url
}

async fn send<B: Serialize>(
    client: &reqwest::Client,
    method: Method,
    url: Url,
    token: &str,
    body: Option<&B>,
    headers: HeaderMap,
) -> Result<Answer, ServerError> {
    let mut request = client.request(method, url).bearer_auth(token).headers(headers);
    if let Some(body) = body {
        request = request.json(body);
    }
    let mut response = request.send().await.map_err(ServerError::Unreachable)?;
    let status = response.status();
    let headers = response.headers().clone();
    let mut bytes = Vec::new();
    while let Some(chunk) = response.chunk().await.map_err(ServerError::Unreachable)? {
        if bytes.len() + chunk.len() > MAX_ANSWER_BYTES {
            return Err(ServerError::NotTheServer(format!(
                "an answer of more than {MAX_ANSWER_BYTES} bytes"
            )));
        }
        bytes.extend_from_slice(&chunk);
    }
    let answer = Answer { status, headers, body: bytes };
    if status.is_success() || status == StatusCode::NOT_MODIFIED {
        Ok(answer)
    } else {
        Err(refusal(&answer))
    }
}

fn refusal(answer: &Answer) -> ServerError {
    let status = answer.status;
    if status.is_server_error() || status == StatusCode::TOO_MANY_REQUESTS {
        let seconds =
            answer.headers.get(RETRY_AFTER).and_then(|value| value.to_str().ok()?.parse().ok());
        return ServerError::Busy {
            status: status.as_u16(),
            retry_after: seconds.map(Duration::from_secs),
        };
    }
    // A proxy may also answer 401 or 403, but only the server's answer has its error body.
    let Ok(body) = serde_json::from_slice::<ErrorBody>(&answer.body) else {
        return not_the_server(answer);
    };
    if status == StatusCode::UNAUTHORIZED {
        return ServerError::TokenRefused(body.error.message);
    }
    ServerError::Refused { code: body.error.code, message: body.error.message }
}

fn not_the_server(answer: &Answer) -> ServerError {
    let start = String::from_utf8_lossy(&answer.body[..answer.body.len().min(80)])
        .replace(char::is_control, " ");
    ServerError::NotTheServer(format!("status {}, {start:?}", answer.status.as_u16()))
}

fn parse<T: DeserializeOwned>(body: &[u8]) -> Result<T, ServerError> {
    serde_json::from_slice(body).map_err(|_| {
        let start =
            String::from_utf8_lossy(&body[..body.len().min(80)]).replace(char::is_control, " ");
        ServerError::NotTheServer(format!("{start:?} where JSON should be"))
    })
}
