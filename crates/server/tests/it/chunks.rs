//! Orders that are placed in chunks, told on every database, and by two servers in turns.

use task_proto::Generation;
use task_proto::api::{AuditQuery, DeploymentState, EditRobot, Placing, RetryDeployment};
use task_proto::messages::report::Phase;
use task_proto::packages::manifest::TaskKind;
use task_proto::people::audit::AuditEntry;
use taskd::orders::actions::TaskOrder;

use crate::database::{TestDatabase, on_all_databases, on_both_databases};
use crate::fleet::{Fleet, Robot, order_of, package, random_key};
use crate::story::code;

on_all_databases! {
    order_in_three_chunks_reaches_all_robots,
    small_order_is_placed_at_once,
    cancel_between_chunks_leaves_the_rest_alone,
    large_deployment_is_cancelled_in_chunks,
    many_assignments_expire_together,
    order_is_placed_on_by_the_next_server,
    report_between_chunks_is_stored,
    repeated_order_between_chunks_is_the_same,
    batches_go_on_across_chunks,
    failures_of_an_earlier_chunk_stop_a_later_one,
    newer_order_between_chunks_wins,
    task_stopped_between_chunks_stays_stopped,
    removed_robot_is_skipped,
    relabelled_and_renamed_robots_stay_selected,
    retry_and_rollback_are_placed_in_chunks,
    package_of_an_unplaced_order_is_kept,
}

/// The most robots of one write, in these tests.
const CHUNK: usize = 2;

async fn fleet_of(database: TestDatabase, robots: u32) -> (Fleet, Vec<Robot>) {
    let fleet = Fleet::with_chunks(database, CHUNK).await;
    let robots = fleet.enroll(robots).await;
    (fleet, robots)
}

impl Fleet {
    /// Places one more chunk; false if there is none.
    async fn place(&self) -> bool {
        self.deployments.continue_order().await.expect("placed")
    }

    async fn place_all(&self) {
        while self.place().await {}
    }

    /// The generations of the robots' desired states.
    async fn generations(&self, robots: &[Robot]) -> Vec<u64> {
        let mut generations = Vec::new();
        for robot in robots {
            generations.push(self.view(robot).await.generation.0);
        }
        generations
    }

    /// The number of the robot's desired tasks.
    async fn tasks(&self, robot: &Robot) -> usize {
        self.desired(robot).await.expect("state").tasks.len()
    }
}

fn placing(selected: u64, placed: u64) -> Option<Placing> {
    Some(Placing { selected, placed })
}

async fn order_in_three_chunks_reaches_all_robots(database: TestDatabase) {
    let (fleet, mut robots) = fleet_of(database, 5).await;
    let id = fleet.deploy("1", |_| ()).await;
    let view = fleet.deployment(&id).await;
    assert_eq!((view.state, view.placing), (DeploymentState::Active, placing(5, 2)));
    assert_eq!(fleet.phases(&id).await, [Phase::Assigned; 2]);
    assert_eq!(fleet.generations(&robots).await, [1, 1, 0, 0, 0]);
    let first = fleet.changes.take_robots_to_notify().await.robots;
    assert_eq!(first, [robots[0].id.clone(), robots[1].id.clone()].into());
    // All that are placed have settled, and the deployment has not.
    for robot in &mut robots[..2] {
        fleet.follow(robot, Phase::Running).await;
    }
    assert_eq!(fleet.deployment(&id).await.state, DeploymentState::Active);
    assert!(fleet.place().await);
    assert_eq!(fleet.deployment(&id).await.placing, placing(5, 4));
    let second = fleet.changes.take_robots_to_notify().await.robots;
    assert_eq!(second, [robots[2].id.clone(), robots[3].id.clone()].into());
    assert!(fleet.place().await);
    assert_eq!(fleet.deployment(&id).await.placing, None);
    assert!(!fleet.place().await, "nothing is left");
    assert_eq!(fleet.generations(&robots).await, [1; 5]);
    for robot in &mut robots[2..] {
        fleet.follow(robot, Phase::Running).await;
    }
    let view = fleet.deployment(&id).await;
    assert_eq!(view.state, DeploymentState::Settled);
    let robots_in = |view: task_proto::api::DeploymentView| view.assignments.expect("there").len();
    assert_eq!(robots_in(view), 5);
    // The audit has the whole order, once.
    let query = AuditQuery { act: Some("deployment.create".to_owned()), ..Default::default() };
    let page = fleet.database.store.audit().page(&query).await.expect("reads");
    let [record] = page.records.as_slice() else { panic!("{page:?}") };
    let entry: AuditEntry = serde_json::from_str(record.entry.get()).expect("an entry");
    assert_eq!((entry.detail["robots"].as_str(), entry.detail["count"].as_str()), ("*", "5"));
}

