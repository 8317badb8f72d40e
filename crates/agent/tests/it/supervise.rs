//! Tasks under the real shim: they outlive the process that started them, are found again, and end
//! without a trace.

use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

use nix::sys::signal::{SigHandler, Signal};
use nix::unistd::Pid;
use task_agent::process::program::ExitStatus;
use task_agent::process::program::ProcessIdentity;
use task_agent::process::run_dir::{RunDir, RunSpec, Started};
use task_agent::process::supervisor::{RunState, SupervisorError};

use crate::harness::{TestRun, eventually, lives, supervisor, within};

const SHORT_GRACE: Duration = Duration::from_millis(300);
const LONG_GRACE: Duration = Duration::from_secs(50);

async fn run_to_end(script: &str) -> (TestRun, RunState) {
    let run = TestRun::of(script);
    within("the start", run.supervisor.start(&run.run_dir(), &run.spec)).await.expect("started");
    let ended = within("the end", run.supervisor.wait(&run.run_dir())).await.expect("observed");
    (run, ended)
}

#[tokio::test]
async fn exit_code_and_signal_are_kept() {
    assert_eq!(run_to_end("exit 0").await.1, RunState::Exited(ExitStatus::Code(0)));
    assert_eq!(run_to_end("exit 7").await.1, RunState::Exited(ExitStatus::Code(7)));
    assert_eq!(run_to_end("kill -SEGV $$").await.1, RunState::Exited(ExitStatus::Signal(11)));
    let (run, _) = run_to_end("exit 3").await;
    let text = std::fs::read_to_string(run.run_dir().join("exit.json")).expect("exit file");
    assert!(text.starts_with(r#"{"code":3,"at_uptime_ms":"#), "{text}");
    assert_eq!(
        supervisor().observe(&run.run_dir()).await.expect("observed"),
        RunState::Exited(ExitStatus::Code(3))
    );
}

#[tokio::test]
async fn task_gets_the_documented_environment_and_nothing_else() {
    let (run, _) =
        run_to_end("env; echo descriptors $(ls /proc/self/fd); cat; echo stdin is empty").await;
    let log = run.log();
    let names: Vec<_> = log.lines().filter_map(|line| Some(line.split_once('=')?.0)).collect();
    let expected = [
        "HOME",
        "LANG",
        "LOGNAME",
        "PATH",
        "PWD",
        "PYTHONUNBUFFERED",
        "SHLVL",
        "TASKD_ASSIGNMENT",
        "TASKD_RUN_DIR",
        "TZ",
        "USER",
        "_",
    ];
    assert!(names.iter().all(|name| expected.contains(name)), "{names:?}");
    assert!(log.contains(&format!("TASKD_ASSIGNMENT={}", run.spec.assignment)));
    // 3 is ls's own, on the directory it lists.
    assert!(log.contains("descriptors 0 1 2 3\n"), "{log}");
    assert!(log.contains("stdin is empty"));
}

#[tokio::test]
async fn failed_start_is_reported_and_leaves_nothing() {
    let mut run = TestRun::of("true");
    run.spec.directory = PathBuf::from("/nonexistent/place");
    let error =
        run.supervisor.start(&run.run_dir(), &run.spec).await.expect_err("refused").to_string();
    assert!(error.contains("/nonexistent/place") && error.contains("No such file"), "{error}");
    assert_eq!(
        run.supervisor.observe(&run.run_dir()).await.expect("observed"),
        RunState::NeverStarted
    );
    let never = run.supervisor.stop(&run.path("never"), SHORT_GRACE).await.expect("stopped");
    assert_eq!(never, RunState::NeverStarted);
}

#[tokio::test]
async fn run_without_a_recorded_shim_is_gone_and_not_restarted() {
    let run = TestRun::of("echo up; sleep 1000");
    // In the way of the file that says it, as a power cut would be.
    std::fs::create_dir_all(run.run_dir().join("pid.json.tmp")).expect("made");
    let error =
        run.supervisor.start(&run.run_dir(), &run.spec).await.expect_err("refused").to_string();
    assert!(error.contains("pid.json"), "{error}");
    std::fs::remove_dir(run.run_dir().join("pid.json.tmp")).expect("removed");
    assert_eq!(run.supervisor.observe(&run.run_dir()).await.expect("observed"), RunState::Gone);
    let again = run.supervisor.start(&run.run_dir(), &run.spec).await;
    assert!(matches!(again, Err(SupervisorError::Used(_))), "{again:?}");
    assert_eq!(run.survivors(), Vec::<u32>::new());
}

#[tokio::test]
async fn repeated_start_runs_the_task_once() {
    let run = TestRun::of("echo up; sleep 1000");
    let dir = run.run_dir();
    let starts = (0..8).map(|_| run.supervisor.start(&dir, &run.spec));
    let started = within("all starts", futures_util::future::join_all(starts)).await;
    let pids: Vec<_> =
        started.into_iter().map(|started| started.expect("started").task.pid).collect();
    assert!(pids.iter().all(|pid| *pid == pids[0]), "{pids:?}");
    assert!(lives(pids[0]));
    within("the stop", run.supervisor.stop(&dir, LONG_GRACE)).await.expect("stopped");
    let again = run.supervisor.start(&dir, &run.spec).await;
    assert!(matches!(again, Err(SupervisorError::Used(_))), "{again:?}");
}

#[tokio::test]
async fn start_abandoned_before_the_shim_starts_nothing() {
    let run = TestRun::of("sleep 1000");
    let dir = RunDir::create(&run.run_dir()).expect("dir");
    let stalled = dir.try_lock().expect("locked").expect("nobody has it");
    let start = run.supervisor.start(dir.path(), &run.spec);
    assert!(tokio::time::timeout(Duration::from_millis(50), start).await.is_err());
    drop(stalled);
    // A waiting process would have the lock now. A process that another test is just starting
    // shares the lock for a moment.
    let over = eventually("the lock", || dir.try_lock().expect("locked")).await;
    assert_eq!(dir.spec().expect("readable"), None);
    drop(over);
    assert_eq!(run.survivors(), Vec::<u32>::new());
    assert_eq!(
        run.supervisor.observe(&run.run_dir()).await.expect("observed"),
        RunState::NeverStarted
    );
}

#[test]
fn waiting_for_a_hanging_start_blocks_no_thread() {
    // With one thread for all that blocks.
    let runtime =
        tokio::runtime::Builder::new_current_thread().enable_all().max_blocking_threads(1).build();
    runtime.expect("a runtime").block_on(async {
        let run = TestRun::of("true");
        let dir = RunDir::create(&run.run_dir()).expect("dir");
        dir.write_spec(&run.spec).expect("written");
        let hangs = dir.try_lock().expect("locked").expect("nobody has it");
        let (supervisor, path) = (&run.supervisor, dir.path());
        let look = supervisor.observe_within(path, Duration::ZERO);
        let looked = within("a look", look).await;
        assert!(matches!(looked, Err(SupervisorError::Starting)), "{looked:?}");
        let waiting = async {
            let all = (
                supervisor.observe(path),
                supervisor.pids(path),
                supervisor.stop(path, SHORT_GRACE),
                supervisor.start(path, &run.spec),
            );
            tokio::join!(all.0, all.1, all.2, all.3)
        };
        assert!(tokio::time::timeout(Duration::from_millis(200), waiting).await.is_err());
        let other = TestRun::of("exit 3");
        within("another start", other.supervisor.start(&other.run_dir(), &other.spec))
            .await
            .expect("started");
        let ended =
            within("its end", other.supervisor.wait(&other.run_dir())).await.expect("observed");
        assert_eq!(ended, RunState::Exited(ExitStatus::Code(3)));
        drop(hangs);
        within("the start", run.supervisor.start(path, &run.spec)).await.expect("started");
        within("its end", run.supervisor.wait(path)).await.expect("observed");
    });
}

/// Not a test of its own: the agent that the next test runs as a process and kills.
#[tokio::test]
async fn starter() {
    let Some(dir) = std::env::var_os("STARTER_DIR").map(PathBuf::from) else { return };
    let spec: RunSpec =
        serde_json::from_slice(&std::fs::read(dir.join("order.json")).expect("order"))
            .expect("spec");
    // A shell's `&` does this to every process that the shell starts.
    // SAFETY: ignoring a signal installs no handler.
    unsafe { nix::sys::signal::signal(Signal::SIGINT, SigHandler::SigIgn) }.expect("ignored");
    supervisor().start(&dir.join("run"), &spec).await.expect("started");
    std::fs::write(dir.join("started"), "").expect("said so");
    std::future::pending::<()>().await;
}

#[expect(
    clippy::disallowed_methods,
    reason = "the test needs a process it can kill in the place of the agent"
)]
fn spawn_starter(dir: &Path) -> std::process::Child {
    let mut command = std::process::Command::new(std::env::current_exe().expect("own path"));
    command.args(["--exact", "supervise::starter"]).env("STARTER_DIR", dir).process_group(0);
    command
        .stdout(std::process::Stdio::null())
        .stderr(std::process::Stdio::null())
        .spawn()
        .expect("spawned")
}

