//! Robots that wait for approval: they have nothing, they can be given no orders, and none waits
//! for ever.

use reqwest::Method;
use serde_json::{Value, json};
use task_proto::RobotId;
use task_proto::api::{
    AuditPage, CreateEnrollmentToken, EnrollResponse, EnrollmentToken, PendingRobotList, RobotView,
};
use task_proto::trust::token::Token;
use taskd::domain::person::Scope;
use taskd::net::tls::ClientProof;
use taskd::store::TokenHolder;
use tempfile::TempDir;

use crate::database::{TestDatabase, on_both_databases};
use crate::enrollments::connack;
use crate::fleet::{Fleet, mac};
use crate::harness::{TestRobot, TestServer, answer, refusal};
use crate::story::code;

on_both_databases! {
    robot_waits_until_approval_rejection_or_a_week,
    at_most_a_thousand_robots_wait_for_approval,
}

const DAY_MS: u64 = 24 * 60 * 60 * 1000;

async fn robot_waits_until_approval_rejection_or_a_week(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let store = fleet.database.store.clone();
    let holder = async |token: &Token| {
        store
            .tokens()
            .admit(token, &ClientProof::NotRequested, fleet.clock.now_ms())
            .await
            .expect("reads")
            .map(|admitted| admitted.holder)
    };
    let order =
        CreateEnrollmentToken { approval: true, ttl_s: Some(30 * 24 * 3600), ..Default::default() };
    let token = fleet.enrollment_token(order).await;
    let one = fleet.try_enroll(&token, mac(1), Some("one")).await.expect("enrolls");
    // An answer that was lost is mended as ever, and the robot goes on waiting.
    let one = fleet
        .try_enroll(&token, mac(1), Some("one"))
        .await
        .map(|again| (one, again))
        .expect("mended");
    assert!(one.0.awaits_approval && one.1.awaits_approval);
    let one = one.1;
    assert_eq!(
        holder(&one.token).await,
        Some(TokenHolder::Pending { robot: one.robot_id.clone(), key: None })
    );
    let two = fleet.try_enroll(&token, mac(2), Some("two")).await.expect("enrolls");
    assert_eq!(
        store
            .robots()
            .matching(&"*".parse().expect("valid"), &Scope::everything(), None)
            .await
            .expect("reads")
            .robots,
        []
    );
    assert_eq!(store.robots().broker_credentials().await.expect("reads"), []);
    assert_eq!(
        store.robots().desired_tasks(std::slice::from_ref(&one.robot_id)).await.expect("reads"),
        []
    );

    for _ in 0..2 {
        fleet.robots.approve(&fleet.operator, &one.robot_id).await.expect("approved");
    }
    assert!(matches!(holder(&one.token).await, Some(TokenHolder::Robot { .. })));
    assert_eq!(
        store
            .robots()
            .matching(&"*".parse().expect("valid"), &Scope::everything(), None)
            .await
            .expect("reads")
            .robots
            .len(),
        1
    );
    // Rejecting a robot that does not wait would be a removal.
    assert_eq!(code(fleet.robots.reject(&fleet.operator, &one.robot_id).await), "not_pending");

    fleet.robots.reject(&fleet.operator, &two.robot_id).await.expect("rejected");
    assert_eq!(holder(&two.token).await, None);
    // Name and MAC are free again.
    let two = fleet.try_enroll(&token, mac(2), Some("two")).await.expect("enrolls");
    fleet.clock.advance_ms(7 * DAY_MS);
    fleet.actions.expire().await.expect("looks");
    assert!(holder(&two.token).await.is_some(), "a week has not passed");
    fleet.clock.advance_ms(1);
    fleet.actions.expire().await.expect("looks");
    assert_eq!(holder(&two.token).await, None);
    let left: Vec<RobotId> = store
        .robots()
        .list(&Default::default())
        .await
        .expect("reads")
        .into_iter()
        .map(|row| row.robot.id)
        .collect();
    assert_eq!(left, [one.robot_id]);
}

async fn at_most_a_thousand_robots_wait_for_approval(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let token = fleet
        .enrollment_token(CreateEnrollmentToken {
            approval: true,
            unlimited: true,
            ..Default::default()
        })
        .await;
    let mut first = None;
    for number in 0..1_000 {
        let came = fleet.try_enroll(&token, mac(number), None).await.expect("enrolls");
        first.get_or_insert(came.robot_id);
    }
    let one_more = async || fleet.try_enroll(&token, mac(1_000), None).await;
    assert_eq!(code(one_more().await), "too_many_requests");
    assert!(fleet.try_enroll(&token, mac(0), None).await.is_ok(), "a waiting robot may ask again");
    fleet.robots.approve(&fleet.operator, &first.expect("came")).await.expect("approved");
    assert!(one_more().await.expect("enrolls").awaits_approval);
}

