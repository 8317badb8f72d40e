//! The API as its clients use it: orders, their idempotency, robots' desired states and reports,
//! and the shapes of refusals.

use futures_util::StreamExt as _;
use reqwest::{Method, StatusCode};
use serde_json::{Value, json};
use task_proto::api::{
    DeploymentState, DeploymentView, MatchedRobots, PackageList, ReportReply, RobotList, ServerInfo,
};
use task_proto::messages::report::Phase;

use crate::harness::{TestServer, answer, refusal};

#[tokio::test(flavor = "multi_thread")]
async fn order_reaches_the_robot_and_its_report_returns() {
    let server = TestServer::start().await;
    let mut robot = server.enroll("atlas").await;
    let package = server.push("talker", "1.0.0").await;
    let packages: PackageList = server.get("/api/v1/packages").await;
    assert_eq!(packages.packages[0].package, package);

    let ordered = server.deploy(&package, "*", "key-1").await;
    assert_eq!(ordered.assignments.as_ref().map(Vec::len), Some(1));
    let state = server.desired(&robot).await;
    assert_eq!(
        (state.robot_id.clone(), state.tasks[0].package.clone()),
        (robot.id.clone(), package)
    );
    let reply: ReportReply =
        server.report(&mut robot, &state, Phase::Running).await.json().await.expect("a reply");
    assert_eq!(reply.generation, state.generation);

    let view = server.robot(&robot).await;
    assert!(view.online);
    assert_eq!((view.tasks[0].phase, view.observed_generation), (Phase::Running, state.generation));
    let settled: DeploymentView = server.get(&format!("/api/v1/deployments/{}", ordered.id)).await;
    assert_eq!(settled.state, DeploymentState::Settled);
}

