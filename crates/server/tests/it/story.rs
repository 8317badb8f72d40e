//! One story of robots, orders and reports, told on every database, and by two servers in turns.

use std::collections::BTreeSet;
use std::slice;
use std::sync::Arc;

use task_proto::Generation;
use task_proto::api::{CreateEnrollmentToken, DeploymentState, EditRobot};
use task_proto::desired::TargetState;
use task_proto::messages::report::Phase;
use task_proto::packages::manifest::TaskKind;
use taskd::http::error::ApiError;
use taskd::orders::actions::{Actions, TaskOrder};
use taskd::orders::report_writer::ReportError;
use taskd::store::Store;

use crate::database::{TestDatabase, on_all_databases, on_both_databases};
use crate::fleet::{Fleet, Robot, STATE_LIFETIME_MS, mac, order_of, package, random_key};

on_all_databases! {
    removed_robot_frees_its_mac_and_name,
    state_is_signed_again_after_half_its_lifetime,
    order_reaches_all_matching_robots_and_settles,
    order_with_an_unknown_robot_name_is_refused,
    idempotency_key_orders_once,
    racing_operators_leave_one_winner,
    newer_deployment_supersedes_and_its_cancel_restores,
    cancel_restores_no_cancelled_deployment,
    cancel_restores_no_deleted_package,
    polling_robots_get_no_notice,
    batches_follow_each_other_and_failures_pause,
    unfinished_assignment_expires,
    tasks_are_stopped_started_and_removed,
    late_reports_change_nothing,
    reports_at_once_are_all_acknowledged,
    unstored_report_gets_an_error,
    robots_ahead_of_a_restored_database_are_left_alone,
    numbers_at_the_end_of_their_range_stop_no_order,
    reopened_database_keeps_all_state,
}

/// The code by which the API refuses the order.
pub fn code<T, E: Into<ApiError>>(result: Result<T, E>) -> &'static str {
    refusal(result).code
}

/// The API's answer to a refused order.
pub fn refusal<T, E: Into<ApiError>>(result: Result<T, E>) -> ApiError {
    result.err().expect("refused").into()
}

async fn removed_robot_frees_its_mac_and_name(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let token = fleet.enrollment_token(CreateEnrollmentToken::default()).await;
    let old = fleet.try_enroll(&token, mac(1), Some("atlas")).await.expect("enrolls");
    let mut robot = Robot::new(old.robot_id.clone());
    let deployment = fleet.deploy("1", |_| ()).await;
    fleet.robots.remove(&fleet.operator, &old.robot_id).await.expect("removed");
    assert_eq!(fleet.phases(&deployment).await, [Phase::Cancelled]);
    assert_eq!(code(fleet.robots.remove(&fleet.operator, &old.robot_id).await), "not_found");
    assert_eq!(code(fleet.desired_states.get(&old.robot_id).await), "not_found");
    let report = fleet.writer.submit(robot.next_report(), 0).await;
    assert!(matches!(report, Err(ReportError::RobotNotFound(_))));
    let now_ms = fleet.clock.now_ms();
    assert_eq!(
        fleet.database.store.tokens().holder(&old.token, now_ms).await.expect("reads"),
        None
    );
    let new = fleet.try_enroll(&token, mac(1), Some("atlas")).await.expect("both are free");
    assert_ne!(new.robot_id, old.robot_id);
    // A name that a selector could take for another robot's id is refused.
    let edit = EditRobot {
        name: Some(old.robot_id.as_str().parse().expect("a name")),
        ..EditRobot::default()
    };
    assert_eq!(
        code(fleet.robots.edit(&fleet.operator, &new.robot_id, &edit).await),
        "invalid_request"
    );
}

async fn state_is_signed_again_after_half_its_lifetime(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let robot = fleet.enroll(1).await.remove(0);
    let signed = async || {
        let states = fleet.desired_states.get_many(slice::from_ref(&robot.id)).await;
        let (_, many) = states.expect("reads").remove(0);
        let one = fleet.desired_states.get(&robot.id).await.expect("signed");
        assert_eq!(one, many, "the cache serves both");
        one.envelope
    };
    let first = signed().await;
    fleet.clock.advance_ms(STATE_LIFETIME_MS / 2);
    assert_eq!(signed().await, first);
    fleet.clock.advance_ms(1);
    let second = signed().await;
    assert_ne!(second, first, "half of the lifetime is over");
    fleet.deploy("1", |_| ()).await;
    assert_ne!(signed().await, second, "the state has changed");
}

