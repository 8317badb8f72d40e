//! Files that come back when there are more of them than the server keeps.

use task_proto::api::OutputList;
use tempfile::TempDir;

use crate::harness::{Robot, Server, eventually, write_package};

#[tokio::test(flavor = "multi_thread")]
async fn outputs_the_server_would_refuse_are_not_uploaded() {
    let dir = TempDir::new().expect("temp dir");
    let server =
        Server::start_with(&dir.path().join("server"), &[("TASKD_ROBOTS_OUTPUT_BYTES", "64MB")])
            .await;
    let _robot = Robot::start(&server, dir.path(), "robot-1", 1).await;
    let push = async |name: &str, script: &str| {
        let package = dir.path().join(name);
        write_package(&package, name, "1.0.0", "job", script);
        let mut manifest = std::fs::read_to_string(package.join("task.toml")).expect("task.toml");
        manifest.push_str("[outputs]\npaths = ['*.bin']\n");
        std::fs::write(package.join("task.toml"), manifest).expect("task.toml");
        server.push(&package, "*").await;
    };
    push("large", "head -c 70000000 /dev/zero > large.bin").await;
    eventually("why the files don't come", async || {
        let robot = serde_json::to_string(&server.robot("robot-1").await?).ok()?;
        (robot.contains("outputs_lost") && robot.contains("(robots.output_bytes)")).then_some(())
    })
    .await;
    let blobs = std::fs::read_dir(server.data().join("blobs/sha256")).expect("a directory");
    let largest =
        blobs.map(|blob| blob.and_then(|blob| blob.metadata()).expect("a blob").len()).max();
    assert!(largest.is_some_and(|bytes| bytes < 1_000_000), "{largest:?}");

    push("small", "head -c 1000 /dev/zero > small.bin").await;
    let listed = eventually("the outputs that fit", async || {
        let list: OutputList = serde_json::from_value(server.get("/api/v1/outputs").await?).ok()?;
        (!list.outputs.is_empty()).then_some(list)
    })
    .await;
    assert_eq!(listed.outputs[0].output.task.as_str(), "small");
}
