//! The one table of all settings that have a flag, a variable and a key in the file, and the
//! parsers of their values.

use std::net::{IpAddr, SocketAddr, ToSocketAddrs as _};
use std::path::PathBuf;

use task_proto::part::{MAX_PART_BYTES, MIN_PART_BYTES};

use super::oidc::{private_url, public_url};
use super::{BlobRead, Config, lifetime};
use crate::domain::delivery::shown_bytes;

/// One setting. `topic-prefix` is the flag's name; the file's key is `topic_prefix`, the variable
/// `TASKD_TOPIC_PREFIX`.
pub(super) struct Setting {
    pub(super) name: &'static str,
    pub(super) value_name: &'static str,
    pub(super) help: &'static str,
    pub(super) set: fn(&mut Config, &str) -> Result<(), String>,
}

impl Setting {
    pub(super) fn key(&self) -> String {
        self.name.replace('-', "_")
    }

    pub(super) fn by_key(key: &str) -> Option<&'static Self> {
        SETTINGS.iter().find(|setting| setting.key() == key)
    }
}

pub(super) const SETTINGS: &[Setting] = &[
    Setting {
        name: "data",
        value_name: "DIR",
        help: "Directory that holds all state; created on the first start [default: ~/.local/share/taskd]",
        set: |config, text| {
            config.data = PathBuf::from(non_empty(text)?);
            Ok(())
        },
    },
    Setting {
        name: "http",
        value_name: "ADDR",
        help: "Where HTTP listens; port 0 takes a free one [default: 127.0.0.1:8080]",
        set: |config, text| address(text).map(|address| config.http = address),
    },
    Setting {
        name: "mqtt",
        value_name: "ADDR",
        help: "Where MQTT listens; port 0 takes a free one [default: 127.0.0.1:1883]",
        set: |config, text| address(text).map(|address| config.mqtt = address),
    },
    Setting {
        name: "broker",
        value_name: "URL",
        help: "mqtt(s)://USER:PASSWORD@HOST[:PORT] of a broker to use instead of the server's own, or several separated by \
               commas, which are tried in this order; in the file or TASKD_BROKER only, since everybody on the machine \
               can read this command line [default: embedded]",
        set: |config, text| {
            config.broker = if text == "embedded" { None } else { Some(parsed(text)?) };
            Ok(())
        },
    },
    Setting {
        name: "broker-pin",
        value_name: "PIN",
        help: "SHA-256 of the public key of the authority behind the broker's certificate, which the server and robots \
               then trust alone [default: the systems' roots vouch for it]",
        set: |config, text| parsed(text).map(|pin| config.broker_pin = Some(pin)),
    },
    Setting {
        name: "database",
        value_name: "URL",
        help: "sqlite:PATH or postgres://… [default: SQLite in the data directory]",
        set: |config, text| database_url(text).map(|url| config.database = Some(url)),
    },
    Setting {
        name: "database-check-interval",
        value_name: "TIME",
        help: "How often a SQLite database is checked in full while it is served [default: 1d]",
        set: |config, text| lifetime(text).map(|time| config.database_check_interval = time),
    },
    Setting {
        name: "topic-prefix",
        value_name: "PREFIX",
        help: "What all MQTT topics start with [default: taskd/v1]",
        set: |config, text| parsed(text).map(|prefix| config.topic_prefix = prefix),
    },
    Setting {
        name: "allow-plaintext",
        value_name: "BOOL",
        help: "Let unencrypted listeners be reached from other machines",
        set: |config, text| boolean(text).map(|allow| config.allow_plaintext = allow),
    },
    Setting {
        name: "tls-certificate",
        value_name: "FILE",
        help: "Own certificate chain (PEM), for HTTP and MQTT; a file that changes is read again",
        set: |config, text| {
            config.tls.certificate = Some(PathBuf::from(non_empty(text)?));
            Ok(())
        },
    },
    Setting {
        name: "tls-key",
        value_name: "FILE",
        help: "Its private key (PEM)",
        set: |config, text| {
            config.tls.key = Some(PathBuf::from(non_empty(text)?));
            Ok(())
        },
    },
    Setting {
        name: "tls-private-ca",
        value_name: "BOOL",
        help: "Encrypt with a certificate by an authority of the server's own, which enrolment tokens tell robots to trust \
               [default: where other machines reach a listener, without --tls-certificate or --allow-plaintext]",
        set: |config, text| boolean(text).map(|private| config.tls.private_ca = Some(private)),
    },
    Setting {
        name: "tls-client-certificates",
        value_name: "BOOL",
        help: "Ask robots for the key that they registered: without it their tokens open nothing [default: false]",
        set: |config, text| boolean(text).map(|asks| config.tls.client_certificates = asks),
    },
    Setting {
        name: "tls-names",
        value_name: "NAME,…",
        help: "Host names and addresses that its certificate is also good for, beside the machine's own",
        set: |config, text| host_names(text).map(|names| config.tls.names = names),
    },
    Setting {
        name: "assignment-expiry",
        value_name: "TIME",
        help: "How long an assignment may stay undone [default: 7d]",
        set: |config, text| lifetime(text).map(|time| config.assignment_expiry = time),
    },
    Setting {
        name: "desired-lifetime",
        value_name: "TIME",
        help: "How long a signed desired state allows new work to be begun [default: 30d]",
        set: |config, text| lifetime(text).map(|time| config.desired_lifetime = time),
    },
    Setting {
        name: "public-mqtt-host",
        value_name: "HOST",
        help: "MQTT host that robots are told [default: the host of the URL they use]",
        set: |config, text| {
            config.public_mqtt_host = Some(non_empty(text)?);
            Ok(())
        },
    },
    Setting {
        name: "public-mqtt-port",
        value_name: "PORT",
        help: "MQTT port that robots are told [default: the port that is bound]",
        set: |config, text| match text.parse() {
            Ok(port) if port > 0 => {
                config.public_mqtt_port = Some(port);
                Ok(())
            }
            _ => Err(format!("{text:?} is not a port: expected 1 to 65535")),
        },
    },
    Setting {
        name: "presence-timeout",
        value_name: "TIME",
        help: "After how long a silent robot that polls counts as offline [default: 90s]",
        set: |config, text| lifetime(text).map(|time| config.presence_timeout = time),
    },
    Setting {
        name: "blob-read",
        value_name: "mmap|pread",
        help: "How blobs are read [default: mmap]",
        set: |config, text| {
            config.blob_read = match text {
                "mmap" => BlobRead::Mmap,
                "pread" => BlobRead::Pread,
                _ => return Err(format!("{text:?} is neither \"mmap\" nor \"pread\"")),
            };
            Ok(())
        },
    },
    Setting {
        name: "blob-grace",
        value_name: "TIME",
        help: "How long unfinished uploads and unreferenced blobs are kept [default: 1d]",
        set: |config, text| lifetime(text).map(|time| config.blob_grace = time),
    },
    Setting {
        name: "max-http-connections",
        value_name: "N",
        help: "Most HTTP connections at once [default: 20000]",
        set: |config, text| {
            count(text, 1_000_000).map(|n| config.max_http_connections = n as usize)
        },
    },
    Setting {
        name: "max-mqtt-connections",
        value_name: "N",
        help: "Most MQTT connections at once [default: 20000]",
        set: |config, text| {
            count(text, 1_000_000).map(|n| config.max_mqtt_connections = n as usize)
        },
    },
    Setting {
        name: "max-silent-per-address",
        value_name: "N",
        help: "Most connections of one address without a good token so far, over MQTT without CONNECT [default: 2048]",
        set: |config, text| {
            count(text, 1_000_000).map(|n| config.max_silent_per_address = n as usize)
        },
    },
    Setting {
        name: "trusted-proxies",
        value_name: "ADDR,…",
        help: "Addresses of reverse proxies whose X-Forwarded-For is believed [default: none]",
        set: |config, text| {
            let addresses = text.split(',').map(str::trim).filter(|text| !text.is_empty());
            let parsed = addresses.map(|text| match text.parse::<IpAddr>() {
                Ok(address) => Ok(address.to_canonical()),
                Err(_) => Err(format!("{text:?} is not an IP address")),
            });
            config.trusted_proxies = parsed.collect::<Result<_, _>>()?;
            Ok(())
        },
    },
    Setting {
        name: "oidc-issuer",
        value_name: "URL",
        help: "OpenID Connect provider by which people may sign in; see docs/people.md [default: none]",
        set: |config, text| private_url(text).map(|url| config.oidc.issuer = url),
    },
    Setting {
        name: "oidc-client-id",
        value_name: "ID",
        help: "What the provider calls this server",
        set: |config, text| non_empty(text).map(|id| config.oidc.client_id = id),
    },
    Setting {
        name: "oidc-client-secret-file",
        value_name: "FILE",
        help: "File with the secret that it gave this server, if it did",
        set: |config, text| {
            non_empty(text).map(|path| config.oidc.client_secret_file = Some(PathBuf::from(path)))
        },
    },
    Setting {
        name: "oidc-public-url",
        value_name: "URL",
        help: "Where browsers reach this server, like https://fleet.example.org",
        set: |config, text| public_url(text).map(|url| config.oidc.public_url = url),
    },
    Setting {
        name: "oidc-scopes",
        value_name: "SCOPES",
        help: "What the provider is asked for [default: openid profile]",
        set: |config, text| match text.split(' ').any(|scope| scope == "openid") {
            true => {
                config.oidc.scopes = text.to_owned();
                Ok(())
            }
            false => Err(format!("{text:?} lacks openid")),
        },
    },
    Setting {
        name: "oidc-name-claim",
        value_name: "CLAIM",
        help: "Claim that a new user is named by [default: preferred_username]",
        set: |config, text| non_empty(text).map(|claim| config.oidc.name_claim = claim),
    },
    Setting {
        name: "oidc-title",
        value_name: "TEXT",
        help: "What the page calls the provider [default: single sign-on]",
        set: |config, text| non_empty(text).map(|title| config.oidc.title = title),
    },
    Setting {
        name: "max-blob-bytes",
        value_name: "BYTES",
        help: "Most bytes of one blob [default: 17179869184]",
        set: |config, text| count(text, 1 << 50).map(|n| config.max_blob_bytes = n),
    },
    Setting {
        name: "max-upload-bytes",
        value_name: "SIZE",
        help: "Most that is unpacked of a package that the page brings as a directory [default: 4 GB]",
        set: |config, text| {
            size_within(text, 1, 1 << 50).map(|bytes| config.max_upload_bytes = bytes)
        },
    },
    Setting {
        name: "delivery-part-bytes",
        value_name: "SIZE",
        help: "Size of a part in direct-push; a smaller package is one message [default: 64 KB]",
        set: |config, text| {
            let most = u64::from(MAX_PART_BYTES).next_multiple_of(1 << 20);
            let bytes = size_within(text, u64::from(MIN_PART_BYTES), most)?;
            config.delivery.part_bytes =
                u32::try_from(bytes).unwrap_or(MAX_PART_BYTES).min(MAX_PART_BYTES);
            Ok(())
        },
    },
    Setting {
        name: "delivery-qos",
        value_name: "0|1|2",
        help: "MQTT quality of service of parts [default: 1]",
        set: |config, text| {
            config.delivery.qos = match text {
                "0" => 0,
                "1" => 1,
                "2" => 2,
                _ => return Err(format!("{text:?} is not a quality of service: 0, 1 or 2")),
            };
            Ok(())
        },
    },
    Setting {
        name: "delivery-inline-bytes",
        value_name: "SIZE",
        help: "Most bytes of a package that ride inside an announcement; 0: none do [default: 32 KB]",
        set: |config, text| {
            let bytes = size_within(text, 0, MAX_INLINE_BYTES)?;
            config.delivery.inline_bytes = u32::try_from(bytes).map_err(|_| text.to_owned())?;
            Ok(())
        },
    },
    Setting {
        name: "delivery-site-label",
        value_name: "LABEL",
        help: "Label whose value says on which site a robot is [default: site]",
        set: |config, text| parsed(text).map(|label| config.delivery.site_label = label),
    },
    Setting {
        name: "transfers-max",
        value_name: "N",
        help: "Most packages that robots pull at the same time [default: no limit]",
        set: |config, text| count(text, 1_000_000).map(|n| config.transfers.all.max = Some(n)),
    },
    Setting {
        name: "transfers-bytes-per-s",
        value_name: "SIZE",
        help: "Most bytes per second that all of them get together [default: no limit]",
        set: |config, text| {
            size_within(text, 1024, 1 << 50).map(|n| config.transfers.all.bytes_per_s = Some(n))
        },
    },
    Setting {
        name: "enrolment-approval",
        value_name: "BOOL",
        help: "Let every new robot wait until an administrator approves it",
        set: |config, text| boolean(text).map(|approval| config.enrolment_approval = approval),
    },
    Setting {
        name: "enrolment-uses",
        value_name: "N",
        help: "How many robots an enrolment token is good for if its maker does not say [default: 100]",
        set: |config, text| count(text, 1_000_000).map(|n| config.enrolment_uses = n),
    },
    Setting {
        name: "enrolment-per-minute",
        value_name: "N",
        help: "How many robots may enrol in a minute, by one token half of them; ten seconds' worth may come at once \
               [default: 3000]",
        set: |config, text| count(text, 1_000_000).map(|n| config.enrolment_per_minute = n),
    },
    Setting {
        name: "disk-reserve",
        value_name: "SIZE",
        help: "What people's packages and uploads leave free on the disk for database, logs and reports; what robots bring \
               back leaves twice as much [default: a fortieth of the disk, 1 GB at most]",
        set: |config, text| {
            size_within(text, 0, 1 << 50).map(|bytes| config.disk_reserve = Some(bytes))
        },
    },
    Setting {
        name: "robots-messages-per-s",
        value_name: "N",
        help: "MQTT messages a second of one robot, beyond which it is slowed; ten seconds' worth may come at once [default: 100]",
        set: |config, text| count(text, 1_000_000).map(|n| config.robots.messages_per_s = n),
    },
    Setting {
        name: "robots-bytes-per-s",
        value_name: "SIZE",
        help: "The same in bytes [default: 1 MB]",
        set: |config, text| {
            size_within(text, 64 << 10, 1 << 40).map(|n| config.robots.bytes_per_s = n)
        },
    },
    Setting {
        name: "robots-requests-per-s",
        value_name: "N",
        help: "The same of reports and questions over HTTP [default: 20]",
        set: |config, text| count(text, 1_000_000).map(|n| config.robots.requests_per_s = n),
    },
    Setting {
        name: "robots-output-bytes",
        value_name: "SIZE",
        help: "The most that is kept of what one robot brings back: beyond it the oldest goes [default: 40 GB, an eighth of the disk \
               at most]",
        set: |config, text| {
            size_within(text, 64 << 20, 1 << 50).map(|bytes| config.max_robot_bytes = Some(bytes))
        },
    },
    Setting {
        name: "people-requests-per-s",
        value_name: "N",
        help: "Requests a second of one person, beyond which they wait or get 429; ten seconds' worth may come at once, orders \
               are counted apart [default: 200]",
        set: |config, text| count(text, 1_000_000).map(|n| config.people.requests_per_s = n),
    },
    Setting {
        name: "robots-patience",
        value_name: "TIME",
        help: "How long a robot is slowed before it is cut off [default: 30s]",
        set: |config, text| lifetime(text).map(|time| config.robots.patience = time),
    },
    Setting {
        name: "robots-backoff",
        value_name: "TIME",
        help: "How long a robot that was cut off has to stay away; doubles up to six times [default: 10s]",
        set: |config, text| lifetime(text).map(|time| config.robots.backoff = time),
    },
    Setting {
        name: "robots-forgive-after",
        value_name: "TIME",
        help: "How long it has to behave to be like any other again [default: 10m]",
        set: |config, text| lifetime(text).map(|time| config.robots.forgive_after = time),
    },
];

