//! Decides which settings apply when both the robot's own file and environment and its
//! administrator at the server set a value. The robot's own settings win, because they were set by
//! a person next to the robot. A function of values; it reads no files or variables.
//!
//! A setup file is a shell script, so naming one means running code. A robot that runs only
//! packages signed by its publishers therefore takes no setup files from its server, unless its own
//! settings allow this.

use std::path::{Path, PathBuf};

use task_proto::AbsolutePath;
use task_proto::desired::settings::{EffectiveSettings, RobotSettings};
use task_proto::telemetry::log::LogLevel;

use crate::config::{Config, count};

#[derive(Debug, Clone, PartialEq)]
pub struct MergedSettings {
    /// The robot's settings with the values taken from the server.
    pub config: Config,
    /// The same settings for the report; `None`: all have their defaults.
    pub effective: Option<EffectiveSettings>,
}

/// Keys of the settings that name files for a shell.
const SHELL_KEYS: [&str; 2] = ["underlays", "workspace"];

/// Combines the robot's `own` settings with the values `set` at the server. The server has checked
/// its values, and they are checked again here, each separately: a server's mistake must not keep
/// the robot from its tasks, nor from the other settings.
pub fn merge_settings(own: &Config, set: &RobotSettings) -> MergedSettings {
    let mut config = own.clone();
    let mut mine = Vec::new();
    let (set, mut refused) = set.clone().usable();
    let takes_shell = own.trust.is_none() || own.server_underlays;
    let mut decide = |key: &'static str, is_own: bool, is_set: bool| {
        if is_own {
            mine.push(key.to_owned());
        } else if is_set && SHELL_KEYS.contains(&key) && !takes_shell {
            refused.push(key.to_owned());
        } else {
            return is_set;
        }
        false
    };
    if decide("underlays", !own.underlays.is_empty(), set.underlays.is_some()) {
        config.underlays =
            set.underlays.iter().flatten().map(|path| PathBuf::from(path.as_str())).collect();
    }
    if decide("workspace", own.workspace.is_some(), set.workspace.is_some()) {
        config.workspace = set.workspace.as_ref().map(|path| PathBuf::from(path.as_str()));
    }
    if decide("ros_domain_id", own.ros_domain_id.is_some(), set.ros_domain_id.is_some()) {
        config.ros_domain_id = set.ros_domain_id;
    }
    if decide("forward_level", own.own_forward_level.is_some(), set.forward_level.is_some()) {
        config.forward.level = set.forward_level.unwrap_or(LogLevel::Warn);
    }
    let is_own = own.limits.bounds().into_iter().filter(|(_, value, ..)| value.is_some());
    mine.extend(is_own.map(|(key, ..)| key.to_owned()));
    let limits = own.limits.or(set.limits);
    config.limits = limits;
    config.task_pids = limits.task_pids.unwrap_or(config.task_pids);
    config.parallel_tasks = limits.parallel_tasks.map_or(config.parallel_tasks, count);
    let values = RobotSettings {
        underlays: Some(
            config.underlays.iter().filter_map(|path| shown_path(path)).collect::<Vec<_>>(),
        )
        .filter(|underlays| !underlays.is_empty()),
        workspace: config.workspace.as_deref().and_then(shown_path),
        ros_domain_id: config.ros_domain_id,
        forward_level: own.own_forward_level.or(set.forward_level),
        limits,
        unreadable: Vec::new(),
    };
    let effective = EffectiveSettings { values, own: mine, refused };
    let effective = Some(effective).filter(|effective| *effective != EffectiveSettings::default());
    MergedSettings { config, effective }
}

/// The path in its wire form, where it has one: a user at the robot may have named a path that the
/// wire form does not allow.
fn shown_path(path: &Path) -> Option<AbsolutePath> {
    path.to_str()?.parse().ok()
}

#[cfg(test)]
mod tests {
    use std::ffi::OsString;

    use serde_json::json;

    use super::*;

    fn own(file: &str, variables: &[(&str, &str)]) -> Config {
        let dir = tempfile::tempdir().expect("a directory");
        std::fs::write(dir.path().join(crate::config::FILE_NAME), file).expect("written");
        let variables =
            variables.iter().map(|(name, value)| (OsString::from(name), OsString::from(value)));
        Config::load(dir.path(), variables).expect("loads")
    }

