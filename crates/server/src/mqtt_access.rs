//! What robots are told about MQTT, and what an external broker is told about robots: their passwords there, derived from
//! the server's secret, and mosquitto's two files. All of it is computed; nothing is stored and nobody is asked.

use base64::Engine as _;
use base64::engine::general_purpose::{STANDARD, URL_SAFE_NO_PAD};
use hmac::{Hmac, KeyInit as _, Mac as _};
use sha2::{Sha256, Sha512};
use task_proto::CaPin;
use task_proto::api::{BrokerFiles, ExternalBroker, MqttEndpoint};
use task_proto::topic::TopicPrefix;

use crate::broker::CANARY_LEVEL;
use crate::broker_url::BrokerUrl;
use crate::store::BrokerCredential;

/// As many as `mosquitto_passwd` makes. They only make guessing slower, and nobody guesses 256 bits.
const ROBOT_ITERATIONS: u32 = 101;
/// The server's own password was thought up by a person.
const SERVER_ITERATIONS: u32 = 20_000;
/// The length mosquitto reads.
const SALT_BYTES: usize = 12;

/// Where robots reach MQTT.
pub struct MqttAccess {
    /// Where it is; without a password.
    endpoint: MqttEndpoint,
    external: Option<External>,
}

struct External {
    secret: [u8; 32],
    user_name: String,
    password: String,
    /// The authority behind its certificate, if it is not one that systems know.
    pin: Option<CaPin>,
}

impl MqttAccess {
    /// Robots come to the server's own broker, with their tokens. `tls`: it speaks that.
    pub fn embedded(host: Option<String>, port: u16, prefix: TopicPrefix, tls: bool) -> Self {
        Self { endpoint: MqttEndpoint { host, port, prefix, tls, external: None }, external: None }
    }

    /// Robots go to the broker at `url`, at `host` and `port` if these are given, and know it by `pin` if that is.
    pub fn external(
        url: &BrokerUrl,
        pin: Option<CaPin>,
        host: Option<String>,
        port: Option<u16>,
        prefix: TopicPrefix,
        secret: [u8; 32],
    ) -> Self {
        // What is loopback here is this machine for robots elsewhere: the host they know the server by.
        let host = host.or_else(|| (!url.is_loopback()).then(|| url.host.clone()));
        let endpoint = MqttEndpoint { host, port: port.unwrap_or(url.port), prefix, tls: url.tls, external: None };
        let external = External { secret, user_name: url.user_name.clone(), password: url.password.clone(), pin };
        Self { endpoint, external: Some(external) }
    }

    /// What the robot needs to connect.
    pub fn endpoint_of(&self, credential: &BrokerCredential) -> MqttEndpoint {
        let external = self.external.as_ref();
        let external = external
            .map(|external| ExternalBroker { password: external.password_of(credential), ca_pin: external.pin });
        MqttEndpoint { external, ..self.endpoint.clone() }
    }

    /// Whether robots go to an external broker.
    pub fn is_external(&self) -> bool {
        self.external.is_some()
    }

    /// What the external broker must know of the server and these robots; `None` without such a broker.
    pub fn files(&self, robots: &[BrokerCredential]) -> Option<BrokerFiles> {
        let external = self.external.as_ref()?;
        let mut passwd = external.passwd_line(&external.user_name, &external.password, SERVER_ITERATIONS);
        for credential in robots {
            let password = external.password_of(credential);
            passwd.push_str(&external.passwd_line(credential.robot.as_str(), &password, ROBOT_ITERATIONS));
        }
        Some(BrokerFiles { acl: acl(&external.user_name, &self.endpoint.prefix), passwd })
    }
}

impl External {
    fn password_of(&self, BrokerCredential { robot, number }: &BrokerCredential) -> String {
        URL_SAFE_NO_PAD.encode(self.derived(&format!("password {robot} {number}")))
    }

    /// One line of a mosquitto password file. The salt follows from user and password, so that the same robots make the
    /// same file and a changed file means a changed password.
    fn passwd_line(&self, user_name: &str, password: &str, iterations: u32) -> String {
        let salt = &self.derived(&format!("salt {user_name} {password}"))[..SALT_BYTES];
        let hash = pbkdf2(password.as_bytes(), salt, iterations);
        format!("{user_name}:$7${iterations}${}${}\n", STANDARD.encode(salt), STANDARD.encode(hash))
    }

    fn derived(&self, purpose: &str) -> [u8; 32] {
        let mut mac = Hmac::<Sha256>::new_from_slice(&self.secret).expect("HMAC takes keys of any length");
        mac.update(purpose.as_bytes());
        mac.finalize().into_bytes().into()
    }
}

