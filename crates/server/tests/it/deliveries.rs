//! How bytes travel to each robot, told on every database: the known facts decide, and the decision
//! is stored and shown.

use std::net::SocketAddr;

use task_proto::api::{DeliveryChoice, DeliveryDecision, EditRobot};
use task_proto::desired::{Delivery, DesiredTask};
use task_proto::messages::report::{LinkFacts, Phase};
use task_proto::packages::manifest::TaskKind;
use taskd::config::DeliverySettings;
use taskd::domain::delivery::{Condition, ConditionKey, Rule};

use crate::database::{TestDatabase, on_both_databases};
use crate::fleet::{Fleet, Robot, order_of, package, random_key};
use crate::story::refusal;

on_both_databases! {
    each_robot_gets_the_delivery_of_its_rule,
    robots_on_a_site_are_counted,
    delivery_is_decided_when_the_batch_begins,
    robot_with_the_content_lacks_no_bytes,
    ordered_delivery_and_priority_are_kept,
    inline_order_of_a_large_package_is_refused,
    assignment_without_decision_uses_the_delivery_of_the_order,
    inline_blobs_are_sent_until_the_robot_has_them,
    link_facts_are_kept_until_the_next_measurement,
    robot_awaits_parts_until_it_has_them_or_pulls,
}

/// A rule with one condition, named like it.
fn rule(key: &str, value: u64, mechanism: Delivery) -> Rule {
    let condition = match Condition::by_key(key).expect(key) {
        ConditionKey::Measure(quantity, comparison) => {
            Condition::Measure(quantity, comparison, value)
        }
        ConditionKey::Flag(flag) => Condition::Flag(flag, value == 1),
    };
    Rule { name: format!("own {key}"), conditions: vec![condition], mechanism }
}

fn settings(own_rules: Vec<Rule>) -> DeliverySettings {
    DeliverySettings { own_rules, ..DeliverySettings::default() }
}

async fn label(fleet: &Fleet, robot: &Robot, key: &str, value: &str) {
    let labels = [(key.parse().expect("a key"), value.parse().expect("a value"))].into();
    fleet
        .robots
        .edit(
            &fleet.operator,
            &robot.id,
            &EditRobot { labels: Some(labels), ..EditRobot::default() },
        )
        .await
        .expect("edited");
}

/// The decisions of a deployment by robot, shortly.
async fn decisions(
    fleet: &Fleet,
    id: &task_proto::DeploymentId,
) -> Vec<Option<(Delivery, String, String)>> {
    let assignments = fleet.deployment(id).await.assignments.expect("asked for");
    let short = |DeliveryDecision { mechanism, rule, because }| (mechanism, rule, because);
    assignments.into_iter().map(|assignment| assignment.delivery.map(short)).collect()
}

fn decision(mechanism: Delivery, rule: &str, because: &str) -> Option<(Delivery, String, String)> {
    Some((mechanism, rule.to_owned(), because.to_owned()))
}

async fn only_task(fleet: &Fleet, robot: &Robot) -> DesiredTask {
    fleet.desired(robot).await.expect("a state").tasks.remove(0)
}

