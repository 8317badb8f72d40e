//! Attacks with an operator's or one robot's credentials: hostile archives, other robots' topics.

use std::path::Path;
use std::time::Duration;

use rumqttc::{
    AsyncClient, ConnectReturnCode, ConnectionError, Event, MqttOptions, Packet, QoS,
    SubscribeReasonCode,
};
use serde_json::json;
use task_proto::Digest;
use task_proto::desired::BlobRef;
use task_proto::packages::oci::ImageManifest;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;

use crate::harness::{Fleet, Server, eventually};

/// One tar entry, header written by hand: the `tar` crate refuses to write most of these.
fn entry(name: &str, kind: u8, link: &str, data: &[u8]) -> Vec<u8> {
    let mut header = [0_u8; 512];
    header[..name.len()].copy_from_slice(name.as_bytes());
    header[100..107].copy_from_slice(b"0000644");
    header[108..115].copy_from_slice(b"0000000");
    header[116..123].copy_from_slice(b"0000000");
    header[124..135].copy_from_slice(format!("{:011o}", data.len()).as_bytes());
    header[136..147].copy_from_slice(b"00000000000");
    header[156] = kind;
    header[157..157 + link.len()].copy_from_slice(link.as_bytes());
    header[257..263].copy_from_slice(b"ustar\0");
    header[263..265].copy_from_slice(b"00");
    header[148..156].copy_from_slice(b"        ");
    let sum: u32 = header.iter().map(|&b| u32::from(b)).sum();
    header[148..156].copy_from_slice(format!("{sum:06o}\0 ").as_bytes());
    let mut bytes = header.to_vec();
    bytes.extend_from_slice(data);
    bytes.resize(bytes.len().next_multiple_of(512), 0);
    bytes
}

fn archive(entries: &[Vec<u8>]) -> Vec<u8> {
    let mut tar = entries.concat();
    tar.extend_from_slice(&[0; 1024]);
    tar
}

/// Uploads a package with the content `tar`, past `taskd push` and its checks, as any OCI client
/// could; returns the answer.
async fn upload(server: &Server, name: &str, tar: &[u8], entries: usize) -> (u16, String) {
    let content = zstd::encode_all(tar, 3).expect("compressed");
    let config = json!({
        "name": name, "version": "1.0.0", "run": {"exec": ["sh", "-c", "exec sleep 1000"]},
        "content": {"tar_digest": Digest::of(tar), "tar_size": tar.len(), "entries": entries},
    });
    let config = serde_json::to_vec(&config).expect("json");
    let blob = |bytes: &[u8]| BlobRef { digest: Digest::of(bytes), size: bytes.len() as u64 };
    let manifest =
        serde_json::to_vec(&ImageManifest::package(blob(&config), blob(&content))).expect("json");
    let client = reqwest::Client::new();
    for bytes in [&config, &content] {
        let url = server.url(&format!("/v2/{name}/blobs/uploads/?digest={}", Digest::of(bytes)));
        let answer = client
            .post(url)
            .bearer_auth(server.operator_token())
            .body(bytes.clone())
            .send()
            .await
            .expect("sent");
        assert_eq!(answer.status(), 201);
    }
    let answer = client
        .put(server.url(&format!("/v2/{name}/manifests/1.0.0")))
        .bearer_auth(server.operator_token())
        .header("content-type", task_proto::packages::oci::MANIFEST_TYPE)
        .body(manifest)
        .send()
        .await
        .expect("sent");
    (answer.status().as_u16(), answer.text().await.unwrap_or_default())
}

fn tree(dir: &Path) -> Vec<std::path::PathBuf> {
    let mut found: Vec<_> =
        std::fs::read_dir(dir).expect("readable").map(|e| e.expect("entry").path()).collect();
    found.sort();
    found
}

#[tokio::test(flavor = "multi_thread")]
async fn hostile_archive_is_refused_at_push_with_its_reason() {
    let dir = tempfile::TempDir::new().expect("temp dir");
    let server = Server::start(&dir.path().join("server")).await;
    let outside = tree(dir.path());
    let file = |name: &str| entry(name, b'0', "", b"x");
    let cases: Vec<(&str, Vec<Vec<u8>>, &str)> = vec![
        ("dotdot", vec![file("../escape")], ".."),
        ("absolute", vec![file("/tmp/taskd-escape")], "absolute"),
        ("symlink", vec![entry("link", b'2', "/etc", b""), file("link/escape")], "link"),
        ("hardlink", vec![entry("link", b'1', "../../ledger.json", b"")], "link"),
        ("device", vec![entry("null", b'3', "", b"")], "device"),
        ("fifo", vec![entry("pipe", b'6', "", b"")], "fifo"),
        ("duplicate", vec![file("twice"), file("./twice")], "twice"),
        (
            "bomb",
            vec![entry("zeros", b'0', "", &vec![0; 300_000_000])],
            "uncompressed bytes for this compressed size",
        ),
    ];
    for (name, entries, reason) in cases {
        let (status, answer) = upload(&server, name, &archive(&entries), entries.len()).await;
        assert!(
            status == 400 && answer.contains("robots would refuse"),
            "{name}: {status} {answer}"
        );
        assert!(answer.to_lowercase().contains(reason), "{name}: {answer}");
    }
    assert_eq!(server.get("/api/v1/packages").await.expect("a list")["packages"], json!([]));
    assert_eq!(tree(dir.path()), outside, "something was written outside the server's directory");
    assert!(!Path::new("/tmp/taskd-escape").exists());
}

