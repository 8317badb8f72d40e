//! The operator's own certificate: a chain and its key in two PEM files, which other programs
//! replace at any time. Only a matching pair is accepted.

use std::fs::File;
use std::io::{self, Read as _};
use std::path::{Path, PathBuf};

use rustls::crypto::ring;
use rustls::pki_types::pem::{self, PemObject as _};
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::sign::CertifiedKey;
use task_proto::Digest;

use super::TlsError;

/// Maximum file size; a longer file is not a certificate or key.
const MAX_FILE_BYTES: u64 = 1024 * 1024;

/// The paths of the two files, and their content at the last check.
#[derive(Debug)]
pub(super) struct Files {
    certificate: PathBuf,
    key: PathBuf,
    seen: Option<[Digest; 2]>,
}

impl Files {
    pub(super) fn new(certificate: PathBuf, key: PathBuf) -> Self {
        Self { certificate, key, seen: None }
    }

    /// The content of the files; `None` if unchanged since the last call. An error is reported
    /// once.
    pub(super) fn read_if_changed(&mut self) -> Result<Option<CertifiedKey>, TlsError> {
        let (certificate, key) = (read(&self.certificate)?, read(&self.key)?);
        let content = [&certificate, &key].map(|bytes| Digest::of(bytes));
        if self.seen.replace(content) == Some(content) {
            return Ok(None);
        }
        self.parse(&certificate, &key).map(Some)
    }

    fn parse(&self, certificate: &[u8], key: &[u8]) -> Result<CertifiedKey, TlsError> {
        let wrong = |path: &Path, expected| TlsError::Content { path: path.to_owned(), expected };
        let chain: Result<Vec<CertificateDer<'static>>, pem::Error> =
            CertificateDer::pem_slice_iter(certificate).collect();
        let chain = chain.ok().filter(|chain| !chain.is_empty());
        let chain = chain.ok_or_else(|| wrong(&self.certificate, "a chain of certificates"))?;
        let key = PrivateKeyDer::from_pem_slice(key)
            .map_err(|_| wrong(&self.key, "an unencrypted private key"))?;
        CertifiedKey::from_der(chain, key, &ring::default_provider()).map_err(|source| {
            TlsError::Unfit { certificate: self.certificate.clone(), key: self.key.clone(), source }
        })
    }
}

fn read(path: &Path) -> Result<Vec<u8>, TlsError> {
    let read = || -> io::Result<Vec<u8>> {
        let mut bytes = Vec::new();
        File::open(path)?.take(MAX_FILE_BYTES).read_to_end(&mut bytes)?;
        Ok(bytes)
    };
    read().map_err(|source| TlsError::Unreadable { path: path.to_owned(), source })
}
