//! Publishers' signatures through the real programs: packages with enough signatures run on any
//! route, and no others.

use std::path::{Path, PathBuf};

use serde_json::{Value, json};
use task_proto::api::RobotView;
use task_proto::messages::report::{Failure, FailureCode, Phase};

use crate::harness::{Robot, Server, eventually, write_package};

/// A server, and a robot that trusts some publishers.
pub struct Site {
    pub server: Server,
    pub robot: Robot,
    pub dir: tempfile::TempDir,
}

/// Makes a key and gives its private file and the public text.
pub async fn new_key(server: &Server, dir: &Path, name: &str) -> (String, String) {
    let file = dir.join(name).to_str().expect("utf-8").to_owned();
    let made: Value =
        serde_json::from_str(&server.operate(["key", "new", &file, "-o", "json"]).await)
            .expect("json");
    (file, made["key"].as_str().expect("a key").to_owned())
}

impl Site {
    /// A robot that trusts `keys` and requires signatures by `threshold` of them.
    pub async fn start(threshold: u8, keys: &[&str]) -> (Self, Vec<(String, String)>) {
        let dir = tempfile::tempdir().expect("temp dir");
        let server = Server::start(&dir.path().join("server")).await;
        let mut made = Vec::new();
        for name in keys {
            made.push(new_key(&server, dir.path(), name).await);
        }
        let keys: Vec<&str> = made.iter().map(|(_, key)| key.as_str()).collect();
        let settings = [
            ("TASK_AGENT_TRUSTED_PUBLISHERS_KEYS", keys.join(",")),
            ("TASK_AGENT_TRUSTED_PUBLISHERS_THRESHOLD", threshold.to_string()),
            ("TASK_AGENT_POLL_INTERVAL_WITHOUT_MQTT_S", "1".to_owned()),
            ("TASK_AGENT_POLL_INTERVAL_S", "1".to_owned()),
        ];
        let settings: Vec<(&str, &str)> =
            settings.iter().map(|(name, value)| (*name, value.as_str())).collect();
        let url = server.url("");
        let robot = Robot::start_with(&server, dir.path(), "robot-1", 1, &url, &settings).await;
        (Self { server, robot, dir }, made)
    }

    /// A service that writes its version to a file in a separate place.
    pub fn package(&self, version: &str) -> PathBuf {
        let package = self.dir.path().join(format!("worker-{version}"));
        write_package(&package, "worker", version, "service", "exec sleep 1000\n");
        package
    }

    /// Orders a version, signed so, and gives the deployment.
    pub async fn push(&self, version: &str, options: &[&str]) -> String {
        self.server.push_with(&self.package(version), "robot-1", options).await.id.to_string()
    }

    /// Waits until the order stands so.
    pub async fn wait(&self, deployment: &str, phase: Phase) -> RobotView {
        eventually(&format!("{deployment} to be {phase}"), async || {
            let view = self.server.robot("robot-1").await?;
            view.tasks
                .iter()
                .any(|task| task.deployment.as_str() == deployment && task.phase == phase)
                .then_some(view)
        })
        .await
    }

    async fn refused(&self, deployment: &str) -> (RobotView, Failure) {
        let view = self.wait(deployment, Phase::Failed).await;
        let failure = view.tasks[0].failure.clone().expect("a reason");
        (view, failure)
    }

