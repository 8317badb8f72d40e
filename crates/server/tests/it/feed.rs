//! The feed: events are told once, grouped where there are many, and to the users they concern.

use std::time::Duration;

use reqwest::Method;
use serde_json::json;
use task_proto::api::{FeedEntry, FeedKind, FeedPage};
use task_proto::report::{Condition, Phase, Report};

use crate::harness::{TestRobot, TestServer, answer, refusal};

/// Longer than anything waits to be told with others.
const PATIENCE: Duration = Duration::from_secs(30);

/// The entries of this kind, once there are some.
async fn told(server: &TestServer, kind: FeedKind) -> Vec<FeedEntry> {
    told_times(server, kind, 1).await
}

/// The same, once there is this number of entries.
async fn told_times(server: &TestServer, kind: FeedKind, times: usize) -> Vec<FeedEntry> {
    let asking = async {
        let mut turns = tokio::time::interval(Duration::from_millis(50));
        loop {
            turns.tick().await;
            let page: FeedPage = server.get("/api/v1/feed?limit=2000").await;
            let found: Vec<_> =
                page.entries.into_iter().filter(|entry| entry.kind == kind).collect();
            if found.len() >= times {
                return found;
            }
        }
    };
    tokio::time::timeout(PATIENCE, asking).await.expect("it is told")
}

/// The token of a user who may see these robots.
async fn limited_to(server: &TestServer, scope: &str) -> String {
    let carol = json!({ "name": "carol", "roles": ["viewer"], "scope": scope, "password": "correct horse battery" });
    let added =
        server.request(Method::POST, "/api/v1/users").json(&carol).send().await.expect("an answer");
    assert!(added.status().is_success());
    let login = json!({ "user": "carol", "password": "correct horse battery" });
    let token: serde_json::Value =
        answer(server.bare(Method::POST, "/api/v1/login").json(&login)).await;
    token["token"].as_str().expect("a token").to_owned()
}

async fn poll(server: &TestServer, robot: &TestRobot) {
    assert_eq!(server.ask_desired(robot).await.status(), 200);
}

#[tokio::test(flavor = "multi_thread")]
async fn what_happens_to_one_is_told_by_name() {
    let server = TestServer::start().await;
    let mut robot = server.enroll("atlas").await;
    let enrolled = told(&server, FeedKind::RobotEnrolled).await;
    assert_eq!(enrolled[0].robot_name.as_ref().map(|name| name.as_str()), Some("atlas"));
    poll(&server, &robot).await;
    assert_eq!(told(&server, FeedKind::RobotOnline).await[0].text, "atlas came online");
    let package = server.push("talker", "1.0.0").await;
    let deployment = server.deploy(&package, "atlas", "key-1").await;
    let begun = told(&server, FeedKind::DeploymentBegun).await;
    assert_eq!(begun[0].deployment.as_ref(), Some(&deployment.id));
    let state = server.desired(&robot).await;
    server.report(&mut robot, &state, Phase::Failed).await;
    let failed = told(&server, FeedKind::TaskFailed).await;
    assert_eq!((failed.len(), failed[0].text.as_str()), (1, "talker 1.0.0 failed on atlas"));
    assert!(told(&server, FeedKind::DeploymentSettled).await[0].number > begun[0].number);
    let after: FeedPage =
        server.get(&format!("/api/v1/feed?after={}&limit=1", enrolled[0].number)).await;
    assert_eq!(after.entries.len(), 1);
    assert!(after.entries[0].number > enrolled[0].number);
    assert_eq!(refusal(server.request(Method::GET, "/api/v1/feed?limit=0")).await.0, 400);
    let gone =
        server.request(Method::DELETE, "/api/v1/robots/atlas").send().await.expect("an answer");
    assert_eq!(gone.status(), 204);
    assert_eq!(told(&server, FeedKind::RobotRevoked).await[0].text, "atlas was removed");
}

