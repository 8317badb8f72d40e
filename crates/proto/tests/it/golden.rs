//! Compares written documents with `tests/golden/`, and reads them as a newer and an older version
//! of the other side would. After an intended change: `UPDATE_GOLDEN=1 cargo test -p task-proto`,
//! and change docs/protocol.md too.

use std::collections::BTreeMap;
use std::fmt::Debug;
use std::path::Path;

use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::{Value, json};
use task_proto::api::{
    BrokerAddress, CreateDeployment, DeliveryChoice, EnrollRequest, EnrollResponse, ErrorBody,
    Event, ExternalBroker, HttpTraffic, LogEvent, LogsFrom, LogsView, MqttConnection, MqttEndpoint,
    MqttTraffic, OutputList, OutputView, PenaltyTotals, ReportReply, RobotToken, ServerInfo,
    Traffic,
};
use task_proto::desired::{
    BlobRef, Delivery, DesiredNotice, DesiredState, DesiredTask, Evidence, Inline, PackageRef,
    RobotDescription, SignatureRef, TargetState,
};
use task_proto::messages::part::{Part, PartRange};
use task_proto::messages::report::{
    ActiveVersion, Condition, Failure, FailureCode, HostFacts, Isolation, LinkFacts, Phase,
    Progress, Report, RosFacts, Status, TaskAccounts, TaskReport,
};
use task_proto::messages::request::{Action, Answer, Ask, Outcome, Refusal, Reply, Request};
use task_proto::messages::topic::TopicPrefix;
use task_proto::packages::manifest::{
    Build, BuildTool, ContentFacts, Limits, Outputs, Ready, ReadyTopic, Requires, Run, TaskKind,
    TaskManifest,
};
use task_proto::packages::oci::ImageManifest;
use task_proto::packages::output::{OutputFile, OutputSet};
use task_proto::packages::publisher::{PackageStatement, PublisherList, Role, SIGNATURE_ARTIFACT};
use task_proto::telemetry::log::{LogBatch, LogLevel, LogLine, LogSource};
use task_proto::telemetry::ros::{
    Endpoint, LifecycleState, NodeDetail, NodeSummary, Parameter, TopicSummary, Transition,
};
use task_proto::trust::envelope::{DESIRED_STATE_TYPE, Envelope, SigningKey};
use task_proto::{Digest, Generation, RobotId};

pub fn parsed<T: std::str::FromStr<Err: Debug>>(text: &str) -> T {
    text.parse().expect(text)
}

fn blob(text: &str) -> BlobRef {
    BlobRef { digest: Digest::of(text.as_bytes()), size: text.len() as u64 }
}

pub fn package() -> PackageRef {
    PackageRef {
        name: parsed("talker"),
        version: parsed("1.2.0"),
        manifest: blob("manifest"),
        config: blob("config"),
        content: blob("content"),
    }
}

pub fn robot() -> RobotId {
    parsed("r00000000000000a1")
}

fn desired_state() -> DesiredState {
    DesiredState {
        robot_id: robot(),
        generation: Generation(7),
        issued_at_ms: 1_800_000_000_000,
        expires_at_ms: 1_802_592_000_000,
        tasks: vec![DesiredTask {
            task: parsed("talker"),
            deployment: parsed("d00000000000000b2"),
            package: package(),
            wanted: TargetState::Running,
            run: 1,
            delivery: Delivery::PushPull,
            priority: 5,
        }],
        evidence: Evidence {
            lists: vec![blob("list")],
            signatures: vec![SignatureRef {
                manifest: package().manifest.digest,
                envelope: blob("signature"),
            }],
        },
        settings: crate::fleet::settings(),
        robot: RobotDescription {
            name: Some(parsed("atlas")),
            labels: [(parsed("site"), parsed("lab"))].into(),
        },
    }
}