async fn order_reaches_all_matching_robots_and_settles(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let mut robots = fleet.enroll(3).await;
    let nobody = order_of(&package("1", TaskKind::Service));
    let nobody = task_proto::api::CreateDeployment {
        selector: "site=mars".parse().expect("valid"),
        ..nobody
    };
    let refused = fleet
        .deployments
        .create(&fleet.operator, &random_key(), &nobody, &package("1", TaskKind::Service))
        .await;
    assert_eq!(code(refused), "no_robots_match");
    let id = fleet.deploy("1", |order| order.selector = "r0,r2".parse().expect("valid")).await;
    let rung: BTreeSet<_> = [robots[0].id.clone(), robots[2].id.clone()].into();
    assert_eq!(fleet.changes.take_robots_to_notify().await.robots, rung);
    assert_eq!(fleet.phases(&id).await, [Phase::Assigned, Phase::Assigned]);
    assert_eq!(fleet.deployment(&id).await.state, DeploymentState::Active);
    assert!(fleet.desired(&robots[1]).await.expect("state").tasks.is_empty());
    let content = package("1", TaskKind::Service).package.content.digest;
    let store = fleet.database.store.clone();

    assert!(store.robots().fetch_grant(&robots[0].id, &content).await.expect("reads").is_some());
    assert_eq!(store.robots().fetch_grant(&robots[1].id, &content).await.expect("reads"), None);
    for robot in [0, 2] {
        fleet.follow(&mut robots[robot], Phase::Running).await;
    }
    let view = fleet.deployment(&id).await;
    assert_eq!(view.state, DeploymentState::Settled);
    assert_eq!(view.counts, [task_proto::api::PhaseCount { phase: Phase::Running, count: 2 }]);
    let robot = fleet.view(&robots[0]).await;
    assert_eq!((robot.generation, robot.observed_generation), (Generation(1), Generation(1)));
    assert_eq!((robot.tasks[0].phase, robot.tasks[0].run), (Phase::Running, 1));
    assert_eq!(store.deployments().packages_in_use().await.expect("reads").len(), 1);
    assert_eq!(fleet.deployments().await.len(), 1);
}

async fn order_with_an_unknown_robot_name_is_refused(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let robots = fleet.enroll(2).await;
    let (by, task) = (&fleet.operator, "talker".parse().expect("a name"));
    let (deployments, robot_actions) = (&fleet.deployments, &fleet.robots);
    let view = package("1", TaskKind::Service);
    let (key, named) = (random_key(), "r0,r1".parse().expect("valid"));
    let order = task_proto::api::CreateDeployment { selector: named, ..order_of(&view) };
    let id = deployments.create(by, &key, &order, &view).await.expect("ordered");
    robot_actions.remove(by, &robots[1].id).await.expect("removed");
    let again = deployments.create(by, &key, &order, &view).await;
    assert_eq!(again.expect("the same order as before"), id);
    for (text, unknown) in
        [("r0,r1,r7", "r1, r7"), ("!r7", "r7"), ("*&r7,r0", "r7"), (robots[1].id.as_str(), "")]
    {
        let selector: task_proto::ids::selector::Selector = text.parse().expect("valid");
        let order =
            task_proto::api::CreateDeployment { selector: selector.clone(), ..order_of(&view) };
        let retry = task_proto::api::RetryDeployment {
            selector: Some(selector.clone()),
            ..Default::default()
        };
        let labels = task_proto::api::BulkLabels {
            selector: selector.clone(),
            set: [("site".parse().expect("valid"), "lab".parse().expect("valid"))].into(),
            remove: Vec::new(),
            dry_run: false,
        };
        let (key, stop) = (random_key(), TaskOrder::Stop);
        let refusals = [
            refusal(deployments.create(by, &key, &order, &view).await),
            refusal(deployments.preview(by, &selector).await),
            refusal(deployments.order_task(by, &key, stop, &task, &selector).await),
            refusal(deployments.preview_task_order(by, &task, &selector).await),
            refusal(deployments.rollback(by, &key, &task, &selector).await),
            refusal(deployments.preview_rollback(by, &task, &selector).await),
            refusal(deployments.preview_retry(by, &id, &retry).await),
            refusal(robot_actions.label_selected(by, None, &labels).await),
            refusal(robot_actions.remove_selected(by, None, &selector).await),
            refusal(robot_actions.preview_removal(by, &selector).await),
        ];
        for refusal in refusals {
            assert_eq!(refusal.code, "unknown_robots", "{text}");
            let message = refusal.message;
            assert!(message.contains(&format!("name or id {unknown}")), "{message}");
        }
    }
    // Where the name is known, and nothing else is wrong, nothing has changed.
    assert_eq!(fleet.view(&robots[0]).await.generation, Generation(1));
}

