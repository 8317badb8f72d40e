//! Enrollment tokens are listed and revoked, and so are robots: a revoked robot is disconnected at
//! once, is told the reason, and returns only by an administrator's token made for that robot.

use reqwest::Method;
use serde_json::{Value, json};
use task_proto::api::{
    AuditPage, EnrollResponse, EnrollmentToken, EnrollmentTokenList, ReportReply, RobotToken,
    RobotView,
};
use task_proto::messages::report::Phase;
use taskd::store::{Store, sqlite_url};

use crate::harness::{NOW_MS, TestRobot, TestServer, answer, refusal};
use crate::mqtt_harness::{Connect, Raw};

async fn token(server: &TestServer, order: Value) -> EnrollmentToken {
    server.post("/api/v1/enrollment-tokens", &order).await
}

fn enroll_request(server: &TestServer, token: &str, mac: &str) -> reqwest::RequestBuilder {
    server.bare(Method::POST, "/api/v1/enroll").bearer_auth(token).json(&json!({ "mac": mac }))
}

async fn listed(server: &TestServer) -> Vec<String> {
    let list: EnrollmentTokenList = server.get("/api/v1/enrollment-tokens").await;
    list.tokens.iter().map(|token| token.id.to_string()).collect()
}

/// The audit entries of `act`, as target and detail.
async fn audited(server: &TestServer, act: &str) -> Vec<(String, Value)> {
    let page: AuditPage = server.get(&format!("/api/v1/audit?act={act}")).await;
    let entries = page
        .records
        .iter()
        .map(|record| serde_json::from_str::<Value>(record.entry.get()).expect("json"));
    entries
        .map(|entry| {
            (entry["target"].as_str().expect("a target").to_owned(), entry["detail"].clone())
        })
        .collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn enrollment_tokens_are_listed_and_revoked_at_once() {
    let server = TestServer::start().await;
    let atlas = server.enroll("atlas").await;
    let all = token(&server, json!({ "labels": { "site": "lab" } })).await;
    let one = token(&server, json!({ "uses": 1, "robot": "atlas" })).await;
    let list: EnrollmentTokenList = server.get("/api/v1/enrollment-tokens").await;
    let shown = &list.tokens[..2];
    assert_eq!((shown[0].id.as_str(), shown[0].uses_left), (one.id.as_str(), Some(1)));
    assert_eq!(shown[0].robot.as_ref().map(|name| name.as_str()), Some("atlas"));
    assert_eq!(
        (shown[1].id.as_str(), shown[1].uses_left, shown[1].labels.len()),
        (all.id.as_str(), Some(100), 1)
    );
    assert!(
        !serde_json::to_string(&list).expect("json").contains(&all.token[18..40]),
        "a secret is listed"
    );

    let came: EnrollResponse =
        answer(enroll_request(&server, &all.token, "02:00:00:00:00:01")).await;
    let path = format!("/api/v1/enrollment-tokens/{}", all.id);
    server
        .request(Method::DELETE, &path)
        .send()
        .await
        .expect("an answer")
        .error_for_status()
        .expect("revoked");
    assert_eq!(
        refusal(enroll_request(&server, &all.token, "02:00:00:00:00:02")).await,
        (401, "unauthorized".to_owned())
    );
    // Not even the answer that may have been lost is given again.
    assert_eq!(refusal(enroll_request(&server, &all.token, "02:00:00:00:00:01")).await.0, 401);
    assert!(!listed(&server).await.contains(&all.id));
    assert_eq!(refusal(server.request(Method::DELETE, &path)).await, (404, "not_found".to_owned()));
    let revoked = audited(&server, "enrolment_token.revoke").await;
    assert_eq!(revoked.iter().map(|(target, _)| target).collect::<Vec<_>>(), [&all.id]);
    // A robot that enrolled with the token stays, and another token works as before.
    server.desired(&TestRobot::new(came.robot_id, came.token)).await;
    let mac = server.robot(&atlas).await.mac.to_string();
    let _: EnrollResponse = answer(enroll_request(&server, &one.token, &mac)).await;
    // A token that only its lifetime ends is no longer listed either.
    server.clock.advance_ms(25 * 60 * 60 * 1000);
    assert!(listed(&server).await.is_empty());
}

/// The answer to a CONNECT by the robot's token: a CONNACK's code.
pub async fn connack(server: &TestServer, robot: &str, token: &str) -> u8 {
    let connect = Connect {
        client_id: robot.to_owned(),
        user_name: Some(robot.to_owned()),
        password: Some(token.to_owned()),
        clean: true,
        keep_alive_s: 0,
        will: None,
    };
    let stream =
        tokio::net::TcpStream::connect(&server.server.addresses().mqtt).await.expect("listens");
    let mut raw = Raw { stream };
    raw.send(&connect.packet()).await;
    let answer = raw.read(4).await.expect("a CONNACK");
    assert_eq!(answer[..3], [0x20, 2, 0]);
    answer[3]
}

#[tokio::test(flavor = "multi_thread")]
async fn revoked_robot_returns_only_by_a_token_for_it() {
    let server = TestServer::start().await;
    let mut atlas = server.enroll("atlas").await;
    let mac = server.robot(&atlas).await.mac.to_string();
    let package = server.push("talker", "1.0.0").await;
    server.deploy(&package, "atlas", "key").await;
    let state = server.desired(&atlas).await;
    assert!(server.report(&mut atlas, &state, Phase::Running).await.status().is_success());
    let own = |path: &str, token: &str| {
        server.bare(Method::POST, &format!("/api/v1/robots/{}/{path}", atlas.id)).bearer_auth(token)
    };
    let next: RobotToken = answer(own("token", &atlas.token)).await;
    let (early, general) =
        (token(&server, json!({ "robot": "atlas" })).await, token(&server, json!({})).await);

    let revoke = format!("/api/v1/robots/{}/revoke", atlas.id);
    for _ in 0..2 {
        server
            .request(Method::POST, &revoke)
            .send()
            .await
            .expect("an answer")
            .error_for_status()
            .expect("revoked");
    }
    assert_eq!(audited(&server, "robot.revoke").await.len(), 1, "doing it twice is one act");
    let view: RobotView = server.robot(&atlas).await;
    assert_eq!(
        (view.conditions[0].code.as_str(), view.tasks.len()),
        ("revoked", 1),
        "the orders stay"
    );
    // Both of the robot's tokens have ended, also once ended tokens have been cleared away, and the
    // robot is told the reason.
    let store = Store::open(&sqlite_url(&server.data().join("taskd.sqlite"))).await.expect("opens");
    let mut write = store.begin().await.expect("begins");
    write.tokens().forget_ended(NOW_MS + 1).await.expect("forgotten");
    write.commit().await.expect("written");
    for token in [&atlas.token, &next.token] {
        assert_eq!(refusal(own("token", token)).await, (401, "robot_revoked".to_owned()));
        assert_eq!(connack(&server, atlas.id.as_str(), token).await, 5);
    }
    // Neither a general token nor one made for the robot earlier brings the robot back.
    assert_eq!(
        refusal(enroll_request(&server, &general.token, &mac)).await,
        (409, "mac_known".to_owned())
    );
    assert_eq!(
        refusal(enroll_request(&server, &early.token, &mac)).await,
        (401, "unauthorized".to_owned())
    );
    let again = token(&server, json!({ "robot": "atlas", "uses": 1 })).await;
    let back: EnrollResponse = answer(enroll_request(&server, &again.token, &mac)).await;
    assert_eq!(back.robot_id, atlas.id);
    // The tokens from before stay ended, also before the new one is used.
    for token in [&atlas.token, &next.token] {
        assert_eq!(refusal(own("token", token)).await, (401, "unauthorized".to_owned()));
    }
    let mut back = TestRobot::new(back.robot_id, back.token);
    assert_eq!(server.desired(&back).await.tasks.len(), 1);
    let reply: ReportReply =
        server.report(&mut back, &state, Phase::Running).await.json().await.expect("stored");
    assert_eq!(reply.generation, state.generation);
    assert!(server.robot(&back).await.conditions.is_empty());
}

#[tokio::test(flavor = "multi_thread")]
async fn enrollment_token_has_a_default_number_of_uses() {
    let server = TestServer::start_in(tempfile::TempDir::new().expect("a directory"), |config| {
        config.enrollment_uses = 2;
    });
    let server = server.await;
    let common = token(&server, json!({})).await;
    assert_eq!(common.uses_left, Some(2));
    for number in 1..=2 {
        let _: EnrollResponse =
            answer(enroll_request(&server, &common.token, &format!("02:00:00:00:01:0{number}")))
                .await;
    }
    assert_eq!(
        refusal(enroll_request(&server, &common.token, "02:00:00:00:01:03")).await,
        (401, "unauthorized".to_owned())
    );
    let unlimited = token(&server, json!({ "unlimited": true })).await;
    assert_eq!(unlimited.uses_left, None);
    for number in 1..=5 {
        let _: EnrollResponse =
            answer(enroll_request(&server, &unlimited.token, &format!("02:00:00:00:02:0{number}")))
                .await;
    }
    let both = server
        .request(Method::POST, "/api/v1/enrollment-tokens")
        .json(&json!({ "uses": 1, "unlimited": true }));
    assert_eq!(refusal(both).await, (400, "invalid_request".to_owned()));
}

#[tokio::test(flavor = "multi_thread")]
async fn enrollment_rate_is_limited_and_one_token_takes_half() {
    let server = TestServer::start_in(tempfile::TempDir::new().expect("a directory"), |config| {
        config.enrollment_per_minute = 24;
    });
    let server = server.await;
    let leaked = token(&server, json!({ "unlimited": true })).await;
    let other = token(&server, json!({})).await;
    let begun = std::time::Instant::now();
    let mut number = 0;
    let mut came_by = async |token: &EnrollmentToken| {
        let mut came = 0;
        loop {
            number += 1;
            let refused =
                enroll_request(&server, &token.token, &format!("02:00:00:00:03:{number:02}"))
                    .send()
                    .await;
            let refused = refused.expect("an answer");
            if refused.status().is_success() {
                came += 1;
                continue;
            }
            assert_eq!(refused.status().as_u16(), 429);
            let wait: u64 =
                refused.headers()["retry-after"].to_str().expect("text").parse().expect("a number");
            assert!((1..=5).contains(&wait), "{wait}");
            return came;
        }
    };
    // Ten seconds' worth at once: two of the four are left to others. A machine that is slow has a
    // few more.
    let (by_leaked, by_other) = (came_by(&leaked).await, came_by(&other).await);
    assert!((2..=6).contains(&by_leaked) && by_other >= 2, "{by_leaked}, {by_other}");
    // However many tokens there are, together they have the whole rate.
    let mut by_all = by_leaked + by_other;
    for _ in 0..4 {
        by_all += came_by(&token(&server, json!({})).await).await;
    }
    let most = 5 + begun.elapsed().as_secs() * 24 / 60;
    assert!(by_all <= most, "{by_all} came, where {most} should");
}
