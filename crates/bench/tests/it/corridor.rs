//! The paper's experiment, its figures 7 and 8: a mapping package goes to a robot as a job, is
//! built there, maps a corridor while the agent keeps its lifecycle node active, and the map is
//! uploaded, as good as the paper claims.

use std::path::Path;

use serde_json::Value;

use crate::ros::{Stage, copy};

/// Shares that the issue of such a map turns on: cells that the lidar could see and knows, walls
/// that are where they are.
const KNOWN: f64 = 0.95;
const WALLS_TRUE: f64 = 0.95;

#[tokio::test(flavor = "multi_thread")]
async fn corridor_map_is_built_on_a_robot_and_uploaded() {
    let stage = Stage::bare().await;
    let package = stage.dir.path().join("corridor_mapping");
    copy(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/corridor_mapping"), &package);
    // As in the example, but in less time: fewer particles, and a robot that drives twice as fast.
    let toml = std::fs::read_to_string(package.join("task.toml")).expect("task.toml");
    let quick = toml.replace("particles = 20", "particles = 8").replace("rate = 4.0", "rate = 8.0");
    assert_ne!(quick, toml);
    std::fs::write(package.join("task.toml"), quick).expect("task.toml");
    stage.server.push(&package, "*").await;
    stage.builds("corridor_mapping").await;
    stage.succeeds("corridor_mapping").await;

    let list = stage.server.operate(["output", "list", "robot-1", "-o", "json"]).await;
    let list: Value = serde_json::from_str(&list).expect("json");
    let files = list["outputs"][0]["files"].as_array().expect("files").iter();
    let paths: Vec<&str> = files.map(|file| file["path"].as_str().expect("a path")).collect();
    let expected = ["corridor.pgm", "corridor.yaml", "odometry.pgm", "odometry.yaml", "score.json"];
    assert_eq!(paths, expected.map(|name| format!("maps/{name}")));

    let into = stage.dir.path().join("fetched");
    let into_text = into.to_str().expect("utf-8");
    stage
        .server
        .operate(["output", "get", "robot-1", "corridor_mapping", "--into", into_text])
        .await;
    let yaml =
        std::fs::read_to_string(into.join("maps/corridor.yaml")).expect("the map's description");
    assert!(yaml.contains("image: corridor.pgm") && yaml.contains("resolution: 0.05"), "{yaml}");
    let map = std::fs::read(into.join("maps/corridor.pgm")).expect("the map");
    assert!(map.starts_with(b"P5"), "a PGM");
    for gray in [0, 205, 254] {
        assert!(map.contains(&gray), "walls, the unknown and free cells are all there");
    }

    let score = std::fs::read(into.join("maps/score.json")).expect("the score");
    let score: Value = serde_json::from_slice(&score).expect("json");
    let share = |map: &str, what: &str| {
        score[map][what].as_f64().unwrap_or_else(|| panic!("{map} {what}: {score}"))
    };
    for map in ["corridor", "odometry"] {
        let [known, walls_true, walls_found] =
            ["known", "walls_true", "walls_found"].map(|what| share(map, what));
        println!(
            "{map}: known {known:.3}, walls true {walls_true:.3}, walls found {walls_found:.3}"
        );
    }
    assert!(
        share("corridor", "known") >= KNOWN && share("corridor", "walls_true") >= WALLS_TRUE,
        "{score}"
    );
    assert!(
        share("corridor", "walls_true") > share("odometry", "walls_true") + 0.2,
        "clearly better: {score}"
    );
}
