//! Actions on many robots at once: on all the selected robots or on none, on every database, and
//! over HTTP.

use std::collections::BTreeSet;

use reqwest::Method;
use serde_json::json;
use task_proto::api::{AuditQuery, BulkLabels, DeploymentView, MatchedRobots, RobotList};
use task_proto::ids::Labels;
use task_proto::messages::report::Phase;
use taskd::orders::changes::Change;

use crate::database::{TestDatabase, on_both_databases};
use crate::fleet::Fleet;
use crate::harness::{TestServer, answer, refusal};
use crate::story::code;

on_both_databases! {
    labels_are_set_and_removed_at_once,
    label_change_beyond_the_scope_changes_nothing,
    robots_are_removed_at_once,
}

fn labels(pairs: &[(&str, &str)]) -> Labels {
    pairs
        .iter()
        .map(|(key, value)| (key.parse().expect("a key"), value.parse().expect("a value")))
        .collect()
}

fn order(selector: &str, set: &[(&str, &str)], remove: &[&str]) -> BulkLabels {
    BulkLabels {
        selector: selector.parse().expect("a selector"),
        set: labels(set),
        remove: remove.iter().map(|key| key.parse().expect("a key")).collect(),
        dry_run: false,
    }
}

async fn labels_are_set_and_removed_at_once(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    // More than one statement takes.
    let robots = fleet.enroll(75).await;
    let label =
        async |order: &BulkLabels| fleet.robots.label_selected(&fleet.operator, None, order).await;
    assert_eq!(
        label(&order("*", &[("site", "lab"), ("room", "7")], &[])).await.expect("done").len(),
        75
    );
    let mut notices = fleet.changes.subscribe();
    let meant = label(&order("!r0", &[("site", "field")], &["room", "none"])).await.expect("done");
    assert_eq!(meant.len(), 74);
    assert_eq!(fleet.view(&robots[0]).await.labels, labels(&[("site", "lab"), ("room", "7")]));
    for robot in &robots[1..] {
        assert_eq!(fleet.view(robot).await.labels, labels(&[("site", "field")]));
    }
    let mut told = BTreeSet::new();
    while let Ok(change) = notices.try_recv() {
        told.insert(change);
    }
    assert!(
        robots[1..].iter().all(|robot| told.contains(&Change::Robot(robot.id.clone()))),
        "all are shown"
    );
    assert!(told.contains(&Change::Scopes) && !told.contains(&Change::Robot(robots[0].id.clone())));

    assert_eq!(code(label(&order("site=mars", &[("a", "b")], &[])).await), "no_robots_match");
    assert_eq!(code(label(&order("*", &[], &[])).await), "invalid_request");
    let would = BulkLabels { dry_run: true, ..order("*", &[], &["site"]) };
    assert_eq!(label(&would).await.expect("could be done").len(), 75);
    assert_eq!(fleet.view(&robots[0]).await.labels, labels(&[("site", "lab"), ("room", "7")]));
    let would_not = BulkLabels { dry_run: true, ..order("*", &[], &[]) };
    assert_eq!(code(label(&would_not).await), "invalid_request");
    assert_eq!(code(label(&order("*", &[("a", "b")], &["a"])).await), "invalid_request");
    let many: Vec<(String, &str)> = (0..64).map(|number| (format!("k{number}"), "v")).collect();
    let many: Vec<(&str, &str)> = many.iter().map(|(key, value)| (key.as_str(), *value)).collect();
    assert_eq!(
        code(label(&order("*", &many, &[])).await),
        "invalid_request",
        "with the existing labels this is one too many"
    );
    assert_eq!(fleet.view(&robots[0]).await.labels.len(), 2);
    label(&order("*", &many, &["site", "room"])).await.expect("just as many as there may be");
}

async fn label_change_beyond_the_scope_changes_nothing(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let robots = fleet.enroll(3).await;
    fleet
        .robots
        .label_selected(&fleet.operator, None, &order("!r2", &[("site", "lab")], &[]))
        .await
        .expect("done");
    let alice = fleet.limited("alice", "site=lab").await;
    for beyond in [order("*", &[("a", "b")], &[]), order("site=lab", &[("site", "field")], &[])] {
        assert_eq!(code(fleet.robots.label_selected(&alice, None, &beyond).await), "out_of_scope");
    }
    let everyone = "*".parse().expect("a selector");
    assert_eq!(code(fleet.robots.remove_selected(&alice, None, &everyone).await), "out_of_scope");
    assert_eq!(fleet.view(&robots[0]).await.labels, labels(&[("site", "lab")]));
    assert!(fleet.view(&robots[2]).await.labels.is_empty());
    fleet
        .robots
        .label_selected(&alice, None, &order("site=lab", &[("a", "b")], &[]))
        .await
        .expect("hers");
    assert_eq!(fleet.view(&robots[1]).await.labels, labels(&[("a", "b"), ("site", "lab")]));
}

