//! The part of the server's HTTP API that a load run needs. Nothing is retried: a run measures
//! single tries.

use std::time::Duration;

use reqwest::{Method, RequestBuilder, Response, StatusCode, Url};
use serde::de::DeserializeOwned;
use task_proto::api::{
    CreateDeployment, CreateEnrollmentToken, DeploymentList, DeploymentView, EnrollRequest,
    EnrollResponse, EnrollmentToken, ErrorBody, IDEMPOTENCY_KEY, RobotList, RobotView, ServerInfo,
    SessionList,
};
use task_proto::desired::BlobRef;
use task_proto::ids::selector::Selector;
use task_proto::messages::request::Ask;
use task_proto::packages::oci::{ImageManifest, MANIFEST_TYPE};
use task_proto::trust::token::Token;
use task_proto::{CaPin, DeploymentId, Digest, RobotId, RobotName, TaskName, Version};
use tokio::sync::Mutex;

use crate::programs::encryption::client_config;
use crate::programs::package::Package;

/// Time limit of one answer.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(60);
/// Time limit of a stream of events.
const STREAM_TIMEOUT: Duration = Duration::from_secs(24 * 3600);
/// Pause before a robot repeats a refused enrollment.
const AGAIN: Duration = Duration::from_secs(1);
/// The payload of a package that only has to exist.
const SMALL_BYTES: u64 = 32;

