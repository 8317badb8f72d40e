//! Robots' vitals, their settings, the outcomes of their tasks, and the server's status.

use serde_json::json;
use task_proto::api::{
    AssignmentView, BrokerStatus, DatabaseStatus, DeliveryDecision, DiskStatus, EditRobot, Event,
    FeedEntry, FeedKind, FeedPage, HttpTraffic, LimitView, ListenerView, MqttTraffic, NodeFigures,
    NodeState, NodeView, PastAssignment, ReportStatus, RobotCounts, RobotSession, RuleView,
    ServerRules, ServerStatus, SessionList, SiteStatus, Subscription, TaskHistory, TimelineEntry,
    Traffic, TransferStatus, VitalsView,
};
use task_proto::desired::settings::{EffectiveSettings, RobotLimits, RobotSettings};
use task_proto::desired::{Delivery, DesiredState, TargetState};
use task_proto::messages::report::{Failure, FailureCode, Phase, Report};
use task_proto::packages::manifest::TaskKind;
use task_proto::telemetry::log::LogLevel;
use task_proto::telemetry::vitals::{Telemetry, Vitals};

use crate::golden::{check, check_tolerance, golden, package, parsed, robot};

pub fn settings() -> RobotSettings {
    RobotSettings {
        underlays: Some(vec![parsed("/opt/ros/jazzy/setup.bash")]),
        workspace: Some(parsed("/home/robot/ros_ws")),
        ros_domain_id: Some(7),
        limits: RobotLimits { task_memory_mb: Some(512), ..RobotLimits::default() },
        forward_level: Some(LogLevel::Error),
        unreadable: Vec::new(),
    }
}

pub fn effective_settings() -> EffectiveSettings {
    let own = vec!["ros_domain_id".to_owned()];
    EffectiveSettings { values: settings(), own, refused: vec!["workspace".to_owned()] }
}

pub fn vitals() -> Vitals {
    Vitals {
        at_ms: 1_800_000_000_000,
        cpu_percent: Some(12.5),
        memory_used_bytes: Some(1_200_000_000),
        memory_total_bytes: Some(4_000_000_000),
        disk_used_bytes: Some(9_000_000_000),
        disk_total_bytes: Some(32_000_000_000),
        network_in_bytes_per_s: Some(2400),
        network_out_bytes_per_s: Some(310),
        load_1m: Some(0.42),
        battery_percent: Some(80),
        temperature_c: Some(51.3),
    }
}

#[test]
fn vitals_documents() {
    check("telemetry.json", &Telemetry { robot_id: robot(), vitals: vitals() });
    check_tolerance::<Telemetry>("telemetry.json");
    let little = Vitals { at_ms: 1_799_999_940_000, ..Vitals::default() };
    check("vitals_view.json", &VitalsView { samples: vec![little, vitals()] });
    check_tolerance::<VitalsView>("vitals_view.json");
}

#[test]
fn robot_settings_documents() {
    check("robot_settings.json", &settings());
    check_tolerance::<RobotSettings>("robot_settings.json");
    check("effective_settings.json", &effective_settings());
    check_tolerance::<EffectiveSettings>("effective_settings.json");
    let edit = |json| serde_json::from_value::<EditRobot>(json).expect("parses").settings;
    assert_eq!(edit(json!({})), None);
    assert_eq!(edit(json!({"settings": null})), Some(None));
    assert_eq!(
        edit(json!({"settings": {"workspace": "/ws"}})).flatten().and_then(|s| s.workspace),
        parsed_path("/ws")
    );
}

fn parsed_path(text: &str) -> Option<task_proto::AbsolutePath> {
    Some(parsed(text))
}

#[test]
fn unreadable_settings_leave_the_others_readable() {
    let mut value: serde_json::Value =
        serde_json::from_str(&golden("desired_state.json")).expect("json");
    value["settings"]["workspace"] = json!("ws");
    value["settings"]["limits"]["log_bytes"] = json!("many");
    let read: DesiredState = serde_json::from_value(value.clone()).expect("tolerated");
    let unreadable = vec!["limits.log_bytes".to_owned(), "workspace".to_owned()];
    let rest = RobotSettings { workspace: None, unreadable, ..read.settings.clone() };
    assert_eq!((&read.settings, read.tasks.len()), (&rest, 1));
    let set = read.settings;
    assert!(set.underlays.is_some() && set.ros_domain_id.is_some(), "the rest is read: {set:?}");
    // A document of an older server.
    value.as_object_mut().expect("an object").remove("settings");
    assert!(serde_json::from_value::<DesiredState>(value).expect("reads").settings.is_empty());
    let mut value: serde_json::Value = serde_json::from_str(&golden("report.json")).expect("json");
    value["host"]["settings"]["forward_level"] = json!("whisper");
    let read: Report = serde_json::from_value(value).expect("tolerated");
    assert_eq!((read.host.settings, read.tasks.len()), (None, 2));
}

