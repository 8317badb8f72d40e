//! The task manifest: a package's config blob, made from `task.toml` and `package.xml` at push and
//! obeyed by the agent. It is data and its own rules; reading the source files is the server
//! crate's work.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::ids::{GraphName, Labels};
use crate::{Digest, TaskName, Version};

/// The longest any text in a manifest may be, in bytes.
pub const MAX_TEXT_BYTES: usize = 4096;
/// The most elements any list or table in a manifest may have.
pub const MAX_LIST_LEN: usize = 256;
/// The largest manifest, in bytes of JSON.
pub const MAX_MANIFEST_BYTES: usize = 1024 * 1024;
/// The largest uncompressed content that is packed, in bytes, and that a robot unpacks by default.
pub const MAX_CONTENT_TAR_BYTES: u64 = 16 << 30;
/// The most files, directories and links that are packed, and that a robot unpacks by default.
pub const MAX_CONTENT_ENTRIES: u64 = 100_000;
/// The most components of a path that is packed, and that a robot unpacks by default.
pub const MAX_CONTENT_DEPTH: usize = 48;
/// The longest path that is packed, and that a robot unpacks by default, in bytes.
pub const MAX_CONTENT_PATH_BYTES: usize = 1024;
/// The highest ratio of uncompressed to compressed bytes beyond [`CONTENT_RATIO_FREE_BYTES`] that
/// is packed, and that a robot unpacks by default.
pub const MAX_CONTENT_RATIO: u64 = 200;
/// Content up to this size may have any compression ratio.
pub const CONTENT_RATIO_FREE_BYTES: u64 = 64 << 20;

/// The most variables in `run.env`.
pub const MAX_ENV_VARIABLES: usize = 128;
/// The longest name of a variable in `run.env`, in bytes.
pub const MAX_ENV_NAME_BYTES: usize = 128;
/// The most bytes of all names and values in `run.env` together.
pub const MAX_ENV_BYTES: usize = 64 * 1024;
/// Variables that bash refuses to change or overwrites before it starts a program.
const SHELL_VARIABLES: [&str; 10] = [
    "_",
    "BASHOPTS",
    "BASH_VERSINFO",
    "EUID",
    "OLDPWD",
    "PPID",
    "PWD",
    "SHELLOPTS",
    "SHLVL",
    "UID",
];

/// Description of a package: how the package is built, run and watched.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct TaskManifest {
    /// The package's and the task's name.
    pub name: TaskName,
    /// The package's version.
    pub version: Version,
    /// How the package is built.
    #[serde(default)]
    pub build: Build,
    /// How the task is run.
    pub run: Run,
    /// Conditions on the ROS graph for the task to count as running.
    #[serde(default)]
    pub ready: Ready,
    /// ROS parameters by node and name.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub parameters: BTreeMap<String, BTreeMap<String, serde_json::Value>>,
    /// Files to upload to the server when the task ends.
    #[serde(default)]
    pub outputs: Outputs,
    /// Requirements on the robot.
    #[serde(default)]
    pub requires: Requires,
    /// Resource limits of the task.
    #[serde(default, skip_serializing_if = "Limits::is_empty")]
    pub limits: Limits,
    /// Names of the packages that `package.xml` declares as needed at run time.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub exec_depends: Vec<String>,
    /// Facts about the content blob.
    pub content: ContentFacts,
}

/// How a package is built on the robot.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Build {
    /// The build tool.
    #[serde(default)]
    pub tool: BuildTool,
}

/// A build tool.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum BuildTool {
    /// `colcon build`, ROS 2.
    Colcon,
    /// `catkin_make install`, ROS 1.
    Catkin,
    /// Nothing to build: an install tree or plain files.
    #[default]
    None,
}

