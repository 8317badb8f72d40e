//! The MQTT endpoints for robots, and the accounts of robots at an external broker: their passwords
//! and client ids, derived from the server's secret, and the broker's files. All of these are
//! computed; nothing is stored and no service is asked.

mod mosquitto;
mod nats;

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use base64::Engine as _;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use futures_util::future::join_all;
use hmac::{Hmac, KeyInit as _, Mac as _};
use sha2::Sha256;
use task_proto::CaPin;
use task_proto::api::{
    BrokerAddress, BrokerCheck, BrokerFiles, ExternalBroker, MqttEndpoint, NatsFile,
};
use task_proto::messages::topic::TopicPrefix;
use task_transport::{MqttLogin, displaces};
use tokio::time::timeout;

use crate::broker::external_route;
use crate::domain::broker_url::{BrokerUrl, BrokerUrls};
use crate::store::BrokerCredential;

/// Time limit for the test of one broker.
const CHECK_TIMEOUT: Duration = Duration::from_secs(8);

/// The MQTT endpoints for robots.
pub struct MqttAccess {
    /// The endpoint, without a password.
    endpoint: MqttEndpoint,
    external: Option<External>,
}

/// External brokers, all with the same accounts.
struct External {
    secret: [u8; 32],
    brokers: BrokerUrls,
    /// The address at which robots reach each broker.
    places: Vec<BrokerAddress>,
    /// The broker that the server was connected to last.
    current: Arc<AtomicUsize>,
    /// The authority behind the brokers' certificates, unless systems already trust it.
    pin: Option<CaPin>,
    /// Only one test at a time: the test accounts would displace each other.
    checking: tokio::sync::Mutex<()>,
}

/// An account at an external broker.
struct Account {
    user_name: String,
    password: String,
    role: Role,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Role {
    Server,
    Robot,
    /// One of the two accounts for testing the broker. They may neither publish nor subscribe.
    Probe,
}

impl Account {
    /// Whether the password was derived from the server's secret.
    fn is_derived(&self) -> bool {
        self.role != Role::Server
    }
}

impl MqttAccess {
    /// Robots connect to the embedded broker with their tokens. `tls`: the broker speaks TLS.
    pub fn embedded(host: Option<String>, port: u16, prefix: TopicPrefix, tls: bool) -> Self {
        let endpoint =
            MqttEndpoint { host, port, prefix, tls, external: None, alternatives: Vec::new() };
        Self { endpoint, external: None }
    }

    /// Robots connect to the external `brokers`, at `host` and `port` if given, and verify them by
    /// `pin` if given. `current` is the one that the server was connected to last.
    pub fn external(
        brokers: BrokerUrls,
        current: Arc<AtomicUsize>,
        pin: Option<CaPin>,
        host: Option<String>,
        port: Option<u16>,
        prefix: TopicPrefix,
        secret: [u8; 32],
    ) -> Self {
        let place = |url: &BrokerUrl| BrokerAddress {
            // A loopback host is this machine: robots elsewhere reach the broker at the server's
            // host.
            host: host.clone().or_else(|| (!url.is_loopback()).then(|| url.host.clone())),
            port: port.unwrap_or(url.port),
            tls: url.tls,
        };
        let places: Vec<BrokerAddress> = brokers.all().iter().map(place).collect();
        let BrokerAddress { host, port, tls } = place(brokers.first());
        let endpoint =
            MqttEndpoint { host, port, prefix, tls, external: None, alternatives: Vec::new() };
        let checking = tokio::sync::Mutex::default();
        Self {
            endpoint,
            external: Some(External { secret, brokers, places, current, pin, checking }),
        }
    }

    /// The robot's connection settings. With several brokers, the server's current broker is first.
    pub fn endpoint_of(&self, credential: &BrokerCredential) -> MqttEndpoint {
        let Some(external) = &self.external else { return self.endpoint.clone() };
        let mut places = external.places.clone();
        let current = external.current.load(Ordering::Relaxed).min(places.len() - 1);
        let BrokerAddress { host, port, tls } = places.remove(current);
        let account = ExternalBroker {
            password: external.password_of(credential),
            client_id: Some(external.client_id_of(credential)),
            ca_pin: external.pin,
        };
        MqttEndpoint {
            host,
            port,
            tls,
            external: Some(account),
            alternatives: places,
            ..self.endpoint.clone()
        }
    }

    /// Whether robots connect to an external broker.
    pub fn is_external(&self) -> bool {
        self.external.is_some()
    }

    /// Mosquitto's files for the server and these robots; `None` without an external broker.
    /// Computing takes a moment for each robot.
    pub fn files(&self, robots: &[BrokerCredential]) -> Option<BrokerFiles> {
        let external = self.external.as_ref()?;
        let url = external.brokers.first();
        let accounts = external.accounts(robots);
        Some(BrokerFiles {
            acl: mosquitto::acl(&url.user_name, &self.endpoint.prefix),
            passwd: accounts
                .iter()
                .map(|account| mosquitto::passwd_line(external, account))
                .collect(),
            conf: mosquitto::conf(url),
        })
    }

