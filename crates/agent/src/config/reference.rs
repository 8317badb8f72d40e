//! The reference of all keys of `agent.toml`. Never reads a file.

use task_proto::toml_keys::{KeyReference, reference_table};

/// All keys: key, default, meaning. The tables are complete here and in `Settings`; a test compares
/// them.
pub(super) const KEYS: [(&str, &str, &str); 36] = [
    ("server", "the server of the enrollment", "URL of the server"),
    ("mqtt", "true", "Whether MQTT is used; with `false` the robot only polls"),
    (
        "mqtt_transport",
        "\"auto\"",
        "`tcp` uses MQTT's own port, `websocket` the HTTP port, `auto` the one that works",
    ),
    ("name", "", "Name that the robot gives itself; the server's wins"),
    (
        "underlays",
        "setup files in `/opt/ros`",
        "Setup files to source before a task is built or run",
    ),
    ("workspace", "", "The robot's own ROS workspace, sourced after the underlays"),
    (
        "server_underlays",
        "false",
        "Whether the server may name setup files although publishers are trusted",
    ),
    ("ros_domain_id", "the variable `ROS_DOMAIN_ID`", "Domain of every task, 0 to 232"),
    ("poll_interval_s", "300", "Seconds between two polls while MQTT works, 1 to 86,400"),
    ("poll_interval_without_mqtt_s", "10", "Seconds between two polls without MQTT, 1 to 86,400"),
    (
        "token_lifetime_s",
        "2592000",
        "Seconds after which the robot asks for a new token, 3,600 or more",
    ),
    ("vitals_interval_s", "60", "Seconds between two reports of the machine's vitals; 0: none"),
    ("task_user", "\"taskd-task\"", "User whose groups the tasks of an agent that is root have"),
    ("seccomp", "\"default\"", "Filter of system calls for builds and tasks; `off`: none"),
    (
        "task_uids",
        "\"70000-79999\"",
        "User ids of tasks and builds, two for each task; `none`: all run as `task_user`",
    ),
    ("labels", "{}", "Labels that the robot gives itself; the server's win"),
    ("limits.archive_bytes", "17179869184", "Bytes of an unpacked package"),
    ("limits.archive_entries", "100000", "Files, directories and links of a package"),
    ("limits.disk_reserve_bytes", "268435456", "Bytes of the disk that stay free"),
    ("limits.log_bytes", "10485760", "Bytes of a log before its rotation; five are kept"),
    ("limits.output_bytes", "4294967296", "Bytes of the output files of a run"),
    ("limits.build_memory_bytes", "three quarters of the memory", "Memory of a build"),
    ("limits.build_timeout_s", "1800", "Seconds of a build"),
    ("limits.parallel_tasks", "2", "Versions that are prepared at the same time, 1 to 64"),
    ("limits.task_memory_mb", "all memory", "Memory of a task whose package sets no limit, in MiB"),
    ("limits.task_pids", "4096", "Processes and threads of such a task, and of a build"),
    (
        "gate.command",
        "",
        "Program that allows or denies starts, stops and switches, by its absolute path, and its arguments",
    ),
    ("gate.timeout_s", "10", "Seconds for the gate's answer, 1 to 300"),
    ("gate.default", "\"deny\"", "Answer of a gate that gives none: `allow` or `deny`"),
    (
        "logs.forward_level",
        "\"warn\"",
        "Lowest severity of lines that go to the server without a request",
    ),
    ("logs.forward_lines_per_s", "10", "Maximum rate of these lines for each task"),
    ("trusted_publishers.keys", "[]", "Keys of publishers; only packages that they signed are run"),
    ("trusted_publishers.threshold", "1", "Number of these keys that must have signed"),
    (
        "trusted_publishers.keeper_keys",
        "the publishers' keys",
        "Keys that must sign the first list of publishers",
    ),
    ("trusted_publishers.keeper_threshold", "1", "Number of these keys that must have signed"),
    (
        "trusted_publishers.require_list",
        "false",
        "Whether nothing is run before the robot has a list",
    ),
];

/// All keys of `agent.toml`, in Markdown.
pub fn reference() -> String {
    let variables = KEYS.map(|(key, ..)| variable(key));
    let keys: Vec<_> = KEYS
        .iter()
        .zip(&variables)
        .map(|((key, default, meaning), variable)| KeyReference {
            key,
            variable: Some(variable),
            default,
            meaning,
        })
        .collect();
    reference_table(&keys)
}

fn variable(key: &str) -> String {
    format!("{}{}", super::VARIABLE_PREFIX, key.replace('.', "_").to_uppercase())
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::super::{Config, Settings};
    use super::*;

    /// The keys that the parser names when it meets an unknown one in `table`.
    fn known(table: &str) -> BTreeSet<String> {
        let (head, prefix) = match table {
            "" => (String::new(), String::new()),
            table => (format!("[{table}]\n"), format!("{table}.")),
        };
        let error =
            toml::from_str::<Settings>(&format!("{head}zzzzzz = 1\n")).expect_err("unknown");
        // Of two keys: `a` or `b`; of more: one of `a`, `b`, `c`.
        let (_, names) = error.message().split_once("expected ").expect("a list");
        let names = names.trim_start_matches("one of ").replace(" or ", ", ");
        names.split(", ").map(|name| format!("{prefix}{}", name.trim_matches('`'))).collect()
    }

    #[test]
    fn every_key_is_listed_once() {
        let tables = ["limits", "gate", "logs", "trusted_publishers"];
        let mut expected = known("");
        for table in tables {
            assert!(expected.remove(table), "{table}");
            expected.extend(known(table));
        }
        let listed: BTreeSet<String> = KEYS.iter().map(|(key, ..)| (*key).to_owned()).collect();
        assert_eq!((&listed, listed.len()), (&expected, KEYS.len()));
    }

    #[test]
    fn documented_defaults_are_those_of_the_code() {
        let load = |content: &str| {
            let dir = tempfile::tempdir().expect("a directory");
            std::fs::write(dir.path().join(super::super::FILE_NAME), content).expect("written");
            Config::load(dir.path(), std::iter::empty()).expect("loads")
        };
        let literal = |default: &str| format!("x = {default}").parse::<toml::Table>().is_ok();
        let mut compared = 0;
        for (key, default, _) in KEYS {
            // The limits and the level are kept beside their effect, to be reported as the robot's
            // own, and a gate or publishers are set by the presence of their table.
            let is_kept = ["limits.", "gate.", "trusted_publishers.", "logs.forward_level"];
            let is_kept = is_kept.iter().any(|prefix| key.starts_with(prefix))
                || ["task_user", "seccomp", "labels"].contains(&key);
            if !is_kept && literal(default) {
                assert_eq!(load(&format!("{key} = {default}\n")), load(""), "{key}");
                compared += 1;
            }
        }
        assert!(compared > 8, "{compared}");
        let set = load(
            "[limits]\nparallel_tasks = 2\ntask_pids = 4096\n[logs]\nforward_level = \"warn\"\n",
        );
        let unset = load("");
        assert_eq!(
            (set.parallel_tasks, set.task_pids, set.forward),
            (unset.parallel_tasks, unset.task_pids, unset.forward)
        );
    }
}
