//! A user limited to some robots, over HTTP and MQTT: visible data, refusals, and that losing a
//! robot ends everything under way for that robot.

use std::time::Duration;

use futures_util::StreamExt as _;
use reqwest::{Method, RequestBuilder, StatusCode};
use serde_json::{Value, json};
use task_proto::api::{AccessToken, DeploymentList, DeploymentView, OutputList, RobotList};
use task_proto::messages::report::Phase;
use task_proto::packages::oci::MANIFEST_TYPE;
use task_proto::packages::publisher::PackageStatement;
use task_proto::{Digest, TokenId};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;

use crate::harness::{TestRobot, TestServer, answer, refusal};
use crate::mqtt_harness::{Connect, PATIENCE, Raw};
use crate::outputs::{Push, file, output};
use crate::people::PASSWORD;
use crate::registry::header;
use crate::signatures::{key, push_signature};

/// A server with a robot in the lab, one in the field, and people.
struct Sites {
    server: TestServer,
    lab: TestRobot,
    field: TestRobot,
}

impl Sites {
    async fn new() -> Self {
        let server = TestServer::start().await;
        let (lab, field) = (server.enroll("atlas").await, server.enroll("boreas").await);
        for (robot, site) in [(&lab, "lab"), (&field, "field")] {
            let path = format!("/api/v1/robots/{}", robot.id);
            let edit =
                server.request(Method::PATCH, &path).json(&json!({ "labels": { "site": site } }));
            let _: Value = answer(edit).await;
        }
        Self { server, lab, field }
    }

    async fn add(&self, name: &str, roles: &[&str], scope: Option<&str>) {
        let user = json!({ "name": name, "roles": roles, "scope": scope, "password": PASSWORD });
        let _: Value = self.server.post("/api/v1/users", &user).await;
    }

    async fn log_in(&self, name: &str) -> AccessToken {
        let request = self.server.bare(Method::POST, "/api/v1/login");
        answer(request.json(&json!({ "user": name, "password": PASSWORD }))).await
    }
}

/// A user who makes requests with their token.
struct Asker<'a> {
    server: &'a TestServer,
    token: String,
}

impl Asker<'_> {
    fn ask(&self, method: Method, path: &str) -> RequestBuilder {
        self.server.bare(method, path).bearer_auth(&self.token)
    }

    async fn status(&self, method: Method, path: &str) -> u16 {
        self.ask(method, path).send().await.expect("an answer").status().as_u16()
    }
}

fn out_of_scope() -> (u16, String) {
    (403, "out_of_scope".to_owned())
}

