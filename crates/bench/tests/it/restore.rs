//! A database put back to an older copy: the robots know more than the server, and nothing that
//! runs is harmed.

use std::path::Path;

use task_proto::messages::report::Phase;

use crate::harness::{Fleet, eventually};

/// Copies the database of a server that is stopped.
fn copy_database(from: &Path, to: &Path) {
    assert!(from.join("taskd.sqlite").exists(), "no database in {}", from.display());
    std::fs::create_dir_all(to).expect("directory");
    for name in ["taskd.sqlite", "taskd.sqlite-wal", "taskd.sqlite-shm"] {
        let _ = std::fs::remove_file(to.join(name));
        if from.join(name).exists() {
            std::fs::copy(from.join(name), to.join(name)).expect("copied");
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn restored_database_stops_no_running_task() {
    let mut fleet = Fleet::start(2).await;
    let first = fleet.package("first", "1.0.0", "service", "exec sleep 1000\n");
    fleet.server.push(&first, "*").await;
    for robot in ["robot-1", "robot-2"] {
        fleet.server.wait_phase(robot, "first", Phase::Running).await;
    }
    let backup = fleet.dir.path().join("backup");
    fleet.server.terminate();
    copy_database(fleet.server.data(), &backup);
    fleet.server.restart().await;

    for name in ["second", "third", "fourth"] {
        let package = fleet.package(name, "1.0.0", "service", "exec sleep 1000\n");
        fleet.server.push(&package, "*").await;
        for robot in ["robot-1", "robot-2"] {
            fleet.server.wait_phase(robot, name, Phase::Running).await;
        }
    }
    let mut pids = Vec::new();
    for robot in ["robot-1", "robot-2"] {
        let view = fleet.server.robot(robot).await.expect("known");
        pids.extend(view.tasks.iter().map(|t| t.active.as_ref().expect("running").pid));
    }
    assert_eq!(pids.len(), 8);

    fleet.server.terminate();
    copy_database(&backup, fleet.server.data());
    fleet.server.restart().await;
    for robot in ["robot-1", "robot-2"] {
        eventually(&format!("{robot} to be diverged"), async || {
            let view = fleet.server.robot(robot).await?;
            view.conditions.iter().any(|c| c.code == "diverged").then_some(())
        })
        .await;
    }
    let alive = |pids: &[u32]| pids.iter().all(|pid| Path::new(&format!("/proc/{pid}")).exists());
    assert!(alive(&pids), "a restored database stopped a task");

    let fifth = fleet.package("fifth", "1.0.0", "service", "exec sleep 1000\n");
    fleet.server.push(&fifth, "*").await;
    for robot in ["robot-1", "robot-2"] {
        let view = fleet.server.wait_phase(robot, "fifth", Phase::Running).await;
        assert!(!view.conditions.iter().any(|c| c.code == "diverged"), "{:?}", view.conditions);
        assert_eq!(view.tasks.len(), 5, "{:?}", view.tasks);
    }
    assert!(alive(&pids), "the next order stopped a task that the backup did not know");
}