async fn idempotency_key_orders_once(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    fleet.enroll(1).await;
    let (key, package) = (random_key(), package("1", TaskKind::Service));
    let order = order_of(&package);
    let first =
        fleet.deployments.create(&fleet.operator, &key, &order, &package).await.expect("ordered");
    let again =
        fleet.deployments.create(&fleet.operator, &key, &order, &package).await.expect("the same");
    assert_eq!(first, again);
    let other = task_proto::api::CreateDeployment { batch: Some(1), ..order };
    let refused = fleet.deployments.create(&fleet.operator, &key, &other, &package).await;
    assert_eq!(code(refused), "idempotency_key_reused");
    let before = fleet
        .deployments
        .repeated(&fleet.operator, &key, &order_of(&package))
        .await
        .expect("reads");
    assert_eq!(before, Some(first));
    let never = fleet
        .deployments
        .repeated(&fleet.operator, &random_key(), &order_of(&package))
        .await
        .expect("reads");
    assert_eq!(never, None);
    let (task, everyone) = ("talker".parse().expect("valid"), "*".parse().expect("valid"));
    let refused = fleet
        .deployments
        .order_task(&fleet.operator, &key, TaskOrder::Stop, &task, &everyone)
        .await;
    assert_eq!(code(refused), "idempotency_key_reused");
    assert_eq!(fleet.deployments().await.len(), 1);
}

async fn racing_operators_leave_one_winner(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let robots = fleet.enroll(5).await;
    // A second server process on the same database would be as good a rival as a second operator.
    let rival = Store::open(&fleet.database.url).await.expect("opens");
    let key = Arc::new(task_proto::trust::envelope::SigningKey::random());
    let rival = Actions::new(
        rival,
        fleet.clock.clone(),
        fleet.changes.clone(),
        key,
        Default::default(),
        fleet.planner.clone(),
    );
    let mut orders = tokio::task::JoinSet::new();
    for round in 0..50u32 {
        let (keys, versions) =
            ([random_key(), random_key()], [format!("1.{round}"), format!("2.{round}")]);
        for retry in 0..2 {
            for (key, version) in keys.iter().zip(&versions) {
                let actions = if retry == 0 { fleet.actions.clone() } else { rival.clone() };
                let (key, package) = (key.clone(), package(version, TaskKind::Service));
                let operator = fleet.operator.clone();
                orders.spawn(async move {
                    let id = actions
                        .deployments
                        .create(&operator, &key, &order_of(&package), &package)
                        .await
                        .expect("ordered");
                    (key.to_string(), id)
                });
            }
        }
    }
    let answers: BTreeSet<_> = orders.join_all().await.into_iter().collect();
    let deployments: BTreeSet<_> = answers.iter().map(|(_, id)| id).collect();
    assert_eq!((answers.len(), deployments.len()), (100, 100));
    let mut winners = BTreeSet::new();
    for robot in &robots {
        let desired = fleet.desired(robot).await.expect("state");
        assert_eq!((desired.generation, desired.tasks.len()), (Generation(100), 1));
        winners.insert(desired.tasks[0].deployment.clone());
    }
    assert_eq!(winners.len(), 1);
    let newest = fleet.deployments().await.remove(0);
    assert_eq!(Some(&newest.id), winners.first());
    assert_eq!(newest.supersedes.len(), 1);
}

