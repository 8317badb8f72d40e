//! The commands' output, compared with the files in `tests/commands`, which read like a session at
//! a terminal; and the files that the commands write: man pages, exported packages.
//! `TRYCMD=overwrite` writes the expected files anew.

use std::os::unix::fs::{PermissionsExt as _, symlink};
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::Duration;

use serde_json::Value;
use task_proto::ids::digest::hex;
use task_proto::trust::envelope::SigningKey;

use crate::answering::{Answering, publish_log_and_go};
use crate::cli::{Bench, Ran, closed_pipe, command, run};

/// A fleet of two, a package in two versions, and a deployment that one robot has followed and the
/// other could not.
pub struct Lab {
    pub bench: Bench,
    ids: Vec<(&'static str, String)>,
}

impl Lab {
    pub async fn new() -> Self {
        let bench = Bench::start().await;
        let robots = [bench.enroll(1).await, bench.enroll(2).await];
        bench.taskd(&["push", &bench.package("1", "")]).await.expect(0, "");
        let order = ["push", &bench.package("2", ""), "--to", "*", "-o", "json"];
        let deployment = bench.taskd(&order).await.expect(0, "").json();
        bench.report(&robots[0], &deployment, "running").await;
        bench.report(&robots[1], &deployment, "failed").await;
        bench
            .bring_back(
                &robots[0],
                &[("maps/lab.pgm", b"P5 1 1 255 x"), ("maps/lab.yaml", b"resolution: 0.05\n")],
            )
            .await;
        let packages = bench.taskd(&["package", "list", "-o", "json"]).await.expect(0, "").json();
        let mut ids = vec![
            ("[FIRST]", robots[0].identity.robot_id.to_string()),
            ("[SECOND]", robots[1].identity.robot_id.to_string()),
            ("[DEPLOYMENT]", deployment["id"].as_str().unwrap().to_owned()),
        ];
        for (short, long, view) in [("[NEW]", "[NEWER]", 0), ("[OLD]", "[OLDER]", 1)] {
            let digest = packages["packages"][view]["package"]["manifest"]["digest"]
                .as_str()
                .unwrap()
                .to_owned();
            ids.push((short, digest["sha256:".len()..][..12].to_owned()));
            ids.push((long, digest));
        }
        Self { bench, ids }
    }

