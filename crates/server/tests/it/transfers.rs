//! Robots that pull: no more at once than the limits allow, each in its turn, and all in the end.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use reqwest::header::CONNECTION;
use reqwest::{Method, Response, StatusCode};
use serde_json::json;
use task_proto::Digest;
use task_proto::api::{DeploymentView, RobotView};
use taskd::config::SiteLimits;
use tempfile::TempDir;

use crate::harness::{TestRobot, TestServer, answer, archive_of};

/// More than a new connection buffers while its client does not read.
const BLOB_BYTES: usize = 8 * 1024 * 1024;
const ROBOTS: usize = 200;
const LIMIT: usize = 8;

/// On a connection of its own: one that has carried a blob holds so much that a whole one fits it,
/// read or not.
async fn get(server: &TestServer, robot: &TestRobot, blob: Digest) -> Response {
    let path = format!("/v2/anything/blobs/{blob}");
    let request =
        server.bare(Method::GET, &path).bearer_auth(&robot.token).header(CONNECTION, "close");
    request.send().await.expect("an answer")
}

/// Repeats the request until it is this robot's turn, at the intervals that the server names.
async fn pull(server: &TestServer, robot: &TestRobot, blob: Digest) -> (Response, u32) {
    let mut sent_away = 0;
    loop {
        let response = get(server, robot, blob).await;
        if response.status() == StatusCode::OK {
            return (response, sent_away);
        }
        assert_eq!(response.status(), StatusCode::TOO_MANY_REQUESTS);
        let seconds: u64 = response.headers()["retry-after"]
            .to_str()
            .expect("text")
            .parse()
            .expect("whole seconds");
        let body = response.text().await.expect("a body");
        assert!(
            body.contains("TOOMANYREQUESTS") && (1..=90).contains(&seconds),
            "{seconds}: {body}"
        );
        tokio::time::sleep(Duration::from_secs(seconds)).await;
        sent_away += 1;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn two_hundred_robots_pull_eight_at_a_time_and_all_succeed() {
    let directory = TempDir::new().expect("a directory");
    let limit = |config: &mut taskd::config::Config| config.transfers.all.max = Some(LIMIT as u64);
    let server = Arc::new(TestServer::start_in(directory, limit).await);
    let package = server.push_content("talker", "1.0.0", archive_of(BLOB_BYTES, 7)).await;
    let mut robots = Vec::new();
    for number in 0..ROBOTS {
        robots.push(server.enroll(&format!("robot-{number}")).await);
    }
    server.deploy(&package, "*", "key-1").await;
    let (running, most) = (Arc::new(AtomicUsize::new(0)), Arc::new(AtomicUsize::new(0)));
    let mut pulls = tokio::task::JoinSet::new();
    for robot in robots {
        let (server, running, most) = (server.clone(), running.clone(), most.clone());
        pulls.spawn(async move {
            let (mut response, _) = pull(&server, &robot, package.content.digest).await;
            // Until this robot reads, its transfer can't end.
            most.fetch_max(running.fetch_add(1, Ordering::SeqCst) + 1, Ordering::SeqCst);
            tokio::task::yield_now().await;
            running.fetch_sub(1, Ordering::SeqCst);
            let mut length = 0;
            while let Some(chunk) = response.chunk().await.expect("the rest") {
                length += chunk.len();
            }
            length
        });
    }
    assert_eq!(pulls.join_all().await, vec![BLOB_BYTES; ROBOTS]);
    let most = most.load(Ordering::SeqCst);
    assert!((2..=LIMIT).contains(&most), "{most} at once");
}

#[tokio::test(flavor = "multi_thread")]
async fn waiting_robot_is_told_when_to_return_and_nothing_else_waits() {
    let directory = TempDir::new().expect("a directory");
    let server = TestServer::start_in(directory, |config| config.transfers.all.max = Some(1)).await;
    let package = server.push_content("talker", "1.0.0", archive_of(BLOB_BYTES, 7)).await;
    let (one, two) = (server.enroll("one").await, server.enroll("two").await);
    server.deploy(&package, "*", "key-1").await;
    let blob = package.content.digest;
    // The client does not read, so the transfer stays under way.
    let first = get(&server, &one, blob).await;
    assert_eq!(first.status(), StatusCode::OK);
    let refused = get(&server, &two, blob).await;
    assert_eq!(refused.status(), StatusCode::TOO_MANY_REQUESTS);
    let path = format!("/v2/talker/blobs/{blob}");
    let head =
        server.bare(Method::HEAD, &path).bearer_auth(&two.token).send().await.expect("an answer");
    assert_eq!(head.status(), StatusCode::OK, "a size costs nothing");
    let operators = server.request(Method::GET, &path).send().await.expect("an answer");
    assert_eq!(operators.bytes().await.expect("bytes").len(), BLOB_BYTES);
    drop(first);
    let (second, _) = pull(&server, &two, blob).await;
    assert_eq!(second.bytes().await.expect("bytes").len(), BLOB_BYTES);
}

/// When a robot is told to come back: after how many seconds.
async fn told(server: &TestServer, robot: &TestRobot, blob: Digest) -> u64 {
    let response = get(server, robot, blob).await;
    assert_eq!(response.status(), StatusCode::TOO_MANY_REQUESTS);
    response.headers()["retry-after"].to_str().expect("text").parse().expect("whole seconds")
}

#[tokio::test(flavor = "multi_thread")]
async fn robots_of_an_order_with_priority_are_told_to_come_back_before_all_others() {
    const OTHERS: usize = 5;
    let directory = TempDir::new().expect("a directory");
    let server = TestServer::start_in(directory, |config| config.transfers.all.max = Some(1)).await;
    let calm = server.push_content("calm", "1.0.0", archive_of(BLOB_BYTES, 7)).await;
    let urgent = server.push_content("urgent", "1.0.0", archive_of(BLOB_BYTES, 8)).await;
    let hurried = server.enroll("hurried").await;
    let mut others = Vec::new();
    for number in 0..=OTHERS {
        others.push(server.enroll(&format!("other-{number}")).await);
    }
    server.deploy(&calm, "*", "calm").await;
    let (package, manifest) = (&urgent.name, urgent.manifest.digest);
    let order =
        json!({ "package": package, "manifest": manifest, "selector": "hurried", "priority": 1 });
    let _: DeploymentView = answer(server.order("/api/v1/deployments", "urgent", &order)).await;
    // The client does not read, so the only permitted transfer stays under way.
    let first = get(&server, &others[0], calm.content.digest).await;
    assert_eq!(first.status(), StatusCode::OK);
    let mut waiting = tokio::task::JoinSet::new();
    let server = Arc::new(server);
    for other in others.split_off(1) {
        let (server, blob) = (server.clone(), calm.content.digest);
        waiting.spawn(async move { told(&server, &other, blob).await });
    }
    let latest = waiting.join_all().await.into_iter().max().expect("some");
    // Each transfer is assumed to last a second, plus a random delay of up to half as much.
    assert!(latest >= OTHERS as u64, "{latest}");
    let hurried = told(&server, &hurried, urgent.content.digest).await;
    assert!(hurried <= 2, "{hurried}: it came last and is next");
}

/// Two robots in the same hall get a package through `limit`, which passes the whole package in a
/// second.
async fn two_pulls_take_two_seconds(limit: impl FnOnce(&mut taskd::config::Config, u64)) {
    const SMALL: usize = 256 * 1024;
    let directory = TempDir::new().expect("a directory");
    let server = TestServer::start_in(directory, |config| limit(config, SMALL as u64)).await;
    let package = server.push_content("talker", "1.0.0", archive_of(SMALL, 7)).await;
    let mut robots = Vec::new();
    for name in ["one", "two"] {
        let robot = server.enroll(name).await;
        let path = format!("/api/v1/robots/{}", robot.id);
        let edit =
            server.request(Method::PATCH, &path).json(&json!({ "labels": { "site": "hall" } }));
        let _: RobotView = answer(edit).await;
        robots.push(robot);
    }
    server.deploy(&package, "*", "key-1").await;
    let begun = tokio::time::Instant::now();
    let whole = async |robot| {
        get(&server, robot, package.content.digest).await.bytes().await.expect("bytes").len()
    };
    assert_eq!(tokio::join!(whole(&robots[0]), whole(&robots[1])), (SMALL, SMALL));
    // The last piece and the first moment aside.
    assert!(begun.elapsed() >= Duration::from_millis(1_500));
}

#[tokio::test(flavor = "multi_thread")]
async fn all_transfers_share_the_bandwidth() {
    two_pulls_take_two_seconds(|config, pace| config.transfers.all.bytes_per_s = Some(pace)).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn all_transfers_of_a_site_share_its_bandwidth() {
    two_pulls_take_two_seconds(|config, pace| {
        let hall = SiteLimits { max: None, bytes_per_s: Some(pace) };
        config.transfers.sites.insert("hall".parse().expect("valid"), hall);
    })
    .await;
}
