//! Building packages: with the real colcon where that matters, with stand-ins for tests of limits.

use std::collections::BTreeMap;
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::PathBuf;
use std::time::Duration;

use task_agent::install::builder::{self, BuildError, BuildLimits, BuildSpec};
use task_agent::install::work_dir;
use task_agent::logs::LogSpec;
use task_agent::process::cgroup::{Cgroups, RunLimits};
use task_agent::process::program;
use task_agent::process::program::ExitStatus;
use task_agent::process::run_dir::RunSpec;
use task_agent::process::supervisor::RunState;
use task_agent::setup::environment;
use task_agent::setup::installation::RosVersion;
use task_agent::setup::launch::Interrupt;
use task_agent::setup::script;
use task_agent::setup::underlay::{self, SearchPaths};
use task_agent::system::layout::DataDir;
use task_proto::Digest;
use task_proto::messages::report::FailureCode;
use task_proto::packages::manifest::{BuildTool, TaskManifest};
use tokio_util::sync::CancellationToken;

use crate::harness::{eventually, lives, other_user, supervisor, within, write};

/// A version directory with an order to build the version.
struct TestBuild {
    dir: tempfile::TempDir,
    spec: BuildSpec,
}

impl TestBuild {
    fn new(underlays: Vec<PathBuf>) -> Self {
        let dir = tempfile::tempdir().expect("temp dir");
        let data = DataDir::new(dir.path()).expect("data dir");
        let version = data.task(&"talker".parse().expect("name")).version(&Digest::of(b"manifest"));
        std::fs::create_dir_all(version.src()).expect("src");
        let spec = BuildSpec {
            tool: BuildTool::Colcon,
            version,
            underlays,
            environment: environment::robot_environment(&BTreeMap::new()),
            log: dir.path().join("build.log"),
            limits: BuildLimits::of_this_machine(),
            user: None,
            cgroups: None,
        };
        Self { dir, spec }
    }

    /// A build with this script as colcon, among the system's other tools.
    fn with_colcon(script: &str) -> Self {
        let mut build = Self::new(Vec::new());
        let bin = build.dir.path().join("bin");
        write(&bin.join("colcon"), &format!("#!/bin/bash\n{script}\n"));
        std::fs::set_permissions(bin.join("colcon"), std::fs::Permissions::from_mode(0o755))
            .expect("executable");
        build
            .spec
            .environment
            .insert("PATH".to_owned(), format!("{}:/usr/bin:/bin", bin.display()));
        build
    }

    async fn run(&self) -> Result<(), BuildError> {
        within("the build", builder::build(&self.spec, &CancellationToken::new())).await
    }

    fn log(&self) -> String {
        std::fs::read_to_string(&self.spec.log).unwrap_or_default()
    }

    fn src(&self, name: &str) -> PathBuf {
        self.spec.version.src().join(name)
    }

    /// The processes that were started for this build.
    fn processes(&self) -> usize {
        let marker = format!("TASKD_RUN_DIR={}", self.spec.version.root().display());
        let table = program::ProcessEntry::all().expect("process table");
        table.iter().filter(|entry| !entry.is_zombie && entry.was_started_with(&marker)).count()
    }
}

/// The real ROS that the tests run on.
fn ros() -> PathBuf {
    let root = std::env::var_os("TASKD_TEST_ROS").map(PathBuf::from);
    root.expect(
        "TASKD_TEST_ROS names no virtual environment with ROS 2 and colcon: \
         run ./scripts/test, which makes one",
    )
    .join("bin/activate")
}

