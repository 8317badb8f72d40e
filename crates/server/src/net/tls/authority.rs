//! The private certificate authority: created on the first start, kept for ever, known to robots by
//! its pin. The authority certifies this server alone. The keys of issued certificates live in
//! memory and are replaced at every start.

use std::net::IpAddr;
use std::time::Duration;

use rcgen::{
    BasicConstraints, CertificateParams, DistinguishedName, DnType, ExtendedKeyUsagePurpose, IsCa,
    Issuer, KeyPair, KeyUsagePurpose, PublicKeyData as _, SanType, date_time_ymd,
};
use rustls::crypto::ring;
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, PrivatePkcs8KeyDer};
use rustls::sign::CertifiedKey;
use task_proto::CaPin;
use task_transport::pin_of;

use super::TlsError;
use crate::system::data_directory::DataDirectory;

/// The first year of validity of the authority's certificate and of certificates for robots: no
/// plausible clock is earlier.
const FIRST_YEAR: i32 = 2020;
/// The last year of validity; the authority has no successor.
const LAST_YEAR: i32 = 2120;
/// How far a robot's clock may be ahead.
const ROBOTS_LIFETIME: Duration = Duration::from_secs(3650 * 86_400);
/// Browsers reject certificates that are valid for longer than 398 days.
const BROWSERS_LIFETIME: Duration = Duration::from_secs(397 * 86_400);
/// How far a browser's clock may be behind.
const BROWSERS_SLACK: Duration = Duration::from_secs(86_400);

/// The clients for which a certificate is issued.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Audience {
    /// Clients that know the pin.
    Robots,
    /// Clients that have imported the authority's certificate.
    Browsers,
}

/// The authority's certificate and key.
pub(super) struct Authority {
    issuer: Issuer<'static, KeyPair>,
    certificate: CertificateDer<'static>,
    pin: CaPin,
}

impl Authority {
    /// Reads the authority, or creates it.
    pub(super) fn open(data: &DataDirectory) -> Result<Self, TlsError> {
        let key = data.authority_key(KeyPair::generate()?.serialize_pem())?;
        let key = KeyPair::from_pem(&key).map_err(|_| data.authority_error(true))?;
        let pin = CaPin::of(&key.subject_public_key_info());
        let params = authority_params(&pin)?;
        let certificate = data.authority_certificate(params.self_signed(&key)?.pem())?;
        let certificate = CertificateDer::from_pem_slice(certificate.as_bytes()).ok();
        let certificate = certificate.filter(|certificate| pin_of(certificate) == Some(pin));
        let certificate = certificate.ok_or_else(|| data.authority_error(false))?;
        Ok(Self { issuer: Issuer::new(params, key), certificate, pin })
    }

    pub(super) fn pin(&self) -> CaPin {
        self.pin
    }

    /// Issues a certificate for the server under these names, with a new key.
    pub(super) fn issue(
        &self,
        audience: Audience,
        names: &[String],
        now_ms: u64,
    ) -> Result<CertifiedKey, TlsError> {
        let mut params = CertificateParams::default();
        params.subject_alt_names = names.iter().filter_map(|name| subject(name)).collect();
        params.distinguished_name = named("taskd");
        params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
        params.extended_key_usages = vec![ExtendedKeyUsagePurpose::ServerAuth];
        params.use_authority_key_identifier_extension = true;
        let now = date_time_ymd(1970, 1, 1) + Duration::from_millis(now_ms);
        (params.not_before, params.not_after) = match audience {
            Audience::Robots => (date_time_ymd(FIRST_YEAR, 1, 1), now + ROBOTS_LIFETIME),
            Audience::Browsers => (now - BROWSERS_SLACK, now + BROWSERS_LIFETIME - BROWSERS_SLACK),
        };
        let key = KeyPair::generate()?;
        let certificate = params.signed_by(&key, &self.issuer)?.der().clone();
        let key = PrivatePkcs8KeyDer::from(key.serialize_der());
        // Includes the authority's own certificate: without it a client that knows only the pin
        // can't recognize the authority.
        let chain = vec![certificate, self.certificate.clone()];
        CertifiedKey::from_der(chain, key.into(), &ring::default_provider())
            .map_err(TlsError::Unusable)
    }
}

/// The content of the authority's certificate depends only on its key, so issued certificates fit a
/// copy of any age.
fn authority_params(pin: &CaPin) -> Result<CertificateParams, rcgen::Error> {
    let mut params = CertificateParams::new(Vec::new())?;
    params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
    params.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
    params.distinguished_name = named(&format!("taskd authority {}", &pin.to_string()[..16]));
    (params.not_before, params.not_after) =
        (date_time_ymd(FIRST_YEAR, 1, 1), date_time_ymd(LAST_YEAR, 1, 1));
    Ok(params)
}

fn named(common_name: &str) -> DistinguishedName {
    let mut name = DistinguishedName::new();
    name.push(DnType::CommonName, common_name);
    name
}

/// The name in the form of certificates; `None` if it can't be represented.
fn subject(name: &str) -> Option<SanType> {
    match name.parse::<IpAddr>() {
        Ok(address) => Some(SanType::IpAddress(address)),
        Err(_) => name.try_into().ok().map(SanType::DnsName),
    }
}
