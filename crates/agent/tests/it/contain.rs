//! Containment: a task can't outlive its stop, starve its neighbours, become root or look into the
//! agent. On machines without the means for one of these, the test checks the remaining guarantees.

use std::os::unix::fs::{MetadataExt as _, PermissionsExt as _};
use std::os::unix::process::CommandExt as _;
use std::time::Duration;

use nix::sys::signal::Signal;
use task_agent::process::cgroup::{Cgroups, RunLimits};
use task_agent::process::containment::RUN_DIR_VARIABLE;
use task_agent::process::program::{ExitStatus, ProcessEntry};
use task_agent::process::run_dir::RunDir;
use task_agent::process::supervisor::RunState;
use task_agent::system::task_user::{TaskUser, return_to_root};

use crate::harness::{TestRun, eventually, lives, other_user, supervisor, within};

const SHORT_GRACE: Duration = Duration::from_millis(300);

/// Leaves its parent, process group, session and environment behind, and stays.
const RUNAWAY: &str = r#"
stay='trap "" INT TERM HUP; echo $$ >> pids; while :; do sleep 1000; done'
(setsid env -i PATH="$PATH" bash -c "setsid bash -c '$stay' & exit" &)
(setsid env -i PATH="$PATH" bash -c "$stay" &)
while :; do sleep 1000; done
"#;

async fn start(run: &TestRun) -> u32 {
    within("the start", run.supervisor.start(&run.run_dir(), &run.spec))
        .await
        .expect("started")
        .task
        .pid
}

async fn stop(run: &TestRun) -> RunState {
    within("the stop", run.supervisor.stop(&run.run_dir(), SHORT_GRACE)).await.expect("stopped")
}

async fn run_to_end(run: &TestRun) -> RunState {
    start(run).await;
    within("the end", run.supervisor.wait(&run.run_dir())).await.expect("observed")
}

async fn runaways(run: &TestRun) -> Vec<u32> {
    eventually("two runaways", || {
        let text = std::fs::read_to_string(run.spec.directory.join("pids")).ok()?;
        let pids: Vec<u32> = text.lines().map(|line| line.parse().ok()).collect::<Option<_>>()?;
        (pids.len() == 2).then_some(pids)
    })
    .await
}

fn living(pids: &[u32]) -> Vec<u32> {
    pids.iter().copied().filter(|pid| lives(*pid)).collect()
}

/// Number of processes and threads of a user.
fn threads_of(uid: u32) -> usize {
    let table = ProcessEntry::all().expect("process table");
    let owned = table.iter().filter(|entry| {
        !entry.is_zombie
            && std::fs::metadata(format!("/proc/{}", entry.pid)).is_ok_and(|data| data.uid() == uid)
    });
    owned
        .map(|entry| {
            std::fs::read_dir(format!("/proc/{}/task", entry.pid)).map_or(0, Iterator::count)
        })
        .sum()
}

/// A task of the same user that reports repeatedly that it still works.
async fn neighbour(user: &TaskUser) -> TestRun {
    let mut run = TestRun::grouped(
        "count=0; while sleep 0.02; do count=$((count + 1)); echo beat $count; done",
    );
    run.run_as(user);
    start(&run).await;
    run.wrote("beat 1\n").await;
    run
}

async fn goes_on(neighbour: &TestRun) {
    let count = neighbour.log().lines().count();
    eventually("the neighbour to go on", || {
        (neighbour.log().lines().count() > count + 5).then_some(())
    })
    .await;
}

#[tokio::test]
async fn nothing_outlives_the_stop_of_its_task() {
    for run in [TestRun::of(RUNAWAY), TestRun::grouped(RUNAWAY)] {
        start(&run).await;
        let pids = runaways(&run).await;
        assert_eq!(living(&pids), pids);
        stop(&run).await;
        assert_eq!(living(&pids), Vec::<u32>::new());
        assert!(run.cgroup().is_none_or(|cgroup| !cgroup.exists()));
    }
}

