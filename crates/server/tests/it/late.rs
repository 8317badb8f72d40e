//! Orders that arrive too late, or for robots about which the database knows too little: nothing is
//! removed because of them, and nothing starts again that a user stopped.

use task_proto::Generation;
use task_proto::api::DeploymentState;
use task_proto::desired::TargetState;
use task_proto::messages::report::{Condition, Phase, Report};
use task_proto::packages::manifest::TaskKind;
use taskd::orders::actions::TaskOrder;

use crate::database::{TestDatabase, on_both_databases};
use crate::fleet::{Fleet, Robot, package, random_key};
use crate::story::code;

on_both_databases! {
    expired_restart_leaves_the_running_task,
    stopped_task_stays_stopped_after_a_cancel,
    silent_robot_delays_only_its_own_batch,
    batch_waits_for_no_robot_that_ran_it_or_was_revoked,
    cancel_of_a_settled_deployment_is_refused,
    order_adopts_only_diverged_robots_in_the_scope,
    adopted_task_gives_no_access_to_an_unstored_package,
    rollback_to_an_adopted_task_works,
    order_for_a_diverged_robot_expires,
    other_state_of_the_same_generation_is_diverged,
}

/// An order for a task that has run, if it does not reach its robot in time, removes nothing from
/// the robot.
async fn expired_restart_leaves_the_running_task(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let mut robots = fleet.enroll(2).await;
    let (task, everyone) = ("talker".parse().expect("valid"), "*".parse().expect("valid"));
    let order = async |order| {
        fleet
            .deployments
            .order_task(&fleet.operator, &random_key(), order, &task, &everyone)
            .await
            .expect("ordered");
    };
    fleet.deploy("1", |order| order.selector = "r0".parse().expect("valid")).await;
    fleet.follow(&mut robots[0], Phase::Running).await;
    let new = fleet.deploy("2", |_| ()).await;
    for robot in &mut robots {
        fleet.follow(robot, Phase::Running).await;
    }
    for (late, wanted, phase) in [
        (TaskOrder::Restart, TargetState::Running, Phase::Running),
        (TaskOrder::Stop, TargetState::Stopped, Phase::Stopped),
        (TaskOrder::Start, TargetState::Stopped, Phase::Stopped),
    ] {
        order(late).await;
        if late == TaskOrder::Stop {
            for robot in &mut robots {
                fleet.follow(robot, Phase::Stopped).await;
            }
        }
        fleet.clock.advance_ms(8 * 24 * 3_600_000);
        fleet.actions.expire().await.expect("done");
        for robot in &robots {
            let desired = fleet.desired(robot).await.expect("state").tasks.remove(0);
            assert_eq!(
                (desired.deployment, desired.wanted, desired.run),
                (new.clone(), wanted, 1),
                "{late:?}"
            );
        }
        assert_eq!(fleet.phases(&new).await, [phase; 2], "{late:?}");
    }
    // Cancelling the order does not remove a task that was only told to restart either.
    order(TaskOrder::Restart).await;
    fleet.deployments.cancel(&fleet.operator, &new).await.expect("cancelled");
    for robot in &robots {
        assert_eq!(fleet.desired(robot).await.expect("state").tasks[0].deployment, new);
    }
    // The robot may have begun one of those runs without reporting that: it would take the next run
    // for the same one, and not start it. A robot that received a restart, and did not perform it,
    // does not perform it later.
    order(TaskOrder::Restart).await;
    assert_eq!(
        fleet.desired(&robots[0]).await.expect("state").tasks[0].run,
        5,
        "2, 3 and 4 were taken back"
    );
    fleet.follow(&mut robots[0], Phase::Staged).await;
    fleet.clock.advance_ms(8 * 24 * 3_600_000);
    fleet.actions.expire().await.expect("done");
    let desired = fleet.desired(&robots[0]).await.expect("state").tasks.remove(0);
    assert_eq!((desired.deployment, desired.wanted), (new, TargetState::Stopped));
}

async fn stopped_task_stays_stopped_after_a_cancel(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let mut robots = fleet.enroll(2).await;
    let order = async |order| {
        let (task, of) = ("talker".parse().expect("valid"), "r1".parse().expect("valid"));
        fleet
            .deployments
            .order_task(&fleet.operator, &random_key(), order, &task, &of)
            .await
            .expect("ordered");
    };
    let old = fleet.deploy("1", |_| ()).await;
    for robot in &mut robots {
        fleet.follow(robot, Phase::Running).await;
    }
    // Though a later batch would have brought another version of it.
    fleet.deploy("2", |order| order.batch = Some(1)).await;
    order(TaskOrder::Stop).await;
    fleet.follow(&mut robots[0], Phase::Running).await;
    let desired = fleet.desired(&robots[1]).await.expect("state").tasks.remove(0);
    assert_eq!((desired.deployment, desired.wanted), (old.clone(), TargetState::Stopped));
    // Although the deployment that stopped it is reverted.
    order(TaskOrder::Start).await;
    fleet.follow(&mut robots[1], Phase::Running).await;
    fleet.deploy("3", |order| order.selector = "r1".parse().expect("valid")).await;
    order(TaskOrder::Stop).await;
    fleet.clock.advance_ms(8 * 24 * 3_600_000);
    fleet.actions.expire().await.expect("done");
    let desired = fleet.desired(&robots[1]).await.expect("state").tasks.remove(0);
    assert_eq!((desired.deployment, desired.wanted), (old, TargetState::Stopped));
}