/// Maximum bytes embedded in an announcement: in base64 they still fit, beside a state of a few
/// tasks.
const MAX_INLINE_BYTES: u64 = 64 * 1024;

fn non_empty(text: &str) -> Result<String, String> {
    if text.is_empty() { Err("it is empty".to_owned()) } else { Ok(text.to_owned()) }
}

fn parsed<T: std::str::FromStr<Err: std::fmt::Display>>(text: &str) -> Result<T, String> {
    text.parse().map_err(|error: T::Err| error.to_string())
}

fn boolean(text: &str) -> Result<bool, String> {
    match text {
        "true" | "1" | "yes" => Ok(true),
        "false" | "0" | "no" => Ok(false),
        _ => Err(format!("{text:?} is neither \"true\" nor \"false\"")),
    }
}

fn address(text: &str) -> Result<SocketAddr, String> {
    let expected =
        || format!("{text:?} is not an address: expected host:port, for example 127.0.0.1:8080");
    text.to_socket_addrs().ok().and_then(|mut found| found.next()).ok_or_else(expected)
}

fn host_names(text: &str) -> Result<Vec<String>, String> {
    let is_name = |name: &str| {
        let is_word = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '-' | '_' | ':');
        (1..=253).contains(&name.len()) && name.chars().all(is_word)
    };
    let names: Vec<String> = text.split(',').map(|name| name.trim().to_owned()).collect();
    match names.iter().find(|name| !is_name(name)) {
        Some(wrong) => Err(format!("{wrong:?} is neither a host name nor an address")),
        None => Ok(names),
    }
}

