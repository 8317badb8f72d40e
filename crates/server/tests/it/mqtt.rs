//! Guarantees for the broker's clients, over real TCP: admission, access, delivery, takeover,
//! wills, time limits.

use std::sync::atomic::Ordering;
use std::time::Duration;

use bytes::Bytes;
use rumqttc::{AsyncClient, Event, MqttOptions, Packet, QoS, SubscribeReasonCode};
use task_proto::RobotId;
use task_proto::api::Traffic;
use task_proto::messages::topic::RobotTopic;
use tokio::time::timeout;

use crate::mqtt_harness::{
    Connect, PATIENCE, Seen, TestBroker, publish, subscribe, topic, unsubscribe,
};

#[tokio::test(flavor = "multi_thread")]
async fn logins_get_the_right_connack() {
    let broker = TestBroker::with(|limits| limits.admit_timeout = Duration::from_secs(2)).await;
    let (robot, other) = (RobotId::random(), RobotId::random());
    let with = |change: fn(&mut Connect, &RobotId)| {
        let mut connect = Connect::robot(&robot);
        change(&mut connect, &other);
        connect.packet()
    };
    let cases: [(Vec<u8>, u8); 16] = [
        (with(|_, _| {}), 0),
        (with(|connect, _| connect.clean = false), 0),
        (Connect::operator("").packet(), 0),
        (with(|connect, _| connect.password = Some("wrong".to_owned())), 4),
        (with(|connect, _| connect.password = None), 5),
        (with(|connect, _| (connect.user_name, connect.password) = (None, None)), 5),
        (with(|connect, _| connect.password = Some("revoked".to_owned())), 5),
        (with(|connect, other| connect.client_id = other.to_string()), 2),
        (with(|connect, _| connect.client_id = "not a robot's id".to_owned()), 2),
        (with(|connect, _| connect.client_id = String::new()), 2),
        (Connect::operator(&"x".repeat(257)).packet(), 2),
        (with(|connect, other| connect.user_name = Some(other.to_string())), 5),
        (retained_will(&robot, b"gone"), 5),
        (with(|connect, _| (connect.client_id, connect.clean) = (String::new(), false)), 2),
        (with(|connect, _| connect.password = Some("outage".to_owned())), 3),
        (with(|connect, _| connect.password = Some("slow".to_owned())), 3),
    ];
    for (index, (packet, code)) in cases.iter().enumerate() {
        let mut raw = broker.raw_with(packet).await;
        raw.expect(&[0x20, 2, 0, *code]).await;
        if *code == 0 {
            raw.expect_nothing().await
        } else {
            raw.expect_close().await
        }
        assert_eq!(
            broker.broker.connected_count(),
            usize::from(*code == 0 && index < 2),
            "case {index}"
        );
        raw.send(&[0xe0, 0]).await;
        raw.expect_close().await;
    }
}

/// A CONNECT with a will to be retained.
fn retained_will(robot: &RobotId, payload: &[u8]) -> Vec<u8> {
    let will = Some((topic(robot, RobotTopic::Status), payload.to_vec()));
    let mut packet = Connect { will, ..Connect::robot(robot) }.packet();
    // The flags follow the fixed header, the protocol name and its level.
    let flags =
        packet.windows(5).position(|bytes| bytes == b"MQTT\x04").expect("a protocol name") + 5;
    packet[flags] |= 0x20;
    packet
}