async fn newer_deployment_supersedes_and_its_cancel_restores(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let mut robots = fleet.enroll(2).await;
    let old = fleet.deploy("1", |_| ()).await;
    for robot in &mut robots {
        fleet.follow(robot, Phase::Running).await;
    }
    let new = fleet.deploy("2", |order| order.selector = "r0".parse().expect("valid")).await;
    assert_eq!(fleet.deployment(&new).await.supersedes, std::slice::from_ref(&old));
    assert_eq!(fleet.phases(&old).await, [Phase::Superseded, Phase::Running]);
    let superseded_by =
        fleet.deployment(&old).await.assignments.expect("there").remove(0).superseded_by;
    assert_eq!(superseded_by, Some(new.clone()));
    fleet.follow(&mut robots[0], Phase::Fetching).await;
    fleet.changes.take_robots_to_notify().await;
    fleet.deployments.cancel(&fleet.operator, &new).await.expect("cancelled");
    fleet.deployments.cancel(&fleet.operator, &new).await.expect("again is harmless");
    assert_eq!(fleet.changes.take_robots_to_notify().await.robots, [robots[0].id.clone()].into());
    assert_eq!(fleet.deployment(&new).await.state, DeploymentState::Cancelled);
    assert_eq!(fleet.phases(&new).await, [Phase::Cancelled]);
    let desired = fleet.desired(&robots[0]).await.expect("state");
    assert_eq!((&desired.tasks[0].deployment, desired.tasks[0].run), (&old, 1));
    // The robot's report on the cancelled deployment is late; its report on the old one counts.
    fleet.report(&mut robots[0]).await;
    assert_eq!(fleet.phases(&new).await, [Phase::Cancelled]);
    fleet.follow(&mut robots[0], Phase::Running).await;
    assert_eq!(fleet.phases(&old).await, [Phase::Running, Phase::Running]);
    assert!(fleet.deployment(&new).await.supersedes.is_empty());
    // A service that runs has settled: there is nothing to interrupt.
    assert_eq!(code(fleet.deployments.cancel(&fleet.operator, &old).await), "nothing_to_cancel");
    assert_eq!(fleet.phases(&old).await, [Phase::Running, Phase::Running]);
    assert_eq!(fleet.desired(&robots[1]).await.expect("state").tasks[0].deployment, old);
    let third = fleet.deploy("3", |_| ()).await;
    fleet.deployments.cancel(&fleet.operator, &third).await.expect("cancelled");
    assert_eq!(fleet.desired(&robots[1]).await.expect("state").tasks[0].deployment, old);
    let unknown = task_proto::DeploymentId::random();
    assert_eq!(code(fleet.deployments.cancel(&fleet.operator, &unknown).await), "not_found");
    assert_eq!(
        code(fleet.deployments.resume(&fleet.operator, &third).await),
        "deployment_cancelled"
    );
}

async fn cancel_restores_no_cancelled_deployment(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let robots = fleet.enroll(1).await;
    fleet.publish("1").await;
    let one = fleet.deploy("1", |_| ()).await;
    let two = fleet.deploy("2", |_| ()).await;
    let three = fleet.deploy("3", |_| ()).await;
    fleet.deployments.cancel(&fleet.operator, &two).await.expect("cancelled");
    assert_eq!(fleet.desired(&robots[0]).await.expect("state").tasks[0].deployment, three);
    fleet.deployments.cancel(&fleet.operator, &three).await.expect("cancelled");
    assert_eq!(fleet.desired(&robots[0]).await.expect("state").tasks[0].deployment, one);
    // Without anything to put back, the task goes.
    fleet.deployments.cancel(&fleet.operator, &one).await.expect("cancelled");
    assert!(fleet.desired(&robots[0]).await.expect("state").tasks.is_empty());
}

async fn cancel_restores_no_deleted_package(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let robots = fleet.enroll(2).await;
    let mut orders = [Vec::new(), Vec::new()];
    for version in ["1", "2", "3", "4", "5"] {
        fleet.publish(version).await;
        for (name, orders) in ["r0", "r1"].into_iter().zip(&mut orders) {
            let id =
                fleet.deploy(version, |order| order.selector = name.parse().expect("valid")).await;
            orders.push(id);
        }
    }
    for version in ["2", "3"] {
        fleet.unpublish(version).await;
    }
    // Their bytes may be gone: no robot should have them, and none would get them by one cancel.
    for (robot, [first, second]) in [(0, [4, 3]), (1, [3, 4])] {
        let orders = &orders[robot];
        fleet.deployments.cancel(&fleet.operator, &orders[first]).await.expect("cancelled");
        let left = fleet.desired(&robots[robot]).await.expect("state").tasks;
        assert_eq!(left[0].deployment, orders[second]);
        fleet.deployments.cancel(&fleet.operator, &orders[second]).await.expect("cancelled");
        let left = fleet.desired(&robots[robot]).await.expect("state").tasks;
        assert_eq!(left[0].deployment, orders[0]);
    }
    // A replaced version is kept for a later revert, even if the version is deleted.
    let next = fleet.deploy("4", |_| ()).await;
    fleet.unpublish("1").await;
    fleet.deployments.cancel(&fleet.operator, &next).await.expect("cancelled");
    assert_eq!(fleet.desired(&robots[0]).await.expect("state").tasks[0].deployment, orders[0][0]);
}

