//! Conversion between ROS names and DDS names: `/chatter` is the DDS topic `rt/chatter`, a service
//! is the pair `rq/…Request` and `rr/…Reply`, `std_msgs/msg/String` is the DDS type
//! `std_msgs::msg::dds_::String_`. Both directions, and nothing else.

use task_proto::telemetry::ros::GraphName;

/// Role of a DDS topic in ROS.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Role {
    Topic,
    /// The request topic of a service.
    Request,
    /// The answer topic of a service.
    Reply,
}

/// The DDS topic on which every participant lists its nodes. The topic has no prefix.
pub const DISCOVERY_TOPIC: &str = "ros_discovery_info";
/// DDS type of the discovery topic.
pub const DISCOVERY_TYPE: &str = "rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_";

/// The role and name of the DDS topic `dds`; `None`: the topic is not from ROS, or ROS does not
/// allow its name.
pub fn from_dds(dds: &str) -> Option<(Role, GraphName)> {
    let (prefix, rest) = dds.split_once('/')?;
    let (role, name) = match prefix {
        "rt" => (Role::Topic, rest),
        "rq" => (Role::Request, rest.strip_suffix("Request")?),
        "rr" => (Role::Reply, rest.strip_suffix("Reply")?),
        _ => return None,
    };
    Some((role, format!("/{name}").parse().ok()?))
}

/// The DDS topic of `name` in this role.
pub fn to_dds(role: Role, name: &GraphName) -> String {
    match role {
        Role::Topic => format!("rt{name}"),
        Role::Request => format!("rq{name}Request"),
        Role::Reply => format!("rr{name}Reply"),
    }
}

/// The ROS type, `package/msg/Type`, that a DDS type stands for in this role.
pub fn type_from_dds(role: Role, dds: &str) -> Option<String> {
    let (path, name) = dds.split_once("::dds_::")?;
    let (package, kind) = path.split_once("::")?;
    let name = name.strip_suffix('_')?;
    let name = match role {
        Role::Topic => name,
        Role::Request => name.strip_suffix("_Request")?,
        Role::Reply => name.strip_suffix("_Response")?,
    };
    let word = |text: &str| {
        !text.is_empty() && text.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'_')
    };
    (word(package) && word(kind) && word(name)).then(|| format!("{package}/{kind}/{name}"))
}

/// The DDS type of the ROS type `package/msg/Type` in this role.
pub fn type_to_dds(role: Role, ros: &str) -> Option<String> {
    let mut parts = ros.split('/');
    let package = parts.next()?;
    let kind = parts.next()?;
    let name = parts.next()?;
    if parts.next().is_some() {
        return None;
    }
    let suffix = match role {
        Role::Topic => "",
        Role::Request => "_Request",
        Role::Reply => "_Response",
    };
    let dds = format!("{package}::{kind}::dds_::{name}{suffix}_");
    // A type is valid only if the reverse conversion gives the same name.
    (type_from_dds(role, &dds).as_deref() == Some(ros)).then_some(dds)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_and_types_go_both_ways() {
        for (role, dds, ros) in [
            (Role::Topic, "rt/chatter", "/chatter"),
            (Role::Request, "rq/robot/talker/get_stateRequest", "/robot/talker/get_state"),
            (Role::Reply, "rr/robot/talker/get_stateReply", "/robot/talker/get_state"),
        ] {
            let (found, name) = from_dds(dds).expect(dds);
            assert_eq!((found, name.as_str()), (role, ros));
            assert_eq!(to_dds(role, &name), dds);
        }
        for (role, dds, ros) in [
            (Role::Topic, "std_msgs::msg::dds_::String_", "std_msgs/msg/String"),
            (Role::Request, "std_srvs::srv::dds_::Trigger_Request_", "std_srvs/srv/Trigger"),
            (Role::Reply, "std_srvs::srv::dds_::Trigger_Response_", "std_srvs/srv/Trigger"),
        ] {
            assert_eq!(type_from_dds(role, dds).as_deref(), Some(ros));
            assert_eq!(type_to_dds(role, ros).as_deref(), Some(dds));
        }
    }

    #[test]
    fn other_dds_names_are_not_ros_names() {
        for dds in [
            "ros_discovery_info",
            "DCPSParticipant",
            "rq/noEnd",
            "rt/",
            "rt/a b",
            "rt//x",
            "xx/chatter",
            "rt/\u{e9}",
        ] {
            assert_eq!(from_dds(dds), None, "{dds:?}");
        }
        for dds in [
            "String",
            "std_msgs::msg::String_",
            "::msg::dds_::String_",
            "a::msg::dds_::B C_",
            "a::msg::dds_::B",
        ] {
            assert_eq!(type_from_dds(Role::Topic, dds), None, "{dds:?}");
        }
        for ros in ["std_msgs/String", "std_msgs/msg/String/more", "std_msgs/msg/", "a/msg/B C"] {
            assert_eq!(type_to_dds(Role::Topic, ros), None, "{ros:?}");
        }
    }
}