async fn small_order_is_placed_at_once(database: TestDatabase) {
    let (fleet, robots) = fleet_of(database, 2).await;
    let id = fleet.deploy("1", |_| ()).await;
    assert_eq!(fleet.deployment(&id).await.placing, None);
    assert_eq!(fleet.generations(&robots).await, [1, 1]);
    assert!(!fleet.place().await);
}

async fn cancel_between_chunks_leaves_the_rest_alone(database: TestDatabase) {
    let (fleet, mut robots) = fleet_of(database, 5).await;
    let before = fleet.deploy("1", |_| ()).await;
    fleet.place_all().await;
    for robot in &mut robots {
        fleet.follow(robot, Phase::Running).await;
    }
    let id = fleet.deploy("2", |_| ()).await;
    fleet.follow(&mut robots[0], Phase::Running).await;
    fleet.deployments.cancel(&fleet.operator, &id).await.expect("cancelled");
    assert!(!fleet.place().await, "the rest is never placed");
    let view = fleet.deployment(&id).await;
    assert_eq!((view.state, view.placing), (DeploymentState::Cancelled, placing(5, 2)));
    assert_eq!(fleet.phases(&id).await, [Phase::Running, Phase::Cancelled]);
    assert_eq!(fleet.desired(&robots[0]).await.expect("state").tasks[0].deployment, id);
    for robot in &robots[1..] {
        assert_eq!(fleet.desired(robot).await.expect("state").tasks[0].deployment, before);
    }
    assert_eq!(fleet.generations(&robots[2..]).await, [1, 1, 1]);
    fleet.deployments.cancel(&fleet.operator, &id).await.expect("again is harmless");
    // An order whose first robots have all settled can be cancelled for the rest.
    let id = fleet.deploy("3", |_| ()).await;
    for robot in &mut robots[..2] {
        fleet.follow(robot, Phase::Running).await;
    }
    fleet.deployments.cancel(&fleet.operator, &id).await.expect("cancelled");
    assert!(!fleet.place().await);
    assert_eq!(fleet.phases(&id).await, [Phase::Running, Phase::Running]);
}

async fn large_deployment_is_cancelled_in_chunks(database: TestDatabase) {
    let (fleet, mut robots) = fleet_of(database, 7).await;
    fleet.publish("1").await;
    let before = fleet.deploy("1", |_| ()).await;
    fleet.place_all().await;
    for robot in &mut robots {
        fleet.follow(robot, Phase::Running).await;
    }
    let id = fleet.deploy("2", |_| ()).await;
    fleet.place_all().await;
    fleet.follow(&mut robots[1], Phase::Running).await;
    fleet.deployments.cancel(&fleet.operator, &id).await.expect("cancelled");
    use Phase::{Assigned, Cancelled, Running};
    assert_eq!(fleet.deployment(&id).await.state, DeploymentState::Cancelled);
    let phases = fleet.phases(&id).await;
    assert_eq!(phases, [Cancelled, Running, Cancelled, Assigned, Assigned, Assigned, Assigned]);
    // In between, a robot gets on with its order, and another one gets a newer order.
    fleet.follow(&mut robots[3], Running).await;
    let newer = fleet.deploy("3", |order| order.selector = "r4".parse().expect("valid")).await;
    fleet.place_all().await;
    let phases = fleet.phases(&id).await;
    let superseded = Phase::Superseded;
    assert_eq!(phases, [Cancelled, Running, Cancelled, Running, superseded, Cancelled, Cancelled]);
    let deployments = [&before, &id, &before, &id, &newer, &before, &before];
    for (robot, deployment) in robots.iter().zip(deployments) {
        assert_eq!(fleet.desired(robot).await.expect("state").tasks[0].deployment, *deployment);
    }
    fleet.deployments.cancel(&fleet.operator, &newer).await.expect("cancelled");
    let restored = fleet.desired(&robots[4]).await.expect("state").tasks.remove(0);
    assert_eq!(restored.deployment, before, "a cancelled deployment is never restored");
}

