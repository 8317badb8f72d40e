//! The gate with real programs: its answers, its reasons, and the leftovers of a program that
//! hangs.

use std::collections::BTreeMap;
use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;
use std::time::Duration;

use task_agent::config::{GateConfig, GateDefault};
use task_agent::process::containment::Containment;
use task_agent::reconcile::gate::Gate;
use task_agent::task::ledger::{GateQuestion, GateStep};
use task_proto::messages::report::Failure;
use task_proto::{DeploymentId, TaskName};

use crate::harness::eventually;

/// Asks the gate `script`; `dir` is its working directory.
async fn ask(
    dir: &Path,
    script: &str,
    timeout: Duration,
    default: GateDefault,
) -> Result<(), Failure> {
    let program = dir.join("gate.sh");
    std::fs::write(&program, format!("#!/bin/bash\n{script}\n")).expect("written");
    std::fs::set_permissions(&program, std::fs::Permissions::from_mode(0o755)).expect("executable");
    ask_program(dir, &program, timeout, default).await
}

async fn ask_program(
    dir: &Path,
    program: &Path,
    timeout: Duration,
    default: GateDefault,
) -> Result<(), Failure> {
    let command = vec![program.display().to_string(), "an argument".to_owned()];
    let environment = BTreeMap::from([("PATH".to_owned(), "/usr/bin:/bin".to_owned())]);
    let gate = Gate::new(GateConfig { command, timeout, default }, dir);
    let question = GateQuestion {
        step: GateStep::Switch,
        deployment: DeploymentId::random(),
        run: 3,
        version: "1.1".parse().expect("valid"),
    };
    gate.query(&task(), &question, &environment).await
}

fn task() -> TaskName {
    "talker".parse().expect("valid")
}

/// Longer than any answer here takes.
const LONG: Duration = Duration::from_secs(60);

#[tokio::test]
async fn gate_receives_the_question_and_its_reason_is_kept() {
    let dir = tempfile::tempdir().expect("a directory");
    let asked = "[ \"$TASKD_GATE_STEP $TASKD_TASK $TASKD_VERSION $TASKD_RUN $1\" \
                 = 'switch talker 1.1 3 an argument' ] \
                 && [ -n \"$TASKD_DEPLOYMENT\" ]";
    assert_eq!(ask(dir.path(), asked, LONG, GateDefault::Deny).await, Ok(()));
    let refusal = ask(
        dir.path(),
        "echo; echo carries a load; echo at dock 3 >&2; exit 7",
        LONG,
        GateDefault::Allow,
    );
    assert_eq!(
        refusal.await.expect_err("no").to_string(),
        "gate_refused: carries a load\nat dock 3"
    );
    let silent = ask(dir.path(), "exit 7", LONG, GateDefault::Allow).await.expect_err("no");
    assert_eq!(silent.to_string(), "gate_refused: the gate refused without a reason (exit code 7)");
    let flood = ask(
        dir.path(),
        "head -c 10000000 /dev/zero | tr '\\0' x; exit 1",
        LONG,
        GateDefault::Allow,
    );
    assert_eq!(flood.await.expect_err("no").text.len(), 1024);
}

#[tokio::test]
async fn gate_without_an_answer_uses_the_default_and_leaves_no_process() {
    let dir = tempfile::tempdir().expect("a directory");
    let hang = "setsid sleep 1000 & trap '' INT TERM; sleep 1000";
    let short = Duration::from_millis(300);
    assert_eq!(ask(dir.path(), hang, short, GateDefault::Allow).await, Ok(()));
    let failure = ask(dir.path(), hang, short, GateDefault::Deny).await.expect_err("no");
    assert!(failure.to_string().starts_with("gate_failed: the gate "), "{failure}");
    assert!(failure.text.contains("did not answer"), "{failure}");
    let left = Containment::new(&dir.path().join("gate/talker"), None, None)
        .members()
        .expect("the process table");
    assert_eq!(left, []);
    let crash = ask(dir.path(), "kill -SEGV $$", LONG, GateDefault::Deny).await.expect_err("no");
    assert!(crash.text.contains("crashed: killed by SIGSEGV"), "{crash}");
    let none = ask_program(dir.path(), Path::new("/nonexistent/gate"), LONG, GateDefault::Deny)
        .await
        .expect_err("no");
    assert!(none.text.starts_with("cannot run the gate /nonexistent/gate: No such file"), "{none}");
}

#[tokio::test]
async fn dropped_gate_query_ends_the_gate() {
    let dir = tempfile::tempdir().expect("a directory");
    let started = dir.path().join("started");
    let script = format!("touch {}; sleep 1000", started.display());
    let gate = ask(dir.path(), &script, LONG, GateDefault::Deny);
    tokio::select! {
        answer = gate => panic!("it answered: {answer:?}"),
        () = eventually("it runs", || started.exists().then_some(())) => {}
    }
    let marked = Containment::new(&dir.path().join("gate/talker"), None, None);
    let is_empty = || marked.members().expect("the process table").is_empty().then_some(());
    eventually("it is gone", is_empty).await;
}
