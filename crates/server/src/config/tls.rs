//! `[tls]`: whether the listeners encrypt, and with which certificate.

use std::path::PathBuf;
use std::time::Duration;

/// The settings of the table `[tls]`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TlsSettings {
    /// The file with the operator's own certificate chain. Requires `key`.
    pub certificate: Option<PathBuf>,
    /// The file with its key.
    pub key: Option<PathBuf>,
    /// Whether robots are told the pin of the private authority, which then also issues the
    /// certificate if the operator provides none. Absent: chosen by the listeners' addresses.
    pub private_ca: Option<bool>,
    /// Additional names and addresses in the authority's certificates.
    pub names: Vec<String>,
    /// Whether robots must prove possession of their registered key.
    pub client_certificates: bool,
    /// Interval between checks of the operator's files.
    pub check_interval: Duration,
}

impl Default for TlsSettings {
    fn default() -> Self {
        Self {
            certificate: None,
            key: None,
            private_ca: None,
            names: Vec::new(),
            client_certificates: false,
            check_interval: Duration::from_secs(10),
        }
    }
}

impl TlsSettings {
    /// The operator's own certificate and its key.
    pub fn own_files(&self) -> Option<(PathBuf, PathBuf)> {
        self.certificate.clone().zip(self.key.clone())
    }

    /// Whether robots are told to trust only the private authority.
    pub fn announces_pin(&self) -> bool {
        self.private_ca.unwrap_or(self.certificate.is_none())
    }

    /// Whether the listeners encrypt, given whether other machines can reach one of them.
    pub(super) fn encrypts(&self, is_exposed: bool, allow_plaintext: bool) -> bool {
        let by_default = is_exposed && !allow_plaintext;
        self.certificate.is_some() || self.private_ca.unwrap_or(by_default)
    }
}
