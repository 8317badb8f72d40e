//! A whole server in this process, on free ports and in a directory of its own, with the requests
//! that every test needs.

use std::path::Path;

use reqwest::{Client, Method, RequestBuilder, Response, StatusCode};
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::{Value, json};
use task_proto::api::{
    DeploymentView, EnrollResponse, EnrollmentToken, IDEMPOTENCY_KEY, RobotView, ServerInfo,
};
use task_proto::desired::{BlobRef, DesiredState, DesiredTask, PackageRef};
use task_proto::messages::report::{HostFacts, Phase, Report, TaskReport};
use task_proto::packages::manifest::{ContentFacts, TaskKind};
use task_proto::packages::oci::{ImageManifest, MANIFEST_TYPE};
use task_proto::trust::envelope::{DESIRED_STATE_TYPE, Envelope};
use task_proto::trust::token::Token;
use task_proto::{Digest, InstanceId, RobotId};
use task_transport::Trust;
use taskd::config::Config;
use taskd::serve::Server;
use taskd::system::clock::Clock;
use tempfile::TempDir;

/// The moment at which every test begins.
pub const NOW_MS: u64 = 1_800_000_000_000;

/// A running server and a signed-in operator.
pub struct TestServer {
    pub directory: TempDir,
    pub server: Server,
    pub clock: Clock,
    pub operator: Token,
    pub client: Client,
}

/// A registered robot, as far as the server can tell.
pub struct TestRobot {
    pub id: RobotId,
    pub token: String,
    instance: InstanceId,
    seq: u64,
}

impl TestServer {
    pub async fn start() -> Self {
        Self::start_in(TempDir::new().expect("a directory"), |_| {}).await
    }

    pub async fn start_in(directory: TempDir, configure: impl FnOnce(&mut Config)) -> Self {
        let mut config = Config::with_data(directory.path().join("data"));
        config.http.set_port(0);
        config.mqtt.set_port(0);
        config.enrollment_per_minute = 1_000_000;
        configure(&mut config);
        let clock = Clock::fixed(NOW_MS);
        let server = Server::start(config, clock.clone()).await.expect("the server starts");
        let operator = server.data().operator_token().expect("read").expect("a token");
        let client = client(Trust::by(server.addresses().ca_pin));
        Self { directory, server, clock, operator, client }
    }

    /// Stops the server and starts another on the same directory.
    pub async fn restart(self) -> Self {
        let directory = self.stop().await;
        Self::start_in(directory, |_| {}).await
    }

    /// Stops the server; the directory stays.
    pub async fn stop(self) -> TempDir {
        self.server.stop().await;
        self.directory
    }

    pub fn data(&self) -> &Path {
        self.server.data().path()
    }

    pub fn url(&self, path: &str) -> String {
        format!("{}{path}", self.server.addresses().url())
    }

    /// A request without credentials.
    pub fn bare(&self, method: Method, path: &str) -> RequestBuilder {
        self.client.request(method, self.url(path))
    }

    /// A request by the operator.
    pub fn request(&self, method: Method, path: &str) -> RequestBuilder {
        self.bare(method, path).bearer_auth(self.operator.reveal())
    }

    pub async fn get<T: DeserializeOwned>(&self, path: &str) -> T {
        answer(self.request(Method::GET, path)).await
    }

    pub async fn post<T: DeserializeOwned>(&self, path: &str, body: &impl Serialize) -> T {
        answer(self.request(Method::POST, path).json(body)).await
    }

    /// An order with its idempotency key.
    pub fn order(&self, path: &str, key: &str, body: &Value) -> RequestBuilder {
        self.request(Method::POST, path).header(IDEMPOTENCY_KEY, key).json(body)
    }

    pub async fn enroll(&self, name: &str) -> TestRobot {
        let token: EnrollmentToken = self.post("/api/v1/enrollment-tokens", &json!({})).await;
        let mac = Digest::of(name.as_bytes()).hex();
        let mac = format!(
            "02:{}:{}:{}:{}:{}",
            &mac[..2],
            &mac[2..4],
            &mac[4..6],
            &mac[6..8],
            &mac[8..10]
        );
        let request = self.bare(Method::POST, "/api/v1/enroll").bearer_auth(token.token);
        let enrolled: EnrollResponse =
            answer(request.json(&json!({ "mac": mac, "name": name }))).await;
        TestRobot::new(enrolled.robot_id, enrolled.token)
    }

