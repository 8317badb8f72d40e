//! A robot's settings and history over HTTP.

use reqwest::{Method, StatusCode};
use serde_json::json;
use task_proto::api::{DeploymentView, RobotView, TaskHistory};
use task_proto::messages::report::Phase;

use crate::harness::{TestServer, answer, refusal};

#[tokio::test]
async fn settings_are_checked_kept_and_cleared() {
    let server = TestServer::start().await;
    let robot = server.enroll("atlas").await;
    let edit =
        |body: serde_json::Value| server.request(Method::PATCH, "/api/v1/robots/atlas").json(&body);
    let settings = json!({
        "underlays": ["/opt/ros/jazzy/setup.bash"], "forward_level": "error",
        "limits": { "task_pids": 64 },
    });
    let view: RobotView = answer(edit(json!({ "settings": settings }))).await;
    assert_eq!(serde_json::to_value(&view.settings).expect("json"), settings);
    assert_eq!(
        serde_json::to_value(server.desired(&robot).await.settings).expect("json"),
        settings
    );
    for (bad, named) in [
        (json!({ "workspace": "ws" }), "settings"),
        (json!({ "underlays": ["/opt/../etc/x"] }), "settings"),
        (json!({ "limits": { "parallel_tasks": 65 } }), "settings: limits.parallel_tasks: 65"),
        (json!({ "gate": { "command": ["/bin/true"] } }), "settings.gate"),
        (json!({ "limits": { "task_pid": 1, "task_pids": 2 } }), "settings.limits.task_pid"),
    ] {
        let response = edit(json!({ "settings": bad })).send().await.expect("an answer");
        assert_eq!(response.status(), StatusCode::BAD_REQUEST, "{bad}");
        let text = response.text().await.expect("a body");
        assert!(text.contains(named), "{text}");
    }
    let view: RobotView = answer(edit(json!({ "labels": {} }))).await;
    assert!(view.settings.is_some(), "absent stays");
    let view: RobotView = answer(edit(json!({ "settings": null }))).await;
    assert_eq!(view.settings, None);
}

#[tokio::test]
async fn robot_history_and_timelines_are_shown_on_request() {
    let server = TestServer::start().await;
    let mut robot = server.enroll("atlas").await;
    let package = server.push("talker", "1.0.0").await;
    let deployment = server.deploy(&package, "atlas", "key-1").await;
    let state = server.desired(&robot).await;
    assert_eq!(server.report(&mut robot, &state, Phase::Running).await.status(), StatusCode::OK);
    let history: TaskHistory = server.get("/api/v1/robots/atlas/tasks").await;
    let past = &history.assignments[0];
    assert_eq!(
        (&past.deployment, past.phase, history.assignments.len()),
        (&deployment.id, Phase::Running, 1)
    );
    let phases = |timeline: &[task_proto::api::TimelineEntry]| {
        timeline.iter().map(|e| e.phase).collect::<Vec<_>>()
    };
    assert_eq!(phases(&past.timeline), [Phase::Assigned, Phase::Running]);
    let show = async |query: &str| {
        let view: DeploymentView =
            server.get(&format!("/api/v1/deployments/{}{query}", deployment.id)).await;
        view.assignments.expect("asked for").remove(0).timeline
    };
    assert_eq!(show("").await, None);
    assert_eq!(show("?timeline=true").await, Some(past.timeline.clone()));
    for bad in ["?limit=0", "?limit=201", "?before=x", "?x=1"] {
        let path = format!("/api/v1/robots/atlas/tasks{bad}");
        assert_eq!(refusal(server.request(Method::GET, &path)).await.0, 400, "{bad}");
    }
    let unknown = "/api/v1/robots/atlas/tasks?before=d00000000000000ff";
    assert_eq!(refusal(server.request(Method::GET, unknown)).await.0, 404);
}
