//! Names and numbers that identify things: each parsed once at the edge, then passed around as its
//! own type. It never looks anything up.

use std::borrow::Borrow;
use std::collections::BTreeMap;
use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// A text that is not a valid identifier; the error names the kind and the allowed form.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{given:?} is not a valid {kind}: {expected}")]
pub struct InvalidId {
    kind: &'static str,
    given: String,
    expected: &'static str,
}

impl InvalidId {
    pub(crate) fn new(kind: &'static str, given: &str, expected: &'static str) -> Self {
        // A hostile name must not fill a log line.
        Self { kind, given: given.chars().take(80).collect(), expected }
    }
}

/// Lets serde read and write a type by its text: for `#[serde(try_from = "String", into = "String")]`.
macro_rules! serde_by_text {
    ($name:ident, $error:ident) => {
        impl TryFrom<String> for $name {
            type Error = $error;
            fn try_from(text: String) -> Result<Self, $error> {
                text.parse()
            }
        }

        impl From<$name> for String {
            fn from(value: $name) -> String {
                value.to_string()
            }
        }
    };
}
pub(crate) use serde_by_text;

/// Declares a text identifier: a newtype over `String` that only `FromStr` (and so serde) can make.
macro_rules! text_id {
    (
        $(#[$doc:meta])* $name:ident like $example:literal $pattern:literal,
        $kind:literal, $expected:literal, $valid:expr
    ) => {
        $(#[$doc])*
        #[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
        #[cfg_attr(
            feature = "openapi",
            derive(utoipa::ToSchema),
            schema(value_type = String, example = $example, pattern = $pattern)
        )]
        #[serde(try_from = "String", into = "String")]
        pub struct $name(String);

        impl $name {
            /// The identifier as text.
            pub fn as_str(&self) -> &str {
                &self.0
            }
        }

        impl FromStr for $name {
            type Err = InvalidId;
            fn from_str(text: &str) -> Result<Self, InvalidId> {
                let valid: fn(&str) -> bool = $valid;
                if !valid(text) {
                    return Err(InvalidId::new($kind, text, $expected));
                }
                Ok(Self(text.to_owned()))
            }
        }

        impl TryFrom<String> for $name {
            type Error = InvalidId;
            fn try_from(text: String) -> Result<Self, InvalidId> {
                text.parse()
            }
        }

        impl Borrow<str> for $name {
            fn borrow(&self) -> &str {
                &self.0
            }
        }

        impl From<$name> for String {
            fn from(id: $name) -> String {
                id.0
            }
        }

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str(&self.0)
            }
        }
    };
}

fn is_lower_hex(text: &str) -> bool {
    text.bytes().all(|b| b.is_ascii_digit() || (b'a'..=b'f').contains(&b))
}

fn is_prefixed_hex(text: &str, prefix: char) -> bool {
    text.len() == 17 && text.starts_with(prefix) && is_lower_hex(&text[1..])
}

fn random_hex(prefix: char) -> String {
    format!("{prefix}{:016x}", rand::random::<u64>())
}

