//! The tasks' users and their confinement, from the package to the operator's view.

use std::os::unix::fs::MetadataExt as _;
use std::path::Path;

use task_proto::api::RobotView;
use task_proto::messages::report::{Failure, Isolation, Phase, TaskAccounts};

use crate::harness::{Fleet, Robot, Server, eventually, open_directory, write_package};
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
async fn task_runs_as_the_task_user_in_a_home_of_its_own() {
    let fleet = Fleet::start(1).await;
    let found = fleet.dir.path().join("found");
    open_directory(&found);
    let identity = fleet.robots[0].data().join("identity.json");
    let script = format!(
        "id -u > {0}/user; cat {1} > {0}/identity; \
         grep ^Seccomp: /proc/self/status > {0}/calls; \
         touch \"$HOME/log\" written && echo \"$HOME\" > {0}/home\n",
        found.display(),
        identity.display()
    );
    let job = fleet.package("curious", "1.0.0", "job", &script);
    fleet.server.push(&job, "*").await;
    fleet.server.wait_phase("robot-1", "curious", Phase::Succeeded).await;
    let read =
        |name: &str| std::fs::read_to_string(found.join(name)).expect(name).trim().to_owned();
    assert_eq!(read("home"), own_home(&fleet.robots[0]));
    if nix::unistd::geteuid().is_root() {
        let user: u32 = read("user").parse().expect("a number");
        assert!((70_000..80_000).contains(&user), "{user}");
        assert_eq!(read("identity"), "");
        assert_eq!(read("calls"), "Seccomp:\t2", "its system calls are filtered");
    } else {
        eprintln!("unavailable: only root can run a task as another user");
    }
}

/// Attempts of a package on its neighbour, and on itself. Each line of its output is a success.
const BURGLAR: &str = r#"
got() { if "$@" >/dev/null 2>&1; then echo "GOT $*" >> "$FOUND"; fi; }
touch mine && echo "own directory: writable" >> "$FOUND"
for name in src/main.sh run.sh task.json work/main.sh work/new work/written new; do
  got dd if=/dev/zero "of=$VICTIM/$name" count=1
done
got rm "$VICTIM/src/main.sh"
got mv "$VICTIM/src" "$VICTIM/moved"
got ls "$VICTIM"
got cat "$VICTIM/src/main.sh"
got cat "$VICTIM_HOME/secret"
got touch "$VICTIM_HOME/new" "$TASKS/new" "$TASKS/victim/new"
for name in ../src/main.sh ../run.sh ../task.json ../new main.sh; do
  got dd if=/dev/zero "of=$name" count=1
done
count=0
while [ $count -lt 200 ]; do
  got kill -9 $VICTIM_PID
  count=$((count + 1))
done
got cat /proc/$VICTIM_PID/environ
got cat /proc/$VICTIM_PID/maps
got perl -e "exit(syscall(101, 16, $VICTIM_PID, 0, 0) != 0)"
echo done >> "$FOUND"
"#;

fn pid_of(robot: &RobotView, task: &str) -> Option<u32> {
    Some(robot.tasks.iter().find(|t| t.task.as_str() == task)?.active.as_ref()?.pid)
}

/// The directory of a task's only version.
fn version_of(robot: &Robot, task: &str) -> std::path::PathBuf {
    std::fs::read_link(robot.data().join("tasks").join(task).join("current"))
        .map(|hex| robot.data().join("tasks").join(task).join(hex))
        .expect("a version")
}

#[tokio::test(flavor = "multi_thread")]
async fn task_cannot_touch_its_neighbour_or_change_its_own_package() {
    if !nix::unistd::geteuid().is_root() {
        return eprintln!("unavailable: only root can run tasks under accounts of their own");
    }
    let fleet = Fleet::start(1).await;
    let robot_1 = &fleet.robots[0];
    let found = fleet.dir.path().join("found");
    open_directory(&found);
    let victim = "umask 0; echo secret > \"$HOME/secret\"; echo mine > written; exec sleep 1000\n";
    fleet.server.push(&fleet.package("victim", "1.0.0", "service", victim), "*").await;
    let before = fleet.server.wait_phase("robot-1", "victim", Phase::Running).await;
    let home = robot_1.data().join("tasks/victim/home");
    eventually("the victim's secret", async || home.join("secret").exists().then_some(())).await;
    let pid = pid_of(&before, "victim").expect("a pid");
    let settings = format!(
        "FOUND={}/found VICTIM={} VICTIM_HOME={} VICTIM_PID={pid} TASKS={}\n",
        found.display(),
        version_of(robot_1, "victim").display(),
        home.display(),
        robot_1.data().join("tasks").display(),
    );
    fleet.server.push(&fleet.package("burglar", "1.0.0", "job", &(settings + BURGLAR)), "*").await;
    fleet.server.wait_phase("robot-1", "burglar", Phase::Succeeded).await;
    let found = std::fs::read_to_string(found.join("found")).expect("the findings");
    assert_eq!(found, "own directory: writable\ndone\n");
    assert_eq!(pid_of(&robot(&fleet.server).await, "victim"), Some(pid), "it was not killed");
    let accounts =
        eventually("the robot's facts", async || robot(&fleet.server).await.host).await.accounts;
    assert_eq!(accounts, Some(TaskAccounts::PerTask));
}

