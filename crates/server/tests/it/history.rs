//! The outcomes and times of each robot's tasks, and the robots' settings, told on every database.

use serde_json::json;
use task_proto::Generation;
use task_proto::api::{BulkLabels, EditRobot, MAX_TIMELINE, PastAssignment};
use task_proto::desired::settings::RobotSettings;
use task_proto::ids::Labels;
use task_proto::messages::report::Phase;
use taskd::orders::actions::TaskOrder;
use taskd::store::{HistoryPage, HistoryQuery};

use crate::database::{TestDatabase, on_both_databases};
use crate::fleet::{Fleet, Robot, random_key};

on_both_databases! {
    every_phase_has_its_start_time,
    long_timeline_keeps_its_beginning_and_end,
    running_task_returns_to_its_timeline,
    robot_history_is_read_in_pages,
    settings_are_part_of_the_desired_state,
    name_and_labels_are_part_of_the_desired_state,
}

async fn history(fleet: &Fleet, robot: &Robot, query: HistoryQuery<'_>) -> HistoryPage {
    fleet
        .database
        .store
        .assignments()
        .history(&robot.id, query)
        .await
        .expect("read")
        .expect("found")
}

async fn newest(fleet: &Fleet, robot: &Robot) -> PastAssignment {
    let all = HistoryQuery { task: None, before: None, limit: 10 };
    history(fleet, robot, all).await.assignments.remove(0)
}

fn steps(past: &PastAssignment) -> Vec<(Phase, u64, u32)> {
    past.timeline.iter().map(|entry| (entry.phase, entry.at_ms, entry.attempt)).collect()
}

async fn every_phase_has_its_start_time(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let mut robot = fleet.enroll(1).await.remove(0);
    let began_ms = fleet.clock.now_ms();
    let first = fleet.deploy("1.0.0", |_| {}).await;
    assert_eq!(steps(&newest(&fleet, &robot).await), [(Phase::Assigned, began_ms, 0)]);
    fleet.clock.advance_ms(1000);
    fleet.follow(&mut robot, Phase::Fetching).await;
    fleet.clock.advance_ms(1000);
    robot.tasks.values_mut().for_each(|task| task.attempts = 2);
    fleet.report(&mut robot).await;
    fleet.clock.advance_ms(1000);
    // Progress alone is no step.
    robot.tasks.values_mut().for_each(|task| {
        task.progress = Some(task_proto::messages::report::Progress { done: 1, total: 2 })
    });
    fleet.report(&mut robot).await;
    fleet.follow(&mut robot, Phase::Running).await;
    let at = |seconds: u64| began_ms + seconds * 1000;
    let so_far = [
        (Phase::Assigned, at(0), 0),
        (Phase::Fetching, at(1), 1),
        (Phase::Fetching, at(2), 2),
        (Phase::Running, at(3), 1),
    ];
    let running = newest(&fleet, &robot).await;
    assert_eq!(steps(&running), so_far);
    assert_eq!(
        (running.deployment.clone(), running.created_at_ms, running.attempts),
        (first.clone(), began_ms, 1)
    );
    assert!(running.wanted.is_some() && running.released && running.superseded_by.is_none());
    let shown = fleet.deployment(&first).await.assignments.expect("asked for").remove(0);
    assert_eq!(shown.timeline, Some(running.timeline.clone()));

    fleet.clock.advance_ms(1000);
    let second = fleet.deploy("2.0.0", |_| {}).await;
    let all = HistoryQuery { task: None, before: None, limit: 10 };
    let mut past = history(&fleet, &robot, all).await.assignments;
    assert_eq!(
        past.iter().map(|past| past.deployment.clone()).collect::<Vec<_>>(),
        [second.clone(), first]
    );
    let replaced = past.remove(1);
    assert_eq!(steps(&replaced)[4..], [(Phase::Superseded, at(4), 0)]);
    assert_eq!((replaced.superseded_by, replaced.wanted), (Some(second.clone()), None));
    fleet.deployments.cancel(&fleet.operator, &second).await.expect("cancelled");
    let past = history(&fleet, &robot, all).await.assignments;
    assert_eq!(steps(&past[0])[1..], [(Phase::Cancelled, at(4), 0)]);
    assert_eq!(steps(&past[1])[5..], [(Phase::Assigned, at(4), 0)], "it is wanted again");
}