async fn each_robot_gets_the_delivery_of_its_rule(database: TestDatabase) {
    let rules = vec![
        rule("metered", 1, Delivery::PushPull),
        rule("battery_below", 20, Delivery::Poll),
        rule("throughput_below", 1 << 20, Delivery::DirectPush),
        rule("reconnects_above", 3, Delivery::Poll),
        rule("connected", 1, Delivery::DirectPush),
        rule("transfers_at_least", 7, Delivery::Inline),
    ];
    let fleet = Fleet::with_delivery(database, &settings(rules)).await;
    let mut robots = fleet.enroll(6).await;
    robots.iter().for_each(|robot| fleet.go_offline(&robot.id));
    label(&fleet, &robots[0], "metered", "true").await;
    robots[1].battery_percent = Some(15);
    robots[2].link =
        Some(LinkFacts { throughput_bytes_per_s: Some(512 << 10), ..LinkFacts::default() });
    robots[3].link = Some(LinkFacts { reconnects: 4, rtt_ms: Some(30), ..LinkFacts::default() });
    for robot in &mut robots[1..4] {
        fleet.report(robot).await;
    }
    let address: SocketAddr = "10.0.0.4:1".parse().expect("an address");
    fleet.presence.connected(&robots[4].id, Some(address), 2, fleet.clock.now_ms());
    fleet.load.set(9, 0);
    let id = fleet.deploy("1", |_| ()).await;
    let expected = [
        decision(Delivery::PushPull, "own metered", "metered"),
        decision(Delivery::Poll, "own battery_below", "battery 15% < 20%"),
        decision(Delivery::DirectPush, "own throughput_below", "throughput 512 KB/s < 1 MB/s"),
        decision(Delivery::Poll, "own reconnects_above", "reconnects 4 > 3"),
        decision(Delivery::DirectPush, "own connected", "connected"),
        decision(Delivery::Inline, "own transfers_at_least", "transfers 9 ≥ 7, size 2 B ≤ 32 KB"),
    ];
    assert_eq!(decisions(&fleet, &id).await, expected);
    for (robot, expected) in robots.iter().zip(&expected) {
        let mechanism = expected.as_ref().map(|(mechanism, ..)| *mechanism);
        assert_eq!(Some(only_task(&fleet, robot).await.delivery), mechanism);
    }
    let rung = [0, 2, 4, 5].map(|robot: usize| robots[robot].id.clone());
    assert_eq!(
        fleet.changes.take_robots_to_notify().await.robots,
        rung.into(),
        "a polling robot gets no notice"
    );
    let inputs = fleet.database.inputs(&id, &robots[3].id).await;
    let expected = serde_json::json!({
        "size": 2, "lacking": 2, "robots": 6, "batch": 6, "connected": false, "metered": false,
        "rtt_ms": 30, "losses": 0, "reconnects": 4, "transfers": 9, "backlog": 0,
    });
    assert_eq!(serde_json::from_str::<serde_json::Value>(&inputs).expect("json"), expected);
}

async fn robots_on_a_site_are_counted(database: TestDatabase) {
    let fleet = Fleet::with_delivery(
        database,
        &settings(vec![rule("same_site_at_least", 2, Delivery::DirectPush)]),
    )
    .await;
    let robots = fleet.enroll(6).await;
    label(&fleet, &robots[0], "site", "hall").await;
    label(&fleet, &robots[1], "site", "hall").await;
    // The label wins over the network, which the two in it without a label share.
    for (robot, address) in
        [(1, "10.0.7.1:5"), (2, "10.0.7.2:5"), (3, "10.0.7.3:5"), (4, "10.0.8.1:5")]
    {
        let address: SocketAddr = address.parse().expect("an address");
        fleet.presence.seen(&robots[robot].id, address, fleet.clock.now_ms());
    }
    let id = fleet.deploy("1", |order| order.batch = Some(3)).await;
    let together = decision(Delivery::DirectPush, "own same_site_at_least", "robots on site 2 ≥ 2");
    let decided = decisions(&fleet, &id).await;
    assert_eq!(decided, [together.clone(), together.clone(), together.clone(), None, None, None]);
    let id = fleet.deploy("2", |_| ()).await;
    let decided = decisions(&fleet, &id).await;
    assert_eq!(decided[3], together);
    let alone = decision(Delivery::Inline, "tiny", "size 2 B ≤ 32 KB");
    assert_eq!(decided[4..], [alone.clone(), alone]);
}

async fn delivery_is_decided_when_the_batch_begins(database: TestDatabase) {
    let fleet =
        Fleet::with_delivery(database, &settings(vec![rule("losses_above", 2, Delivery::Poll)]))
            .await;
    let mut robots = fleet.enroll(2).await;
    let id = fleet.deploy("1", |order| order.batch = Some(1)).await;
    let tiny = decision(Delivery::Inline, "tiny", "size 2 B ≤ 32 KB");
    assert_eq!(decisions(&fleet, &id).await, [tiny.clone(), None]);
    robots[1].link = Some(LinkFacts { losses: 5, ..LinkFacts::default() });
    fleet.report(&mut robots[1]).await;
    // A decision stays, regardless of later measurements.
    robots[0].link = Some(LinkFacts { losses: 9, ..LinkFacts::default() });
    fleet.follow(&mut robots[0], Phase::Running).await;
    assert_eq!(
        decisions(&fleet, &id).await,
        [tiny, decision(Delivery::Poll, "own losses_above", "losses 5 > 2")]
    );
}