fn write_ament_package(build: &TestBuild) {
    write(
        &build.src("package.xml"),
        r#"<?xml version="1.0"?>
<package format="3">
  <name>talker</name><version>1.0.0</version><description>says hello</description>
  <maintainer email="robots@example.com">Robots</maintainer><license>Apache-2.0</license>
  <exec_depend>rclpy</exec_depend>
  <export><build_type>ament_python</build_type></export>
</package>
"#,
    );
    write(
        &build.src("setup.py"),
        r#"from setuptools import setup
setup(name="talker", version="1.0.0", packages=["talker"],
      data_files=[("share/ament_index/resource_index/packages", ["resource/talker"]),
                  ("share/talker", ["package.xml"])],
      install_requires=["setuptools"],
      entry_points={"console_scripts": ["talker = talker.node:main"]})
"#,
    );
    write(
        &build.src("setup.cfg"),
        "[develop]\nscript_dir=$base/lib/talker\n[install]\ninstall_scripts=$base/lib/talker\n",
    );
    write(&build.src("resource/talker"), "");
    write(&build.src("talker/__init__.py"), "");
    write(
        &build.src("talker/node.py"),
        r#"import os, sys
import rclpy
def main():
    rclpy.init()
    node = rclpy.create_node("talker")
    domain = os.environ["ROS_DOMAIN_ID"]
    print("hello from", node.get_fully_qualified_name(), sys.argv[1:], domain, flush=True)
    node.destroy_node()
    rclpy.shutdown()
"#,
    );
}

