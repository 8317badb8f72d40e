//! The connection of a server to the others of its cluster: their own questions to each other, and
//! clients' requests that are passed on as they are. Every wait for another server has a limit;
//! there are no retries, because a robot's answer or an upload must not be asked for twice.

use std::net::IpAddr;
use std::time::Duration;

use axum::body::Body;
use axum::extract::Request;
use axum::response::Response;
use futures_util::StreamExt as _;
use http::{HeaderMap, HeaderName, HeaderValue, header};
use http_body::Body as _;
use reqwest::Url;
use serde::Serialize;
use serde::de::DeserializeOwned;
use task_proto::ids::NodeName;
use task_proto::trust::envelope::SigningKey;
use task_transport::Trust;
use tokio_util::sync::CancellationToken;

use super::proof::{CLIENT, PEER, PeerKey, Proven};
use crate::system::clock::Clock;

/// Marks a request that another server has passed on; it is not passed on again.
pub(super) const FORWARDED: HeaderName = HeaderName::from_static("taskd-forwarded");
/// Time limit of a connection to another server.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(3);
/// The longest silence within an answer. Streams send a sign of life every 15 s.
const READ_TIMEOUT: Duration = Duration::from_secs(45);
/// Time limit of another server's answer to a question of this one.
const ANSWER_TIMEOUT: Duration = Duration::from_millis(500);
/// Maximum size of such an answer: a thousand sessions with their subscriptions.
const MAX_ANSWER_BYTES: usize = 4 << 20;
/// Headers that concern one connection only, or that no client may set at another server.
const NOT_PASSED_ON: [HeaderName; 13] = [
    header::CONNECTION,
    header::EXPECT,
    header::PROXY_AUTHENTICATE,
    header::PROXY_AUTHORIZATION,
    header::TE,
    header::TRAILER,
    header::TRANSFER_ENCODING,
    header::UPGRADE,
    HeaderName::from_static("keep-alive"),
    HeaderName::from_static("x-forwarded-for"),
    FORWARDED,
    CLIENT,
    PEER,
];

/// Another server of the cluster, with a URL.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Peer {
    pub name: NodeName,
    pub url: String,
}

/// How long a server may leave a request unanswered before it is asked whether it is there, and how
/// long it may take to say so.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Patience {
    pub pause: Duration,
    pub answer: Duration,
}

impl Patience {
    /// For a request about a robot, which may take some time itself.
    pub const ROBOT: Self = Self { pause: Duration::from_secs(1), answer: Duration::from_secs(2) };
    /// For an upload, which keeps a server busy.
    pub const UPLOAD: Self =
        Self { pause: Duration::from_secs(10), answer: Duration::from_secs(10) };
}

/// The other server did not answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the server of the cluster that has the answer is silent")]
pub struct SilentPeer;

/// The client of a server of the cluster.
pub(super) struct PeerClient {
    http: reqwest::Client,
    key: PeerKey,
}

impl PeerClient {
    /// A client that trusts the certificates of the cluster's authority or, without it, of the
    /// system's roots.
    pub(super) fn new(key: &SigningKey, trust: Trust) -> Result<Self, reqwest::Error> {
        let http = reqwest::Client::builder()
            .tls_backend_preconfigured(trust.client_config(Clock::for_certificates()))
            .connect_timeout(CONNECT_TIMEOUT)
            .read_timeout(READ_TIMEOUT)
            .redirect(reqwest::redirect::Policy::none())
            .no_proxy()
            // A connection counts for one caller at the other server.
            .pool_max_idle_per_host(0)
            .build()?;
        Ok(Self { http, key: PeerKey::of(key) })
    }

    /// The proof of a request that has reached the server `own`.
    pub(super) fn proven(&self, own: &NodeName, request: &Request) -> Proven {
        self.key.proven(own, request.method(), request.uri(), request.headers())
    }