fn database_url(text: &str) -> Result<String, String> {
    let known =
        ["sqlite:", "postgres://", "postgresql://"].iter().any(|scheme| text.starts_with(scheme));
    // The URL may contain a password, so the message does not repeat the URL.
    if known {
        Ok(text.to_owned())
    } else {
        Err("expected a URL that starts with sqlite: or postgres://".to_owned())
    }
}

fn count(text: &str, most: u64) -> Result<u64, String> {
    match text.parse() {
        Ok(number) if (1..=most).contains(&number) => Ok(number),
        _ => Err(format!("{text:?} is not a whole number from 1 to {most}")),
    }
}

/// Parses a number of bytes: a whole number, alone or with `B`, `KB`, `MB` or `GB`, each 1,024
/// times the previous one.
pub(super) fn size(text: &str) -> Option<u64> {
    let split = text.find(|c: char| !c.is_ascii_digit()).unwrap_or(text.len());
    let number: u64 = text[..split].parse().ok()?;
    let one = match text[split..].trim_start() {
        "" | "B" => 1,
        "KB" => 1 << 10,
        "MB" => 1 << 20,
        "GB" => 1 << 30,
        _ => return None,
    };
    number.checked_mul(one)
}

fn size_within(text: &str, least: u64, most: u64) -> Result<u64, String> {
    let expected =
        || format!("{text:?} is not a size from {} to {}", shown_bytes(least), shown_bytes(most));
    size(text).filter(|bytes| (least..=most).contains(bytes)).ok_or_else(expected)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_have_units() {
        let good = [
            ("65536", 65_536),
            ("1 KB", 1024),
            ("256KB", 262_144),
            ("9 MB", 9 << 20),
            ("1 GB", 1 << 30),
            ("7 B", 7),
        ];
        for (text, bytes) in good {
            assert_eq!(size(text), Some(bytes), "{text}");
        }
        for bad in ["", "KB", "-1 KB", "1.5 MB", "1 kb", "1 TB", "20000000000 GB", "1 KB "] {
            assert_eq!(size(bad), None, "{bad}");
        }
    }

    #[test]
    fn proxies_are_a_list_of_addresses() {
        let mut config = Config::with_data(PathBuf::new());
        let setting = Setting::by_key("trusted_proxies").expect("there");
        assert_eq!((setting.set)(&mut config, "::1, ::ffff:10.0.0.1"), Ok(()));
        assert_eq!(
            config.trusted_proxies,
            [IpAddr::from([0, 0, 0, 0, 0, 0, 0, 1]), IpAddr::from([10, 0, 0, 1])]
        );
        let error = (setting.set)(&mut config, "10.0.0.1,nginx").expect_err("refused");
        assert_eq!(error, "\"nginx\" is not an IP address");
        assert_eq!((setting.set)(&mut config, ""), Ok(()));
        assert!(config.trusted_proxies.is_empty());
    }

    #[test]
    fn a_part_may_hold_the_largest_message() {
        let mut config = Config::with_data(PathBuf::new());
        let setting = Setting::by_key("delivery_part_bytes").expect("there");
        assert_eq!((setting.set)(&mut config, "256 MB"), Ok(()));
        assert_eq!(config.delivery.part_bytes, MAX_PART_BYTES);
        let error = (setting.set)(&mut config, "257 MB").expect_err("refused");
        assert_eq!(error, "\"257 MB\" is not a size from 1 KB to 256 MB");
    }
}