async fn robots_are_removed_at_once(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let mut robots = fleet.enroll(75).await;
    let id = fleet.deploy("1", |order| order.batch = Some(1)).await;
    fleet.follow(&mut robots[0], Phase::Running).await;
    let mut notices = fleet.changes.subscribe();
    let (key, others) = ("again".parse().expect("a key"), "!r0,!r1".parse().expect("a selector"));
    let remove = async || fleet.robots.remove_selected(&fleet.operator, Some(&key), &others).await;
    let gone = remove().await.expect("removed");
    assert_eq!(gone.len(), 73);
    assert_eq!(remove().await.expect("the same order"), gone);
    let other = "*".parse().expect("a selector");
    assert_eq!(
        code(fleet.robots.remove_selected(&fleet.operator, Some(&key), &other).await),
        "idempotency_key_reused"
    );
    let mut removed = 0;
    while let Ok(change) = notices.try_recv() {
        removed += usize::from(matches!(change, Change::RobotRemoved(_)));
    }
    assert_eq!(removed, 73);
    let one = AuditQuery { target: Some(robots[5].id.to_string()), ..AuditQuery::default() };
    let written = fleet.database.store.audit().page(&one).await.expect("reads").records;
    assert!(written[0].entry.get().contains("robot.remove"), "{}", written[0].entry.get());
    assert_eq!(code(fleet.desired(&robots[5]).await), "not_found");
    // The remaining robot goes on, and assignments that waited for the others wait no longer.
    fleet.follow(&mut robots[1], Phase::Running).await;
    assert_eq!(fleet.deployment(&id).await.state, task_proto::api::DeploymentState::Settled);
    let again = fleet.robots.remove_selected(&fleet.operator, None, &others).await;
    assert_eq!(code(again), "no_robots_match");
}

#[tokio::test(flavor = "multi_thread")]
async fn bulk_labels_and_removal_work_over_http() {
    let server = TestServer::start().await;
    let mut robots = Vec::new();
    for name in ["atlas", "boreas", "ceto"] {
        robots.push(server.enroll(name).await);
    }
    let label = json!({ "selector": "!ceto", "set": { "site": "lab" }, "dry_run": true });
    let planned: MatchedRobots = server.post("/api/v1/bulk/labels", &label).await;
    assert_eq!(planned.robots.len(), 2);
    let list: RobotList = server.get("/api/v1/robots?selector=site=lab").await;
    assert!(list.robots.is_empty(), "a dry run changes nothing");
    let label = json!({ "selector": "!ceto", "set": { "site": "lab" } });
    let _: MatchedRobots = server.post("/api/v1/bulk/labels", &label).await;
    let list: RobotList = server.get("/api/v1/robots?selector=site=lab").await;
    assert_eq!(list.robots.len(), 2);
    let remove = json!({ "selector": "site=lab,!boreas" });
    let removed: MatchedRobots = server.post("/api/v1/bulk/remove", &remove).await;
    assert_eq!(
        removed.robots.iter().map(|robot| robot.name.as_str()).collect::<Vec<_>>(),
        ["atlas"]
    );
    assert_eq!(server.ask_desired(&robots[0]).await.status(), 401);
    assert_eq!(server.ask_desired(&robots[1]).await.status(), 200);
    let refused = server.request(Method::POST, "/api/v1/bulk/remove").json(&remove);
    assert_eq!(refusal(refused).await, (409, "no_robots_match".to_owned()));
    let misspelt = json!({ "selector": "*", "sets": {} });
    let refused = server.request(Method::POST, "/api/v1/bulk/labels").json(&misspelt);
    assert_eq!(refusal(refused).await, (400, "invalid_request".to_owned()));
}

#[tokio::test(flavor = "multi_thread")]
async fn tasks_are_restarted_retried_and_rolled_back_over_http() {
    let server = TestServer::start().await;
    let mut robot = server.enroll("atlas").await;
    let old = server.push("talker", "1.0.0").await;
    server.deploy(&old, "*", "old").await;
    let state = server.desired(&robot).await;
    server.report(&mut robot, &state, Phase::Running).await;
    let new = server.push("talker", "2.0.0").await;
    let failed = server.deploy(&new, "*", "new").await;
    let state = server.desired(&robot).await;
    server.report(&mut robot, &state, Phase::Failed).await;

    let restart =
        server.order("/api/v1/tasks/talker/restart", "restart", &json!({ "selector": "*" }));
    let restarted: MatchedRobots = answer(restart).await;
    assert_eq!(restarted.robots.len(), 1);
    assert_eq!(server.desired(&robot).await.tasks[0].run, 2);
    let state = server.desired(&robot).await;
    server.report(&mut robot, &state, Phase::Failed).await;

    let path = format!("/api/v1/deployments/{}/retry", failed.id);
    let keyless = server.request(Method::POST, &path).json(&json!({}));
    assert_eq!(refusal(keyless).await, (400, "invalid_request".to_owned()));
    let planned: MatchedRobots = server.post(&path, &json!({ "dry_run": true })).await;
    assert_eq!(planned.robots.len(), 1);
    let other = server.order(&path, "other", &json!({ "code": "disk_full" }));
    assert_eq!(refusal(other).await, (409, "nothing_to_retry".to_owned()));
    let retried: DeploymentView = answer(server.order(&path, "retry", &json!({}))).await;
    assert_eq!((retried.assignments.expect("asked for").len(), &retried.package), (1, &new));

    let path = "/api/v1/tasks/talker/rollback";
    let body = json!({ "selector": "atlas" });
    let planned: task_proto::api::RolledBack =
        server.post(path, &json!({ "selector": "atlas", "dry_run": true })).await;
    assert_eq!((planned.deployments.len(), planned.robots.len(), planned.without.len()), (0, 1, 0));
    let back: task_proto::api::RolledBack = answer(server.order(path, "back", &body)).await;
    assert_eq!(back.deployments[0].package, old);
    assert_eq!(server.desired(&robot).await.tasks[0].package, old);
    let again: task_proto::api::RolledBack = answer(server.order(path, "back", &body)).await;
    assert_eq!(again.deployments[0].id, back.deployments[0].id);
}