fn report() -> Report {
    Report {
        robot_id: robot(),
        start: 3,
        instance: parsed("i00000000000000c3"),
        place: None,
        boot_id: "5f0c6a55-5a0f-4f7c-9d59-1f3c3f0f0c11".to_owned(),
        seq: 12,
        observed_generation: Generation(7),
        uptime_ms: 61_000,
        host: HostFacts {
            agent_version: "0.1.0".to_owned(),
            hostname: "atlas".to_owned(),
            arch: "x86_64".to_owned(),
            mac: Some(parsed("02:00:00:00:00:01")),
            ros_distros: vec!["jazzy".to_owned()],
            disk_free_bytes: 10_000_000_000,
            ros: Some(RosFacts {
                distro: "jazzy".to_owned(),
                rmw: Some("rmw_fastrtps_cpp".to_owned()),
                domain_id: Some(7),
                localhost_only: false,
            }),
            isolation: Isolation::Cgroup,
            accounts: Some(TaskAccounts::PerTask),
            battery_percent: Some(80),
            publishers: Some(3),
            settings: Some(crate::fleet::effective_settings()),
        },
        conditions: vec![Condition {
            code: "held".to_owned(),
            text: "held at the robot".to_owned(),
        }],
        link: Some(LinkFacts {
            throughput_bytes_per_s: Some(2_400_000),
            rtt_ms: Some(31),
            reconnects: 1,
            losses: 2,
        }),
        tasks: vec![
            TaskReport {
                task: parsed("mapper"),
                deployment: parsed("d00000000000000b1"),
                package: package(),
                wanted: TargetState::Running,
                run: 2,
                kind: None,
                phase: Phase::Fetching,
                phase_ms: 1_500,
                progress: Some(Progress { done: 1, total: 7 }),
                missing_parts: Some(vec![
                    PartRange { from: 0, to: 0 },
                    PartRange { from: 3, to: 5 },
                ]),
                attempts: 1,
                restarts: 0,
                failure: None,
                degraded: None,
                active: None,
            },
            TaskReport {
                task: parsed("talker"),
                deployment: parsed("d00000000000000b2"),
                package: package(),
                wanted: TargetState::Running,
                run: 1,
                kind: Some(TaskKind::Service),
                phase: Phase::Failed,
                phase_ms: 9_000,
                progress: None,
                missing_parts: None,
                attempts: 3,
                restarts: 1,
                failure: Some(Failure::new(
                    FailureCode::BUILD_FAILED,
                    "colcon build ended with status 1",
                )),
                degraded: Some(Failure::new(FailureCode::TOPIC_SILENT, "/scan has no publisher")),
                active: Some(ActiveVersion {
                    deployment: parsed("d00000000000000b0"),
                    version: parsed("1.1.0"),
                    manifest: Some(Digest::of(b"manifest")),
                    pid: 4711,
                }),
            },
        ],
    }
}

pub fn manifest() -> TaskManifest {
    TaskManifest {
        name: parsed("talker"),
        version: parsed("1.2.0"),
        build: Build { tool: BuildTool::Colcon },
        run: Run {
            exec: Some(vec!["install/talker/lib/talker/talker".to_owned()]),
            kind: TaskKind::Service,
            ..Run::default()
        },
        ready: Ready {
            nodes: vec!["/talker".to_owned()],
            lifecycle: vec!["/talker".to_owned()],
            services: vec!["/talker/say".to_owned()],
            topics: BTreeMap::from([
                ("/chatter".to_owned(), ReadyTopic { min_hz: Some(5.0) }),
                ("/words".to_owned(), ReadyTopic::default()),
            ]),
            ..Ready::default()
        },
        parameters: BTreeMap::from([(
            "/talker".to_owned(),
            BTreeMap::from([("period_s".to_owned(), json!(0.5))]),
        )]),
        outputs: Outputs { paths: vec!["maps/*.pgm".to_owned()] },
        requires: Requires {
            ros_distro: vec!["jazzy".to_owned(), "kilted".to_owned()],
            ..Requires::default()
        },
        limits: Limits { memory_mb: Some(512), cpu_weight: None, pids: Some(64) },
        exec_depends: vec!["rclpy".to_owned()],
        content: ContentFacts { tar_digest: Digest::of(b"tar"), tar_size: 10_240, entries: 9 },
    }
}