text_id!(
    /// A robot's server-issued identity: `r` and 16 lower-case hex digits. It is also the robot's
    /// MQTT client id and user name, and is never used twice.
    RobotId like "r00000000000000a1" r"^r[0-9a-f]{16}$",
    "robot id", "the letter r and 16 lower-case hex digits", |t| is_prefixed_hex(t, 'r')
);
text_id!(
    /// An operator's order: `d` and 16 lower-case hex digits.
    DeploymentId like "d00000000000000a1" r"^d[0-9a-f]{16}$",
    "deployment id", "the letter d and 16 lower-case hex digits", |t| is_prefixed_hex(t, 'd')
);
text_id!(
    /// One start of an agent: `i` and 16 lower-case hex digits.
    InstanceId like "i00000000000000a1" r"^i[0-9a-f]{16}$",
    "instance id", "the letter i and 16 lower-case hex digits", |t| is_prefixed_hex(t, 'i')
);
text_id!(
    /// A question to a robot: `q` and 16 lower-case hex digits.
    RequestId like "q00000000000000a1" r"^q[0-9a-f]{16}$",
    "request id", "the letter q and 16 lower-case hex digits", |t| is_prefixed_hex(t, 'q')
);
text_id!(
    /// A node's, topic's or service's full name on a ROS graph, `/robot/scan`; from the ROS 2
    /// design article on names.
    GraphName like "/robot/scan" r"^(/[A-Za-z_][A-Za-z0-9_]*)+$",
    "ROS name",
    "like /robot/scan: letters, digits and '_' in parts that begin with no digit, \
     at most 255 bytes", |t| {
        let part_ok = |part: &str| {
            part.bytes().next().is_some_and(|b| b.is_ascii_alphabetic() || b == b'_')
                && part.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'_')
        };
        t.len() <= 255 && t.strip_prefix('/').is_some_and(|rest| rest.split('/').all(part_ok))
    }
);
text_id!(
    /// The name of a package and of the task it becomes on a robot. It is one component of an OCI
    /// repository name, so it is also safe as a file name.
    TaskName like "corridor_mapping" r"^[a-z0-9]+([._-][a-z0-9]+)*$",
    "package name",
    "at most 64 lower-case letters and digits, joined by single '.', '_' or '-'", |t| {
        let edge = |b: u8| b.is_ascii_lowercase() || b.is_ascii_digit();
        let bytes = t.as_bytes();
        !bytes.is_empty()
            && bytes.len() <= 64
            && edge(bytes[0])
            && edge(bytes[bytes.len() - 1])
            && bytes.windows(2).all(|w| edge(w[0]) || edge(w[1]))
            && bytes.iter().all(|&b| edge(b) || matches!(b, b'.' | b'_' | b'-'))
    }
);
text_id!(
    /// A package's version; it is used as an OCI tag.
    Version like "1.0.0" r"^[A-Za-z0-9_][A-Za-z0-9._-]{0,127}$",
    "version", "at most 128 letters, digits, '.', '_' and '-', not starting with '.' or '-'", |t| {
        is_tag(t, 128)
    }
);
text_id!(
    /// An OCI repository's name; that of a package's repository is its [`TaskName`].
    RepositoryName like "corridor_mapping"
    r"^[a-z0-9]+((\.|_|__|-+)[a-z0-9]+)*(/[a-z0-9]+((\.|_|__|-+)[a-z0-9]+)*)*$",
    "repository name",
    "at most 255 bytes of components joined by '/', each lower-case letters and digits \
     joined by one '.', one or two '_' or any number of '-'", |t| {
        t.len() <= 255 && t.split('/').all(is_repository_component)
    }
);
impl RepositoryName {
    /// The repository of a package's manifests and blobs.
    pub fn of_package(name: &TaskName) -> Self {
        Self(name.as_str().to_owned())
    }
}