    /// Whether the robot has taken in anything of an order's package.
    async fn has_fetched(&self, deployment: &str) -> bool {
        let package = self.server.deployment(deployment).await.expect("known").package;
        let version = self.robot.data().join("tasks/worker").join(package.manifest.digest.hex());
        ["task.json", "src"].iter().any(|name| version.join(name).exists())
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn only_packages_with_enough_signatures_run_by_any_delivery() {
    let (site, keys) = Site::start(2, &["ada.key", "bob.key"]).await;
    let [ada, bob] = [0, 1].map(|at: usize| keys[at].0.as_str());
    let (eve, _) = new_key(&site.server, site.dir.path(), "eve.key").await;
    for (version, delivery) in
        [("1.0", "push-pull"), ("2.0", "inline"), ("3.0", "direct-push"), ("4.0", "poll")]
    {
        let order =
            site.push(version, &["--sign", ada, "--sign", bob, "--delivery", delivery]).await;
        site.wait(&order, Phase::Running).await;
    }
    let keys: [&[&str]; 3] = [&[], &["--sign", ada], &["--sign", ada, "--sign", &eve]];
    for (version, signers) in ["5.0", "6.0", "7.0"].into_iter().zip(keys) {
        let order = site.push(version, signers).await;
        let (view, failure) = site.refused(&order).await;
        assert_eq!(failure.code, FailureCode::UNTRUSTED_PACKAGE);
        let count = usize::from(!signers.is_empty());
        let text = format!("signed by {count} of the 2 required trusted publishers");
        assert!(failure.text.contains(&text), "{failure}");
        assert!(!site.has_fetched(&order).await);
        assert_eq!(
            view.tasks[0].active.as_ref().map(|active| active.version.as_str()),
            Some("4.0"),
            "it goes on"
        );
    }
    // The operator sees why, and the second publisher's word is enough, from the same directory on
    // any machine.
    let shown = site.server.operate(["robot", "info", "robot-1"]).await;
    assert!(shown.contains("untrusted_package"), "{shown}");
    assert!(shown.contains("from the robot's own settings"), "{shown}");
    let order = site.push("6.0", &["--sign", bob]).await;
    site.wait(&order, Phase::Running).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn publisher_list_rotates_keys_and_blocks_restarts_of_revoked_packages() {
    let (mut site, keys) = Site::start(1, &["ada.key"]).await;
    let ada = keys[0].0.clone();
    let (bob, bob_public) = new_key(&site.server, site.dir.path(), "bob.key").await;
    let (keeper, keeper_public) = new_key(&site.server, site.dir.path(), "keeper.key").await;
    let order = site.push("1.0", &["--sign", &ada]).await;
    site.wait(&order, Phase::Running).await;

    let draft = site.dir.path().join("list").to_str().expect("utf-8").to_owned();
    let server = &site.server;
    server
        .operate(["key", "draft", &draft, "--publisher", &bob_public, "--keeper", &keeper_public])
        .await;
    let unsigned = server.try_operate(["key", "publish", &draft]).await;
    assert!(!unsigned.status.success());
    // By the keeper before, which is the publisher of the robot's settings, and by the new one.
    for key in [&ada, &keeper] {
        server.operate(["key", "sign", &draft, "--key", key]).await;
    }
    server.operate(["key", "publish", &draft]).await;
    let listed: Value =
        serde_json::from_str(&server.operate(["key", "list", "-o", "json"]).await).expect("json");
    assert_eq!(
        (&listed["version"], &listed["publishers"]["keys"]),
        (&json!(1), &json!([bob_public]))
    );
    let revoked = eventually("the robot to go by the list", async || {
        let view = server.robot("robot-1").await?;
        let degraded = view.tasks[0]
            .degraded
            .as_ref()
            .is_some_and(|why| why.code == FailureCode::UNTRUSTED_PACKAGE);
        (view.host.as_ref()?.publishers == Some(1) && degraded).then_some(view)
    })
    .await;
    assert_eq!(revoked.tasks[0].phase, Phase::Running, "the running task continues");

    // The machine goes down and comes back: a package that is no longer vouched for is not started.
    let pid = revoked.tasks[0].active.as_ref().expect("active").pid;
    site.robot.kill();
    let pid = nix::unistd::Pid::from_raw(i32::try_from(pid).expect("a pid"));
    nix::sys::signal::kill(pid, nix::sys::signal::Signal::SIGKILL).expect("killed");
    site.robot.restart();
    let (view, failure) = site.refused(&order).await;
    assert_eq!(failure.code, FailureCode::UNTRUSTED_PACKAGE);
    assert!(view.tasks[0].active.is_none());

    let order = site.push("2.0", &["--sign", &ada]).await;
    assert_eq!(site.refused(&order).await.1.code, FailureCode::UNTRUSTED_PACKAGE);
    let order = site.push("1.0", &["--sign", &bob]).await;
    site.wait(&order, Phase::Running).await;
    // The next list is the new keeper's alone, and takes a package back.
    let manifest =
        site.server.deployment(&order).await.expect("known").package.manifest.digest.to_string();
    site.server.operate(["key", "draft", &draft, "--withdraw", &manifest]).await;
    site.server.operate(["key", "sign", &draft, "--key", &keeper]).await;
    site.server.operate(["key", "publish", &draft]).await;
    eventually("the robot to go by the next list", async || {
        let view = site.server.robot("robot-1").await?;
        (view.host.as_ref()?.publishers == Some(2) && view.tasks[0].degraded.is_some())
            .then_some(())
    })
    .await;
    let order = site.push("1.0", &["--sign", &bob, "--restart"]).await;
    let (_, failure) = site.refused(&order).await;
    assert!(failure.text.contains("version 2 of the list of publishers withdraws it"), "{failure}");
}