/// Adds an unknown field to every object.
fn from_the_future(value: &Value) -> Value {
    match value {
        Value::Array(items) => items.iter().map(from_the_future).collect(),
        Value::Object(fields) => {
            let mut fields: serde_json::Map<_, _> =
                fields.iter().map(|(k, v)| (k.clone(), from_the_future(v))).collect();
            fields.insert("x_future".to_owned(), json!({"any": ["thing"]}));
            Value::Object(fields)
        }
        other => other.clone(),
    }
}

pub fn check<T: Serialize + DeserializeOwned + PartialEq + Debug>(name: &str, value: &T) {
    check_text::<T>(name, value);
    let text = golden(name);
    assert_eq!(
        &serde_json::from_str::<T>(&text).expect("golden file parses"),
        value,
        "{name} reads back"
    );
}

pub fn check_text<T: Serialize + DeserializeOwned>(name: &str, value: &T) {
    let written = serde_json::to_string_pretty(value).expect("json") + "\n";
    update_golden(name, &written);
    assert_eq!(written, golden(name), "{name} has changed on the wire");
    serde_json::from_str::<T>(&written).expect("parses its own output");
}

/// A reader of this version must ignore additions of a later version. Only where maps hold no free
/// keys.
pub fn check_tolerance<T: DeserializeOwned + PartialEq + Debug>(name: &str) {
    let value: Value = serde_json::from_str(&golden(name)).expect("json");
    let now: T = serde_json::from_value(value.clone()).expect("reads its own");
    assert_eq!(
        serde_json::from_value::<T>(from_the_future(&value)).expect("reads the future"),
        now,
        "{name}"
    );
}

fn update_golden(name: &str, written: &str) {
    if std::env::var_os("UPDATE_GOLDEN").is_some() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden").join(name);
        std::fs::write(path, written).expect("golden file written");
    }
}

pub fn golden(name: &str) -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden").join(name);
    std::fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

#[test]
fn robot_protocol_documents() {
    let key = SigningKey::from_bytes([7; 32]);
    let state = desired_state();
    check("desired_state.json", &state);
    let envelope =
        Envelope::seal(DESIRED_STATE_TYPE, &serde_json::to_vec(&state).expect("json"), &key);
    check(
        "doorbell_state.json",
        &DesiredNotice::State { envelope: envelope.clone(), inline: Inline::default() },
    );
    let mut inline = Inline::default();
    inline.insert(blob("config").digest, b"config".to_vec());
    inline.insert(blob("content").digest, b"content".to_vec());
    check("doorbell_inline.json", &DesiredNotice::State { envelope: envelope.clone(), inline });
    check("doorbell_notice.json", &DesiredNotice::Notice { generation: Generation(8) });
    check("report.json", &report());
    check(
        "status.json",
        &Status {
            online: true,
            start: 3,
            instance: parsed("i00000000000000c3"),
            connection: 2,
            place: None,
        },
    );
    let reply = ReportReply {
        generation: Generation(7),
        name: parsed("atlas"),
        labels: [(parsed("site"), parsed("lab"))].into(),
    };
    check("report_reply.json", &reply);

    check_tolerance::<DesiredState>("desired_state.json");
    check_tolerance::<DesiredNotice>("doorbell_state.json");
    check_tolerance::<DesiredNotice>("doorbell_inline.json");
    check_tolerance::<DesiredNotice>("doorbell_notice.json");
    check_tolerance::<Report>("report.json");
    check_tolerance::<Status>("status.json");
    let payload = envelope.open(DESIRED_STATE_TYPE, &key.public_key()).expect("signed");
    assert_eq!(serde_json::from_slice::<DesiredState>(&payload).expect("json"), state);
}