    /// Pushes a package of one small file.
    pub async fn push(&self, name: &str, version: &str) -> PackageRef {
        self.push_content(
            name,
            version,
            archive_with(format!("content of {name} {version}").as_bytes()),
        )
        .await
    }

    /// The same with the content that [`archive_with`] or [`archive_of`] made.
    pub async fn push_content(&self, name: &str, version: &str, content: Vec<u8>) -> PackageRef {
        let content_ref = BlobRef { digest: Digest::of(&content), size: content.len() as u64 };
        let config = json!({
            "name": name,
            "version": version,
            "build": { "tool": "none" },
            "run": { "exec": ["sh", "main.sh"] },
            "content": archive_facts(),
        });
        let config = serde_json::to_vec(&config).expect("json");
        let config_ref = BlobRef { digest: Digest::of(&config), size: config.len() as u64 };
        for (blob, bytes) in [(config_ref, config), (content_ref, content)] {
            let path = format!("/v2/{name}/blobs/uploads/?digest={}", blob.digest);
            let request = self
                .request(Method::POST, &path)
                .header("content-type", "application/octet-stream");
            assert_eq!(
                request.body(bytes).send().await.expect("an answer").status(),
                StatusCode::CREATED
            );
        }
        let manifest =
            serde_json::to_vec(&ImageManifest::package(config_ref, content_ref)).expect("json");
        let manifest_ref = BlobRef { digest: Digest::of(&manifest), size: manifest.len() as u64 };
        let request = self.request(Method::PUT, &format!("/v2/{name}/manifests/{version}"));
        let response = request
            .header("content-type", MANIFEST_TYPE)
            .body(manifest)
            .send()
            .await
            .expect("an answer");
        assert_eq!(
            response.status(),
            StatusCode::CREATED,
            "{}",
            response.text().await.unwrap_or_default()
        );
        PackageRef {
            name: name.parse().expect("a name"),
            version: version.parse().expect("a version"),
            manifest: manifest_ref,
            config: config_ref,
            content: content_ref,
        }
    }

    pub async fn deploy(&self, package: &PackageRef, selector: &str, key: &str) -> DeploymentView {
        let digest = &package.manifest.digest;
        let body = json!({ "package": package.name, "manifest": digest, "selector": selector });
        answer(self.order("/api/v1/deployments", key, &body)).await
    }

    pub async fn robot(&self, robot: &TestRobot) -> RobotView {
        self.get(&format!("/api/v1/robots/{}", robot.id)).await
    }

    /// The response to the robot's request for its desired state.
    pub async fn ask_desired(&self, robot: &TestRobot) -> Response {
        let path = format!("/api/v1/robots/{}/desired", robot.id);
        self.bare(Method::GET, &path).bearer_auth(&robot.token).send().await.expect("an answer")
    }

    /// The robot's desired state, its signature verified.
    pub async fn desired(&self, robot: &TestRobot) -> DesiredState {
        let response = self.ask_desired(robot).await;
        assert_eq!(
            response.status(),
            StatusCode::OK,
            "{}",
            response.text().await.unwrap_or_default()
        );
        let envelope: Envelope = response.json().await.expect("an envelope");
        opened(self, &envelope).await
    }

    /// The robot reports that it accepted `state` and that all of its tasks are in `phase`.
    pub async fn report(
        &self,
        robot: &mut TestRobot,
        state: &DesiredState,
        phase: Phase,
    ) -> Response {
        let report = robot.next_report(state, phase);
        self.send_report(robot, &report).await
    }

    pub async fn send_report(&self, robot: &TestRobot, report: &Report) -> Response {
        let path = format!("/api/v1/robots/{}/report", robot.id);
        let request = self.bare(Method::POST, &path).bearer_auth(&robot.token);
        request.json(report).send().await.expect("an answer")
    }
}

