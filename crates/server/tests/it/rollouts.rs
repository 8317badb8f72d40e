//! Batched rollouts among robots that come and go, told on every database.

use std::time::Duration;

use serde_json::json;
use task_proto::api::{DeploymentState, DeploymentView};
use task_proto::messages::report::Phase;
use taskd::domain::rollout::{LOST_AFTER_MS, OFFLINE_GRACE_MS};
use taskd::http::error::ApiError;
use tokio::time::timeout;

use crate::database::{TestDatabase, on_both_databases};
use crate::fleet::{Fleet, Robot};
use crate::harness::{TestServer, answer};

on_both_databases! {
    offline_robot_is_skipped_and_begins_when_it_is_back,
    remaining_offline_robots_expire,
    robot_offline_before_it_begins_holds_its_batch_for_a_minute,
    robot_lost_in_its_batch_counts_as_a_failure_until_it_is_back,
    robots_that_come_back_together_begin_in_batches,
    resume_of_an_unpaused_rollout_names_its_obstacle,
}

impl Fleet {
    async fn has_begun(&self, robot: &Robot) -> bool {
        self.desired(robot).await.is_ok_and(|state| !state.tasks.is_empty())
    }

    async fn advance(&self) {
        self.deployments.advance_rollouts().await.expect("moved on");
    }
}

async fn offline_robot_is_skipped_and_begins_when_it_is_back(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let mut robots = fleet.enroll(4).await;
    fleet.go_offline(&robots[0].id);
    fleet.go_offline(&robots[2].id);
    let id =
        fleet.deploy("1", |order| (order.batch, order.max_failures) = (Some(1), Some(0))).await;
    assert!(!fleet.has_begun(&robots[0]).await && fleet.has_begun(&robots[1]).await);
    fleet.follow(&mut robots[1], Phase::Running).await;
    assert!(!fleet.has_begun(&robots[2]).await && fleet.has_begun(&robots[3]).await);
    // One that comes back while another is busy waits for its turn.
    fleet.come_online(&robots[0].id);
    fleet.advance().await;
    assert!(!fleet.has_begun(&robots[0]).await);
    fleet.follow(&mut robots[3], Phase::Running).await;
    assert!(fleet.has_begun(&robots[0]).await);
    // Its report is still judged by the number of failures that the order tolerates.
    fleet.follow(&mut robots[0], Phase::Failed).await;
    fleet.come_online(&robots[2].id);
    fleet.advance().await;
    assert!(!fleet.has_begun(&robots[2]).await);
    assert_eq!(fleet.deployment(&id).await.state, DeploymentState::Paused);
    fleet.deployments.resume(&fleet.operator, &id).await.expect("resumed");
    fleet.follow(&mut robots[2], Phase::Running).await;
    assert_eq!(
        fleet.phases(&id).await,
        [Phase::Failed, Phase::Running, Phase::Running, Phase::Running]
    );
}

async fn remaining_offline_robots_expire(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let mut robots = fleet.enroll(2).await;
    fleet.go_offline(&robots[0].id);
    let id =
        fleet.deploy("1", |order| (order.batch, order.expires_in_s) = (Some(1), Some(60))).await;
    // Its time does not run while others have their turn.
    fleet.clock.advance_ms(59_999);
    fleet.actions.expire().await.expect("done");
    fleet.follow(&mut robots[1], Phase::Running).await;
    fleet.clock.advance_ms(59_999);
    fleet.advance().await;
    fleet.actions.expire().await.expect("done");
    assert_eq!(fleet.phases(&id).await, [Phase::Assigned, Phase::Running]);
    fleet.clock.advance_ms(1);
    fleet.actions.expire().await.expect("done");
    assert_eq!(fleet.phases(&id).await, [Phase::Expired, Phase::Running]);
    assert_eq!(fleet.deployment(&id).await.state, DeploymentState::Settled);
}

async fn robot_offline_before_it_begins_holds_its_batch_for_a_minute(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let mut robots = fleet.enroll(2).await;
    let id =
        fleet.deploy("1", |order| (order.batch, order.max_failures) = (Some(1), Some(0))).await;
    fleet.go_offline(&robots[0].id);
    fleet.clock.advance_ms(OFFLINE_GRACE_MS - 1);
    fleet.advance().await;
    assert!(!fleet.has_begun(&robots[1]).await);
    fleet.clock.advance_ms(1);
    fleet.advance().await;
    assert!(fleet.has_begun(&robots[1]).await);
    // The robot has begun, so it follows when it is back.
    fleet.come_online(&robots[0].id);
    for robot in &mut robots {
        fleet.follow(robot, Phase::Running).await;
    }
    assert_eq!(fleet.deployment(&id).await.state, DeploymentState::Settled);
}

