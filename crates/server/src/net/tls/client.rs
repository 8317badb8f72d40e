//! Clients' proof of identity in the handshake. A client may present any certificate with an
//! ed25519 key, from any issuer. The certificate only proves possession of the key; other modules
//! know the owner of the key.

use std::sync::Arc;

use rustls::client::danger::HandshakeSignatureValid;
use rustls::crypto::{
    WebPkiSupportedAlgorithms, ring, verify_tls12_signature, verify_tls13_signature,
};
use rustls::pki_types::{CertificateDer, UnixTime};
use rustls::server::danger::{ClientCertVerified, ClientCertVerifier};
use rustls::{CertificateError, DigitallySignedStruct, DistinguishedName, Error, SignatureScheme};
use task_proto::trust::envelope::PublicKey;
use task_transport::key_in;

/// A client's proof by a certificate of its own.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub enum ClientProof {
    /// The server did not request a certificate.
    #[default]
    NotRequested,
    /// The client presented none.
    NoCertificate,
    /// The client holds this key.
    Holds(PublicKey),
}

impl ClientProof {
    /// Whether the proof is sufficient for a client that has registered this key, if any.
    pub fn suffices(&self, registered: Option<&PublicKey>) -> bool {
        match (self, registered) {
            (Self::NotRequested, _) | (_, None) => true,
            (Self::NoCertificate, Some(_)) => false,
            (Self::Holds(key), Some(registered)) => key == registered,
        }
    }

    /// The proof from the certificates that a client presented on request.
    pub(super) fn of(presented: Option<&[CertificateDer<'_>]>) -> Self {
        presented.and_then(<[_]>::first).and_then(key_in).map_or(Self::NoCertificate, Self::Holds)
    }
}

/// Accepts every certificate with an ed25519 key, and also none.
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
