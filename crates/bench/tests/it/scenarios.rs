//! The scenarios that start servers and fleets of their own: that they work, never how fast.
#![expect(clippy::disallowed_methods, reason = "a test starts processes")]

use std::path::Path;
use std::process::Output;

use serde_json::Value;

use crate::harness::program;
use crate::leftovers::processes_with;

pub async fn taskbench(dir: &Path, arguments: &[&str]) -> Output {
    let data = dir.join("data");
    let out = dir.join("out");
    std::fs::create_dir(&data).expect("a directory");
    let run = tokio::process::Command::new(program("taskbench"))
        .args(arguments)
        .args([Path::new("--data"), &data, Path::new("--out"), &out])
        .args(["--seed", "7"])
        .kill_on_drop(true)
        .output();
    let output = run.await.expect("taskbench runs");
    assert_eq!(
        std::fs::read_dir(&data).expect("readable").count(),
        0,
        "a server's directory is left"
    );
    let needle = data.to_str().expect("utf-8").as_bytes().to_owned();
    assert_eq!(processes_with(&needle), Vec::<i32>::new(), "a process is left");
    output
}

/// The points of the result, all of which must have arrived whole.
fn arrived(dir: &Path, scenario: &str, output: &Output) -> Vec<Value> {
    let said = String::from_utf8_lossy(&output.stderr);
    let file =
        |extension: &str| std::fs::read(dir.join("out").join(format!("{scenario}.{extension}")));
    let json = file("json").unwrap_or_else(|error| panic!("{error}: {said}"));
    let run: Value = serde_json::from_slice(&json).expect("json");
    let points = run["points"].as_array().expect("points").clone();
    for point in &points {
        assert!(point["failures"].is_null(), "{point:#}");
        assert_eq!(point["quantities"]["arrival"]["min"], 100.0, "{point:#}");
    }
    assert!(output.status.success(), "{said}");
    assert_eq!(run["seed"], 7);
    assert!(
        run["versions"]["taskd"].is_string() && run["machine"]["cores"].as_u64() > Some(0),
        "{run:#}"
    );
    let html = String::from_utf8(file("html").expect("a page")).expect("utf-8");
    assert!(html.contains("<svg") && html.contains("Nothing failed."));
    assert!(file("csv").expect("a table").len() > 100);
    points
}

/// The mechanisms by the names that results have.
const MECHANISMS: [&str; 8] = [
    "push-pull",
    "direct-push",
    "direct-push QoS 0",
    "direct-push QoS 2",
    "direct-push, one message",
    "poll",
    "inline",
    "adaptive",
];

#[tokio::test(flavor = "multi_thread")]
async fn every_mechanism_delivers_identical_bytes_to_every_robot() {
    let dir = tempfile::tempdir().expect("temp dir");
    let output = taskbench(dir.path(), &["paper", "--quick"]).await;
    let points = arrived(dir.path(), "paper", &output);
    for mechanism in MECHANISMS {
        let of = points.iter().filter(|point| point["series"] == mechanism);
        // Content inside an announcement is small.
        assert_eq!(of.clone().count(), if mechanism == "inline" { 2 } else { 4 }, "{mechanism}");
        for point in of {
            let payload = point["settings"]["payload_bytes"].as_f64().expect("set");
            let robots = point["settings"]["robots"].as_f64().expect("set");
            let load = point["quantities"]["load"]["min"].as_f64().expect("measured");
            assert!(load > payload * robots, "{point:#}");
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn fleet_connects_and_every_robot_gets_the_package() {
    for encrypted in [None, Some("--tls")] {
        let dir = tempfile::tempdir().expect("temp dir");
        let arguments =
            ["fleet", "--robots", "3,20", "--payload", "5000"].into_iter().chain(encrypted);
        let output = taskbench(dir.path(), &arguments.collect::<Vec<_>>()).await;
        let points = arrived(dir.path(), "fleet", &output);
        let counts: Vec<_> =
            points.iter().map(|point| point["quantities"]["connected"]["count"].as_u64()).collect();
        assert_eq!(counts, [Some(3), Some(20)]);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn link_uses_temporary_namespaces_or_is_refused_with_a_reason() {
    let dir = tempfile::tempdir().expect("temp dir");
    let arguments =
        ["paper", "--quick", "--only", "push-pull", "--max-payload", "1000", "--link", "50mbit"];
    let output = taskbench(dir.path(), &arguments).await;
    if nix::unistd::geteuid().is_root() {
        assert_eq!(arrived(dir.path(), "paper", &output).len(), 2);
    } else {
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(!output.status.success() && said.contains("--link needs root"), "{said}");
    }
    // A namespace is named for the run's process, which is no more.
    let left = std::fs::read_dir("/run/netns")
        .into_iter()
        .flatten()
        .flatten()
        .map(|entry| entry.file_name());
    let left =
        left.filter_map(|name| name.to_str()?.strip_prefix("taskbench-")?.parse::<u32>().ok());
    let left: Vec<u32> =
        left.filter(|pid| !Path::new("/proc").join(pid.to_string()).exists()).collect();
    assert_eq!(left, Vec::<u32>::new());
}
