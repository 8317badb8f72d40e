//! A client's own key, and the certificate by which the client proves possession of the key. The
//! certificate carries no other statement: no authority signs it, and a peer that knows the key
//! knows its owner.

use std::fmt;
use std::sync::Arc;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use rcgen::{CertificateParams, DistinguishedName, ExtendedKeyUsagePurpose, KeyPair, PKCS_ED25519};
use rustls::ClientConfig;
use rustls::crypto::ring;
use rustls::pki_types::{CertificateDer, PrivatePkcs8KeyDer};
use rustls::server::ParsedCertificate;
use rustls::sign::{CertifiedKey, SingleCertAndKey};
use serde::{Deserialize, Serialize};
use task_proto::trust::envelope::{PublicKey, SigningKey};

/// DER prefix before the seed in an ed25519 key as PKCS #8 (RFC 8410, section 7).
const PKCS8_PREFIX: [u8; 16] = [
    0x30, 0x2e, 0x02, 0x01, 0x00, 0x30, 0x05, 0x06, 0x03, 0x2b, 0x65, 0x70, 0x04, 0x22, 0x04, 0x20,
];
/// DER prefix before the key in its SubjectPublicKeyInfo.
const INFO_PREFIX: [u8; 12] =
    [0x30, 0x2a, 0x30, 0x05, 0x06, 0x03, 0x2b, 0x65, 0x70, 0x03, 0x21, 0x00];

/// An ed25519 key. Its text is the base64 of its seed, for a file of mode 0600.
#[derive(Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct ClientKey(SigningKey);

/// A text that is no such key.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("not a key: expected 32 bytes in base64")]
pub struct InvalidKey;

/// The certificate can't be created.
#[derive(Debug, thiserror::Error)]
#[error("could not create a certificate with this key")]
pub struct CertificateError(#[source] Box<dyn std::error::Error + Send + Sync>);

impl ClientKey {
    /// A fresh random key.
    pub fn random() -> Self {
        Self(SigningKey::random())
    }

    /// The public key, by which the other side identifies the client.
    pub fn public_key(&self) -> PublicKey {
        self.0.public_key()
    }

    /// Makes `config` present the certificate to servers that request one.
    pub fn show_in(&self, config: &mut ClientConfig) -> Result<(), CertificateError> {
        let certificate = self.certificate().map_err(CertificateError)?;
        config.client_auth_cert_resolver = Arc::new(SingleCertAndKey::from(certificate));
        Ok(())
    }

    fn certificate(&self) -> Result<CertifiedKey, Box<dyn std::error::Error + Send + Sync>> {
        let der = PrivatePkcs8KeyDer::from([&PKCS8_PREFIX[..], &self.0.to_bytes()].concat());
        let key = KeyPair::from_pkcs8_der_and_sign_algo(&der, &PKCS_ED25519)?;
        let mut params = CertificateParams::default();
        params.distinguished_name = DistinguishedName::new();
        params.extended_key_usages = vec![ExtendedKeyUsagePurpose::ClientAuth];
        let certificate = params.self_signed(&key)?.der().clone();
        Ok(CertifiedKey::from_der(vec![certificate], der.into(), &ring::default_provider())?)
    }
}

/// The key in a certificate; `None` for a key of another kind.
pub fn key_in(certificate: &CertificateDer<'_>) -> Option<PublicKey> {
    let parsed = ParsedCertificate::try_from(certificate).ok()?;
    let info = parsed.subject_public_key_info();
    PublicKey::from_bytes(info.strip_prefix(&INFO_PREFIX)?.try_into().ok()?)
}

impl Clone for ClientKey {
    fn clone(&self) -> Self {
        Self(SigningKey::from_bytes(self.0.to_bytes()))
    }
}

impl TryFrom<String> for ClientKey {
    type Error = InvalidKey;
    fn try_from(text: String) -> Result<Self, InvalidKey> {
        let seed = STANDARD.decode(text).ok().and_then(|seed| seed.try_into().ok());
        seed.map(|seed| Self(SigningKey::from_bytes(seed))).ok_or(InvalidKey)
    }
}

impl From<ClientKey> for String {
    fn from(key: ClientKey) -> Self {
        STANDARD.encode(key.0.to_bytes())
    }
}

impl fmt::Debug for ClientKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ClientKey").field("public_key", &self.public_key()).finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn certificate_contains_its_key() {
        let key = ClientKey::random();
        let certified = key.certificate().expect("a certificate");
        assert_eq!(key_in(&certified.cert[0]), Some(key.public_key()));
        assert_ne!(key_in(&certified.cert[0]), Some(ClientKey::random().public_key()));
        let text = String::from(key.clone());
        assert!(!format!("{key:?}").contains(&text));
        assert_eq!(ClientKey::try_from(text).expect("a key").public_key(), key.public_key());
        assert!(ClientKey::try_from("nothing".to_owned()).is_err());
    }
}
