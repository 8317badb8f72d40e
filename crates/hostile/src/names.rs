//! Short texts that people and robots type or send: names, digests, addresses, selectors, tokens.

use std::fmt::{Debug, Display};
use std::str::FromStr;

use task_proto::ids::selector::Selector;
use task_proto::ids::{GraphName, LabelKey, LabelValue, Labels, OutputPath, RequestId};
use task_proto::messages::topic::TopicPrefix;
use task_proto::trust::token::Token;
use task_proto::{
    DeploymentId, Digest, InstanceId, MacAddress, RepositoryName, RobotId, RobotName, Tag,
    TaskName, TokenId, UserName, Version,
};

/// Every type of name: an accepted name is written as it was read and has no control character. A
/// name that becomes a file name is one component other than `.` or `..`.
pub fn names(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else { return };
    let file_names = [
        exact::<RobotId>(text),
        exact::<DeploymentId>(text),
        exact::<InstanceId>(text),
        exact::<RequestId>(text),
        exact::<TaskName>(text),
        exact::<Version>(text),
        exact::<Tag>(text),
        exact::<RobotName>(text),
        exact::<UserName>(text),
        exact::<TokenId>(text),
        exact::<Digest>(text),
    ];
    if file_names.contains(&true) {
        assert!(!text.contains('/') && text != "." && text != "..", "{text:?} is no file's name");
    }
    exact::<GraphName>(text);
    exact::<LabelKey>(text);
    exact::<LabelValue>(text);
    exact::<TopicPrefix>(text);
    if exact::<RepositoryName>(text) | exact::<OutputPath>(text) {
        assert!(
            text.split('/').all(|name| !matches!(name, "" | "." | "..")),
            "{text:?} leaves its directory"
        );
    }
    if let Ok(address) = text.parse::<MacAddress>() {
        assert_eq!(address.to_string().parse(), Ok(address));
    }
}

/// Whether `text` parses as a `T`, which then must print as it was read and be safe in a log line.
fn exact<T: FromStr + Display>(text: &str) -> bool {
    let Ok(name) = text.parse::<T>() else { return false };
    assert_eq!(name.to_string(), text);
    assert!(!text.contains(char::is_control), "{text:?} has a control character");
    true
}

/// A selector: written and read again, it matches the same robots.
pub fn selector(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else { return };
    let Some(selector) = round_trip::<Selector>(text) else { return };
    let again: Selector = selector.to_string().parse().expect("a selector that was written");
    let id: RobotId = "r00000000000000a1".parse().expect("valid");
    for (name, labels) in
        [("spare-1", ""), ("atlas", "site=lab"), ("r2", "site=lab,base=turtlebot")]
    {
        let labels: Labels = labels
            .split(',')
            .filter_map(|label| label.split_once('='))
            .map(|(key, value)| (key.parse().expect("valid"), value.parse().expect("valid")))
            .collect();
        let name = name.parse().expect("valid");
        assert_eq!(selector.matches(&id, &name, &labels), again.matches(&id, &name, &labels));
    }
}

/// A token: its text reads back the same, and its secret shows nowhere else. We try the bytes as
/// they are, and with the checksum that they would need.
pub fn token(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else { return };
    let checksummed = format!("{text}_{:08x}", crc32fast::hash(text.as_bytes()));
    for text in [text, &checksummed] {
        let Ok(token) = text.parse::<Token>() else { continue };
        assert_eq!(token.reveal(), text.trim());
        assert_eq!(token.reveal().parse(), Ok(token.clone()));
        let secret = text.split('_').nth(2).expect("a secret");
        assert!(!format!("{token:?}").contains(secret), "a secret is shown");
    }
}

fn round_trip<T: FromStr + Display + PartialEq + Debug>(text: &str) -> Option<T> {
    let read: T = text.parse().ok()?;
    assert_eq!(read.to_string().parse::<T>().ok().as_ref(), Some(&read));
    Some(read)
}
