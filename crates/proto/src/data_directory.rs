//! Owns the layout of a server's data directory that other programs on its machine rely on: its
//! default path, and the names and content of files; it never reads or writes the directory.

use std::ffi::OsString;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::CaPin;

/// The file that a running server keeps locked.
pub const LOCK: &str = "taskd.lock";
/// The file with the first operator's token.
pub const OPERATOR_TOKEN: &str = "operator.token";
/// The file with the key that signs desired states.
pub const SIGNING_KEY: &str = "signing.key";
/// The file with the key of the private certificate authority.
pub const AUTHORITY_KEY: &str = "ca.key";
/// The file with the authority's certificate.
pub const AUTHORITY_CERTIFICATE: &str = "ca.pem";
/// The file with the secret from which robots' passwords at an external broker are derived.
pub const BROKER_SECRET: &str = "broker.secret";
/// The files that all servers of a cluster share.
pub const SECRETS: [&str; 5] =
    [SIGNING_KEY, AUTHORITY_KEY, AUTHORITY_CERTIFICATE, BROKER_SECRET, OPERATOR_TOKEN];
/// The file with the bound [`Addresses`].
pub const ADDRESSES: &str = "addresses.json";

/// The default data directory, from the environment's variables.
pub fn default_data_directory(variable: impl Fn(&str) -> Option<OsString>) -> Option<PathBuf> {
    let set = |name| variable(name).filter(|value| !value.is_empty()).map(PathBuf::from);
    let base =
        set("XDG_DATA_HOME").or_else(|| set("HOME").map(|home| home.join(".local/share")))?;
    Some(base.join("taskd"))
}

/// The bound addresses, for programs on the same machine: the content of [`ADDRESSES`], which
/// exists while a server runs.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Addresses {
    /// The HTTP address, `host:port`.
    pub http: String,
    /// The MQTT address, `host:port`.
    pub mqtt: String,
    /// The pin of the authority behind the certificates of both listeners; present only if they
    /// speak TLS.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ca_pin: Option<CaPin>,
}

impl Addresses {
    /// The base URL of the HTTP listener.
    pub fn url(&self) -> String {
        let scheme = if self.ca_pin.is_some() { "https" } else { "http" };
        format!("{scheme}://{}", self.http)
    }
}