/// How a task is run. Exactly one of `launch` and `exec` is given.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Run {
    /// Package and launch file for `ros2 launch`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub launch: Option<[String; 2]>,
    /// A command and its arguments, run in the task's directory.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub exec: Option<Vec<String>>,
    /// Launch arguments, `name:=value`.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub args: BTreeMap<String, String>,
    /// Environment variables of the task, set after the ROS setup files have been sourced.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub env: BTreeMap<String, String>,
    /// Service or job.
    #[serde(default)]
    pub kind: TaskKind,
    /// Behaviour after a reboot.
    #[serde(default)]
    pub on_boot: OnBoot,
    /// When to restart the process after it ends by itself.
    #[serde(default)]
    pub restart: Restart,
    /// Whether an interrupted job may be restarted.
    #[serde(default)]
    pub idempotent: bool,
    /// Seconds between SIGINT and SIGTERM, and again between SIGTERM and SIGKILL.
    #[serde(default = "default_stop_timeout_s")]
    pub stop_timeout_s: u32,
    /// Seconds a job may run; absent: no limit.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub deadline_s: Option<u32>,
}

impl Default for Run {
    fn default() -> Self {
        Self {
            launch: None,
            exec: None,
            args: BTreeMap::new(),
            env: BTreeMap::new(),
            kind: TaskKind::default(),
            on_boot: OnBoot::default(),
            restart: Restart::default(),
            idempotent: false,
            stop_timeout_s: default_stop_timeout_s(),
            deadline_s: None,
        }
    }
}

fn default_stop_timeout_s() -> u32 {
    10
}

/// Whether a task keeps running or ends.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum TaskKind {
    /// Keeps running.
    #[default]
    Service,
    /// Runs to completion, once per run.
    Job,
}

/// Behaviour of a task after a reboot.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum OnBoot {
    /// The task starts.
    #[default]
    Start,
    /// The task stays stopped until an operator starts it.
    Hold,
}

/// When to restart a process that ended by itself.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "kebab-case")]
pub enum Restart {
    /// After a failure.
    #[default]
    OnFailure,
    /// After every end.
    Always,
    /// Never.
    Never,
}

/// Conditions for a task to count as running.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Ready {
    /// Nodes that must be on the graph.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub nodes: Vec<String>,
    /// Lifecycle nodes that the agent configures and activates.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub lifecycle: Vec<String>,
    /// Services that must answer.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub services: Vec<String>,
    /// Topics that must have a publisher.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub topics: BTreeMap<String, ReadyTopic>,
    /// Seconds that all conditions must hold.
    #[serde(default = "default_hold_s")]
    pub hold_s: u32,
    /// Seconds until the conditions must hold.
    #[serde(default = "default_ready_timeout_s")]
    pub timeout_s: u32,
}

impl Default for Ready {
    fn default() -> Self {
        Self {
            nodes: Vec::new(),
            lifecycle: Vec::new(),
            services: Vec::new(),
            topics: BTreeMap::new(),
            hold_s: default_hold_s(),
            timeout_s: default_ready_timeout_s(),
        }
    }
}

/// Further conditions on a topic, besides having a publisher.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ReadyTopic {
    /// Minimum rate of the topic, in messages per second.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub min_hz: Option<f64>,
}

fn default_hold_s() -> u32 {
    2
}

fn default_ready_timeout_s() -> u32 {
    30
}

/// Files to upload to the server when the task ends.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Outputs {
    /// Glob patterns below the task's directory.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub paths: Vec<String>,
}

/// Requirements on a robot; an empty list accepts any value.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Requires {
    /// Labels that the robot must have.
    #[serde(default, skip_serializing_if = "Labels::is_empty")]
    #[cfg_attr(feature = "openapi", schema(inline))]
    pub labels: Labels,
    /// Accepted ROS distributions; one is enough.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub ros_distro: Vec<String>,
    /// Accepted architectures; one is enough.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub arch: Vec<String>,
}

/// Resource limits of a task; enforced if the robot has control groups.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Limits {
    /// Memory of all the task's processes together, in MiB.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub memory_mb: Option<u64>,
    /// CPU weight under contention, 1 to 10,000; tasks without a weight have 100.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cpu_weight: Option<u32>,
    /// Number of processes and threads.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pids: Option<u32>,
}

impl Limits {
    /// Whether no limit is set.
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }
}

/// Measurements of the content blob by the packer, known to the robot before the transfer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ContentFacts {
    /// Digest of the uncompressed tar.
    pub tar_digest: Digest,
    /// Size of the uncompressed tar in bytes.
    pub tar_size: u64,
    /// Number of files, directories and links.
    pub entries: u64,
}

