//! A package's parts, fanned out over real TCP: to the clients with a grant, for the duration of
//! the grant, no faster than they receive.

use bytes::Bytes;
use rumqttc::{AsyncClient, Event, MqttOptions, Packet, QoS, SubscribeReasonCode};
use task_proto::messages::topic::{Topic, TopicPrefix};
use task_proto::{Digest, RobotId};
use taskd::broker::{FanOut, FanOutError, FanOutSettings, MAX_PART_BYTES, Part, PartQos};
use tokio::io::AsyncReadExt;
use tokio::sync::Notify;
use tokio::time::timeout;

use crate::mqtt_harness::{PATIENCE, Raw, TestBroker, publish, subscribe, unsubscribe};

fn name_of(digest: Digest) -> String {
    TopicPrefix::default().format(&Topic::Package(digest))
}

/// A subscription to a package, and its expected answer.
async fn subscribe_to(raw: &mut Raw, digest: Digest, code: u8) {
    raw.send(&subscribe(9, &[(&name_of(digest), 1)])).await;
    raw.expect(&[0x90, 3, 0, 9, code]).await;
}

/// The part comes as the session's message with this packet id.
async fn expect_part(raw: &mut Raw, digest: Digest, id: u8, part: &str) {
    raw.expect(&publish(&name_of(digest), 1, id.into(), part.as_bytes())).await;
}

async fn acknowledge(raw: &mut Raw, id: u8) {
    raw.send(&[0x40, 2, 0, id]).await;
}

fn settings(part_bytes: usize, qos: PartQos) -> FanOutSettings {
    FanOutSettings { part_bytes, qos }
}

fn begin(broker: &TestBroker, digest: Digest, robots: &[RobotId]) -> Result<FanOut, FanOutError> {
    broker.broker.fan_out(digest, settings(64 * 1024, PartQos::AtLeastOnce), robots.to_vec())
}

fn part(text: &str) -> Part {
    let (header, bytes) = text.split_at(text.len() / 2);
    Part {
        header: Bytes::copy_from_slice(header.as_bytes()),
        bytes: Bytes::copy_from_slice(bytes.as_bytes()),
    }
}

async fn send(fan_out: &mut FanOut, part: &str) {
    fan_out.publish(self::part(part)).await.expect("sent");
}

