//! The one table of all settings that have a flag, a variable and a key in the file, and the
//! parsers of their values.

use std::net::{IpAddr, SocketAddr, ToSocketAddrs as _};
use std::path::PathBuf;
use std::time::Duration;

use task_proto::messages::part::{MAX_PART_BYTES, MIN_PART_BYTES};
use task_proto::size::{format_bytes, parse_bytes};
use task_proto::time::{parse_duration, parse_lifetime};

use super::cluster::Bus;
use super::oidc::{private_url, public_url};
use super::{BlobRead, Config};
use crate::domain::database_url;

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
        name: "log-format",
        value_name: "auto|text|json",
        help: "Form of the log on stderr: lines for people, or JSON, which \"auto\" chooses if stderr is systemd's \
               journal; TASKD_LOG filters it [default: auto]",
        set: |config, text| parsed(text).map(|format| config.log_format = format),
    },
    Setting {
        name: "http",
        value_name: "ADDR",
        help: "Address of the HTTP listener; port 0 picks a free port [default: 127.0.0.1:8080]",
        set: |config, text| address(text).map(|address| config.http = address),
    },
    Setting {
        name: "mqtt",
        value_name: "ADDR",
        help: "Address of the MQTT listener; port 0 picks a free port [default: 127.0.0.1:1883]",
        set: |config, text| address(text).map(|address| config.mqtt = address),
    },
    Setting {
        name: "broker",
        value_name: "URL",
        help: "mqtt(s)://USER:PASSWORD@HOST[:PORT] of an external broker, or several separated by commas, \
               which are tried in this order; only in the file or TASKD_BROKER, because every user of the machine \
               can read this command line [default: embedded]",
        set: |config, text| {
            config.broker = if text == "embedded" { None } else { Some(parsed(text)?) };
            Ok(())
        },
    },
    Setting {
        name: "broker-pin",
        value_name: "PIN",
        help: "SHA-256 of the public key of the broker's certificate authority; the server and robots then trust \
               only this authority [default: the systems' root certificates]",
        set: |config, text| parsed(text).map(|pin| config.broker_pin = Some(pin)),
    },
    Setting {
        name: "database",
        value_name: "URL",
        help: "sqlite:PATH or postgres://…; several Postgres URLs separated by commas name the servers of one \
               database, of which the one that takes writes is used [default: SQLite in the data directory]",
        set: |config, text| {
            database_url::check(text).map_err(|error| error.to_string())?;
            config.database = Some(text.to_owned());
            Ok(())
        },
    },
    Setting {
        name: "standby",
        value_name: "BOOL",
        help: "Wait while another server uses the database, a Postgres, and take over when that server ends; \
               see docs/cluster.md [default: false]",
        set: |config, text| boolean(text).map(|standby| config.standby = standby),
    },
    Setting {
        name: "database-check-interval",
        value_name: "TIME",
        help: "Interval between full checks of a SQLite database [default: 1d]",
        set: |config, text| parse_lifetime(text).map(|time| config.database_check_interval = time),
    },
    Setting {
        name: "topic-prefix",
        value_name: "PREFIX",
        help: "Prefix of all MQTT topics [default: taskd/v1]",
        set: |config, text| parsed(text).map(|prefix| config.topic_prefix = prefix),
    },
    Setting {
        name: "allow-plaintext",
        value_name: "BOOL",
        help: "Allow unencrypted connections from other machines",
        set: |config, text| boolean(text).map(|allow| config.allow_plaintext = allow),
    },
    Setting {
        name: "tls-certificate",
        value_name: "FILE",
        help: "Certificate chain (PEM) for HTTP and MQTT; reloaded when the file changes",
        set: |config, text| {
            config.tls.certificate = Some(PathBuf::from(non_empty(text)?));
            Ok(())
        },
    },
    Setting {
        name: "tls-key",
        value_name: "FILE",
        help: "Private key of the certificate (PEM)",
        set: |config, text| {
            config.tls.key = Some(PathBuf::from(non_empty(text)?));
            Ok(())
        },
    },
    Setting {
        name: "tls-private-ca",
        value_name: "BOOL",
        help: "Encrypt with a certificate of the server's private authority, which enrollment tokens pin \
               [default: if other machines can reach a listener, without --tls-certificate and --allow-plaintext]",
        set: |config, text| boolean(text).map(|private| config.tls.private_ca = Some(private)),
    },
    Setting {
        name: "tls-client-certificates",
        value_name: "BOOL",
        help: "Require robots' registered client certificates: their tokens are then refused without the key [default: false]",
        set: |config, text| boolean(text).map(|asks| config.tls.client_certificates = asks),
    },
    Setting {
        name: "tls-names",
        value_name: "NAME,…",
        help: "Additional host names and addresses in the private authority's certificate",
        set: |config, text| host_names(text).map(|names| config.tls.names = names),
    },
    Setting {
        name: "assignment-expiry",
        value_name: "TIME",
        help: "Time after which an unfinished assignment expires [default: 7d]",
        set: |config, text| parse_lifetime(text).map(|time| config.assignment_expiry = time),
    },
    Setting {
        name: "desired-lifetime",
        value_name: "TIME",
        help: "Time for which a signed desired state permits new work [default: 30d]",
        set: |config, text| parse_lifetime(text).map(|time| config.desired_lifetime = time),
    },
    Setting {
        name: "public-mqtt-host",
        value_name: "HOST",
        help: "MQTT host announced to robots [default: the host of the URL they use]",
        set: |config, text| {
            config.public_mqtt_host = Some(non_empty(text)?);
            Ok(())
        },
    },
    Setting {
        name: "public-mqtt-port",
        value_name: "PORT",
        help: "MQTT port announced to robots [default: the bound port]",
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
        help: "Silence after which a polling robot counts as offline [default: 90s]",
        set: |config, text| parse_lifetime(text).map(|time| config.presence_timeout = time),
    },
    Setting {
        name: "blob-read",
        value_name: "mmap|pread",
        help: "How blob files are read [default: mmap]",
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
        name: "blobs-store",
        value_name: "URL",
        help: "s3://BUCKET?endpoint=https://HOST&region=NAME or file:///DIR for the bytes of packages and outputs, which \
               several servers then share; an S3 key is read from AWS_* variables or from a file named by \
               &credentials=FILE; see docs/server.md [default: the data directory]",
        set: |config, text| parsed(text).map(|store| config.blob_store = Some(store)),
    },
    Setting {
        name: "blobs-cache-bytes",
        value_name: "SIZE",
        help: "Maximum size of the local copies of blobs that lie in --blobs-store [default: 50 GB, at most a quarter \
               of the disk]",
        set: |config, text| {
            size_within(text, 1 << 20, 1 << 50).map(|bytes| config.blob_cache_bytes = Some(bytes))
        },
    },
    Setting {
        name: "blob-grace",
        value_name: "TIME",
        help: "Retention of unfinished uploads and unreferenced blobs [default: 1d]",
        set: |config, text| parse_lifetime(text).map(|time| config.blob_grace = time),
    },
    Setting {
        name: "max-http-connections",
        value_name: "N",
        help: "Maximum concurrent HTTP connections [default: 20000]",
        set: |config, text| {
            count(text, 1_000_000).map(|n| config.max_http_connections = n as usize)
        },
    },
    Setting {
        name: "max-mqtt-connections",
        value_name: "N",
        help: "Maximum concurrent MQTT connections [default: 20000]",
        set: |config, text| {
            count(text, 1_000_000).map(|n| config.max_mqtt_connections = n as usize)
        },
    },
    Setting {
        name: "max-silent-per-address",
        value_name: "N",
        help: "Maximum unauthenticated connections per address [default: 2048]",
        set: |config, text| {
            count(text, 1_000_000).map(|n| config.max_silent_per_address = n as usize)
        },
    },
    Setting {
        name: "trusted-proxies",
        value_name: "ADDR,…",
        help: "Addresses of reverse proxies whose X-Forwarded-For is trusted [default: none]",
        set: |config, text| ip_addresses(text).map(|proxies| config.trusted_proxies = proxies),
    },
    Setting {
        name: "proxies",
        value_name: "ADDR,…",
        help: "Addresses of balancers that begin each connection, HTTP and MQTT, with a PROXY protocol v2 header; \
               see docs/tls.md [default: none]",
        set: |config, text| ip_addresses(text).map(|proxies| config.proxies = proxies),
    },
    Setting {
        name: "drain",
        value_name: "TIME",
        help: "Time before a stop in which /readyz answers 503 and robots' sessions end one after the other; \
               see docs/cluster.md [default: 0s]",
        set: |config, text| drain(text).map(|time| config.drain = time),
    },
    Setting {
        name: "cluster-name",
        value_name: "NAME",
        help: "Name of this server in its cluster [default: the host's name]",
        set: |config, text| parsed(text).map(|name| config.cluster_mut().name = Some(name)),
    },
    Setting {
        name: "cluster-url",
        value_name: "URL",
        help: "URL at which the other servers of the cluster reach this one; it makes this server a part of a \
               cluster, see docs/cluster.md [default: none]",
        set: |config, text| public_url(text).map(|url| config.cluster_mut().url = Some(url)),
    },
    Setting {
        name: "cluster-secrets",
        value_name: "DIR",
        help: "Directory with the cluster's keys, which the server only reads; `taskd cluster export` makes one \
               [default: the data directory]",
        set: |config, text| {
            config.cluster_mut().secrets = Some(PathBuf::from(non_empty(text)?));
            Ok(())
        },
    },
    Setting {
        name: "cluster-bus",
        value_name: "postgres|off",
        help: "How the servers of a cluster notify each other; without it they find changes every ten seconds \
               [default: postgres]",
        set: |config, text| {
            config.cluster_mut().bus = match text {
                "postgres" => Bus::Postgres,
                "off" => Bus::Off,
                _ => return Err(format!("{text:?} is neither \"postgres\" nor \"off\"")),
            };
            Ok(())
        },
    },
    Setting {
        name: "oidc-issuer",
        value_name: "URL",
        help: "OpenID Connect issuer for sign-in; see docs/people.md [default: none]",
        set: |config, text| private_url(text).map(|url| config.oidc.issuer = url),
    },
    Setting {
        name: "oidc-client-id",
        value_name: "ID",
        help: "Client id of this server at the provider",
        set: |config, text| non_empty(text).map(|id| config.oidc.client_id = id),
    },
    Setting {
        name: "oidc-client-secret-file",
        value_name: "FILE",
        help: "File with the client secret, for a confidential client",
        set: |config, text| {
            non_empty(text).map(|path| config.oidc.client_secret_file = Some(PathBuf::from(path)))
        },
    },
    Setting {
        name: "oidc-public-url",
        value_name: "URL",
        help: "Public URL of this server for browsers, such as https://fleet.example.org",
        set: |config, text| public_url(text).map(|url| config.oidc.public_url = url),
    },
    Setting {
        name: "oidc-scopes",
        value_name: "SCOPES",
        help: "Scopes requested from the provider [default: openid profile]",
        set: |config, text| match text.split(' ').any(|scope| scope == "openid") {
            true => {
                config.oidc.scopes = text.to_owned();
                Ok(())
            }
            false => Err(format!("{text:?} does not include openid")),
        },
    },
    Setting {
        name: "oidc-name-claim",
        value_name: "CLAIM",
        help: "Claim with a new user's name [default: preferred_username]",
        set: |config, text| non_empty(text).map(|claim| config.oidc.name_claim = claim),
    },
    Setting {
        name: "oidc-title",
        value_name: "TEXT",
        help: "Name of the provider on the page [default: single sign-on]",
        set: |config, text| non_empty(text).map(|title| config.oidc.title = title),
    },
    Setting {
        name: "max-blob-bytes",
        value_name: "BYTES",
        help: "Maximum size of one blob, in bytes [default: 17179869184]",
        set: |config, text| count(text, 1 << 50).map(|n| config.max_blob_bytes = n),
    },
    Setting {
        name: "max-upload-bytes",
        value_name: "SIZE",
        help: "Maximum unpacked size of a package uploaded from the page [default: 4 GB]",
        set: |config, text| {
            size_within(text, 1, 1 << 50).map(|bytes| config.max_upload_bytes = bytes)
        },
    },
    Setting {
        name: "delivery-part-bytes",
        value_name: "SIZE",
        help: "Size of a part in direct-push; a smaller package travels as one message [default: 64 KB]",
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
        help: "Maximum size of a package embedded in its announcement; 0 disables it [default: 32 KB]",
        set: |config, text| {
            let bytes = size_within(text, 0, MAX_INLINE_BYTES)?;
            config.delivery.inline_bytes = u32::try_from(bytes).map_err(|_| text.to_owned())?;
            Ok(())
        },
    },
    Setting {
        name: "delivery-site-label",
        value_name: "LABEL",
        help: "Label whose value names a robot's site [default: site]",
        set: |config, text| parsed(text).map(|label| config.delivery.site_label = label),
    },
    Setting {
        name: "transfers-max",
        value_name: "N",
        help: "Maximum concurrent pulls of packages [default: no limit]",
        set: |config, text| count(text, 1_000_000).map(|n| config.transfers.all.max = Some(n)),
    },
    Setting {
        name: "transfers-bytes-per-s",
        value_name: "SIZE",
        help: "Maximum bandwidth of all pulls together, per second [default: no limit]",
        set: |config, text| {
            size_within(text, 1024, 1 << 50).map(|n| config.transfers.all.bytes_per_s = Some(n))
        },
    },
    Setting {
        name: "enrolment-approval",
        value_name: "BOOL",
        help: "Require approval of new robots by an administrator",
        set: |config, text| boolean(text).map(|approval| config.enrollment_approval = approval),
    },
    Setting {
        name: "enrolment-uses",
        value_name: "N",
        help: "Default number of robots per enrollment token [default: 100]",
        set: |config, text| count(text, 1_000_000).map(|n| config.enrollment_uses = n),
    },
    Setting {
        name: "enrolment-per-minute",
        value_name: "N",
        help: "Maximum enrollments per minute, and half as many per token; the burst is ten seconds' worth [default: 3000]",
        set: |config, text| count(text, 1_000_000).map(|n| config.enrollment_per_minute = n),
    },
    Setting {
        name: "disk-reserve",
        value_name: "SIZE",
        help: "Disk space that people's packages and uploads leave free for database, logs and reports; robots' \
               outputs leave twice as much [default: a fortieth of the disk, at most 1 GB]",
        set: |config, text| {
            size_within(text, 0, 1 << 50).map(|bytes| config.disk_reserve = Some(bytes))
        },
    },
    Setting {
        name: "robots-messages-per-s",
        value_name: "N",
        help: "MQTT messages per second after which a robot is slowed; the burst is ten seconds' worth [default: 100]",
        set: |config, text| count(text, 1_000_000).map(|n| config.robots.messages_per_s = n),
    },
    Setting {
        name: "robots-bytes-per-s",
        value_name: "SIZE",
        help: "MQTT bytes per second after which a robot is slowed [default: 1 MB]",
        set: |config, text| {
            size_within(text, 64 << 10, 1 << 40).map(|n| config.robots.bytes_per_s = n)
        },
    },
    Setting {
        name: "robots-requests-per-s",
        value_name: "N",
        help: "HTTP requests per second after which a robot is slowed [default: 20]",
        set: |config, text| count(text, 1_000_000).map(|n| config.robots.requests_per_s = n),
    },
    Setting {
        name: "robots-output-bytes",
        value_name: "SIZE",
        help: "Maximum bytes of one robot's outputs; beyond it the oldest is deleted [default: 40 GB, at most an \
               eighth of the disk]",
        set: |config, text| {
            size_within(text, 64 << 20, 1 << 50).map(|bytes| config.max_robot_bytes = Some(bytes))
        },
    },
    Setting {
        name: "people-requests-per-s",
        value_name: "N",
        help: "Requests per second of one person, beyond which they wait or get 429; the burst is ten seconds' worth, \
               and orders are counted separately [default: 200]",
        set: |config, text| count(text, 1_000_000).map(|n| config.people.requests_per_s = n),
    },
    Setting {
        name: "robots-patience",
        value_name: "TIME",
        help: "Time for which a robot is slowed before it is disconnected [default: 30s]",
        set: |config, text| parse_lifetime(text).map(|time| config.robots.patience = time),
    },
    Setting {
        name: "robots-backoff",
        value_name: "TIME",
        help: "Time for which a disconnected robot is refused; doubles up to six times [default: 10s]",
        set: |config, text| parse_lifetime(text).map(|time| config.robots.backoff = time),
    },
    Setting {
        name: "robots-forgive-after",
        value_name: "TIME",
        help: "Time without violations after which a robot's record is cleared [default: 10m]",
        set: |config, text| parse_lifetime(text).map(|time| config.robots.penalty_lifetime = time),
    },
];

