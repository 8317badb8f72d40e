//! Reads `task.toml`. The parser is strict: an unknown key and a value of the wrong type are
//! problems, and all problems are found in one pass. Rules that involve several keys are not
//! checked here.

use std::collections::BTreeMap;

use serde::de::DeserializeOwned;
use task_proto::expected::in_file_terms;
use task_proto::packages::manifest::{
    BuildTool, Limits, Outputs, Ready, ReadyTopic, Requires, Run,
};
use task_proto::toml_keys::{KeyReference, closest_key, reference_table};
use task_proto::{TaskName, Version};

use super::Problem;

/// The file's name in a package.
pub const FILE: &str = "task.toml";

/// Contents of the file; absent keys have their default or are `None`.
#[derive(Debug, Default, PartialEq)]
pub struct TaskToml {
    /// `name`; absent: the name in package.xml.
    pub name: Option<TaskName>,
    /// `version`; absent: the version in package.xml.
    pub version: Option<Version>,
    /// `build.tool`; absent: the tool implied by package.xml.
    pub build_tool: Option<BuildTool>,
    /// `[run]`: the launch file or program, and how to run it.
    pub run: Run,
    /// `[ready]`: the conditions for the task to count as running.
    pub ready: Ready,
    /// `[parameters]`, by node and name.
    pub parameters: BTreeMap<String, BTreeMap<String, serde_json::Value>>,
    /// `[outputs]`: the files to upload when the task ends.
    pub outputs: Outputs,
    /// `[requires]`: the requirements on a robot.
    pub requires: Requires,
    /// `[limits]`: the resource limits of the task.
    pub limits: Limits,
}

/// All keys: key, default, meaning.
const KEYS: [(&str, &str, &str); 28] = [
    ("name", "<name> of package.xml", "Name of the package and its task"),
    ("version", "<version> of package.xml", "Version of the package"),
    ("build.tool", "by package.xml", "`colcon`, `catkin` or `none`"),
    ("run.launch", "", "`[\"package\", \"file.launch.py\"]`; this or `run.exec` is required"),
    ("run.exec", "", "A command and its arguments"),
    ("run.args", "{}", "Launch arguments by name"),
    ("run.env", "{}", "Environment variables of the task, which win over those of ROS setup files"),
    ("run.kind", "\"service\"", "`service` keeps running, `job` runs to its end"),
    ("run.on_boot", "\"start\"", "After a reboot: `start` or `hold`"),
    (
        "run.restart",
        "\"on-failure\"",
        "Restart after an end by itself: `on-failure`, `always` or `never`",
    ),
    ("run.idempotent", "false", "Whether an interrupted job may be started again"),
    ("run.stop_timeout_s", "10", "Seconds from SIGINT to SIGTERM, and again to SIGKILL; 1 to 600"),
    ("run.deadline_s", "", "Seconds that a job may run, at most 30 days"),
    ("ready.nodes", "[]", "Nodes that must be on the ROS graph"),
    ("ready.lifecycle", "[]", "Lifecycle nodes, which the agent brings to active"),
    ("ready.services", "[]", "Services that must answer"),
    ("ready.topics", "{}", "Topics that must be published, by name"),
    ("ready.topics.NAME.min_hz", "", "Lowest rate of the topic"),
    ("ready.hold_s", "2", "Seconds that the conditions must hold"),
    ("ready.timeout_s", "30", "Seconds within which the task must become ready; 1 to 3600"),
    (
        "parameters.NODE.NAME",
        "",
        "ROS parameter of a node: boolean, number, string or list of one of these",
    ),
    ("outputs.paths", "[]", "Globs of files to upload when the task ends"),
    ("requires.labels", "{}", "Labels that the robot must have"),
    ("requires.ros_distro", "[]", "ROS distributions, one of which the robot must have"),
    ("requires.arch", "[]", "Architectures, one of which the robot must have"),
    ("limits.memory_mb", "the robot's", "Memory of all the task's processes, in MiB"),
    ("limits.cpu_weight", "100", "CPU weight under contention, 1 to 10,000"),
    ("limits.pids", "the robot's", "Number of processes and threads"),
];

/// All keys of `task.toml`, in Markdown.
pub fn reference() -> String {
    let keys =
        KEYS.map(|(key, default, meaning)| KeyReference { key, variable: None, default, meaning });
    reference_table(&keys)
}

