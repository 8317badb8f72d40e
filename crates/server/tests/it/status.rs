//! The server's own status: figures for permitted users, of their own robots only.

use reqwest::Method;
use serde_json::json;
use task_proto::api::{ServerRules, ServerStatus, SessionList};
use task_proto::messages::report::Phase;

use crate::harness::{TestServer, answer, refusal};
use crate::uplink::Session;

#[tokio::test(flavor = "multi_thread")]
async fn server_status_has_traffic_transfers_and_sites() {
    let server = TestServer::start().await;
    let mut atlas = server.enroll("atlas").await;
    server.enroll("boreas").await;
    let package = server.push("talker", "1.0.0").await;
    server.deploy(&package, "atlas", "key-1").await;
    let state = server.desired(&atlas).await;
    // Enough requests that the rate, which is rounded to a tenth, is zero on no machine.
    for _ in 0..20 {
        server.report(&mut atlas, &state, Phase::Running).await;
    }
    let body = json!({ "labels": { "site": "lab" } });
    server
        .request(Method::PATCH, "/api/v1/robots/boreas")
        .json(&body)
        .send()
        .await
        .expect("an answer");
    let status: ServerStatus = server.get("/api/v1/server/status").await;
    assert_eq!((status.robots.known, status.robots.online), (2, 1));
    let sites: Vec<_> = status
        .sites
        .iter()
        .map(|site| (site.site.as_ref().map(|s| s.as_str()), site.robots))
        .collect();
    assert_eq!(sites, [(None, 1), (Some("lab"), 1)]);
    assert!(
        status.reports.per_s > 0.0 && status.reports.latency_ms_p50 > Some(0.0),
        "{:?}",
        status.reports
    );
    assert_eq!(
        (status.database.kind.as_str(), status.broker.kind.as_str()),
        ("sqlite", "embedded")
    );
    assert!(status.database.size_bytes > Some(0) && status.broker.healthy);
    assert!(status.disk.packages_bytes > 0 && status.disk.total_bytes >= status.disk.free_bytes);
    let listeners: Vec<_> =
        status.listeners.iter().map(|listener| listener.kind.as_str()).collect();
    assert_eq!(listeners, ["http", "mqtt"]);
    let rules: ServerRules = server.get("/api/v1/server/rules").await;
    let names: Vec<_> =
        rules.rules.iter().map(|rule| (rule.name.as_str(), rule.condition.as_str())).collect();
    assert_eq!(names, [("tiny", "size ≤ 32 KB"), ("otherwise", "")]);
    assert!(rules.limits.iter().any(|limit| limit.key == "transfers.max" && limit.value == "none"));
}

#[tokio::test(flavor = "multi_thread")]
async fn sessions_are_listed_with_their_subscriptions() {
    let server = TestServer::start().await;
    let (atlas, boreas) = (server.enroll("atlas").await, server.enroll("boreas").await);
    server.enroll("away").await;
    let mut first = Session::open(&server, &atlas).await;
    let mut second = Session::open(&server, &boreas).await;
    for (session, robot) in [(&mut first, &atlas), (&mut second, &boreas)] {
        let status =
            json!({ "online": true, "start": 1, "instance": "i00000000000000c3", "connection": 1 });
        session.publish("status", status.to_string().into_bytes()).await;
        assert!(server.robot(robot).await.online);
    }
    let all: SessionList = server.get("/api/v1/server/sessions").await;
    assert_eq!((all.total, all.sessions.len(), all.next.as_ref()), (2, 2, None));
    let session = &all.sessions[0];
    assert_eq!((session.name.as_str(), &session.robot), ("atlas", &atlas.id));
    let filters: Vec<_> =
        session.subscriptions.iter().map(|s| (s.topic_filter.clone(), s.qos)).collect();
    assert_eq!(filters, [(format!("taskd/v1/r/{}/desired", atlas.id), 1)]);
    assert!(session.address.is_some() && session.traffic.bytes_in > 0);
    let page: SessionList = server.get("/api/v1/server/sessions?limit=1").await;
    assert_eq!(
        (page.total, page.sessions.len(), page.next.as_ref().map(|n| n.as_str())),
        (2, 1, Some("atlas"))
    );
    let rest: SessionList = server.get("/api/v1/server/sessions?limit=1&after=atlas").await;
    assert_eq!((rest.sessions[0].name.as_str(), rest.next), ("boreas", None));
    assert_eq!(
        refusal(server.request(Method::GET, "/api/v1/server/sessions?limit=0")).await.0,
        400
    );

    let password = "correct horse battery";
    let order =
        json!({ "name": "carol", "roles": ["viewer"], "scope": "boreas", "password": password });
    let added =
        server.request(Method::POST, "/api/v1/users").json(&order).send().await.expect("an answer");
    assert!(added.status().is_success(), "{}", added.text().await.unwrap_or_default());
    let login = json!({ "user": "carol", "password": password });
    let token: serde_json::Value =
        answer(server.bare(Method::POST, "/api/v1/login").json(&login)).await;
    let token = token["token"].as_str().expect("a token").to_owned();
    let hers = |path: &str| server.bare(Method::GET, path).bearer_auth(&token);
    let seen: SessionList = answer(hers("/api/v1/server/sessions")).await;
    assert_eq!((seen.total, seen.sessions[0].name.as_str()), (1, "boreas"));
    let status: ServerStatus = answer(hers("/api/v1/server/status")).await;
    assert_eq!((status.robots.known, status.robots.online), (1, 1), "of her own");
}