#[tokio::test]
async fn hanging_start_is_ended_with_its_control_group() {
    let run = TestRun::grouped("echo up");
    let Some(cgroups) = Cgroups::find() else {
        return eprintln!("unavailable: this machine has no control groups that may be written to");
    };
    let dir = RunDir::create(&run.run_dir()).expect("dir");
    // A process that enters a frozen group gets no further, as with a run directory on a file
    // system that does not answer.
    let group = cgroups.create(dir.path(), &RunLimits::default()).expect("made");
    std::fs::write(group.path().join("cgroup.freeze"), "1").expect("frozen");
    let hangs = || group.pids().is_ok_and(|pids| !pids.is_empty()).then_some(());
    tokio::select! {
        started = run.supervisor.start(dir.path(), &run.spec) => panic!("{started:?}"),
        () = eventually("it hangs", hangs) => {}
    }
    let observed =
        within("the stop", run.supervisor.stop(dir.path(), Duration::ZERO)).await.expect("stopped");
    assert!(
        matches!(observed, RunState::Running { .. } | RunState::Exited(ExitStatus::Signal(9))),
        "{observed:?}"
    );
    let ended = within("its end", run.supervisor.wait(dir.path())).await.expect("observed");
    assert_eq!(ended, RunState::Exited(ExitStatus::Signal(9)));
    assert!(!run.log().contains("up") && !group.path().exists());
}

#[tokio::test]
async fn nothing_outlives_a_task_that_ends_by_itself() {
    let leave = RUNAWAY.replace("while :; do sleep 1000; done\n\"", "");
    let script = format!("{leave}\n");
    for run in [TestRun::of(&script), TestRun::grouped(&script)] {
        let task = start(&run).await;
        let pids = runaways(&run).await;
        let task =
            task_agent::process::program::ProcessIdentity::of(task).expect("stat").expect("alive");
        task.signal(Signal::SIGKILL).expect("killed");
        let ended = within("the end", run.supervisor.wait(&run.run_dir())).await.expect("observed");
        assert_eq!(ended, RunState::Exited(ExitStatus::Signal(9)));
        assert_eq!(living(&pids), Vec::<u32>::new());
        eventually("the control group's end", || {
            run.cgroup().is_none_or(|cgroup| !cgroup.exists()).then_some(())
        })
        .await;
    }
}

#[tokio::test]
async fn new_agent_finds_the_control_group_and_needs_neither_shim_nor_environment() {
    let run = TestRun::grouped(RUNAWAY);
    let started = within("the start", run.supervisor.start(&run.run_dir(), &run.spec))
        .await
        .expect("started");
    let Some(cgroup) = run.cgroup() else {
        eprintln!("unavailable: this machine has no control groups that may be written to");
        return;
    };
    let pids = runaways(&run).await;
    let group = std::fs::read_to_string(format!("/proc/{}/cgroup", pids[0])).expect("its groups");
    let name = cgroup.file_name().and_then(|name| name.to_str()).expect("a name");
    assert!(group.lines().any(|line| line.starts_with("0::") && line.ends_with(name)), "{group}");
    started.shim.signal(Signal::SIGKILL).expect("killed");
    // Another supervisor, as after a restart of the agent; it learns of the group only from the run
    // directory.
    let observed = within("the notice", supervisor().wait(&run.run_dir())).await.expect("observed");
    assert_eq!(observed, RunState::Gone);
    assert_eq!(living(&pids), Vec::<u32>::new());
    assert!(!cgroup.exists());
}

#[tokio::test]
async fn fork_bomb_stays_within_its_limit_and_ends_with_its_task() {
    let Some(user) = other_user() else { return };
    let neighbour = neighbour(&user).await;
    let mut bomb = TestRun::grouped("bomb() { bomb | bomb & }; bomb; while :; do wait; done");
    bomb.run_as(&user);
    bomb.spec.limits.pids = Some(64);
    start(&bomb).await;
    bomb.wrote("Resource temporarily unavailable").await;
    let most = threads_of(user.uid);
    // The neighbour has two or three; without a controller, the processes that ran at the start are
    // added to the limit.
    assert!((10..=72).contains(&most), "{most}");
    goes_on(&neighbour).await;
    let stopped = stop(&bomb).await;
    assert!(matches!(stopped, RunState::Exited(_)), "{stopped:?}");
    assert!(bomb.cgroup().is_none_or(|cgroup| !cgroup.exists()));
    goes_on(&neighbour).await;
    stop(&neighbour).await;
    assert_eq!(threads_of(user.uid), 0);
}