/// Parses `text`, adding errors to `problems`.
pub fn parse(text: &str, problems: &mut Vec<Problem>) -> TaskToml {
    let mut file = TaskToml::default();
    match text.parse::<toml::Table>() {
        Ok(table) => {
            Section { path: String::new(), table, known: Vec::new(), problems }.read_file(&mut file)
        }
        Err(error) => {
            let line = error
                .span()
                .map_or(1, |span| text[..span.start.min(text.len())].matches('\n').count() + 1);
            problems.push(Problem {
                file: FILE.to_owned(),
                reason: format!("line {line}: {}", error.message()),
            });
        }
    }
    file
}

/// A table that is read key by key; keys left over at the end are unknown.
struct Section<'p> {
    /// The table's own key followed by a dot; empty at the top.
    path: String,
    table: toml::Table,
    known: Vec<&'static str>,
    problems: &'p mut Vec<Problem>,
}

impl Section<'_> {
    fn read_file(mut self, file: &mut TaskToml) {
        self.take("name", &mut file.name);
        self.take("version", &mut file.version);
        self.section("build", |build| build.take("tool", &mut file.build_tool));
        self.section("run", |section| {
            let run = &mut file.run;
            section.take("launch", &mut run.launch);
            section.take("exec", &mut run.exec);
            section.take("args", &mut run.args);
            section.take("env", &mut run.env);
            section.take("kind", &mut run.kind);
            section.take("on_boot", &mut run.on_boot);
            section.take("restart", &mut run.restart);
            section.take("idempotent", &mut run.idempotent);
            section.take("stop_timeout_s", &mut run.stop_timeout_s);
            section.take("deadline_s", &mut run.deadline_s);
        });
        self.section("ready", |section| {
            let ready = &mut file.ready;
            section.take("nodes", &mut ready.nodes);
            section.take("lifecycle", &mut ready.lifecycle);
            section.take("services", &mut ready.services);
            section.topics(&mut ready.topics);
            section.take("hold_s", &mut ready.hold_s);
            section.take("timeout_s", &mut ready.timeout_s);
        });
        self.section("outputs", |section| section.take("paths", &mut file.outputs.paths));
        self.section("requires", |section| {
            let requires = &mut file.requires;
            section.take("labels", &mut requires.labels);
            section.take("ros_distro", &mut requires.ros_distro);
            section.take("arch", &mut requires.arch);
        });
        self.section("limits", |section| {
            let limits = &mut file.limits;
            section.take("memory_mb", &mut limits.memory_mb);
            section.take("cpu_weight", &mut limits.cpu_weight);
            section.take("pids", &mut limits.pids);
        });
        self.parameters(&mut file.parameters);
        self.finish();
    }

    /// Reads `key` into `slot`, which keeps its default if the key is absent or invalid.
    fn take<T: DeserializeOwned>(&mut self, key: &'static str, slot: &mut T) {
        self.known.push(key);
        let Some(value) = self.table.remove(key) else { return };
        let written = truncated(&value);
        match value.try_into() {
            Ok(value) => *slot = value,
            Err(error) => {
                let error: toml::de::Error = error;
                self.problem(
                    key,
                    format!("{} (it is {written})", in_file_terms(error.message().trim_end())),
                );
            }
        }
    }

    /// Reads the table `key` with `read`; the table may be absent.
    fn section(&mut self, key: &'static str, read: impl FnOnce(&mut Section<'_>)) {
        self.known.push(key);
        match self.table.remove(key) {
            None => {}
            Some(toml::Value::Table(table)) => {
                let path = format!("{}{key}.", self.path);
                let mut section =
                    Section { path, table, known: Vec::new(), problems: self.problems };
                read(&mut section);
                section.finish();
            }
            Some(other) => self.problem(
                key,
                format!("expected a table, written [{key}] (it is {})", truncated(&other)),
            ),
        }
    }

    /// Reads `topics`: a table of tables, by the topics' names.
    fn topics(&mut self, topics: &mut BTreeMap<String, ReadyTopic>) {
        let mut tables: BTreeMap<String, toml::Table> = BTreeMap::new();
        self.take("topics", &mut tables);
        for (topic, table) in tables {
            let path = format!("{}topics.{topic:?}.", self.path);
            let mut section = Section { path, table, known: Vec::new(), problems: self.problems };
            let mut wanted = ReadyTopic::default();
            section.take("min_hz", &mut wanted.min_hz);
            section.finish();
            topics.insert(topic, wanted);
        }
    }

    fn parameters(&mut self, nodes: &mut BTreeMap<String, BTreeMap<String, serde_json::Value>>) {
        self.known.push("parameters");
        let tables = match self.table.remove("parameters") {
            None => return,
            Some(toml::Value::Table(tables)) => tables,
            Some(other) => {
                return self.problem(
                    "parameters",
                    format!("expected a table (it is {})", truncated(&other)),
                );
            }
        };
        for (node, value) in tables {
            let toml::Value::Table(parameters) = value else {
                self.problem(
                    "parameters",
                    format!(
                        "expected one table per node, like [parameters.\"/mapper\"], not {node:?}"
                    ),
                );
                continue;
            };
            let mut accepted = BTreeMap::new();
            for (name, value) in parameters {
                match parameter(&value) {
                    Ok(value) => drop(accepted.insert(name, value)),
                    Err(reason) => self.problem("parameters", format!("{node:?} {name}: {reason}")),
                }
            }
            nodes.insert(node, accepted);
        }
    }

    fn finish(&mut self) {
        for (key, _) in std::mem::take(&mut self.table) {
            let hint = match closest_key(&key, self.known.iter().copied()) {
                Some(known) => format!(" (did you mean {}{known}?)", self.path),
                None => format!(" (expected one of: {})", self.known.join(", ")),
            };
            self.problem(&key, format!("unknown key{hint}"));
        }
    }

    fn problem(&mut self, key: &str, reason: String) {
        self.problems.push(Problem {
            file: FILE.to_owned(),
            reason: format!("{}{key}: {reason}", self.path),
        });
    }
}