    /// A NATS server's file for the server and these robots; `None` without an external broker.
    pub fn nats_file(&self, robots: &[BrokerCredential]) -> Option<NatsFile> {
        let external = self.external.as_ref()?;
        let authorization =
            nats::authorization(external, &external.accounts(robots), &self.endpoint.prefix);
        let authorization = authorization
            .inspect_err(|error| tracing::error!(%error, "a password can't be hashed with bcrypt"));
        Some(NatsFile { authorization: authorization.ok()? })
    }

    /// Tests whether an account at each external broker can end the session of another account by
    /// connecting with its client id; `None` without an external broker. The two accounts and the
    /// client id exist only for this test.
    pub async fn check(&self) -> Option<Vec<BrokerCheck>> {
        let external = self.external.as_ref()?;
        let _guard = external.checking.lock().await;
        let probes = external.probes();
        let logins = [0, 1].map(|at: usize| MqttLogin {
            user_name: &probes[at].user_name,
            password: &probes[at].password,
        });
        let checks = external.brokers.all().iter().map(async |url| {
            let client_id = format!("{}-{:016x}", probes[0].user_name, rand::random::<u64>());
            let route = external_route(url, external.pin);
            let (displaces, problem) =
                match timeout(CHECK_TIMEOUT, displaces(&route, &client_id, logins)).await {
                    Ok(Ok(displaces)) => (Some(displaces), None),
                    Ok(Err(error)) => (None, Some(error.to_string())),
                    Err(_) => (
                        None,
                        Some(format!(
                            "the broker does not answer within {} s",
                            CHECK_TIMEOUT.as_secs()
                        )),
                    ),
                };
            BrokerCheck { address: url.address(), displaces, problem }
        });
        Some(join_all(checks).await)
    }
}

/// The server's client id at an external broker. The id is stable over restarts, so a session that
/// the network has lost ends when the next one begins. Because the id is derived from the secret,
/// no other client can connect with it.
pub fn server_client_id(secret: &[u8; 32]) -> String {
    format!("taskd-{}", URL_SAFE_NO_PAD.encode(&derived(secret, "client id of the server")[..16]))
}

fn derived(secret: &[u8; 32], purpose: &str) -> [u8; 32] {
    let mut mac = Hmac::<Sha256>::new_from_slice(secret).expect("HMAC takes keys of any length");
    mac.update(purpose.as_bytes());
    mac.finalize().into_bytes().into()
}

impl External {
    fn password_of(&self, BrokerCredential { robot, number }: &BrokerCredential) -> String {
        URL_SAFE_NO_PAD.encode(self.derived(&format!("password {robot} {number}")))
    }

    /// Begins with the robot id, for readers of the broker's log.
    fn client_id_of(&self, BrokerCredential { robot, number }: &BrokerCredential) -> String {
        let secret = self.derived(&format!("client id {robot} {number}"));
        format!("{robot}-{}", URL_SAFE_NO_PAD.encode(&secret[..16]))
    }

    /// The accounts of the server, of the test and of the robots.
    fn accounts(&self, robots: &[BrokerCredential]) -> Vec<Account> {
        let url = self.brokers.first();
        let (user_name, password) = (url.user_name.clone(), url.password.clone());
        let mut accounts = vec![Account { user_name, password, role: Role::Server }];
        accounts.extend(self.probes());
        accounts.extend(robots.iter().map(|credential| Account {
            user_name: credential.robot.to_string(),
            password: self.password_of(credential),
            role: Role::Robot,
        }));
        accounts
    }

    /// The two accounts for testing the broker.
    fn probes(&self) -> [Account; 2] {
        [1, 2].map(|number| Account {
            user_name: format!("{}-probe-{number}", self.brokers.first().user_name),
            password: URL_SAFE_NO_PAD.encode(self.derived(&format!("password of probe {number}"))),
            role: Role::Probe,
        })
    }