    /// Asks another server; `None`: it did not answer in time.
    pub(super) async fn ask<Q: Serialize, A: DeserializeOwned>(
        &self,
        to: &Peer,
        path: &'static str,
        question: &Q,
    ) -> Option<A> {
        let body = serde_json::to_vec(question).ok()?;
        let request = self
            .http
            .post(format!("{}{path}", to.url))
            .header(PEER, self.key.prove_request(&to.name, path, &body))
            .header(header::CONTENT_TYPE, "application/json")
            .body(body);
        let answer = async {
            let response = request.send().await?.error_for_status()?;
            let mut chunks = response.bytes_stream();
            let mut answer = Vec::new();
            while let Some(chunk) = chunks.next().await.transpose()? {
                answer.extend_from_slice(&chunk);
                if answer.len() > MAX_ANSWER_BYTES {
                    break;
                }
            }
            Ok::<_, reqwest::Error>(answer)
        };
        match tokio::time::timeout(ANSWER_TIMEOUT, answer).await {
            Ok(Ok(answer)) => serde_json::from_slice(&answer).ok(),
            Ok(Err(error)) => {
                let error = &error as &dyn std::error::Error;
                tracing::debug!(error, "server {} did not answer", to.name);
                None
            }
            Err(_) => None,
        }
    }

    /// Passes a client's request on, and returns the answer as it comes. The answer ends with
    /// `stop`.
    pub(super) async fn forward(
        &self,
        to: &Peer,
        patience: Patience,
        client: IpAddr,
        request: Request,
        stop: CancellationToken,
    ) -> Result<Response, SilentPeer> {
        let sent = self.outgoing(to, client, request).ok_or(SilentPeer)?;
        let answer = tokio::select! {
            answer = self.http.execute(sent) => answer.map_err(|error| {
                let error = &error as &dyn std::error::Error;
                tracing::warn!(error, "a request could not be passed on to server {}", to.name);
                SilentPeer
            })?,
            () = self.silence(to, patience) => return Err(SilentPeer),
        };
        let (mut parts, body) = http::Response::<reqwest::Body>::from(answer).into_parts();
        parts.headers = passed_on(&parts.headers);
        let chunks = Body::new(body).into_data_stream();
        Ok(Response::from_parts(
            parts,
            Body::from_stream(chunks.take_until(stop.cancelled_owned())),
        ))
    }

    /// The request as the other server gets it; `None`: its URL is invalid.
    fn outgoing(&self, to: &Peer, client: IpAddr, request: Request) -> Option<reqwest::Request> {
        let (parts, body) = request.into_parts();
        let path = parts.uri.path_and_query()?;
        let url = Url::parse(&format!("{}{path}", to.url)).ok()?;
        // As it is sent: a URL is normalized.
        let path = url.as_str().strip_prefix(&url.origin().ascii_serialization())?;
        let proof = self.key.prove_client(&to.name, &parts.method, path, client);
        let mut headers = passed_on(&parts.headers);
        headers.insert(FORWARDED, HeaderValue::from_static("1"));
        headers.insert(CLIENT, HeaderValue::try_from(proof).ok()?);
        let mut sent = reqwest::Request::new(parts.method, url);
        *sent.headers_mut() = headers;
        if !body.is_end_stream() {
            *sent.body_mut() = Some(reqwest::Body::wrap_stream(body.into_data_stream()));
        }
        Some(sent)
    }

    /// Returns when the server has not shown in time that it is there.
    async fn silence(&self, to: &Peer, patience: Patience) {
        let health = format!("{}/healthz", to.url);
        loop {
            tokio::time::sleep(patience.pause).await;
            let answer = self.http.get(&health).send();
            match tokio::time::timeout(patience.answer, answer).await {
                Ok(Ok(_)) => {}
                Ok(Err(_)) | Err(_) => return,
            }
        }
    }
}

/// Headers without those of the connection.
fn passed_on(headers: &HeaderMap) -> HeaderMap {
    let kept = headers.iter().filter(|(name, _)| !NOT_PASSED_ON.contains(name));
    kept.map(|(name, value)| (name.clone(), value.clone())).collect()
}