#[tokio::test(flavor = "multi_thread")]
async fn lists_and_views_are_limited_to_the_scope() {
    let mut sites = Sites::new().await;
    sites.add("alice", &["operator"], Some("site=lab")).await;
    let package = sites.server.push("talker", "1.0.0").await;
    let before = sites.server.deploy(&package, "boreas", "before").await;
    let everywhere = sites.server.deploy(&package, "atlas,boreas", "everywhere").await;
    assert_eq!(everywhere.supersedes, std::slice::from_ref(&before.id));
    let elsewhere = sites.server.deploy(&package, "boreas", "elsewhere").await;
    for robot in [&sites.lab, &sites.field] {
        let push = Push::new(&sites.server, robot, format!("outputs/{}/mapping", robot.id));
        let map = push.blob(b"a map").await;
        assert_eq!(
            push.output(&output(&robot.id, 1, vec![file("map", map)])).await,
            StatusCode::CREATED
        );
    }
    let state = sites.server.desired(&sites.lab).await;
    sites.server.report(&mut sites.lab, &state, Phase::Running).await;
    let alice = Asker { server: &sites.server, token: sites.log_in("alice").await.token };

    let robots: RobotList = answer(alice.ask(Method::GET, "/api/v1/robots")).await;
    assert_eq!(
        robots.robots.iter().map(|robot| robot.name.as_str()).collect::<Vec<_>>(),
        ["atlas"]
    );
    let robots: RobotList = answer(alice.ask(Method::GET, "/api/v1/robots?selector=boreas")).await;
    assert!(robots.robots.is_empty());
    let outputs: OutputList = answer(alice.ask(Method::GET, "/api/v1/outputs")).await;
    assert_eq!(
        outputs.outputs.iter().map(|output| output.robot_name.as_str()).collect::<Vec<_>>(),
        ["atlas"]
    );
    let deployments: DeploymentList = answer(alice.ask(Method::GET, "/api/v1/deployments")).await;
    assert_eq!(deployments.deployments.len(), 1);
    assert_eq!(deployments.deployments[0].counts.iter().map(|count| count.count).sum::<u64>(), 1);
    let path = format!("/api/v1/deployments/{}", everywhere.id);
    let part: DeploymentView = answer(alice.ask(Method::GET, &path)).await;
    assert_eq!(part.counts, deployments.deployments[0].counts);
    assert_eq!(part.state, task_proto::api::DeploymentState::Settled, "hers runs");
    assert_eq!(part.assignments.expect("asked for").len(), 1);
    for view in ["/api/v1/deployments", path.as_str()] {
        let text = alice
            .ask(Method::GET, view)
            .send()
            .await
            .expect("an answer")
            .text()
            .await
            .expect("text");
        assert!(!text.contains("boreas") && !text.contains(before.id.as_str()), "{view}: {text}");
    }

    let own = ["/api/v1/robots/atlas", "/api/v1/robots/atlas/logs", "/api/v1/outputs?robot=atlas"];
    for path in own {
        assert_eq!(alice.status(Method::GET, path).await, 200, "{path}");
    }
    let foreign = [
        "/api/v1/robots/boreas".to_owned(),
        format!("/api/v1/robots/{}", sites.field.id),
        "/api/v1/robots/boreas/logs".to_owned(),
        "/api/v1/robots/boreas/logs?follow=true".to_owned(),
        "/api/v1/outputs?robot=boreas".to_owned(),
        format!("/api/v1/deployments/{}", elsewhere.id),
    ];
    for path in foreign {
        assert_eq!(refusal(alice.ask(Method::GET, &path)).await, out_of_scope(), "{path}");
    }
    let ask = |robot: &str| {
        alice
            .ask(Method::POST, &format!("/api/v1/robots/{robot}/ask"))
            .json(&json!({ "type": "nodes" }))
    };
    assert_eq!(refusal(ask("atlas")).await, (409, "robot_offline".to_owned()));
    assert_eq!(refusal(ask("boreas")).await, out_of_scope());

    // In the registry: packages, and the outputs of her own robots.
    assert_eq!(alice.status(Method::GET, "/v2/talker/tags/list").await, 200);
    let tags = |robot: &TestRobot| format!("/v2/outputs/{}/mapping/tags/list", robot.id);
    assert_eq!(alice.status(Method::GET, &tags(&sites.lab)).await, 200);
    assert_eq!(alice.status(Method::GET, &tags(&sites.field)).await, 403);
    let map = task_proto::Digest::of(b"a map");
    let mount =
        format!("/v2/own/blobs/uploads/?mount={map}&from=outputs/{}/mapping", sites.field.id);
    assert_eq!(alice.status(Method::POST, &mount).await, 403, "an operator does not push");
    sites.add("carol", &["publisher"], Some("site=lab")).await;
    let carol = Asker { server: &sites.server, token: sites.log_in("carol").await.token };
    assert_eq!(carol.status(Method::POST, &mount).await, 202, "an upload begins instead");
    assert_eq!(carol.status(Method::GET, &format!("/v2/own/blobs/{map}")).await, 404);
}