#[test]
fn request_and_reply_documents() {
    let asks = [
        Ask::Nodes,
        Ask::Node { name: parsed("/talker") },
        Ask::Topics,
        Ask::Parameters { node: parsed("/talker") },
        Ask::Parameter { node: parsed("/talker"), name: "period_s".to_owned() },
        Ask::SetParameter { node: parsed("/talker"), parameter: parameter() },
        Ask::Lifecycle { node: parsed("/talker"), transition: Transition::Activate },
        Ask::Logs {
            task: Some(parsed("talker")),
            level: LogLevel::Warn,
            since_ms: Some(600_000),
            max_lines: 100,
        },
        Ask::Follow { level: LogLevel::Info, lease_ms: 30_000 },
        Ask::Vitals,
    ];
    let requests = asks.map(|ask| Request {
        id: parsed("q00000000000000d4"),
        ttl_ms: 10_000,
        ask,
        signed: None,
    });
    let action = Action {
        robot_id: parsed("r00000000000000a1"),
        instance: parsed("i00000000000000c3"),
        id: parsed("q00000000000000d4"),
        ask: Ask::Lifecycle { node: parsed("/talker"), transition: Transition::Activate },
    };
    check("action.json", &action);
    check_tolerance::<Action>("action.json");
    check("requests.json", &requests.to_vec());
    check_tolerance::<Vec<Request>>("requests.json");
    let newer =
        json!({"id": "q00000000000000d4", "ttl_ms": 1, "ask": {"type": "levitate", "height_m": 2}});
    assert_eq!(serde_json::from_value::<Request>(newer).expect("tolerated").ask, Ask::Unknown);

    let summary = NodeSummary {
        name: parsed("/talker"),
        task: Some(parsed("talker")),
        lifecycle: Some(LifecycleState::Active),
    };
    let endpoint =
        |name: &str, kind: &str| vec![Endpoint { name: parsed(name), kind: kind.to_owned() }];
    let detail = NodeDetail {
        node: summary.clone(),
        publishers: endpoint("/chatter", "std_msgs/msg/String"),
        subscriptions: Vec::new(),
        services: endpoint("/talker/say", "std_srvs/srv/Trigger"),
        clients: Vec::new(),
    };
    let topic = TopicSummary {
        name: parsed("/chatter"),
        types: vec!["std_msgs/msg/String".to_owned()],
        publishers: vec![parsed("/talker")],
        subscriptions: Vec::new(),
    };
    let answers = [
        Answer::Nodes { age_ms: 20, nodes: vec![summary] },
        Answer::Node { age_ms: 20, nodes: vec![detail] },
        Answer::Topics { age_ms: 20, topics: vec![topic] },
        Answer::Parameters { parameters: vec![parameter()] },
        Answer::ParameterSet { parameter: parameter() },
        Answer::Lifecycle { state: LifecycleState::Active },
        Answer::Logs(log_batch()),
        Answer::Following,
        Answer::Vitals(crate::fleet::vitals()),
    ];
    let refusal = Refusal {
        code: "no_such_node".to_owned(),
        text: "no node /talker on the graph".to_owned(),
    };
    let outcomes = answers.map(Outcome::Answer).into_iter().chain([Outcome::Refusal(refusal)]);
    let reply = |outcome| Reply { robot_id: robot(), id: parsed("q00000000000000d4"), outcome };
    check("replies.json", &outcomes.map(reply).collect::<Vec<_>>());
    check_tolerance::<Vec<Reply>>("replies.json");
    check("log_batch.json", &log_batch());
    check_tolerance::<LogBatch>("log_batch.json");
}

fn parameter() -> Parameter {
    Parameter { name: "period_s".to_owned(), value: json!(0.5) }
}

fn log_batch() -> LogBatch {
    let line = LogLine {
        at_ms: 1_800_000_000_000,
        level: LogLevel::Warn,
        source: LogSource::Rosout,
        task: Some(parsed("talker")),
        node: Some(parsed("/talker")),
        text: "nobody listens".to_owned(),
    };
    LogBatch { robot_id: robot(), now_ms: 1_800_000_000_250, lines: vec![line], suppressed: 3 }
}