#[tokio::test(flavor = "multi_thread")]
async fn what_is_wrong_with_a_robot_is_told_when_it_is_new() {
    let server = TestServer::start().await;
    let mut robot = server.enroll("atlas").await;
    let state = server.desired(&robot).await;
    let held =
        || Condition { code: "held".to_owned(), text: "a wheel is being changed".to_owned() };
    let wrong = || Condition { code: "clock_wrong".to_owned(), text: "by two days".to_owned() };
    for conditions in [vec![held()], vec![held(), wrong()], vec![], vec![held()]] {
        let report = Report { conditions, ..robot.next_report(&state, Phase::Running) };
        assert!(server.send_report(&robot, &report).await.status().is_success());
    }
    let told = told_times(&server, FeedKind::RobotCondition, 3).await;
    let texts: Vec<&str> = told.iter().map(|entry| entry.text.as_str()).collect();
    let held = "atlas: held: a wheel is being changed";
    assert_eq!(texts, [held, "atlas: clock wrong: by two days", held]);
}

#[tokio::test(flavor = "multi_thread")]
async fn many_that_come_are_told_together_and_not_to_whom_some_are_hidden() {
    let server = TestServer::start().await;
    let mut robots = Vec::new();
    for number in 0..8 {
        robots.push(server.enroll(&format!("r{number}")).await);
    }
    for robot in &robots {
        poll(&server, robot).await;
    }
    let online = told(&server, FeedKind::RobotOnline).await;
    assert_eq!(
        (online.len(), online[0].text.as_str(), online[0].robot.as_ref()),
        (1, "8 robots came online", None)
    );
    let token = limited_to(&server, "r3").await;
    let gone = server.request(Method::DELETE, "/api/v1/robots/r3").send().await.expect("an answer");
    assert_eq!(gone.status(), 204);
    told(&server, FeedKind::RobotRevoked).await;
    let page: FeedPage = answer(server.bare(Method::GET, "/api/v1/feed").bearer_auth(token)).await;
    // The fill level of this machine's disk concerns all users.
    let of_robots: Vec<_> =
        page.entries.iter().filter(|entry| entry.kind != FeedKind::Disk).collect();
    assert!(
        of_robots.iter().all(|entry| entry.robot.as_ref() == Some(&robots[3].id)),
        "{of_robots:?}"
    );
    let (last, before) = of_robots.split_last().expect("what became of r3");
    assert_eq!(last.kind, FeedKind::RobotRevoked);
    assert!(before.iter().all(|entry| entry.kind == FeedKind::RobotEnrolled), "{before:?}");
    let others = json!({ "selector": "*" });
    let gone = server
        .request(Method::POST, "/api/v1/bulk/remove")
        .json(&others)
        .send()
        .await
        .expect("an answer");
    assert_eq!(gone.status(), 200);
    // Together, or in parts where its turn came in the middle.
    let count = |entry: &FeedEntry| match entry.text.split_once(" robots were removed") {
        Some((count, _)) => count.parse::<usize>().expect("a count"),
        None => 1,
    };
    let mut entries = 2;
    let removed = loop {
        let removed = told_times(&server, FeedKind::RobotRevoked, entries).await;
        if removed.iter().skip(1).map(count).sum::<usize>() >= 7 {
            break removed;
        }
        entries = removed.len() + 1;
    };
    assert_eq!(removed.iter().skip(1).map(count).sum::<usize>(), 7, "{removed:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn what_was_told_of_a_robot_is_for_those_whose_it_is_now() {
    let server = TestServer::start().await;
    let robot = server.enroll("atlas").await;
    told(&server, FeedKind::RobotEnrolled).await;
    let token = limited_to(&server, "site=lab").await;
    for (site, is_told) in [("secret", false), ("lab", true), ("secret", false)] {
        let edit = server.request(Method::PATCH, &format!("/api/v1/robots/{}", robot.id));
        let edited =
            edit.json(&json!({ "labels": { "site": site } })).send().await.expect("an answer");
        assert!(edited.status().is_success());
        let page: FeedPage =
            answer(server.bare(Method::GET, "/api/v1/feed").bearer_auth(&token)).await;
        let has_it = page.entries.iter().any(|entry| entry.robot.as_ref() == Some(&robot.id));
        assert_eq!(has_it, is_told, "{site}: {:?}", page.entries);
    }
}