/// A rule that a manifest breaks, named by the user's own key.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{key}: {reason}")]
pub struct ManifestProblem {
    /// The key as it is written in `task.toml`, for example `run.exec`.
    pub key: String,
    /// The problem with this key's value.
    pub reason: String,
}

impl TaskManifest {
    /// Every rule that this manifest breaks; empty if the manifest can be deployed.
    pub fn problems(&self) -> Vec<ManifestProblem> {
        let mut problems = Problems(Vec::new());
        self.check_run(&mut problems);
        self.check_ready(&mut problems);
        self.check_limits(&mut problems);
        problems.texts("outputs.paths", &self.outputs.paths);
        for path in &self.outputs.paths {
            if path.starts_with('/') || path.split('/').any(|part| part == "..") {
                problems
                    .add("outputs.paths", format!("{path:?} must stay below the task's directory"));
            }
        }
        problems.texts("requires.ros_distro", &self.requires.ros_distro);
        problems.texts("requires.arch", &self.requires.arch);
        problems.texts("exec_depend", &self.exec_depends);
        if self.parameters.len() > MAX_LIST_LEN
            || self.parameters.values().any(|p| p.len() > MAX_LIST_LEN)
        {
            problems.add("parameters", format!("more than {MAX_LIST_LEN} entries"));
        }
        for node in self.parameters.keys() {
            problems.graph_name("parameters", node);
        }
        problems.0
    }

    fn check_run(&self, problems: &mut Problems) {
        let run = &self.run;
        match (&run.launch, &run.exec) {
            (None, None) => problems.add("run", "give either \"launch\" or \"exec\"".to_owned()),
            (Some(_), Some(_)) => {
                problems.add("run", "\"launch\" and \"exec\" exclude each other".to_owned())
            }
            (Some(launch), None) => {
                problems.texts("run.launch", launch);
                if launch.iter().any(|part| part.starts_with('-')) {
                    problems
                        .add("run.launch", "package and file must not start with '-'".to_owned());
                }
            }
            (None, Some(exec)) => {
                problems.texts("run.exec", exec);
                if exec.first().is_none_or(String::is_empty) {
                    problems.add("run.exec", "needs a command".to_owned());
                }
                if !run.args.is_empty() {
                    problems.add(
                        "run.args",
                        "goes with \"launch\"; put a command's arguments into \"exec\"".to_owned(),
                    );
                }
            }
        }
        if run.args.len() > MAX_LIST_LEN {
            problems.add("run.args", format!("more than {MAX_LIST_LEN} entries"));
        }
        for (name, value) in &run.args {
            problems.texts("run.args", [name, value]);
            if name.is_empty() || name.starts_with('-') || name.contains(":=") {
                problems.add("run.args", format!("{name:?} is not the name of a launch argument"));
            }
            if value.is_empty() {
                let reason = "is empty: no launcher takes that; \
                              leave it out and give the launch file a default";
                problems.add("run.args", format!("{name:?} {reason}"));
            }
        }
        self.check_env(problems);
        if !(1..=600).contains(&run.stop_timeout_s) {
            problems.add("run.stop_timeout_s", "must be between 1 and 600".to_owned());
        }
        if run.idempotent && run.kind == TaskKind::Service {
            problems.add("run.idempotent", "goes with kind = \"job\"".to_owned());
        }
        if run.deadline_s.is_some() && run.kind == TaskKind::Service {
            problems.add("run.deadline_s", "goes with kind = \"job\"".to_owned());
        }
        if run.deadline_s.is_some_and(|seconds| !(1..=30 * 24 * 3600).contains(&seconds)) {
            problems.add("run.deadline_s", "must be between 1 and 2592000".to_owned());
        }
    }

