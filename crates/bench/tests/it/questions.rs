//! An operator's view of a robot's ROS graph and actions on its nodes, through the whole system:
//! real nodes, the real commands, and the resulting health of the task.

use std::collections::BTreeSet;

use serde_json::Value;

use crate::harness::eventually;
use crate::ros::Stage;

const ROBOT: &str = "robot-1";

impl Stage {
    /// A command's JSON.
    async fn asked(&self, words: &[&str]) -> Value {
        let out = self.server.operate(words.iter().chain(&["-o", "json"])).await;
        serde_json::from_str(&out).unwrap_or_else(|error| panic!("{error}: {out}"))
    }

    /// The error output of a failing command.
    async fn refused(&self, words: &[&str]) -> String {
        let output = self.server.try_operate(words).await;
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(1), "{words:?}: {said}");
        said
    }
}

fn named<'a>(list: &'a Value, name: &str) -> &'a Value {
    let list = list.as_array().expect("a list");
    list.iter().find(|item| item["name"] == name).unwrap_or_else(|| panic!("no {name} in {list:?}"))
}

#[tokio::test(flavor = "multi_thread")]
async fn operator_inspects_and_changes_nodes() {
    let stage = Stage::start().await;
    let rest = "restart = 'never'\n[ready]\nhold_s = 0\ntimeout_s = 60\nlifecycle = ['/asked']\n";
    stage.push("asked", "--node asked --lifecycle --service /say --topic /ticks", rest).await;
    stage.runs("asked").await;

    let nodes = stage.asked(&["node", "list", ROBOT]).await;
    let node = named(&nodes["nodes"], "/asked");
    assert_eq!((&node["task"], &node["lifecycle"]), (&"asked".into(), &"active".into()), "{nodes}");
    assert!(nodes["age_ms"].as_u64().is_some_and(|age| age < 60_000), "{nodes}");
    let info = stage.asked(&["node", "info", ROBOT, "/asked"]).await;
    assert_eq!(named(&info["nodes"][0]["services"], "/say")["type"], "std_srvs/srv/Trigger");
    assert_eq!(named(&info["nodes"][0]["publishers"], "/ticks")["type"], "std_msgs/msg/String");
    let topics = stage.asked(&["topic", "list", ROBOT]).await;
    assert_eq!(
        named(&topics["topics"], "/ticks")["publishers"],
        serde_json::json!(["/asked"]),
        "{topics}"
    );

    let set = stage.asked(&["param", "set", ROBOT, "/asked", "resolution", "2"]).await;
    assert_eq!(set["parameter"]["value"], 2.0, "a whole number becomes the node's double: {set}");
    assert_eq!(stage.say("/say").await, "2.0", "as an independent client hears");
    // The node's log line about this is kept with its task, once, though the line is on its
    // standard error as well.
    let said = eventually("the node's words", async || {
        let logs = stage.asked(&["logs", ROBOT, "asked", "--level", "warn"]).await;
        let lines = logs["lines"].as_array().expect("lines").clone();
        let said: Vec<Value> =
            lines.into_iter().filter(|line| line["text"] == "I was asked").collect();
        (!said.is_empty()).then_some(said)
    })
    .await;
    let moments: BTreeSet<_> = said.iter().map(|line| line["at_ms"].as_u64()).collect();
    assert_eq!(said.len(), moments.len(), "{said:?}");
    assert_eq!(
        (&said[0]["node"], &said[0]["level"]),
        (&"/asked".into(), &"warn".into()),
        "{said:?}"
    );
    let all = stage.asked(&["param", "list", ROBOT, "/asked"]).await;
    assert_eq!(named(&all["parameters"], "resolution")["value"], 2.0);
    let rejected = stage.refused(&["param", "set", ROBOT, "/asked", "resolution", "-1"]).await;
    assert!(
        rejected.contains("/asked does not accept resolution = -1: must be positive"),
        "{rejected}"
    );
    let kept = stage.asked(&["param", "get", ROBOT, "/asked", "resolution"]).await;
    assert_eq!(named(&kept["parameters"], "resolution")["value"], 2.0);
    let unknown = stage.refused(&["param", "get", ROBOT, "/asked", "colour"]).await;
    assert!(unknown.contains("/asked has no parameter colour"), "{unknown}");
    let nobody = stage.refused(&["node", "info", ROBOT, "/nobody"]).await;
    assert!(
        nobody.contains("there is no node /nobody; on the graph: ") && nobody.contains("/asked"),
        "{nobody}"
    );

    let state = stage.asked(&["lifecycle", ROBOT, "/asked", "deactivate"]).await;
    assert_eq!(state["state"], "inactive", "{state}");
    assert_eq!(stage.degrades("asked").await.code.as_str(), "node_inactive");
    let again = stage.refused(&["lifecycle", ROBOT, "/asked", "deactivate"]).await;
    assert!(again.contains("/asked does not deactivate: it is inactive"), "{again}");
    let state = stage.asked(&["lifecycle", ROBOT, "/asked", "activate"]).await;
    assert_eq!(state["state"], "active", "{state}");
    stage.runs("asked").await;
}
