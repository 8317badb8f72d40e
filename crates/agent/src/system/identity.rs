//! The robot's identity: `identity.json` (0600), written by `enroll` and when the token changes,
//! and the MAC address that the robot was registered by. Finding the MAC reads `/sys/class/net`;
//! this module does not talk to the server.

use std::io;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use task_proto::api::MqttEndpoint;
use task_proto::trust::envelope::PublicKey;
use task_proto::{CaPin, MacAddress, RobotId};
use task_transport::ClientKey;

use crate::system::durable;
use crate::system::permanent_address;

/// The kernel's directory of network interfaces.
const INTERFACES: &str = "/sys/class/net";
/// Value of `addr_assign_type` for the hardware's own address.
const PERMANENT: &str = "0";

#[derive(Clone, Serialize, Deserialize)]
pub struct Identity {
    /// The robot's permanent id at the server.
    pub robot_id: RobotId,
    /// The robot's bearer token and MQTT password.
    pub token: String,
    /// The next token, from before its first use until the agent has seen it work.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub next_token: Option<String>,
    /// Time from which `token` has been in use, by this robot's clock.
    #[serde(default)]
    pub token_since_ms: u64,
    /// The server that the robot registered at.
    pub server: String,
    /// The key that signs the robot's desired states.
    pub server_key: PublicKey,
    /// The certificate authority of the server's certificate; absent: the system's roots verify the
    /// server's certificate, if it has one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ca_pin: Option<CaPin>,
    /// The robot's key for TLS client authentication.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub client_key: Option<ClientKey>,
    /// Address of the MQTT broker.
    pub mqtt: MqttEndpoint,
    /// The MAC address that the robot was registered by.
    pub mac: MacAddress,
    /// Whether the robot was waiting for approval at the last answer to `enroll`.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub awaits_approval: bool,
}

/// The identity can't be read or written.
#[derive(Debug, thiserror::Error)]
pub enum IdentityError {
    /// The robot has no identity.
    #[error("this robot is not registered: run task-agent enroll (no {0})")]
    Missing(PathBuf),
    /// Reading or writing the file failed.
    #[error("cannot use {path}")]
    Io { path: PathBuf, source: io::Error },
    /// The file is not an identity.
    #[error("{path} is not an identity")]
    Malformed { path: PathBuf, source: serde_json::Error },
}

/// Reasons why no MAC address was chosen.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum MacError {
    /// There is no physical network interface.
    #[error(
        "no physical network interface with an address was found: give the robot's MAC with --mac"
    )]
    NoneFound,
    /// All interfaces have addresses other than the permanent one of the hardware.
    #[error(
        "the addresses of this robot's network interfaces are not those of the hardware ({0}): \
         give the robot's MAC with --mac"
    )]
    NotPermanent(String),
}

impl Identity {
    pub fn read(path: &Path) -> Result<Self, IdentityError> {
        match std::fs::read(path) {
            Ok(bytes) => serde_json::from_slice(&bytes)
                .map_err(|source| IdentityError::Malformed { path: path.to_owned(), source }),
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                Err(IdentityError::Missing(path.to_owned()))
            }
            Err(source) => Err(IdentityError::Io { path: path.to_owned(), source }),
        }
    }

    /// Writes the identity, readable by its owner only.
    pub fn write(&self, path: &Path) -> Result<(), IdentityError> {
        let bytes = serde_json::to_vec_pretty(self)
            .map_err(|source| IdentityError::Malformed { path: path.to_owned(), source })?;
        durable::write(path, &bytes, 0o600)
            .map_err(|source| IdentityError::Io { path: path.to_owned(), source })
    }
}

/// Runs [`find_mac`] on this machine.
pub fn find_own_mac() -> Result<MacAddress, MacError> {
    // An interface that can't be queried counts as one without an answer.
    find_mac(Path::new(INTERFACES), |name| permanent_address::of(name).ok().flatten())
}