async fn silent_robot_delays_only_its_own_batch(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let mut robots = fleet.enroll(3).await;
    let id =
        fleet.deploy("1", |order| (order.batch, order.expires_in_s) = (Some(1), Some(60))).await;
    fleet.clock.advance_ms(60_000);
    fleet.actions.expire().await.expect("done");
    assert_eq!(fleet.phases(&id).await, [Phase::Expired, Phase::Assigned, Phase::Assigned]);
    // The second batch has as much time as the first.
    fleet.clock.advance_ms(59_999);
    fleet.actions.expire().await.expect("done");
    fleet.follow(&mut robots[1], Phase::Running).await;
    assert_eq!(fleet.desired(&robots[2]).await.expect("state").tasks[0].deployment, id);
}

async fn batch_waits_for_no_robot_that_ran_it_or_was_revoked(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let mut robots = fleet.enroll(5).await;
    let first = fleet.deploy("1", |order| order.batch = Some(1)).await;
    fleet.follow(&mut robots[0], Phase::Running).await;
    // The first robot's earlier version is desired again, and the robot never reports it.
    let other = fleet.deploy("2", |order| order.selector = "r0".parse().expect("valid")).await;
    fleet.deployments.cancel(&fleet.operator, &other).await.expect("cancelled");
    assert_eq!(fleet.phases(&first).await[0], Phase::Assigned);
    let has_it =
        async |robot: &Robot| fleet.desired(robot).await.is_ok_and(|state| !state.tasks.is_empty());
    assert!(has_it(&robots[1]).await && !has_it(&robots[2]).await);
    fleet.follow(&mut robots[1], Phase::Running).await;
    assert!(has_it(&robots[2]).await);
    // The next robot does not either, nor does it get anything if it is revoked before its turn.
    fleet.robots.revoke(&fleet.operator, &robots[3].id).await.expect("revoked");
    assert!(!has_it(&robots[4]).await);
    fleet.robots.revoke(&fleet.operator, &robots[2].id).await.expect("revoked");
    assert!(has_it(&robots[4]).await);
}

async fn cancel_of_a_settled_deployment_is_refused(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let mut robots = fleet.enroll(2).await;
    let id = fleet.deploy("1", |_| ()).await;
    for robot in &mut robots {
        fleet.follow(robot, Phase::Running).await;
    }
    let before = fleet.deployment(&id).await;
    let refused = fleet.deployments.cancel(&fleet.operator, &id).await;
    assert_eq!(code(refused), "nothing_to_cancel");
    assert_eq!(fleet.deployment(&id).await, before);
    assert_eq!(before.state, DeploymentState::Settled);
    // Nor is an assignment that later ones have replaced, and that has settled since.
    let newer = fleet.deploy("2", |_| ()).await;
    fleet.follow(&mut robots[0], Phase::Running).await;
    fleet.follow(&mut robots[1], Phase::Running).await;
    assert_eq!(code(fleet.deployments.cancel(&fleet.operator, &id).await), "nothing_to_cancel");
    // Where the deployment failed, the previous version comes back.
    let broken = fleet.deploy("3", |_| ()).await;
    fleet.follow(&mut robots[0], Phase::Running).await;
    fleet.follow(&mut robots[1], Phase::Failed).await;
    fleet.deployments.cancel(&fleet.operator, &broken).await.expect("one has failed");
    assert_eq!(fleet.desired(&robots[1]).await.expect("state").tasks[0].deployment, newer);
}

/// A fleet of robots that run version 1 from orders that the database has never seen.
async fn restored(database: TestDatabase, count: u32) -> (Fleet, Vec<Robot>) {
    let fleet = Fleet::new(database).await;
    let mut robots = fleet.enroll(count).await;
    let before = Fleet::new(crate::database::sqlite().await).await;
    let elsewhere = before.enroll(1).await;
    before.deploy("1", |_| ()).await;
    let lost = before.desired(&elsewhere[0]).await.expect("state");
    for robot in &mut robots {
        robot.accept(&lost, Phase::Running);
        fleet.report(robot).await;
    }
    (fleet, robots)
}

