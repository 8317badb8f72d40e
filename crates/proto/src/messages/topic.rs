//! MQTT topics, typed both ways. All lie below one configurable prefix, by default `taskd/v1`.
//!
//! ```
//! use task_proto::messages::topic::{RobotTopic, Topic, TopicPrefix};
//! let prefix = TopicPrefix::default();
//! let robot: task_proto::RobotId = "r00000000000000a1".parse().unwrap();
//! let topic = Topic::Robot(robot, RobotTopic::Desired);
//! assert_eq!(prefix.format(&topic), "taskd/v1/r/r00000000000000a1/desired");
//! assert_eq!(prefix.parse("taskd/v1/r/r00000000000000a1/desired"), Some(topic));
//! assert_eq!(prefix.parse("taskd/v1/r/+/desired"), None);
//! ```

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::{Digest, RobotId};

/// The prefix of all topics: no leading or trailing `/`, no wildcard, at most 64 bytes.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(
    feature = "openapi",
    derive(utoipa::ToSchema),
    schema(
        value_type = String,
        pattern = "^[A-Za-z0-9._-]+(/[A-Za-z0-9._-]+)*$",
        example = "tasks"
    )
)]
#[serde(try_from = "String", into = "String")]
pub struct TopicPrefix(String);

/// A prefix that MQTT or our parser does not accept.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "{0:?} is not a topic prefix: \
     1 to 64 letters, digits, '.', '_' and '-' in levels joined by single '/'"
)]
pub struct InvalidPrefix(String);

/// The subject of a topic.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Topic {
    /// One robot's own topic.
    Robot(RobotId, RobotTopic),
    /// A package's bytes, for direct-push.
    Package(Digest),
}

/// The last level of a robot's topic.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum RobotTopic {
    /// Server to robot: a [`crate::desired::DesiredNotice`].
    Desired,
    /// Robot to server: a [`crate::messages::report::Report`].
    Report,
    /// Robot to server: a [`crate::messages::report::Status`]; its last will as well.
    Status,
    /// Robot to server: a [`crate::telemetry::vitals::Telemetry`].
    Telemetry,
    /// Robot to server: a [`crate::telemetry::log::LogBatch`].
    Log,
    /// Server to robot: a question or a one-off action.
    Request,
    /// Robot to server: the answer to a request.
    Reply,
}

impl RobotTopic {
    /// Every robot topic.
    pub const ALL: [Self; 7] = [
        Self::Desired,
        Self::Report,
        Self::Status,
        Self::Telemetry,
        Self::Log,
        Self::Request,
        Self::Reply,
    ];

    /// The level's text.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Desired => "desired",
            Self::Report => "report",
            Self::Status => "status",
            Self::Telemetry => "telemetry",
            Self::Log => "log",
            Self::Request => "request",
            Self::Reply => "reply",
        }
    }

    /// Whether the robot publishes here; it may subscribe to the others.
    pub fn is_from_robot(self) -> bool {
        !matches!(self, Self::Desired | Self::Request)
    }
}

impl TopicPrefix {
    /// The prefix as text.
    pub fn as_str(&self) -> &str {
        &self.0
    }

    /// The full name of a topic.
    pub fn format(&self, topic: &Topic) -> String {
        match topic {
            Topic::Robot(robot, topic) => format!("{}/r/{robot}/{}", self.0, topic.as_str()),
            Topic::Package(digest) => format!("{}/p/{digest}", self.0),
        }
    }

    /// Parses a topic name or filter; `None` for foreign names and for wildcards.
    pub fn parse(&self, name: &str) -> Option<Topic> {
        let rest = name.strip_prefix(&self.0)?.strip_prefix('/')?;
        if let Some(digest) = rest.strip_prefix("p/") {
            return digest.parse().ok().map(Topic::Package);
        }
        let (robot, last) = rest.strip_prefix("r/")?.split_once('/')?;
        let topic = RobotTopic::ALL.into_iter().find(|t| t.as_str() == last)?;
        Some(Topic::Robot(robot.parse().ok()?, topic))
    }
}

impl Default for TopicPrefix {
    fn default() -> Self {
        Self("taskd/v1".to_owned())
    }
}

impl FromStr for TopicPrefix {
    type Err = InvalidPrefix;
    fn from_str(text: &str) -> Result<Self, InvalidPrefix> {
        let level_ok = |level: &str| {
            !level.is_empty()
                && level
                    .bytes()
                    .all(|b| b.is_ascii_alphanumeric() || matches!(b, b'.' | b'_' | b'-'))
        };
        if text.len() <= 64 && text.split('/').all(level_ok) {
            Ok(Self(text.to_owned()))
        } else {
            Err(InvalidPrefix(text.chars().take(80).collect()))
        }
    }
}

crate::ids::serde_by_text!(TopicPrefix, InvalidPrefix);

impl fmt::Display for TopicPrefix {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_topic_parses_back() {
        let prefix: TopicPrefix = "acme/fleet".parse().expect("valid");
        let robot = RobotId::random();
        for last in RobotTopic::ALL {
            let topic = Topic::Robot(robot.clone(), last);
            assert_eq!(prefix.parse(&prefix.format(&topic)), Some(topic));
        }
        let topic = Topic::Package(Digest::of(b"x"));
        assert_eq!(prefix.parse(&prefix.format(&topic)), Some(topic));
    }

    #[test]
    fn foreign_names_and_bad_prefixes_are_refused() {
        let prefix = TopicPrefix::default();
        for name in [
            "",
            "#",
            "taskd/v1",
            "taskd/v1/",
            "taskd/v1x/r/r00000000000000a1/log",
            "taskd/v1/r/r00000000000000a1/log/x",
            "taskd/v1/r/#",
        ] {
            assert_eq!(prefix.parse(name), None, "{name}");
        }
        for bad in ["", "/a", "a/", "a//b", "a/+", "#", "$SYS"] {
            assert!(bad.parse::<TopicPrefix>().is_err(), "{bad}");
        }
    }
}