async fn many_assignments_expire_together(database: TestDatabase) {
    let (fleet, _robots) = fleet_of(database, 5).await;
    let id = fleet.deploy("1", |order| order.expires_in_s = Some(60)).await;
    fleet.place_all().await;
    fleet.clock.advance_ms(60_000);
    fleet.actions.expire().await.expect("done");
    assert_eq!(fleet.phases(&id).await, [Phase::Expired; 5]);
}

async fn order_is_placed_on_by_the_next_server(database: TestDatabase) {
    let (fleet, robots) = fleet_of(database, 5).await;
    let id = fleet.deploy("1", |_| ()).await;
    assert!(fleet.place().await);
    // Another server finds the rest, as after the end of the first one.
    let next = fleet.database.another_store().await;
    let actions = taskd::orders::actions::Actions::new(
        next,
        fleet.clock.clone(),
        fleet.changes.clone(),
        std::sync::Arc::new(crate::fleet::key()),
        Default::default(),
        fleet.planner.clone(),
    );
    // Both place at the same time: each chunk is placed once.
    let (one, other) =
        tokio::join!(actions.deployments.continue_order(), fleet.deployments.continue_order());
    let placed = [one.expect("placed"), other.expect("placed")];
    assert!(placed.contains(&true));
    assert!(!actions.deployments.continue_order().await.expect("reads"));
    assert_eq!(fleet.deployment(&id).await.placing, None);
    assert_eq!(fleet.generations(&robots).await, [1; 5]);
}

async fn report_between_chunks_is_stored(database: TestDatabase) {
    let (fleet, mut robots) = fleet_of(database, 5).await;
    let old = fleet.deploy("1", |_| ()).await;
    fleet.place_all().await;
    fleet.deploy("2", |_| ()).await;
    // The last robot is still to get the second order, and reports on the first.
    fleet.follow(&mut robots[4], Phase::Fetching).await;
    assert_eq!(fleet.phases(&old).await[4], Phase::Fetching);
    fleet.place_all().await;
    assert_eq!(fleet.phases(&old).await[4], Phase::Superseded);
    assert_eq!(fleet.report(&mut robots[4]).await, Generation(2));
}

async fn repeated_order_between_chunks_is_the_same(database: TestDatabase) {
    let (fleet, robots) = fleet_of(database, 5).await;
    let (key, package) = (random_key(), package("1", TaskKind::Service));
    let order = order_of(&package);
    let create = async || fleet.deployments.create(&fleet.operator, &key, &order, &package).await;
    let first = create().await.expect("ordered");
    assert_eq!(create().await.expect("the same"), first);
    assert!(fleet.place().await);
    assert_eq!(create().await.expect("the same"), first);
    fleet.place_all().await;
    assert_eq!(create().await.expect("the same"), first);
    assert_eq!(fleet.deployments().await.len(), 1);
    assert_eq!(fleet.generations(&robots).await, [1; 5]);
}

