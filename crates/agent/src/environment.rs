//! The environment that builds and tasks start with: a short explicit list, nothing else of the agent's own. What the
//! agent was started with (tokens, a virtual environment, `_ROS_WHEELS_BOOTSTRAP_COMPLETE`) never reaches a task.

use std::collections::BTreeMap;

/// Passed on from the agent, with what to use where the agent has none.
const PASSED_ON: [(&str, Option<&str>); 6] = [
    ("PATH", Some("/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin")),
    ("HOME", Some("/")),
    ("LANG", Some("C.UTF-8")),
    ("USER", None),
    ("LOGNAME", None),
    ("TZ", None),
];

/// The environment made of the robot's settings (`ROS_DOMAIN_ID` and the like, which win) and of what `inherited` says
/// about the few variables every program expects.
pub fn explicit(
    settings: &BTreeMap<String, String>,
    inherited: impl Fn(&str) -> Option<String>,
) -> BTreeMap<String, String> {
    let passed_on = PASSED_ON.into_iter().filter_map(|(name, default)| {
        let value = inherited(name).filter(|value| !value.is_empty()).or(default.map(str::to_owned))?;
        Some((name.to_owned(), value))
    });
    let mut environment: BTreeMap<_, _> = passed_on.collect();
    // Without it Python holds a task's lines back until a buffer is full, and the log of a killed task misses its end.
    environment.insert("PYTHONUNBUFFERED".to_owned(), "1".to_owned());
    environment.extend(settings.clone());
    environment
}

/// [`explicit`] with this process's own variables.
pub fn of_this_robot(settings: &BTreeMap<String, String>) -> BTreeMap<String, String> {
    explicit(settings, |name| std::env::var(name).ok())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_is_listed_passes_and_settings_win() {
        let settings =
            BTreeMap::from([("ROS_DOMAIN_ID".to_owned(), "7".to_owned()), ("TZ".to_owned(), "UTC".to_owned())]);
        let environment = explicit(&settings, |name| match name {
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