#[tokio::test(flavor = "multi_thread")]
async fn parts_reach_only_robots_with_a_grant() {
    let broker = TestBroker::start().await;
    let robots: Vec<RobotId> = (0..3).map(|_| RobotId::random()).collect();
    let (digest, other) = (Digest::of(b"package"), Digest::of(b"other"));
    let mut operator = broker.operator("taskd/v1/#", 1).await;
    let (mut one, mut two, mut three) = (
        broker.robot(&robots[0]).await,
        broker.robot(&robots[1]).await,
        broker.robot(&robots[2]).await,
    );
    subscribe_to(&mut one, digest, 0x80).await;

    let mut fan_out = begin(&broker, digest, &robots[..2]).expect("room");
    let again = begin(&broker, digest, &[]).err();
    assert_eq!(again, Some(FanOutError::AlreadyRunning(digest)));
    let too_large =
        Part { header: Bytes::from_static(b"h"), bytes: vec![0; MAX_PART_BYTES].into() };
    assert_eq!(fan_out.publish(too_large).await, Err(FanOutError::TooLarge(MAX_PART_BYTES + 1)));
    send(&mut fan_out, "unheard").await;
    subscribe_to(&mut one, digest, 1).await;
    subscribe_to(&mut two, digest, 1).await;
    subscribe_to(&mut three, digest, 0x80).await;
    subscribe_to(&mut one, other, 0x80).await;
    assert_eq!(fan_out.subscribers(), 2);
    for number in 1..=40 {
        send(&mut fan_out, &format!("part {number}")).await;
        for raw in [&mut one, &mut two] {
            expect_part(raw, digest, number, &format!("part {number}")).await;
            acknowledge(raw, number).await;
        }
    }

    fan_out.withdraw(&robots[1]);
    send(&mut fan_out, "late").await;
    expect_part(&mut one, digest, 41, "late").await;
    acknowledge(&mut one, 41).await;
    two.expect_nothing().await;
    subscribe_to(&mut two, digest, 0x80).await;
    assert_eq!(fan_out.subscribers(), 1);

    // A client that leaves, or whose grant ends with the fan-out, receives the next one only by
    // subscribing again.
    one.send(&unsubscribe(7, &[&name_of(digest)])).await;
    one.expect(&[0xb0, 2, 0, 7]).await;
    assert_eq!(fan_out.subscribers(), 0);
    subscribe_to(&mut one, digest, 1).await;
    drop(fan_out);
    subscribe_to(&mut one, digest, 0x80).await;
    let mut fan_out = begin(&broker, digest, &robots).expect("room");
    send(&mut fan_out, "again").await;
    subscribe_to(&mut three, digest, 1).await;
    send(&mut fan_out, "and on").await;
    expect_part(&mut three, digest, 1, "and on").await;
    for raw in [&mut one, &mut two, &mut operator] {
        raw.expect_nothing().await;
    }
    drop(three);
    let fan_outs: Vec<_> =
        (0u8..).map_while(|n| begin(&broker, Digest::of(&[n]), &[]).ok()).collect();
    assert_eq!(fan_outs.len(), 3, "four at a time");
    broker.assert_serves().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn withdrawn_subscription_is_no_longer_listed() {
    let broker = TestBroker::start().await;
    let (robot, digest) = (RobotId::random(), Digest::of(b"package"));
    let mut raw = broker.robot(&robot).await;
    let unlisted = async || {
        while !broker.broker.subscriptions_of(&robot).is_empty() {
            tokio::task::yield_now().await;
        }
    };
    for round in 0..50 {
        let fan_out = begin(&broker, digest, std::slice::from_ref(&robot)).expect("room");
        subscribe_to(&mut raw, digest, 1).await;
        assert_eq!(broker.broker.subscriptions_of(&robot).len(), 1);
        if round % 2 == 0 {
            fan_out.withdraw(&robot);
        } else {
            // The client subscribes again while its permission ends: either may come first.
            raw.send(&subscribe(9, &[(&name_of(digest), 1)])).await;
            fan_out.withdraw(&robot);
            let mut answer = [0; 5];
            raw.stream.read_exact(&mut answer).await.expect("an answer");
            assert_eq!(&answer[..4], &[0x90, 3, 0, 9]);
        }
        timeout(PATIENCE, unlisted()).await.expect("it is listed no longer");
    }
}

/// Receives part `number`, which is the session's message of that packet id, and acknowledges it.
async fn take(raw: &mut Raw, digest: Digest, number: u8) {
    expect_part(raw, digest, number, &format!("part {number}")).await;
    acknowledge(raw, number).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn slow_subscriber_delays_parts_until_it_leaves() {
    let broker = TestBroker::start().await;
    let robots: Vec<RobotId> = (0..2).map(|_| RobotId::random()).collect();
    let digest = Digest::of(b"package");
    let mut fan_out = begin(&broker, digest, &robots).expect("room");
    let (mut quick, mut slow) = (broker.robot(&robots[0]).await, broker.robot(&robots[1]).await);
    subscribe_to(&mut quick, digest, 1).await;
    subscribe_to(&mut slow, digest, 1).await;
    let publishing = tokio::spawn(async move {
        for number in 1..=100 {
            send(&mut fan_out, &format!("part {number}")).await;
        }
        fan_out.settle(PATIENCE).await;
        fan_out
    });
    for number in 1..=24 {
        take(&mut quick, digest, number).await;
    }
    quick.expect_nothing().await;
    assert!(!publishing.is_finished());
    for number in 1..=10 {
        take(&mut slow, digest, number).await;
    }
    for number in 25..=34 {
        take(&mut quick, digest, number).await;
    }
    quick.expect_nothing().await;
    drop(slow);
    for number in 35..=100 {
        take(&mut quick, digest, number).await;
    }
    let fan_out = publishing.await.expect("no panic");
    assert_eq!((fan_out.subscribers(), fan_out.take_evicted()), (1, Vec::new()));
}

#[tokio::test(flavor = "multi_thread")]
async fn stalled_subscriber_is_evicted_and_the_queue_stays_bounded() {
    const PART_BYTES: usize = 128 * 1024;
    let broker = TestBroker::start().await;
    let robots: Vec<RobotId> = (0..3).map(|_| RobotId::random()).collect();
    let digest = Digest::of(b"package");
    let mut fan_out = broker
        .broker
        .fan_out(digest, settings(PART_BYTES, PartQos::AtLeastOnce), robots.clone())
        .expect("room");
    let mut raws = Vec::new();
    for robot in &robots {
        raws.push(broker.robot(robot).await);
    }
    for raw in &mut raws {
        subscribe_to(raw, digest, 1).await;
    }
    let stalled = raws.pop();
    let receiving: Vec<_> = raws
        .into_iter()
        .map(|mut raw| {
            tokio::spawn(async move {
                for number in 1..=200 {
                    raw.expect_large(&publish(
                        &name_of(digest),
                        1,
                        number.into(),
                        &vec![number; PART_BYTES],
                    ))
                    .await;
                    acknowledge(&mut raw, number).await;
                }
                raw
            })
        })
        .collect();
    for number in 1..=200 {
        let bytes = vec![number; PART_BYTES].into();
        fan_out.publish(Part { header: Bytes::new(), bytes }).await.expect("sent");
        // The window, however many subscribe and however slow they are.
        assert!(broker.broker.queued_part_bytes() <= 24 * PART_BYTES);
    }
    let mut raws = Vec::new();
    for receiving in receiving {
        raws.push(receiving.await.expect("received all"));
    }
    assert_eq!((fan_out.take_evicted(), fan_out.subscribers()), (vec![robots[2].clone()], 2));
    drop(fan_out);
    assert_eq!(broker.broker.queued_part_bytes(), 0);
    drop(stalled);
    broker.assert_serves().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn parts_use_the_lower_qos_of_both_sides() {
    let broker = TestBroker::start().await;
    let robot = RobotId::random();
    let digest = Digest::of(b"package");
    let (unsure, sure, exact) = (PartQos::AtMostOnce, PartQos::AtLeastOnce, PartQos::ExactlyOnce);
    for (ours, its, expected) in
        [(unsure, 2, 0), (sure, 0, 0), (sure, 2, 1), (exact, 1, 1), (exact, 2, 2)]
    {
        let mut fan_out =
            broker.broker.fan_out(digest, settings(16, ours), vec![robot.clone()]).expect("room");
        let mut raw = broker.robot(&robot).await;
        raw.send(&subscribe(9, &[(&name_of(digest), its)])).await;
        raw.expect(&[0x90, 3, 0, 9, its]).await;
        let receiving = tokio::spawn(async move {
            for number in 1..=100 {
                raw.expect(&publish(&name_of(digest), expected, number, b"sixteen bytes ok")).await;
                let id = number as u8;
                match expected {
                    0 => {}
                    1 => acknowledge(&mut raw, id).await,
                    _ => {
                        raw.send(&[0x50, 2, 0, id]).await;
                        raw.expect(&[0x62, 2, 0, id]).await;
                        raw.send(&[0x70, 2, 0, id]).await;
                    }
                }
            }
            raw
        });
        for _ in 0..100 {
            send(&mut fan_out, "sixteen bytes ok").await;
            fan_out.settle(PATIENCE).await;
        }
        receiving.await.expect("received all");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn whole_package_is_one_shared_message() {
    let broker = TestBroker::start().await;
    let robots: Vec<RobotId> = (0..4).map(|_| RobotId::random()).collect();
    let digest = Digest::of(b"package");
    let bytes: Bytes =
        (0..48 * 1024 * 1024_u32).map(|at| (at % 251) as u8).collect::<Vec<u8>>().into();
    let settings = settings(bytes.len() + 1, PartQos::AtLeastOnce);
    let mut fan_out = broker.broker.fan_out(digest, settings, robots.clone()).expect("room");
    let mut receiving = Vec::new();
    for robot in &robots {
        let mut raw = broker.robot(robot).await;
        subscribe_to(&mut raw, digest, 1).await;
        let expected = publish(&name_of(digest), 1, 1, &[b"h", &bytes[..]].concat());
        receiving.push(tokio::spawn(async move {
            raw.expect_large(&expected).await;
            acknowledge(&mut raw, 1).await;
            raw
        }));
    }
    fan_out
        .publish(Part { header: Bytes::from_static(b"h"), bytes: bytes.clone() })
        .await
        .expect("sent");
    assert_eq!(broker.broker.queued_part_bytes(), bytes.len() + 1, "once, for all");
    fan_out.settle(PATIENCE).await;
    for receiving in receiving {
        receiving.await.expect("received all").expect_nothing().await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn independent_client_receives_all_parts_in_order_at_each_qos() {
    const PARTS: u32 = 300;
    let (broker, subscribed) = (TestBroker::start().await, Notify::new());
    for (ours, its) in [
        (PartQos::AtMostOnce, QoS::AtMostOnce),
        (PartQos::AtLeastOnce, QoS::AtLeastOnce),
        (PartQos::ExactlyOnce, QoS::ExactlyOnce),
    ] {
        let (robot, digest) = (RobotId::random(), Digest::of(b"package"));
        let mut fan_out =
            broker.broker.fan_out(digest, settings(8192, ours), vec![robot.clone()]).expect("room");
        let mut options = MqttOptions::new(robot.as_str(), "127.0.0.1", broker.address().port());
        options.set_credentials(robot.as_str(), format!("pw-{robot}"));
        let (client, mut events) = AsyncClient::new(options, 10);
        client.subscribe(name_of(digest), its).await.expect("queued");
        let receiving = async {
            let mut received = 0;
            while received < PARTS {
                match events.poll().await.expect("connected") {
                    Event::Incoming(Packet::Publish(part)) => {
                        assert_eq!(
                            (part.qos, &part.payload[..4]),
                            (its, &received.to_be_bytes()[..])
                        );
                        received += 1;
                    }
                    Event::Incoming(Packet::SubAck(ack)) => {
                        assert_eq!(ack.return_codes, [SubscribeReasonCode::Success(its)]);
                        subscribed.notify_one();
                    }
                    _ => {}
                }
            }
        };
        let publishing = async {
            subscribed.notified().await;
            for number in 0..PARTS {
                let header = Bytes::copy_from_slice(&number.to_be_bytes());
                fan_out.publish(Part { header, bytes: vec![0; 8000].into() }).await.expect("sent");
            }
        };
        timeout(PATIENCE, async { tokio::join!(receiving, publishing) })
            .await
            .expect("all should arrive");
    }
}
