//! The environment that builds and tasks start with: a short explicit list, and no other variables
//! of the agent's own. Variables that the agent was started with (tokens, a virtual environment,
//! `_ROS_WHEELS_BOOTSTRAP_COMPLETE`) never reach a task.

use std::collections::BTreeMap;

use task_proto::desired::RobotDescription;
use task_proto::ids::LabelKey;
use task_proto::messages::report::RosFacts;
use task_proto::{DeploymentId, RobotId, RobotName, TaskName, Version};

use crate::setup::installation::{Installation, RosVersion};

/// Variables passed on from the agent, with a default where the agent has none.
const INHERITED: [(&str, Option<&str>); 6] = [
    ("PATH", Some("/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin")),
    ("HOME", Some("/")),
    ("LANG", Some("C.UTF-8")),
    ("USER", None),
    ("LOGNAME", None),
    ("TZ", None),
];

/// Variables that control discovery and transport of the robot's nodes; tasks get the agent's
/// values, where it has them. `ROS_DOMAIN_ID` is not among them: it is a setting, with the agent's
/// variable as the default.
pub const ROS_VARIABLES: [&str; 20] = [
    "ROS_AUTOMATIC_DISCOVERY_RANGE",
    "ROS_STATIC_PEERS",
    "ROS_LOCALHOST_ONLY",
    "RMW_IMPLEMENTATION",
    "CYCLONEDDS_URI",
    "FASTRTPS_DEFAULT_PROFILES_FILE",
    "FASTDDS_DEFAULT_PROFILES_FILE",
    "FASTDDS_BUILTIN_TRANSPORTS",
    "RMW_FASTRTPS_USE_QOS_FROM_XML",
    "ROS_DISCOVERY_SERVER",
    "ROS_SUPER_CLIENT",
    "ROS_SECURITY_ENABLE",
    "ROS_SECURITY_STRATEGY",
    "ROS_SECURITY_KEYSTORE",
    "ROS_SECURITY_ENCLAVE_OVERRIDE",
    "ZENOH_ROUTER_CONFIG_URI",
    "ZENOH_SESSION_CONFIG_URI",
    "ROS_MASTER_URI",
    "ROS_IP",
    "ROS_HOSTNAME",
];

/// The variables of `run_env` that decide which ROS graph the task's nodes join. The agent must
/// know them to find the nodes.
pub fn graph_variables(
    run_env: &BTreeMap<String, String>,
) -> impl Iterator<Item = (String, String)> {
    let of_graph = |name: &str| name == "ROS_DOMAIN_ID" || ROS_VARIABLES.contains(&name);
    let pairs = run_env.iter().filter(move |(name, _)| of_graph(name));
    pairs.map(|(name, value)| (name.clone(), value.clone()))
}

/// The variables that name the robot. A server of an earlier version does not send the robot's
/// name; its id stands in.
pub fn robot_variables(id: &RobotId, robot: &RobotDescription) -> BTreeMap<String, String> {
    let mut variables = BTreeMap::new();
    // Of several keys with the same variable, the first in the order of their bytes counts.
    for (key, value) in &robot.labels {
        variables.entry(label_variable(key)).or_insert_with(|| value.to_string());
    }
    let name = robot.name.as_ref().map_or(id.as_str(), RobotName::as_str);
    variables.insert("TASKD_ROBOT".to_owned(), name.to_owned());
    variables.insert("TASKD_ROBOT_ID".to_owned(), id.to_string());
    variables
}

fn label_variable(key: &LabelKey) -> String {
    let plain = |c: char| if c.is_ascii_alphanumeric() { c.to_ascii_uppercase() } else { '_' };
    format!("TASKD_LABEL_{}", key.as_str().chars().map(plain).collect::<String>())
}