/// Why a request to the server failed.
#[derive(Debug, thiserror::Error)]
pub enum ServerError {
    /// The server could not be reached, the connection was lost, or the answer is not one of taskd.
    #[error("no answer to {0}")]
    NoAnswer(&'static str, #[source] reqwest::Error),
    /// The server answered with an error.
    #[error("{0} was refused with {1}: {2}")]
    Refused(&'static str, StatusCode, String),
}

/// A server and the operator's token for that server.
pub struct Server {
    http: reqwest::Client,
    base: Url,
    token: String,
    /// Packages that were to be removed while robots should have them.
    in_use: Mutex<Vec<(TaskName, Digest)>>,
}

impl Server {
    /// A client that accepts certificates by the authority with this pin, if a pin is given.
    /// Nothing is sent yet.
    pub fn new(base: Url, token: &Token, pin: Option<CaPin>) -> Result<Self, ServerError> {
        let http = reqwest::Client::builder()
            .timeout(ANSWER_TIMEOUT)
            .redirect(reqwest::redirect::Policy::none());
        let http = http.tls_backend_preconfigured(client_config(pin));
        let http = http.build().map_err(|source| ServerError::NoAnswer("nothing", source))?;
        Ok(Self { http, base, token: token.reveal(), in_use: Mutex::default() })
    }

    /// The server's description, and its traffic.
    pub async fn info(&self) -> Result<ServerInfo, ServerError> {
        read("the question for its version", self.request(Method::GET, "/api/v1/server")).await
    }

    /// Makes a token that robots register with.
    pub async fn create_enrollment_token(
        &self,
        order: &CreateEnrollmentToken,
    ) -> Result<EnrollmentToken, ServerError> {
        read(
            "an enrollment token",
            self.request(Method::POST, "/api/v1/enrollment-tokens").json(order),
        )
        .await
    }

    /// Enrolls a robot with the enrollment token, as an agent does: if the server is overloaded,
    /// the request is repeated.
    pub async fn enroll(
        &self,
        token: &str,
        request: &EnrollRequest,
    ) -> Result<EnrollResponse, ServerError> {
        loop {
            let post = self.http.post(self.url("/api/v1/enroll")).bearer_auth(token);
            match read("an enrollment", post.json(request)).await {
                Err(ServerError::Refused(_, StatusCode::TOO_MANY_REQUESTS, _)) => {
                    tokio::time::sleep(AGAIN).await
                }
                answer => return answer,
            }
        }
    }

    /// The robots that match a selector.
    pub async fn robots(&self, selector: &Selector) -> Result<RobotList, ServerError> {
        let get = self.request(Method::GET, "/api/v1/robots");
        read("the list of robots", get.query(&[("selector", selector.to_string())])).await
    }

    pub async fn robot(&self, robot: &RobotId) -> Result<RobotView, ServerError> {
        read("a robot", self.request(Method::GET, &format!("/api/v1/robots/{robot}"))).await
    }

    pub async fn remove_robot(&self, robot: &RobotId) -> Result<(), ServerError> {
        send("a robot's removal", self.request(Method::DELETE, &format!("/api/v1/robots/{robot}")))
            .await
            .map(drop)
    }

    /// Orders a package for robots.
    pub async fn order(&self, order: &CreateDeployment) -> Result<DeploymentView, ServerError> {
        self.order_with_key(order, &order.manifest.hex()).await
    }

    /// The same with this idempotency key.
    pub async fn order_with_key(
        &self,
        order: &CreateDeployment,
        key: &str,
    ) -> Result<DeploymentView, ServerError> {
        let post = self.request(Method::POST, "/api/v1/deployments").header(IDEMPOTENCY_KEY, key);
        read("the order", post.json(order)).await
    }

    /// The deployment that was ordered last, without its robots.
    pub async fn newest_deployment(&self) -> Result<DeploymentView, ServerError> {
        let what = "the newest deployment";
        let get = self.request(Method::GET, "/api/v1/deployments").query(&[("limit", "1")]);
        let mut list: DeploymentList = read(what, get).await?;
        list.deployments
            .pop()
            .ok_or_else(|| ServerError::Refused(what, StatusCode::OK, "there is none".to_owned()))
    }

    /// Cancels a deployment.
    pub async fn cancel(&self, id: &DeploymentId) -> Result<(), ServerError> {
        let path = format!("/api/v1/deployments/{id}/cancel");
        self.order_at("the cancel", &path, &serde_json::json!({})).await
    }

    /// Gives an order of another kind, whose answer is not read.
    pub async fn order_at(
        &self,
        what: &'static str,
        path: &str,
        order: &serde_json::Value,
    ) -> Result<(), ServerError> {
        let key = format!("{:032x}", rand::random::<u128>());
        let post = self.request(Method::POST, path).header(IDEMPOTENCY_KEY, key).json(order);
        send(what, post).await.map(drop)
    }

    /// Asks a robot something, and waits for its answer.
    pub async fn ask(&self, robot: &str, question: &Ask) -> Result<(), ServerError> {
        let post = self.request(Method::POST, &format!("/api/v1/robots/{robot}/ask"));
        send("a question to a robot", post.json(question)).await.map(drop)
    }

    /// The server's stream of events, which goes on until one side ends it.
    pub async fn events(&self) -> Result<Response, ServerError> {
        let get = self.request(Method::GET, "/api/v1/events").timeout(STREAM_TIMEOUT);
        send("the events", get).await
    }

    /// A page of the robots' sessions.
    pub async fn sessions(&self, after: Option<&RobotName>) -> Result<SessionList, ServerError> {
        let mut get = self.request(Method::GET, "/api/v1/server/sessions?limit=1000");
        if let Some(after) = after {
            get = get.query(&[("after", after.as_str())]);
        }
        read("the list of sessions", get).await
    }

    /// Whether the server says that it is ready.
    pub async fn is_ready(&self) -> bool {
        send("its readiness", self.request(Method::GET, "/readyz")).await.is_ok()
    }

    /// The state of a deployment, robot by robot.
    pub async fn deployment(&self, id: &DeploymentId) -> Result<DeploymentView, ServerError> {
        read("the deployment", self.request(Method::GET, &format!("/api/v1/deployments/{id}")))
            .await
    }

    /// Pushes a package with one small file, and returns its manifest.
    pub async fn push_package(
        &self,
        name: &TaskName,
        version: &Version,
    ) -> Result<Digest, ServerError> {
        self.push(Package::random(name.clone(), version.clone(), SMALL_BYTES, rand::random())).await
    }

    /// Pushes a package, and returns its manifest.
    pub async fn push(&self, package: Package) -> Result<Digest, ServerError> {
        let config = package.config_blob();
        let content = package.content_blob();
        let Package { name, version, config: config_bytes, content: content_bytes, .. } = package;
        self.push_blob(&name, config, config_bytes).await?;
        self.push_blob(&name, content, content_bytes).await?;
        let bytes = json_bytes(&ImageManifest::package(config, content));
        let digest = Digest::of(&bytes);
        let put = self.request(Method::PUT, &format!("/v2/{name}/manifests/{version}"));
        send("the manifest", put.header(reqwest::header::CONTENT_TYPE, MANIFEST_TYPE).body(bytes))
            .await?;
        Ok(digest)
    }

    /// Deletes a package version. A version still assigned to robots is deleted by a later call,
    /// once no robot should have it.
    pub async fn remove_package(
        &self,
        name: &TaskName,
        manifest: &Digest,
    ) -> Result<(), ServerError> {
        let mut in_use = self.in_use.lock().await;
        in_use.push((name.clone(), *manifest));
        let mut kept = Vec::new();
        for (name, manifest) in in_use.drain(..) {
            let delete = self.request(Method::DELETE, &format!("/v2/{name}/manifests/{manifest}"));
            match send("the package's removal", delete).await {
                Err(ServerError::Refused(_, StatusCode::CONFLICT, _)) => {
                    kept.push((name, manifest))
                }
                removed => drop(removed?),
            }
        }
        *in_use = kept;
        Ok(())
    }

    async fn push_blob(
        &self,
        name: &TaskName,
        blob: BlobRef,
        bytes: Vec<u8>,
    ) -> Result<(), ServerError> {
        let post = self
            .request(Method::POST, &format!("/v2/{name}/blobs/uploads/?digest={}", blob.digest));
        send("a blob", post.body(bytes)).await.map(drop)
    }

    fn request(&self, method: Method, path: &str) -> RequestBuilder {
        self.http.request(method, self.url(path)).bearer_auth(&self.token)
    }

    fn url(&self, path: &str) -> String {
        format!("{}{path}", self.base.as_str().trim_end_matches('/'))
    }
}

fn json_bytes(value: &impl serde::Serialize) -> Vec<u8> {
    // Plain numbers and texts can always be written.
    serde_json::to_vec(value).unwrap_or_default()
}

async fn read<T: DeserializeOwned>(
    what: &'static str,
    request: RequestBuilder,
) -> Result<T, ServerError> {
    send(what, request)
        .await?
        .json()
        .await
        .map_err(|source| ServerError::NoAnswer(what, source.without_url()))
}

async fn send(what: &'static str, request: RequestBuilder) -> Result<Response, ServerError> {
    // Without the URL, which differs from robot to robot, equal failures have equal texts.
    let response =
        request.send().await.map_err(|source| ServerError::NoAnswer(what, source.without_url()))?;
    if response.status().is_success() {
        return Ok(response);
    }
    let status = response.status();
    let body = response.json::<ErrorBody>().await;
    Err(ServerError::Refused(
        what,
        status,
        body.map_or("no reason given".to_owned(), |body| body.error.message),
    ))
}