async fn robot_with_the_content_lacks_no_bytes(database: TestDatabase) {
    let fleet =
        Fleet::with_delivery(database, &settings(vec![rule("lacking_at_most", 0, Delivery::Poll)]))
            .await;
    let mut robots = fleet.enroll(3).await;
    let id = fleet.deploy("1", |_| ()).await;
    assert_eq!(
        decisions(&fleet, &id).await,
        vec![decision(Delivery::Inline, "tiny", "size 2 B ≤ 32 KB"); 3]
    );
    fleet.follow(&mut robots[0], Phase::Running).await;
    fleet.follow(&mut robots[1], Phase::Fetching).await;
    let again = fleet.deploy("1", |order| order.restart = true).await;
    let decided = decisions(&fleet, &again).await;
    assert_eq!(decided[0], decision(Delivery::Poll, "own lacking_at_most", "lacking 0 B ≤ 0 B"));
    let tiny = decision(Delivery::Inline, "tiny", "size 2 B ≤ 32 KB");
    assert_eq!(decided[1..], [tiny.clone(), tiny], "one has begun only, one has nothing");
}

async fn ordered_delivery_and_priority_are_kept(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let robots = fleet.enroll(1).await;
    for (version, choice) in [
        ("1", DeliveryChoice::DirectPush),
        ("2", DeliveryChoice::Poll),
        ("3", DeliveryChoice::Inline),
    ] {
        let id = fleet.deploy(version, |order| {
            order.delivery = choice;
            order.priority = 7;
        });
        let id = id.await;
        let mechanism = choice.mechanism().expect("not adaptive");
        let because = format!("the order says {mechanism}");
        assert_eq!(decisions(&fleet, &id).await, [decision(mechanism, "ordered", &because)]);
        let task = only_task(&fleet, &robots[0]).await;
        assert_eq!((task.delivery, task.priority), (mechanism, 7));
        let view = fleet.deployment(&id).await;
        assert_eq!((view.delivery, view.priority), (choice, 7));
    }
    for priority in [-101, 101, i32::MAX] {
        let mut order = order_of(&package("4", TaskKind::Service));
        order.priority = priority;
        let refused = fleet
            .deployments
            .create(&fleet.operator, &random_key(), &order, &package("4", TaskKind::Service))
            .await;
        let error = refused.expect_err("refused");
        assert_eq!(error.to_string(), format!("priority: expected -100 to 100, not {priority}"));
    }
}

async fn inline_order_of_a_large_package_is_refused(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    fleet.enroll(1).await;
    let mut large = package("1", TaskKind::Service);
    large.package.content.size = 10_171_187;
    let mut order = order_of(&large);
    order.delivery = DeliveryChoice::Inline;
    let refused = fleet.deployments.create(&fleet.operator, &random_key(), &order, &large).await;
    let error = refusal(refused);
    assert_eq!(error.message, "delivery: talker 1 has 9.7 MB, inline carries at most 32 KB");
    assert_eq!(error.code, "package_too_large");
    // One byte too many, which the config brings.
    large.package.content.size = 32 << 10;
    let refused = fleet.deployments.create(&fleet.operator, &random_key(), &order, &large).await;
    let message = refused.expect_err("refused").to_string();
    assert_eq!(message, "delivery: talker 1 has 32769 B, inline carries at most 32768 B");
    order.delivery = DeliveryChoice::Adaptive;
    let id = fleet
        .deployments
        .create(&fleet.operator, &random_key(), &order, &large)
        .await
        .expect("ordered");
    let because = "size 32769 B > 32768 B";
    assert_eq!(decisions(&fleet, &id).await, [decision(Delivery::PushPull, "otherwise", because)]);
}

