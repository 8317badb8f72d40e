//! ROS 1: Debian's catkin, roslaunch and master, the whole way. And requirements, which are checked
//! before bytes travel.
#![expect(clippy::disallowed_methods, reason = "a test starts processes")]

use std::net::TcpListener;
use std::path::Path;

use task_proto::messages::report::{FailureCode, Phase};

use crate::harness::{Fleet, Robot, Server, eventually, required};
use crate::leftovers::processes_with;

/// The unused address of a ROS 1 master, and the nodes' means of finding the master.
struct Master {
    uri: String,
}

impl Master {
    fn on_a_free_port() -> Self {
        // The port is free again when the master begins; no other process asks the kernel for this
        // very port.
        let port = TcpListener::bind("127.0.0.1:0")
            .and_then(|free| free.local_addr())
            .expect("a port")
            .port();
        Self { uri: format!("http://127.0.0.1:{port}") }
    }

    fn environment(&self) -> [(&str, &str); 2] {
        [("ROS_MASTER_URI", &self.uri), ("ROS_IP", "127.0.0.1")]
    }

    /// The output of one of ROS 1's own programs, `None` when the program fails.
    async fn ask(&self, home: &Path, program: &str, arguments: &[&str]) -> Option<String> {
        let mut command = tokio::process::Command::new(format!("/usr/bin/{program}"));
        command
            .args(arguments)
            .env_clear()
            .env("PATH", "/usr/bin:/bin")
            .env("HOME", home)
            .envs(self.environment());
        let output = command.output().await.expect("ROS 1 is installed: run ./scripts/test");
        output.status.success().then(|| String::from_utf8_lossy(&output.stdout).trim().to_owned())
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn ros_1_package_is_built_launched_and_stopped() {
    let dir = tempfile::tempdir().expect("temp dir");
    let home = dir.path().to_str().expect("utf-8");
    let server = Server::start(&dir.path().join("server")).await;
    // Its nodes write their own logs below HOME.
    let master = Master::on_a_free_port();
    let mut settings = vec![("HOME", home)];
    settings.extend(master.environment());
    let robot =
        Robot::start_with(&server, dir.path(), "robot-1", 1, &server.url(""), &settings).await;
    let package = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/ros1_talker");
    let package = package.to_str().expect("utf-8");
    server.operate(["push", package, "--to", "*", "--wait", "--timeout", "3m"]).await;

    eventually("the node to be registered", async || {
        let nodes = master.ask(dir.path(), "rosnode", &["list"]).await?;
        nodes.lines().any(|node| node == "/talker").then_some(())
    })
    .await;
    let said = eventually("the service to answer", async || {
        master.ask(dir.path(), "rosservice", &["call", "/say"]).await
    })
    .await;
    assert!(said.contains("success: True") && said.contains("good day "), "{said}");
    let facts = server.robot("robot-1").await.expect("known").host.expect("reported");
    assert!(facts.ros_distros.contains(&"debian".to_owned()), "{facts:?}");

    // Each of them is in a session of its own.
    let master_uri = format!("ROS_MASTER_URI={}", master.uri);
    let ours = |program: &str| {
        let carry = processes_with(master_uri.as_bytes());
        let named = |pid: &i32| std::fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
        carry
            .into_iter()
            .filter(|pid| String::from_utf8_lossy(&named(pid)).contains(program))
            .count()
    };
    for program in ["roslaunch", "rosmaster", "rosout", "ros1_talker/talker"] {
        assert!(ours(program) > 0, "{program} runs");
    }
    server.operate(["stop", "ros1_talker", "--on", "*", "--yes"]).await;
    server.wait_phase("robot-1", "ros1_talker", Phase::Stopped).await;
    for program in ["roslaunch", "rosmaster", "rosout", "ros1_talker/talker"] {
        assert_eq!(ours(program), 0, "{program} is left");
    }
    drop(robot);
}

#[tokio::test(flavor = "multi_thread")]
async fn robot_without_a_ros_package_is_unmet_before_the_content_travels() {
    let venv = required("TASKD_TEST_ROS");
    let mut fleet = Fleet::start(0).await;
    // The domain is the one of the shell that the agent was started in.
    let settings =
        [("TASK_AGENT_UNDERLAYS", &*format!("{venv}/bin/activate")), ("ROS_DOMAIN_ID", "73")];
    let url = fleet.server.url("");
    fleet.robots.push(
        Robot::start_with(&fleet.server, fleet.dir.path(), "robot-1", 1, &url, &settings).await,
    );
    let package = fleet.dir.path().join("navigator");
    std::fs::create_dir(&package).expect("made");
    let xml = "<package format=\"3\"><name>navigator</name><version>1.0.0</version>\
        <description>d</description>\
        <maintainer email=\"a@example.org\">A</maintainer><license>Apache-2.0</license>\
        <exec_depend>rclpy</exec_depend><exec_depend>std_msgs</exec_depend>\
        <exec_depend>python3-numpy</exec_depend>\
        <exec_depend>taskd_absent_bringup</exec_depend><exec_depend>taskd_absent_msgs</exec_depend>\
        <exec_depend condition=\"$ROS_VERSION == 1\">taskd_absent_of_ros_1</exec_depend>\
        <export><build_type>ament_python</build_type></export></package>";
    std::fs::write(package.join("package.xml"), xml).expect("written");
    std::fs::write(
        package.join("setup.py"),
        "from setuptools import setup\nsetup(name='navigator')\n",
    )
    .expect("written");
    std::fs::write(package.join("task.toml"), "[run]\nexec = [\"true\"]\n").expect("written");
    fleet.server.push(&package, "*").await;

    let view = fleet.server.wait_phase("robot-1", "navigator", Phase::Unmet).await;
    let failure = view.tasks[0].failure.clone().expect("why");
    assert_eq!(failure.code, FailureCode::REQUIREMENTS_UNMET);
    let list = "navigator 1.0.0: ROS package taskd_absent_bringup, ROS package taskd_absent_msgs";
    assert!(failure.text.ends_with(list), "{failure}");
    let log = std::fs::read_to_string(fleet.robots[0].data().with_extension("agent.log"))
        .expect("the agent's log");
    assert!(
        log.contains("pull the manifest of navigator") && !log.contains("pull navigator"),
        "{log}"
    );

    let ros = view.host.expect("reported").ros.expect("kilted was found");
    assert_eq!((ros.distro.as_str(), ros.domain_id), ("kilted", Some(73)));
    assert_eq!(ros.rmw.as_deref(), Some("rmw_fastrtps_cpp"));
}