text_id!(
    /// A file that came back from a task, by its path below the task's directory. It can't leave
    /// the directory it is written into.
    OutputPath like "maps/corridor.pgm" r"^[^/]+(/[^/]+)*$",
    "path of an output",
    "at most 1024 bytes of printable names, none of them '.' or '..', joined by single '/'", |t| {
        t.len() <= 1024
            && !t.chars().any(char::is_control)
            && t.split('/').all(|name| !matches!(name, "" | "." | "..") && !name.contains('\\'))
    }
);
text_id!(
    /// A name for a manifest inside its repository.
    Tag like "1.0.0" r"^[A-Za-z0-9_][A-Za-z0-9._-]{0,127}$",
    "tag", "at most 128 letters, digits, '.', '_' and '-', not starting with '.' or '-'", |t| {
        is_tag(t, 128)
    }
);
text_id!(
    /// The name people give a robot.
    RobotName like "atlas-1" r"^[A-Za-z0-9_][A-Za-z0-9._-]{0,63}$",
    "robot name", "1 to 64 letters, digits, '.', '_' and '-', not starting with '.' or '-'", |t| {
        is_tag(t, 64)
    }
);
text_id!(
    /// A user's name, for sign-in and in the audit.
    UserName like "alice" r"^[a-z0-9][a-z0-9._@-]{0,63}$",
    "user name",
    "1 to 64 lower-case letters, digits, '.', '_', '-' and '@', \
     starting with a letter or digit", |t| {
        let plain = |b: u8| b.is_ascii_lowercase() || b.is_ascii_digit();
        t.len() <= 64
            && t.bytes().next().is_some_and(plain)
            && t.bytes().all(|b| plain(b) || matches!(b, b'.' | b'_' | b'-' | b'@'))
    }
);
text_id!(
    /// The name of a server in a cluster, by default its host's.
    NodeName like "rack-1" r"^[A-Za-z0-9_][A-Za-z0-9._-]{0,63}$",
    "server name", "1 to 64 letters, digits, '.', '_' and '-', not starting with '.' or '-'", |t| {
        is_tag(t, 64)
    }
);
text_id!(
    /// A file or directory on a robot, as named by the robot's administrator.
    AbsolutePath like "/opt/ros/jazzy/setup.bash" r"^/",
    "absolute path",
    "it starts with '/', has at most 1024 bytes, no '.' or '..' between its '/', \
     and only printable characters", |t| {
        let turns = |c: char| {
            matches!(c, '\u{200e}' | '\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
        };
        t.len() <= 1024
            && t.starts_with('/')
            && !t.chars().any(|c| c.is_control() || turns(c))
            && !t.split('/').any(|name| matches!(name, "." | ".."))
    }
);
text_id!(
    /// The public part of a token, used to list and revoke the token: 12 lower-case hex digits.
    TokenId like "0123456789ab" r"^[0-9a-f]{12}$",
    "token id", "12 lower-case hex digits", |t| t.len() == 12 && is_lower_hex(t)
);
text_id!(
    /// A label's key.
    LabelKey like "site" r"^[A-Za-z0-9._/-]{1,63}$",
    "label key", "1 to 63 letters, digits, '.', '_', '/' and '-'", |t| {
        !t.is_empty() && is_label_text(t)
    }
);
text_id!(
    /// A label's value; it may be empty.
    LabelValue like "lab" r"^[A-Za-z0-9._/-]{0,63}$",
    "label value", "at most 63 letters, digits, '.', '_', '/' and '-'", is_label_text
);

/// Whether the text is an OCI tag of at most `max_bytes`.
fn is_tag(text: &str, max_bytes: usize) -> bool {
    text.len() <= max_bytes
        && text.bytes().next().is_some_and(|b| b.is_ascii_alphanumeric() || b == b'_')
        && text.bytes().all(|b| b.is_ascii_alphanumeric() || matches!(b, b'.' | b'_' | b'-'))
}

fn is_repository_component(text: &str) -> bool {
    let is_word = |b: u8| b.is_ascii_lowercase() || b.is_ascii_digit();
    let is_separator = |s: &[u8]| matches!(s, b"." | b"_" | b"__") || s.iter().all(|&b| b == b'-');
    let bytes = text.as_bytes();
    bytes.first().is_some_and(|&b| is_word(b))
        && bytes.last().is_some_and(|&b| is_word(b))
        && bytes
            .chunk_by(|&a, &b| is_word(a) == is_word(b))
            .all(|run| is_word(run[0]) || is_separator(run))
}

fn is_label_text(text: &str) -> bool {
    text.len() <= 63
        && text.bytes().all(|b| b.is_ascii_alphanumeric() || matches!(b, b'.' | b'_' | b'/' | b'-'))
}

/// A robot's labels, sorted by key.
pub type Labels = BTreeMap<LabelKey, LabelValue>;

impl RobotId {
    /// A fresh id from the thread's random generator.
    pub fn random() -> Self {
        Self(random_hex('r'))
    }
}

impl DeploymentId {
    /// A fresh id from the thread's random generator.
    pub fn random() -> Self {
        Self(random_hex('d'))
    }
}

impl RequestId {
    /// A fresh id from the thread's random generator.
    pub fn random() -> Self {
        Self(random_hex('q'))
    }
}

impl InstanceId {
    /// A fresh id from the thread's random generator.
    pub fn random() -> Self {
        Self(random_hex('i'))
    }
}

/// The number of a robot's desired state. It only grows; zero means "none yet".
#[derive(
    Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(transparent)]
pub struct Generation(pub u64);

impl Generation {
    /// The next generation.
    pub fn next(self) -> Self {
        Self(self.0 + 1)
    }
}

impl fmt::Display for Generation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