async fn assignment_without_decision_uses_the_delivery_of_the_order(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let robots = fleet.enroll(1).await;
    let id = fleet.deploy("1", |order| order.delivery = DeliveryChoice::Poll).await;
    fleet.database.forget_decisions().await;
    assert_eq!(only_task(&fleet, &robots[0]).await.delivery, Delivery::Poll);
    assert_eq!(decisions(&fleet, &id).await, [None]);
}

async fn inline_blobs_are_sent_until_the_robot_has_them(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let mut robots = fleet.enroll(1).await;
    let riding = async |robot: &Robot| {
        fleet.desired_states.get(&robot.id).await.expect("a state").bundled_blobs
    };
    let package = |version| package(version, TaskKind::Service).package;
    for (version, choice, expected) in [
        ("1", DeliveryChoice::Inline, vec![package("1").config, package("1").content]),
        ("2", DeliveryChoice::DirectPush, vec![package("2").config]),
        ("3", DeliveryChoice::PushPull, vec![]),
        ("4", DeliveryChoice::Poll, vec![]),
    ] {
        fleet.deploy(version, |order| order.delivery = choice).await;
        assert_eq!(riding(&robots[0]).await, expected, "{version}");
        fleet.follow(&mut robots[0], Phase::Fetching).await;
        assert_eq!(riding(&robots[0]).await, expected, "{version}");
        fleet.follow(&mut robots[0], Phase::Running).await;
        assert_eq!(riding(&robots[0]).await, [], "{version}: it has all there is");
    }
}

async fn link_facts_are_kept_until_the_next_measurement(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let mut robots = fleet.enroll(1).await;
    let link =
        LinkFacts { throughput_bytes_per_s: Some(9), rtt_ms: Some(2), reconnects: 1, losses: 0 };
    robots[0].link = Some(link);
    robots[0].battery_percent = Some(50);
    fleet.report(&mut robots[0]).await;
    let view = fleet.view(&robots[0]).await;
    assert_eq!(
        (view.link, view.host.and_then(|host| host.battery_percent)),
        (Some(link), Some(50))
    );
    // The agent starts again and has measured nothing yet.
    robots[0].link = None;
    fleet.report(&mut robots[0]).await;
    assert_eq!(fleet.view(&robots[0]).await.link, Some(link));
    let newer = LinkFacts { losses: 3, ..link };
    robots[0].link = Some(newer);
    fleet.report(&mut robots[0]).await;
    assert_eq!(fleet.view(&robots[0]).await.link, Some(newer));
}

async fn robot_awaits_parts_until_it_has_them_or_pulls(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let mut robots = fleet.enroll(2).await;
    let content = package("1", TaskKind::Service).package.content.digest;
    let id = fleet.deploy("1", |order| order.delivery = DeliveryChoice::DirectPush).await;
    let store = fleet.database.store.clone();
    let waiting = async || store.fan_outs().awaiting_parts(&content).await.expect("read");
    let part = |robot: &Robot| (id.clone(), robot.id.clone());
    assert_eq!(waiting().await, [part(&robots[0]), part(&robots[1])]);
    fleet.follow(&mut robots[0], Phase::Running).await;
    assert_eq!(waiting().await, [part(&robots[1])]);
    let generation = fleet.desired(&robots[1]).await.expect("a state").generation;
    // A robot that has all of the parts is left alone, for any request.
    let both = [part(&robots[0]), part(&robots[1])];
    for _ in 0..2 {
        fleet
            .deployments
            .switch_to_pull(&both, "the robot held up the others")
            .await
            .expect("ordered");
    }
    assert_eq!(fleet.desired(&robots[1]).await.expect("a state").generation.0, generation.0 + 1);
    let told = decision(Delivery::PushPull, "fell behind", "the robot held up the others");
    let ordered = decision(Delivery::DirectPush, "ordered", "the order says direct-push");
    assert_eq!(decisions(&fleet, &id).await, [ordered, told]);
    assert_eq!(
        (waiting().await, store.fan_outs().list().await.expect("read").len()),
        (Vec::new(), 0)
    );
}
