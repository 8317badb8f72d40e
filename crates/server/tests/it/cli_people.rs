//! The commands about people, with the real binary: users, signing in, tokens and the audit.

use std::fs::File;
use std::os::unix::fs::PermissionsExt as _;

use serde_json::Value;

use crate::cli::{Bench, Ran, command, run};

const PASSWORD: &str = "correct horse battery";

/// A user at another machine, who knows the server's URL and has a directory of their own for
/// sign-ins.
struct Away<'a> {
    bench: &'a Bench,
}

impl Away<'_> {
    fn command(&self, arguments: &[&str]) -> std::process::Command {
        let mut command = command(arguments);
        command.env("TASKD_SERVER", format!("http://{}", self.bench.server().addresses().http));
        command.env("XDG_CONFIG_HOME", self.bench.dir.path().join("config"));
        command.env("XDG_DATA_HOME", self.bench.dir.path().join("nothing"));
        command
    }

    async fn taskd(&self, arguments: &[&str]) -> Ran {
        run(self.command(arguments)).await
    }

    /// The same with these lines on standard input.
    async fn told(&self, lines: &[&str], arguments: &[&str]) -> Ran {
        let mut command = self.command(arguments);
        command.stdin(input(self.bench, lines));
        run(command).await
    }
}

fn input(bench: &Bench, lines: &[&str]) -> File {
    let path = bench.dir.path().join(format!("input-{:08x}", rand::random::<u32>()));
    std::fs::write(&path, lines.iter().map(|line| format!("{line}\n")).collect::<String>())
        .unwrap();
    File::open(path).unwrap()
}

async fn add_user(bench: &Bench, name: &str, more: &[&str]) -> Ran {
    let mut command = command(&[&["user", "add", name, "--password-stdin"], more].concat());
    command.env("TASKD_DATA", bench.data()).stdin(input(bench, &[PASSWORD]));
    run(command).await
}

