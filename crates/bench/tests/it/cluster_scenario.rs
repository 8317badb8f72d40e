//! `taskbench cluster` in small: engines, robots and load start, a server is killed meanwhile, and
//! every check has something to check.

use serde_json::Value;

use crate::scenarios::taskbench;

#[tokio::test(flavor = "multi_thread")]
async fn cluster_loses_nothing_when_a_server_is_killed() {
    let dir = tempfile::tempdir().expect("temp dir");
    let arguments = ["cluster", "--nodes", "2", "--robots", "24", "--order-robots", "8"];
    let more = ["--faults", "F0,F1", "--seconds", "6", "--payload", "5000"];
    let output = taskbench(dir.path(), &[&arguments[..], &more[..]].concat()).await;
    let said = String::from_utf8_lossy(&output.stderr);
    let json = std::fs::read(dir.path().join("out/cluster.json"));
    let run: Value =
        serde_json::from_slice(&json.unwrap_or_else(|error| panic!("{error}: {said}")))
            .expect("json");
    assert!(output.status.success(), "{said}");
    let points = run["points"].as_array().expect("points");
    let series: Vec<_> = points.iter().map(|point| point["series"].as_str()).collect();
    assert_eq!(series, [Some("F0 none"), Some("F1 server killed")]);
    let at_least = |point: &Value, name: &str, least: f64| {
        let found = point["quantities"][name]["max"].as_f64();
        assert!(found >= Some(least), "{name}: {point:#}");
    };
    for point in points {
        assert!(point["failures"].is_null(), "{point:#}");
        let compared = ["acknowledged_reports", "runs_started"].map(|name| (name, 24.0));
        for (name, least) in compared.into_iter().chain([
            ("orders_repeated", 1.0),
            ("rollout_samples", 1.0),
            ("objects_needed", 3.0),
            ("feed_entries_heard", 1.0),
            ("push_before", 0.1),
            ("wal", 1.0),
        ]) {
            at_least(point, name, least);
        }
    }
    // Half of the robots were at the killed server.
    at_least(&points[1], "sessions_lost", 6.0);
    at_least(&points[1], "back_after_fault", 0.1);
}