    fn check_env(&self, problems: &mut Problems) {
        let env = &self.run.env;
        if env.len() > MAX_ENV_VARIABLES {
            problems.add("run.env", format!("more than {MAX_ENV_VARIABLES} variables"));
        }
        let bytes: usize = env.iter().map(|(name, value)| name.len() + value.len() + 2).sum();
        if bytes > MAX_ENV_BYTES {
            let reason = format!("names and values have {bytes} bytes, more than {MAX_ENV_BYTES}");
            problems.add("run.env", reason);
        }
        for (name, value) in env {
            let key = format!("run.env.{name}");
            let is_plain = |c: char| c.is_ascii_alphanumeric() || c == '_';
            if !name.chars().all(is_plain) || name.starts_with(|c: char| c.is_ascii_digit()) {
                let key = format!("run.env.{name:?}");
                let reason = "is not the name of a variable: letters, digits and _, \
                              and no digit first";
                problems.add(&key, reason.to_owned());
            } else if name.is_empty() {
                problems.add("run.env.\"\"", "a variable needs a name".to_owned());
            } else if name.len() > MAX_ENV_NAME_BYTES {
                problems.add(&key, format!("its name is longer than {MAX_ENV_NAME_BYTES} bytes"));
            } else if name.starts_with("TASKD_") {
                let reason = "names that begin with TASKD_ are the agent's".to_owned();
                problems.add(&key, reason);
            } else if SHELL_VARIABLES.contains(&name.as_str()) {
                problems.add(&key, "bash, which starts the task, sets it itself".to_owned());
            }
            if value.contains('\0') {
                problems.add(&key, "has a NUL, which no variable can hold".to_owned());
            }
        }
    }

    fn check_ready(&self, problems: &mut Problems) {
        let ready = &self.ready;
        let lists = [
            ("ready.nodes", &ready.nodes),
            ("ready.lifecycle", &ready.lifecycle),
            ("ready.services", &ready.services),
        ];
        for (key, names) in lists {
            problems.texts(key, names);
            for name in names {
                problems.graph_name(key, name);
            }
        }
        problems.texts("ready.topics", ready.topics.keys());
        for (topic, wanted) in &ready.topics {
            problems.graph_name("ready.topics", topic);
            if wanted.min_hz.is_some_and(|hz| !(hz > 0.0 && hz <= 10_000.0)) {
                problems.add(
                    "ready.topics",
                    format!("{topic:?} min_hz: must be above 0 and at most 10000"),
                );
            }
        }
        if self.build.tool == BuildTool::Catkin {
            let promised = [
                ("ready.nodes", ready.nodes.is_empty()),
                ("ready.lifecycle", ready.lifecycle.is_empty()),
                ("ready.services", ready.services.is_empty()),
                ("ready.topics", ready.topics.is_empty()),
                ("parameters", self.parameters.is_empty()),
            ];
            for (key, _) in promised.iter().filter(|(_, is_empty)| !is_empty) {
                problems.add(
                    key,
                    "is about the graph of ROS 2; build.tool = \"catkin\" means ROS 1".to_owned(),
                );
            }
        }
        if !(1..=3600).contains(&ready.timeout_s) {
            problems.add("ready.timeout_s", "must be between 1 and 3600".to_owned());
        }
        if ready.hold_s >= ready.timeout_s {
            problems.add("ready.hold_s", "must be less than ready.timeout_s".to_owned());
        }
    }

    fn check_limits(&self, problems: &mut Problems) {
        let limits = &self.limits;
        if limits.memory_mb.is_some_and(|megabytes| !(1..=1 << 24).contains(&megabytes)) {
            problems.add("limits.memory_mb", "must be between 1 and 16777216".to_owned());
        }
        if limits.cpu_weight.is_some_and(|weight| !(1..=10_000).contains(&weight)) {
            problems.add("limits.cpu_weight", "must be between 1 and 10000".to_owned());
        }
        if limits.pids.is_some_and(|pids| !(1..=1 << 22).contains(&pids)) {
            problems.add("limits.pids", "must be between 1 and 4194304".to_owned());
        }
    }
}

struct Problems(Vec<ManifestProblem>);

impl Problems {
    fn add(&mut self, key: &str, reason: String) {
        self.0.push(ManifestProblem { key: key.to_owned(), reason });
    }

    /// Texts end up in a generated script and in argument lists: no NUL, no line breaks, no other
    /// control characters.
    fn texts<T: AsRef<str>>(&mut self, key: &str, texts: impl IntoIterator<Item = T>) {
        let mut count = 0;
        for text in texts {
            let text = text.as_ref();
            count += 1;
            if text.chars().any(char::is_control) {
                self.add(key, format!("{text:?} has a control character"));
            }
            if text.len() > MAX_TEXT_BYTES {
                self.add(key, format!("a text is longer than {MAX_TEXT_BYTES} bytes"));
            }
        }
        if count > MAX_LIST_LEN {
            self.add(key, format!("more than {MAX_LIST_LEN} entries"));
        }
    }