    /// Setting by which a command started elsewhere finds the server.
    pub fn here(&self) -> [(&'static str, String); 1] {
        [("TASKD_DATA", self.bench.data().display().to_string())]
    }

    /// The deployment's id.
    pub fn deployment(&self) -> &str {
        &self.ids[2].1
    }

    /// A fleet of three: one that can be asked, one that said something and went, one that never
    /// came. Beside the commands lie Ada's key, and Ben's, which others may read.
    async fn to_be_asked() -> (Self, Answering) {
        let bench = Bench::start().await;
        let robots = [bench.enroll(1).await, bench.enroll(2).await, bench.enroll(3).await];
        let answering = Answering::start(&bench, &robots[0]).await;
        publish_log_and_go(&bench, &robots[1]).await;
        let directory = bench.dir.path().join("keys.in");
        std::fs::create_dir(&directory).unwrap();
        let mut ids = Vec::new();
        for (name, short, long, seed, mode) in
            [("ada", "[ADA]", "[ADAKEY]", 1, 0o600), ("ben", "[BEN]", "[BENKEY]", 2, 0o644)]
        {
            let key = SigningKey::from_bytes([seed; 32]);
            let private = directory.join(format!("{name}.key"));
            std::fs::write(&private, format!("taskd-private-key ed25519 {}\n", hex(&[seed; 32])))
                .unwrap();
            std::fs::set_permissions(&private, std::fs::Permissions::from_mode(mode)).unwrap();
            std::fs::write(
                directory.join(format!("{name}.key.pub")),
                format!("{}\n", key.public_key()),
            )
            .unwrap();
            ids.extend([(short, key.public_key().id()), (long, key.public_key().to_string())]);
        }
        (Self { bench, ids }, answering)
    }

    /// Compares the commands of one file with their expected output. The commands write their files
    /// beside that file, not into the sources.
    async fn holds(&self, file: &str) {
        let sources = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/commands");
        let path = self.bench.dir.path().join(file);
        symlink(sources.join(file), &path).unwrap();
        std::fs::create_dir_all(path.with_extension("in")).unwrap();
        let (data, ids) = (self.bench.data(), self.ids.clone());
        let held = tokio::task::spawn_blocking(move || {
            let cases = trycmd::TestCases::new();
            cases.register_bin("taskd", Path::new(env!("CARGO_BIN_EXE_taskd")));
            cases
                .env("TASKD_DATA", data.display().to_string())
                .env("XDG_CONFIG_HOME", "/nonexistent");
            // The long ones first: a short one is a part of one of them.
            for (name, id) in ids.into_iter().rev() {
                cases.insert_var(name, id).unwrap();
            }
            cases.timeout(Duration::from_secs(60)).case(path).run();
        });
        held.await.unwrap();
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn command_output_matches_its_files() {
    let lab = Lab::new().await;
    for file in [
        "robots.trycmd",
        "packages.trycmd",
        "deployments.trycmd",
        "outputs.trycmd",
        "people.trycmd",
        "help.trycmd",
    ] {
        lab.holds(file).await;
    }
    lab.bench.server.unwrap().stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn robot_answers_match_their_files() {
    let (lab, _answering) = Lab::to_be_asked().await;
    for file in ["graph.trycmd", "logs.trycmd", "keys.trycmd"] {
        lab.holds(file).await;
    }
    lab.bench.server.unwrap().stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn closed_pipe_is_not_a_failure() {
    let bench = Bench::start().await;
    for arguments in [
        &["robot", "list", "-o", "json"][..],
        &["package", "list", "-o", "wide"],
        &["deploy", "list", "-o", "name"],
        &["completions", "bash"],
        &["version"],
        &["server", "info"],
    ] {
        let mut unread = command(arguments);
        unread.env("TASKD_DATA", bench.data()).stdout(closed_pipe()).stderr(Stdio::piped());
        let ran = run(unread).await;
        assert_eq!((ran.code, ran.stderr.as_str()), (0, ""), "{arguments:?}");
    }
    bench.server.unwrap().stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn every_command_has_a_man_page() {
    let dir = tempfile::tempdir().unwrap();
    let pages = dir.path().join("man1");
    run(command(&["man", pages.to_str().unwrap()])).await.expect(0, "read the pages with: man ");
    let read = |page: &str| std::fs::read_to_string(pages.join(page)).unwrap();
    assert!(read("taskd.1").contains("Exit codes: 0 success"), "{}", read("taskd.1"));
    for page in [
        "taskd-push.1",
        "taskd-robot-label.1",
        "taskd-deploy-retry.1",
        "taskd-package-export.1",
        "taskd-doctor.1",
    ] {
        assert!(read(page).contains(".SH SYNOPSIS"), "{page}");
    }
    assert!(read("taskd-push.1").contains("\\-\\-max\\-failures"));
    // Where a man page reader is installed, the reader accepts the pages without a complaint.
    if let Some(rendered) = rendered(&pages.join("taskd-push.1")).await {
        assert!(
            rendered.stdout.contains("--max-failures") && rendered.stderr.is_empty(),
            "{}",
            rendered.stderr
        );
    }
}

#[expect(clippy::disallowed_methods, reason = "the test needs the program that reads man pages")]
async fn rendered(page: &Path) -> Option<Ran> {
    let mut man = std::process::Command::new("man");
    man.arg("-l")
        .arg(page)
        .env("MANPAGER", "cat")
        .env("LC_ALL", "C.UTF-8")
        .env("MANWIDTH", "100")
        .stdin(Stdio::null());
    let ran = tokio::task::spawn_blocking(move || man.output()).await.unwrap().ok()?;
    // A system that was made small has a `man` that only says so.
    (ran.status.success() && String::from_utf8_lossy(&ran.stdout).contains("SYNOPSIS"))
        .then(|| ran.into())
}

/// A directory's content: paths, and the bytes of files.
fn tree(dir: &Path) -> Vec<(String, Option<Vec<u8>>)> {
    let mut found = Vec::new();
    let mut left = vec![PathBuf::new()];
    while let Some(below) = left.pop() {
        for entry in std::fs::read_dir(dir.join(&below)).unwrap() {
            let entry = entry.unwrap();
            let path = below.join(entry.file_name());
            let is_dir = entry.file_type().unwrap().is_dir();
            found.push((
                path.display().to_string(),
                (!is_dir).then(|| std::fs::read(entry.path()).unwrap()),
            ));
            if is_dir {
                left.push(path);
            }
        }
    }
    found.sort();
    found
}

#[tokio::test(flavor = "multi_thread")]
async fn exported_package_equals_the_pushed_one() {
    let bench = Bench::start().await;
    let plain = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/plain");
    bench.taskd(&["push", plain.to_str().unwrap()]).await.expect(0, "");
    let list = bench.taskd(&["package", "list", "-o", "name"]).await.expect(0, "").stdout;
    let name = list.trim();
    let to = |file: &str| bench.dir.path().join(file).to_str().unwrap().to_owned();
    bench.taskd(&["package", "export", name, &to("out")]).await.expect(0, "exported ");
    assert_eq!(tree(Path::new(&to("out"))), tree(&plain));
    bench
        .taskd(&["package", "export", name, &to("out")])
        .await
        .expect(2, "already exists and is not empty");
    // The exported package can be pushed again, and is the same.
    bench.taskd(&["push", &to("out")]).await.expect(0, "nothing to upload");
    bench.taskd(&["package", "export", name, &to("a.tar")]).await.expect(0, "exported ");
    bench.taskd(&["package", "export", name, &to("a.tar.zst")]).await.expect(0, "exported ");
    let plain = zstd::decode_all(std::fs::File::open(to("a.tar.zst")).unwrap()).unwrap();
    assert_eq!(std::fs::read(to("a.tar")).unwrap(), plain);
    bench
        .taskd(&["package", "export", "nothing", &to("b")])
        .await
        .expect(2, "package nothing not found");
    bench
        .taskd(&["package", "export", &format!("{name}:9.9.9"), &to("b")])
        .await
        .expect(2, "not found on the server");
    bench.taskd(&["package", "export", "a/b", &to("b")]).await.expect(2, "a/b");
    bench.server.unwrap().stop().await;
}

/// A ROS package that does not state how to run it.
fn ros_package(bench: &Bench) -> PathBuf {
    let dir = bench.dir.path().join("say");
    std::fs::create_dir_all(dir.join("launch")).unwrap();
    let xml = "<package format=\"3\"><name>say</name><version>1.0.0</version>\
        <description>d</description>\
        <maintainer email=\"a@example.org\">A</maintainer><license>Apache-2.0</license>\
        <export><build_type>ament_python</build_type></export></package>";
    for (file, text) in [
        ("package.xml", xml),
        ("setup.py", ""),
        ("launch/say.launch.py", ""),
        ("launch/two.launch.py", ""),
    ] {
        std::fs::write(dir.join(file), text).unwrap();
    }
    dir
}

async fn runs(bench: &Bench) -> Vec<(String, Value, Value)> {
    let packages = bench.taskd(&["package", "list", "-o", "json"]).await.expect(0, "").json();
    let views = packages["packages"].as_array().unwrap().clone();
    let run = |view: &Value| {
        let run = &view["manifest"]["run"];
        (
            view["package"]["manifest"]["digest"].as_str().unwrap().to_owned(),
            run["launch"].clone(),
            run["args"].clone(),
        )
    };
    views.iter().map(run).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn launch_file_runs_with_its_arguments_on_a_robot() {
    let bench = Bench::start().await;
    bench.enroll(1).await;
    let dir = ros_package(&bench);
    let dir = dir.to_str().unwrap();
    bench.taskd(&["push", dir]).await.expect(2, "does not specify how to run the package");
    let order = ["run", "robot-1", dir, "say.launch.py", "rate:=5", "--detach", "-o", "json"];
    let deployment = bench.taskd(&order).await.expect(0, "say 1.0.0 to robot-1").json();
    let pushed = runs(&bench).await;
    assert_eq!(pushed.len(), 1);
    assert_eq!(pushed[0].1, serde_json::json!(["say", "say.launch.py"]));
    assert_eq!(pushed[0].2, serde_json::json!({ "rate": "5" }));
    assert_eq!(
        deployment["package"]["manifest"]["digest"], pushed[0].0,
        "the digest pins the arguments"
    );

    // The same with the packages stored by now: nothing new for the same arguments, another digest
    // for other arguments.
    let stored = ["run", "robot-1", "say:1.0.0", "say.launch.py", "rate:=5", "--detach"];
    bench.taskd(&stored).await.expect(0, "nothing to upload");
    assert_eq!(runs(&bench).await.len(), 1);
    bench.taskd(&["run", "robot-1", "say", "two.launch.py", "--detach"]).await.expect(0, "");
    let pushed = runs(&bench).await;
    assert_eq!((pushed.len(), &pushed[0].1), (2, &serde_json::json!(["say", "two.launch.py"])));
    assert_eq!(pushed[0].2, Value::Null, "arguments are those of their launch file");

    for (order, said) in [
        (&["run", "robot-1", dir, "none.launch.py", "--detach"][..], "none.launch.py"),
        (&["run", "robot-1", "say", "say.launch.py", "rate=5"], "expected ARG:=VALUE"),
        (&["run", "robot-1", "say", "say.launch.py", "rate:=", "--detach"], "run.args"),
        (&["run", "robot-9", "say", "say.launch.py"], "no robot has the name or id robot-9"),
        (&["run", "robot-1", "shout", "say.launch.py"], "package shout not found"),
    ] {
        bench.taskd(order).await.expect(2, said);
    }
    bench.server.unwrap().stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn deployment_is_watched_until_it_has_settled() {
    let lab = Lab::new().await;
    let deployment = lab.deployment();
    let watched =
        lab.bench.taskd(&["deploy", "watch", deployment]).await.expect(3, "1 of 2 succeeded");
    assert!(
        watched.stderr.contains("robot-2: failed (process_exited: exit code 3)"),
        "{}",
        watched.stderr
    );
    assert!(
        watched.stderr.contains(&format!("taskd deploy retry {deployment}")),
        "{}",
        watched.stderr
    );
    lab.bench.server.unwrap().stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn many_robots_are_labelled_and_removed_at_once() {
    let bench = Bench::start().await;
    for number in 1..=3 {
        bench.enroll(number).await;
    }
    let labelled =
        bench.taskd(&["robot", "label", "!robot-3", "site=lab", "arm=ur5", "-o", "name"]).await;
    assert_eq!(labelled.expect(0, "labelled 2 robots").stdout, "robot-1\nrobot-2\n");
    bench.taskd(&["robot", "label", "robot-1", "arm-"]).await.expect(0, "labelled 1 robot");
    let of = async |selector: &str| {
        bench.taskd(&["robot", "list", selector, "-o", "name"]).await.expect(0, "").stdout
    };
    assert_eq!(of("site=lab,!arm=ur5").await, "robot-1\n");
    bench.taskd(&["robot", "rm", "site=lab", "--yes"]).await.expect(0, "removed robot-2");
    assert_eq!(of("*").await, "robot-3\n");
    for number in 11..=21 {
        bench.enroll(number).await;
    }
    bench.taskd(&["robot", "label", "*", "site=lab"]).await.expect(2, "confirm with --yes");
    bench
        .taskd(&["robot", "label", "*", "site=lab", "--yes"])
        .await
        .expect(0, "labelled 12 robots");
    bench.server.unwrap().stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn retry_and_rollback_select_the_right_robots() {
    let bench = Bench::start().await;
    let (one, two) = (bench.enroll(1).await, bench.enroll(2).await);
    let push = async |version: &str| {
        let package = bench.package(version, "");
        bench.taskd(&["push", &package, "--to", "*", "-o", "json"]).await.expect(0, "").json()
    };
    let first = push("1").await;
    bench.report(&one, &first, "running").await;
    bench.report(&two, &first, "failed").await;
    let id = first["id"].as_str().unwrap();
    let meant =
        bench.taskd(&["deploy", "retry", id, "--dry-run", "-o", "name"]).await.expect(0, "");
    assert_eq!(meant.stdout, "robot-2\n");
    bench
        .taskd(&["deploy", "retry", id, "--code", "build_failed"])
        .await
        .expect(2, "has no failed robots to retry");
    let again =
        bench.taskd(&["deploy", "retry", id, "--code", "process_exited", "-o", "json"]).await;
    let again = again.expect(0, "hello 1 to 1 robot").json();
    bench.report(&two, &again, "failed").await;

    bench
        .taskd(&["rollback", "hello", "--on", "*"])
        .await
        .expect(2, "no robot that matches * has an earlier version");
    let second = push("2").await;
    bench.report(&one, &second, "running").await;
    let back = bench.taskd(&["rollback", "hello", "--on", "*", "-o", "json"]).await;
    let back = back.expect(0, "skipped, no earlier version: robot-2").json();
    assert_eq!(back["deployments"][0]["package"]["version"], "1");
    assert_eq!(back["robots"][0]["name"], "robot-1");
    let restarted = bench
        .taskd(&["restart", "hello", "--on", "robot-1", "-o", "name"])
        .await
        .expect(0, "requested: restart");
    assert_eq!(restarted.stdout, "robot-1\n");
    bench.server.unwrap().stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn package_is_listed_compared_and_deleted() {
    let bench = Bench::start().await;
    bench.enroll(1).await;
    let one = bench.package("1", "");
    std::fs::write(Path::new(&one).join("old.txt"), "old").unwrap();
    bench.taskd(&["push", &one]).await.expect(0, "");
    let two = bench.package("2", "");
    std::fs::write(Path::new(&two).join("new.txt"), "new").unwrap();
    bench.taskd(&["push", &two, "--to", "*"]).await.expect(0, "");
    let files = bench.taskd(&["package", "files", "hello:1"]).await.expect(0, "").stdout;
    assert!(files.contains("-rw-r--r--  3 B") && files.contains("old.txt"), "{files}");
    assert_eq!(
        bench.taskd(&["package", "files", "hello", "-o", "name"]).await.expect(0, "").stdout,
        "new.txt\ntask.toml\n"
    );
    for to in ["2", "hello:2"] {
        let diff = bench
            .taskd(&["package", "diff", "hello:1", to])
            .await
            .expect(0, "1 added, 1 removed, 1 changed");
        let changes: Vec<_> = diff
            .stdout
            .lines()
            .skip(1)
            .map(|line| line.split_whitespace().take(2).collect::<Vec<_>>())
            .collect();
        assert_eq!(
            changes,
            [["added", "new.txt"], ["removed", "old.txt"], ["changed", "task.toml"]],
            "{}",
            diff.stdout
        );
    }
    let info = bench.taskd(&["package", "info", "hello"]).await.expect(0, "").stdout;
    assert_eq!(
        info.lines().map(|line| line.split_whitespace().last().unwrap()).collect::<Vec<_>>(),
        ["ROBOTS", "1", "0"]
    );
    let info = bench.taskd(&["package", "info", "hello:2"]).await.expect(0, "").stdout;
    assert!(
        info.contains("deployed to 1 robot\n") && info.contains("run         true\n"),
        "{info}"
    );
    bench.taskd(&["package", "rm", "hello:2", "--yes"]).await.expect(1, "robot-1");
    bench.taskd(&["package", "rm", "hello:1", "--yes"]).await.expect(0, "deleted hello:1");
    bench.taskd(&["package", "files", "hello:1"]).await.expect(2, "package hello:1 not found");
    bench.server.unwrap().stop().await;
}
