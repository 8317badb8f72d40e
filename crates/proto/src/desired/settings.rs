//! Settings of a robot that the server can store: those of the robot's own property file about the
//! ROS setup and the limits of tasks. Where both are set, the robot's own value wins: it was set by
//! a person next to the robot.

use serde::de::DeserializeOwned;
use serde::{Deserialize, Deserializer, Serialize};
use serde_json::{Value, json};

use crate::ids::AbsolutePath;
use crate::telemetry::log::LogLevel;

/// The most setup files of a robot.
pub const MAX_UNDERLAYS: usize = 16;
/// ROS 2's last domain whose ports exist everywhere.
pub const MAX_ROS_DOMAIN_ID: u32 = 232;

/// Settings of a robot on the server. An absent value is left to the robot.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct RobotSettings {
    /// Setup files to source before a task is built or run, in this order, instead of those found
    /// in `/opt/ros`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub underlays: Option<Vec<AbsolutePath>>,
    /// The robot's own ROS workspace, whose `install/` or `devel/` setup file is sourced after the
    /// underlays.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub workspace: Option<AbsolutePath>,
    /// `ROS_DOMAIN_ID` of every task, 0 to 232.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ros_domain_id: Option<u32>,
    /// Resource limits of tasks.
    #[serde(skip_serializing_if = "RobotLimits::is_empty")]
    pub limits: RobotLimits,
    /// The least severe log level that the robot forwards while no client follows its log.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub forward_level: Option<LogLevel>,
    /// Keys of stored settings that could not be read, because a server of another version wrote
    /// them.
    #[serde(skip)]
    pub unreadable: Vec<String>,
}

/// Resource limits of tasks on a robot, named as in the robot's property file.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct RobotLimits {
    /// Largest size of an unpacked package, in bytes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub archive_bytes: Option<u64>,
    /// Largest number of files, directories and links in a package.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub archive_entries: Option<u64>,
    /// Bytes to keep free on the disk.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub disk_reserve_bytes: Option<u64>,
    /// Size at which a task's log file is rotated, in bytes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub log_bytes: Option<u64>,
    /// Largest total size of the output files of a run, in bytes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub output_bytes: Option<u64>,
    /// Memory limit of a build, in bytes; without control groups, of each of its processes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub build_memory_bytes: Option<u64>,
    /// Time limit of a build in seconds, 1 to 86,400.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub build_timeout_s: Option<u64>,
    /// Number of versions prepared at the same time, 1 to 64.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub parallel_tasks: Option<u64>,
    /// Memory limit, in MiB, of a task whose package sets none, 1 to 16,777,216; absent: all of the
    /// robot's memory.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub task_memory_mb: Option<u64>,
    /// Limit of processes and threads of a task whose package sets none, and of a build, 1 to
    /// 4,194,304.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub task_pids: Option<u64>,
}

/// Settings in effect on a robot. An absent value is the agent's default.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct EffectiveSettings {
    /// The values in effect.
    #[serde(flatten)]
    pub values: RobotSettings,
    /// Keys of the settings (`underlays`, `limits.log_bytes`) whose values come from the robot's
    /// own configuration: setting them on the server has no effect.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub own: Vec<String>,
    /// Keys of the server's settings that the robot refused: its own settings forbid the change, or
    /// the value is unusable.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub refused: Vec<String>,
}

/// A setting with an unusable value, named by its key.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum InvalidSetting {
    /// A number out of its bounds.
    #[error("{key}: {value} is not between {least} and {most}")]
    OutOfBounds {
        /// The setting's key.
        key: &'static str,
        /// The given value.
        value: u64,
        /// The least allowed value.
        least: u64,
        /// The greatest allowed value.
        most: u64,
    },
    /// Too many setup files.
    #[error("underlays: {0} setup files are more than {MAX_UNDERLAYS}")]
    TooManyUnderlays(usize),
}

impl InvalidSetting {
    /// The setting's key.
    pub fn key(&self) -> &'static str {
        match self {
            Self::OutOfBounds { key, .. } => key,
            Self::TooManyUnderlays(_) => "underlays",
        }
    }
}

impl RobotSettings {
    /// Whether a setting with this key exists, like `workspace` or `limits.log_bytes`.
    pub fn has(key: &str) -> bool {
        ["underlays", "workspace", "ros_domain_id", "forward_level"].contains(&key)
            || RobotLimits::default().bounds().iter().any(|(known, ..)| *known == key)
    }