/// PBKDF2 with HMAC-SHA-512, of which mosquitto uses just the first block.
fn pbkdf2(password: &[u8], salt: &[u8], iterations: u32) -> [u8; 64] {
    let keyed = Hmac::<Sha512>::new_from_slice(password).expect("HMAC takes keys of any length");
    let block = |input: &[&[u8]]| -> [u8; 64] {
        let mut mac = keyed.clone();
        input.iter().for_each(|bytes| mac.update(bytes));
        mac.finalize().into_bytes().into()
    };
    let mut last = block(&[salt, &1u32.to_be_bytes()]);
    let mut all = last;
    for _ in 1..iterations {
        last = block(&[&last]);
        all.iter_mut().zip(last).for_each(|(all, last)| *all ^= last);
    }
    all
}

/// A mosquitto ACL file: robots on their own topics by name, `%u` being the robot id; the server on what it needs of all.
/// Patterns hold for every user of the broker, of whom only robots have such names.
fn acl(user_name: &str, prefix: &TopicPrefix) -> String {
    format!(
        "# Written by `taskd broker acl`.\n\
         user {user_name}\n\
         topic write {prefix}/r/+/desired\n\
         topic write {prefix}/r/+/request\n\
         topic write {prefix}/p/+\n\
         topic read {prefix}/r/+/status\n\
         topic read {prefix}/r/+/reply\n\
         topic read {prefix}/r/+/log\n\
         topic read {prefix}/r/+/telemetry\n\
         topic readwrite {prefix}/{CANARY_LEVEL}\n\
         \n\
         pattern read {prefix}/r/%u/desired\n\
         pattern read {prefix}/r/%u/request\n\
         pattern read {prefix}/p/+\n\
         pattern write {prefix}/r/%u/status\n\
         pattern write {prefix}/r/%u/reply\n\
         pattern write {prefix}/r/%u/log\n\
         pattern write {prefix}/r/%u/telemetry\n"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn access(secret: u8) -> MqttAccess {
        let url: BrokerUrl = "mqtt://server:hunter2@localhost:1884".parse().expect("valid");
        MqttAccess::external(&url, None, None, None, TopicPrefix::default(), [secret; 32])
    }

    fn credential(robot: &str, number: u64) -> BrokerCredential {
        BrokerCredential { robot: robot.parse().expect("valid"), number }
    }

    #[test]
    fn a_password_is_one_robots_until_it_enrols_anew() {
        let password = |secret, robot, number| {
            let endpoint = access(secret).endpoint_of(&credential(robot, number));
            endpoint.external.expect("external").password
        };
        let (a, b) = ("r00000000000000a1", "r00000000000000b2");
        assert_eq!(password(1, a, 0), password(1, a, 0));
        assert_eq!(password(1, a, 0).len(), 43);
        let others = [password(1, b, 0), password(1, a, 1), password(2, a, 0)];
        assert!(others.iter().all(|other| *other != password(1, a, 0)), "{others:?}");
    }

    #[test]
    fn a_broker_on_this_machine_is_where_the_server_is() {
        let endpoint = access(1).endpoint_of(&credential("r00000000000000a1", 0));
        assert_eq!((endpoint.host, endpoint.port), (None, 1884));
        let url: BrokerUrl = "mqtt://server:hunter2@broker.lab".parse().expect("valid");
        let (host, port) = (Some("wifi.lab".to_owned()), Some(1999));
        let named = MqttAccess::external(&url, None, None, None, TopicPrefix::default(), [1; 32]);
        let told = MqttAccess::external(&url, None, host.clone(), port, TopicPrefix::default(), [1; 32]);
        assert_eq!((named.endpoint.host.as_deref(), named.endpoint.port), (Some("broker.lab"), 1883));
        assert_eq!((told.endpoint.host, told.endpoint.port), (host, 1999));
    }

    #[test]
    fn the_files_are_the_same_until_a_password_changes() {
        let robots = [credential("r00000000000000a1", 0), credential("r00000000000000b2", 3)];
        let files = access(1).files(&robots).expect("external");
        assert_eq!(access(1).files(&robots).expect("external").passwd, files.passwd);
        let lines: Vec<&str> = files.passwd.lines().collect();
        assert!(lines[0].starts_with("server:$7$20000$") && lines[2].starts_with("r00000000000000b2:$7$101$"));
        let changed = access(1).files(&[robots[0].clone(), credential("r00000000000000b2", 4)]).expect("external");
        let changed: Vec<&str> = changed.passwd.lines().collect();
        assert_eq!(changed[..2], lines[..2]);
        assert_ne!(changed[2], lines[2]);
        assert!(!files.passwd.contains("hunter2"));
        assert!(files.acl.contains("\npattern write taskd/v1/r/%u/status\n"), "{}", files.acl);
        assert!(MqttAccess::embedded(None, 1, TopicPrefix::default(), false).files(&robots).is_none());
    }

    #[test]
    fn the_hash_is_the_known_one() {
        // PBKDF2-HMAC-SHA-512 of "password" and "salt", one and two iterations, begins so in every implementation.
        let hex = |iterations| {
            let bytes = pbkdf2(b"password", b"salt", iterations);
            bytes[..8].iter().map(|byte| format!("{byte:02x}")).collect::<String>()
        };
        assert_eq!((hex(1).as_str(), hex(2).as_str()), ("867f70cf1ade02cf", "e1d9c16aa681708a"));
    }
}