#[tokio::test(flavor = "multi_thread")]
async fn mqtt_5_client_is_refused_and_named_in_the_servers_log() {
    let dir = tempfile::TempDir::new().expect("temp dir");
    let server = Server::start(&dir.path().join("server")).await;
    // CONNECT of MQTT 5 with a clean start, no properties and no client id.
    let connect = [0x10, 13, 0, 4, b'M', b'Q', b'T', b'T', 5, 2, 0, 60, 0, 0, 0];
    let mut peer = None;
    for _ in 0..3 {
        let mut stream = TcpStream::connect(server.mqtt).await.expect("connected");
        peer.get_or_insert(stream.local_addr().expect("bound"));
        stream.write_all(&connect).await.expect("sent");
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).await.expect("an answer");
        assert_eq!(answer, [0x20, 2, 0, 1]);
    }
    let peer = peer.expect("connected").to_string();
    let line = eventually("a line in the log", async || {
        let log = std::fs::read_to_string(server.data().with_extension("server.log")).ok()?;
        let mut lines = log
            .lines()
            .filter(|line| line.contains("MQTT 5"))
            .map(str::to_owned)
            .collect::<Vec<_>>();
        (lines.len() == 1).then(|| lines.remove(0))
    })
    .await;
    assert!(line.contains("WARN") && line.contains(&peer) && line.contains("MQTT 3.1.1"), "{line}");
}

async fn next_packet(events: &mut rumqttc::EventLoop) -> Result<Packet, ConnectionError> {
    loop {
        if let Event::Incoming(packet) =
            tokio::time::timeout(Duration::from_secs(20), events.poll())
                .await
                .expect("an answer")?
        {
            return Ok(packet);
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn robot_credentials_reach_no_other_robot() {
    let mut fleet = Fleet::start(2).await;
    let identity: serde_json::Value = serde_json::from_slice(
        &std::fs::read(fleet.robots[0].data().join("identity.json")).expect("identity"),
    )
    .expect("json");
    fleet.robots[0].terminate();
    let own = fleet.robots[0].id.to_string();
    let other = fleet.robots[1].id.to_string();
    let options = |password: &str| {
        let mut options =
            MqttOptions::new(&own, fleet.server.mqtt.ip().to_string(), fleet.server.mqtt.port());
        options.set_credentials(&own, password);
        options
    };
    let (_client, mut events) = AsyncClient::new(options("wrong"), 10);
    match next_packet(&mut events).await {
        Err(ConnectionError::ConnectionRefused(ConnectReturnCode::BadUserNamePassword)) => {}
        other => panic!("expected CONNACK 4, got {other:?}"),
    }

    let token = identity["token"].as_str().expect("token");
    let (client, mut events) = AsyncClient::new(options(token), 10);
    assert!(matches!(next_packet(&mut events).await, Ok(Packet::ConnAck(_))));
    for filter in ["#", "taskd/v1/#", "+/+/+/+/+", &format!("taskd/v1/r/{other}/desired"), "$SYS/#"]
    {
        client.subscribe(filter, QoS::AtMostOnce).await.expect("queued");
        loop {
            match next_packet(&mut events).await {
                Ok(Packet::SubAck(ack)) => {
                    assert_eq!(ack.return_codes, [SubscribeReasonCode::Failure], "{filter}");
                    break;
                }
                Ok(_) => {}
                Err(error) => panic!("{filter}: {error}"),
            }
        }
    }
    client
        .publish(format!("taskd/v1/r/{other}/report"), QoS::AtLeastOnce, false, "{}")
        .await
        .expect("queued");
    let refused = async {
        loop {
            match next_packet(&mut events).await {
                Ok(Packet::PubAck(_)) => panic!("a forged report was acknowledged"),
                Ok(_) => {}
                Err(_) => return,
            }
        }
    };
    refused.await;
    // The other robot is none the worse.
    fleet.server.wait_online(&other).await;
}
