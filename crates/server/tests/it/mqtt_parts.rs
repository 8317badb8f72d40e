//! A package's parts, fanned out over real TCP: to whom they are granted, as long as they are, no faster than they listen.

use bytes::Bytes;
use task_proto::topic::{Topic, TopicPrefix};
use task_proto::{Digest, RobotId};
use taskd::broker::{FanOut, FanOutError, MAX_PART_BYTES};

use crate::mqtt_harness::{Raw, TestBroker, publish, subscribe, unsubscribe};

fn name_of(digest: Digest) -> String {
    TopicPrefix::default().format(&Topic::Package(digest))
}

/// A subscription to a package, and how it is answered.
async fn listen(raw: &mut Raw, digest: Digest, code: u8) {
    raw.send(&subscribe(9, &[(&name_of(digest), 1)])).await;
    raw.expect(&[0x90, 3, 0, 9, code]).await;
}

/// The part comes as the session's message with this packet id.
async fn hear(raw: &mut Raw, digest: Digest, id: u8, part: &str) {
    raw.expect(&publish(&name_of(digest), 1, id.into(), part.as_bytes())).await;
}

async fn acknowledge(raw: &mut Raw, id: u8) {
    raw.send(&[0x40, 2, 0, id]).await;
}

async fn send(fan_out: &mut FanOut, part: &str) {
    fan_out.publish(Bytes::copy_from_slice(part.as_bytes())).await.expect("sent");
}

#[tokio::test(flavor = "multi_thread")]
async fn parts_are_heard_by_whom_they_are_granted_to_and_only_as_long() {
    let broker = TestBroker::start().await;
    let robots: Vec<RobotId> = (0..3).map(|_| RobotId::random()).collect();
    let (digest, other) = (Digest::of(b"package"), Digest::of(b"other"));
    let mut operator = broker.operator("taskd/v1/#", 1).await;
    let (mut one, mut two, mut three) =
        (broker.robot(&robots[0]).await, broker.robot(&robots[1]).await, broker.robot(&robots[2]).await);
    listen(&mut one, digest, 0x80).await;

    let mut fan_out = broker.broker.fan_out(digest, robots[..2].to_vec()).expect("room");
    let again = broker.broker.fan_out(digest, Vec::new()).err();
    assert_eq!(again, Some(FanOutError::UnderWay(digest)));
    assert_eq!(
        fan_out.publish(vec![0; MAX_PART_BYTES + 1].into()).await,
        Err(FanOutError::TooLarge(MAX_PART_BYTES + 1))
    );
    send(&mut fan_out, "unheard").await;
    listen(&mut one, digest, 1).await;
    listen(&mut two, digest, 1).await;
    listen(&mut three, digest, 0x80).await;
    listen(&mut one, other, 0x80).await;
    assert_eq!(fan_out.listeners(), 2);
    for number in 1..=40 {
        send(&mut fan_out, &format!("part {number}")).await;
        for raw in [&mut one, &mut two] {
            hear(raw, digest, number, &format!("part {number}")).await;
            acknowledge(raw, number).await;
        }
    }

    fan_out.withdraw(&robots[1]);
    send(&mut fan_out, "late").await;
    hear(&mut one, digest, 41, "late").await;
    acknowledge(&mut one, 41).await;
    two.expect_nothing().await;
    listen(&mut two, digest, 0x80).await;
    assert_eq!(fan_out.listeners(), 1);

    // Who leaves, or whose grant ends with the fan-out, hears the next one only by asking again.
    one.send(&unsubscribe(7, &[&name_of(digest)])).await;
    one.expect(&[0xb0, 2, 0, 7]).await;
    assert_eq!(fan_out.listeners(), 0);
    listen(&mut one, digest, 1).await;
    drop(fan_out);
    listen(&mut one, digest, 0x80).await;
    let mut fan_out = broker.broker.fan_out(digest, robots.clone()).expect("room");
    send(&mut fan_out, "again").await;
    listen(&mut three, digest, 1).await;
    send(&mut fan_out, "and on").await;
    hear(&mut three, digest, 1, "and on").await;
    for raw in [&mut one, &mut two, &mut operator] {
        raw.expect_nothing().await;
    }
    drop(three);
    let fan_outs: Vec<_> = (0u8..).map_while(|n| broker.broker.fan_out(Digest::of(&[n]), Vec::new()).ok()).collect();
    assert_eq!(fan_outs.len(), 3, "four at a time");
    broker.assert_serves().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_robot_that_is_slow_holds_the_parts_back_and_one_that_goes_lets_them_go() {
    let broker = TestBroker::with(|limits| limits.max_part_listeners = 2).await;
    let robots: Vec<RobotId> = (0..3).map(|_| RobotId::random()).collect();
    let digest = Digest::of(b"package");
    let mut fan_out = broker.broker.fan_out(digest, robots.clone()).expect("room");
    let (mut quick, mut slow, mut third) =
        (broker.robot(&robots[0]).await, broker.robot(&robots[1]).await, broker.robot(&robots[2]).await);
    listen(&mut quick, digest, 1).await;
    listen(&mut slow, digest, 1).await;
    listen(&mut third, digest, 0x80).await;
    let publishing = tokio::spawn(async move {
        for number in 1..=100 {
            send(&mut fan_out, &format!("part {number}")).await;
        }
        fan_out
    });
    // 32 without an acknowledgement, and 8 that wait behind them.
    for number in 1..=40 {
        hear(&mut quick, digest, number, &format!("part {number}")).await;
        acknowledge(&mut quick, number).await;
    }
    quick.expect_nothing().await;
    assert!(!publishing.is_finished());
    for number in 1..=10 {
        hear(&mut slow, digest, number, &format!("part {number}")).await;
        acknowledge(&mut slow, number).await;
    }
    for number in 41..=50 {
        hear(&mut quick, digest, number, &format!("part {number}")).await;
        acknowledge(&mut quick, number).await;
    }
    quick.expect_nothing().await;
    drop(slow);
    for number in 51..=100 {
        hear(&mut quick, digest, number, &format!("part {number}")).await;
        acknowledge(&mut quick, number).await;
    }
    assert_eq!(publishing.await.expect("no panic").listeners(), 1);
}
