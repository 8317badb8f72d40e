//! Orders that compete, are retried, are taken back.

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use task_proto::messages::report::Phase;

use crate::harness::{Fleet, Robot, Server, eventually, write_package};
use crate::proxy::Proxy;

#[tokio::test(flavor = "multi_thread")]
async fn two_operators_end_with_one_winner_everywhere() {
    let fleet = Fleet::start(3).await;
    let versions =
        ["1.0.0", "2.0.0"].map(|v| fleet.package("worker", v, "service", "exec sleep 1000\n"));
    for package in &versions {
        fleet.server.operate(["push", package.to_str().expect("utf-8")]).await;
    }
    let mut ids = BTreeSet::new();
    for round in 0..50 {
        // Each operator's request is sent twice, as a client does that missed the answer.
        let order = async |operator: usize| {
            let key = format!("round-{round}-operator-{operator}");
            let package = versions[operator].to_str().expect("utf-8");
            let args =
                ["push", package, "--to", "*", "--yes", "-o", "json", "--idempotency-key", &key];
            let (first, again) =
                tokio::join!(fleet.server.operate(args), fleet.server.operate(args));
            let id = |text: &str| {
                let view: serde_json::Value = serde_json::from_str(text).expect("json");
                view["id"].as_str().expect("id").to_owned()
            };
            assert_eq!(id(&first), id(&again), "one key made two deployments");
            id(&first)
        };
        let (one, two) = tokio::join!(order(0), order(1));
        ids.extend([one, two]);
    }
    assert_eq!(ids.len(), 100);
    let listed = fleet.server.get("/api/v1/deployments").await.expect("list");
    assert_eq!(listed["deployments"].as_array().expect("array").len(), 100);

    eventually("the same version to run everywhere", async || {
        let mut running = BTreeSet::new();
        for robot in &fleet.robots {
            let view = fleet.server.robot(&robot.name).await?;
            let task = view.tasks.into_iter().find(|t| t.phase == Phase::Running)?;
            let active = task.active?;
            (active.deployment == task.deployment).then_some(())?;
            running.insert(task.deployment);
        }
        (running.len() == 1).then_some(())
    })
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn cancelled_update_leaves_the_old_version_running() {
    let dir = tempfile::tempdir().expect("temp dir");
    let server = Server::start(&dir.path().join("server")).await;
    let proxy = Proxy::start(server.http, 100_000_000).await;
    let url = format!("http://{}", proxy.address);
    let _robot = Robot::start_with(&server, dir.path(), "robot-1", 1, &url, &[]).await;
    let old = dir.path().join("old");
    write_package(&old, "worker", "1.0.0", "service", "exec sleep 1000\n");
    server.push(&old, "*").await;
    let before = server.wait_phase("robot-1", "worker", Phase::Running).await;

    let new = dir.path().join("new");
    write_package(&new, "worker", "2.0.0", "service", "exec sleep 1000\n");
    let ballast: Vec<u8> = (0..4_000_000).map(|_| rand::random()).collect();
    std::fs::write(new.join("ballast"), ballast).expect("ballast");
    proxy.set_rate(50_000);
    let update = server.push(&new, "*").await;
    server.wait_phase("robot-1", "worker", Phase::Fetching).await;
    let start = Instant::now();
    server.operate(["deploy", "cancel", update.id.as_str()]).await;
    let after = eventually("the old version to be the ordered one again", async || {
        let view = server.robot("robot-1").await?;
        (view.tasks == before.tasks && view.observed_generation == view.generation).then_some(view)
    })
    .await;
    assert!(start.elapsed() < Duration::from_secs(40), "it took {:?}", start.elapsed());
    assert_eq!(after.tasks[0].active, before.tasks[0].active);
    let cancelled = server.deployment(update.id.as_str()).await.expect("known");
    assert_eq!(cancelled.assignments.expect("assignments")[0].phase, Phase::Cancelled);
}
