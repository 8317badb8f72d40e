//! Parses the setting `broker`: the address of an external broker, and the server's account there.
//! The password appears in no message and no debug output. This module opens no connection.

use std::fmt;
use std::net::IpAddr;
use std::str::FromStr;

use task_proto::RobotId;

use super::url_text::{percent_decoded, split};

/// The schemes, each with its default port, and whether it is TLS.
const SCHEMES: [(&str, u16, bool); 2] = [("mqtt://", 1883, false), ("mqtts://", 8883, true)];
/// The longest password, in bytes; MQTT itself allows 64 KiB.
const MAX_PASSWORD_BYTES: usize = 512;
/// The most brokers in one list. A robot tries them one after another.
const MAX_BROKERS: usize = 8;

/// One URL or several, separated by commas: brokers with the same accounts, in the order of the
/// connection attempts.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BrokerUrls(Vec<BrokerUrl>);

impl BrokerUrls {
    /// The brokers; at least one.
    pub fn all(&self) -> &[BrokerUrl] {
        &self.0
    }

    /// The first broker. All others have its user and password.
    pub fn first(&self) -> &BrokerUrl {
        &self.0[0]
    }
}

impl FromStr for BrokerUrls {
    type Err = InvalidBrokerUrl;

    fn from_str(text: &str) -> Result<Self, InvalidBrokerUrl> {
        let schemes = SCHEMES.map(|(scheme, ..)| scheme);
        let urls: Vec<BrokerUrl> =
            split(text, &schemes).into_iter().map(str::parse).collect::<Result<_, _>>()?;
        let account = |url: &BrokerUrl| (url.user_name.clone(), url.password.clone());
        match urls.iter().any(|url| account(url) != account(&urls[0])) {
            true => Err(InvalidBrokerUrl::Accounts),
            false if urls.len() > MAX_BROKERS => Err(InvalidBrokerUrl::TooMany),
            false => Ok(Self(urls)),
        }
    }
}

#[derive(Clone, PartialEq, Eq)]
pub struct BrokerUrl {
    /// Host name or address; an IPv6 address in brackets.
    pub host: String,
    pub port: u16,
    /// Whether the broker expects TLS.
    pub tls: bool,
    /// The server's own user at the broker.
    pub user_name: String,
    pub password: String,
}

/// The text is not a valid broker URL. The message never repeats the text, which may hold a
/// password.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum InvalidBrokerUrl {
    /// The scheme is not `mqtt://` or `mqtts://`.
    #[error(
        "expected mqtt://USER:PASSWORD@HOST[:PORT] or mqtts://…, or \"embedded\" for the server's own broker"
    )]
    Form,
    /// No user or no password. Without them the broker's access control list protects nothing.
    #[error("its user name or password is missing: expected mqtt://USER:PASSWORD@HOST[:PORT]")]
    NoCredentials,
    /// The user can't be written into the broker's files, or is a robot's.
    #[error(
        "its user name is not 1 to 64 letters, digits, '.', '_', '-' and '@', or has the form of a robot id"
    )]
    UserName,
    /// A character that is only valid as %XX.
    #[error(
        "its password holds a '%' that is not followed by two hex digits, or is longer than 512 bytes"
    )]
    Password,
    /// No host, or a host that no machine can have.
    #[error(
        "its host is missing or invalid: expected a name, an IPv4 address or an IPv6 address in brackets"
    )]
    Host,
    /// Several URLs with different users or passwords.
    #[error(
        "its URLs name different users or passwords: the brokers of a list share one password file"
    )]
    Accounts,
    /// More URLs than a robot would try.
    #[error("it names more than 8 brokers")]
    TooMany,
    /// The port is not from 1 to 65535.
    #[error("its port is not a number from 1 to 65535")]
    Port,
}

impl BrokerUrl {
    /// Whether the host's name means this machine.
    pub fn is_loopback(&self) -> bool {
        let bare = self.host.trim_start_matches('[').trim_end_matches(']');
        self.host == "localhost"
            || bare.parse::<IpAddr>().is_ok_and(|address| address.is_loopback())
    }

    /// `host:port`, without the password and so safe to show.
    pub fn address(&self) -> String {
        format!("{}:{}", self.host, self.port)
    }
}

impl FromStr for BrokerUrl {
    type Err = InvalidBrokerUrl;

    fn from_str(text: &str) -> Result<Self, InvalidBrokerUrl> {
        let of_scheme =
            |(scheme, port, tls)| text.strip_prefix(scheme).map(|rest| (rest, port, tls));
        let (rest, default_port, tls) =
            SCHEMES.into_iter().find_map(of_scheme).ok_or(InvalidBrokerUrl::Form)?;
        let rest = rest.strip_suffix('/').unwrap_or(rest);
        // A host has no '@', a password may.
        let (credentials, place) = rest.rsplit_once('@').ok_or(InvalidBrokerUrl::NoCredentials)?;
        let (user_name, password) =
            credentials.split_once(':').ok_or(InvalidBrokerUrl::NoCredentials)?;
        let user_name = percent_decoded(user_name).ok_or(InvalidBrokerUrl::UserName)?;
        let password = percent_decoded(password)
            .filter(|password| password.len() <= MAX_PASSWORD_BYTES)
            .ok_or(InvalidBrokerUrl::Password)?;
        if user_name.is_empty() || password.is_empty() {
            return Err(InvalidBrokerUrl::NoCredentials);
        }
        let is_plain = |b: u8| b.is_ascii_alphanumeric() || matches!(b, b'.' | b'_' | b'-' | b'@');
        if user_name.len() > 64
            || !user_name.bytes().all(is_plain)
            || user_name.parse::<RobotId>().is_ok()
        {
            return Err(InvalidBrokerUrl::UserName);
        }
        let (host, port) = host_and_port(place)?;
        Ok(Self {
            host: host.to_owned(),
            port: port.unwrap_or(default_port),
            tls,
            user_name,
            password,
        })
    }
}