#[test]
fn task_history_documents() {
    let timeline = vec![
        TimelineEntry { phase: Phase::Fetching, at_ms: 1_800_000_000_100, attempt: 1 },
        TimelineEntry { phase: Phase::Fetching, at_ms: 1_800_000_003_000, attempt: 2 },
        TimelineEntry { phase: Phase::Failed, at_ms: 1_800_000_003_400, attempt: 2 },
    ];
    let decision = DeliveryDecision {
        mechanism: Delivery::PushPull,
        rule: "otherwise".to_owned(),
        because: "size 9.7 MB > 4 KB".to_owned(),
    };
    let past = PastAssignment {
        deployment: parsed("d00000000000000b2"),
        package: package(),
        kind: TaskKind::Service,
        released: true,
        wanted: Some(TargetState::Running),
        phase: Phase::Failed,
        progress: None,
        failure: Some(Failure::new(FailureCode::DISK_FULL, "2 GB are needed, 1 GB is free")),
        attempts: 2,
        delivery: Some(decision.clone()),
        timeline: timeline.clone(),
        created_at_ms: 1_800_000_000_000,
        updated_at_ms: 1_800_000_003_400,
        superseded_by: None,
    };
    check(
        "task_history.json",
        &TaskHistory { assignments: vec![past], next: Some(parsed("d00000000000000b1")) },
    );
    check_tolerance::<TaskHistory>("task_history.json");
    let view = AssignmentView {
        robot: robot(),
        name: parsed("atlas"),
        online: true,
        released: true,
        delivery: Some(decision),
        phase: Phase::Failed,
        progress: None,
        failure: None,
        attempts: 2,
        superseded_by: None,
        updated_at_ms: 1_800_000_003_400,
        timeline: Some(timeline),
    };
    check("assignment_view.json", &view);
    check_tolerance::<AssignmentView>("assignment_view.json");
}

#[test]
fn server_status_documents() {
    let site = |site: Option<&str>, rtt_ms: Option<u64>| SiteStatus {
        site: site.map(parsed),
        robots: 3,
        online: 2,
        throughput_bytes_per_s: rtt_ms.map(|_| 2_400_000),
        rtt_ms,
    };
    let status = ServerStatus {
        version: "0.1.0".to_owned(),
        uptime_s: 3600,
        now_ms: 1_800_000_000_000,
        robots: RobotCounts { known: 5, online: 4 },
        mqtt: MqttTraffic::default(),
        http: HttpTraffic::default(),
        transfers: TransferStatus { active: 2, waiting: 7, bytes_per_s: 12_000_000 },
        sites: vec![site(Some("lab"), Some(31)), site(None, None)],
        reports: ReportStatus {
            per_s: 120.5,
            latency_ms_p50: Some(1.5),
            latency_ms_p99: Some(12.0),
        },
        database: DatabaseStatus {
            kind: "sqlite".to_owned(),
            size_bytes: Some(4_194_304),
            latency_ms: 0.2,
            problem: None,
            fully_checked_at_ms: None,
            guard: None,
        },
        disk: DiskStatus { free_bytes: 9, total_bytes: 10, packages_bytes: 1 },
        broker: BrokerStatus {
            kind: "embedded".to_owned(),
            healthy: true,
            detail: "in this server".to_owned(),
        },
        listeners: vec![ListenerView {
            kind: "http".to_owned(),
            address: "127.0.0.1:8080".to_owned(),
            tls: false,
        }],
        nodes: vec![
            NodeView {
                name: parsed("one"),
                url: Some("https://10.0.0.11:8080".to_owned()),
                version: "0.1.0".to_owned(),
                state: NodeState::Serving,
                answers: true,
                heartbeat_age_ms: None,
                figures: Some(NodeFigures { uptime_s: 3600, ..NodeFigures::default() }),
            },
            NodeView {
                name: parsed("two"),
                url: None,
                version: "0.1.0".to_owned(),
                state: NodeState::Lost,
                answers: false,
                heartbeat_age_ms: Some(12_000),
                figures: None,
            },
        ],
    };
    check("server_status.json", &status);
    check_tolerance::<ServerStatus>("server_status.json");
    assert_eq!(
        serde_json::from_str::<NodeState>("\"asleep\"").expect("tolerated"),
        NodeState::Unknown
    );
    let session = RobotSession {
        robot: robot(),
        name: parsed("atlas"),
        since_ms: 1_800_000_000_000,
        address: Some("192.0.2.7:51234".to_owned()),
        subscriptions: vec![Subscription {
            topic_filter: "taskd/v1/r/r00000000000000a1/desired".to_owned(),
            qos: 1,
        }],
        traffic: Traffic::default(),
        node: Some(parsed("one")),
    };
    check(
        "session_list.json",
        &SessionList { sessions: vec![session], total: 2, next: Some(parsed("atlas")) },
    );
    check_tolerance::<SessionList>("session_list.json");
    let rule = RuleView {
        order: 1,
        name: "tiny".to_owned(),
        condition: "size ≤ 4 KB".to_owned(),
        mechanism: Delivery::Inline,
        own: false,
    };
    let limit = LimitView { key: "transfers.at_once".to_owned(), value: "none".to_owned() };
    check("server_rules.json", &ServerRules { rules: vec![rule], limits: vec![limit] });
    check_tolerance::<ServerRules>("server_rules.json");
}

#[test]
fn feed_documents() {
    let entry = FeedEntry {
        number: 1_800_000_000_007,
        at_ms: 1_800_000_000_000,
        kind: FeedKind::TaskFailed,
        level: LogLevel::Error,
        robot: Some(robot()),
        robot_name: Some(parsed("atlas")),
        deployment: Some(parsed("d00000000000000b2")),
        text: "talker 1.2.0 failed on atlas: build_failed: colcon build ended with status 1"
            .to_owned(),
    };
    check("feed_page.json", &FeedPage { entries: vec![entry.clone()] });
    check_tolerance::<FeedPage>("feed_page.json");
    check("event_feed.json", &Event::Feed { entry });
    let newer: FeedKind = serde_json::from_value(json!("robot_levitated")).expect("tolerated");
    assert_eq!(newer, FeedKind::Unknown);
}

#[test]
fn delivery_decision_document() {
    let decision = DeliveryDecision {
        mechanism: Delivery::DirectPush,
        rule: "many small".to_owned(),
        because: "size 20 KB ≤ 256 KB, robots 40 ≥ 8".to_owned(),
    };
    check("delivery_decision.json", &decision);
    check_tolerance::<DeliveryDecision>("delivery_decision.json");
}