#[tokio::test(flavor = "multi_thread")]
async fn user_is_added_signs_in_and_out() {
    let bench = Bench::start().await;
    let away = Away { bench: &bench };
    add_user(&bench, "alice", &["--role", "operator,publisher", "--robots", "site=lab"])
        .await
        .expect(0, "");
    add_user(&bench, "alice", &["--role", "viewer"]).await.expect(1, "user_exists");
    add_user(&bench, "Bob!", &["--role", "viewer"]).await.expect(2, "is not a valid user name");
    add_user(&bench, "bob", &["--role", "root"]).await.expect(2, "is not a role");
    bench.taskd(&["user", "add", "ci", "--role", "publisher", "--no-password"]).await.expect(0, "");
    let list = bench.taskd(&["user", "list"]).await.expect(0, "").stdout;
    assert!(list.contains("alice  operator,publisher  site=lab  yes"), "{list}");
    assert!(list.contains("ci     publisher           *         no"), "{list}");
    bench
        .taskd(&["user", "add", "bob", "--role", "viewer"])
        .await
        .expect(2, "use --password-stdin");

    away.taskd(&["whoami"]).await.expect(2, "sign in with taskd login");
    away.told(&["wrong"], &["login", "alice", "--password-stdin"])
        .await
        .expect(4, "or the password is wrong");
    away.told(&[PASSWORD], &["login", "alice", "--password-stdin"])
        .await
        .expect(0, "as alice until");
    let kept = bench.dir.path().join("config/taskd/credentials.json");
    assert_eq!(std::fs::metadata(&kept).unwrap().permissions().mode() & 0o777, 0o600);
    let me = away.taskd(&["whoami", "-o", "json"]).await.expect(0, "").json();
    assert_eq!((&me["name"], &me["scope"][0]), (&Value::from("alice"), &Value::from("site=lab")));
    assert_eq!(me["permissions"], serde_json::json!(["read", "operate", "publish"]));
    let mut anywhere = away.command(&["whoami"]);
    anywhere.env_remove("TASKD_SERVER");
    run(anywhere).await.expect(0, "");
    away.taskd(&["user", "list"]).await.expect(4, "alice has no permission to administer");

    let token = away
        .taskd(&["token", "create", "--title", "ci", "--role", "publisher"])
        .await
        .expect(0, "of alice");
    let token = token.stdout.trim().to_owned();
    assert!(token.starts_with("tsko_"));
    let by_token =
        away.taskd(&["--token", &token, "whoami", "-o", "json"]).await.expect(0, "").json();
    assert_eq!(by_token["permissions"], serde_json::json!(["read", "publish"]));
    let listed = away.taskd(&["token", "list", "-o", "json"]).await.expect(0, "").json();
    let origins: Vec<_> =
        listed["tokens"].as_array().unwrap().iter().map(|token| token["origin"].clone()).collect();
    assert_eq!(origins, ["token", "login"]);
    away.taskd(&["token", "revoke", by_token["token"].as_str().unwrap()])
        .await
        .expect(0, "revoked");
    away.taskd(&["--token", &token, "whoami"]).await.expect(4, "expired or revoked");

    let passwd = ["user", "passwd", "--password-stdin"];
    away.told(&["wrong", "another long one"], &passwd)
        .await
        .expect(2, "old: the old password is wrong");
    away.told(&[PASSWORD, "another long one"], &passwd)
        .await
        .expect(0, "signed out everywhere else");
    away.taskd(&["whoami"]).await.expect(0, "");
    let kept_token = |kept: &std::path::Path| {
        let kept: Value = serde_json::from_slice(&std::fs::read(kept).unwrap()).unwrap();
        kept["servers"].as_object().unwrap().values().next().unwrap().as_str().unwrap().to_owned()
    };
    let token = kept_token(&kept);
    // The server that was signed in to last is meant where none is named.
    let mut anywhere = away.command(&["logout"]);
    anywhere.env_remove("TASKD_SERVER");
    run(anywhere).await.expect(0, "signed out of http://");
    away.taskd(&["--token", &token, "whoami"]).await.expect(4, "expired or revoked");
    away.taskd(&["whoami"]).await.expect(2, "no token");
    away.taskd(&["logout"]).await.expect(2, "you are not signed in");

    bench
        .taskd(&["user", "edit", "alice", "--role", "viewer", "--robots", "*"])
        .await
        .expect(0, "");
    bench.taskd(&["user", "remove", "alice"]).await.expect(2, "confirm with --yes");
    bench.taskd(&["user", "remove", "alice", "--yes"]).await.expect(0, "removed user alice");
    away.told(&["another long one"], &["login", "alice", "--password-stdin"])
        .await
        .expect(4, "is wrong");
    bench.server.unwrap().stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn failed_sign_out_keeps_the_local_token() {
    let mut bench = Bench::start().await;
    add_user(&bench, "alice", &["--role", "viewer"]).await.expect(0, "");
    let sign_in = ["login", "alice", "--password-stdin"];
    Away { bench: &bench }.told(&[PASSWORD], &sign_in).await.expect(0, "");
    let log_out = Away { bench: &bench }.command(&["logout"]);
    let stopped = bench.stop().await;
    run(log_out).await.expect(1, "can't reach the server");
    bench.go_on(stopped).await;
    Away { bench: &bench }.taskd(&["logout"]).await.expect(0, "signed out of http://");
    bench.server.unwrap().stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn data_flag_wins_over_the_environment() {
    let (meant, other) = (Bench::start().await, Bench::start().await);
    let token = std::fs::read_to_string(other.data().join("operator.token")).unwrap();
    let data = meant.data();
    let ask = |arguments: &[&str]| {
        let mut command = command(&[arguments, &["server", "info", "-o", "json"]].concat());
        command.env("TASKD_SERVER", format!("http://{}", other.server().addresses().http));
        command.env("TASKD_TOKEN", token.trim());
        run(command)
    };
    let mqtt = |bench: &Bench| Value::from(bench.server().addresses().mqtt.as_str());
    let typed = ask(&["--data", data.to_str().unwrap()]).await.expect(0, "").json();
    let server = ask(&[]).await.expect(0, "").json();
    assert_eq!((&typed["mqtt"], &server["mqtt"]), (&mqtt(&meant), &mqtt(&other)));
    meant.server.unwrap().stop().await;
    other.server.unwrap().stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn audit_is_shown_exported_and_verified() {
    let bench = Bench::start().await;
    add_user(&bench, "alice", &["--role", "viewer"]).await.expect(0, "");
    let package = bench.package("1", "");
    bench.taskd(&["push", &package]).await.expect(0, "");
    bench.taskd(&["enroll-token", "create"]).await.expect(0, "");
    let shown = bench.taskd(&["audit"]).await.expect(0, "").stdout;
    let acts: Vec<_> =
        shown.lines().skip(1).map(|line| line.split_whitespace().nth(5).unwrap()).collect();
    assert_eq!(acts, ["user.add", "manifest.push", "enrolment_token.create"], "{shown}");
    assert!(
        shown.contains("operator.token")
            && shown.contains("127.0.0.1")
            && !shown.contains(PASSWORD),
        "{shown}"
    );
    let pushed =
        bench.taskd(&["audit", "--act", "manifest.", "-o", "json"]).await.expect(0, "").json();
    assert_eq!(pushed["records"].as_array().unwrap().len(), 1);
    assert_eq!(pushed["records"][0]["entry"]["target"], "hello");

    let seen = bench.taskd(&["audit", "--verify"]).await.expect(0, "3 entries verified").stdout;
    assert!(seen.starts_with("3:sha256:"), "{seen}");
    let export = bench.taskd(&["audit", "--export"]).await.expect(0, "").stdout;
    assert_eq!(export.lines().count(), 3);
    let path = bench.dir.path().join("audit.jsonl");
    let file = path.to_str().unwrap();
    let verify = async |text: String| {
        std::fs::write(&path, text).unwrap();
        bench.taskd(&["audit", "--verify", "--file", file, "--expect", seen.trim()]).await
    };
    assert_eq!(verify(export.clone()).await.expect(0, "3 entries verified").stdout, seen);
    verify(export.replace("\"hello\"", "\"other\""))
        .await
        .expect(1, "audit verification failed: entry 2");
    let shorter: String = export.lines().take(2).map(|line| format!("{line}\n")).collect();
    verify(shorter).await.expect(1, "entry 3 is expected, but the log ends at entry 2");
    verify("nonsense\n".to_owned()).await.expect(2, "line 1: not an audit record");
    let other = format!("2:{}", seen.trim().split_once(':').unwrap().1);
    bench
        .taskd(&["audit", "--verify", "--expect", &other])
        .await
        .expect(1, "entry 2 differs from the expected link");
    bench
        .taskd(&["audit", "--verify", "--expect", "x"])
        .await
        .expect(2, "a link printed by --verify");

    // A robot is found by its name, under any name in the entries.
    bench.enroll(1).await;
    bench.taskd(&["robot", "revoke", "robot-1", "--yes"]).await.expect(0, "");
    let of_robot = bench.taskd(&["audit", "--target", "robot-1"]).await.expect(0, "").stdout;
    assert!(of_robot.contains("robot.enroll") && of_robot.contains("robot.revoke"), "{of_robot}");
    bench.server.unwrap().stop().await;
}