async fn polling_robots_get_no_notice(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let robots = fleet.enroll(2).await;
    let poll = fleet.deploy("1", |order| {
        order.selector = "r0".parse().expect("valid");
        order.delivery = task_proto::api::DeliveryChoice::Poll;
    });
    let poll = poll.await;
    fleet.deploy("2", |order| order.selector = "r1".parse().expect("valid")).await;
    assert_eq!(fleet.changes.take_robots_to_notify().await.robots, [robots[1].id.clone()].into());
    assert_eq!(fleet.desired(&robots[0]).await.expect("state").tasks[0].deployment, poll);
}

async fn batches_follow_each_other_and_failures_pause(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let mut robots = fleet.enroll(6).await;
    let id = fleet
        .deploy("1", |order| {
            order.batch = Some(2);
            order.max_failures = Some(1);
        })
        .await;
    let released = async || {
        let assignments = fleet.deployment(&id).await.assignments.expect("there");
        assignments.iter().filter(|assignment| assignment.released).count()
    };
    assert_eq!(fleet.changes.take_robots_to_notify().await.robots.len(), 2);
    assert_eq!(released().await, 2);
    fleet.follow(&mut robots[0], Phase::Running).await;
    assert_eq!(released().await, 2);
    fleet.follow(&mut robots[1], Phase::Failed).await;
    assert_eq!(released().await, 4);
    assert_eq!(
        fleet.changes.take_robots_to_notify().await.robots,
        [robots[2].id.clone(), robots[3].id.clone()].into()
    );
    fleet.follow(&mut robots[2], Phase::Failed).await;
    assert_eq!(fleet.deployment(&id).await.state, DeploymentState::Paused);
    fleet.follow(&mut robots[3], Phase::Running).await;
    assert_eq!(released().await, 4);
    fleet.deployments.resume(&fleet.operator, &id).await.expect("resumed");
    assert_eq!(released().await, 6);
    fleet.follow(&mut robots[4], Phase::Running).await;
    // A removed robot is not waited for.
    fleet.robots.remove(&fleet.operator, &robots[5].id).await.expect("removed");
    assert_eq!(fleet.deployment(&id).await.state, DeploymentState::Settled);

    // A newer order also replaces assignments that still wait for their batch.
    let slow = fleet.deploy("2", |order| order.batch = Some(1)).await;
    let fast = fleet.deploy("3", |_| ()).await;
    assert!(fleet.phases(&slow).await.iter().all(|phase| *phase == Phase::Superseded));
    let desired = fleet.desired(&robots[4]).await.expect("state");
    assert_eq!(desired.tasks[0].deployment, fast);
}

async fn unfinished_assignment_expires(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let mut robots = fleet.enroll(2).await;
    let old = fleet.deploy("1", |_| ()).await;
    for robot in &mut robots {
        fleet.follow(robot, Phase::Running).await;
    }
    let new = fleet.deploy("2", |order| order.expires_in_s = Some(60)).await;
    fleet.follow(&mut robots[0], Phase::Running).await;
    fleet.clock.advance_ms(59_999);
    fleet.actions.expire().await.expect("done");
    assert_eq!(fleet.phases(&new).await, [Phase::Running, Phase::Assigned]);
    fleet.clock.advance_ms(1);
    fleet.actions.expire().await.expect("done");
    assert_eq!(fleet.phases(&new).await, [Phase::Running, Phase::Expired]);
    assert_eq!(fleet.desired(&robots[1]).await.expect("state").tasks[0].deployment, old);
    assert_eq!(fleet.deployment(&new).await.state, DeploymentState::Settled);
    // Seven days by default; versions that have run stay.
    fleet.clock.advance_ms(8 * 24 * 3_600_000);
    fleet.actions.expire().await.expect("done");
    assert_eq!(fleet.phases(&new).await, [Phase::Running, Phase::Expired]);
}