/// Maximum bytes embedded in an announcement: in base64 they still fit, beside a state of a few
/// tasks.
const MAX_INLINE_BYTES: u64 = 64 * 1024;

fn non_empty(text: &str) -> Result<String, String> {
    if text.is_empty() { Err("must not be empty".to_owned()) } else { Ok(text.to_owned()) }
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

fn ip_addresses(text: &str) -> Result<Vec<IpAddr>, String> {
    let addresses = text.split(',').map(str::trim).filter(|text| !text.is_empty());
    let parsed = addresses.map(|text| match text.parse::<IpAddr>() {
        Ok(address) => Ok(address.to_canonical()),
        Err(_) => Err(format!("{text:?} is not an IP address")),
    });
    parsed.collect()
}

/// At most five minutes: longer, and a service manager kills the server before it stops.
fn drain(text: &str) -> Result<Duration, String> {
    const MAX: Duration = Duration::from_secs(5 * 60);
    match parse_duration(text) {
        Some(time) if time <= MAX => Ok(time),
        _ => Err(format!("{text:?} is not a time of at most 5m: expected for example 0s or 10s")),
    }
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

fn count(text: &str, most: u64) -> Result<u64, String> {
    match text.parse() {
        Ok(number) if (1..=most).contains(&number) => Ok(number),
        _ => Err(format!("{text:?} is not a whole number from 1 to {most}")),
    }
}

fn size_within(text: &str, least: u64, most: u64) -> Result<u64, String> {
    let expected =
        || format!("{text:?} is not a size from {} to {}", format_bytes(least), format_bytes(most));
    parse_bytes(text).filter(|bytes| (least..=most).contains(bytes)).ok_or_else(expected)
}

#[cfg(test)]
mod tests {
    use super::*;

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
        let setting = Setting::by_key("proxies").expect("there");
        assert_eq!((setting.set)(&mut config, "10.0.0.2"), Ok(()));
        assert_eq!(config.proxies, [IpAddr::from([10, 0, 0, 2])]);
    }

    #[test]
    fn part_size_allows_the_largest_message() {
        let mut config = Config::with_data(PathBuf::new());
        let setting = Setting::by_key("delivery_part_bytes").expect("there");
        assert_eq!((setting.set)(&mut config, "256 MB"), Ok(()));
        assert_eq!(config.delivery.part_bytes, MAX_PART_BYTES);
        let error = (setting.set)(&mut config, "257 MB").expect_err("refused");
        assert_eq!(error, "\"257 MB\" is not a size from 1 KB to 256 MB");
    }
}