async fn order_adopts_only_diverged_robots_in_the_scope(database: TestDatabase) {
    let (fleet, robots) = restored(database, 2).await;
    let alice = fleet.limited("alice", "r0").await;
    let (task, everyone) = ("talker".parse().expect("valid"), "*".parse().expect("valid"));
    let meant = fleet
        .deployments
        .order_task(&alice, &random_key(), TaskOrder::Stop, &task, &everyone)
        .await;
    assert_eq!(meant.expect("ordered").len(), 1);
    assert_eq!(fleet.view(&robots[0]).await.generation, Generation(2));
    assert_eq!(fleet.view(&robots[1]).await.generation, Generation(0));
    assert_eq!(code(fleet.desired(&robots[1]).await), "diverged");
}

async fn adopted_task_gives_no_access_to_an_unstored_package(database: TestDatabase) {
    let (fleet, robots) = restored(database, 1).await;
    let (task, everyone) = ("talker".parse().expect("valid"), "*".parse().expect("valid"));
    fleet
        .deployments
        .order_task(&fleet.operator, &random_key(), TaskOrder::Stop, &task, &everyone)
        .await
        .expect("ordered");
    let named = package("1", TaskKind::Service).package;
    assert_eq!(fleet.desired(&robots[0]).await.expect("state").tasks[0].package, named);
    let may = async || {
        let order = fleet
            .database
            .store
            .robots()
            .fetch_grant(&robots[0].id, &named.content.digest)
            .await
            .expect("reads");
        order.is_some()
    };
    assert!(!may().await, "it may have made it up");
    fleet.publish("1").await;
    assert!(may().await);
}

async fn rollback_to_an_adopted_task_works(database: TestDatabase) {
    let (fleet, mut robots) = restored(database, 1).await;
    for version in ["1", "2"] {
        fleet.publish(version).await;
    }
    let two = fleet.deploy("2", |_| ()).await;
    fleet.follow(&mut robots[0], Phase::Failed).await;
    assert_eq!(fleet.phases(&two).await, [Phase::Failed]);
    let (task, everyone) = ("talker".parse().expect("valid"), "*".parse().expect("valid"));
    let back = fleet
        .deployments
        .rollback(&fleet.operator, &random_key(), &task, &everyone)
        .await
        .expect("there is one");
    assert_eq!(back.robots.len(), 1);
    assert_eq!(fleet.version(&robots[0]).await, "1");
}

async fn order_for_a_diverged_robot_expires(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let mut robots = fleet.enroll(1).await;
    let id = fleet.deploy("1", |_| ()).await;
    robots[0].observed = Generation(1 << 40);
    fleet.report(&mut robots[0]).await;
    fleet.clock.advance_ms(8 * 24 * 3_600_000);
    fleet.actions.expire().await.expect("done");
    assert_eq!(fleet.phases(&id).await, [Phase::Expired]);
    let view = fleet.view(&robots[0]).await;
    assert_eq!((view.generation, view.conditions[0].code.as_str()), (Generation(1), "diverged"));
}

async fn other_state_of_the_same_generation_is_diverged(database: TestDatabase) {
    let (fleet, mut robots) = restored(database, 1).await;
    // As if the robot had not reported yet. One order was lost, and one is made before the report.
    let robot = &mut robots[0];
    (robot.start, robot.observed) = (2, Generation(0));
    let tasks = std::mem::take(&mut robot.tasks);
    fleet.report(robot).await;
    let late = fleet.deploy("2", |_| ()).await;
    (robot.tasks, robot.observed) = (tasks, Generation(1));
    fleet.report(robot).await;
    assert_eq!(fleet.version(robot).await, "2");
    let contradicted = Condition {
        code: Report::STATE_CONTRADICTED.to_owned(),
        text: "it is not the same".to_owned(),
    };
    let report = Report { conditions: vec![contradicted], ..robot.next_report() };
    fleet.writer.submit(report, 0).await.expect("stored");
    let view = fleet.view(robot).await;
    assert_eq!((view.generation, view.conditions[0].code.as_str()), (Generation(1), "diverged"));
    assert_eq!(code(fleet.desired(robot).await), "diverged");
    // The next order starts from the robot's current version.
    let (task, everyone) = ("talker".parse().expect("valid"), "*".parse().expect("valid"));
    fleet
        .deployments
        .order_task(&fleet.operator, &random_key(), TaskOrder::Stop, &task, &everyone)
        .await
        .expect("ordered");
    let desired = fleet.desired(robot).await.expect("not withheld any more");
    assert_eq!(
        (desired.generation, desired.tasks[0].wanted),
        (Generation(3), TargetState::Stopped)
    );
    assert_eq!(desired.tasks[0].package.version.as_str(), "1");
    assert_eq!(fleet.phases(&late).await, [Phase::Stopped]);
}
