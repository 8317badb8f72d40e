//! `[tls]`: whether the listeners encrypt, and by whose certificate.

use std::path::PathBuf;
use std::time::Duration;

/// `[tls]`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TlsSettings {
    /// The file with the operator's own certificate chain. Not without `key`.
    pub certificate: Option<PathBuf>,
    /// The file with its key.
    pub key: Option<PathBuf>,
    /// Whether robots are told the pin of the private authority, which then also makes the
    /// certificate if there is no own one. Absent: as is best for the addresses that are listened
    /// on.
    pub private_ca: Option<bool>,
    /// Names and addresses that the authority's certificates are also good for.
    pub names: Vec<String>,
    /// Whether robots have to show the key that they registered.
    pub client_certificates: bool,
    /// How often the operator's files are looked at.
    pub look_interval: Duration,
}

impl Default for TlsSettings {
    fn default() -> Self {
        Self {
            certificate: None,
            key: None,
            private_ca: None,
            names: Vec::new(),
            client_certificates: false,
            look_interval: Duration::from_secs(10),
        }
    }
}

impl TlsSettings {
    /// The operator's own certificate and its key.
    pub fn own_files(&self) -> Option<(PathBuf, PathBuf)> {
        self.certificate.clone().zip(self.key.clone())
    }

    /// Whether robots are told to trust the private authority alone.
    pub fn tells_pin(&self) -> bool {
        self.private_ca.unwrap_or(self.certificate.is_none())
    }

    /// Whether the listeners encrypt, if one of them is reached from other machines or not.
    pub(super) fn encrypts(&self, is_reached_from_elsewhere: bool, allow_plaintext: bool) -> bool {
        let by_default = is_reached_from_elsewhere && !allow_plaintext;
        self.certificate.is_some() || self.private_ca.unwrap_or(by_default)
    }
}
