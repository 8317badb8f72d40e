//! The load tool against a real server.
#![expect(clippy::disallowed_methods, reason = "a test starts processes")]

use serde_json::Value;

use crate::harness::{Server, program};

#[tokio::test(flavor = "multi_thread")]
async fn load_run_measures_every_phase_and_leaves_no_robots() {
    let dir = tempfile::tempdir().expect("temp dir");
    let server = Server::start(&dir.path().join("server")).await;
    let token = server.data().join("operator.token");
    let run = tokio::process::Command::new(program("taskbench"))
        .args(["load", "--server", &server.url(""), "--token-file", token.to_str().expect("utf-8")])
        .args(["--robots", "20", "--seconds", "1", "--reports-per-s", "40", "-o", "json"])
        .kill_on_drop(true)
        .output();
    let output = run.await.expect("taskbench runs");
    let out = String::from_utf8_lossy(&output.stdout);
    let err = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{}\n{out}\n{err}", output.status);

    let result: Value = serde_json::from_str(&out).unwrap_or_else(|error| panic!("{error}: {out}"));
    assert_eq!(result["facts"]["robots"], 20);
    let phases: Vec<_> = result["phases"]
        .as_array()
        .expect("phases")
        .iter()
        .map(|phase| {
            assert!(phase["p50_ms"].as_f64() <= phase["max_ms"].as_f64(), "{phase}");
            (
                phase["phase"].as_str().expect("name"),
                phase["count"].as_u64(),
                phase["failed"].as_u64(),
            )
        })
        .collect();
    let names = [
        "enrol",
        "connect",
        "first report",
        "order",
        "order to running",
        "steady reports",
        "reconnect storm",
    ];
    let expected: Vec<_> = names
        .into_iter()
        .chain(["remove"])
        .map(|name| (name, Some(if name == "steady reports" { 40 } else { 20 }), Some(0)))
        .collect();
    assert_eq!(phases, expected);
    for list in ["robots", "packages"] {
        let left = server.get(&format!("/api/v1/{list}")).await.expect("a list");
        assert_eq!(left[list].as_array().map(Vec::len), Some(0), "{left}");
    }
}
