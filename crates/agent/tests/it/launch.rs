//! Launchers: the arguments that reach `ros2 launch`, and the processes that are asked to end. A
//! recorded `ros2` stands in for the real one.

use std::collections::BTreeMap;
use std::os::unix::fs::PermissionsExt;
use std::path::PathBuf;
use std::time::Duration;

use task_agent::process::program::ExitStatus;
use task_agent::process::supervisor::RunState;
use task_agent::setup::launch;
use task_agent::setup::script;
use task_agent::system::layout::{DataDir, VersionDir};
use task_proto::Digest;
use task_proto::packages::manifest::TaskManifest;

use crate::harness::{TestRun, eventually, within, write};

/// Longer than a stop may take that is not waited for in vain.
const LONG_GRACE: Duration = Duration::from_secs(50);

/// A task of an installed package, started by a `ros2` that is this program.
struct Launched {
    run: TestRun,
    version: VersionDir,
}

impl Launched {
    fn by(ros2: &str, arguments: &[(&str, &str)]) -> Self {
        let mut run = TestRun::of("");
        let manifest: TaskManifest = serde_json::from_value(serde_json::json!({
            "name": "talker", "version": "1.0.0", "build": {"tool": "colcon"},
            "run": {
                "launch": ["talker", "talker.launch.py"],
                "args": arguments.iter().copied().collect::<BTreeMap<_, _>>(),
            },
            "content": {"tar_digest": Digest::of(b""), "tar_size": 0, "entries": 0},
        }))
        .expect("manifest");
        let data = DataDir::new(&run.path("it's data")).expect("data dir");
        let version = data.task(&manifest.name).version(&Digest::of(b"manifest"));
        write(&version.install().join("local_setup.bash"), "export OVERLAY=sourced\n");
        std::fs::create_dir_all(version.work()).expect("a working directory");
        let underlay = run.path("setup.bash");
        write(
            &underlay,
            &format!("export UNDERLAY=sourced PATH=\"{}:$PATH\"\n", run.path("bin").display()),
        );
        let program = run.path("bin/ros2");
        write(&program, ros2);
        std::fs::set_permissions(&program, std::fs::Permissions::from_mode(0o755))
            .expect("executable");
        write(&run.spec.script, &script::run_script(&manifest, &version, &[underlay]));
        run.spec.interrupt = launch::of(&manifest).interrupt;
        run.spec.directory = version.work();
        run.spec.environment.insert("ROS_DOMAIN_ID".to_owned(), "42".to_owned());
        Self { run, version }
    }

    async fn start(&self) {
        within("the start", self.run.supervisor.start(&self.run.run_dir(), &self.run.spec))
            .await
            .expect("started");
    }

    async fn stop(&self) -> RunState {
        within("the stop", self.run.supervisor.stop(&self.run.run_dir(), LONG_GRACE))
            .await
            .expect("stopped")
    }
}

/// The texts in a file, each ended by NUL.
fn texts(path: PathBuf) -> Vec<String> {
    let text = String::from_utf8(std::fs::read(path).expect("recorded")).expect("utf-8");
    text.split_terminator('\0').map(str::to_owned).collect()
}