/// An IEEE 802 MAC-48 address, written `aa:bb:cc:dd:ee:ff`; `-` as separator and capitals are read
/// as well.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[cfg_attr(
    feature = "openapi",
    derive(utoipa::ToSchema),
    schema(
        value_type = String,
        pattern = "^[0-9A-Fa-f]{2}([:-][0-9A-Fa-f]{2}){5}$",
        example = "02:00:00:00:00:01"
    )
)]
#[serde(try_from = "String", into = "String")]
pub struct MacAddress([u8; 6]);

impl MacAddress {
    /// From its six octets, first on the wire first. `None` for all zeros and for group addresses,
    /// which no NIC has.
    pub fn from_octets(octets: [u8; 6]) -> Option<Self> {
        (octets != [0; 6] && octets[0] & 1 == 0).then_some(Self(octets))
    }

    /// Whether the "locally administered" bit is set, as in randomised and virtual addresses.
    pub fn is_locally_administered(&self) -> bool {
        self.0[0] & 2 != 0
    }
}

impl FromStr for MacAddress {
    type Err = InvalidId;
    fn from_str(text: &str) -> Result<Self, InvalidId> {
        let invalid = || {
            InvalidId::new(
                "MAC address",
                text,
                "six two-digit hex octets like 02:00:00:00:00:01, of one NIC",
            )
        };
        let mut octets = [0; 6];
        let mut parts = text.split([':', '-']);
        for octet in &mut octets {
            let part =
                parts.next().filter(|p| p.len() == 2 && p.bytes().all(|b| b.is_ascii_hexdigit()));
            *octet = u8::from_str_radix(part.ok_or_else(invalid)?, 16).map_err(|_| invalid())?;
        }
        if parts.next().is_some() {
            return Err(invalid());
        }
        Self::from_octets(octets).ok_or_else(invalid)
    }
}

serde_by_text!(MacAddress, InvalidId);

impl fmt::Display for MacAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [a, b, c, d, e, g] = self.0;
        write!(f, "{a:02x}:{b:02x}:{c:02x}:{d:02x}:{e:02x}:{g:02x}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn task_names_follow_the_oci_component_grammar() {
        for good in ["talker", "corridor_mapping", "a-b.c_d", "7"] {
            assert!(good.parse::<TaskName>().is_ok(), "{good}");
        }
        let long = "a".repeat(65);
        for bad in ["", "A", "a__b", "_a", "a-", "..", "a/b", "a b", "ä", long.as_str()] {
            assert!(bad.parse::<TaskName>().is_err(), "{bad}");
        }
    }

    #[test]
    fn repository_names_and_tags_follow_the_oci_grammar() {
        for good in ["talker", "a/b/c", "a__b/c.d-e", "a---b", "7/8"] {
            assert!(good.parse::<RepositoryName>().is_ok(), "{good}");
        }
        let long = "a/".repeat(200);
        for bad in [
            "",
            "/",
            "a/",
            "/a",
            "a//b",
            "a___b",
            "a..b",
            "a_-b",
            "-a",
            "a/B",
            "a/..",
            "a b",
            long.as_str(),
        ] {
            assert!(bad.parse::<RepositoryName>().is_err(), "{bad}");
        }
        assert!("v1.0_x-Y".parse::<Tag>().is_ok());
        for bad in ["", ".a", "-a", "a b", "a:b", "a".repeat(129).as_str()] {
            assert!(bad.parse::<Tag>().is_err(), "{bad}");
        }
    }

    #[test]
    fn mac_addresses_are_normalised_and_checked() {
        let mac: MacAddress = "02-AB-00-00-00-01".parse().expect("valid");
        assert_eq!(mac.to_string(), "02:ab:00:00:00:01");
        assert!(mac.is_locally_administered());
        for bad in [
            "",
            "02:00:00:00:00",
            "02:00:00:00:00:01:02",
            "00:00:00:00:00:00",
            "01:00:5e:00:00:01",
            "+2:00:00:00:00:01",
        ] {
            assert!(bad.parse::<MacAddress>().is_err(), "{bad}");
        }
    }

    #[test]
    fn random_ids_parse_back() {
        let id = RobotId::random();
        assert_eq!(id.as_str().parse::<RobotId>(), Ok(id));
        assert!(DeploymentId::random().as_str().parse::<RobotId>().is_err());
    }
}