/// A ROS parameter's value: a boolean, number or string, or a list of one of these types.
fn parameter(value: &toml::Value) -> Result<serde_json::Value, &'static str> {
    const EXPECTED: &str = "expected a boolean, a number, a string or a list of one of these";
    match value {
        toml::Value::Boolean(truth) => Ok((*truth).into()),
        toml::Value::Integer(number) => Ok((*number).into()),
        toml::Value::String(text) => Ok(text.as_str().into()),
        toml::Value::Float(number) if number.is_finite() => Ok((*number).into()),
        toml::Value::Float(_) => Err("must be a finite number"),
        toml::Value::Array(list) if list.iter().any(|item| item.is_array() || item.is_table()) => {
            Err(EXPECTED)
        }
        toml::Value::Array(list) if list.windows(2).any(|pair| !pair[0].same_type(&pair[1])) => {
            Err("a list's values must be of one type")
        }
        toml::Value::Array(list) => list.iter().map(parameter).collect(),
        toml::Value::Datetime(_) | toml::Value::Table(_) => Err(EXPECTED),
    }
}

/// A value roughly as the user wrote it, short enough for a message.
fn truncated(value: &toml::Value) -> String {
    const MAX_CHARS: usize = 60;
    let text = value.to_string().replace('\n', " ");
    if text.chars().count() <= MAX_CHARS {
        text
    } else {
        text.chars().take(MAX_CHARS).chain(['…']).collect()
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use task_proto::packages::manifest::{OnBoot, Restart, TaskKind};

    use super::*;

    fn problems(text: &str) -> Vec<String> {
        let mut problems = Vec::new();
        parse(text, &mut problems);
        problems.into_iter().map(|problem| problem.to_string()).collect()
    }

    #[test]
    fn every_key_is_read() {
        let text = r#"
            name = "corridor_mapping"
            version = "1.0.0"
            [build]
            tool = "colcon"
            [run]
            launch = ["corridor_mapping", "mapping.launch.py"]
            args = { use_sim_time = "false" }
            env = { GREETING = "good day" }
            kind = "job"
            on_boot = "hold"
            restart = "never"
            idempotent = true
            stop_timeout_s = 3
            [ready]
            nodes = ["/mapper"]
            lifecycle = ["/mapper"]
            hold_s = 1
            timeout_s = 20
            [parameters."/mapper"]
            resolution = 0.05
            frames = ["map", "odom"]
            "nested.name" = 3
            [outputs]
            paths = ["maps/*.pgm"]
            [requires]
            labels = { base = "turtlebot" }
            ros_distro = ["jazzy"]
            arch = ["x86_64"]
        "#;
        let mut problems = Vec::new();
        let file = parse(text, &mut problems);
        assert_eq!(problems, []);
        assert_eq!(file.name.expect("name").as_str(), "corridor_mapping");
        assert_eq!(file.build_tool, Some(BuildTool::Colcon));
        assert_eq!(
            file.run.launch,
            Some(["corridor_mapping".to_owned(), "mapping.launch.py".to_owned()])
        );
        assert_eq!(
            (file.run.kind, file.run.on_boot, file.run.restart),
            (TaskKind::Job, OnBoot::Hold, Restart::Never)
        );
        assert_eq!(file.run.env["GREETING"], "good day");
        assert_eq!((file.run.stop_timeout_s, file.ready.hold_s, file.ready.timeout_s), (3, 1, 20));
        assert_eq!(file.parameters["/mapper"]["resolution"], serde_json::json!(0.05));
        assert_eq!(file.parameters["/mapper"]["frames"], serde_json::json!(["map", "odom"]));
        assert_eq!(file.requires.labels.len(), 1);
    }

    #[test]
    fn reference_has_every_key_with_its_default() {
        // Each section lists its keys when it meets an unknown one.
        let text = "zzzzzz = 1\n[build]\nzzzzzz = 1\n[run]\nzzzzzz = 1\n[ready]\nzzzzzz = 1\n[outputs]\nzzzzzz = 1\n\
                    [requires]\nzzzzzz = 1\n[limits]\nzzzzzz = 1\n[ready.topics.\"/t\"]\nzzzzzz = 1\n";
        let mut known = BTreeSet::new();
        for problem in problems(text) {
            let (at, rest) = problem.split_once("zzzzzz: unknown key").expect("unknown");
            let table = at.trim_start_matches("task.toml: ").replace("\"/t\"", "NAME");
            let keys = rest.split_once("one of: ").expect("a list").1.trim_end_matches(')');
            known.extend(keys.split(", ").map(|key| format!("{table}{key}")));
        }
        let tables = ["build", "run", "ready", "outputs", "requires", "limits", "parameters"];
        known.retain(|key| !tables.contains(&key.as_str()));
        known.insert("parameters.NODE.NAME".to_owned());
        assert_eq!(known, KEYS.iter().map(|(key, ..)| (*key).to_owned()).collect());
        let literal = |default: &str| format!("x = {default}").parse::<toml::Table>().is_ok();
        let defaults: String = KEYS
            .iter()
            // Tasks without a weight have that of the kernel.
            .filter(|(key, default, _)| literal(default) && *key != "limits.cpu_weight")
            .map(|(key, default, _)| format!("{key} = {default}\n"))
            .collect();
        let mut problems = Vec::new();
        assert_eq!(parse(&defaults, &mut problems), TaskToml::default(), "{defaults}");
        assert_eq!(problems, []);
    }

    #[test]
    fn all_problems_are_found_at_once_and_name_their_key() {
        let text = "nam = \"x\"\nversion = 1\nzzz = 1\n[run]\nexec = \"true\"\nkindd = \"job\"\nrestart = \"sometimes\"\n\
                    [ready]\nhold_s = -1\n[outputs]\npaths = [1]\n";
        let found = problems(text);
        for expected in [
            "task.toml: nam: unknown key (did you mean name?)",
            "task.toml: zzz: unknown key (expected one of: name, version, build, run,",
            "task.toml: version: invalid type: integer `1`, expected a string (it is 1)",
            "task.toml: run.kindd: unknown key (did you mean run.kind?)",
            "task.toml: run.exec: invalid type: string \"true\", expected a list",
            "task.toml: run.restart: unknown variant `sometimes`, expected one of `on-failure`, `always`, `never`",
            "task.toml: ready.hold_s: ",
            "task.toml: outputs.paths: ",
        ] {
            assert!(
                found.iter().any(|problem| problem.starts_with(expected)),
                "{expected:?} not in {found:#?}"
            );
        }
        assert_eq!(found.len(), 8, "{found:#?}");
    }

    #[test]
    fn syntax_errors_name_the_line() {
        let found = problems("name = \"x\"\nversion = \n");
        assert!(found[0].starts_with("task.toml: line 2: "), "{found:?}");
    }

    #[test]
    fn sections_must_be_tables_and_parameters_must_be_ros_values() {
        assert_eq!(
            problems("run = 3"),
            ["task.toml: run: expected a table, written [run] (it is 3)"]
        );
        let found = problems(
            "[parameters]\nx = 1\n[parameters.\"/n\"]\na = nan\nb = [1, 2.0]\nc = { d = 1 }\ne = 2020-01-01\n",
        );
        assert_eq!(found.len(), 5, "{found:#?}");
        assert!(found[0].contains("\"/n\" a: must be a finite number"), "{found:#?}");
    }
}