    /// Whether no setting is set.
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }

    /// Checks every value against its bounds, which are the agent's.
    pub fn check(&self) -> Result<(), InvalidSetting> {
        self.invalid_settings().into_iter().next().map_or(Ok(()), Err)
    }

    /// The settings with unusable values.
    pub fn invalid_settings(&self) -> Vec<InvalidSetting> {
        let underlays = self.underlays.as_ref().map_or(0, Vec::len);
        let too_many =
            (underlays > MAX_UNDERLAYS).then_some(InvalidSetting::TooManyUnderlays(underlays));
        let domain_id = self.ros_domain_id.map(u64::from);
        let domain_id = [("ros_domain_id", domain_id, 0, u64::from(MAX_ROS_DOMAIN_ID))];
        let bounds = domain_id.into_iter().chain(self.limits.bounds());
        let out_of_bounds = bounds.filter_map(|(key, value, least, most)| {
            let value = value.filter(|value| *value < least || *value > most)?;
            Some(InvalidSetting::OutOfBounds { key, value, least, most })
        });
        too_many.into_iter().chain(out_of_bounds).collect()
    }

    /// Returns the usable settings, and the keys of the removed ones.
    #[must_use]
    pub fn usable(mut self) -> (Self, Vec<String>) {
        let mut unusable = std::mem::take(&mut self.unreadable);
        for fault in self.invalid_settings() {
            let key = fault.key();
            match key {
                "underlays" => self.underlays = None,
                "ros_domain_id" => self.ros_domain_id = None,
                limit => self.limits.clear(limit),
            }
            unusable.push(key.to_owned());
        }
        (self, unusable)
    }
}

impl RobotLimits {
    /// Whether no limit is set.
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }

    /// These limits, with `other` as the fallback for absent ones.
    #[must_use]
    pub fn or(self, other: Self) -> Self {
        Self {
            archive_bytes: self.archive_bytes.or(other.archive_bytes),
            archive_entries: self.archive_entries.or(other.archive_entries),
            disk_reserve_bytes: self.disk_reserve_bytes.or(other.disk_reserve_bytes),
            log_bytes: self.log_bytes.or(other.log_bytes),
            output_bytes: self.output_bytes.or(other.output_bytes),
            build_memory_bytes: self.build_memory_bytes.or(other.build_memory_bytes),
            build_timeout_s: self.build_timeout_s.or(other.build_timeout_s),
            parallel_tasks: self.parallel_tasks.or(other.parallel_tasks),
            task_memory_mb: self.task_memory_mb.or(other.task_memory_mb),
            task_pids: self.task_pids.or(other.task_pids),
        }
    }

    /// Clears the limit with this key.
    fn clear(&mut self, key: &str) {
        let limit = match key {
            "limits.archive_bytes" => &mut self.archive_bytes,
            "limits.archive_entries" => &mut self.archive_entries,
            "limits.disk_reserve_bytes" => &mut self.disk_reserve_bytes,
            "limits.log_bytes" => &mut self.log_bytes,
            "limits.output_bytes" => &mut self.output_bytes,
            "limits.build_memory_bytes" => &mut self.build_memory_bytes,
            "limits.build_timeout_s" => &mut self.build_timeout_s,
            "limits.parallel_tasks" => &mut self.parallel_tasks,
            "limits.task_memory_mb" => &mut self.task_memory_mb,
            "limits.task_pids" => &mut self.task_pids,
            _ => return,
        };
        *limit = None;
    }

    /// Each limit with its key, its value, and its least and greatest allowed value.
    pub fn bounds(&self) -> [(&'static str, Option<u64>, u64, u64); 10] {
        // Fits a signed 64-bit column and the number types of all common programs.
        const MAX_BYTES: u64 = 1 << 50;
        [
            ("limits.archive_bytes", self.archive_bytes, 1, MAX_BYTES),
            ("limits.archive_entries", self.archive_entries, 1, 1 << 32),
            ("limits.disk_reserve_bytes", self.disk_reserve_bytes, 0, MAX_BYTES),
            ("limits.log_bytes", self.log_bytes, 4096, MAX_BYTES),
            ("limits.output_bytes", self.output_bytes, 0, MAX_BYTES),
            ("limits.build_memory_bytes", self.build_memory_bytes, 1 << 20, MAX_BYTES),
            ("limits.build_timeout_s", self.build_timeout_s, 1, 86_400),
            ("limits.parallel_tasks", self.parallel_tasks, 1, 64),
            ("limits.task_memory_mb", self.task_memory_mb, 1, 1 << 24),
            ("limits.task_pids", self.task_pids, 1, 1 << 22),
        ]
    }
}

