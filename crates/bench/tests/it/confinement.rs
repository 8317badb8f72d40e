//! Whom tasks run as and what they may use, from the package to what the operator reads.

use task_proto::api::RobotView;
use task_proto::report::{Failure, Isolation, Phase};

use crate::harness::{Fleet, Robot, Server, TASK_USER, eventually, open_directory, write_package};
use crate::leftovers::processes_with;

async fn failure_of(server: &Server, task: &str, phase: Phase) -> Failure {
    let view = server.wait_phase("robot-1", task, phase).await;
    let found = view.tasks.into_iter().find(|t| t.task.as_str() == task).expect("the task");
    found.failure.expect("a failure")
}

async fn robot(server: &Server) -> RobotView {
    server.robot("robot-1").await.expect("the robot")
}

#[tokio::test(flavor = "multi_thread")]
async fn a_task_runs_as_the_task_user_in_a_home_of_its_own() {
    let fleet = Fleet::start(1).await;
    let found = fleet.dir.path().join("found");
    open_directory(&found);
    let identity = fleet.robots[0].data().join("identity.json");
    let script = format!(
        "id -u > {0}/user; cat {1} > {0}/identity; grep ^Seccomp: /proc/self/status > {0}/calls; touch \"$HOME/log\" written && echo \"$HOME\" > {0}/home\n",
        found.display(),
        identity.display()
    );
    let job = fleet.package("curious", "1.0.0", "job", &script);
    fleet.server.push(&job, "*").await;
    fleet.server.wait_phase("robot-1", "curious", Phase::Succeeded).await;
    let read = |name: &str| std::fs::read_to_string(found.join(name)).expect(name).trim().to_owned();
    assert_eq!(read("home"), own_home(&fleet.robots[0]));
    if nix::unistd::geteuid().is_root() {
        assert_eq!((read("user").as_str(), read("identity").as_str()), (TASK_USER, ""));
        assert_eq!(read("calls"), "Seccomp:\t2", "its system calls are filtered");
    } else {
        eprintln!("unavailable: only root can run a task as another user");
    }
}

fn own_home(robot: &Robot) -> String {
    if nix::unistd::geteuid().is_root() {
        robot.data().join("tasks/curious/home").display().to_string()
    } else {
        std::env::var("HOME").unwrap_or("/".to_owned())
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn without_a_task_user_a_robot_says_what_to_do_and_runs_nothing() {
    let dir = tempfile::tempdir().expect("temp dir");
    let server = Server::start(&dir.path().join("server")).await;
    let settings = [("TASK_AGENT_TASK_USER", "no-such-user")];
    let _robot = Robot::start_with(&server, dir.path(), "robot-1", 1, &server.url(""), &settings).await;
    let package = dir.path().join("idle");
    write_package(&package, "idle", "1.0.0", "service", "exec sleep 1000\n");
    server.push(&package, "*").await;
    let failure = failure_of(&server, "idle", Phase::Unmet).await;
    assert_eq!(failure.code.as_str(), "no_task_user");
    assert!(failure.text.contains("\"no-such-user\""), "{failure}");
    let conditions = robot(&server).await.conditions;
    let condition = conditions.iter().find(|condition| condition.code == "no_task_user").expect("a condition");
    assert_eq!(condition.text, failure.text);
    let run_dir = format!("TASKD_RUN_DIR={}", dir.path().display());
    assert_eq!(processes_with(run_dir.as_bytes()), Vec::<i32>::new());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_task_that_wants_eight_gigabytes_fails_alone_and_by_name() {
    let fleet = Fleet::start(1).await;
    let calm = fleet.package("calm", "1.0.0", "service", "exec sleep 1000\n");
    fleet.server.push(&calm, "*").await;
    let before = fleet.server.wait_phase("robot-1", "calm", Phase::Running).await;
    let greedy = fleet.package("greedy", "1.0.0", "job", "head -c 8G /dev/zero | tail -n 1 >/dev/null\n");
    let toml = std::fs::read_to_string(greedy.join("task.toml")).expect("task.toml");
    std::fs::write(greedy.join("task.toml"), toml + "[limits]\nmemory_mb = 200\npids = 32\ncpu_weight = 50\n")
        .expect("limits");
    fleet.server.push(&greedy, "*").await;
    let failure = failure_of(&fleet.server, "greedy", Phase::Failed).await;
    // What the robot says of itself is what it does.
    match eventually("the robot's facts", async || robot(&fleet.server).await.host).await.isolation {
        Isolation::Cgroup => {
            assert_eq!(failure.code.as_str(), "out_of_memory");
            assert!(failure.text.contains("200 MiB"), "{failure}");
        }
        Isolation::None => {
            assert_eq!(failure.code.as_str(), "process_exited");
            assert!(failure.text.contains("memory exhausted"), "{failure}");
        }
    }
    let after = robot(&fleet.server).await;
    let pid = |view: &RobotView| Some(view.tasks.iter().find(|t| t.task.as_str() == "calm")?.active.as_ref()?.pid);
    assert_eq!(pid(&after), pid(&before));
    assert!(pid(&after).is_some());
}