#[tokio::test]
async fn task_over_its_memory_limit_is_reported_out_of_memory() {
    let Some(user) = other_user() else { return };
    let neighbour = neighbour(&user).await;
    let mut greedy =
        TestRun::grouped("head -c 8G /dev/zero | tail -n 1 >/dev/null; exit ${PIPESTATUS[1]}");
    greedy.run_as(&user);
    greedy.spec.limits.memory_bytes = Some(256 << 20);
    let ended = run_to_end(&greedy).await;
    if Cgroups::find().is_some_and(|cgroups| cgroups.isolates()) {
        assert_eq!(ended, RunState::OutOfMemory { limit_bytes: 256 << 20 });
    } else {
        // Each process by itself: one that asks for too much is refused, and can report that.
        assert_eq!(ended, RunState::Exited(ExitStatus::Code(1)));
        assert!(greedy.log().contains("memory exhausted"), "{}", greedy.log());
    }
    goes_on(&neighbour).await;
    stop(&neighbour).await;
}

#[tokio::test]
async fn task_goes_before_its_agent_and_shim_when_the_machine_runs_out_of_memory() {
    let run =
        TestRun::grouped("cat /proc/self/oom_score_adj /proc/$PPID/oom_score_adj; sleep 1000");
    let before: i32 = std::fs::read_to_string("/proc/self/oom_score_adj")
        .expect("own")
        .trim()
        .parse()
        .expect("number");
    start(&run).await;
    run.wrote("300\n").await;
    let scores: Vec<i32> = eventually("both scores", || {
        let scores: Vec<i32> = run.log().lines().filter_map(|line| line.parse().ok()).collect();
        (scores.len() == 2).then_some(scores)
    })
    .await;
    assert_eq!(scores[0], 300);
    if may_lower_scores() {
        assert!(scores[1] <= -900, "{scores:?}");
    } else {
        eprintln!("unavailable: this process may not lower the score of its shim");
        assert_eq!(scores[1], before);
    }
    stop(&run).await;
}

/// Whether this process has CAP_SYS_RESOURCE, as root on a machine does.
fn may_lower_scores() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").expect("status");
    let powers = status.lines().find_map(|line| line.strip_prefix("CapEff:")).expect("listed");
    u64::from_str_radix(powers.trim(), 16).expect("a number") & (1 << 24) != 0
}

/// The first attempts of a hostile package. Each line prints its result.
const BURGLAR: &str = r#"
got() { if "$@" >/dev/null 2>&1; then echo "GOT $*"; fi; }
got cat "$DATA/identity.json"
got ls "$DATA"
got ls "$DATA/run"
got touch "$DATA/new" "$DATA/run/new"
for pid in $PPID $AGENT; do
  got cat /proc/$pid/environ
  got cat /proc/$pid/maps
  got ls /proc/$pid/fd/
  got kill -0 $pid
  got kill -9 $pid
  got python3 -c "import ctypes, sys; sys.exit(ctypes.CDLL(None).ptrace(16, $pid, 0, 0) != 0)"
done
got su -c true
got sudo -n true
got chmod 666 /etc/passwd
got setpriv --reuid 0 true
echo "root again: $("$DATA/set-id-root" -u)"
echo "ids: $(id -u) $(id -g) $(id -G)"
grep -E '^(NoNewPrivs|Cap...):' /proc/self/status | tr -d '\t' | tr '\n' ' '
echo
touch mine && echo "own directory: writable"
echo "by name: works" > /dev/stdout
env | cut -d= -f1 | sort | tr '\n' ' '
"#;

