//! The feed: events are told once, grouped where there are many, and to the users they concern.

use std::time::Duration;

use reqwest::Method;
use serde_json::json;
use task_proto::api::{FeedEntry, FeedKind, FeedPage};
use task_proto::messages::report::{Condition, Phase, Report};
use task_proto::telemetry::log::LogLevel;
use taskd::store::{FeedAudience, NewFeedEntry};

use crate::database::{TestDatabase, on_both_databases};
use crate::harness::{TestRobot, TestServer, answer, refusal};
use crate::page_sessions::{restart, server_on};

on_both_databases! {
    feed_survives_a_restart,
    newest_entries_are_kept_under_growing_numbers,
}

/// Longer than anything waits to be told with others.
const PATIENCE: Duration = Duration::from_secs(30);

/// The entries of this kind, once there are some.
async fn feed_entries(server: &TestServer, kind: FeedKind) -> Vec<FeedEntry> {
    wait_for_feed_entries(server, kind, 1).await
}

/// The same, once there is this number of entries.
async fn wait_for_feed_entries(
    server: &TestServer,
    kind: FeedKind,
    times: usize,
) -> Vec<FeedEntry> {
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
async fn limited_to(server: &TestServer, name: &str, scope: &str) -> String {
    let password = "correct horse battery";
    let user = json!({ "name": name, "roles": ["viewer"], "scope": scope, "password": password });
    let added =
        server.request(Method::POST, "/api/v1/users").json(&user).send().await.expect("an answer");
    assert!(added.status().is_success());
    let login = json!({ "user": name, "password": password });
    let token: serde_json::Value =
        answer(server.bare(Method::POST, "/api/v1/login").json(&login)).await;
    token["token"].as_str().expect("a token").to_owned()
}

async fn poll(server: &TestServer, robot: &TestRobot) {
    assert_eq!(server.ask_desired(robot).await.status(), 200);
}

async fn feed_survives_a_restart(database: TestDatabase) {
    let server = server_on(&database, tempfile::tempdir().expect("a directory")).await;
    server.enroll("atlas").await;
    let before = feed_entries(&server, FeedKind::RobotEnrolled).await;
    let (theirs, others) =
        (limited_to(&server, "carol", "atlas").await, limited_to(&server, "dave", "boreas").await);

    let server = restart(&database, server).await;
    assert_eq!(feed_entries(&server, FeedKind::RobotEnrolled).await, before);
    for (token, is_told) in [(theirs, true), (others, false)] {
        let page: FeedPage =
            answer(server.bare(Method::GET, "/api/v1/feed").bearer_auth(token)).await;
        assert_eq!(page.entries.contains(&before[0]), is_told, "{:?}", page.entries);
    }
    let mut events = server.request(Method::GET, "/api/v1/events").send().await.expect("an answer");
    server.enroll("boreas").await;
    let after = wait_for_feed_entries(&server, FeedKind::RobotEnrolled, 2).await;
    assert_eq!(after[..1], before);
    assert!(after[1].number > before[0].number);
    // The stream of events has the same entry.
    let entry = serde_json::to_string(&after[1]).expect("json");
    let mut heard = String::new();
    while !heard.contains(&entry) {
        let chunk = tokio::time::timeout(PATIENCE, events.chunk()).await.expect("it should come");
        let chunk = chunk.expect("no error").expect("the stream should go on");
        heard.push_str(std::str::from_utf8(&chunk).expect("text"));
    }
    assert!(!heard.contains("atlas: "), "earlier events are not repeated: {heard}");
}

async fn newest_entries_are_kept_under_growing_numbers(database: TestDatabase) {
    const KEPT: u64 = 1_000;
    let feed = database.store.feed();
    let entry = |text: &str| NewFeedEntry {
        kind: FeedKind::Disk,
        level: LogLevel::Info,
        robot: None,
        deployment: None,
        text: text.to_owned(),
        audience: FeedAudience::Everybody,
    };
    assert_eq!(feed.append(&[entry("a"), entry("b")], 5_000).await.expect("stored"), 5_000..=5_001);
    // Neither entries of one moment nor a clock that goes back give a number twice.
    assert_eq!(feed.append(&[entry("c")], 5_000).await.expect("stored"), 5_002..=5_002);
    assert_eq!(feed.append(&[entry("d")], 4_000).await.expect("stored"), 5_003..=5_003);
    let texts = async |number: u64| -> Vec<String> {
        let entries = feed.after(number).await.expect("reads").into_iter();
        entries.map(|(entry, _)| entry.text).collect()
    };
    assert_eq!(texts(0).await, ["a", "b", "c", "d"]);
    assert_eq!(texts(5_001).await, ["c", "d"]);
    let of_one = feed.between(&(5_003..=5_003)).await.expect("reads");
    assert_eq!((of_one.len(), of_one[0].0.number, of_one[0].0.at_ms), (1, 5_003, 4_000));
    let many = vec![entry("e"); 997];
    assert_eq!(feed.append(&many, 9_000).await.expect("stored"), 9_000..=9_996);
    let kept = feed.after(0).await.expect("reads");
    assert_eq!((kept.len() as u64, kept[0].0.text.as_str()), (KEPT, "b"));
    assert_eq!(kept.last().map(|(entry, _)| entry.number), Some(9_996));
}

#[tokio::test(flavor = "multi_thread")]
async fn single_events_name_their_robot() {
    let server = TestServer::start().await;
    let mut robot = server.enroll("atlas").await;
    let enrolled = feed_entries(&server, FeedKind::RobotEnrolled).await;
    assert_eq!(enrolled[0].robot_name.as_ref().map(|name| name.as_str()), Some("atlas"));
    poll(&server, &robot).await;
    assert_eq!(feed_entries(&server, FeedKind::RobotOnline).await[0].text, "atlas came online");
    let package = server.push("talker", "1.0.0").await;
    let deployment = server.deploy(&package, "atlas", "key-1").await;
    let begun = feed_entries(&server, FeedKind::DeploymentBegun).await;
    assert_eq!(begun[0].deployment.as_ref(), Some(&deployment.id));
    let state = server.desired(&robot).await;
    server.report(&mut robot, &state, Phase::Failed).await;
    let failed = feed_entries(&server, FeedKind::TaskFailed).await;
    assert_eq!((failed.len(), failed[0].text.as_str()), (1, "talker 1.0.0 failed on atlas"));
    assert!(feed_entries(&server, FeedKind::DeploymentSettled).await[0].number > begun[0].number);
    let after: FeedPage =
        server.get(&format!("/api/v1/feed?after={}&limit=1", enrolled[0].number)).await;
    assert_eq!(after.entries.len(), 1);
    assert!(after.entries[0].number > enrolled[0].number);
    assert_eq!(refusal(server.request(Method::GET, "/api/v1/feed?limit=0")).await.0, 400);
    let gone =
        server.request(Method::DELETE, "/api/v1/robots/atlas").send().await.expect("an answer");
    assert_eq!(gone.status(), 204);
    assert_eq!(feed_entries(&server, FeedKind::RobotRevoked).await[0].text, "atlas was removed");
}

#[tokio::test(flavor = "multi_thread")]
async fn new_condition_of_a_robot_is_reported_once() {
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
    let feed_entries = wait_for_feed_entries(&server, FeedKind::RobotCondition, 3).await;
    let texts: Vec<&str> = feed_entries.iter().map(|entry| entry.text.as_str()).collect();
    let held = "atlas: held: a wheel is being changed";
    assert_eq!(texts, [held, "atlas: clock wrong: by two days", held]);
}

#[tokio::test(flavor = "multi_thread")]
async fn burst_of_events_is_combined_for_unlimited_readers_only() {
    let server = TestServer::start().await;
    let mut robots = Vec::new();
    for number in 0..8 {
        robots.push(server.enroll(&format!("r{number}")).await);
    }
    for robot in &robots {
        poll(&server, robot).await;
    }
    let online = feed_entries(&server, FeedKind::RobotOnline).await;
    assert_eq!(
        (online.len(), online[0].text.as_str(), online[0].robot.as_ref()),
        (1, "8 robots came online", None)
    );
    let token = limited_to(&server, "carol", "r3").await;
    let gone = server.request(Method::DELETE, "/api/v1/robots/r3").send().await.expect("an answer");
    assert_eq!(gone.status(), 204);
    feed_entries(&server, FeedKind::RobotRevoked).await;
    let page: FeedPage = answer(server.bare(Method::GET, "/api/v1/feed").bearer_auth(token)).await;
    // The fill level of this machine's disk concerns all users.
    let of_robots: Vec<_> =
        page.entries.iter().filter(|entry| entry.kind != FeedKind::Disk).collect();
    assert!(
        of_robots.iter().all(|entry| entry.robot.as_ref() == Some(&robots[3].id)),
        "{of_robots:?}"
    );
    let (last, before) = of_robots.split_last().expect("the events of r3");
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
        let removed = wait_for_feed_entries(&server, FeedKind::RobotRevoked, entries).await;
        if removed.iter().skip(1).map(count).sum::<usize>() >= 7 {
            break removed;
        }
        entries = removed.len() + 1;
    };
    assert_eq!(removed.iter().skip(1).map(count).sum::<usize>(), 7, "{removed:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn feed_entries_follow_the_robots_current_labels() {
    let server = TestServer::start().await;
    let robot = server.enroll("atlas").await;
    feed_entries(&server, FeedKind::RobotEnrolled).await;
    let token = limited_to(&server, "carol", "site=lab").await;
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