fn host_and_port(place: &str) -> Result<(&str, Option<u16>), InvalidBrokerUrl> {
    let end =
        if place.starts_with('[') { place.find(']').map(|at| at + 1) } else { place.find(':') };
    let (host, port) = place.split_at(end.unwrap_or(place.len()));
    let is_address = host.strip_prefix('[').is_some_and(|inner| {
        inner.strip_suffix(']').is_some_and(|inner| inner.parse::<std::net::Ipv6Addr>().is_ok())
    });
    let is_name = !host.is_empty()
        && host.len() <= 253
        && host.bytes().all(|b| b.is_ascii_alphanumeric() || matches!(b, b'.' | b'-' | b'_'));
    if !is_address && !is_name {
        return Err(InvalidBrokerUrl::Host);
    }
    if port.is_empty() {
        return Ok((host, None));
    }
    match port.strip_prefix(':').and_then(|port| port.parse().ok()) {
        Some(port) if port > 0 => Ok((host, Some(port))),
        _ => Err(InvalidBrokerUrl::Port),
    }
}

impl fmt::Debug for BrokerUrl {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("BrokerUrl")
            .field("address", &self.address())
            .field("user_name", &self.user_name)
            .finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn url_is_parsed() {
        let url: BrokerUrl = "mqtt://taskd:s%40c:r@et@broker.lab:1884".parse().expect("valid");
        assert_eq!((url.user_name.as_str(), url.password.as_str()), ("taskd", "s@c:r@et"));
        assert_eq!(url.address(), "broker.lab:1884");
        assert!(!url.is_loopback());
        assert!(!format!("{url:?}").contains("et@"), "{url:?}");
        let url: BrokerUrl = "mqtt://taskd:x@[::1]/".parse().expect("valid");
        assert_eq!(
            (url.address().as_str(), url.is_loopback(), url.tls),
            ("[::1]:1883", true, false)
        );
        let url: BrokerUrl = "mqtts://taskd:x@broker.lab".parse().expect("valid");
        assert_eq!((url.address().as_str(), url.tls), ("broker.lab:8883", true));
    }

    #[test]
    fn list_of_urls_is_split_at_commas_before_a_url() {
        let urls: BrokerUrls =
            "mqtt://taskd:a,b@one.lab, mqtts://taskd:a,b@two.lab:1".parse().expect("valid");
        let addresses: Vec<_> = urls.all().iter().map(|url| (url.address(), url.tls)).collect();
        assert_eq!(addresses, [("one.lab:1883".to_owned(), false), ("two.lab:1".to_owned(), true)]);
        assert_eq!(urls.first().password, "a,b");
        let refused = |text: &str| text.parse::<BrokerUrls>().expect_err(text);
        assert_eq!(refused("mqtt://taskd:a@one,mqtt://other:a@two"), InvalidBrokerUrl::Accounts);
        assert_eq!(refused("mqtt://taskd:a@one,mqtt://taskd:b@two"), InvalidBrokerUrl::Accounts);
        assert_eq!(refused("mqtt://taskd:a@one,mqtt://taskd@two"), InvalidBrokerUrl::NoCredentials);
        assert_eq!(refused("mqtt://taskd:a@one,two"), InvalidBrokerUrl::Host);
        assert_eq!(refused(&["mqtt://taskd:a@one"; 9].join(",")), InvalidBrokerUrl::TooMany);
    }

    #[test]
    fn invalid_url_is_refused_without_showing_the_password() {
        use InvalidBrokerUrl::{Form, Host, NoCredentials, Password, Port, UserName};
        for (text, expected) in [
            ("", Form),
            ("tcp://a:secret@h", Form),
            ("mqtts:a:secret@h", Form),
            ("mqtt://h", NoCredentials),
            ("mqtt://a@h", NoCredentials),
            ("mqtt://a:@h", NoCredentials),
            ("mqtt://a b:secret@h", UserName),
            ("mqtt://r00000000000000a1:secret@h", UserName),
            ("mqtt://a:secret%4@h", Password),
            ("mqtt://a:secret%+1@h", Password),
            ("mqtt://a:secret@", Host),
            ("mqtt://a:secret@h/x", Host),
            ("mqtt://a:secret@[::g]:1", Host),
            ("mqtt://a:secret@h:0", Port),
            ("mqtt://a:secret@h:x", Port),
        ] {
            let error = text.parse::<BrokerUrl>().expect_err(text);
            assert_eq!(error, expected, "{text}");
            assert!(!error.to_string().contains("secret"));
        }
    }
}