#[tokio::test]
async fn task_user_cannot_reach_agent_files_and_processes() {
    let Some(user) = other_user() else { return };
    let mut run = TestRun::grouped(BURGLAR);
    run.run_as(&user);
    std::fs::write(run.path("identity.json"), "secret").expect("identity");
    std::fs::set_permissions(run.path("identity.json"), std::fs::Permissions::from_mode(0o600))
        .expect("its mode");
    std::fs::copy("/usr/bin/id", run.path("set-id-root")).expect("copied");
    std::fs::set_permissions(run.path("set-id-root"), std::fs::Permissions::from_mode(0o4755))
        .expect("set-id");
    run.spec.environment.insert("DATA".to_owned(), run.path("").display().to_string());
    run.spec.environment.insert("AGENT".to_owned(), std::process::id().to_string());
    assert_eq!(run_to_end(&run).await, RunState::Exited(ExitStatus::Code(0)), "{}", run.log());
    let log = run.log();
    assert!(!log.contains("GOT"), "{log}");
    assert!(log.contains(&format!("root again: {}\n", user.uid)), "{log}");
    assert!(log.contains(&format!("ids: {0} {0} {0} {1}\n", user.uid, user.groups[0])), "{log}");
    let none = "0000000000000000";
    let powers = format!(
        "CapInh:{none} CapPrm:{none} CapEff:{none} CapBnd:{none} CapAmb:{none} NoNewPrivs:1 "
    );
    assert!(log.contains(&powers), "{log}");
    assert!(log.contains("own directory: writable\nby name: works\n"), "{log}");
    assert_eq!(std::fs::metadata(run.spec.directory.join("mine")).expect("made").uid(), user.uid);
    let names = log.lines().last().expect("the environment");
    let expected = [
        "AGENT",
        "DATA",
        "HOME",
        "LANG",
        "LOGNAME",
        "OLDPWD",
        "PATH",
        "PWD",
        "PYTHONUNBUFFERED",
        "SHLVL",
    ];
    let others = ["TASKD_ASSIGNMENT", "TASKD_RUN_DIR", "TZ", "USER", "_"];
    let unexpected: Vec<_> = names
        .split_whitespace()
        .filter(|name| !expected.contains(name) && !others.contains(name))
        .collect();
    assert_eq!(unexpected, Vec::<&str>::new());
}

/// Things that a task may put in place of its run directory, since the task owns the path to it.
const EXCHANGES: [&str; 4] = [
    "mkfifo src",
    "mkfifo pipe; ln -s pipe src",
    "ln -s \"$ROOTS_PIPE\" src",
    "ln -s /dev/watchdog src",
];

#[tokio::test]
async fn shim_opens_nothing_in_an_exchanged_directory() {
    let Some(user) = other_user() else { return };
    for exchange in EXCHANGES {
        let mut run = TestRun::grouped(&format!(
            "cd ..; rm -r src; {exchange}; trap 'exit 0' INT; sleep 1000 & wait"
        ));
        let work = run.path("work");
        run.run_as(&user);
        run.spec.directory = work.join("src");
        user.make_home(&run.spec.directory).expect("made");
        // Only root may open the pipe, and waits for ever if it does.
        let pipe = run.path("roots-pipe");
        nix::unistd::mkfifo(&pipe, nix::sys::stat::Mode::S_IRWXU).expect("a pipe");
        run.spec.environment.insert("ROOTS_PIPE".to_owned(), pipe.display().to_string());
        run.spec.has_outputs = true;
        let started = within("the start", run.supervisor.start(&run.run_dir(), &run.spec))
            .await
            .expect("started");
        let kind = || std::fs::symlink_metadata(&run.spec.directory).ok();
        let exchanged = || kind().filter(|about| !about.is_dir()).map(drop);
        eventually("the exchange", exchanged).await;
        assert_eq!(
            stop(&run).await,
            RunState::Exited(ExitStatus::Code(0)),
            "{exchange}: {}",
            run.log()
        );
        eventually("the shim to end", || (!started.shim.is_alive()).then_some(())).await;
    }
}

#[tokio::test]
async fn start_in_an_unreachable_directory_is_reported() {
    let Some(user) = other_user() else { return };
    let mut run = TestRun::grouped("true");
    run.run_as(&user);
    std::fs::set_permissions(run.path("."), std::fs::Permissions::from_mode(0o700))
        .expect("closed");
    let error =
        run.supervisor.start(&run.run_dir(), &run.spec).await.expect_err("refused").to_string();
    assert!(error.contains("run.sh") && error.contains("Permission denied"), "{error}");
}

