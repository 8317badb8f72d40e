//! Robots that pull: no more at once than the limits allow, each in its turn, and all in the end.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use reqwest::{Method, Response, StatusCode};
use task_proto::Digest;
use tempfile::TempDir;

use crate::harness::{TestRobot, TestServer};

/// More than a connection holds while nobody reads.
const BLOB_BYTES: usize = 8 * 1024 * 1024;
const ROBOTS: usize = 200;
const LIMIT: usize = 8;

async fn get(server: &TestServer, robot: &TestRobot, blob: Digest) -> Response {
    let path = format!("/v2/anything/blobs/{blob}");
    server.bare(Method::GET, &path).bearer_auth(&robot.token).send().await.expect("an answer")
}

/// Asks until it is this robot's turn, as often and as late as it is told.
async fn pull(server: &TestServer, robot: &TestRobot, blob: Digest) -> (Response, u32) {
    let mut sent_away = 0;
    loop {
        let response = get(server, robot, blob).await;
        if response.status() == StatusCode::OK {
            return (response, sent_away);
        }
        assert_eq!(response.status(), StatusCode::TOO_MANY_REQUESTS);
        let seconds: u64 = response.headers()["retry-after"].to_str().expect("text").parse().expect("whole seconds");
        let body = response.text().await.expect("a body");
        assert!(body.contains("TOOMANYREQUESTS") && (1..=90).contains(&seconds), "{seconds}: {body}");
        tokio::time::sleep(Duration::from_secs(seconds)).await;
        sent_away += 1;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn two_hundred_robots_pull_eight_at_a_time_and_all_get_it() {
    let directory = TempDir::new().expect("a directory");
    let limit = |config: &mut taskd::config::Config| config.transfers.all.max = Some(LIMIT as u64);
    let server = Arc::new(TestServer::start_in(directory, limit).await);
    let package = server.push_content("talker", "1.0.0", vec![7; BLOB_BYTES]).await;
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
async fn who_waits_is_told_when_to_come_back_and_only_robots_wait() {
    let directory = TempDir::new().expect("a directory");
    let server = TestServer::start_in(directory, |config| config.transfers.all.max = Some(1)).await;
    let package = server.push_content("talker", "1.0.0", vec![7; BLOB_BYTES]).await;
    let (one, two) = (server.enroll("one").await, server.enroll("two").await);
    server.deploy(&package, "*", "key-1").await;
    let blob = package.content.digest;
    // Nobody reads it, so it stays under way.
    let first = get(&server, &one, blob).await;
    assert_eq!(first.status(), StatusCode::OK);
    let refused = get(&server, &two, blob).await;
    assert_eq!(refused.status(), StatusCode::TOO_MANY_REQUESTS);
    let path = format!("/v2/talker/blobs/{blob}");
    let head = server.bare(Method::HEAD, &path).bearer_auth(&two.token).send().await.expect("an answer");
    assert_eq!(head.status(), StatusCode::OK, "a size costs nothing");
    let operators = server.request(Method::GET, &path).send().await.expect("an answer");
    assert_eq!(operators.bytes().await.expect("bytes").len(), BLOB_BYTES);
    drop(first);
    let (second, _) = pull(&server, &two, blob).await;
    assert_eq!(second.bytes().await.expect("bytes").len(), BLOB_BYTES);
}

#[tokio::test(flavor = "multi_thread")]
async fn all_transfers_of_a_site_share_its_bandwidth() {
    const SMALL: usize = 256 * 1024;
    let directory = TempDir::new().expect("a directory");
    let limit = |config: &mut taskd::config::Config| config.transfers.all.bytes_per_s = Some(SMALL as u64);
    let server = TestServer::start_in(directory, limit).await;
    let package = server.push_content("talker", "1.0.0", vec![7; SMALL]).await;
    let (one, two) = (server.enroll("one").await, server.enroll("two").await);
    server.deploy(&package, "*", "key-1").await;
    let begun = tokio::time::Instant::now();
    let whole = async |robot| get(&server, robot, package.content.digest).await.bytes().await.expect("bytes").len();
    assert_eq!(tokio::join!(whole(&one), whole(&two)), (SMALL, SMALL));
    // Two seconds' worth of bytes, the last piece and the first moment aside.
    assert!(begun.elapsed() >= Duration::from_millis(1_500));
}
