//! Real nodes' messages on ROS topics are kept with the task of the publishing process.

use task_agent::logs::Logs;
use task_agent::logs::archive::LogQuery;
use task_agent::ros::graph_access::GraphAccess;
use task_agent::ros::node_logs;
use task_agent::system::layout::DataDir;
use task_proto::messages::report::RosFacts;
use task_proto::telemetry::log::{LogLevel, LogLine, LogSource};

use crate::harness::within;
use crate::ros::{RosNode, open, program};

/// Longer than one poll of the ROS graph's participants, shorter than a test's limit.
const PAUSE: std::time::Duration = std::time::Duration::from_millis(200);

#[tokio::test(flavor = "multi_thread")]
async fn node_messages_are_kept_with_their_task() {
    let temp = tempfile::tempdir().unwrap();
    let data = DataDir::new(temp.path()).unwrap();
    let task = data.task(&"talker".parse().unwrap());
    std::fs::create_dir_all(task.logs()).unwrap();
    let run_dir = task.run().join("1");
    let graph = open(118).await;
    let keeping = tokio::spawn(node_logs::record_messages(graph.clone(), data.clone(), None));
    let in_namespace = |namespace| ["--ros-args", "-r", namespace];
    let environment = [("TASKD_RUN_DIR", run_dir.as_path())];
    let mut ours =
        RosNode::start_with("talker.py", 118, &in_namespace("__ns:=/ours"), &environment).await;
    let mut other = RosNode::start("talker.py", 118, &in_namespace("__ns:=/other")).await;
    let logs = Logs::new(data);
    let kept = async |task: Option<&str>| -> Vec<LogLine> {
        let task = task.map(|task| task.parse().unwrap());
        logs.query(LogQuery { task, level: LogLevel::Warn, since_ms: None, max_lines: 1000 })
            .await
            .unwrap()
    };
    let has = |lines: &[LogLine], text: &str| lines.iter().any(|line| line.text == text);
    // Messages sent before both sides have matched are lost, so each is sent until it arrives.
    let all = async {
        let mut tick = tokio::time::interval(PAUSE);
        loop {
            tick.tick().await;
            ours.order("warn low").await;
            other.order("warn a neighbour").await;
            ours.order("diagnose battery is low").await;
            let lines = kept(Some("talker")).await;
            if has(&lines, "low")
                && has(&lines, "battery: battery is low")
                && has(&kept(None).await, "a neighbour")
            {
                return lines;
            }
        }
    };
    let lines = within("all to be kept", all).await;
    assert!(!has(&lines, "a neighbour"), "{lines:?}");
    let said = lines.iter().find(|line| line.text == "low").unwrap();
    assert_eq!((said.level, said.source), (LogLevel::Warn, LogSource::Rosout));
    assert_eq!(said.node.as_ref().map(|node| node.as_str()), Some("/ours/talker"));
    let statuses = lines.iter().filter(|line| line.source == LogSource::Diagnostics).count();
    assert_eq!(statuses, 1, "a status that does not change is said once: {lines:?}");
    ours.leave().await;
    other.leave().await;
    graph.close().await;
    within("the end of the graph", keeping).await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn node_message_files_keep_the_size_limit_set_when_the_graph_opens() {
    let temp = tempfile::tempdir().unwrap();
    let data = DataDir::new(temp.path()).unwrap();
    let access =
        GraphAccess::of_robot("02:00:00:00:00:01".parse().unwrap(), data.clone(), program());
    access.limit(Some(4096));
    let facts = RosFacts {
        distro: "jazzy".to_owned(),
        rmw: None,
        domain_id: Some(119),
        localhost_only: true,
    };
    let graph = access.open(Some(&facts)).await.unwrap();
    let mut node = RosNode::start("talker.py", 119, &[]).await;
    let rotated = data.ros_log().with_extension("log.1");
    let filled = async {
        while !rotated.exists() {
            node.order(&format!("warn {}", "x".repeat(1000))).await;
        }
    };
    within("the file to be full", filled).await;
    node.leave().await;
    drop(access);
    graph.close().await;
}