/// The variables that name a task and its order.
pub fn task_variables(
    task: &TaskName,
    version: &Version,
    deployment: &DeploymentId,
) -> [(String, String); 3] {
    [
        ("TASKD_TASK".to_owned(), task.to_string()),
        ("TASKD_VERSION".to_owned(), version.to_string()),
        ("TASKD_DEPLOYMENT".to_owned(), deployment.to_string()),
    ]
}

/// The discovery method of nodes with this environment, if the agent can't take part in it.
pub fn unsupported_discovery(environment: &BTreeMap<String, String>) -> Option<&'static str> {
    let value = |name| environment.get(name).map(String::as_str).filter(|value| !value.is_empty());
    match (value("RMW_IMPLEMENTATION"), value("ROS_DISCOVERY_SERVER")) {
        (Some("rmw_zenoh_cpp"), _) => Some("Zenoh"),
        (_, Some(_)) => Some("a discovery server (ROS_DISCOVERY_SERVER)"),
        _ => None,
    }
}

/// The environment from the robot's settings (`ROS_DOMAIN_ID` and the like, which take precedence)
/// and from the values in `inherited` of the few variables that every program expects.
pub fn task_environment(
    settings: &BTreeMap<String, String>,
    inherited: impl Fn(&str) -> Option<String>,
) -> BTreeMap<String, String> {
    let inherited_values = INHERITED.into_iter().filter_map(|(name, default)| {
        let value =
            inherited(name).filter(|value| !value.is_empty()).or(default.map(str::to_owned))?;
        Some((name.to_owned(), value))
    });
    let mut environment: BTreeMap<_, _> = inherited_values.collect();
    // Otherwise Python holds a task's lines back until a buffer is full, and the log of a killed
    // task misses its end.
    environment.insert("PYTHONUNBUFFERED".to_owned(), "1".to_owned());
    environment.extend(settings.clone());
    environment
}

/// [`task_environment`] with this process's own variables.
pub fn robot_environment(settings: &BTreeMap<String, String>) -> BTreeMap<String, String> {
    task_environment(settings, |name| std::env::var(name).ok())
}

