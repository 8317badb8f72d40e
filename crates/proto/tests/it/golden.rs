//! Compares what is written with `tests/golden/`, and reads it as a newer and an older version of the other side would.
//! After a wanted change: `UPDATE_GOLDEN=1 cargo test -p task-proto`, and change docs/protocol.md with it.

use std::collections::BTreeMap;
use std::fmt::Debug;
use std::path::Path;

use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::{Value, json};
use task_proto::api::{CreateDeployment, EnrollRequest, EnrollResponse, ErrorBody, Event, MqttEndpoint, ReportReply};
use task_proto::desired::{BlobRef, Delivery, DesiredState, DesiredTask, Doorbell, PackageRef, Wanted};
use task_proto::envelope::{DESIRED_STATE_TYPE, Envelope, SigningKey};
use task_proto::manifest::{Build, BuildTool, ContentFacts, Outputs, Ready, Requires, Run, TaskKind, TaskManifest};
use task_proto::oci::ImageManifest;
use task_proto::report::{
    ActiveVersion, Condition, Failure, FailureCode, HostFacts, Phase, Progress, Report, Status, TaskReport,
};
use task_proto::topic::TopicPrefix;
use task_proto::{Digest, Generation, RobotId};

fn parsed<T: std::str::FromStr<Err: Debug>>(text: &str) -> T {
    text.parse().expect(text)
}

fn blob(text: &str) -> BlobRef {
    BlobRef { digest: Digest::of(text.as_bytes()), size: text.len() as u64 }
}

fn package() -> PackageRef {
    PackageRef {
        name: parsed("talker"),
        version: parsed("1.2.0"),
        manifest: blob("manifest"),
        config: blob("config"),
        content: blob("content"),
    }
}

fn robot() -> RobotId {
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
            wanted: Wanted::Running,
            run: 1,
            delivery: Delivery::PushPull,
        }],
    }
}

fn report() -> Report {
    Report {
        robot_id: robot(),
        start: 3,
        instance: parsed("i00000000000000c3"),
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
        },
        conditions: vec![Condition { code: "held".to_owned(), text: "held at the robot".to_owned() }],
        tasks: vec![
            TaskReport {
                task: parsed("mapper"),
                deployment: parsed("d00000000000000b1"),
                package: package(),
                wanted: Wanted::Running,
                run: 2,
                kind: None,
                phase: Phase::Fetching,
                phase_ms: 1_500,
                progress: Some(Progress { done: 1, total: 7 }),
                attempts: 1,
                restarts: 0,
                failure: None,
                active: None,
            },
            TaskReport {
                task: parsed("talker"),
                deployment: parsed("d00000000000000b2"),
                package: package(),
                wanted: Wanted::Running,
                run: 1,
                kind: Some(TaskKind::Service),
                phase: Phase::Failed,
                phase_ms: 9_000,
                progress: None,
                attempts: 3,
                restarts: 1,
                failure: Some(Failure::new(FailureCode::BUILD_FAILED, "colcon build ended with status 1")),
                active: Some(ActiveVersion {
                    deployment: parsed("d00000000000000b0"),
                    version: parsed("1.1.0"),
                    pid: 4711,
                }),
            },
        ],
    }
}

fn manifest() -> TaskManifest {
    TaskManifest {
        name: parsed("talker"),
        version: parsed("1.2.0"),
        build: Build { tool: BuildTool::Colcon },
        run: Run {
            exec: Some(vec!["install/talker/lib/talker/talker".to_owned()]),
            kind: TaskKind::Service,
            ..Run::default()
        },
        ready: Ready { nodes: vec!["/talker".to_owned()], ..Ready::default() },
        parameters: BTreeMap::from([("/talker".to_owned(), BTreeMap::from([("period_s".to_owned(), json!(0.5))]))]),
        outputs: Outputs { paths: vec!["maps/*.pgm".to_owned()] },
        requires: Requires { ros_distro: vec!["jazzy".to_owned(), "kilted".to_owned()], ..Requires::default() },
        exec_depends: vec!["rclpy".to_owned()],
        content: ContentFacts { tar_digest: Digest::of(b"tar"), tar_size: 10_240, entries: 9 },
    }
}