    fn set(settings: serde_json::Value) -> RobotSettings {
        serde_json::from_value(settings).expect("parses")
    }

    #[test]
    fn unset_settings_come_from_the_server() {
        let own = own("", &[]);
        assert_eq!(
            merge_settings(&own, &RobotSettings::default()),
            MergedSettings { config: own.clone(), effective: None }
        );
        let set = set(json!({
            "underlays": ["/opt/ros/jazzy/setup.bash"], "workspace": "/home/robot/ws", "ros_domain_id": 7,
            "forward_level": "error", "limits": { "task_pids": 64, "parallel_tasks": 5 }
        }));
        let MergedSettings { config, effective } = merge_settings(&own, &set);
        assert_eq!(config.underlays, [PathBuf::from("/opt/ros/jazzy/setup.bash")]);
        assert_eq!(config.workspace, Some(PathBuf::from("/home/robot/ws")));
        assert_eq!((config.ros_domain_id, config.forward.level), (Some(7), LogLevel::Error));
        assert_eq!((config.task_pids, config.parallel_tasks), (64, 5));
        assert_eq!(
            effective,
            Some(EffectiveSettings { values: set, ..EffectiveSettings::default() })
        );
    }

    #[test]
    fn robots_own_file_and_environment_win() {
        let file = "underlays = [\"/own/setup.bash\"]\n[limits]\nlog_bytes = 9000\n[logs]\nforward_level = \"info\"\n";
        let own = own(file, &[("ROS_DOMAIN_ID", "3")]);
        let set = set(json!({
            "underlays": ["/theirs/setup.bash"], "ros_domain_id": 7, "forward_level": "fatal",
            "limits": { "log_bytes": 5000, "task_pids": 64 }
        }));
        let MergedSettings { config, effective } = merge_settings(&own, &set);
        assert_eq!(config.underlays, [PathBuf::from("/own/setup.bash")]);
        assert_eq!((config.ros_domain_id, config.forward.level), (Some(3), LogLevel::Info));
        assert_eq!((config.limits.log_bytes, config.task_pids), (Some(9000), 64));
        let effective = effective.expect("something is set");
        assert_eq!(
            effective.own,
            ["underlays", "ros_domain_id", "forward_level", "limits.log_bytes"]
        );
        assert_eq!(
            (effective.values.limits.log_bytes, effective.values.limits.task_pids),
            (Some(9000), Some(64))
        );
    }

    #[test]
    fn robot_that_trusts_publishers_takes_no_setup_file_from_its_server() {
        let key = task_proto::trust::envelope::SigningKey::from_bytes([7; 32]).public_key();
        let trusting = format!("[trusted_publishers]\nkeys = [\"{key}\"]\n");
        let set = set(
            json!({ "underlays": ["/tmp/evil.sh"], "workspace": "/tmp/evil", "ros_domain_id": 7 }),
        );
        let MergedSettings { config, effective } = merge_settings(&own(&trusting, &[]), &set);
        assert_eq!(
            (config.underlays.len(), config.workspace, config.ros_domain_id),
            (0, None, Some(7))
        );
        assert_eq!(effective.expect("reported").refused, ["underlays", "workspace"]);
        let allows = format!("server_underlays = true\n{trusting}");
        let MergedSettings { config, effective } = merge_settings(&own(&allows, &[]), &set);
        assert_eq!(
            (config.underlays.len(), config.workspace),
            (1, Some(PathBuf::from("/tmp/evil")))
        );
        assert_eq!(effective.expect("reported").refused, Vec::<String>::new());
    }

    #[test]
    fn invalid_server_settings_are_refused() {
        let own = own("", &[]);
        let set =
            set(json!({ "ros_domain_id": 7, "limits": { "parallel_tasks": 0, "task_pids": 64 } }));
        let set = RobotSettings { unreadable: vec!["forward_level".to_owned()], ..set };
        let MergedSettings { config, effective } = merge_settings(&own, &set);
        assert_eq!(
            (config.ros_domain_id, config.task_pids, config.parallel_tasks),
            (Some(7), 64, own.parallel_tasks)
        );
        assert_eq!(
            effective.expect("reported").refused,
            ["forward_level", "limits.parallel_tasks"]
        );
    }
}