#[test]
fn package_documents() {
    check("task_manifest.json", &manifest());
    assert_eq!(manifest().problems(), []);
    check("oci_manifest.json", &ImageManifest::package(blob("config"), blob("content")));
    check_tolerance::<ImageManifest>("oci_manifest.json");
}

#[test]
fn publisher_documents() {
    let keys = [1, 2, 3].map(|seed| SigningKey::from_bytes([seed; 32]));
    let public = |keys: &[SigningKey]| keys.iter().map(SigningKey::public_key).collect::<Vec<_>>();
    let statement = PackageStatement { package: package() };
    check("package_statement.json", &statement);
    check_tolerance::<PackageStatement>("package_statement.json");
    check("package_signature.json", &statement.seal(&keys[0]));
    let list = PublisherList {
        version: 3,
        issued_at_ms: 1_800_000_000_000,
        expires_at_ms: 1_807_776_000_000,
        publishers: Role::new(public(&keys[..2]), 2).expect("a role"),
        keepers: Role::new(public(&keys[2..]), 1).expect("a role"),
        withdrawn: vec![Digest::of(b"manifest of a bad one")],
    };
    check("publisher_list.json", &list);
    check_tolerance::<PublisherList>("publisher_list.json");
    let manifest = ImageManifest::signed_document(
        SIGNATURE_ARTIFACT,
        blob("envelope"),
        Some(blob("manifest")),
    );
    check("signature_manifest.json", &manifest);
    assert_eq!(manifest.lone_envelope(), Some(blob("envelope")));
    assert_eq!(ImageManifest::package(blob("config"), blob("content")).lone_envelope(), None);
}

#[test]
fn api_documents() {
    check(
        "error.json",
        &serde_json::from_value::<ErrorBody>(
            json!({"error": {"code": "not_found", "message": "no robot \"x\""}}),
        )
        .expect("json"),
    );
    check("event_removed.json", &Event::RobotRemoved { id: robot() });
    check_text(
        "enroll_request.json",
        &EnrollRequest {
            mac: parsed("02:00:00:00:00:01"),
            name: Some(parsed("atlas")),
            labels: [(parsed("site"), parsed("lab"))].into(),
            client_key: Some(SigningKey::from_bytes([7; 32]).public_key()),
        },
    );
    check_text(
        "enroll_response.json",
        &EnrollResponse {
            robot_id: robot(),
            name: parsed("atlas"),
            token: "tskr_…".to_owned(),
            mqtt: MqttEndpoint {
                host: None,
                port: 1883,
                prefix: TopicPrefix::default(),
                tls: true,
                external: None,
                alternatives: Vec::new(),
            },
            awaits_approval: false,
        },
    );
    let external = Some(ExternalBroker {
        password: "…".to_owned(),
        client_id: Some("r00000000000000a1-…".to_owned()),
        ca_pin: Some(task_proto::CaPin::of(b"authority")),
    });
    check(
        "mqtt_endpoint.json",
        &MqttEndpoint {
            host: Some("broker.lab".to_owned()),
            port: 1884,
            prefix: TopicPrefix::default(),
            tls: true,
            external,
            alternatives: vec![BrokerAddress {
                host: Some("broker2.lab".to_owned()),
                port: 8883,
                tls: true,
            }],
        },
    );
    check_text("robot_token.json", &RobotToken { token: "tskr_…".to_owned() });
    check_text(
        "create_deployment.json",
        &CreateDeployment {
            package: parsed("talker"),
            manifest: Digest::of(b"manifest"),
            selector: parsed("site=lab"),
            delivery: DeliveryChoice::Adaptive,
            priority: 0,
            batch: Some(10),
            max_failures: Some(1),
            expires_in_s: None,
            restart: false,
            dry_run: false,
        },
    );
}