#[tokio::test(flavor = "multi_thread")]
async fn order_counts_robots_outside_the_scope() {
    let sites = Sites::new().await;
    sites.add("alice", &["operator"], Some("site=lab")).await;
    let package = sites.server.push("talker", "1.0.0").await;
    let alice = Asker { server: &sites.server, token: sites.log_in("alice").await.token };
    let order = |selector: &str, key: &str| {
        let digest = &package.manifest.digest;
        let body = json!({ "package": package.name, "manifest": digest, "selector": selector });
        alice.ask(Method::POST, "/api/v1/deployments").header("idempotency-key", key).json(&body)
    };
    let refused = order("*", "one").send().await.expect("an answer");
    assert_eq!(refused.status(), StatusCode::FORBIDDEN);
    let body: Value = refused.json().await.expect("json");
    let said =
        "1 of the 2 robots of \"*\" are outside of alice's scope \"site=lab\"; nothing was done";
    assert_eq!(
        (&body["error"]["code"], &body["error"]["message"]),
        (&json!("out_of_scope"), &json!(said))
    );
    // Whether a robot of that name is another's is not hers to know.
    for selector in ["boreas", "site=lab,boreas", "site=lab,!boreas", "nobody"] {
        let said = format!(
            "selector: no registered robot has the name or id {}; nothing was done",
            if selector == "nobody" { "nobody" } else { "boreas" }
        );
        let refused = order(selector, "two").send().await.expect("an answer");
        assert_eq!(refused.status(), StatusCode::NOT_FOUND);
        let body: Value = refused.json().await.expect("json");
        assert_eq!(
            (&body["error"]["code"], &body["error"]["message"]),
            (&json!("unknown_robots"), &json!(said))
        );
    }
    let ordered: DeploymentView = answer(order("site=lab", "three")).await;
    assert_eq!(ordered.assignments.expect("asked for").len(), 1);
    // An action that is never permitted to her is refused in other words.
    let me = alice.ask(Method::DELETE, "/api/v1/robots/atlas").send().await.expect("an answer");
    let body: Value = me.json().await.expect("json");
    assert_eq!(body["error"]["message"], "alice has no permission to maintain (roles: operator)");
}

