//! The `authorization` block of a NATS server: each account with a bcrypt hash of its password and
//! the subjects to which MQTT maps its topics. Subjects outside the lists are denied, including
//! NATS' own subjects (`$MQTT.>`, `$JS.>`, `$SYS.>`). Every protocol but MQTT is denied too: a NATS
//! client with a robot's password could read other robots' sessions there. There is no deny list:
//! one with `$MQTT.>` would also deny the subscriptions that NATS makes for each MQTT session.

use std::fmt::Write as _;

use task_proto::messages::topic::{RobotTopic, TopicPrefix};

use super::{Account, External, Role};
use crate::broker::CANARY_LEVEL;

/// The lowest cost that bcrypt supports: 256 bits can't be guessed.
const DERIVED_COST: u32 = 4;
/// A higher cost, because a person chose the server's own password.
const SERVER_COST: u32 = 11;
pub(super) fn authorization(
    external: &External,
    accounts: &[Account],
    prefix: &TopicPrefix,
) -> Result<String, bcrypt::BcryptError> {
    let mut text =
        "# Written by `taskd broker nats`. Holds hashes, and no password.\nauthorization {\n  users = [\n".to_owned();
    for account in accounts {
        let hash = hash(external, account)?;
        let (publish, subscribe) = subjects(account, prefix);
        // Names and subjects consist of letters, digits and a few signs: no escaping is needed.
        let _ = writeln!(
            text,
            "    {{ user: \"{}\", password: \"{hash}\", allowed_connection_types: [\"MQTT\"], permissions: {{\n      \
             publish: {{ allow: [{publish}] }}, subscribe: {{ allow: [{subscribe}] }} }} }}",
            account.user_name
        );
    }
    text.push_str("  ]\n}\n");
    Ok(text)
}

/// The salt is derived from user and password, so that the same robots make the same file.
fn hash(external: &External, account: &Account) -> Result<String, bcrypt::BcryptError> {
    let Account { user_name, password, .. } = account;
    let cost = if account.is_derived() { DERIVED_COST } else { SERVER_COST };
    let mut salt = [0; 16];
    salt.copy_from_slice(&external.derived(&format!("bcrypt salt {user_name} {password}"))[..16]);
    Ok(bcrypt::hash_with_salt(password, cost, salt)?.format_for_version(bcrypt::Version::TwoA))
}

/// The account's publish and subscribe permissions, as lists of quoted subjects.
fn subjects(account: &Account, prefix: &TopicPrefix) -> (String, String) {
    let prefix = subject(prefix.as_str());
    let list = |subjects: Vec<String>| {
        subjects.iter().map(|subject| format!("\"{subject}\"")).collect::<Vec<_>>().join(", ")
    };
    let of_robot = |robot: &str, topics: &[RobotTopic]| -> Vec<String> {
        topics.iter().map(|topic| format!("{prefix}.r.{robot}.{}", topic.as_str())).collect()
    };
    let to_robots = [RobotTopic::Desired, RobotTopic::Request];
    let from_robots =
        [RobotTopic::Status, RobotTopic::Reply, RobotTopic::Log, RobotTopic::Telemetry];
    let (parts, canary) = (format!("{prefix}.p.*"), format!("{prefix}.{CANARY_LEVEL}"));
    match account.role {
        Role::Server => {
            let (mut publish, mut subscribe) =
                (of_robot("*", &to_robots), of_robot("*", &from_robots));
            publish.extend([parts, canary.clone()]);
            subscribe.push(canary);
            (list(publish), list(subscribe))
        }
        Role::Robot => {
            let mut subscribe = of_robot(&account.user_name, &to_robots);
            subscribe.push(parts);
            (list(of_robot(&account.user_name, &from_robots)), list(subscribe))
        }
        // Without an allow list every subject would be allowed.
        Role::Probe => {
            let own = format!("{prefix}.probe.{}", account.user_name);
            (list(vec![own.clone()]), list(vec![own]))
        }
    }
}

/// A topic in NATS' mapping: a level is a token, and a dot in a level is written `//`.
fn subject(topic: &str) -> String {
    topic.replace('.', "//").replace('/', ".").replace("..", "//")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn topic_becomes_the_nats_subject() {
        assert_eq!(subject("taskd/v1"), "taskd.v1");
        assert_eq!(subject("fleet/v1.2/x"), "fleet.v1//2.x");
    }
}
