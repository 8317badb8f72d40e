//! An act and its entry in the audit are one: with an audit that can't be written to, nothing is
//! done; with one that can, each act leaves one entry. Every act that the API has is tried.

use reqwest::{Method, RequestBuilder};
use serde_json::{Value, json};
use task_proto::api::{AccessToken, AuditPage, DeploymentView, EnrollmentToken};
use task_proto::desired::PackageRef;
use task_proto::messages::report::Phase;
use task_proto::packages::oci::MANIFEST_TYPE;
use taskd::store::sqlite_url;

use crate::database::{contents, rename};
use crate::harness::{TestRobot, TestServer, answer};
use crate::people::PASSWORD;

/// A server with one of everything that can be acted upon.
struct Stage {
    server: TestServer,
    robot: TestRobot,
    unused: PackageRef,
    walker: PackageRef,
    manifest: String,
    deployment: String,
    paused: String,
    failed: String,
    enrollment: String,
    signed_in: AccessToken,
    other_token: AccessToken,
}

impl Stage {
    async fn new() -> Self {
        let server = TestServer::start().await;
        let (mut robot, _) = (server.enroll("atlas").await, server.enroll("boreas").await);
        server.push("spare", "1.0.0").await;
        let old = server.push("runner", "1.0.0").await;
        server.deploy(&old, "*", "old-runner").await;
        let state = server.desired(&robot).await;
        assert_eq!(server.report(&mut robot, &state, Phase::Running).await.status(), 200);
        let runner = server.push("runner", "2.0.0").await;
        let failed = server.deploy(&runner, "*", "new-runner").await.id.to_string();
        let climber = server.push("climber", "1.0.0").await;
        let careful = json!({
            "package": "climber", "manifest": climber.manifest.digest, "selector": "*", "batch": 1,
            "max_failures": 0,
        });
        let paused: DeploymentView =
            answer(server.order("/api/v1/deployments", "careful", &careful)).await;
        let state = server.desired(&robot).await;
        assert_eq!(server.report(&mut robot, &state, Phase::Failed).await.status(), 200);
        let (talker, walker) =
            (server.push("talker", "1.0.0").await, server.push("walker", "1.0.0").await);
        let unused = server.push("unused", "1.0.0").await;
        let path = format!("/v2/talker/manifests/{}", talker.manifest.digest);
        let manifest = server
            .request(Method::GET, &path)
            .send()
            .await
            .expect("an answer")
            .text()
            .await
            .expect("text");
        let deployment = server.deploy(&talker, "*", "first").await.id.to_string();
        let user = json!({ "name": "alice", "roles": ["operator"], "password": PASSWORD });
        let _: Value = server.post("/api/v1/users", &user).await;
        let log_in = || {
            server
                .bare(Method::POST, "/api/v1/login")
                .json(&json!({ "user": "alice", "password": PASSWORD }))
        };
        let (signed_in, other_token) = (answer(log_in()).await, answer(log_in()).await);
        let enrollment: EnrollmentToken =
            server.post("/api/v1/enrollment-tokens", &json!({})).await;
        let enrollment = enrollment.token;
        let paused = paused.id.to_string();
        Self {
            server,
            robot,
            unused,
            walker,
            manifest,
            deployment,
            paused,
            failed,
            enrollment,
            signed_in,
            other_token,
        }
    }

    fn order(&self, path: &str, body: &Value) -> RequestBuilder {
        self.server.order(path, &format!("{:016x}", rand::random::<u64>()), body)
    }