#[tokio::test(flavor = "multi_thread")]
async fn package_changed_on_disk_is_fetched_again_before_start() {
    if !nix::unistd::geteuid().is_root() {
        return eprintln!("unavailable: only root can protect the programs of tasks from them");
    }
    let fleet = Fleet::start(1).await;
    let found = fleet.dir.path().join("found");
    open_directory(&found);
    let script = format!("echo good >> {}/started; exec sleep 1000\n", found.display());
    fleet.server.push(&fleet.package("steady", "1.0.0", "service", &script), "*").await;
    let before = fleet.server.wait_phase("robot-1", "steady", Phase::Running).await;
    let pid = pid_of(&before, "steady").expect("a pid");
    let main = version_of(&fleet.robots[0], "steady").join("src/main.sh");
    std::fs::write(&main, script.replace("good", "evil")).expect("changed");
    nix::sys::signal::kill(
        nix::unistd::Pid::from_raw(pid.cast_signed()),
        nix::sys::signal::Signal::SIGKILL,
    )
    .expect("killed");
    eventually("another process", async || {
        let now = pid_of(&robot(&fleet.server).await, "steady")?;
        (now != pid && std::fs::read_to_string(found.join("started")).ok()?.lines().count() == 2)
            .then_some(())
    })
    .await;
    assert_eq!(std::fs::read_to_string(found.join("started")).expect("written"), "good\ngood\n");
    assert_eq!(std::fs::read_to_string(&main).expect("there"), script);
    let log =
        std::fs::read_to_string(fleet.robots[0].data().with_extension("agent.log")).expect("a log");
    assert!(log.contains("src was changed after unpacking"), "{log}");
}

#[tokio::test(flavor = "multi_thread")]
async fn fallback_changed_on_disk_is_fetched_again_before_start() {
    if !nix::unistd::geteuid().is_root() {
        return eprintln!("unavailable: only root can protect the programs of tasks from them");
    }
    let fleet = Fleet::start(1).await;
    let found = fleet.dir.path().join("found");
    open_directory(&found);
    let started = found.join("started");
    let script = format!("echo good >> {}; exec sleep 1000\n", started.display());
    fleet.server.push(&fleet.package("steady", "1.0.0", "service", &script), "*").await;
    fleet.server.wait_phase("robot-1", "steady", Phase::Running).await;
    let has_started = |runs: usize| {
        (std::fs::read_to_string(&started).ok()? == "good\n".repeat(runs)).then_some(())
    };
    eventually("the script to run", async || has_started(1)).await;
    let main = version_of(&fleet.robots[0], "steady").join("src/main.sh");
    std::fs::write(&main, script.replace("good", "evil")).expect("changed");
    let broken = fleet.package("steady", "2.0.0", "service", "exit 3\n");
    let toml = std::fs::read_to_string(broken.join("task.toml")).expect("task.toml");
    let unready = toml.replace("[ready]\nhold_s = 0", "restart = \"never\"\n[ready]\nhold_s = 20");
    assert_ne!(unready, toml);
    std::fs::write(broken.join("task.toml"), unready).expect("changed");
    fleet.server.push(&broken, "*").await;
    eventually("the first version again", async || {
        let view = robot(&fleet.server).await;
        let task = view.tasks.iter().find(|task| task.phase == Phase::RolledBack)?;
        (task.active.as_ref()?.version.as_str() == "1.0.0").then_some(())
    })
    .await;
    eventually("the script to run again", async || has_started(2)).await;
    assert_eq!(std::fs::read_to_string(&main).expect("there"), script);
    let log =
        std::fs::read_to_string(fleet.robots[0].data().with_extension("agent.log")).expect("a log");
    assert!(log.contains("src was changed after unpacking"), "{log}");
}