#[tokio::test]
async fn task_outlives_the_agent_and_is_adopted() {
    let run = TestRun::of(
        "trap 'echo asked; exit 4' INT; echo up; while :; do sleep 1000 & wait $!; done",
    );
    std::fs::write(run.path("order.json"), serde_json::to_vec(&run.spec).expect("json"))
        .expect("order");
    let mut starter = spawn_starter(&run.path("."));
    eventually("the start", || run.path("started").exists().then_some(())).await;
    run.wrote("up").await;
    let group = Pid::from_raw(i32::try_from(starter.id()).expect("pid"));
    nix::sys::signal::killpg(group, Signal::SIGKILL).expect("killed");
    starter.wait().expect("collected");

    let recorded =
        RunDir::create(&run.run_dir()).expect("dir").started().expect("read").expect("started");
    let observed = run.supervisor.observe(&run.run_dir()).await.expect("observed");
    assert!(
        matches!(observed, RunState::Running { pid, .. } if pid == recorded.task.pid),
        "{observed:?}"
    );
    // The run was started by a process that ignored SIGINT; a trap on SIGINT works only where the
    // ignored signal was not inherited.
    let (waited, stopped) = within(
        "the stop",
        futures_util::future::join(
            run.supervisor.wait(&run.run_dir()),
            run.supervisor.stop(&run.run_dir(), LONG_GRACE),
        ),
    )
    .await;
    assert_eq!(waited.expect("waited"), RunState::Exited(ExitStatus::Code(4)));
    assert_eq!(stopped.expect("stopped"), RunState::Exited(ExitStatus::Code(4)));
    assert_eq!(run.survivors(), Vec::<u32>::new());
}