/// The MAC address to register by: the permanent address of the first physical interface below
/// `interfaces`, by name, so that `eth0` comes before `wlan0`. For an interface that uses another
/// address, `permanent` returns the hardware's own, if possible.
pub fn find_mac(
    interfaces: &Path,
    permanent: impl Fn(&str) -> Option<MacAddress>,
) -> Result<MacAddress, MacError> {
    let read = |dir: &Path, file: &str| {
        std::fs::read_to_string(dir.join(file)).map(|text| text.trim().to_owned())
    };
    let mut dirs: Vec<PathBuf> = std::fs::read_dir(interfaces)
        .into_iter()
        .flatten()
        .flatten()
        .map(|entry| entry.path())
        .collect();
    dirs.sort();
    let mut not_permanent = Vec::new();
    for dir in dirs {
        // A bridge, a tunnel or a container's interface has no device behind it.
        let is_physical = dir.join("device").exists();
        let Some(mac) = read(&dir, "address").ok().and_then(|text| text.parse::<MacAddress>().ok())
        else {
            continue;
        };
        if !is_physical {
            continue;
        }
        let name = dir.file_name().unwrap_or_default().to_string_lossy();
        let is_own = read(&dir, "addr_assign_type").is_ok_and(|kind| kind == PERMANENT);
        let own = if is_own { Some(mac) } else { permanent(&name) };
        if let Some(own) = own.filter(|own| !own.is_locally_administered()) {
            return Ok(own);
        }
        not_permanent.push(format!("{name} {mac}"));
    }
    if not_permanent.is_empty() {
        Err(MacError::NoneFound)
    } else {
        Err(MacError::NotPermanent(not_permanent.join(", ")))
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt as _;

    use super::*;

    fn interface(root: &Path, name: &str, address: &str, assign_type: &str, physical: bool) {
        let dir = root.join(name);
        std::fs::create_dir_all(&dir).expect("made");
        std::fs::write(dir.join("address"), format!("{address}\n")).expect("written");
        std::fs::write(dir.join("addr_assign_type"), format!("{assign_type}\n")).expect("written");
        if physical {
            std::fs::create_dir(dir.join("device")).expect("made");
        }
    }

    #[test]
    fn mac_is_a_physical_permanent_address() {
        let root = tempfile::tempdir().expect("a directory");
        assert_eq!(find_mac(root.path(), |_| None), Err(MacError::NoneFound));
        interface(root.path(), "docker0", "00:11:22:33:44:50", "0", false);
        interface(root.path(), "lo", "00:00:00:00:00:00", "0", false);
        assert_eq!(find_mac(root.path(), |_| None), Err(MacError::NoneFound));
        interface(root.path(), "eth0", "02:11:22:33:44:51", "0", true);
        interface(root.path(), "usb0", "00:11:22:33:44:52", "1", true);
        let error =
            find_mac(root.path(), |_| None).expect_err("only made-up addresses").to_string();
        assert!(
            error.contains("eth0 02:11:22:33:44:51")
                && error.contains("usb0")
                && error.contains("--mac")
        );
        // The Wi-Fi interface uses a made-up address, but its hardware has a permanent one.
        let burned_in =
            |name: &str| (name == "usb0").then(|| "00:11:22:33:44:99".parse().expect("valid"));
        assert_eq!(
            find_mac(root.path(), burned_in).expect("found").to_string(),
            "00:11:22:33:44:99"
        );
        interface(root.path(), "wlan0", "00:11:22:33:44:53", "0", true);
        assert_eq!(
            find_mac(root.path(), |_| None).expect("found").to_string(),
            "00:11:22:33:44:53"
        );
    }

    #[test]
    fn identity_is_private_and_reads_back() {
        let dir = tempfile::tempdir().expect("a directory");
        let path = dir.path().join("identity.json");
        assert!(matches!(Identity::read(&path), Err(IdentityError::Missing(_))));
        let identity = Identity {
            robot_id: RobotId::random(),
            token: "tskr_…".to_owned(),
            next_token: None,
            token_since_ms: 0,
            server: "http://server".to_owned(),
            server_key: task_proto::trust::envelope::SigningKey::random().public_key(),
            ca_pin: None,
            client_key: None,
            mqtt: MqttEndpoint {
                host: None,
                port: 1883,
                prefix: Default::default(),
                tls: false,
                external: None,
                alternatives: Vec::new(),
            },
            mac: "02:00:00:00:00:01".parse().expect("valid"),
            awaits_approval: false,
        };
        identity.write(&path).expect("written");
        assert_eq!(std::fs::metadata(&path).expect("there").permissions().mode() & 0o777, 0o600);
        assert_eq!(Identity::read(&path).expect("read").robot_id, identity.robot_id);
    }
}
