//! What clients prove about themselves. Anybody may show any certificate with an ed25519 key, by
//! whomever it was made; what counts is that they hold the key, and whose key that is others know.

use std::sync::Arc;

use rustls::client::danger::HandshakeSignatureValid;
use rustls::crypto::{
    WebPkiSupportedAlgorithms, ring, verify_tls12_signature, verify_tls13_signature,
};
use rustls::pki_types::{CertificateDer, UnixTime};
use rustls::server::danger::{ClientCertVerified, ClientCertVerifier};
use rustls::{CertificateError, DigitallySignedStruct, DistinguishedName, Error, SignatureScheme};
use task_proto::envelope::PublicKey;
use task_transport::key_in;

/// What a client has proven by a certificate of its own.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub enum ClientProof {
    /// It was not asked to.
    #[default]
    NotAsked,
    /// Nothing.
    Nothing,
    /// That it holds this key.
    Holds(PublicKey),
}

impl ClientProof {
    /// Whether it is enough for who has registered this key, if any.
    pub fn suffices(&self, registered: Option<&PublicKey>) -> bool {
        match (self, registered) {
            (Self::NotAsked, _) | (_, None) => true,
            (Self::Nothing, Some(_)) => false,
            (Self::Holds(key), Some(registered)) => key == registered,
        }
    }

    /// Of the certificates that a client has shown, when it was asked.
    pub(super) fn of(shown: Option<&[CertificateDer<'_>]>) -> Self {
        shown.and_then(<[_]>::first).and_then(key_in).map_or(Self::Nothing, Self::Holds)
    }
}

/// Takes every certificate with an ed25519 key, and none at all.
#[derive(Debug)]
pub(super) struct AnyKey(WebPkiSupportedAlgorithms);

impl AnyKey {
    pub(super) fn new() -> Arc<Self> {
        Arc::new(Self(ring::default_provider().signature_verification_algorithms))
    }
}

impl ClientCertVerifier for AnyKey {
    fn client_auth_mandatory(&self) -> bool {
        false
    }

    fn root_hint_subjects(&self) -> &[DistinguishedName] {
        &[]
    }

    fn verify_client_cert(
        &self,
        end_entity: &CertificateDer<'_>,
        _intermediates: &[CertificateDer<'_>],
        _now: UnixTime,
    ) -> Result<ClientCertVerified, Error> {
        match key_in(end_entity) {
            Some(_) => Ok(ClientCertVerified::assertion()),
            None => Err(CertificateError::BadEncoding.into()),
        }
    }

    fn verify_tls12_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signature: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        verify_tls12_signature(message, certificate, signature, &self.0)
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signature: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        verify_tls13_signature(message, certificate, signature, &self.0)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        vec![SignatureScheme::ED25519]
    }
}