/// Ignores every signal that can be ignored, and has children in sessions of their own, one of them
/// without its environment.
const STUBBORN: &str = r#"
trap '' INT TERM HUP
stubborn='trap "" INT TERM HUP; echo $$ >> pids; while :; do sleep 1000; done'
setsid bash -c "$stubborn" &
(setsid env -i PATH="$PATH" bash -c "$stubborn" &)
(setsid bash -c "setsid bash -c '$stubborn' & exit" &)
echo $$ >> pids
while :; do sleep 1000; done
"#;

async fn start_stubborn(script: &str) -> (TestRun, Started, Vec<u32>) {
    let run = TestRun::of(script);
    let started = within("the start", run.supervisor.start(&run.run_dir(), &run.spec))
        .await
        .expect("started");
    let pids = eventually("four stubborn processes", || {
        let text = std::fs::read_to_string(run.path("pids")).ok()?;
        let pids: Vec<u32> = text.lines().map(|line| line.parse().ok()).collect::<Option<_>>()?;
        (pids.len() == 4).then_some(pids)
    })
    .await;
    (run, started, pids)
}

#[tokio::test]
async fn stubborn_task_and_its_daemons_are_killed() {
    let (run, _, pids) = start_stubborn(STUBBORN).await;
    let stopped = within("the stop", run.supervisor.stop(&run.run_dir(), SHORT_GRACE))
        .await
        .expect("stopped");
    assert_eq!(stopped, RunState::Exited(ExitStatus::Signal(9)));
    assert_eq!(run.survivors(), Vec::<u32>::new());
    assert_eq!(pids.into_iter().filter(|pid| lives(*pid)).collect::<Vec<_>>(), Vec::<u32>::new());
    let again = within("the second stop", run.supervisor.stop(&run.run_dir(), SHORT_GRACE))
        .await
        .expect("stopped");
    assert_eq!(again, stopped);
}

#[tokio::test]
async fn dropped_stop_can_be_repeated() {
    let (run, _, _) = start_stubborn(STUBBORN).await;
    let dropped = tokio::time::timeout(
        Duration::from_millis(50),
        run.supervisor.stop(&run.run_dir(), LONG_GRACE),
    )
    .await;
    assert!(dropped.is_err());
    within("the second stop", run.supervisor.stop(&run.run_dir(), SHORT_GRACE))
        .await
        .expect("stopped");
    assert_eq!(run.survivors(), Vec::<u32>::new());
}

#[tokio::test]
async fn ended_task_leaves_no_daemons() {
    let (run, ended) = run_to_end(
        "setsid sleep 1000 & setsid bash -c 'trap \"\" TERM; sleep 1000' & echo $!; exit 5",
    )
    .await;
    assert_eq!(ended, RunState::Exited(ExitStatus::Code(5)));
    assert_eq!(run.survivors(), Vec::<u32>::new());
}

