//! A robot's settings as the server may hold them: the same that its own property file has for how
//! tasks meet ROS and what they may use. Where both say something, the robot's own holds, for
//! whoever set it stands next to the robot.

use serde::de::DeserializeOwned;
use serde::{Deserialize, Deserializer, Serialize};
use serde_json::{Value, json};

use crate::id::AbsolutePath;
use crate::log::LogLevel;

/// The most setup files of a robot.
pub const MAX_UNDERLAYS: usize = 16;
/// ROS 2's last domain whose ports exist everywhere.
pub const MAX_ROS_DOMAIN_ID: u32 = 232;

/// What an administrator sets for a robot at the server. What is absent is the robot's own
/// business.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct RobotSettings {
    /// Setup files that are sourced before a task is built or run, in this order, instead of what
    /// is found in `/opt/ros`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub underlays: Option<Vec<AbsolutePath>>,
    /// The robot's own ROS workspace, whose `install/` or `devel/` setup file is sourced after the
    /// underlays.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub workspace: Option<AbsolutePath>,
    /// `ROS_DOMAIN_ID` of every task, 0 to 232.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ros_domain_id: Option<u32>,
    /// What tasks may use.
    #[serde(skip_serializing_if = "RobotLimits::is_empty")]
    pub limits: RobotLimits,
    /// The least serious log lines that go to the server while nobody follows.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub forward_level: Option<LogLevel>,
    /// The keys of what is set and could not be read, because the server that set it is of another
    /// version.
    #[serde(skip)]
    pub unreadable: Vec<String>,
}

/// What tasks on a robot may use, by the names of the robot's property file.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct RobotLimits {
    /// Bytes a package may have when it is unpacked.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub archive_bytes: Option<u64>,
    /// Files, directories and links a package may have.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub archive_entries: Option<u64>,
    /// Bytes that stay free on the disk.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub disk_reserve_bytes: Option<u64>,
    /// Bytes of a task's log file before it is rotated.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub log_bytes: Option<u64>,
    /// Bytes of files that a run may bring back.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub output_bytes: Option<u64>,
    /// Memory that a build may have; each of its processes, where there are no control groups.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub build_memory_bytes: Option<u64>,
    /// Seconds a build may take, 1 to 86,400.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub build_timeout_s: Option<u64>,
    /// Versions that are prepared at the same time, 1 to 64.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub parallel_tasks: Option<u64>,
    /// Memory of a task whose package says nothing of it, in MiB, 1 to 16,777,216; absent: all
    /// there is.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub task_memory_mb: Option<u64>,
    /// Processes and threads of such a task, and of a build, 1 to 4,194,304.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub task_pids: Option<u64>,
}

/// What holds on a robot, of all that [`RobotSettings`] has. What is absent is the agent's default.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct EffectiveSettings {
    /// The values that hold.
    #[serde(flatten)]
    pub values: RobotSettings,
    /// The settings, by their keys (`underlays`, `limits.log_bytes`), whose values are the robot's
    /// own: setting them at the server changes nothing.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub own: Vec<String>,
    /// Those that the server has set and the robot does not take: its own settings do not allow it,
    /// or it can't use the value.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub refused: Vec<String>,
}

/// A setting that can't be used; names it by its key.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum InvalidSetting {
    /// A number out of its bounds.
    #[error("{key}: {value} is not between {least} and {most}")]
    OutOfBounds {
        /// Which.
        key: &'static str,
        /// What was given.
        value: u64,
        /// The least it may be.
        least: u64,
        /// The most.
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
    /// Whether there is a setting of this key, like `workspace` or `limits.log_bytes`.
    pub fn has(key: &str) -> bool {
        ["underlays", "workspace", "ros_domain_id", "forward_level"].contains(&key)
            || RobotLimits::default().bounds().iter().any(|(known, ..)| *known == key)
    }

    /// Whether nothing is set.
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }

    /// Checks every value against its bounds, which are the agent's.
    pub fn check(&self) -> Result<(), InvalidSetting> {
        self.faults().into_iter().next().map_or(Ok(()), Err)
    }

    /// The values that can't be used.
    pub fn faults(&self) -> Vec<InvalidSetting> {
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

    /// The same without what can't be used, and the keys of that.
    #[must_use]
    pub fn usable(mut self) -> (Self, Vec<String>) {
        let mut unusable = std::mem::take(&mut self.unreadable);
        for fault in self.faults() {
            let key = fault.key();
            match key {
                "underlays" => self.underlays = None,
                "ros_domain_id" => self.ros_domain_id = None,
                limit => self.limits.forget(limit),
            }
            unusable.push(key.to_owned());
        }
        (self, unusable)
    }
}

impl RobotLimits {
    /// Whether none is set.
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }

    /// These, and those of `other` where these say nothing.
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

    /// Takes back the one of this key.
    fn forget(&mut self, key: &str) {
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

    /// Each with its key, its value, the least and the most it may be.
    pub fn bounds(&self) -> [(&'static str, Option<u64>, u64, u64); 10] {
        // What a signed 64-bit column and every program's numbers can hold.
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

/// Reads the settings that are of this version, and notes the keys of those that are not: they must
/// not make a state unreadable, nor each other.
pub(crate) fn each_readable<'de, D: Deserializer<'de>>(
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

/// Reads what is of this version, and passes over what is not: what is told must not make a report
/// unreadable.
pub(crate) fn tolerant<'de, D: Deserializer<'de>, T: DeserializeOwned + Default>(
    deserializer: D,
) -> Result<T, D::Error> {
    let value = Value::deserialize(deserializer)?;
    Ok(serde_json::from_value(value).unwrap_or_default())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_value_out_of_bounds_is_named_by_its_key() {
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
    fn what_can_not_be_used_leaves_the_rest() {
        let limits = json!({"archive_bytes": 0, "archive_entries": 0, "disk_reserve_bytes": u64::MAX, "log_bytes": 1,
            "output_bytes": u64::MAX, "build_memory_bytes": 1, "build_timeout_s": 0, "parallel_tasks": 65,
            "task_memory_mb": 0, "task_pids": 0});
        let underlays = vec!["/setup.bash"; MAX_UNDERLAYS + 1];
        let all = json!({"underlays": underlays, "workspace": "/ws", "ros_domain_id": 233, "limits": limits});
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