#[tokio::test(flavor = "multi_thread")]
async fn http_traffic_is_counted_at_the_sockets() {
    let server = TestServer::start().await;
    let before: ServerInfo = server.get("/api/v1/server").await;
    let body: PackageList = server.get("/api/v1/packages").await;
    let after: ServerInfo = server.get("/api/v1/server").await;
    assert_eq!(after.http.requests, before.http.requests + 2);
    let answers = serde_json::to_vec(&before).expect("json").len()
        + serde_json::to_vec(&body).expect("json").len();
    assert!(after.http.bytes_out > before.http.bytes_out + answers as u64, "{before:?} {after:?}");
    assert!(after.http.bytes_in > before.http.bytes_in, "{before:?} {after:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn desired_state_with_a_matching_etag_has_no_body() {
    let server = TestServer::start().await;
    let robot = server.enroll("atlas").await;
    let tag = server.ask_desired(&robot).await.headers()["etag"].clone();
    let path = format!("/api/v1/robots/{}/desired", robot.id);
    let again = || {
        server
            .bare(Method::GET, &path)
            .bearer_auth(&robot.token)
            .header("if-none-match", tag.clone())
    };
    assert_eq!(again().send().await.expect("an answer").status(), StatusCode::NOT_MODIFIED);
    let package = server.push("talker", "1.0.0").await;
    server.deploy(&package, "atlas", "key-1").await;
    assert_eq!(again().send().await.expect("an answer").status(), StatusCode::OK);
}

#[tokio::test(flavor = "multi_thread")]
async fn repeated_idempotency_key_returns_the_same_order() {
    let server = TestServer::start().await;
    let robot = server.enroll("atlas").await;
    let package = server.push("talker", "1.0.0").await;
    let first = server.deploy(&package, "*", "key-1").await;
    let generation = server.desired(&robot).await.generation;
    assert_eq!(server.deploy(&package, "*", "key-1").await.id, first.id);
    assert_eq!(server.desired(&robot).await.generation, generation);
    let other =
        json!({ "package": "talker", "manifest": package.manifest.digest, "selector": "atlas" });
    let reused = refusal(server.order("/api/v1/deployments", "key-1", &other)).await;
    assert_eq!(reused, (409, "idempotency_key_reused".to_owned()));
    assert_ne!(server.deploy(&package, "*", "key-2").await.id, first.id);
}

#[tokio::test(flavor = "multi_thread")]
async fn dry_run_names_the_robots_and_orders_nothing() {
    let server = TestServer::start().await;
    let robot = server.enroll("atlas").await;
    server.enroll("boreas").await;
    let package = server.push("talker", "1.0.0").await;
    let body = json!({
        "package": "talker", "manifest": package.manifest.digest, "selector": "atlas",
        "dry_run": true,
    });
    let matched: MatchedRobots = server.post("/api/v1/deployments", &body).await;
    assert_eq!(
        matched.robots.iter().map(|robot| robot.name.as_str()).collect::<Vec<_>>(),
        ["atlas"]
    );
    assert!(server.desired(&robot).await.tasks.is_empty());
    let body =
        json!({ "package": "talker", "manifest": package.manifest.digest, "selector": "nobody" });
    let nobody = refusal(server.order("/api/v1/deployments", "key-1", &body)).await;
    assert_eq!(nobody, (404, "unknown_robots".to_owned()));
}

#[tokio::test(flavor = "multi_thread")]
async fn cancelled_order_restores_the_old_version() {
    let server = TestServer::start().await;
    let mut robot = server.enroll("atlas").await;
    let (old, new) = (server.push("talker", "1.0.0").await, server.push("talker", "2.0.0").await);
    server.deploy(&old, "*", "key-1").await;
    let state = server.desired(&robot).await;
    server.report(&mut robot, &state, Phase::Running).await;
    let second = server.deploy(&new, "*", "key-2").await;
    assert_eq!(server.desired(&robot).await.tasks[0].package, new);
    let path = format!("/api/v1/deployments/{}/cancel", second.id);
    let cancelled: DeploymentView = answer(server.request(Method::POST, &path)).await;
    assert_eq!(cancelled.state, DeploymentState::Cancelled);
    assert_eq!(server.desired(&robot).await.tasks[0].package, old);
    // An order that is repeated after its package was deleted is the same order.
    let path = format!("/v2/talker/manifests/{}", new.manifest.digest);
    let deleted = server.request(Method::DELETE, &path).send().await.expect("an answer");
    assert_eq!(deleted.status(), StatusCode::ACCEPTED);
    assert_eq!(server.deploy(&new, "*", "key-2").await.id, second.id);
    let body = json!({ "package": "talker", "manifest": new.manifest.digest, "selector": "*" });
    let refused = refusal(server.order("/api/v1/deployments", "key-3", &body)).await;
    assert_eq!(refused, (404, "package_not_found".to_owned()));
}

#[tokio::test(flavor = "multi_thread")]
async fn tasks_are_stopped_started_and_removed() {
    let server = TestServer::start().await;
    let robot = server.enroll("atlas").await;
    let package = server.push("talker", "1.0.0").await;
    server.deploy(&package, "*", "key-1").await;
    let order = json!({ "selector": "*" });
    let matched: MatchedRobots =
        answer(server.order("/api/v1/tasks/talker/stop", "key-2", &order)).await;
    assert_eq!(matched.robots.len(), 1);
    assert_eq!(
        server.desired(&robot).await.tasks[0].wanted,
        task_proto::desired::TargetState::Stopped
    );
    let _: MatchedRobots =
        answer(server.order("/api/v1/tasks/talker/start", "key-3", &order)).await;
    let started = server.desired(&robot).await.tasks[0].clone();
    assert_eq!((started.wanted, started.run), (task_proto::desired::TargetState::Running, 2));
    let _: MatchedRobots =
        answer(server.order("/api/v1/tasks/talker/remove", "key-4", &order)).await;
    assert!(server.desired(&robot).await.tasks.is_empty());
}

#[tokio::test(flavor = "multi_thread")]
async fn robots_are_found_edited_and_removed() {
    let server = TestServer::start().await;
    let robot = server.enroll("atlas").await;
    server.enroll("boreas").await;
    let edit = json!({ "name": "atlas-2", "labels": { "site": "lab" } });
    let edited: Value =
        answer(server.request(Method::PATCH, "/api/v1/robots/atlas").json(&edit)).await;
    assert_eq!(edited["name"], "atlas-2");
    let found: RobotList = server.get("/api/v1/robots?selector=site%3Dlab").await;
    assert_eq!(found.robots.len(), 1);
    let taken =
        server.request(Method::PATCH, "/api/v1/robots/boreas").json(&json!({ "name": "atlas-2" }));
    assert_eq!(refusal(taken).await, (409, "name_taken".to_owned()));
    let removed =
        server.request(Method::DELETE, "/api/v1/robots/atlas-2").send().await.expect("an answer");
    assert_eq!(removed.status(), StatusCode::NO_CONTENT);
    assert_eq!(server.ask_desired(&robot).await.status(), StatusCode::UNAUTHORIZED);
    assert_eq!(refusal(server.request(Method::GET, "/api/v1/robots/atlas-2")).await.0, 404);
}

#[tokio::test(flavor = "multi_thread")]
async fn errors_have_one_shape() {
    let server = TestServer::start().await;
    let get = |path: &str| server.request(Method::GET, path);
    let post = |body: String| {
        server
            .request(Method::POST, "/api/v1/enrollment-tokens")
            .header("content-type", "application/json")
            .body(body)
    };
    let cases = [
        (get("/nothing"), 404, "not_found"),
        (get("/api/v1/nothing"), 404, "not_found"),
        (get("/api/v1/robots/nobody"), 404, "not_found"),
        (get("/api/v1/robots/%FF"), 404, "not_found"),
        (get("/api/v1/deployments/nonsense"), 404, "not_found"),
        (get("/api/v1/deployments/d0000000000000000"), 404, "not_found"),
        (get("/api/v1/robots?selector=a%20b"), 400, "invalid_request"),
        (get("/api/v1/robots?selektor=*"), 400, "invalid_request"),
        (server.request(Method::PUT, "/api/v1/robots"), 405, "method_not_allowed"),
        (
            server.request(Method::POST, "/api/v1/enrollment-tokens").body("{}"),
            415,
            "unsupported_media_type",
        ),
        (post("{".to_owned()), 400, "invalid_request"),
        (post(r#"{"uses": "two"}"#.to_owned()), 400, "invalid_request"),
        (post(r#"{"user": 2}"#.to_owned()), 400, "invalid_request"),
        (post(format!("{{\"labels\": {{\"a\": \"{}\"}}}}", "x".repeat(100_000))), 413, "too_large"),
        (
            server
                .request(Method::POST, "/api/v1/tasks/talker/stop")
                .json(&json!({"selector": "*"})),
            400,
            "invalid_request",
        ),
    ];
    for (request, status, code) in cases {
        let request = request.build().expect("a request");
        let shown = format!("{} {}", request.method(), request.url());
        let request = reqwest::RequestBuilder::from_parts(server.client.clone(), request);
        assert_eq!(refusal(request).await, (status, code.to_owned()), "{shown}");
    }
    let allow = server.request(Method::PUT, "/api/v1/robots").send().await.expect("an answer");
    assert!(allow.headers().contains_key("allow"));
    assert_eq!(allow.headers()["x-content-type-options"], "nosniff");
    assert!(
        allow.headers()["content-security-policy"]
            .to_str()
            .expect("text")
            .contains("default-src 'none'")
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn known_mac_needs_a_token_for_that_robot() {
    let server = TestServer::start().await;
    server.enroll("atlas").await;
    let mac = server.get::<RobotList>("/api/v1/robots").await.robots[0].mac.to_string();
    let enroll = async |token: Value| {
        let token: Value = server.post("/api/v1/enrollment-tokens", &token).await;
        let request = server
            .bare(Method::POST, "/api/v1/enroll")
            .bearer_auth(token["token"].as_str().expect("text"));
        request.json(&json!({ "mac": mac }))
    };
    assert_eq!(refusal(enroll(json!({})).await).await, (409, "mac_known".to_owned()));
    let again: Value = answer(enroll(json!({ "robot": "atlas" })).await).await;
    assert_eq!(again["name"], "atlas");
}

#[tokio::test(flavor = "multi_thread")]
async fn event_stream_reports_changes_and_ends_with_the_server() {
    let server = TestServer::start().await;
    let response = server.request(Method::GET, "/api/v1/events").send().await.expect("an answer");
    assert_eq!(response.headers()["content-type"], "text/event-stream");
    let mut stream = response.bytes_stream();
    let mut text = String::new();
    server.enroll("atlas").await;
    while !text.contains("event: robot\n") {
        let chunk = stream.next().await.expect("the stream goes on").expect("bytes");
        text.push_str(std::str::from_utf8(&chunk).expect("text"));
    }
    assert!(text.contains(r#""type":"robot""#) && text.contains(r#""name":"atlas""#), "{text}");
    server.stop().await;
    while let Some(chunk) = stream.next().await {
        chunk.expect("the stream ends in order");
    }
}