async fn tasks_are_stopped_started_and_removed(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let mut robots = fleet.enroll(2).await;
    let id = fleet.deploy("1", |order| order.selector = "r0".parse().expect("valid")).await;
    let (task, everyone) = ("talker".parse().expect("valid"), "*".parse().expect("valid"));
    let order = async |order| {
        fleet
            .deployments
            .order_task(&fleet.operator, &random_key(), order, &task, &everyone)
            .await
            .expect("ordered")
    };
    fleet.follow(&mut robots[0], Phase::Running).await;

    // Starting a running task changes nothing; robots without the task are left out.
    let meant = order(TaskOrder::Start).await;
    assert_eq!(meant.iter().map(|robot| robot.name.as_str()).collect::<Vec<_>>(), ["r0"]);
    assert_eq!(fleet.view(&robots[0]).await.generation, Generation(1));

    order(TaskOrder::Stop).await;
    assert_eq!(
        fleet.desired(&robots[0]).await.expect("state").tasks[0].wanted,
        TargetState::Stopped
    );
    assert_eq!(fleet.phases(&id).await, [Phase::Running]);
    fleet.follow(&mut robots[0], Phase::Stopped).await;
    assert_eq!(fleet.phases(&id).await, [Phase::Stopped]);

    order(TaskOrder::Start).await;
    let desired = fleet.desired(&robots[0]).await.expect("state").tasks.remove(0);
    assert_eq!((desired.wanted, desired.run), (TargetState::Running, 2));
    assert_eq!(fleet.phases(&id).await, [Phase::Assigned]);
    // The stop of the first run is no word on the second.
    fleet.report(&mut robots[0]).await;
    assert_eq!(fleet.phases(&id).await, [Phase::Assigned]);
    fleet.follow(&mut robots[0], Phase::Running).await;
    assert_eq!(fleet.phases(&id).await, [Phase::Running]);

    order(TaskOrder::Remove).await;
    assert!(fleet.desired(&robots[0]).await.expect("state").tasks.is_empty());
    // The task is shown until the robot reports that the task is gone.
    fleet.report(&mut robots[0]).await;
    assert_eq!(fleet.view(&robots[0]).await.tasks.len(), 1);
    fleet.follow(&mut robots[0], Phase::Running).await;
    assert_eq!(fleet.phases(&id).await, [Phase::Stopped]);
    assert!(fleet.view(&robots[0]).await.tasks.is_empty());
    let refused = fleet
        .deployments
        .order_task(&fleet.operator, &random_key(), TaskOrder::Stop, &task, &everyone)
        .await;
    assert_eq!(code(refused), "no_robots_match");
}

async fn late_reports_change_nothing(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let mut robots = fleet.enroll(1).await;
    let id = fleet.deploy("1", |_| ()).await;
    let robot = &mut robots[0];
    let desired = fleet.desired(robot).await.expect("state");
    robot.accept(&desired, Phase::Fetching);
    let late = robot.next_report();
    robot.accept(&desired, Phase::Running);
    fleet.report(robot).await;
    assert_eq!(fleet.writer.submit(late, 0).await.expect("acknowledged").generation, Generation(1));
    assert_eq!(fleet.phases(&id).await, [Phase::Running]);
    robot.accept(&desired, Phase::Failed);
    fleet.report(robot).await;
    robot.accept(&desired, Phase::Running);
    fleet.report(robot).await;
    assert_eq!(fleet.phases(&id).await, [Phase::Failed]);
}

async fn reports_at_once_are_all_acknowledged(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let mut robots = fleet.enroll(20).await;
    let id = fleet.deploy("1", |_| ()).await;
    let mut submissions = tokio::task::JoinSet::new();
    for robot in &mut robots {
        let desired = fleet.desired(robot).await.expect("state");
        for phase in [Phase::Fetching, Phase::Unpacking, Phase::Running] {
            robot.accept(&desired, phase);
            let (writer, report) = (fleet.writer.clone(), robot.next_report());
            submissions.spawn(async move { writer.submit(report, 0).await.expect("stored") });
        }
    }
    assert_eq!(submissions.join_all().await.len(), 60);
    assert!(fleet.phases(&id).await.iter().all(|phase| *phase == Phase::Running));
}

async fn unstored_report_gets_an_error(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let mut robots = fleet.enroll(1).await;
    fleet.database.store.close().await;
    let refused = fleet.writer.submit(robots[0].next_report(), 0).await;
    assert!(matches!(refused, Err(ReportError::NotStored(_))));
}