#[tokio::test(flavor = "multi_thread")]
async fn retained_message_ends_the_session_unless_empty() {
    let broker = TestBroker::start().await;
    for qos in 0..=2 {
        let robot = RobotId::random();
        let status = topic(&robot, RobotTopic::Status);
        let mut operator = broker.operator(&status, 0).await;
        let mut client = broker.robot(&robot).await;
        let retained = |payload: &[u8]| {
            let mut packet = publish(&status, qos, 9, payload);
            packet[0] |= 1;
            packet
        };
        // The message asks the broker to forget a retained message, of which there is none, and is
        // passed on as any other message.
        client.send(&retained(b"")).await;
        match qos {
            1 => client.expect(&[0x40, 2, 0, 9]).await,
            2 => client.expect(&[0x50, 2, 0, 9]).await,
            _ => client.expect_nothing().await,
        }
        operator.expect(&publish(&status, 0, 0, b"")).await;
        client.send(&retained(b"online")).await;
        client.expect_close().await;
        operator.expect_nothing().await;
    }
    let robot = RobotId::random();
    let mut empty_will = broker.raw_with(&retained_will(&robot, b"")).await;
    empty_will.expect(&[0x20, 2, 0, 0]).await;
    let mut operator = broker.operator("taskd/v1/#", 1).await;
    operator
        .send(&{
            let mut packet = publish("taskd/v1/x", 1, 3, b"kept?");
            packet[0] |= 1;
            packet
        })
        .await;
    operator.expect_close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn independent_client_subscribes_and_publishes() {
    let broker = TestBroker::start().await;
    let robot = RobotId::random();
    let client = |id: &str, user: &str, password: &str| {
        let mut options = MqttOptions::new(id, "127.0.0.1", broker.address().port());
        options.set_credentials(user, password);
        AsyncClient::new(options, 10)
    };
    let (operator, mut from_operator) = client("somebody", "x", "operator");
    operator.subscribe("taskd/v1/r/+/report", QoS::ExactlyOnce).await.unwrap();
    operator.subscribe("#", QoS::AtLeastOnce).await.unwrap();
    let (publisher, mut from_publisher) =
        client(robot.as_str(), robot.as_str(), &format!("pw-{robot}"));
    publisher.subscribe(topic(&robot, RobotTopic::Desired), QoS::AtLeastOnce).await.unwrap();

    let mut codes = Vec::new();
    let (mut desired, mut received) = (None, Vec::new());
    timeout(PATIENCE, async {
        while codes.len() < 2 {
            if let Event::Incoming(Packet::SubAck(ack)) = from_operator.poll().await.unwrap() {
                codes.extend(ack.return_codes);
            }
        }
        for qos in [QoS::AtMostOnce, QoS::AtLeastOnce, QoS::ExactlyOnce] {
            publisher
                .publish(topic(&robot, RobotTopic::Report), qos, false, "report")
                .await
                .unwrap();
        }
        while desired.is_none() || received.len() < 3 {
            let incoming = tokio::select! {
                event = from_publisher.poll() => event.unwrap(),
                event = from_operator.poll() => event.unwrap(),
            };
            match incoming {
                Event::Incoming(Packet::SubAck(_)) => {
                    broker.broker.send_desired(&robot, Bytes::from_static(b"ding")).unwrap();
                }
                Event::Incoming(Packet::Publish(message)) if message.topic.ends_with("desired") => {
                    desired = Some(message)
                }
                Event::Incoming(Packet::Publish(message)) => {
                    received.push((message.qos, message.retain))
                }
                _ => {}
            }
        }
    })
    .await
    .expect("all should arrive");
    assert_eq!(
        codes,
        [SubscribeReasonCode::Success(QoS::ExactlyOnce), SubscribeReasonCode::Failure]
    );
    assert_eq!(desired.unwrap().payload, "ding");
    assert_eq!(
        received,
        [(QoS::AtMostOnce, false), (QoS::AtLeastOnce, false), (QoS::ExactlyOnce, false)]
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn denied_filters_are_refused_individually() {
    let broker = TestBroker::start().await;
    let (robot, other) = (RobotId::random(), RobotId::random());
    let (own, foreign) = (topic(&robot, RobotTopic::Desired), topic(&other, RobotTopic::Desired));
    let mut raw = broker.robot(&robot).await;
    raw.send(&subscribe(
        3,
        &[(&foreign, 1), (&own, 2), ("#", 0), ("taskd/v1/#", 0), ("$SYS/#", 0)],
    ))
    .await;
    raw.expect(&[0x90, 7, 0, 3, 0x80, 2, 0x80, 0x80, 0x80]).await;
    let _other = broker.robot(&other).await;
    broker.broker.send_desired(&other, Bytes::from_static(b"secret")).unwrap();
    broker.broker.send_desired(&robot, Bytes::from_static(b"mine")).unwrap();
    raw.expect(&publish(&own, 1, 1, b"mine")).await;
    raw.send(&unsubscribe(4, &[&own, "never/subscribed"])).await;
    raw.expect(&[0xb0, 2, 0, 4]).await;
    broker.broker.send_desired(&robot, Bytes::from_static(b"unheard")).unwrap();
    raw.expect_nothing().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn publish_to_a_foreign_topic_ends_the_session() {
    let broker = TestBroker::start().await;
    let (robot, other) = (RobotId::random(), RobotId::random());
    for name in
        [topic(&other, RobotTopic::Report), topic(&robot, RobotTopic::Desired), "x".to_owned()]
    {
        let mut raw = broker.robot(&robot).await;
        raw.send(&publish(&name, 1, 1, b"forged")).await;
        raw.expect_close().await;
    }
    let mut operator = broker.operator("taskd/v1/#", 0).await;
    operator.send(&publish(&topic(&robot, RobotTopic::Report), 0, 0, b"forged")).await;
    operator.expect_close().await;
    broker.assert_serves().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn message_is_acknowledged_only_after_it_is_stored() {
    let broker = TestBroker::with(|limits| limits.inbox_timeout = Duration::from_millis(100)).await;
    let robot = RobotId::random();
    let report = topic(&robot, RobotTopic::Report);
    broker.refuse_messages.store(true, Ordering::SeqCst);
    for qos in 0..=2 {
        let mut raw = broker.robot(&robot).await;
        raw.send(&publish(&report, qos, 1, b"x")).await;
        raw.expect_close().await;
    }
    broker.refuse_messages.store(false, Ordering::SeqCst);
    let mut raw = broker.robot(&robot).await;
    raw.send(&publish(&report, 1, 1, b"stall")).await;
    raw.expect_close().await;
    let mut raw = broker.robot(&robot).await;
    raw.send(&publish(&report, 1, 1, b"x")).await;
    raw.expect(&[0x40, 2, 0, 1]).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn qos_2_arrives_exactly_once() {
    let broker = TestBroker::start().await;
    let robot = RobotId::random();
    let mut raw = broker.robot(&robot).await;
    assert!(matches!(broker.next_of(&robot).await, Seen::Connected(..)));
    let mut message = publish(&topic(&robot, RobotTopic::Report), 2, 5, b"once");
    raw.send(&message).await;
    raw.expect(&[0x50, 2, 0, 5]).await;
    message[0] |= 0x08;
    raw.send(&message).await;
    raw.expect(&[0x50, 2, 0, 5]).await;
    for _ in 0..2 {
        raw.send(&[0x62, 2, 0, 5]).await;
        raw.expect(&[0x70, 2, 0, 5]).await;
    }
    raw.send(&publish(&topic(&robot, RobotTopic::Report), 2, 5, b"twice")).await;
    raw.expect(&[0x50, 2, 0, 5]).await;
    for payload in ["once", "twice"] {
        assert_eq!(
            broker.next_of(&robot).await,
            Seen::Received(robot.clone(), RobotTopic::Report, payload.into())
        );
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn permitted_mqtt_is_not_a_violation() {
    let broker = TestBroker::start().await;
    let robot = RobotId::random();
    let (report, desired) = (topic(&robot, RobotTopic::Report), topic(&robot, RobotTopic::Desired));
    let mut raw = broker.robot(&robot).await;
    // The client may release none of its messages before all of them are sent.
    for id in 1..=1000_u16 {
        let [high, low] = id.to_be_bytes();
        raw.send(&publish(&report, 2, id, b"x")).await;
        raw.expect(&[0x50, 2, high, low]).await;
    }
    for id in 1..=1000_u16 {
        let [high, low] = id.to_be_bytes();
        raw.send(&[0x62, 2, high, low]).await;
        raw.expect(&[0x70, 2, high, low]).await;
    }
    // And ask for more at once than it gets.
    raw.send(&subscribe(1, &[(desired.as_str(), 1); 100])).await;
    raw.expect(&[&[0x90_u8, 102, 0, 1][..], &[1; 64], &[0x80; 36]].concat()).await;
    broker.broker.send_desired(&robot, Bytes::from_static(b"ding")).unwrap();
    raw.expect(&publish(&desired, 1, 1, b"ding")).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn slow_robot_receives_only_the_newest_state() {
    let broker = TestBroker::start().await;
    let robot = RobotId::random();
    let desired = topic(&robot, RobotTopic::Desired);
    assert!(broker.broker.send_desired(&robot, Bytes::new()).is_err());
    let mut raw = broker.robot(&robot).await;
    for word in ["old", "older", "new"] {
        broker.broker.send_desired(&robot, word.into()).unwrap();
    }
    raw.send(&subscribe(1, &[(&desired, 1)])).await;
    raw.expect(&[0x90, 3, 0, 1, 1]).await;
    raw.expect(&publish(&desired, 1, 1, b"new")).await;
    raw.expect_nothing().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn takeover_waits_for_the_old_session_to_end() {
    let broker = TestBroker::start().await;
    let robot = RobotId::random();
    let status = topic(&robot, RobotTopic::Status);
    let mut connect = Connect::robot(&robot);
    connect.will = Some((status, b"gone".to_vec()));
    let mut last = None;
    for round in 0..20 {
        let mut raw = broker.raw_with(&connect.packet()).await;
        raw.expect(&[0x20, 2, 0, 0]).await;
        if let Some((mut old, number)) = last.take() {
            let old: &mut crate::mqtt_harness::Raw = &mut old;
            old.expect_close().await;
            let gone = Seen::Received(robot.clone(), RobotTopic::Status, "gone".into());
            assert_eq!(broker.next_of(&robot).await, gone, "round {round}");
            assert_eq!(broker.next_of(&robot).await, Seen::Disconnected(robot.clone(), number));
        }
        let Seen::Connected(_, number) = broker.next_of(&robot).await else {
            panic!("connected should come")
        };
        last = Some((raw, number));
    }
    assert_eq!(broker.broker.connected_count(), 1);
}

#[tokio::test(flavor = "multi_thread")]
async fn will_is_published_unless_the_client_disconnects() {
    let broker = TestBroker::start().await;
    let robot = RobotId::random();
    let status = topic(&robot, RobotTopic::Status);
    let mut connect = Connect::robot(&robot);
    connect.will = Some((status.clone(), b"gone".to_vec()));
    let mut operator = broker.operator(&status, 0).await;

    let mut polite = broker.raw_with(&connect.packet()).await;
    polite.expect(&[0x20, 2, 0, 0]).await;
    polite.send(&[0xe0, 0]).await;
    polite.expect_close().await;
    operator.expect_nothing().await;

    let mut rude = broker.raw_with(&connect.packet()).await;
    rude.expect(&[0x20, 2, 0, 0]).await;
    drop(rude);
    operator.expect(&publish(&status, 0, 0, b"gone")).await;

    let mut violent = broker.raw_with(&connect.packet()).await;
    violent.expect(&[0x20, 2, 0, 0]).await;
    violent.send(&connect.packet()).await;
    violent.expect_close().await;
    operator.expect(&publish(&status, 0, 0, b"gone")).await;

    connect.will = Some((topic(&RobotId::random(), RobotTopic::Status), b"forged".to_vec()));
    let mut forger = broker.raw_with(&connect.packet()).await;
    forger.expect(&[0x20, 2, 0, 5]).await;
    forger.expect_close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn silence_beyond_the_keepalive_ends_the_session() {
    let broker = TestBroker::start().await;
    let robot = RobotId::random();
    let mut connect = Connect::robot(&robot);
    connect.keep_alive_s = 1;
    let begin = tokio::time::Instant::now();
    let mut raw = broker.raw_with(&connect.packet()).await;
    raw.expect(&[0x20, 2, 0, 0]).await;
    raw.expect_close().await;
    assert!(
        (Duration::from_millis(1500)..Duration::from_secs(5)).contains(&begin.elapsed()),
        "{:?}",
        begin.elapsed()
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn traffic_is_counted_for_the_connection_and_in_total() {
    let broker = TestBroker::start().await;
    let (robot, other) = (RobotId::random(), RobotId::random());
    let (report, desired) = (topic(&robot, RobotTopic::Report), topic(&robot, RobotTopic::Desired));
    assert_eq!(broker.broker.traffic_of(&robot), None);
    let mut raw = broker.robot(&robot).await;
    let connect = Connect::robot(&robot).packet().len() as u64;
    let mut expected = Traffic {
        bytes_in: connect,
        bytes_out: 4,
        packets_in: 1,
        packets_out: 1,
        ..Traffic::default()
    };
    assert_eq!(broker.broker.traffic_of(&robot), Some(expected));

    let (subscribe_packet, publish_packet, desired_packet) = (
        subscribe(3, &[(&desired, 1)]),
        publish(&report, 1, 1, b"report"),
        publish(&desired, 1, 1, b"ding"),
    );
    raw.send(&subscribe_packet).await;
    raw.expect(&[0x90, 3, 0, 3, 1]).await;
    raw.send(&publish_packet).await;
    raw.expect(&[0x40, 2, 0, 1]).await;
    broker.broker.send_desired(&robot, Bytes::from_static(b"ding")).unwrap();
    raw.expect(&desired_packet).await;
    raw.send(&[0x40, 2, 0, 1]).await;
    raw.expect_nothing().await;
    expected.bytes_in += (subscribe_packet.len() + publish_packet.len() + 4 + 2) as u64;
    expected.bytes_out += (5 + 4 + desired_packet.len() + 2) as u64;
    (expected.packets_in, expected.packets_out) = (5, 5);
    (expected.messages_in, expected.messages_out, expected.acks_in, expected.acks_out) =
        (1, 1, 1, 1);
    assert_eq!(broker.broker.traffic_of(&robot), Some(expected));
    let all = broker.broker.traffic();
    assert_eq!(
        (all.robots_connected, all.connections_accepted, all.connections_refused),
        (1, 1, 0)
    );
    assert_eq!((all.messages_refused, all.messages_dropped, all.all), (0, 0, expected));

    // Other violations count for the client and for the total: a wrong password, a forbidden
    // publication.
    let wrong = Connect { password: Some("wrong".to_owned()), ..Connect::robot(&other) }.packet();
    let mut refused = broker.raw_with(&wrong).await;
    refused.expect(&[0x20, 2, 0, 4]).await;
    let mut forger = broker.robot(&other).await;
    let forged = publish(&report, 1, 1, b"forged");
    forger.send(&forged).await;
    forger.expect_close().await;
    let all = broker.broker.traffic();
    assert_eq!(
        (all.connections_accepted, all.connections_refused, all.messages_refused),
        (2, 1, 1)
    );
    assert_eq!(all.all.messages_in, 2);
    assert_eq!(
        all.all.bytes_in,
        expected.bytes_in + (wrong.len() + connect as usize + forged.len()) as u64
    );
    assert_eq!(
        broker.broker.traffic_of(&robot),
        Some(expected),
        "other clients' traffic is not counted"
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn revoked_and_stopped_sessions_end() {
    let broker = TestBroker::start().await;
    let (revoked, stopped) = (RobotId::random(), RobotId::random());
    let (mut first, mut second) = (broker.robot(&revoked).await, broker.robot(&stopped).await);
    broker.broker.disconnect(&revoked);
    first.expect_close().await;
    let mut silent = broker.raw().await;
    let (broker, closed) = (broker.broker.clone(), async {
        second.expect_close().await;
        silent.expect_close().await;
    });
    tokio::join!(broker.shutdown(PATIENCE), closed);
    assert_eq!(broker.connected_count(), 0);
}

#[tokio::test]
async fn robot_evicted_during_admission_gets_no_session() {
    let broker = TestBroker::start().await;
    let robot = RobotId::random();
    let connect = Connect { password: Some(format!("once-{robot}")), ..Connect::robot(&robot) };
    let mut raw = broker.raw_with(&connect.packet()).await;
    timeout(PATIENCE, broker.gatekeeper.asked.notified()).await.expect("the gatekeeper is asked");
    // There is no session yet that could be ended.
    broker.broker.disconnect(&robot);
    broker.gatekeeper.go_on.notify_one();
    raw.expect(&[0x20, 2, 0, 5]).await;
    raw.expect_close().await;
}

#[tokio::test]
async fn new_token_ends_the_old_session_even_if_admission_times_out() {
    let broker = TestBroker::with(|limits| limits.admit_timeout = Duration::from_secs(2)).await;
    let robot = RobotId::random();
    let mut old = broker.robot(&robot).await;
    let connect = Connect { password: Some(format!("new-{robot}")), ..Connect::robot(&robot) };
    let mut new = broker.raw_with(&connect.packet()).await;
    new.expect(&[0x20, 2, 0, 3]).await;
    broker.gatekeeper.go_on.notify_one();
    old.expect_close().await;
}

#[tokio::test]
async fn slow_large_packet_counts_as_activity_and_a_trickle_does_not() {
    let broker = TestBroker::with(|limits| limits.connect_timeout = Duration::from_secs(5)).await;
    let (slow, trickling) = (RobotId::random(), RobotId::random());
    // A client that says nothing is hung up on after five seconds; the others may be silent for
    // seven and a half.
    let mut five_seconds = broker.raw().await;
    let mut clients = Vec::new();
    for (robot, bytes) in [(&slow, 2048), (&trickling, 100)] {
        let connect = Connect { keep_alive_s: 5, ..Connect::robot(robot) };
        let mut raw = broker.raw_with(&connect.packet()).await;
        raw.expect(&[0x20, 2, 0, 0]).await;
        clients.push((raw, publish(&topic(robot, RobotTopic::Report), 1, 7, &[b'x'; 8192]), bytes));
    }
    five_seconds.expect_close().await;
    for (raw, packet, bytes) in &mut clients {
        raw.send(&packet[..*bytes]).await;
    }
    broker.raw().await.expect_close().await;
    for (raw, packet, bytes) in &mut clients {
        raw.send(&packet[*bytes..]).await;
    }
    clients[0].0.expect(&[0x40, 2, 0, 7]).await;
    clients[1].0.expect_close().await;
}