    /// Every act, by its name in the audit, in an order in which each can be done.
    fn acts(&self) -> Vec<(&'static str, RequestBuilder)> {
        let request =
            |method, path: &str, body: Value| self.server.request(method, path).json(&body);
        let bare = |method, path: &str, body: Value| self.server.bare(method, path).json(&body);
        let post = |path: &str, body| request(Method::POST, &format!("/api/v1/{path}"), body);
        let delete = |path: &str| self.server.request(Method::DELETE, path);
        let api = |path: &str| format!("/api/v1/{path}");
        let robot = |rest: &str| format!("/api/v1/robots/{}{rest}", self.robot.id);
        let all = json!({ "selector": "*" });
        let walker = &self.walker.manifest.digest;
        let deploy = json!({ "package": "walker", "manifest": walker, "selector": "*" });
        let manifest = self.server.request(Method::PUT, "/v2/talker/manifests/2.0.0");
        let manifest = manifest.header("content-type", MANIFEST_TYPE).body(self.manifest.clone());
        let unused = &self.unused;
        let ask = json!({ "type": "lifecycle", "node": "/talker", "transition": "activate" });
        vec![
            ("enrolment_token.create", post("enrollment-tokens", json!({}))),
            (
                "robot.enroll",
                bare(
                    Method::POST,
                    &api("enroll"),
                    json!({ "mac": "02:00:00:00:00:07", "name": "ceto" }),
                )
                .bearer_auth(&self.enrollment),
            ),
            ("robot.edit", request(Method::PATCH, &robot(""), json!({ "name": "argo" }))),
            ("robot.ask", request(Method::POST, &robot("/ask"), ask)),
            ("deployment.create", self.order(&api("deployments"), &deploy)),
            ("task.stop", self.order(&api("tasks/talker/stop"), &all)),
            ("task.start", self.order(&api("tasks/talker/start"), &all)),
            ("task.restart", self.order(&api("tasks/talker/restart"), &all)),
            (
                "deployment.retry",
                self.order(&api(&format!("deployments/{}/retry", self.failed)), &json!({})),
            ),
            ("task.rollback", self.order(&api("tasks/runner/rollback"), &all)),
            ("bulk.labels", post("bulk/labels", json!({ "selector": "*", "set": { "a": "b" } }))),
            ("manifest.delete", delete(&api("packages/spare/1.0.0"))),
            ("task.remove", self.order(&api("tasks/talker/remove"), &all)),
            (
                "deployment.cancel",
                post(&format!("deployments/{}/cancel", self.deployment), json!({})),
            ),
            ("deployment.resume", post(&format!("deployments/{}/resume", self.paused), json!({}))),
            ("manifest.push", manifest),
            ("tag.delete", delete("/v2/talker/manifests/2.0.0")),
            (
                "manifest.delete",
                delete(&format!("/v2/unused/manifests/{}", unused.manifest.digest)),
            ),
            ("blob.delete", delete(&format!("/v2/unused/blobs/{}", unused.content.digest))),
            ("user.add", post("users", json!({ "name": "bob", "roles": ["viewer"] }))),
            (
                "user.edit",
                request(Method::PATCH, &api("users/alice"), json!({ "roles": ["viewer"] })),
            ),
            (
                "sign_in",
                bare(Method::POST, &api("login"), json!({ "user": "alice", "password": PASSWORD })),
            ),
            (
                "sign_in",
                bare(
                    Method::POST,
                    &api("session"),
                    json!({ "user": "alice", "password": PASSWORD }),
                ),
            ),
            ("token.create", post("tokens", json!({ "user": "alice" }))),
            ("token.revoke", delete(&api(&format!("tokens/{}", self.other_token.id)))),
            (
                "sign_out",
                bare(Method::DELETE, &api("session"), json!({})).bearer_auth(&self.signed_in.token),
            ),
            (
                "user.password",
                request(
                    Method::PUT,
                    &api("users/alice/password"),
                    json!({ "password": "another long one" }),
                ),
            ),
            ("user.remove", delete(&api("users/alice"))),
            ("bulk.remove", post("bulk/remove", json!({ "selector": "boreas" }))),
            ("robot.remove", delete(&robot(""))),
        ]
    }

    fn database(&self) -> String {
        sqlite_url(&self.server.data().join("taskd.sqlite"))
    }

    async fn entries(&self) -> Vec<String> {
        let page: AuditPage = self.server.get("/api/v1/audit?after=0").await;
        page.records.iter().map(|record| record.read().expect("an entry").act).collect()
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn act_without_an_audit_entry_is_not_done() {
    let stage = Stage::new().await;
    let before = stage.entries().await;
    rename(&stage.database(), "audit", "audit_elsewhere").await;
    let was = contents(&stage.database()).await;
    // A tag of the old package, since the new one is not there.
    for (act, request) in stage.acts() {
        let status = send(request, act, "/v2/talker/manifests/1.0.0").await;
        assert_eq!(status, 500, "{act}");
        assert_eq!(
            contents(&stage.database()).await,
            was,
            "{act} was done, and nobody knows by whom"
        );
    }
    rename(&stage.database(), "audit_elsewhere", "audit").await;
    assert_eq!(stage.entries().await, before);

    let mut expected = before;
    for (act, request) in stage.acts() {
        let status = send(request, act, "/v2/talker/manifests/2.0.0").await;
        // The asked robot is absent; the question is still in the audit log.
        assert!(status < 300 || act == "robot.ask", "{act}: {status}");
        // Of each robot that is removed with others there is one as well.
        expected.extend((act == "bulk.remove").then(|| "robot.remove".to_owned()));
        expected.push(act.to_owned());
        assert_eq!(stage.entries().await, expected, "{act} is one entry");
        assert_ne!(contents(&stage.database()).await, was, "{act}");
    }
}

async fn send(request: RequestBuilder, act: &str, tag: &str) -> u16 {
    let mut request = request.build().expect("a request");
    if act == "tag.delete" {
        request.url_mut().set_path(tag);
    }
    reqwest::Client::new().execute(request).await.expect("an answer").status().as_u16()
}