    fn graph_name(&mut self, key: &str, name: &str) {
        if let Err(error) = name.parse::<GraphName>() {
            self.add(key, error.to_string());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn manifest(run: Run) -> TaskManifest {
        TaskManifest {
            name: "talker".parse().expect("valid"),
            version: "1.0.0".parse().expect("valid"),
            build: Build::default(),
            run,
            ready: Ready::default(),
            parameters: BTreeMap::new(),
            outputs: Outputs::default(),
            requires: Requires::default(),
            limits: Limits::default(),
            exec_depends: Vec::new(),
            content: ContentFacts { tar_digest: Digest::of(b""), tar_size: 0, entries: 0 },
        }
    }

    fn run(exec: &[&str]) -> Run {
        Run { exec: Some(exec.iter().map(|s| (*s).to_owned()).collect()), ..Run::default() }
    }

    #[test]
    fn plain_command_has_no_problems() {
        assert_eq!(manifest(run(&["true"])).problems(), []);
    }

    #[test]
    fn variables_are_limited_in_count_and_size() {
        let of = |count: usize, value: &str| {
            let env = (0..count).map(|n| (format!("_n{n:03}"), value.to_owned())).collect();
            manifest(Run { env, ..run(&["true"]) }).problems()
        };
        assert_eq!(of(MAX_ENV_VARIABLES, "several\nlines, $(no) 'command'"), []);
        assert_eq!(of(MAX_ENV_VARIABLES + 1, "")[0].key, "run.env");
        assert_eq!(of(2, &"x".repeat(MAX_ENV_BYTES / 2 - 7)), []);
        assert_eq!(of(2, &"x".repeat(MAX_ENV_BYTES / 2))[0].key, "run.env");
        let long = Run { env: [("N".repeat(129), String::new())].into(), ..run(&["true"]) };
        assert!(manifest(long).problems()[0].reason.contains("longer than 128 bytes"));
    }

    #[test]
    fn problems_name_the_users_key() {
        let keys = |manifest: &TaskManifest| {
            manifest.problems().into_iter().map(|p| p.key).collect::<Vec<_>>()
        };
        assert_eq!(keys(&manifest(Run::default())), ["run"]);
        assert_eq!(keys(&manifest(run(&[]))), ["run.exec"]);
        assert_eq!(keys(&manifest(run(&["a\nb"]))), ["run.exec"]);
        let launch = Some(["talker".to_owned(), "talker.launch.py".to_owned()]);
        let args = [("map".to_owned(), String::new())].into();
        assert_eq!(keys(&manifest(Run { launch, args, ..Run::default() })), ["run.args"]);
        let env =
            ["", "A-B", "1ST", "é", "TASKD_ROBOT", "UID"].map(|name| (name.into(), "".into()));
        let named = Run { env: env.into(), ..run(&["true"]) };
        let expected = ["\"\"", "\"1ST\"", "\"A-B\"", "TASKD_ROBOT", "UID", "\"é\""];
        assert_eq!(keys(&manifest(named)), expected.map(|name| format!("run.env.{name}")));
        let odd = Run { env: [("A".into(), "a\0".into())].into(), ..run(&["true"]) };
        assert_eq!(keys(&manifest(odd)), ["run.env.A"]);
        let mut odd = manifest(run(&["true"]));
        odd.ready.nodes = vec!["mapper".to_owned()];
        odd.outputs.paths = vec!["../secrets".to_owned()];
        assert_eq!(keys(&odd), ["ready.nodes", "outputs.paths"]);
        let mut ros1 = manifest(run(&["true"]));
        ros1.build.tool = BuildTool::Catkin;
        ros1.ready.services = vec!["/say".to_owned()];
        ros1.parameters.insert("/talker".to_owned(), BTreeMap::new());
        assert_eq!(keys(&ros1), ["ready.services", "parameters"]);
    }
}
