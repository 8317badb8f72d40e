//! TLS of a run: the configuration of its clients, and a certificate for the program that taskd is
//! compared with.

use anyhow::Context as _;
use rcgen::{BasicConstraints, CertificateParams, IsCa, Issuer, KeyPair};
use rustls::ClientConfig;
use rustls::client::Resumption;
use task_agent::system::clock;
use task_proto::CaPin;
use task_transport::{Trust, pin_of};

/// Servers that a client knows again.
const SESSIONS: usize = 2;
/// The note in a result with encryption.
pub const ENCRYPTION_NOTE: &str =
    "Every connection is TLS 1.3, each client checks the server's certificate.";

/// TLS configuration for a server whose authority has this pin; without a pin, the system's root
/// certificates apply.
pub fn client_config(pin: Option<CaPin>) -> ClientConfig {
    Trust::by(pin).client_config(clock::for_certificates())
}

/// A configuration for another client, without shared session state: tickets from the server to one
/// client are unknown to the other.
pub fn without_shared_sessions(tls: &ClientConfig) -> ClientConfig {
    let mut own = tls.clone();
    own.resumption = Resumption::in_memory_sessions(SESSIONS);
    own
}

/// A certificate for 127.0.0.1 by an authority that is forgotten at once.
pub struct Certificate {
    /// The certificate and the authority's, PEM.
    pub chain: String,
    pub key: String,
    pub pin: CaPin,
}

impl Certificate {
    /// A fresh authority, and a server certificate signed by that authority.
    pub fn new() -> anyhow::Result<Self> {
        let mut params = CertificateParams::new(Vec::new())?;
        params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
        let authority_key = KeyPair::generate()?;
        let key = KeyPair::generate()?;
        let authority = params.self_signed(&authority_key)?;
        let pin = pin_of(authority.der()).context("the authority's certificate is none")?;
        let issuer = Issuer::new(params, authority_key);
        let own = CertificateParams::new(vec!["127.0.0.1".to_owned()])?.signed_by(&key, &issuer)?;
        Ok(Self { chain: own.pem() + &authority.pem(), key: key.serialize_pem(), pin })
    }
}