async fn running_task_returns_to_its_timeline(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let mut robot = fleet.enroll(1).await.remove(0);
    fleet.deploy("1.0.0", |_| {}).await;
    fleet.follow(&mut robot, Phase::Running).await;
    // The database knows nothing of the orders up to this one; with the next, it adopts the robot's
    // state.
    robot.observed = Generation(7);
    fleet.report(&mut robot).await;
    let (task, all) = ("talker".parse().expect("a name"), "*".parse().expect("a selector"));
    fleet
        .deployments
        .order_task(&fleet.operator, &random_key(), TaskOrder::Stop, &task, &all)
        .await
        .expect("ordered");
    let phases: Vec<Phase> =
        newest(&fleet, &robot).await.timeline.iter().map(|entry| entry.phase).collect();
    assert_eq!(phases, [Phase::Assigned, Phase::Running, Phase::Stopped, Phase::Running]);
}

async fn long_timeline_keeps_its_beginning_and_end(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let mut robot = fleet.enroll(1).await.remove(0);
    fleet.deploy("1.0.0", |_| {}).await;
    let began_ms = fleet.clock.now_ms();
    for _ in 0..50 {
        for phase in [Phase::Starting, Phase::Running] {
            fleet.clock.advance_ms(1);
            fleet.follow(&mut robot, phase).await;
        }
    }
    let at: Vec<u64> =
        newest(&fleet, &robot).await.timeline.iter().map(|entry| entry.at_ms - began_ms).collect();
    let half = MAX_TIMELINE as u64 / 2;
    assert_eq!(at, (0..half).chain(101 - half..101).collect::<Vec<_>>());
}

async fn robot_history_is_read_in_pages(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let robots = fleet.enroll(2).await;
    let mut ordered = Vec::new();
    for version in ["1.0.0", "1.1.0", "1.2.0"] {
        ordered.insert(0, fleet.deploy(version, |_| {}).await);
    }
    let ids = |page: &HistoryPage| {
        page.assignments.iter().map(|past| past.deployment.clone()).collect::<Vec<_>>()
    };
    let page =
        history(&fleet, &robots[0], HistoryQuery { task: None, before: None, limit: 2 }).await;
    assert_eq!((ids(&page), page.next.as_ref()), (ordered[..2].to_vec(), Some(&ordered[1])));
    let page = history(
        &fleet,
        &robots[0],
        HistoryQuery { task: None, before: page.next.as_ref(), limit: 2 },
    )
    .await;
    assert_eq!((ids(&page), page.next.as_ref()), (ordered[2..].to_vec(), None));
    let task = page.assignments[0].package.name.clone();
    let of = |task| HistoryQuery { task: Some(task), before: None, limit: 9 };
    assert_eq!(history(&fleet, &robots[1], of(&task)).await.assignments.len(), 3);
    assert_eq!(
        history(&fleet, &robots[1], of(&"other".parse().expect("a name"))).await.assignments.len(),
        0
    );
    let unknown = task_proto::DeploymentId::random();
    let before = HistoryQuery { task: None, before: Some(&unknown), limit: 9 };
    assert!(
        fleet
            .database
            .store
            .assignments()
            .history(&robots[0].id, before)
            .await
            .expect("read")
            .is_none()
    );
    let selector = robots[0].id.as_str().parse().expect("a selector");
    let key = random_key();
    let order =
        fleet.deployments.order_task(&fleet.operator, &key, TaskOrder::Remove, &task, &selector);
    order.await.expect("removed");
    assert_eq!(newest(&fleet, &robots[0]).await.wanted, None);
}