async fn batches_go_on_across_chunks(database: TestDatabase) {
    let (fleet, mut robots) = fleet_of(database, 7).await;
    fleet.go_offline(&robots[0].id);
    let id = fleet.deploy("1", |order| order.batch = Some(3)).await;
    // The first chunk has one robot that is online.
    assert_eq!(fleet.generations(&robots).await, [0, 1, 0, 0, 0, 0, 0]);
    assert!(fleet.place().await);
    assert_eq!(fleet.generations(&robots).await, [0, 1, 0, 0, 0, 0, 0], "the batch is busy");
    fleet.follow(&mut robots[1], Phase::Running).await;
    assert_eq!(fleet.generations(&robots).await, [0, 1, 1, 1, 0, 0, 0]);
    for robot in &mut robots[2..4] {
        fleet.follow(robot, Phase::Running).await;
    }
    // Only an offline robot waits, and others are still to come: its time does not run.
    fleet.clock.advance_ms(1);
    fleet.deployments.advance_rollouts().await.expect("advanced");
    fleet.place_all().await;
    assert_eq!(fleet.generations(&robots).await, [0, 1, 1, 1, 1, 1, 0]);
    for robot in &mut robots[4..6] {
        fleet.follow(robot, Phase::Running).await;
    }
    assert_eq!(fleet.generations(&robots).await, [0, 1, 1, 1, 1, 1, 1]);
    // The robot that was passed over comes after all others, also those of later chunks.
    fleet.come_online(&robots[0].id);
    fleet.follow(&mut robots[6], Phase::Running).await;
    assert_eq!(fleet.generations(&robots).await, [1; 7]);
    fleet.follow(&mut robots[0], Phase::Running).await;
    assert_eq!(fleet.deployment(&id).await.state, DeploymentState::Settled);
}

async fn failures_of_an_earlier_chunk_stop_a_later_one(database: TestDatabase) {
    let (fleet, mut robots) = fleet_of(database, 5).await;
    let id = fleet.deploy("1", |order| order.max_failures = Some(0)).await;
    fleet.follow(&mut robots[1], Phase::Failed).await;
    fleet.place_all().await;
    assert_eq!(fleet.deployment(&id).await.state, DeploymentState::Paused);
    assert_eq!(fleet.generations(&robots).await, [1, 1, 0, 0, 0]);
    fleet.deployments.resume(&fleet.operator, &id).await.expect("resumed");
    assert_eq!(fleet.generations(&robots).await, [1; 5]);
}

async fn newer_order_between_chunks_wins(database: TestDatabase) {
    let (fleet, robots) = fleet_of(database, 5).await;
    let old = fleet.deploy("1", |_| ()).await;
    let some = fleet.deploy("2", |order| order.selector = "r1,r3".parse().expect("valid")).await;
    let waiting = fleet
        .deploy("3", |order| {
            (order.selector, order.batch) = ("r2,r4".parse().expect("valid"), Some(1));
        })
        .await;
    fleet.place_all().await;
    let expected = [&old, &some, &waiting, &some, &old];
    for (robot, expected) in robots.iter().zip(expected) {
        let state = fleet.desired(robot).await.expect("state");
        match state.tasks.as_slice() {
            [task] => assert_eq!(task.deployment, *expected),
            // The batch that the newest order waits for is not over.
            tasks => assert!(tasks.is_empty() && robot.id == robots[4].id, "{tasks:?}"),
        }
    }
    let view = fleet.deployment(&old).await;
    let newer: Vec<_> =
        view.assignments.iter().flatten().map(|one| one.superseded_by.clone()).collect();
    let (some, waiting) = (Some(some), Some(waiting));
    assert_eq!(newer, [None, some.clone(), waiting.clone(), some, waiting]);
    assert_eq!(fleet.generations(&robots).await, [1, 2, 1, 1, 0]);
}

async fn task_stopped_between_chunks_stays_stopped(database: TestDatabase) {
    let (fleet, mut robots) = fleet_of(database, 5).await;
    fleet.deploy("1", |_| ()).await;
    fleet.place_all().await;
    for robot in &mut robots {
        fleet.follow(robot, Phase::Running).await;
    }
    let id = fleet.deploy("2", |_| ()).await;
    let (by, task) = (&fleet.operator, "talker".parse().expect("a name"));
    let order = async |order, selector: &str| {
        let selector = selector.parse().expect("a selector");
        fleet.deployments.order_task(by, &random_key(), order, &task, &selector).await
    };
    order(TaskOrder::Stop, "r3").await.expect("ordered");
    order(TaskOrder::Remove, "r4").await.expect("ordered");
    fleet.place_all().await;
    let view = fleet.deployment(&id).await;
    let phases: Vec<_> = view.assignments.iter().flatten().map(|one| one.phase).collect();
    use Phase::{Assigned, Cancelled};
    assert_eq!(phases, [Assigned, Assigned, Assigned, Cancelled, Cancelled]);
    let stopped = fleet.desired(&robots[3]).await.expect("state");
    assert_eq!(stopped.tasks[0].wanted, task_proto::desired::TargetState::Stopped);
    assert_eq!(fleet.tasks(&robots[4]).await, 0);
}