/// The last part of a blob of 1,030 bytes, in hexadecimal digits.
#[test]
fn part_message() {
    let blob: Vec<u8> = (0..1030).map(|at| (at % 256) as u8).collect();
    let part = Part { index: 1, count: 2, part_bytes: 1024, bytes: &blob[1024..] };
    let written = part.encode().iter().map(|byte| format!("{byte:02x}")).collect::<String>() + "\n";
    update_golden("part.hex", &written);
    assert_eq!(written, golden("part.hex"), "parts have changed on the wire");
    assert_eq!(Part::decode(&part.encode(), blob.len() as u64), Ok(part));
}

#[test]
fn output_documents() {
    let file = |path: &str| OutputFile { path: parsed(path), blob: blob(path) };
    let output = OutputSet {
        robot_id: robot(),
        task: parsed("mapping"),
        version: parsed("1.2.0"),
        deployment: parsed("d00000000000000b2"),
        run: 2,
        files: vec![file("maps/corridor.pgm"), file("maps/corridor.yaml")],
    };
    check("output_set.json", &output);
    check_tolerance::<OutputSet>("output_set.json");
    check("output_manifest.json", &output.manifest(blob("config")));
    let (robot_name, manifest) = (parsed("atlas"), Digest::of(b"manifest"));
    let view = OutputView { robot_name, manifest, pushed_at_ms: 1_800_000_000_000, output };
    check("output_view.json", &view);
    check_tolerance::<OutputView>("output_view.json");
    check_text("output_list.json", &OutputList { outputs: vec![view] });
}

#[test]
fn log_documents() {
    let view = LogsView {
        from: LogsFrom::Server,
        age_ms: 61_000,
        reason: Some("atlas is not connected over MQTT".to_owned()),
        lines: log_batch().lines,
        suppressed: 3,
    };
    check("logs_view.json", &view);
    check_tolerance::<LogsView>("logs_view.json");
    let events = [
        LogEvent::Following,
        LogEvent::Away { reason: "atlas is not connected over MQTT".to_owned() },
        LogEvent::Lines { lines: log_batch().lines, suppressed: 3 },
    ];
    check("log_events.json", &events.to_vec());
    check_tolerance::<Vec<LogEvent>>("log_events.json");
}

#[test]
fn traffic_documents() {
    let traffic = Traffic {
        bytes_in: 1,
        bytes_out: 2,
        packets_in: 3,
        packets_out: 4,
        messages_in: 5,
        messages_out: 6,
        acks_in: 7,
        acks_out: 8,
    };
    check("mqtt_connection.json", &MqttConnection { since_ms: 1_800_000_000_000, traffic });
    let info = ServerInfo {
        version: "0.1.0".to_owned(),
        key: SigningKey::from_bytes([7; 32]).public_key(),
        ca_pin: Some(task_proto::CaPin::of(b"authority")),
        mqtt: "127.0.0.1:1883".to_owned(),
        now_ms: 1_800_000_000_000,
        traffic: MqttTraffic {
            robots_connected: 1,
            connections_accepted: 2,
            connections_refused: 3,
            messages_refused: 4,
            messages_dropped: 5,
            all: traffic,
        },
        http: HttpTraffic { connections: 6, requests: 7, bytes_in: 8, bytes_out: 9 },
        conduct: PenaltyTotals { slowed: 3, cut: 2, turned_away: 1 },
    };
    check_text("server_info.json", &info);
}

#[test]
fn values_of_a_newer_version_are_tolerated() {
    let mut value = serde_json::to_value(report()).expect("json");
    value["tasks"][0]["phase"] = json!("levitating");
    value["tasks"][1]["failure"]["code"] = json!("gravity_lost");
    let read: Report = serde_json::from_value(value).expect("tolerated");
    assert_eq!(read.tasks[0].phase, Phase::Unknown);
    assert_eq!(read.tasks[1].failure.as_ref().map(|f| f.code.as_str()), Some("gravity_lost"));

    let mut value = serde_json::to_value(desired_state()).expect("json");
    value["tasks"][0]["delivery"] = json!("by-pigeon");
    let read: DesiredState = serde_json::from_value(value).expect("tolerated");
    assert_eq!(read.tasks[0].delivery, Delivery::PushPull);
}