#[test]
fn handing_over_skips_links_and_files_already_handed_over() {
    let Some(user) = other_user() else { return };
    let temp = tempfile::tempdir().expect("temp dir");
    let (tree, outside) = (temp.path().join("tree"), temp.path().join("outside"));
    std::fs::create_dir_all(tree.join("src/deep")).expect("tree");
    std::fs::write(tree.join("src/deep/file"), "").expect("file");
    std::fs::write(&outside, "").expect("outside");
    std::os::unix::fs::symlink(&outside, tree.join("src/link")).expect("link");
    std::fs::hard_link(&outside, tree.join("src/second-name")).expect("hard link");
    user.hand_over(&tree).expect("handed over");
    let owner = |path: &std::path::Path| std::fs::symlink_metadata(path).expect("there").uid();
    for path in ["", "src", "src/deep", "src/deep/file", "src/link"] {
        assert_eq!(owner(&tree.join(path)), user.uid, "{path}");
    }
    assert_eq!(owner(&outside), 0);
    std::fs::write(tree.join("late"), "").expect("late");
    user.hand_over(&tree).expect("nothing to do");
    assert_eq!(owner(&tree.join("late")), 0);
    // A link in place of the tree is refused, not followed.
    std::os::unix::fs::symlink(temp.path(), temp.path().join("tree-link")).expect("link");
    user.hand_over(&temp.path().join("tree-link")).expect_err("refused");
}

#[test]
fn taking_back_skips_foreign_files_and_links() {
    let Some(user) = other_user() else { return };
    let temp = tempfile::tempdir().expect("temp dir");
    let (tree, outside) = (temp.path().join("tree"), temp.path().join("outside"));
    std::fs::create_dir_all(tree.join("deep")).expect("tree");
    std::fs::write(tree.join("deep/file"), "").expect("file");
    std::fs::set_permissions(tree.join("deep/file"), std::fs::Permissions::from_mode(0o2700))
        .expect("set");
    user.hand_over(&tree).expect("handed over");
    std::fs::write(&outside, "secret").expect("outside");
    std::fs::set_permissions(&outside, std::fs::Permissions::from_mode(0o600)).expect("closed");
    std::os::unix::fs::symlink(&outside, tree.join("link")).expect("link");
    std::fs::hard_link(&outside, tree.join("second-name")).expect("hard link");
    return_to_root(&tree, user.uid).expect("taken back");
    let about = |path: &str| {
        let about = std::fs::symlink_metadata(tree.join(path)).expect("there");
        (about.uid(), about.mode() & 0o7777)
    };
    assert_eq!([about(""), about("deep"), about("deep/file")], [(0, 0o755); 3]);
    assert_eq!(std::fs::metadata(&outside).expect("there").mode() & 0o7777, 0o600);
    return_to_root(&temp.path().join("nothing"), user.uid).expect("nothing to do");
}

#[test]
#[expect(
    clippy::disallowed_methods,
    reason = "starts the shim as the agent does, with less rights"
)]
fn exit_status_is_reported_despite_an_unsignallable_process() {
    let Some(user) = other_user() else { return };
    // As by `sudo`: the process that the task starts there is root's, and no other user may signal
    // it.
    let mut run = TestRun::of(
        "./as-root --reuid=0 --regid=0 --clear-groups sh -c 'echo $$ > pid; exec sleep 1000' &
         until [ -s pid ]; do :; done; exit 3",
    );
    let (program, setpriv) = (run.path("task-agent"), run.path("as-root"));
    std::fs::copy(env!("CARGO_BIN_EXE_task-agent"), &program).expect("copied");
    std::fs::copy("/usr/bin/setpriv", &setpriv).expect("copied");
    std::fs::set_permissions(&setpriv, std::fs::Permissions::from_mode(0o4755)).expect("set");
    let dir = RunDir::create(&run.run_dir()).expect("dir");
    // The end of this test finds the processes by this variable.
    run.spec.environment.insert(RUN_DIR_VARIABLE.to_owned(), dir.path().display().to_string());
    dir.write_spec(&run.spec).expect("written");
    user.hand_over(dir.path()).expect("handed over");
    std::fs::set_permissions(run.path("."), std::fs::Permissions::from_mode(0o777)).expect("open");
    let mut shim = std::process::Command::new(program);
    shim.arg("shim").arg("--dir").arg(dir.path()).uid(user.uid).gid(user.gid);
    assert!(shim.output().expect("runs").status.success());
    let ended = dir.ended().expect("readable").expect("written");
    assert_eq!(ended.status, ExitStatus::Code(3));
    let pid: u32 =
        std::fs::read_to_string(run.path("pid")).expect("a pid").trim().parse().expect("a pid");
    assert!(lives(pid), "it could not be ended, or this test shows nothing");
}