#[tokio::test]
async fn launch_arguments_reach_ros2_as_they_are() {
    let arguments = [
        ("a_space", "two words  and two spaces "),
        ("b_quotes", r#"it's "quoted" \ and `run`"#),
        ("c_shell", "$HOME $(touch escaped) ${PATH} ; & | > escaped * ? ~ !"),
        ("d_unicode", "grüße, 走廊, 🤖"),
        ("e_empty", ""),
        ("f_assignment", "x:=y"),
        ("g_option", "--ros-args"),
    ];
    let record = "#!/bin/bash\nprintf '%s\\0' \"$@\" > argv\nenv -0 > environment\n\
                  grep SigIgn /proc/self/status\npwd -P\n";
    let launched = Launched::by(record, &arguments);
    launched.start().await;
    let ended = within("the end", launched.run.supervisor.wait(&launched.run.run_dir()))
        .await
        .expect("observed");
    let log = launched.run.log();
    assert_eq!(ended, RunState::Exited(ExitStatus::Code(0)), "{log}");

    let root = launched.version.work();
    let mut expected =
        vec!["launch".to_owned(), "talker".to_owned(), "talker.launch.py".to_owned()];
    expected.extend(arguments.iter().map(|(name, value)| format!("{name}:={value}")));
    assert_eq!(texts(root.join("argv")), expected);
    assert!(!root.join("escaped").exists(), "a value became shell");
    assert!(log.contains(&root.canonicalize().expect("there").display().to_string()), "{log}");
    let ignored = log.lines().find_map(|line| line.strip_prefix("SigIgn:\t")).expect("recorded");
    let ignored = u64::from_str_radix(ignored, 16).expect("a mask");
    assert_eq!(
        ignored & 0x7fff_ffff,
        0,
        "signals a person can send are not ignored, SIGINT least of all"
    );

    let environment: BTreeMap<String, String> = texts(root.join("environment"))
        .iter()
        .filter_map(|entry| {
            entry.split_once('=').map(|(name, value)| (name.to_owned(), value.to_owned()))
        })
        .collect();
    let assignment = launched.run.spec.assignment.to_string();
    for (name, value) in [
        ("UNDERLAY", "sourced"),
        ("OVERLAY", "sourced"),
        ("ROS_DOMAIN_ID", "42"),
        ("PYTHONUNBUFFERED", "1"),
        ("TASKD_ASSIGNMENT", assignment.as_str()),
    ] {
        assert_eq!(environment.get(name).map(String::as_str), Some(value), "{name}");
    }
    let inherited = environment
        .keys()
        .filter(|name| name.starts_with("CARGO") || name.starts_with("TASKD_TEST"));
    assert_eq!(inherited.collect::<Vec<_>>(), Vec::<&String>::new());
}

/// Behaves as `ros2 launch` without a terminal: starts a node in its own process group and forwards
/// a SIGINT to the node. The node counts the SIGINTs that arrive until its launcher has seen the
/// first.
const LAUNCHER: &str = r#"#!/usr/bin/env python3
import os, signal, subprocess, sys
NODE = '''
import signal, sys
count = 0
def interrupted(*_):
    global count
    count += 1
    print("interrupted", flush=True)
signal.signal(signal.SIGINT, interrupted)
print("up", flush=True)
sys.stdin.read()
print("the node was interrupted", count, flush=True)
'''
pipe = subprocess.PIPE
node = subprocess.Popen([sys.executable, "-c", NODE], stdin=pipe, stdout=pipe, text=True)
assert node.stdout.readline() == "up\n"
def interrupted(*_):
    node.send_signal(signal.SIGINT)
signal.signal(signal.SIGINT, interrupted)
print("launched", flush=True)
assert node.stdout.readline() == "interrupted\n"
print(node.communicate()[0], flush=True)
sys.exit(7)
"#;

#[tokio::test]
async fn stop_signals_only_the_launcher() {
    let launched = Launched::by(LAUNCHER, &[]);
    launched.start().await;
    launched.run.wrote("launched").await;
    let stopped = launched.stop().await;
    let log = launched.run.log();
    assert_eq!(stopped, RunState::Exited(ExitStatus::Code(7)), "{log}");
    assert!(log.contains("the node was interrupted 1\n"), "{log}");
    assert_eq!(launched.run.survivors(), Vec::<u32>::new());
}

#[tokio::test]
async fn dead_launcher_leaves_no_node() {
    let launched =
        Launched::by(&LAUNCHER.replace("text=True)", "text=True, start_new_session=True)"), &[]);
    launched.start().await;
    launched.run.wrote("launched").await;
    let started = task_agent::process::run_dir::RunDir::create(&launched.run.run_dir())
        .expect("dir")
        .started()
        .expect("read");
    started.expect("started").task.signal(nix::sys::signal::Signal::SIGKILL).expect("killed");
    let ended = within("the end", launched.run.supervisor.wait(&launched.run.run_dir()))
        .await
        .expect("observed");
    assert_eq!(ended, RunState::Exited(ExitStatus::Signal(9)));
    assert_eq!(launched.run.survivors(), Vec::<u32>::new());
}

#[tokio::test]
async fn stop_is_noticed_while_an_underlay_is_sourced() {
    let launched = Launched::by("#!/bin/bash\necho never\n", &[]);
    write(&launched.run.path("setup.bash"), "echo sourcing; while :; do sleep 0.05; done\n");
    launched.start().await;
    eventually("the underlay to be sourced", || {
        launched.run.log().contains("sourcing").then_some(())
    })
    .await;
    assert_eq!(launched.stop().await, RunState::Exited(ExitStatus::Code(130)));
}