async fn robots_ahead_of_a_restored_database_are_left_alone(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let mut robots = fleet.enroll(2).await;
    // The robots know three orders that this database has never seen.
    let before = Fleet::new(crate::database::sqlite().await).await;
    let mut elsewhere = before.enroll(1).await;
    for version in ["1", "2", "3"] {
        before.deploy(version, |_| ()).await;
    }
    let mut lost = before.desired(&elsewhere[0]).await.expect("state");
    lost.tasks[0].run = 4;
    elsewhere.clear();
    for robot in &mut robots {
        robot.accept(&lost, Phase::Running);
        fleet.report(robot).await;
    }
    let view = fleet.view(&robots[0]).await;
    assert_eq!(view.conditions[0].code, "diverged");
    assert_eq!(code(fleet.desired(&robots[0]).await), "diverged");
    fleet.actions.expire().await.expect("done");
    assert_eq!(fleet.view(&robots[0]).await.generation, Generation(0));

    let (task, first) = ("talker".parse().expect("valid"), "r0".parse().expect("valid"));
    fleet
        .deployments
        .order_task(&fleet.operator, &random_key(), TaskOrder::Stop, &task, &first)
        .await
        .expect("ordered");
    let desired = fleet.desired(&robots[0]).await.expect("not withheld any more");
    assert_eq!((desired.generation, desired.tasks[0].run), (Generation(4), 4));
    assert_eq!(desired.tasks[0].package, lost.tasks[0].package);
    assert_eq!(desired.tasks[0].wanted, TargetState::Stopped);
    assert_eq!(code(fleet.desired(&robots[1]).await), "diverged");

    let next = fleet.deploy("4", |order| order.selector = "r1".parse().expect("valid")).await;
    let desired = fleet.desired(&robots[1]).await.expect("not withheld any more");
    assert_eq!((desired.generation, desired.tasks.len()), (Generation(4), 1));
    assert_eq!(desired.tasks[0].deployment, next);
    fleet.deployments.cancel(&fleet.operator, &next).await.expect("cancelled");
    assert_eq!(
        fleet.desired(&robots[1]).await.expect("state").tasks[0].deployment,
        lost.tasks[0].deployment
    );
    assert!(fleet.view(&robots[1]).await.conditions.is_empty());
}

async fn numbers_at_the_end_of_their_range_stop_no_order(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let mut robots = fleet.enroll(2).await;
    fleet.deploy("1", |_| ()).await;
    for robot in &mut robots {
        fleet.follow(robot, Phase::Running).await;
    }
    // One robot invents numbers; the robot's reported state is adopted with the next order.
    let liar = &mut robots[0];
    (liar.observed, liar.start) = (Generation(u64::MAX), u64::MAX);
    for task in liar.tasks.values_mut() {
        (task.run, task.phase_ms, task.attempts, task.restarts) =
            (u64::MAX, u64::MAX, u32::MAX, u32::MAX);
    }
    for _ in 0..2 {
        fleet.report(liar).await;
    }
    let (task, everyone) = ("talker".parse().expect("valid"), "*".parse().expect("valid"));
    for order in [TaskOrder::Stop, TaskOrder::Start] {
        fleet
            .deployments
            .order_task(&fleet.operator, &random_key(), order, &task, &everyone)
            .await
            .expect("ordered");
    }
    for robot in &robots {
        let desired = fleet.desired(robot).await.expect("state");
        assert_eq!((desired.tasks.len(), desired.tasks[0].wanted), (1, TargetState::Running));
        assert!(desired.tasks[0].run > 1, "{desired:?}");
    }
}

async fn reopened_database_keeps_all_state(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let mut robots = fleet.enroll(1).await;
    let id = fleet.deploy("1", |_| ()).await;
    fleet.follow(&mut robots[0], Phase::Running).await;
    let before = fleet.database.store.robots().get(&robots[0].id).await.expect("reads");
    assert!(before.is_some());
    fleet.database.store.close().await;
    let store = Store::open(&fleet.database.url).await.expect("opens again");
    assert_eq!(store.robots().get(&robots[0].id).await.expect("reads"), before);
    let deployment = store.deployments().summary(&id).await.expect("reads").expect("there");
    assert_eq!(deployment.state(), DeploymentState::Settled);
}