#[tokio::test]
async fn without_its_shim_a_task_is_ended_and_gone() {
    // Only the shim could identify the owner of the process without its environment.
    let (run, started, pids) = start_stubborn(&STUBBORN.replace("env -i PATH=\"$PATH\"", "")).await;
    let dir = run.run_dir();
    let kill = async { started.shim.signal(Signal::SIGKILL).expect("killed") };
    let (observed, ()) =
        within("the notice", futures_util::future::join(run.supervisor.wait(&dir), kill)).await;
    assert_eq!(observed.expect("observed"), RunState::Gone);
    assert_eq!(pids.into_iter().filter(|pid| lives(*pid)).collect::<Vec<_>>(), Vec::<u32>::new());
    assert_eq!(run.survivors(), Vec::<u32>::new());
    assert_eq!(
        run.supervisor.stop(&run.run_dir(), SHORT_GRACE).await.expect("stopped"),
        RunState::Gone
    );
}

#[tokio::test]
async fn reused_pid_is_not_mistaken_for_the_task() {
    let run = TestRun::of("true");
    let dir = RunDir::create(&run.run_dir()).expect("dir");
    dir.write_spec(&run.spec).expect("spec");
    let own = ProcessIdentity::of(std::process::id()).expect("stat").expect("alive");
    for imposter in [
        ProcessIdentity { start_ticks: own.start_ticks + 1, ..own.clone() },
        ProcessIdentity { boot_id: "0f5e1f2a-an-earlier-boot".to_owned(), ..own },
    ] {
        dir.write_started(&Started { shim: imposter.clone(), task: imposter }).expect("pid file");
        // A stop by pid would end this very process.
        assert_eq!(
            run.supervisor.stop(&run.run_dir(), SHORT_GRACE).await.expect("stopped"),
            RunState::Gone
        );
    }
}

#[tokio::test]
async fn flood_of_output_neither_blocks_the_task_nor_fills_the_disk() {
    let mut run = TestRun::of("yes 'a line of output' | head -c 20000000; echo the end");
    run.spec.log.max_bytes = 100_000;
    run.spec.log.files = 3;
    within("the start", run.supervisor.start(&run.run_dir(), &run.spec)).await.expect("started");
    let ended = within("the end", run.supervisor.wait(&run.run_dir())).await.expect("observed");
    assert_eq!(ended, RunState::Exited(ExitStatus::Code(0)));
    let sizes: Vec<u64> = ["task.log", "task.log.1", "task.log.2", "task.log.3"]
        .iter()
        .filter_map(|name| Some(std::fs::metadata(run.path(name)).ok()?.len()))
        .collect();
    assert_eq!(sizes.len(), 3);
    assert!(sizes.iter().all(|size| *size <= 100_000), "{sizes:?}");
    assert!(run.log().ends_with("the end\n"));
}

#[tokio::test]
async fn output_and_errors_are_told_apart_and_a_prompt_is_not_held_back() {
    let run = TestRun::of("mkfifo answer; echo one; echo two >&2; printf 'name? '; cat answer");
    within("the start", run.supervisor.start(&run.run_dir(), &run.spec)).await.expect("started");
    run.wrote("name? ").await;
    std::fs::write(run.path("answer"), "Ada\n").expect("answered");
    within("the end", run.supervisor.wait(&run.run_dir())).await.expect("observed");
    let log = std::fs::read_to_string(&run.spec.log.path).expect("log");
    let lines = log.lines().map(|line| line.split_once(' ').expect("a time").1);
    let of = |letters: &str| {
        lines.clone().filter(|line| line.starts_with(|c| letters.contains(c))).collect::<Vec<_>>()
    };
    assert_eq!(of("Oo"), ["O one", "O name? ", "o Ada"]);
    assert_eq!((of("Ee"), of("T")), (vec!["E two"], vec!["T started"]));
    let end = task_agent::logs::last_lines(&run.spec.log.path, 4096);
    assert!(end.contains("name?\nAda") && !end.contains("started"), "{end}");
}

#[tokio::test]
async fn unwritable_log_does_not_stop_the_task() {
    let mut run = TestRun::of("yes | head -c 1000000; exit 6");
    run.spec.log.path = PathBuf::from("/nonexistent/task.log");
    within("the start", run.supervisor.start(&run.run_dir(), &run.spec)).await.expect("started");
    let ended = within("the end", run.supervisor.wait(&run.run_dir())).await.expect("observed");
    assert_eq!(ended, RunState::Exited(ExitStatus::Code(6)));
}