/// The ROS setup of tasks without special needs: the best of `installations` under their
/// `environment`. `None` where there is no ROS.
pub fn ros_facts(
    installations: &[Installation],
    environment: &BTreeMap<String, String>,
) -> Option<RosFacts> {
    let best = installations.last()?;
    let variable =
        |name: &str| environment.get(name).map(String::as_str).filter(|value| !value.is_empty());
    let distro = best.distros.last().map_or("unknown", String::as_str).to_owned();
    if best.versions == [RosVersion::Ros1] {
        let own = variable("ROS_HOSTNAME").or(variable("ROS_IP"));
        let localhost_only = own
            .is_some_and(|name| name == "localhost" || name.starts_with("127.") || name == "::1");
        return Some(RosFacts { distro, rmw: None, domain_id: None, localhost_only });
    }
    let default = if distro == "galactic" { "rmw_cyclonedds_cpp" } else { "rmw_fastrtps_cpp" };
    let rmw = best.rmw.as_deref().or(variable("RMW_IMPLEMENTATION")).unwrap_or(default).to_owned();
    let domain_id = variable("ROS_DOMAIN_ID").and_then(|id| id.parse().ok()).unwrap_or(0);
    let localhost_only = variable("ROS_LOCALHOST_ONLY") == Some("1")
        || matches!(variable("ROS_AUTOMATIC_DISCOVERY_RANGE"), Some("LOCALHOST" | "OFF"));
    Some(RosFacts { distro, rmw: Some(rmw), domain_id: Some(domain_id), localhost_only })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ros_facts_follow_the_installations_and_the_environment() {
        let environment = |pairs: &[(&str, &str)]| {
            pairs
                .iter()
                .map(|(name, value)| ((*name).to_owned(), (*value).to_owned()))
                .collect::<BTreeMap<_, _>>()
        };
        assert_eq!(ros_facts(&[], &environment(&[])), None);
        assert_eq!(
            unsupported_discovery(&environment(&[
                ("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp"),
                ("ROS_DISCOVERY_SERVER", "")
            ])),
            None
        );
        assert_eq!(
            unsupported_discovery(&environment(&[("RMW_IMPLEMENTATION", "rmw_zenoh_cpp")])),
            Some("Zenoh")
        );
        assert!(
            unsupported_discovery(&environment(&[("ROS_DISCOVERY_SERVER", "10.0.0.1:11811")]))
                .is_some()
        );
        let installation = |distro: &str, version| Installation {
            distros: vec![distro.to_owned()],
            versions: vec![version],
            ..Installation::default()
        };
        let facts = |distro: &str, rmw: Option<&str>, domain_id, localhost_only| {
            Some(RosFacts {
                distro: distro.to_owned(),
                rmw: rmw.map(str::to_owned),
                domain_id,
                localhost_only,
            })
        };
        let all =
            [installation("noetic", RosVersion::Ros1), installation("humble", RosVersion::Ros2)];
        assert_eq!(
            ros_facts(&all, &environment(&[])),
            facts("humble", Some("rmw_fastrtps_cpp"), Some(0), false)
        );
        let given = [
            ("ROS_DOMAIN_ID", "7"),
            ("ROS_LOCALHOST_ONLY", "1"),
            ("RMW_IMPLEMENTATION", "rmw_cyclonedds_cpp"),
        ];
        assert_eq!(
            ros_facts(&all, &environment(&given)),
            facts("humble", Some("rmw_cyclonedds_cpp"), Some(7), true)
        );
        let given = environment(&[("ROS_IP", "127.0.0.1"), ("ROS_DOMAIN_ID", "7")]);
        assert_eq!(ros_facts(&all[..1], &given), facts("noetic", None, None, true));
    }

    #[test]
    fn label_variables_are_upper_case_and_the_first_of_equal_ones_counts() {
        let id: RobotId = "r0123456789abcdef".parse().expect("valid");
        let labels = [("site", "lab"), ("rack.no-1", "b"), ("rack-no.1", "a"), ("Rack_no_1", "c")];
        let labels = labels
            .map(|(key, value)| (key.parse().expect("a key"), value.parse().expect("a value")));
        let mut robot = RobotDescription { name: None, labels: labels.into() };
        let expected = |name: &str| {
            let pairs = [
                ("TASKD_LABEL_RACK_NO_1", "c"),
                ("TASKD_LABEL_SITE", "lab"),
                ("TASKD_ROBOT", name),
                ("TASKD_ROBOT_ID", "r0123456789abcdef"),
            ];
            BTreeMap::from(pairs.map(|(name, value)| (name.to_owned(), value.to_owned())))
        };
        assert_eq!(robot_variables(&id, &robot), expected("r0123456789abcdef"));
        robot.name = Some("atlas".parse().expect("valid"));
        assert_eq!(robot_variables(&id, &robot), expected("atlas"));
    }

    #[test]
    fn only_listed_variables_are_inherited_and_settings_win() {
        let settings = BTreeMap::from([
            ("ROS_DOMAIN_ID".to_owned(), "7".to_owned()),
            ("TZ".to_owned(), "UTC".to_owned()),
        ]);
        let environment = task_environment(&settings, |name| match name {
            "HOME" => Some("/home/robot".to_owned()),
            "LANG" => Some(String::new()),
            "TZ" => Some("CET".to_owned()),
            _ => None,
        });
        let names: Vec<_> = environment.keys().map(String::as_str).collect();
        assert_eq!(names, ["HOME", "LANG", "PATH", "PYTHONUNBUFFERED", "ROS_DOMAIN_ID", "TZ"]);
        assert_eq!(
            (&*environment["HOME"], &*environment["LANG"], &*environment["TZ"]),
            ("/home/robot", "C.UTF-8", "UTC")
        );
    }
}