async fn enrol(server: &TestServer, token: &str, number: u8) -> EnrollResponse {
    let body =
        json!({ "mac": format!("02:00:00:00:00:{number:02x}"), "name": format!("robot-{number}") });
    answer(server.bare(Method::POST, "/api/v1/enroll").bearer_auth(token).json(&body)).await
}

async fn act(server: &TestServer, robot: &RobotId, verb: &str) {
    let request = server.request(Method::POST, &format!("/api/v1/robots/{robot}/{verb}"));
    request.send().await.expect("an answer").error_for_status().expect("done");
}

#[tokio::test(flavor = "multi_thread")]
async fn pending_robot_has_no_access_until_it_is_approved() {
    let directory = TempDir::new().expect("a directory");
    let server = TestServer::start_in(directory, |config| config.enrollment_approval = true).await;
    let package = server.push("talker", "1.0.0").await;
    let token: EnrollmentToken = server.post("/api/v1/enrollment-tokens", &json!({})).await;
    let came = enrol(&server, &token.token, 1).await;
    assert!(came.awaits_approval);
    let own = format!("/api/v1/robots/{}", came.robot_id);
    let routes = [
        (Method::GET, format!("{own}/desired")),
        (Method::GET, format!("{own}/mqtt")),
        (Method::POST, format!("{own}/token")),
        (Method::POST, format!("{own}/report")),
    ];
    for (method, path) in routes {
        let refused = refusal(server.bare(method, &path).bearer_auth(&came.token)).await;
        assert_eq!(refused, (403, "awaits_approval".to_owned()), "{path}");
    }
    for path in ["/v2/".to_owned(), format!("/v2/talker/blobs/{}", package.content.digest)] {
        let refused = server
            .bare(Method::GET, &path)
            .bearer_auth(&came.token)
            .send()
            .await
            .expect("an answer");
        assert_eq!(refused.status(), 403, "{path}");
    }
    assert_eq!(connack(&server, came.robot_id.as_str(), &came.token).await, 5);
    // No selector of an order matches the robot.
    for (selector, why) in [
        ("*", "no_robots_match"),
        ("robot-1", "unknown_robots"),
        (came.robot_id.as_str(), "unknown_robots"),
    ] {
        let digest = &package.manifest.digest;
        let body = json!({ "package": "talker", "manifest": digest, "selector": selector });
        assert_eq!(refusal(server.order("/api/v1/deployments", selector, &body)).await.1, why);
    }
    let view: RobotView = server.get(&own).await;
    assert_eq!((view.conditions[0].code.as_str(), view.online), ("awaits_approval", false));
    let list: PendingRobotList = server.get("/api/v1/pending-robots").await;
    let [pending] = &list.robots[..] else { panic!("{list:?}") };
    assert_eq!((&pending.id, pending.address.as_deref()), (&came.robot_id, Some("127.0.0.1")));
    assert_eq!(pending.token.as_ref().map(|id| id.as_str()), Some(token.id.as_str()));

    act(&server, &came.robot_id, "approve").await;
    let robot = TestRobot::new(came.robot_id.clone(), came.token);
    server.deploy(&package, "*", "key").await;
    assert_eq!(server.desired(&robot).await.tasks.len(), 1);
    let approved: AuditPage = server.get("/api/v1/audit?act=robot.approve").await;
    let entry: Value = serde_json::from_str(approved.records[0].entry.get()).expect("json");
    assert_eq!(
        (entry["who"].as_str(), entry["target"].as_str()),
        (Some("operator.token"), Some(came.robot_id.as_str()))
    );

    // A robot that an administrator makes a token for is known already.
    let own: EnrollmentToken =
        server.post("/api/v1/enrollment-tokens", &json!({ "robot": "robot-1" })).await;
    assert!(!enrol(&server, &own.token, 1).await.awaits_approval);
    let other = enrol(&server, &token.token, 2).await;
    act(&server, &other.robot_id, "reject").await;
    let refused =
        server.bare(Method::GET, "/v2/").bearer_auth(&other.token).send().await.expect("an answer");
    assert_eq!(refused.status(), 401);
    assert_eq!(server.get::<PendingRobotList>("/api/v1/pending-robots").await.robots, []);
}