/// Adds a field nobody knows to every object.
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

fn check<T: Serialize + DeserializeOwned + PartialEq + Debug>(name: &str, value: &T) {
    check_text::<T>(name, value);
    let text = golden(name);
    assert_eq!(&serde_json::from_str::<T>(&text).expect("golden file parses"), value, "{name} reads back");
}

fn check_text<T: Serialize + DeserializeOwned>(name: &str, value: &T) {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden").join(name);
    let written = serde_json::to_string_pretty(value).expect("json") + "\n";
    if std::env::var_os("UPDATE_GOLDEN").is_some() {
        std::fs::write(&path, &written).expect("golden file written");
    }
    assert_eq!(written, golden(name), "{name} has changed on the wire");
    serde_json::from_str::<T>(&written).expect("reads what it wrote");
}

/// A reader of this version must not mind what a later version adds. Only where maps hold no free keys.
fn check_tolerance<T: DeserializeOwned + PartialEq + Debug>(name: &str) {
    let value: Value = serde_json::from_str(&golden(name)).expect("json");
    let now: T = serde_json::from_value(value.clone()).expect("reads its own");
    assert_eq!(serde_json::from_value::<T>(from_the_future(&value)).expect("reads the future"), now, "{name}");
}

fn golden(name: &str) -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden").join(name);
    std::fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

#[test]
fn documents_between_server_and_robot() {
    let key = SigningKey::from_bytes([7; 32]);
    let state = desired_state();
    check("desired_state.json", &state);
    let envelope = Envelope::seal(DESIRED_STATE_TYPE, &serde_json::to_vec(&state).expect("json"), &key);
    check("doorbell_state.json", &Doorbell::State(envelope.clone()));
    check("doorbell_notice.json", &Doorbell::Notice { generation: Generation(8) });
    check("report.json", &report());
    check("status.json", &Status { online: true, start: 3, instance: parsed("i00000000000000c3"), connection: 2 });
    let reply = ReportReply {
        generation: Generation(7),
        name: parsed("atlas"),
        labels: [(parsed("site"), parsed("lab"))].into(),
    };
    check("report_reply.json", &reply);

    check_tolerance::<DesiredState>("desired_state.json");
    check_tolerance::<Doorbell>("doorbell_state.json");
    check_tolerance::<Doorbell>("doorbell_notice.json");
    check_tolerance::<Report>("report.json");
    check_tolerance::<Status>("status.json");
    let payload = envelope.open(DESIRED_STATE_TYPE, &key.public_key()).expect("signed");
    assert_eq!(serde_json::from_slice::<DesiredState>(&payload).expect("json"), state);
}

#[test]
fn documents_of_a_package() {
    check("task_manifest.json", &manifest());
    assert_eq!(manifest().problems(), []);
    check("oci_manifest.json", &ImageManifest::package(blob("config"), blob("content")));
    check_tolerance::<ImageManifest>("oci_manifest.json");
}

#[test]
fn documents_of_the_api() {
    check(
        "error.json",
        &serde_json::from_value::<ErrorBody>(json!({"error": {"code": "not_found", "message": "no robot \"x\""}}))
            .expect("json"),
    );
    check("event_removed.json", &Event::RobotRemoved { id: robot() });
    check_text(
        "enroll_request.json",
        &EnrollRequest {
            mac: parsed("02:00:00:00:00:01"),
            name: Some(parsed("atlas")),
            labels: [(parsed("site"), parsed("lab"))].into(),
        },
    );
    check_text(
        "enroll_response.json",
        &EnrollResponse {
            robot_id: robot(),
            name: parsed("atlas"),
            token: "tskr_…".to_owned(),
            mqtt: MqttEndpoint { host: None, port: 1883, prefix: TopicPrefix::default() },
        },
    );
    check_text(
        "create_deployment.json",
        &CreateDeployment {
            package: parsed("talker"),
            manifest: Digest::of(b"manifest"),
            selector: parsed("site=lab"),
            delivery: Delivery::PushPull,
            batch: Some(10),
            max_failures: Some(1),
            expires_in_s: None,
            dry_run: false,
        },
    );
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