async fn settings_are_part_of_the_desired_state(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let robots = fleet.enroll(2).await;
    let before = fleet.desired(&robots[0]).await.expect("a state");
    assert!(before.settings.is_empty());
    let set = async |settings: serde_json::Value| {
        let edit: EditRobot =
            serde_json::from_value(json!({ "settings": settings })).expect("parses");
        fleet.robots.edit(&fleet.operator, &robots[0].id, &edit).await
    };
    let wanted = json!({
        "workspace": "/home/robot/it's ws", "ros_domain_id": 7, "limits": { "task_memory_mb": 512 },
    });
    set(wanted.clone()).await.expect("set");
    let wanted: RobotSettings = serde_json::from_value(wanted).expect("parses");
    let state = fleet.desired(&robots[0]).await.expect("a state");
    assert_eq!((state.generation.0, &state.settings), (before.generation.0 + 1, &wanted));
    assert_eq!(fleet.changes.take_robots_to_notify().await.robots, [robots[0].id.clone()].into());
    assert_eq!(fleet.view(&robots[0]).await.settings, Some(wanted.clone()));
    set(serde_json::to_value(&wanted).expect("json")).await.expect("the same");
    assert_eq!(
        fleet.desired(&robots[0]).await.expect("a state").generation,
        state.generation,
        "nothing is new"
    );
    assert!(set(json!({ "limits": { "parallel_tasks": 0 } })).await.is_err());
    let renamed =
        EditRobot { name: Some("atlas".parse().expect("a name")), ..EditRobot::default() };
    fleet.robots.edit(&fleet.operator, &robots[0].id, &renamed).await.expect("renamed");
    assert_eq!(fleet.desired(&robots[0]).await.expect("a state").settings, wanted, "absent stays");
    set(serde_json::Value::Null).await.expect("cleared");
    let cleared = fleet.desired(&robots[0]).await.expect("a state");
    assert_eq!((cleared.generation.0, cleared.settings.is_empty()), (state.generation.0 + 2, true));
    assert_eq!(fleet.view(&robots[0]).await.settings, None);
    assert!(fleet.desired(&robots[1]).await.expect("a state").settings.is_empty());
}

async fn name_and_labels_are_part_of_the_desired_state(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let mut robots = fleet.enroll(2).await;
    let site = |value: &str| {
        Labels::from([("site".parse().expect("a key"), value.parse().expect("a value"))])
    };
    let edit = async |robot: &Robot, labels: Labels| {
        let edit = EditRobot { labels: Some(labels), ..EditRobot::default() };
        fleet.robots.edit(&fleet.operator, &robot.id, &edit).await.expect("edited");
        fleet.desired(robot).await.expect("a state")
    };
    let before = fleet.desired(&robots[0]).await.expect("a state");
    let named = edit(&robots[0], site("lab")).await;
    assert_eq!(named.robot.labels, site("lab"), "no state of before the change");
    assert_eq!(named.generation, before.generation, "nothing is ordered yet");
    fleet.deploy("1.0.0", |_| {}).await;
    let ordered = fleet.desired(&robots[0]).await.expect("a state");
    fleet.changes.take_robots_to_notify().await;
    let moved = edit(&robots[0], site("yard")).await;
    assert_eq!((&moved.robot.labels, &moved.tasks), (&site("yard"), &ordered.tasks));
    assert_eq!(moved.generation.0, ordered.generation.0 + 1);
    assert_eq!(fleet.changes.take_robots_to_notify().await.robots, [robots[0].id.clone()].into());
    assert_eq!(edit(&robots[0], site("yard")).await.generation, moved.generation, "nothing is new");
    let order = BulkLabels {
        selector: "*".parse().expect("a selector"),
        set: site("yard"),
        remove: Vec::new(),
        dry_run: false,
    };
    let second = fleet.desired(&robots[1]).await.expect("a state");
    fleet.robots.label_selected(&fleet.operator, None, &order).await.expect("labelled");
    let labelled = fleet.desired(&robots[1]).await.expect("a state");
    assert_eq!(labelled.robot.labels, site("yard"));
    assert_eq!(labelled.generation.0, second.generation.0 + 1);
    assert_eq!(fleet.desired(&robots[0]).await.expect("a state").generation, moved.generation);
    assert_eq!(fleet.changes.take_robots_to_notify().await.robots, [robots[1].id.clone()].into());

    // A robot with a later state than the database keeps its tasks until the next order.
    robots[0].observed = Generation(moved.generation.0 + 1);
    fleet.report(&mut robots[0]).await;
    let edited = EditRobot { labels: Some(site("hall")), ..EditRobot::default() };
    fleet.robots.edit(&fleet.operator, &robots[0].id, &edited).await.expect("edited");
    assert!(fleet.desired(&robots[0]).await.is_err(), "the state of before the copy was sent");
}