#[tokio::test(flavor = "multi_thread")]
async fn package_in_use_outside_the_scope_is_not_deleted_or_retagged() {
    let sites = Sites::new().await;
    let package = sites.server.push("talker", "1.0.0").await;
    let later = sites.server.push("talker", "2.0.0").await;
    let signature = PackageStatement { package: package.clone() }.seal(&key(1));
    let signed = push_signature(&sites.server, &package, &signature).await;
    let signed = header(&signed, "docker-content-digest");
    sites.server.deploy(&package, "*", "fleet").await;
    sites.add("pia", &["publisher"], Some("site=lab")).await;
    let pia = Asker { server: &sites.server, token: sites.log_in("pia").await.token };
    let operator = Asker { server: &sites.server, token: sites.server.operator.reveal() };
    let (manifest, content) = (package.manifest.digest, package.content.digest);
    let envelope = Digest::of(&serde_json::to_vec(&signature).expect("json"));
    let everybody = [
        format!("manifests/{manifest}"),
        format!("blobs/{content}"),
        format!("blobs/{}", package.config.digest),
    ];
    let limited =
        ["manifests/1.0.0".to_owned(), format!("manifests/{signed}"), format!("blobs/{envelope}")];
    for path in everybody.iter().chain(&limited) {
        assert_eq!(pia.status(Method::DELETE, &format!("/v2/talker/{path}")).await, 409, "{path}");
    }
    for path in &everybody {
        assert_eq!(
            operator.status(Method::DELETE, &format!("/v2/talker/{path}")).await,
            409,
            "{path}"
        );
    }
    let refused = pia
        .ask(Method::DELETE, &format!("/v2/talker/manifests/{manifest}"))
        .send()
        .await
        .expect("an answer");
    let said = refused.text().await.expect("text");
    assert!(said.contains("is in use by 2 robots: atlas, …") && !said.contains("boreas"), "{said}");
    // The tag stays unchanged as well; setting it again to its current target is permitted.
    let bytes = |digest| pia.ask(Method::GET, &format!("/v2/talker/manifests/{digest}")).send();
    let moved = async |by: &Asker<'_>, digest: Digest| {
        let manifest = bytes(digest).await.expect("an answer").bytes().await.expect("a manifest");
        let put =
            by.ask(Method::PUT, "/v2/talker/manifests/1.0.0").header("content-type", MANIFEST_TYPE);
        put.body(manifest).send().await.expect("an answer").status().as_u16()
    };
    assert_eq!((moved(&pia, later.manifest.digest).await, moved(&pia, manifest).await), (409, 201));
    for path in everybody.iter().chain(&limited) {
        assert_eq!(
            operator.status(Method::GET, &format!("/v2/talker/{path}")).await,
            200,
            "{path}"
        );
    }

    // Where all the robots are her own, she may do all except delete the package itself; once no
    // robot has the package, that is deleted too.
    sites.server.deploy(&later, "boreas", "elsewhere").await;
    assert_eq!(pia.status(Method::DELETE, &format!("/v2/talker/manifests/{manifest}")).await, 409);
    for path in &limited {
        assert_eq!(pia.status(Method::DELETE, &format!("/v2/talker/{path}")).await, 202, "{path}");
    }
    sites.server.deploy(&later, "atlas", "here").await;
    for path in everybody.iter().rev() {
        assert_eq!(pia.status(Method::DELETE, &format!("/v2/talker/{path}")).await, 202, "{path}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn repeated_answer_is_limited_to_the_current_scope() {
    let sites = Sites::new().await;
    sites.add("alice", &["operator"], Some("site=lab")).await;
    sites.add("mia", &["admin"], Some("site=lab")).await;
    let label = async |robot: &TestRobot, site: &str| {
        let edit = sites.server.request(Method::PATCH, &format!("/api/v1/robots/{}", robot.id));
        let _: Value = answer(edit.json(&json!({ "labels": { "site": site } }))).await;
    };
    label(&sites.field, "lab").await;
    let [old, new] =
        [sites.server.push("talker", "1.0.0").await, sites.server.push("talker", "2.0.0").await];
    for (package, key) in [(&old, "old"), (&new, "new")] {
        sites.server.deploy(package, "*", key).await;
    }
    let alice = Asker { server: &sites.server, token: sites.log_in("alice").await.token };
    let mia = Asker { server: &sites.server, token: sites.log_in("mia").await.token };
    let deploy =
        json!({ "package": new.name, "manifest": new.manifest.digest, "selector": "site=lab" });
    let all = json!({ "selector": "*" });
    let orders = [
        (&alice, "deployments", &deploy),
        (&alice, "tasks/talker/stop", &all),
        (&alice, "tasks/talker/start", &all),
        (&mia, "bulk/labels", &json!({ "selector": "site=lab", "set": { "hall": "2" } })),
    ];
    let said = async |(by, path, body): &(&Asker<'_>, &str, &Value)| {
        let order = by
            .ask(Method::POST, &format!("/api/v1/{path}"))
            .header("idempotency-key", path.replace('/', "-"));
        let answer = order.json(body).send().await.expect("an answer");
        assert!(answer.status().is_success(), "{path}: {}", answer.status());
        answer.text().await.expect("text")
    };
    for order in &orders {
        let said = said(order).await;
        assert!(said.contains("atlas") && said.contains("boreas"), "{}: {said}", order.1);
    }
    label(&sites.field, "field").await;
    for order in &orders {
        let said = said(order).await;
        assert!(said.contains("atlas") && !said.contains("boreas"), "{}: {said}", order.1);
        assert!(!said.contains(sites.field.id.as_str()), "{}: {said}", order.1);
    }
}

/// The events that come on a stream, by name and data.
struct Events {
    chunks: futures_util::stream::BoxStream<'static, reqwest::Result<bytes::Bytes>>,
    text: String,
}

impl Events {
    async fn open(asker: &Asker<'_>) -> Self {
        let response = asker.ask(Method::GET, "/api/v1/events").send().await.expect("an answer");
        assert_eq!(response.status(), StatusCode::OK);
        let mut events = Self { chunks: response.bytes_stream().boxed(), text: String::new() };
        events.until(|text| text.contains("hello")).await;
        events
    }

    /// Reads until the received text is enough.
    async fn until(&mut self, is_enough: impl Fn(&str) -> bool) -> &str {
        while !is_enough(&self.text) {
            let chunk =
                tokio::time::timeout(PATIENCE, self.chunks.next()).await.expect("it should come");
            let chunk = chunk.expect("the stream should go on").expect("no error");
            self.text.push_str(std::str::from_utf8(&chunk).expect("text"));
        }
        &self.text
    }

    /// The stream ends by itself.
    async fn ended(mut self) {
        while let Some(Ok(_)) =
            tokio::time::timeout(PATIENCE, self.chunks.next()).await.expect("it should end")
        {
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn event_stream_is_limited_to_the_scope_and_ends_with_the_rights() {
    let sites = Sites::new().await;
    sites.add("alice", &["viewer"], Some("site=lab")).await;
    let alice = Asker { server: &sites.server, token: sites.log_in("alice").await.token };
    let mut events = Events::open(&alice).await;
    let mut all =
        Events::open(&Asker { server: &sites.server, token: sites.server.operator.reveal() }).await;
    let package = sites.server.push("talker", "1.0.0").await;
    let elsewhere = sites.server.deploy(&package, "boreas", "elsewhere").await;
    let everywhere = sites.server.deploy(&package, "atlas,boreas", "everywhere").await;
    let last = |text: &str| text.contains(everywhere.id.as_str());
    all.until(|text| last(text) && text.contains("\"boreas\"") && text.contains("\"atlas\"")).await;
    // The feed may name the deployment before the deployment itself arrives.
    let is_counted = |text: &str| text.contains("\"counts\":");
    let seen =
        events.until(|text| last(text) && is_counted(text) && text.contains("\"atlas\"")).await;
    for other in ["boreas", sites.field.id.as_str(), elsewhere.id.as_str()] {
        assert!(!seen.contains(other), "{other}: {seen}");
    }
    let counted = seen.split("\"counts\":").nth(1).expect("a deployment");
    assert!(counted.starts_with("[{\"phase\":\"assigned\",\"count\":1}]"), "{counted}");
    // A robot that is removed elsewhere is none of her business either.
    sites.server.request(Method::DELETE, "/api/v1/robots/boreas").send().await.expect("an answer");
    all.until(|text| text.contains("robot_removed")).await;
    sites.server.request(Method::DELETE, "/api/v1/robots/atlas").send().await.expect("an answer");
    let seen = events.until(|text| text.contains("robot_removed")).await;
    assert!(!seen.contains(sites.field.id.as_str()), "{seen}");

    let edit = sites
        .server
        .request(Method::PATCH, "/api/v1/users/alice")
        .json(&json!({ "scope": "site=field" }));
    let _: Value = answer(edit).await;
    events.ended().await;
    let again = Events::open(&alice).await;
    let gone = sites
        .server
        .request(Method::DELETE, "/api/v1/users/alice")
        .send()
        .await
        .expect("an answer");
    assert_eq!(gone.status(), StatusCode::NO_CONTENT);
    again.ended().await;
    assert_eq!(alice.status(Method::GET, "/api/v1/events").await, 401);
}

async fn mqtt(sites: &Sites, token: &str) -> (Raw, [u8; 4]) {
    let connect = Connect { password: Some(token.to_owned()), ..Connect::operator("") };
    let stream = TcpStream::connect(&sites.server.server.addresses().mqtt).await.expect("listens");
    let mut raw = Raw { stream };
    raw.send(&connect.packet()).await;
    let mut answer = [0; 4];
    let read = tokio::time::timeout(PATIENCE, raw.stream.read_exact(&mut answer))
        .await
        .expect("an answer");
    read.expect("an answer");
    (raw, answer)
}

#[tokio::test(flavor = "multi_thread")]
async fn revoked_token_ends_its_mqtt_session_at_once() {
    let sites = Sites::new().await;
    sites.add("alice", &["viewer"], None).await;
    sites.add("bob", &["viewer"], Some("site=lab")).await;
    let (alice, bob) = (sites.log_in("alice").await, sites.log_in("bob").await);
    let (mut session, answer) = mqtt(&sites, &alice.token).await;
    assert_eq!(answer, [0x20, 2, 0, 0]);
    let (_, refused) = mqtt(&sites, &bob.token).await;
    assert_eq!(refused, [0x20, 2, 0, 5], "over MQTT one hears every robot");
    let path = format!("/api/v1/tokens/{}", alice.id);
    let revoked = sites.server.request(Method::DELETE, &path).send().await.expect("an answer");
    assert_eq!(revoked.status(), StatusCode::NO_CONTENT);
    session.expect_close().await;
    let (_, refused) = mqtt(&sites, &alice.token).await;
    assert_eq!(refused, [0x20, 2, 0, 4]);
}

#[tokio::test(flavor = "multi_thread")]
async fn token_with_fewer_rights_revokes_no_other_token() {
    let sites = Sites::new().await;
    sites.add("alice", &["viewer"], None).await;
    let alice = sites.log_in("alice").await;
    let made = sites
        .server
        .bare(Method::POST, "/api/v1/tokens")
        .bearer_auth(&alice.token)
        .json(&json!({ "title": "wall" }));
    let made: AccessToken = answer(made).await;
    let end = async |with: &str, id: &TokenId| {
        let request =
            sites.server.bare(Method::DELETE, &format!("/api/v1/tokens/{id}")).bearer_auth(with);
        request.send().await.expect("an answer").status()
    };
    assert_eq!(end(&made.token, &alice.id).await, StatusCode::NOT_FOUND);
    let alice_asks = sites.server.bare(Method::GET, "/api/v1/robots").bearer_auth(&alice.token);
    assert_eq!(alice_asks.send().await.expect("an answer").status(), StatusCode::OK);
    assert_eq!(end(&made.token, &made.id).await, StatusCode::NO_CONTENT, "itself");
    let again = sites
        .server
        .bare(Method::POST, "/api/v1/tokens")
        .bearer_auth(&alice.token)
        .json(&json!({ "title": "wall" }));
    let again: AccessToken = answer(again).await;
    assert_eq!(end(&alice.token, &again.id).await, StatusCode::NO_CONTENT);
}

#[tokio::test(flavor = "multi_thread")]
async fn forwarded_address_counts_only_from_a_trusted_proxy() {
    let directory = tempfile::TempDir::new().expect("a directory");
    let server = TestServer::start_in(directory, |config| {
        config.trusted_proxies = vec![[127, 0, 0, 1].into()]
    })
    .await;
    let create = server.request(Method::POST, "/api/v1/enrollment-tokens").json(&json!({}));
    let _: Value = answer(create.header("x-forwarded-for", "198.51.100.1, 192.0.2.7")).await;
    let from = |audit: &Value| audit["records"][0]["entry"]["address"].clone();
    assert_eq!(from(&server.get("/api/v1/audit").await), "192.0.2.7");
    // Addresses behind the proxy are counted apart.
    let sign_in = |n: u8, from: &str| {
        let request = server.bare(Method::POST, "/api/v1/login").header("x-forwarded-for", from);
        request.json(&json!({ "user": format!("nobody{n}"), "password": "guess" })).send()
    };
    for n in 0..50 {
        assert_eq!(sign_in(n, "192.0.2.7").await.expect("an answer").status(), 401);
    }
    assert_eq!(sign_in(50, "192.0.2.7").await.expect("an answer").status(), 429);
    assert_eq!(sign_in(50, "192.0.2.8").await.expect("an answer").status(), 401);
    let server = server.restart().await;
    let create = server.request(Method::POST, "/api/v1/enrollment-tokens").json(&json!({}));
    let _: Value = answer(create.header("x-forwarded-for", "192.0.2.7")).await;
    assert_eq!(from(&server.get("/api/v1/audit").await), "127.0.0.1");
}

#[tokio::test(flavor = "multi_thread")]
async fn sign_in_flood_does_not_delay_robots() {
    let sites = Sites::new().await;
    let mut flood = tokio::task::JoinSet::new();
    for n in 0..200 {
        let request = sites.server.bare(Method::POST, "/api/v1/login");
        let request = request.json(&json!({ "user": format!("nobody{n}"), "password": "guess" }));
        flood.spawn(async move { request.send().await.expect("an answer").status().as_u16() });
    }
    // While it lasts, a robot is answered.
    for _ in 0..20 {
        let asked =
            tokio::time::timeout(Duration::from_secs(5), sites.server.ask_desired(&sites.lab))
                .await;
        assert_eq!(asked.expect("answered").status(), StatusCode::OK);
    }
    let answers = flood.join_all().await;
    let count = |status: u16| answers.iter().filter(|answer| **answer == status).count();
    assert_eq!(count(401) + count(429), answers.len(), "{answers:?}");
    assert!(count(401) <= 50 && count(429) >= 150, "one address has its limit: {answers:?}");
}

/// The head of a request by `token` with a body of `length` bytes.
fn head(request: &str, token: &str, length: usize) -> String {
    format!(
        "{request} HTTP/1.1\r\nhost: localhost\r\nauthorization: Bearer {token}\r\n\
         connection: close\r\ncontent-type: application/json\r\ncontent-length: {length}\r\n\
         expect: 100-continue\r\n\r\n"
    )
}

#[tokio::test(flavor = "multi_thread")]
async fn request_in_flight_of_a_removed_person_changes_nothing() {
    let sites = Sites::new().await;
    for name in ["mallory", "alice"] {
        sites.add(name, &["admin"], None).await;
    }
    let mallory = sites.log_in("mallory").await;
    let bodies = [
        ("POST /api/v1/users", json!({ "name": "evil", "roles": ["admin"] })),
        ("POST /api/v1/tokens", json!({ "user": "alice" })),
    ];
    let mut held = Vec::new();
    for (request, body) in bodies {
        let body = body.to_string();
        let mut stream =
            TcpStream::connect(&sites.server.server.addresses().http).await.expect("listens");
        stream.write_all(head(request, &mallory.token, body.len()).as_bytes()).await.expect("sent");
        // A request for the body shows that the client was admitted.
        let mut asked = [0; 25];
        tokio::time::timeout(PATIENCE, stream.read_exact(&mut asked))
            .await
            .expect("in time")
            .expect("asked");
        assert_eq!(&asked, b"HTTP/1.1 100 Continue\r\n\r\n");
        held.push((stream, body));
    }
    let removed = sites
        .server
        .request(Method::DELETE, "/api/v1/users/mallory")
        .send()
        .await
        .expect("an answer");
    assert_eq!(removed.status(), StatusCode::NO_CONTENT);
    for (mut stream, body) in held {
        stream.write_all(body.as_bytes()).await.expect("sent");
        let mut said = String::new();
        tokio::time::timeout(PATIENCE, stream.read_to_string(&mut said))
            .await
            .expect("in time")
            .expect("an answer");
        assert!(said.starts_with("HTTP/1.1 401 "), "{said}");
    }
    let users: Value = sites.server.get("/api/v1/users").await;
    assert_eq!(users["users"].as_array().map(Vec::len), Some(1), "{users}");
}

#[tokio::test(flavor = "multi_thread")]
async fn removed_persons_session_ends_even_if_the_client_disconnects() {
    let sites = Sites::new().await;
    let is_there = async |name: &str| {
        let users: Value = sites.server.get("/api/v1/users").await;
        users["users"].as_array().is_some_and(|users| users.iter().any(|user| user["name"] == name))
    };
    for number in 0..12 {
        let name = format!("user{number}");
        let user = json!({ "name": name, "roles": ["viewer"] });
        let _: Value = sites.server.post("/api/v1/users", &user).await;
        let made: Value = sites.server.post("/api/v1/tokens", &json!({ "user": name })).await;
        let (mut session, answer) = mqtt(&sites, made["token"].as_str().expect("a token")).await;
        assert_eq!(answer, [0x20, 2, 0, 0]);
        // The caller hangs up at an unknown moment: at once, in which case nothing happens, or
        // after some steps.
        let mut others = number % 4;
        while is_there(&name).await {
            let mut stream =
                TcpStream::connect(&sites.server.server.addresses().http).await.expect("listens");
            let request =
                head(&format!("DELETE /api/v1/users/{name}"), &sites.server.operator.reveal(), 0);
            stream.write_all(request.as_bytes()).await.expect("sent");
            for _ in 0..others {
                let _: Value = sites.server.get("/api/v1/session").await;
            }
            others += 1;
        }
        session.expect_close().await;
    }
}
