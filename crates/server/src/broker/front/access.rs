//! Topic permissions: pure functions of the client and the topic. This module never looks anything
//! up.

use task_proto::messages::topic::{RobotTopic, Topic, TopicPrefix};
use task_proto::{Digest, RobotId, UserName};

use crate::broker::router::CANARY_TOPIC;

/// The owner of a session.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Client {
    Robot { robot: RobotId, token_number: u64 },
    Operator(UserName),
    Canary,
}

/// The destination of a permitted message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Route {
    /// To the inbox before the acknowledgement, and then to all subscribers.
    Inbox(RobotTopic),
    /// Through the router whether there are subscribers or not.
    Canary,
}

/// The source of messages for a permitted subscription.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum MessageSource {
    /// The server's messages to this robot, straight from its mailbox.
    Desired,
    /// The server's requests to this robot, straight from its mailbox.
    Request,
    /// A package's parts, for permitted robots: the session checks the permission.
    Package(Digest),
    /// Messages of the router that match the filter.
    Router,
}

/// The destination of the client's message on `topic`; `None` if the client may not publish there.
/// A robot publishes on its own from-robot topics only, an operator not at all.
pub(super) fn may_publish(client: &Client, prefix: &TopicPrefix, topic: &str) -> Option<Route> {
    match client {
        Client::Canary => (topic == CANARY_TOPIC).then_some(Route::Canary),
        Client::Operator(_) => None,
        Client::Robot { robot, .. } => match prefix.parse(topic)? {
            Topic::Robot(owner, last) if owner == *robot => match last {
                RobotTopic::Report
                | RobotTopic::Status
                | RobotTopic::Reply
                | RobotTopic::Log
                | RobotTopic::Telemetry => Some(Route::Inbox(last)),
                RobotTopic::Desired | RobotTopic::Request => None,
            },
            Topic::Robot(..) | Topic::Package(_) => None,
        },
    }
}

/// The source of messages for a subscription to `filter`; `None` if the client may not subscribe. A
/// robot subscribes to its own topics by exact name, an operator to any filter whose first levels
/// are the prefix.
pub(super) fn may_subscribe(
    client: &Client,
    prefix: &TopicPrefix,
    filter: &str,
) -> Option<MessageSource> {
    match client {
        Client::Canary => (filter == CANARY_TOPIC).then_some(MessageSource::Router),
        Client::Operator(_) => filter
            .strip_prefix(prefix.as_str())
            .is_some_and(|rest| rest.starts_with('/'))
            .then_some(MessageSource::Router),
        Client::Robot { robot, .. } => match prefix.parse(filter)? {
            Topic::Robot(owner, RobotTopic::Desired) if owner == *robot => {
                Some(MessageSource::Desired)
            }
            Topic::Robot(owner, RobotTopic::Request) if owner == *robot => {
                Some(MessageSource::Request)
            }
            Topic::Package(digest) => Some(MessageSource::Package(digest)),
            Topic::Robot(..) => None,
        },
    }
}

/// Whether a valid filter matches a valid topic name, by MQTT 3.1.1 section 4.7.
pub(super) fn matches(filter: &str, topic: &str) -> bool {
    let mut levels = topic.split('/');
    for expected in filter.split('/') {
        match (expected, levels.next()) {
            ("#", _) => return true,
            (_, None) => return false,
            ("+", Some(_)) => {}
            (expected, Some(level)) if expected == level => {}
            _ => return false,
        }
    }
    levels.next().is_none()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn robot() -> Client {
        Client::Robot { robot: "r00000000000000a1".parse().expect("valid"), token_number: 0 }
    }

    fn operator() -> Client {
        Client::Operator("alice".parse().expect("valid"))
    }

    #[test]
    fn robot_publishes_on_its_own_topics_only() {
        let prefix = TopicPrefix::default();
        let route = |topic: &str| may_publish(&robot(), &prefix, topic);
        assert_eq!(
            route("taskd/v1/r/r00000000000000a1/report"),
            Some(Route::Inbox(RobotTopic::Report))
        );
        assert_eq!(route("taskd/v1/r/r00000000000000a1/log"), Some(Route::Inbox(RobotTopic::Log)));
        assert_eq!(
            route("taskd/v1/r/r00000000000000a1/telemetry"),
            Some(Route::Inbox(RobotTopic::Telemetry))
        );
        for denied in [
            "taskd/v1/r/r00000000000000a1/desired",
            "taskd/v1/r/r00000000000000a1/request",
            "taskd/v1/r/r00000000000000a2/report",
            "taskd/v1/r/r00000000000000a1/report/",
            "/taskd/v1/r/r00000000000000a1/report",
            "$SYS/x",
            "é",
            CANARY_TOPIC,
        ] {
            assert_eq!(route(denied), None, "{denied}");
        }
        assert_eq!(may_publish(&operator(), &prefix, "taskd/v1/r/r00000000000000a1/report"), None);
    }

    #[test]
    fn robot_subscribes_to_its_own_topics_only() {
        let prefix = TopicPrefix::default();
        let source = |filter: &str| may_subscribe(&robot(), &prefix, filter);
        assert_eq!(source("taskd/v1/r/r00000000000000a1/desired"), Some(MessageSource::Desired));
        assert_eq!(source("taskd/v1/r/r00000000000000a1/request"), Some(MessageSource::Request));
        let package = Digest::of(b"x");
        assert_eq!(source(&format!("taskd/v1/p/{package}")), Some(MessageSource::Package(package)));
        for denied in [
            "#",
            "+/+/+/+/+",
            "taskd/v1/#",
            "taskd/v1/r/+/desired",
            "taskd/v1/r/r00000000000000a1/#",
            "taskd/v1/r/r00000000000000a1/+",
            "taskd/v1/r/r00000000000000a1/report",
            "taskd/v1/r/r00000000000000a2/desired",
            "$share/g/taskd/v1/r/r00000000000000a1/desired",
            "taskd/v1/p/+",
            "taskd/v1/p/#",
        ] {
            assert_eq!(source(denied), None, "{denied}");
        }
    }

    #[test]
    fn operator_subscribes_below_the_prefix_only() {
        let prefix = TopicPrefix::default();
        let source = |filter: &str| may_subscribe(&operator(), &prefix, filter);
        for allowed in ["taskd/v1/#", "taskd/v1/r/+/report", "taskd/v1/r/r00000000000000a1/status"]
        {
            assert_eq!(source(allowed), Some(MessageSource::Router), "{allowed}");
        }
        for denied in [
            "#",
            "+/v1/#",
            "taskd/#",
            "taskd/+/r/#",
            "taskd/v1",
            "taskd/v10/#",
            "$SYS/#",
            CANARY_TOPIC,
        ] {
            assert_eq!(source(denied), None, "{denied}");
        }
    }

    #[test]
    fn filters_match_as_the_standard_says() {
        for (filter, topic) in [
            ("a/#", "a"),
            ("a/#", "a/b/c"),
            ("#", "a/b"),
            ("+", "a"),
            ("+/+", "/a"),
            ("/+", "/a"),
            ("a/+/c", "a//c"),
            ("a/b", "a/b"),
        ] {
            assert!(matches(filter, topic), "{filter} {topic}");
        }
        for (filter, topic) in
            [("a/+", "a"), ("+", "/a"), ("a", "a/b"), ("a/b", "a"), ("a/+", "a/b/c"), ("A", "a")]
        {
            assert!(!matches(filter, topic), "{filter} {topic}");
        }
    }
}