async fn removed_robot_is_skipped(database: TestDatabase) {
    let (fleet, mut robots) = fleet_of(database, 5).await;
    let id = fleet.deploy("1", |_| ()).await;
    fleet.robots.remove(&fleet.operator, &robots[3].id).await.expect("removed");
    fleet.place_all().await;
    let view = fleet.deployment(&id).await;
    assert_eq!(view.placing, None);
    let names: Vec<_> = view.assignments.iter().flatten().map(|one| one.name.as_str()).collect();
    assert_eq!(names, ["r0", "r1", "r2", "r4"]);
    robots.remove(3);
    for robot in &mut robots {
        fleet.follow(robot, Phase::Running).await;
    }
    assert_eq!(fleet.deployment(&id).await.state, DeploymentState::Settled);
}

/// The order is for the robots that matched when it was given.
async fn relabelled_and_renamed_robots_stay_selected(database: TestDatabase) {
    let (fleet, robots) = fleet_of(database, 5).await;
    let id = fleet.deploy("1", |order| order.selector = "!r4".parse().expect("valid")).await;
    let rename = |name: &str| EditRobot {
        name: Some(name.parse().expect("a name")),
        ..EditRobot::default()
    };
    let edit = async |robot: &Robot, name: &str| {
        fleet.robots.edit(&fleet.operator, &robot.id, &rename(name)).await.expect("renamed");
    };
    edit(&robots[3], "a").await;
    edit(&robots[4], "b").await;
    fleet.place_all().await;
    assert_eq!(fleet.generations(&robots).await, [1, 1, 1, 1, 0]);
    assert_eq!(fleet.phases(&id).await.len(), 4);
}

async fn retry_and_rollback_are_placed_in_chunks(database: TestDatabase) {
    let (fleet, mut robots) = fleet_of(database, 5).await;
    fleet.publish("1").await;
    fleet.publish("2").await;
    fleet.deploy("1", |_| ()).await;
    fleet.place_all().await;
    for robot in &mut robots {
        fleet.follow(robot, Phase::Running).await;
    }
    let bad = fleet.deploy("2", |_| ()).await;
    fleet.place_all().await;
    for robot in &mut robots {
        fleet.follow(robot, Phase::Failed).await;
    }
    let (by, retry) = (&fleet.operator, RetryDeployment::default());
    let id = fleet.deployments.retry(by, &random_key(), &bad, &retry).await.expect("ordered");
    assert_eq!(fleet.deployment(&id).await.placing, placing(5, 2));
    fleet.place_all().await;
    assert_eq!(fleet.generations(&robots).await, [3; 5]);
    for robot in &mut robots {
        fleet.follow(robot, Phase::Running).await;
    }
    let (task, everyone) = ("talker".parse().expect("valid"), "*".parse().expect("valid"));
    let key = random_key();
    let done = fleet.deployments.rollback(by, &key, &task, &everyone).await.expect("ordered");
    let [id] = done.deployments.as_slice() else { panic!("{done:?}") };
    assert_eq!((done.robots.len(), fleet.deployment(id).await.placing), (5, placing(5, 2)));
    fleet.place_all().await;
    assert_eq!(fleet.generations(&robots).await, [4; 5]);
}

async fn package_of_an_unplaced_order_is_kept(database: TestDatabase) {
    let (fleet, robots) = fleet_of(database, 3).await;
    let id = fleet.deploy("1", |_| ()).await;
    for robot in &robots[..2] {
        fleet.robots.remove(&fleet.operator, &robot.id).await.expect("removed");
    }
    assert_eq!(fleet.phases(&id).await, [Phase::Cancelled; 2]);
    let in_use = fleet.database.store.deployments().packages_in_use().await.expect("reads");
    assert_eq!(in_use, [package("1", TaskKind::Service).package]);
    fleet.place_all().await;
    assert_eq!(fleet.tasks(&robots[2]).await, 1);
    let unknown = task_proto::DeploymentId::random();
    assert_eq!(code(fleet.deployments.cancel(&fleet.operator, &unknown).await), "not_found");
}