/// Gives a tree to the account of all tasks, as earlier agents did that let tasks own their files.
fn give_to_all_tasks(path: &Path) {
    let about = std::fs::symlink_metadata(path).expect("there");
    std::os::unix::fs::lchown(path, Some(65_534), Some(65_534)).expect("given");
    if about.is_dir() {
        std::fs::read_dir(path)
            .expect("a list")
            .for_each(|entry| give_to_all_tasks(&entry.expect("an entry").path()));
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn version_of_an_earlier_agent_is_adopted_with_its_task_files() {
    if !nix::unistd::geteuid().is_root() {
        return eprintln!("unavailable: only root can give files to another user");
    }
    let mut fleet = Fleet::start(1).await;
    fleet
        .server
        .push(
            &fleet.package("steady", "1.0.0", "service", "echo run >> written; exec sleep 1000\n"),
            "*",
        )
        .await;
    let before = fleet.server.wait_phase("robot-1", "steady", Phase::Running).await;
    let pid = pid_of(&before, "steady").expect("a pid");
    fleet.robots[0].terminate();
    nix::sys::signal::kill(
        nix::unistd::Pid::from_raw(pid.cast_signed()),
        nix::sys::signal::Signal::SIGKILL,
    )
    .expect("killed");
    let version = version_of(&fleet.robots[0], "steady");
    std::fs::remove_dir_all(version.join("work")).expect("removed");
    std::fs::remove_file(version.with_extension("seal")).expect("removed");
    give_to_all_tasks(&version);
    let handed_over = std::fs::metadata(version.join("task.json")).expect("there");
    let old = version.join("src/written");
    let since = (handed_over.ctime(), handed_over.ctime_nsec());
    // The clock of files does not tick at each write.
    while std::fs::metadata(&old).map_or(true, |about| (about.mtime(), about.mtime_nsec()) <= since)
    {
        std::fs::write(&old, "old\n").expect("written");
    }
    give_to_all_tasks(&old);
    fleet.robots[0].restart();
    eventually("another process", async || {
        (std::fs::read_to_string(version.join("work/written")).ok()? == "old\nrun\n").then_some(())
    })
    .await;
    let owner = |name: &str| std::fs::metadata(version.join(name)).expect("there").uid();
    assert_eq!((owner(""), owner("src"), owner("src/main.sh")), (0, 0, 0));
    assert!(
        (70_000..80_000).contains(&owner("work/written"))
            && version.with_extension("seal").exists()
    );
}

fn own_home(robot: &Robot) -> String {
    if nix::unistd::geteuid().is_root() {
        robot.data().join("tasks/curious/home").display().to_string()
    } else {
        std::env::var("HOME").unwrap_or("/".to_owned())
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn robot_without_a_task_user_runs_nothing_and_reports_the_remedy() {
    let dir = tempfile::tempdir().expect("temp dir");
    let server = Server::start(&dir.path().join("server")).await;
    let settings = [("TASK_AGENT_TASK_USER", "no-such-user")];
    let _robot =
        Robot::start_with(&server, dir.path(), "robot-1", 1, &server.url(""), &settings).await;
    let package = dir.path().join("idle");
    write_package(&package, "idle", "1.0.0", "service", "exec sleep 1000\n");
    server.push(&package, "*").await;
    let failure = failure_of(&server, "idle", Phase::Unmet).await;
    assert_eq!(failure.code.as_str(), "no_task_user");
    assert!(failure.text.contains("\"no-such-user\""), "{failure}");
    let conditions = robot(&server).await.conditions;
    let condition =
        conditions.iter().find(|condition| condition.code == "no_task_user").expect("a condition");
    assert_eq!(condition.text, failure.text);
    let run_dir = format!("TASKD_RUN_DIR={}", dir.path().display());
    assert_eq!(processes_with(run_dir.as_bytes()), Vec::<i32>::new());
}

#[tokio::test(flavor = "multi_thread")]
async fn task_above_its_memory_limit_fails_alone_and_by_name() {
    let fleet = Fleet::start(1).await;
    let calm = fleet.package("calm", "1.0.0", "service", "exec sleep 1000\n");
    fleet.server.push(&calm, "*").await;
    let before = fleet.server.wait_phase("robot-1", "calm", Phase::Running).await;
    let greedy =
        fleet.package("greedy", "1.0.0", "job", "head -c 8G /dev/zero | tail -n 1 >/dev/null\n");
    let toml = std::fs::read_to_string(greedy.join("task.toml")).expect("task.toml");
    std::fs::write(
        greedy.join("task.toml"),
        toml + "[limits]\nmemory_mb = 200\npids = 32\ncpu_weight = 50\n",
    )
    .expect("limits");
    fleet.server.push(&greedy, "*").await;
    let failure = failure_of(&fleet.server, "greedy", Phase::Failed).await;
    // The robot's reported confinement matches its actual one.
    match eventually("the robot's facts", async || robot(&fleet.server).await.host).await.isolation
    {
        Isolation::Cgroup => {
            assert_eq!(failure.code.as_str(), "out_of_memory");
            assert!(failure.text.contains("200 MB"), "{failure}");
        }
        Isolation::None => {
            assert_eq!(failure.code.as_str(), "process_exited");
            assert!(failure.text.contains("memory exhausted"), "{failure}");
        }
    }
    let after = robot(&fleet.server).await;
    assert_eq!(pid_of(&after, "calm"), pid_of(&before, "calm"));
    assert!(pid_of(&after, "calm").is_some());
}
