//! Power cuts: `kill -9` of agent and server at every kind of moment. Nothing is stuck, nothing is
//! lost.

use std::io::Write as _;

use rand::RngExt as _;
use rand::SeedableRng as _;
use task_proto::api::{DeploymentState, RobotView};
use task_proto::messages::report::Phase;
use taskbench::programs::database::{add_robots, sqlite_url};

use crate::harness::{Fleet, Robot, Server, eventually, open_directory, write_package};
use crate::proxy::Proxy;

fn pid_of(robot: &RobotView, task: &str) -> Option<u32> {
    Some(robot.tasks.iter().find(|t| t.task.as_str() == task)?.active.as_ref()?.pid)
}

#[tokio::test(flavor = "multi_thread")]
async fn fetch_resumes_after_a_power_cut() {
    const SIZE: usize = 200_000_000;
    let dir = tempfile::tempdir().expect("temp dir");
    let server = Server::start(&dir.path().join("server")).await;
    let proxy = Proxy::start(server.http, 30_000_000).await;
    let url = format!("http://{}", proxy.address);
    let mut robot = Robot::start_with(&server, dir.path(), "robot-1", 1, &url, &[]).await;

    let package = dir.path().join("heavy");
    write_package(&package, "heavy", "1.0.0", "service", "exec sleep 1000\n");
    // Random bytes do not compress, so the bytes transferred equal the bytes requested.
    let mut random = rand::rngs::SmallRng::seed_from_u64(1);
    let mut file = std::fs::File::create(package.join("ballast.bin")).expect("ballast");
    let mut chunk = vec![0; 1_000_000];
    for _ in 0..SIZE / chunk.len() {
        random.fill(&mut chunk[..]);
        file.write_all(&chunk).expect("written");
    }
    let deployment = server.push(&package, "*").await;
    let total = deployment.package.content.size;

    let blobs = robot.data().join("blobs/sha256");
    let part_bytes = || -> Option<u64> {
        let entries = std::fs::read_dir(&blobs).ok()?.filter_map(Result::ok);
        let parts = entries
            .filter(|entry| entry.path().extension().is_some_and(|extension| extension == "part"));
        Some(parts.filter_map(|entry| Some(entry.metadata().ok()?.len())).sum())
    };
    eventually("a third of the package to be kept", async || {
        (part_bytes()? > total / 3).then_some(())
    })
    .await;
    robot.kill();
    let part_bytes = part_bytes().expect("they stay");
    let before = proxy.bytes_to_clients();
    proxy.set_rate(1_000_000_000);
    robot.restart();
    server.wait_phase("robot-1", "heavy", Phase::Running).await;
    let after_restart = proxy.bytes_to_clients() - before;
    let left = total - part_bytes;
    assert!(
        after_restart < left + 1_000_000,
        "{after_restart} bytes were fetched, {left} were left"
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn running_task_survives_its_agent() {
    let mut fleet = Fleet::start(1).await;
    let package = fleet.package("steady", "1.0.0", "service", "exec sleep 1000\n");
    fleet.server.push(&package, "*").await;
    let before = fleet.server.wait_phase("robot-1", "steady", Phase::Running).await;
    let pid = pid_of(&before, "steady").expect("a pid");

    fleet.robots[0].kill();
    fleet.robots[0].restart();
    // Work that only the new agent can have done.
    let second = fleet.package("second", "1.0.0", "service", "exec sleep 1000\n");
    fleet.server.push(&second, "*").await;
    let after = fleet.server.wait_phase("robot-1", "second", Phase::Running).await;
    assert_eq!(pid_of(&after, "steady"), Some(pid));
    assert!(std::path::Path::new(&format!("/proc/{pid}")).exists());
}

/// The robots are only rows, enough that the order takes longer than its answer.
#[tokio::test(flavor = "multi_thread")]
async fn large_order_goes_on_after_a_server_crash() {
    const ROBOTS: u64 = 20_000;
    let dir = tempfile::tempdir().expect("temp dir");
    let mut server = Server::start(&dir.path().join("server")).await;
    let database = sqlite_url(&server.data().join("taskd.sqlite"));
    add_robots(&database, ROBOTS as u32).await.expect("added");
    let package = dir.path().join("steady");
    write_package(&package, "steady", "1.0.0", "service", "exec sleep 1000\n");
    let ordered = server.push(&package, "*").await;
    server.kill();
    let placing = ordered.placing.expect("the answer comes before the order is placed everywhere");
    assert!(placing.selected == ROBOTS && placing.placed < ROBOTS, "{placing:?}");
    server.restart().await;
    let placed = eventually("the order to be placed for all robots", async || {
        let view = server.deployment(ordered.id.as_str()).await?;
        view.placing.is_none().then_some(view)
    })
    .await;
    assert_eq!(placed.assignments.expect("there").len() as u64, ROBOTS);
    assert_eq!(placed.state, DeploymentState::Active);
}

#[tokio::test(flavor = "multi_thread")]
async fn order_survives_a_server_crash() {
    let mut fleet = Fleet::start(2).await;
    let package = fleet.package("steady", "1.0.0", "service", "exec sleep 1000\n");
    fleet.server.push(&package, "*").await;
    fleet.server.kill();
    fleet.server.restart().await;
    for robot in ["robot-1", "robot-2"] {
        fleet.server.wait_phase(robot, "steady", Phase::Running).await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn nothing_is_lost_after_a_hundred_power_cuts() {
    let seed = rand::random::<u64>();
    println!("seed {seed}");
    let mut random = rand::rngs::SmallRng::seed_from_u64(seed);
    let mut fleet = Fleet::start(2).await;
    // Each job leaves a line per start, so that a second start of one run would show.
    let starts = fleet.dir.path().join("starts");
    open_directory(&starts);
    let mut newest = String::new();
    let mut jobs = Vec::new();
    for cut in 0..100 {
        if cut % 10 == 0 {
            newest = format!("1.0.{cut}");
            let service = fleet.package("worker", &newest, "service", "exec sleep 1000\n");
            fleet.server.push(&service, "*").await;
            let script = format!("echo start >> {}/$TASKD_ASSIGNMENT-$$\n", starts.display());
            let job = fleet.package(&format!("job-{cut}"), "1.0.0", "job", &script);
            jobs.push(fleet.server.push(&job, "*").await.id);
        }
        let pause = std::time::Duration::from_millis(random.random_range(0..400));
        match random.random_range(0..3) {
            2 => {
                // A moment picked at random is the point of this test.
                tokio::time::sleep(pause).await;
                fleet.server.kill();
                fleet.server.restart().await;
            }
            robot => {
                tokio::time::sleep(pause).await;
                fleet.robots[robot].kill();
                fleet.robots[robot].restart();
            }
        }
    }
    for robot in ["robot-1", "robot-2"] {
        eventually(&format!("{robot} to run worker {newest}"), async || {
            let view = fleet.server.robot(robot).await?;
            let worker = view.tasks.iter().find(|t| t.task.as_str() == "worker")?;
            let active = worker.active.as_ref()?;
            (worker.phase == Phase::Running && active.version.as_str() == newest).then_some(())
        })
        .await;
    }
    for job in &jobs {
        eventually(&format!("job {job} to settle"), async || {
            let deployment = fleet.server.deployment(job.as_str()).await?;
            deployment.assignments?.iter().all(|a| a.phase.is_final()).then_some(())
        })
        .await;
        let deployment = fleet.server.deployment(job.as_str()).await.expect("known");
        for assignment in deployment.assignments.expect("assignments") {
            let started = std::fs::read_dir(&starts)
                .expect("directory")
                .filter(|f| {
                    f.as_ref()
                        .expect("entry")
                        .file_name()
                        .to_string_lossy()
                        .starts_with(job.as_str())
                })
                .count();
            assert!(started <= 2, "{job} was started {started} times on two robots");
            let interrupted =
                assignment.failure.as_ref().is_some_and(|f| f.code.as_str() == "interrupted");
            assert!(assignment.phase == Phase::Succeeded || interrupted, "{job}: {assignment:?}");
        }
    }
}