async fn robot_lost_in_its_batch_counts_as_a_failure_until_it_is_back(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let mut robots = fleet.enroll(3).await;
    let id =
        fleet.deploy("1", |order| (order.batch, order.max_failures) = (Some(1), Some(0))).await;
    fleet.follow(&mut robots[0], Phase::Starting).await;
    fleet.go_offline(&robots[0].id);
    fleet.clock.advance_ms(LOST_AFTER_MS - 1);
    fleet.advance().await;
    assert_eq!(fleet.deployment(&id).await.state, DeploymentState::Active);
    assert!(!fleet.has_begun(&robots[1]).await);
    fleet.clock.advance_ms(1);
    fleet.advance().await;
    assert_eq!(fleet.deployment(&id).await.state, DeploymentState::Paused);
    fleet.deployments.resume(&fleet.operator, &id).await.expect("resumed");
    assert!(fleet.has_begun(&robots[1]).await);
    fleet.follow(&mut robots[1], Phase::Running).await;
    // The robot is back and goes on: the others wait for it again.
    fleet.come_online(&robots[0].id);
    for robot in [0, 2] {
        fleet.follow(&mut robots[robot], Phase::Running).await;
    }
    assert_eq!(fleet.deployment(&id).await.state, DeploymentState::Settled);
}

async fn robots_that_come_back_together_begin_in_batches(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let robots = fleet.enroll(75).await;
    robots.iter().for_each(|robot| fleet.go_offline(&robot.id));
    let id = fleet.deploy("1", |order| order.batch = Some(2)).await;
    robots.iter().skip(5).for_each(|robot| fleet.come_online(&robot.id));
    fleet.advance().await;
    fleet.advance().await;
    let begun: Vec<bool> = fleet
        .deployment(&id)
        .await
        .assignments
        .expect("there")
        .iter()
        .map(|one| one.released)
        .collect();
    assert_eq!(begun.iter().filter(|released| **released).count(), 2);
    assert!(
        fleet.has_begun(&robots[10]).await && fleet.has_begun(&robots[11]).await,
        "by name: 10 comes before 5"
    );
}

async fn resume_of_an_unpaused_rollout_names_its_obstacle(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let mut robots = fleet.enroll(4).await;
    fleet.go_offline(&robots[3].id);
    let id = fleet.deploy("1", |order| order.batch = Some(1)).await;
    let refused =
        async || fleet.deployments.resume(&fleet.operator, &id).await.expect_err("not paused");
    let (error, expected) = (
        refused().await.to_string(),
        format!("deployment {id} is not paused: waiting for r0; next: r1, r2; offline: r3"),
    );
    assert_eq!(error, expected);
    fleet.come_online(&robots[3].id);
    for robot in &mut robots {
        fleet.follow(robot, Phase::Running).await;
    }
    assert_eq!(ApiError::from(refused().await).code, "not_paused");
    assert!(refused().await.to_string().ends_with("settled on all robots"));
}

/// The running server looks at rollouts by itself where a robot comes online.
#[tokio::test(flavor = "multi_thread")]
async fn waiting_robot_begins_when_it_comes_online() {
    let server = TestServer::start().await;
    let robot = server.enroll("atlas").await;
    let package = server.push("talker", "1.0.0").await;
    let digest = &package.manifest.digest;
    let order = json!({ "package": "talker", "manifest": digest, "selector": "*", "batch": 1 });
    let ordered: DeploymentView =
        answer(server.order("/api/v1/deployments", "key-1", &order)).await;
    let has_begun =
        |view: &DeploymentView| view.assignments.iter().flatten().all(|one| one.released);
    assert!(!has_begun(&ordered), "it has not been heard yet");
    server.ask_desired(&robot).await;
    let path = format!("/api/v1/deployments/{}", ordered.id);
    let begins = async { while !has_begun(&server.get(&path).await) {} };
    timeout(Duration::from_secs(60), begins).await.expect("it begins");
    assert_eq!(server.desired(&robot).await.tasks.len(), 1);
}