    fn derived(&self, purpose: &str) -> [u8; 32] {
        derived(&self.secret, purpose)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn access(secret: u8) -> MqttAccess {
        external("mqtt://server:hunter2@localhost:1884", None, None, secret)
    }

    fn external(brokers: &str, host: Option<String>, port: Option<u16>, secret: u8) -> MqttAccess {
        let brokers = brokers.parse().expect("valid");
        MqttAccess::external(
            brokers,
            Arc::default(),
            None,
            host,
            port,
            TopicPrefix::default(),
            [secret; 32],
        )
    }

    fn credential(robot: &str, number: u64) -> BrokerCredential {
        BrokerCredential { robot: robot.parse().expect("valid"), number }
    }

    #[test]
    fn password_is_unique_per_robot_and_enrollment() {
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
    fn loopback_broker_is_reached_at_the_servers_host() {
        let endpoint = access(1).endpoint_of(&credential("r00000000000000a1", 0));
        assert_eq!((endpoint.host, endpoint.port), (None, 1884));
        let url = "mqtt://server:hunter2@broker.lab";
        let (host, port) = (Some("wifi.lab".to_owned()), Some(1999));
        let named = external(url, None, None, 1);
        let configured = external(url, host.clone(), port, 1);
        assert_eq!(
            (named.endpoint.host.as_deref(), named.endpoint.port),
            (Some("broker.lab"), 1883)
        );
        assert_eq!((configured.endpoint.host, configured.endpoint.port), (host, 1999));
    }

    #[test]
    fn broker_files_change_only_with_a_password() {
        let robots = [credential("r00000000000000a1", 0), credential("r00000000000000b2", 3)];
        let files = access(1).files(&robots).expect("external");
        assert_eq!(access(1).files(&robots).expect("external").passwd, files.passwd);
        let lines: Vec<&str> = files.passwd.lines().collect();
        assert!(
            lines[0].starts_with("server:$7$20000$")
                && lines[4].starts_with("r00000000000000b2:$7$101$")
        );
        assert!(
            lines[1].starts_with("server-probe-1:$7$101$")
                && lines[2].starts_with("server-probe-2:$7$101$")
        );
        let changed = access(1)
            .files(&[robots[0].clone(), credential("r00000000000000b2", 4)])
            .expect("external");
        let changed: Vec<&str> = changed.passwd.lines().collect();
        assert_eq!(changed[..4], lines[..4]);
        assert_ne!(changed[4], lines[4]);
        assert!(!files.passwd.contains("hunter2"));
        assert!(files.acl.contains("\npattern write taskd/v1/r/%u/status\n"), "{}", files.acl);
        assert!(
            MqttAccess::embedded(None, 1, TopicPrefix::default(), false).files(&robots).is_none()
        );
    }

    #[test]
    fn client_id_depends_on_secret_and_enrollment() {
        let id = |secret, robot, number| {
            let endpoint = access(secret).endpoint_of(&credential(robot, number));
            endpoint.external.expect("external").client_id.expect("a client id")
        };
        let a = id(1, "r00000000000000a1", 0);
        assert!(a.starts_with("r00000000000000a1-") && a.len() == 17 + 1 + 22, "{a}");
        assert_eq!(id(1, "r00000000000000a1", 0), a);
        assert!(
            [id(2, "r00000000000000a1", 0), id(1, "r00000000000000a1", 1)]
                .iter()
                .all(|other| *other != a)
        );
        assert_ne!(server_client_id(&[1; 32]), server_client_id(&[2; 32]));
    }

    #[test]
    fn current_broker_is_the_first_endpoint_of_robots() {
        let brokers =
            "mqtt://server:x@one.lab,mqtts://server:x@two.lab,mqtt://server:x@127.0.0.1:7";
        let current = Arc::new(AtomicUsize::new(0));
        let brokers = brokers.parse().expect("valid");
        let access = MqttAccess::external(
            brokers,
            current.clone(),
            None,
            None,
            None,
            TopicPrefix::default(),
            [1; 32],
        );
        let endpoints = || {
            let endpoint = access.endpoint_of(&credential("r00000000000000a1", 0));
            let first =
                BrokerAddress { host: endpoint.host, port: endpoint.port, tls: endpoint.tls };
            let places: Vec<BrokerAddress> =
                [first].into_iter().chain(endpoint.alternatives).collect();
            places
                .into_iter()
                .map(|place| (place.host.unwrap_or_default(), place.port, place.tls))
                .collect::<Vec<_>>()
        };
        let [one, two, three] = [("one.lab", 1883, false), ("two.lab", 8883, true), ("", 7, false)]
            .map(|(h, p, t)| (h.to_owned(), p, t));
        assert_eq!(endpoints(), [one.clone(), two.clone(), three.clone()]);
        current.store(1, Ordering::Relaxed);
        assert_eq!(endpoints(), [two, one, three]);
    }

    #[test]
    fn nats_file_allows_robots_their_own_subjects_only() {
        let robots = [credential("r00000000000000a1", 0)];
        let nats = access(1).nats_file(&robots).expect("external").authorization;
        assert_eq!(access(1).nats_file(&robots).expect("external").authorization, nats);
        let robot = nats.split("r00000000000000a1\", password").nth(1).expect("the robot's user");
        assert!(
            robot.starts_with(": \"$2a$04$")
                && robot.contains("allowed_connection_types: [\"MQTT\"]"),
            "{nats}"
        );
        assert!(
            robot.contains("publish: { allow: [\"taskd.v1.r.r00000000000000a1.status\", "),
            "{nats}"
        );
        assert!(
            robot.contains("subscribe: { allow: [\"taskd.v1.r.r00000000000000a1.desired\", "),
            "{nats}"
        );
        assert!(
            !nats.contains("$MQTT") && !nats.contains("deny"),
            "NATS needs its own subjects: {nats}"
        );
        assert!(
            !nats.contains("hunter2") && nats.contains("user: \"server\", password: \"$2a$11$"),
            "{nats}"
        );
        let files = access(1).files(&robots).expect("external");
        assert!(
            files.conf.contains("\nlistener 1884\n")
                && files.conf.contains("\nuse_username_as_clientid true\n")
        );
    }
}