impl TestRobot {
    /// A first instance of a robot, or one more.
    pub fn new(id: RobotId, token: String) -> Self {
        Self { id, token, instance: InstanceId::random(), seq: 0 }
    }

    /// A report that the robot accepted `state` and that all of its tasks are in `phase`.
    pub fn next_report(&mut self, state: &DesiredState, phase: Phase) -> Report {
        self.seq += 1;
        Report {
            robot_id: self.id.clone(),
            start: 1,
            instance: self.instance.clone(),
            place: None,
            boot_id: "boot".to_owned(),
            seq: self.seq,
            observed_generation: state.generation,
            uptime_ms: 1_000,
            host: HostFacts { hostname: "host".to_owned(), ..HostFacts::default() },
            conditions: Vec::new(),
            link: None,
            tasks: state.tasks.iter().map(|task| in_phase(task, phase)).collect(),
        }
    }
}

/// A package's content: an archive of one file, and `bytes` in a skippable zstd frame, so that they
/// travel as they are.
pub fn archive_with(bytes: &[u8]) -> Vec<u8> {
    let mut content = zstd::encode_all(&*archive(), 1).expect("in memory");
    content.extend(0x184D_2A50_u32.to_le_bytes());
    content.extend(u32::try_from(bytes.len()).expect("a frame's length").to_le_bytes());
    content.extend(bytes);
    content
}

/// The same with as much of `fill` as makes it `size` bytes.
pub fn archive_of(size: usize, fill: u8) -> Vec<u8> {
    archive_with(&vec![fill; size - archive_with(&[]).len()])
}

/// The archive's description in a manifest.
pub fn archive_facts() -> ContentFacts {
    let tar = archive();
    ContentFacts { tar_digest: Digest::of(&tar), tar_size: tar.len() as u64, entries: 1 }
}

fn archive() -> Vec<u8> {
    let mut header = tar::Header::new_ustar();
    header.set_size(4);
    header.set_mode(0o644);
    header.set_entry_type(tar::EntryType::Regular);
    let mut archive = tar::Builder::new(Vec::new());
    archive.append_data(&mut header, "main.sh", &b"true"[..]).expect("in memory");
    archive.into_inner().expect("in memory")
}

/// An HTTP client that trusts them.
pub fn client(trust: Trust) -> Client {
    // For clients that a test makes itself. A second install is refused because the first is in
    // place.
    let _ = rustls::crypto::ring::default_provider().install_default();
    let tls = trust.client_config(Clock::for_certificates());
    Client::builder().tls_backend_preconfigured(tls).build().expect("a client")
}

/// An envelope's content, after its signature is verified.
pub async fn opened(server: &TestServer, envelope: &Envelope) -> DesiredState {
    let info: ServerInfo = server.get("/api/v1/server").await;
    let payload = envelope.open(DESIRED_STATE_TYPE, &info.key).expect("signed by this server");
    serde_json::from_slice(&payload).expect("a desired state")
}

fn in_phase(task: &DesiredTask, phase: Phase) -> TaskReport {
    TaskReport { kind: Some(TaskKind::Service), phase_ms: 10, ..TaskReport::of(task, phase) }
}

/// Sends the request and reads a success's JSON.
pub async fn answer<T: DeserializeOwned>(request: RequestBuilder) -> T {
    let response = request.send().await.expect("an answer");
    let status = response.status();
    let text = response.text().await.expect("a body");
    assert!(status.is_success(), "{status}: {text}");
    serde_json::from_str(&text).unwrap_or_else(|error| panic!("{error}: {text}"))
}

/// Sends the request and reads an error's status and code.
pub async fn refusal(request: RequestBuilder) -> (u16, String) {
    let response = request.send().await.expect("an answer");
    let status = response.status().as_u16();
    let text = response.text().await.expect("a body");
    let body: task_proto::api::ErrorBody =
        serde_json::from_str(&text).unwrap_or_else(|error| panic!("{status}, {error}: {text}"));
    (status, body.error.code)
}
