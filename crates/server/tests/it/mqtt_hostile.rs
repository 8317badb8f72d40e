//! Hostile clients of the broker: malformed, oversized, endless, rude and random bytes. After each
//! case a healthy robot and a healthy operator still get through.

use std::time::Duration;

use proptest::prelude::*;
use proptest::test_runner::{Config, TestRunner};
use task_proto::RobotId;
use task_proto::messages::topic::RobotTopic;
use taskd::broker::Limits;
use tokio::io::AsyncReadExt;
use tokio::time::timeout;

use crate::mqtt_harness::{
    Connect, PATIENCE, Raw, TestBroker, binary, framed, publish, subscribe, text, topic,
    unsubscribe,
};

/// CONNECT with any protocol name, level and flags.
fn connect(name: &[u8], level: u8, flags: u8, fields: &[u8]) -> Vec<u8> {
    let mut body = binary(name);
    body.extend([level, flags, 0, 0]);
    body.extend(fields);
    framed(0x10, &body)
}

/// Closes with a reset instead of a goodbye.
fn reset(raw: Raw) {
    raw.stream.set_zero_linger().unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn invalid_connect_is_not_answered() {
    let broker = TestBroker::start().await;
    let id = text("somebody");
    let credentials = [text("somebody"), text("user"), text("operator")].concat();
    let cases = [
        vec![0x00, 0],
        vec![0xf0, 0],
        vec![0xc0, 0],
        vec![0x20, 2, 0, 0],
        vec![0x10, 0xff, 0xff, 0xff, 0xff],
        vec![0x10, 0xff, 0xff, 0xff, 0xff, 0x01],
        vec![0x10, 0xff, 0xff, 0xff, 0x7f],
        vec![0x10, 0],
        b"GET / HTTP/1.1\r\n\r\n".to_vec(),
        subscribe(1, &[("#", 0)]),
        connect(b"MQTX", 4, 2, &id),
        connect(b"", 4, 2, &id),
        connect(b"\xff\xfe", 4, 2, &id),
        connect(b"MQTT", 4, 3, &id),
        connect(b"MQTT", 4, 0b0000_1010, &id),
        connect(b"MQTT", 4, 0b0010_0010, &id),
        connect(b"MQTT", 4, 0b0001_1110, &[&id[..], &text("t"), &text("m")].concat()),
        connect(b"MQTT", 4, 0b0100_0010, &[&id[..], &text("p")].concat()),
        connect(b"MQTT", 4, 0b1100_0010, &[&credentials[..], b"x"].concat()),
        connect(b"MQTT", 4, 0b1100_0010, &id),
        connect(b"MQTT", 4, 2, &binary(b"\xc3\x28")),
        connect(b"MQTT", 4, 2, &binary(b"a\0b")),
        connect(b"MQTT", 4, 2, &binary(b"\xed\xa0\x80")),
        connect(b"MQTT", 4, 2, &[0xff, 0xff, b'x']),
        connect(b"MQTT", 4, 0b0000_0110, &[&id[..], &text("a/#"), &text("m")].concat()),
        [&connect(b"MQTT", 4, 2, &id)[..1], &connect(b"MQTT", 4, 2, &vec![0; 5000])[1..]].concat(),
    ];
    for packet in cases {
        let mut raw = broker.raw_with(&packet).await;
        raw.expect_close().await;
    }
    for (name, level) in [(&b"MQTT"[..], 3), (b"MQTT", 5), (b"MQTT", 0x84), (b"MQIsdp", 3)] {
        let mut raw = broker.raw_with(&connect(name, level, 2, &id)).await;
        raw.expect(&[0x20, 2, 0, 1]).await;
        raw.expect_close().await;
    }
    broker.assert_serves().await;
}

/// Every packet that a session must not survive.
fn violations(robot: &RobotId) -> Vec<Vec<u8>> {
    let (own, report) = (topic(robot, RobotTopic::Desired), topic(robot, RobotTopic::Report));
    let with_first = |first: u8, mut packet: Vec<u8>| {
        packet[0] = first;
        packet
    };
    let mut cases = vec![
        Connect::robot(robot).packet(),
        vec![0x00, 0],
        vec![0xf0, 0],
        vec![0x20, 2, 0, 0],
        vec![0x90, 3, 0, 1, 0],
        vec![0xb0, 2, 0, 1],
        vec![0xd0, 0],
        vec![0xc0, 1, 0],
        vec![0xc1, 0],
        vec![0xe0, 1, 0],
        vec![0xe1, 0],
        vec![0x40, 2, 0, 0],
        vec![0x40, 1, 0],
        vec![0x40, 3, 0, 1, 0],
        vec![0x41, 2, 0, 1],
        vec![0x60, 2, 0, 1],
        vec![0x30, 0],
        vec![0x30, 0xff, 0xff, 0xff, 0xff, 1],
        vec![0x30, 0xff, 0xff, 0xff, 0x7f],
        framed(0x30, &[0, 9, b'x']),
        with_first(0x36, publish(&report, 1, 1, b"x")),
        with_first(0x38, publish(&report, 0, 0, b"x")),
        publish(&report, 1, 0, b"x"),
        publish(&report, 1, 1, &vec![0; Limits::default().max_packet_bytes]),
        framed(0x30, &binary(b"\xff\xff")),
        framed(0x32, &text(&report)),
        subscribe(0, &[(&own, 0)]),
        subscribe(1, &[(&own, 3)]),
        subscribe(1, &[(&own, 0x81)]),
        subscribe(1, &[]),
        with_first(0x80, subscribe(1, &[(&own, 0)])),
        framed(0x82, &[&[0, 1][..], &text(&own)].concat()),
        framed(0x82, &[&[0, 1][..], &binary(b"\xff"), &[0]].concat()),
        vec![0x82, 1, 0],
        unsubscribe(1, &[]),
        unsubscribe(0, &[&own]),
        unsubscribe(1, &["a/#/b"]),
        with_first(0xa0, unsubscribe(1, &[&own])),
        framed(0xa2, &[&[0, 1][..], &text(&own), &[0]].concat()),
    ];
    for name in
        ["", "é", "ü/x", "$SYS/x", "$", "a/+", "#", "a\0b", "/", "\u{feff}", "router canary"]
    {
        cases.push(publish(name, 0, 0, b"x"));
        cases.push(publish(name, 2, 1, b"x"));
    }
    for filter in ["", "a/#/b", "a#", "a+", "+a/b", "##", "a\0"] {
        cases.push(subscribe(1, &[(filter, 0)]));
    }
    cases
}

#[tokio::test(flavor = "multi_thread")]
async fn violations_end_only_their_own_session() {
    let broker = TestBroker::start().await;
    let robot = RobotId::random();
    for packet in violations(&robot) {
        let mut raw = broker.robot(&robot).await;
        raw.send(&packet).await;
        raw.expect_close().await;
    }
    for packet in violations(&robot) {
        let mut raw = broker.operator("taskd/v1/#", 2).await;
        raw.send(&packet).await;
        raw.expect_close().await;
    }
    broker.assert_serves().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn silent_and_slow_clients_delay_no_other_client() {
    let broker =
        TestBroker::with(|limits| limits.connect_timeout = Duration::from_millis(300)).await;
    let mut silent = Vec::new();
    for _ in 0..50 {
        silent.push(broker.raw().await);
    }
    broker.assert_serves().await;
    for mut raw in silent {
        raw.expect_close().await;
    }
    // One byte at a time, for ever: the time limit is for the whole CONNECT.
    let mut slow = broker.raw().await;
    let dribble = async {
        for byte in Connect::robot(&RobotId::random()).packet().iter().cycle() {
            slow.send(&[*byte]).await;
            tokio::time::sleep(Duration::from_millis(20)).await;
            if slow.stream.try_read(&mut [0; 8]).is_ok_and(|count| count == 0) {
                return;
            }
        }
    };
    timeout(PATIENCE, dribble).await.expect("the slow client should be disconnected");
    broker.assert_serves().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn client_that_sends_byte_by_byte_in_time_is_served() {
    let broker = TestBroker::start().await;
    let robot = RobotId::random();
    let bytes = [
        Connect::robot(&robot).packet(),
        publish(&topic(&robot, RobotTopic::Report), 1, 300, b"slow"),
    ]
    .concat();
    let mut raw = broker.raw().await;
    raw.stream.set_nodelay(true).unwrap();
    for byte in bytes {
        raw.send(&[byte]).await;
    }
    raw.expect(&[0x20, 2, 0, 0]).await;
    raw.expect(&[0x40, 2, 1, 44]).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn resets_and_takeover_storms_are_survived() {
    let broker = TestBroker::with(|limits| limits.max_sessions_per_person = 256).await;
    let robot = RobotId::random();
    let packet = Connect::robot(&robot).packet();
    for _ in 0..50 {
        reset(broker.raw_with(&packet).await);
    }
    let mut storm = Vec::new();
    for _ in 0..100 {
        storm.push(broker.raw_with(&packet).await);
    }
    for name in ["same", ""] {
        for _ in 0..50 {
            let raw = broker.raw_with(&Connect::operator(name).packet()).await;
            if name.is_empty() {
                reset(raw);
            }
        }
    }
    let mut survivor = broker.robot(&robot).await;
    survivor.expect_nothing().await;
    drop(storm);
    survivor.expect_nothing().await;
    broker.assert_serves().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn burst_before_disconnect_is_survived() {
    let broker = TestBroker::start().await;
    let mut operators = Vec::new();
    for _ in 0..5 {
        operators.push(broker.operator("taskd/v1/#", 2).await);
    }
    for (last, qos) in [(RobotTopic::Telemetry, 0), (RobotTopic::Report, 0), (RobotTopic::Log, 1)] {
        let robot = RobotId::random();
        let mut burst = Connect::robot(&robot).packet();
        for id in 1..=3000 {
            burst.extend(publish(&topic(&robot, last), qos, id, b"burst"));
        }
        burst.extend([0xe0, 0]);
        let mut raw = broker.raw_with(&burst).await;
        let mut answers = Vec::new();
        let _ = timeout(PATIENCE, raw.stream.read_to_end(&mut answers))
            .await
            .expect("the broker should close");
        assert_eq!(answers.len(), 4 + if qos == 1 { 4 * 3000 } else { 0 });
    }
    for operator in operators {
        reset(operator);
    }
    broker.assert_serves().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn floods_are_capped() {
    let broker = TestBroker::with(|limits| limits.write_timeout = Duration::from_millis(500)).await;
    let robot = RobotId::random();
    let own = topic(&robot, RobotTopic::Desired);

    let mut wide = broker.robot(&robot).await;
    wide.send(&subscribe(1, &vec![(own.as_str(), 1); 30_000])).await;
    wide.expect_close().await;

    let mut many = broker.operator("taskd/v1/x", 0).await;
    for id in 2..=200_u16 {
        many.send(&subscribe(id, &[(&format!("taskd/v1/{id}/#"), 0)])).await;
        let code = if id <= 64 { 0 } else { 0x80 };
        many.expect(&[0x90, 3, (id >> 8) as u8, id as u8, code]).await;
    }

    // Endless pings by a client that reads no answer: disconnected by the write timeout, or cut off
    // while sending.
    let mut stalled = broker.robot(&robot).await;
    let pings = vec![[0xc0, 0]; 32 * 1024].concat();
    let flood = async {
        use tokio::io::AsyncWriteExt;
        while stalled.stream.write_all(&pings).await.is_ok() {}
    };
    // All that lies between the two has to fill up first, two bytes at a time.
    timeout(6 * PATIENCE, flood).await.expect("the client should be disconnected");
    broker.assert_serves().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn operator_that_does_not_acknowledge_is_disconnected() {
    let broker = TestBroker::with(|limits| limits.write_timeout = Duration::from_millis(300)).await;
    let robot = RobotId::random();
    let report = topic(&robot, RobotTopic::Report);
    let mut operator = broker.operator("taskd/v1/#", 1).await;
    let mut raw = broker.robot(&robot).await;
    for id in 1..=300 {
        raw.send(&publish(&report, 1, id, b"x")).await;
    }
    let mut received = Vec::new();
    let _ = timeout(PATIENCE, operator.stream.read_to_end(&mut received))
        .await
        .expect("the broker should close");
    assert_eq!(received.len(), 32 * publish(&report, 1, 1, b"x").len(), "no more than the window");
    broker.assert_serves().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn idle_client_does_not_hit_the_write_timeout() {
    let write_timeout = Duration::from_millis(50);
    let broker = TestBroker::with(|limits| limits.write_timeout = write_timeout).await;
    let mut raw = broker.robot(&RobotId::random()).await;
    for _ in 0..8 {
        timeout(write_timeout * 2, raw.stream.read_u8()).await.expect_err("nothing comes unasked");
        raw.send(&[0xc0, 0]).await;
        raw.expect(&[0xd0, 0]).await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn connection_and_operator_limits_hold() {
    let broker =
        TestBroker::with(|limits| (limits.max_connections, limits.max_operators) = (6, 2)).await;
    let (first, second) =
        (broker.operator("taskd/v1/#", 0).await, broker.operator("taskd/v1/#", 0).await);
    let mut third = broker.raw_with(&Connect::operator("").packet()).await;
    third.expect(&[0x20, 2, 0, 3]).await;
    third.expect_close().await;
    drop((first, second, third));
    // The places are free once the broker has noticed; until then a new client is rejected.
    let mut crowd = Vec::new();
    timeout(PATIENCE, async {
        while crowd.len() < 6 {
            let mut raw = broker.raw_with(&Connect::robot(&RobotId::random()).packet()).await;
            if raw.stream.read_exact(&mut [0; 4]).await.is_ok() {
                crowd.push(raw);
            }
        }
    })
    .await
    .expect("the places should be free again");
    let mut seventh = broker.raw_with(&Connect::robot(&RobotId::random()).packet()).await;
    seventh.expect_close().await;
    assert_eq!(broker.broker.connected_count(), 6);
}

#[tokio::test(flavor = "multi_thread")]
async fn session_limit_of_one_person_leaves_room_for_others() {
    let broker = TestBroker::start().await;
    let mut sessions = Vec::new();
    for _ in 0..16 {
        sessions.push(broker.operator("taskd/v1/#", 0).await);
    }
    let mut further = broker.raw_with(&Connect::operator("").packet()).await;
    further.expect(&[0x20, 2, 0, 3]).await;
    further.expect_close().await;
    let bob = Connect { password: Some("operator-bob".to_owned()), ..Connect::operator("") };
    let mut other = broker.raw_with(&bob.packet()).await;
    other.expect(&[0x20, 2, 0, 0]).await;
    for raw in &mut sessions {
        raw.expect_nothing().await;
    }
    drop(sessions);
    // No filter is longer than a session should store.
    let longest = format!("taskd/v1/{}", "x".repeat(1024 - "taskd/v1/".len()));
    other.send(&subscribe(1, &[(&longest, 0), (&format!("{longest}x"), 0)])).await;
    other.expect(&[0x90, 4, 0, 1, 0, 0x80]).await;
}

/// Time limit for clients that are not to be disconnected for slowness.
const HOUR: Duration = Duration::from_secs(3600);

#[tokio::test(flavor = "multi_thread")]
async fn silent_connections_are_evicted_at_the_connection_limit() {
    let broker =
        TestBroker::with(|limits| (limits.max_connections, limits.connect_timeout) = (2, HOUR))
            .await;
    let mut connected = broker.robot(&RobotId::random()).await;
    let mut silent = broker.raw().await;
    // No client is evicted in its first seconds: until then new clients are rejected.
    let mut ticks = tokio::time::interval(Duration::from_millis(100));
    let mut newcomer = timeout(PATIENCE, async {
        loop {
            ticks.tick().await;
            let mut raw = broker.raw_with(&Connect::robot(&RobotId::random()).packet()).await;
            if raw.stream.read_exact(&mut [0; 4]).await.is_ok() {
                return raw;
            }
        }
    })
    .await
    .expect("a place should be free");
    silent.expect_close().await;
    newcomer.expect_nothing().await;
    connected.expect_nothing().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn one_address_gets_a_quarter_of_the_connections_before_connect() {
    let broker =
        TestBroker::with(|limits| (limits.max_connections, limits.connect_timeout) = (400, HOUR))
            .await;
    let mut oldest = broker.raw().await;
    let mut crowd = Vec::new();
    for _ in 0..100 {
        crowd.push(broker.raw().await);
    }
    let newcomers = async {
        let mut ticks = tokio::time::interval(Duration::from_millis(100));
        loop {
            ticks.tick().await;
            crowd.push(broker.raw().await);
        }
    };
    tokio::select! {
        () = oldest.expect_close() => {}
        () = newcomers => unreachable!("they go on coming"),
    }
}

#[test]
fn random_bytes_and_mutated_packets_are_survived() {
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let broker = runtime.block_on(TestBroker::start());
    let robot = RobotId::random();
    let valid = [
        subscribe(1, &[(&topic(&robot, RobotTopic::Desired), 1)]),
        publish(&topic(&robot, RobotTopic::Telemetry), 0, 0, b"abc"),
        publish(&topic(&robot, RobotTopic::Report), 2, 7, b"abc"),
        vec![0x62, 2, 0, 7],
        unsubscribe(2, &[&topic(&robot, RobotTopic::Desired)]),
        vec![0xc0, 0],
    ];
    let connects = [Connect::robot(&robot).packet(), Connect::operator("fuzz").packet()];
    let valid = valid.concat();
    let mutations =
        proptest::collection::vec((any::<prop::sample::Index>(), any::<u8>(), 0..3_u8), 1..6);
    let script = (
        0..2_usize,
        any::<bool>(),
        any::<bool>(),
        mutations,
        proptest::collection::vec(any::<u8>(), 0..200),
    );
    let config = Config { cases: 400, failure_persistence: None, ..Config::default() };
    TestRunner::new(config)
        .run(&script, |(who, intact, random, mutations, noise)| {
            let mut bytes = [&connects[who][..], &valid].concat();
            let from = if intact { connects[who].len() } else { 0 };
            for (index, value, kind) in mutations {
                let at = from + index.index(bytes.len() - from);
                match kind {
                    0 => bytes[at] = value,
                    1 => bytes.insert(at, value),
                    _ => drop(bytes.remove(at)),
                }
            }
            if random {
                bytes.truncate(from);
                bytes.extend(noise);
            }
            runtime.block_on(async {
                let raw = broker.raw_with(&bytes).await;
                // Not waiting for the end keeps several of them going at the same time.
                drop(raw);
            });
            Ok(())
        })
        .unwrap();
    runtime.block_on(broker.assert_serves());
}