/// Reads the settings that this version knows, and records the keys of the others. An unreadable
/// setting must not make a state, or another setting, unreadable.
pub(crate) fn read_known_settings<'de, D: Deserializer<'de>>(
    deserializer: D,
) -> Result<RobotSettings, D::Error> {
    let Value::Object(mut values) = Value::deserialize(deserializer)? else {
        return Ok(RobotSettings::default());
    };
    let mut unreadable = Vec::new();
    let mut keep = |key: String, alone: Value| {
        let is_readable = serde_json::from_value::<RobotSettings>(alone).is_ok();
        if !is_readable {
            unreadable.push(key);
        }
        is_readable
    };
    if let Some(Value::Object(limits)) = values.get_mut("limits") {
        limits.retain(|key, value| {
            keep(format!("limits.{key}"), json!({ "limits": { key: value } }))
        });
    }
    values.retain(|key, value| keep(key.clone(), json!({ key: value })));
    let read: RobotSettings = serde_json::from_value(Value::Object(values)).unwrap_or_default();
    Ok(RobotSettings { unreadable, ..read })
}

/// Reads a value, and ignores one that this version can't read: an informational field must not
/// make a report unreadable.
pub(crate) fn default_if_unreadable<'de, D: Deserializer<'de>, T: DeserializeOwned + Default>(
    deserializer: D,
) -> Result<T, D::Error> {
    let value = Value::deserialize(deserializer)?;
    Ok(serde_json::from_value(value).unwrap_or_default())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn value_out_of_bounds_is_named_by_its_key() {
        let check = |json: serde_json::Value| {
            serde_json::from_value::<RobotSettings>(json).expect("parses").check()
        };
        let said = |json| check(json).expect_err("refused").to_string();
        assert_eq!(
            check(serde_json::json!({"ros_domain_id": 232, "limits": {"parallel_tasks": 64}})),
            Ok(())
        );
        assert_eq!(
            said(serde_json::json!({"ros_domain_id": 233})),
            "ros_domain_id: 233 is not between 0 and 232"
        );
        let none = serde_json::json!({"limits": {"parallel_tasks": 0}});
        assert_eq!(said(none), "limits.parallel_tasks: 0 is not between 1 and 64");
        let many = serde_json::json!({"underlays": vec!["/opt/ros/jazzy"; MAX_UNDERLAYS + 1]});
        assert_eq!(said(many), "underlays: 17 setup files are more than 16");
    }

    #[test]
    fn unusable_settings_leave_the_others() {
        let limits = json!({
            "archive_bytes": 0, "archive_entries": 0, "disk_reserve_bytes": u64::MAX,
            "log_bytes": 1, "output_bytes": u64::MAX, "build_memory_bytes": 1,
            "build_timeout_s": 0, "parallel_tasks": 65, "task_memory_mb": 0, "task_pids": 0,
        });
        let underlays = vec!["/setup.bash"; MAX_UNDERLAYS + 1];
        let all = json!({
            "underlays": underlays, "workspace": "/ws", "ros_domain_id": 233, "limits": limits,
        });
        let (left, unusable) =
            serde_json::from_value::<RobotSettings>(all).expect("parses").usable();
        assert_eq!(left, serde_json::from_value(json!({"workspace": "/ws"})).expect("parses"));
        assert_eq!(unusable.len(), 12, "{unusable:?}");
    }

    #[test]
    fn only_clean_absolute_paths_are_read() {
        let read = |path: &str| {
            serde_json::from_value::<RobotSettings>(serde_json::json!({"workspace": path})).is_ok()
        };
        assert!(read("/home/robot/my ws"));
        for bad in
            ["", "ws", "~/ws", "$HOME/ws", "/ws/../etc", "/ws/.", "/a\nb", "/a\u{0}", "/a\u{202e}b"]
        {
            assert!(!read(bad), "{bad:?}");
        }
    }
}