#[tokio::test]
async fn real_ros_package_is_built_and_runs_under_its_shim() {
    let found = underlay::find(&[ros()], &SearchPaths::of_this_machine());
    let setups = underlay::setup_files(&found, Some(RosVersion::Ros2), &["kilted".to_owned()]);
    let mut build = TestBuild::new(setups.expect("kilted is there"));
    build.spec.environment.insert("ROS_DOMAIN_ID".to_owned(), "47".to_owned());
    write_ament_package(&build);
    build.run().await.unwrap_or_else(|error| panic!("{error}: {}", build.log()));
    // An interrupted build is done again.
    build.run().await.expect("built again");

    let manifest: TaskManifest = serde_json::from_value(serde_json::json!({
        "name": "talker", "version": "1.0.0", "build": {"tool": "colcon"},
        "run": {"exec": ["install/talker/lib/talker/talker", "it's", "$HOME"], "kind": "job"},
        "content": {"tar_digest": Digest::of(b""), "tar_size": 0, "entries": 0},
    }))
    .expect("manifest");
    let version = &build.spec.version;
    std::fs::write(
        version.run_script(),
        script::run_script(&manifest, version, &build.spec.underlays),
    )
    .expect("script");
    work_dir::refresh(BuildTool::Colcon, version, None).expect("made");
    let run_dir = build.dir.path().join("run");
    let spec = RunSpec {
        assignment: task_proto::DeploymentId::random(),
        script: version.run_script(),
        directory: version.work(),
        environment: build.spec.environment.clone(),
        interrupt: Interrupt::Group,
        log: LogSpec::at(build.dir.path().join("task.log")),
        limits: RunLimits::default(),
        user: None,
        has_outputs: false,
        cgroup: None,
    };
    supervisor().start(&run_dir, &spec).await.expect("started");
    let ended = within("the node", supervisor().wait(&run_dir)).await.expect("observed");
    let log = std::fs::read_to_string(&spec.log.path).unwrap_or_default();
    assert_eq!(ended, RunState::Exited(ExitStatus::Code(0)), "{log}");
    assert!(log.contains(r#"hello from /talker ["it's", '$HOME'] 47"#), "{log}");
}

#[tokio::test]
async fn catkin_package_is_built_and_installed() {
    let mut build = TestBuild::new(Vec::new());
    build.spec.tool = BuildTool::Catkin;
    write(
        &build.src("package.xml"),
        r#"<?xml version="1.0"?>
<package format="2">
  <name>mapper</name><version>1.0.0</version><description>maps</description>
  <maintainer email="robots@example.com">Robots</maintainer><license>Apache-2.0</license>
  <buildtool_depend>catkin</buildtool_depend>
</package>
"#,
    );
    write(
        &build.src("CMakeLists.txt"),
        "cmake_minimum_required(VERSION 3.5)\nproject(mapper NONE)\n\
         find_package(catkin REQUIRED)\ncatkin_package()\n\
         install(PROGRAMS mapper.sh DESTINATION ${CATKIN_PACKAGE_BIN_DESTINATION})\n",
    );
    write(&build.src("mapper.sh"), "#!/bin/sh\n");
    build
        .run()
        .await
        .unwrap_or_else(|error| panic!("{error}: ./scripts/test installs the requirements"));
    let install = build.spec.version.install();
    assert!(
        install.join("lib/mapper/mapper.sh").is_file()
            && install.join("local_setup.bash").is_file()
    );
}

#[tokio::test]
async fn failed_build_reports_the_tools_output() {
    let build = TestBuild::new(vec![ros()]);
    write_ament_package(&build);
    std::fs::remove_file(build.src("resource/talker")).expect("removed");
    let error = build.run().await.expect_err("failed");
    assert_eq!(error.code(), Some(FailureCode::BUILD_FAILED));
    assert!(error.to_string().contains("can't copy 'resource/talker'"), "{error}");
}

#[tokio::test]
async fn package_skipped_by_colcon_fails() {
    let build = TestBuild::new(vec![ros()]);
    write(&build.src("readme.txt"), "no package here");
    let error = build.run().await.expect_err("failed");
    assert!(
        matches!(
            &error,
            BuildError::NotInstalled { missing, .. } if missing.contains("package.xml")
        ),
        "{error}"
    );
}

#[tokio::test]
async fn missing_tool_and_a_missing_underlay_are_named() {
    let mut build = TestBuild::new(Vec::new());
    build.spec.environment.insert("PATH".to_owned(), "/nonexistent".to_owned());
    let error = build.run().await.expect_err("failed").to_string();
    assert!(error.contains("colcon is not installed"), "{error}");
    build.spec.underlays = vec!["/nonexistent/setup.bash".into()];
    let error = build.run().await.expect_err("failed").to_string();
    assert!(error.contains("the underlay /nonexistent/setup.bash does not exist"), "{error}");
}

#[tokio::test]
async fn build_is_optimized_and_skips_tests() {
    let build = TestBuild::new(vec![ros()]);
    write(
        &build.src("package.xml"),
        "<package format=\"3\"><!-- was <name>tested</name> --><name>plain</name>\
         <version>1.0.0</version><description>p</description>\
         <maintainer email=\"a@b.co\">a</maintainer><license>MIT</license>\
         <export><build_type>cmake</build_type></export></package>",
    );
    let cmake = "cmake_minimum_required(VERSION 3.10)\nproject(plain NONE)\n\
                 option(BUILD_TESTING \"\" ON)\n\
                 if(BUILD_TESTING)\nfind_package(nobody_has_this REQUIRED)\nendif()\n\
                 file(WRITE ${CMAKE_BINARY_DIR}/kind \"${CMAKE_BUILD_TYPE}\")\n\
                 install(FILES package.xml ${CMAKE_BINARY_DIR}/kind DESTINATION share/plain)\n";
    write(&build.src("CMakeLists.txt"), cmake);
    build.run().await.unwrap_or_else(|error| panic!("{error}\n{}", build.log()));
    let kind = std::fs::read_to_string(build.spec.version.install().join("plain/share/plain/kind"))
        .expect("installed");
    assert_eq!(kind, "Release");
    // A colcon that does not know cmake is given no cmake arguments.
    let bare = TestBuild::with_colcon("echo \"asked: $*\"; mkdir -p install/talker");
    bare.run().await.expect("built");
    assert!(bare.log().contains("--install-base install\n"), "{}", bare.log());
}

#[tokio::test]
async fn build_has_low_priority_and_limits() {
    let mut build = TestBuild::with_colcon(
        "echo nice $(nice), memory $(ulimit -d); mkdir -p install/talker; exit 0",
    );
    build.spec.limits.memory_bytes = Some(1 << 30);
    build.run().await.expect("built");
    assert!(build.log().contains("nice 10, memory 1048576"), "{}", build.log());
    let big = TestBuild::with_colcon("tail /dev/zero");
    let mut limited = big.spec.clone();
    limited.limits.memory_bytes = Some(100 << 20);
    let error = within("the build", builder::build(&limited, &CancellationToken::new()))
        .await
        .expect_err("failed");
    assert!(error.to_string().contains("memory exhausted"), "{error}");
}

const ENDLESS: &str =
    "trap '' INT TERM; (setsid sleep 1000 &); echo compiling; sleep 1000; sleep 1000";

#[tokio::test]
async fn cancelled_build_ends_all_its_processes() {
    let build = TestBuild::with_colcon(ENDLESS);
    let cancel = CancellationToken::new();
    let cancelling = async {
        eventually("the build's start", || build.log().contains("compiling").then_some(())).await;
        cancel.cancel();
    };
    let building = futures_util::future::join(builder::build(&build.spec, &cancel), cancelling);
    let (built, ()) = within("the cancelled build", building).await;
    assert!(matches!(built, Err(BuildError::Cancelled)), "{built:?}");
    assert_eq!(build.processes(), 0);
}

#[tokio::test]
async fn dropped_or_timed_out_build_leaves_no_processes() {
    let mut build = TestBuild::with_colcon(ENDLESS);
    {
        let cancel = CancellationToken::new();
        let mut building = std::pin::pin!(builder::build(&build.spec, &cancel));
        let compiles = || build.log().contains("compiling").then_some(());
        tokio::select! {
            built = &mut building => panic!("{built:?}"),
            () = eventually("the build's start", compiles) => {}
        }
    }
    eventually("the end of the dropped build", || (build.processes() == 0).then_some(())).await;
    build.spec.limits.timeout = Duration::from_millis(200);
    let error = build.run().await.expect_err("failed");
    assert_eq!(error.code(), Some(FailureCode::DEADLINE_EXCEEDED));
    assert_eq!(build.processes(), 0);
}

/// Starts a process that leaves the build's session and environment.
const ESCAPE: &str = "env -i setsid bash -c \
                      'echo $$ > escaped.tmp; mv escaped.tmp escaped; exec sleep 1000' & \
                      until [ -e escaped ]; do :; done; exit 3";

#[tokio::test]
async fn build_in_a_cgroup_leaves_no_processes() {
    let mut build = TestBuild::with_colcon(ESCAPE);
    build.spec.cgroups = Cgroups::find();
    let Some(cgroups) = &build.spec.cgroups else {
        eprintln!("unavailable: this machine has no control groups that may be written to");
        return;
    };
    let error = build.run().await.expect_err("colcon failed");
    assert!(matches!(error, BuildError::Failed { status: ExitStatus::Code(3), .. }), "{error:?}");
    let pid = std::fs::read_to_string(build.spec.version.root().join("escaped")).expect("its pid");
    assert!(!lives(pid.trim().parse().expect("a pid")));
    assert!(!cgroups.group(build.spec.version.root()).path().exists());
}

#[tokio::test]
async fn build_writes_only_its_tree_and_has_no_privileges() {
    let Some(user) = other_user() else { return };
    let mut build = TestBuild::with_colcon(
        "mkdir -m 700 install/talker; touch install/talker/mine build/mine log/mine
         chmod 4755 install/talker/mine
         id -u; grep -E 'NoNewPrivs|CapBnd' /proc/self/status
         for place in src/new new build.sh; do if touch $place; then echo GOT $place; fi; done",
    );
    user.allow_traversal(&[
        build.dir.path().to_owned(),
        build.dir.path().join("tasks"),
        build.dir.path().join("tasks/talker"),
    ])
    .expect("let through");
    build.spec.user = Some(user.clone());
    build.run().await.unwrap_or_else(|error| panic!("{error}: {}", build.log()));
    let log = build.log().replace('\t', "");
    assert!(
        log.contains(&format!("{}\nCapBnd:0000000000000000\nNoNewPrivs:1\n", user.uid)),
        "{log}"
    );
    assert!(!log.contains("GOT"), "{log}");
    // All of it is root's now: readable by every user who reaches it, and writable by none.
    let about = |name: &str| {
        let about = std::fs::metadata(build.spec.version.root().join(name)).expect("there");
        (about.uid(), about.mode() & 0o7777)
    };
    assert_eq!((about("install/talker"), about("install/talker/mine")), ((0, 0o755), (0, 0o755)));
    assert_eq!((about("build/mine").0, about("log/mine").0, about("src").0), (0, 0, 0));
}

#[tokio::test]
async fn escaped_build_process_does_not_block() {
    let build = TestBuild::with_colcon(ESCAPE);
    let error = build.run().await.expect_err("colcon failed");
    let pid = std::fs::read_to_string(build.spec.version.root().join("escaped")).expect("its pid");
    let escaped =
        program::ProcessIdentity::of(pid.trim().parse().expect("a pid")).expect("process table");
    escaped.expect("it still lives").signal(nix::sys::signal::Signal::SIGKILL).expect("killed");
    assert!(matches!(error, BuildError::Failed { status: ExitStatus::Code(3), .. }), "{error:?}");
}
