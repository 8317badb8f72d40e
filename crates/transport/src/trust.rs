//! How a client authenticates the server: by the private authority that an enrollment token pinned,
//! or by the system's root certificates and the requested name. A clock that can't be right does
//! not keep a client out.

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use rustls::client::{verify_server_cert_signed_by_trust_anchor, verify_server_name};
use rustls::crypto::{
    WebPkiSupportedAlgorithms, ring, verify_tls12_signature, verify_tls13_signature,
};
use rustls::pki_types::{CertificateDer, ServerName, UnixTime};
use rustls::server::ParsedCertificate;
use rustls::time_provider::TimeProvider;
use rustls::{
    CertificateError, ClientConfig, DigitallySignedStruct, Error, OtherError, RootCertStore,
    SignatureScheme,
};
use task_proto::CaPin;
use task_proto::trust::pin::PINNED_PROTOCOL;

/// Certificates whose start of validity a wrong clock may be moved to: more than any chain has.
const MAX_CHAIN: usize = 8;

/// The authorities a client trusts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Trust {
    /// Only the authority with this pin. That authority signs for one server only, so the server's
    /// name does not matter.
    Pinned(CaPin),
    /// The system's root certificates, with a check of the name. `SSL_CERT_FILE` and `SSL_CERT_DIR`
    /// select other root certificates.
    System,
}

/// The earliest build time of this program, in milliseconds since the Unix epoch: a clock that
/// shows less is wrong. A build that sets `SOURCE_DATE_EPOCH`, as reproducible builds do, uses that
/// time.
pub const BUILT_MS: u64 = built_ms(option_env!("SOURCE_DATE_EPOCH"));
/// 2026-01-01: the program did not exist earlier.
const BEGINNING_MS: u64 = 1_767_225_600_000;

/// A machine's clock, which may be wrong.
#[derive(Debug, Clone, Copy)]
pub struct Clock {
    /// The clock's time: milliseconds since the Unix epoch.
    pub now_ms: fn() -> u64,
    /// The earliest time that a correct clock can show.
    pub earliest_ms: u64,
}

/// The server has no certificate by the pinned authority.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WrongServer;

impl fmt::Display for WrongServer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("this is not the server whose certificate authority was pinned")
    }
}

impl std::error::Error for WrongServer {}

impl Trust {
    /// Trust in the pinned authority, or in the system's roots without a pin.
    pub fn by(pin: Option<CaPin>) -> Self {
        pin.map_or(Self::System, Self::Pinned)
    }

    /// TLS configuration of a client with this trust. Reads the system's certificates if needed.
    pub fn client_config(self, clock: Clock) -> ClientConfig {
        let provider = Arc::new(ring::default_provider());
        let algorithms = provider.signature_verification_algorithms;
        let anchor = match self {
            Self::Pinned(pin) => Anchor::Pin(pin),
            Self::System => Anchor::Roots(system_roots()),
        };
        let verifier = Verifier { anchor, algorithms, earliest: at(clock.earliest_ms) };
        let builder = ClientConfig::builder_with_details(provider, Arc::new(clock));
        let builder = builder
            .with_safe_default_protocol_versions()
            .expect("the provider has suites for them");
        let builder = builder.dangerous().with_custom_certificate_verifier(Arc::new(verifier));
        let mut config = builder.with_no_client_auth();
        if let Self::Pinned(_) = self {
            config.alpn_protocols = vec![b"http/1.1".to_vec(), PINNED_PROTOCOL.to_vec()];
        }
        config
    }
}

impl Clock {
    /// A clock that can't be right before [`BUILT_MS`].
    pub fn new(now_ms: fn() -> u64) -> Self {
        Self { now_ms, earliest_ms: BUILT_MS }
    }
}

impl TimeProvider for Clock {
    fn current_time(&self) -> Option<UnixTime> {
        Some(at((self.now_ms)()))
    }
}

/// Converts whole seconds since the Unix epoch, as text, to milliseconds. Any other text, and any
/// earlier time, gives `BEGINNING_MS`.
const fn built_ms(seconds: Option<&str>) -> u64 {
    let Some(text) = seconds else { return BEGINNING_MS };
    let (digits, mut at, mut read) = (text.as_bytes(), 0, 0u64);
    while at < digits.len() {
        if !digits[at].is_ascii_digit() || at > 11 {
            return BEGINNING_MS;
        }
        read = read * 10 + (digits[at] - b'0') as u64;
        at += 1;
    }
    if read * 1000 > BEGINNING_MS { read * 1000 } else { BEGINNING_MS }
}

fn at(unix_ms: u64) -> UnixTime {
    UnixTime::since_unix_epoch(Duration::from_millis(unix_ms))
}

/// The pin of an authority from its certificate; `None` if the bytes are no certificate.
pub fn pin_of(certificate: &CertificateDer<'_>) -> Option<CaPin> {
    let parsed = ParsedCertificate::try_from(certificate).ok()?;
    Some(CaPin::of(&parsed.subject_public_key_info()))
}

/// A machine without root certificates trusts no server; plain text and pins need none.
fn system_roots() -> RootCertStore {
    let mut roots = RootCertStore::empty();
    roots.add_parsable_certificates(rustls_native_certs::load_native_certs().certs);
    roots
}

#[derive(Debug)]
enum Anchor {
    Pin(CaPin),
    Roots(RootCertStore),
}

#[derive(Debug)]
struct Verifier {
    anchor: Anchor,
    algorithms: WebPkiSupportedAlgorithms,
    earliest: UnixTime,
}

impl Verifier {
    fn verify(
        &self,
        certificate: &CertificateDer<'_>,
        chain: &[CertificateDer<'_>],
        name: &ServerName<'_>,
        now: UnixTime,
    ) -> Result<(), Error> {
        let server = ParsedCertificate::try_from(certificate)?;
        let by = |roots: &RootCertStore| {
            self.check_at_plausible_time(now, |time| {
                verify_server_cert_signed_by_trust_anchor(
                    &server,
                    roots,
                    chain,
                    time,
                    self.algorithms.all,
                )
            })
        };
        match &self.anchor {
            Anchor::Roots(roots) => {
                by(roots)?;
                verify_server_name(&server, name)
            }
            Anchor::Pin(pin) => {
                let authority = chain.iter().find(|certificate| pin_of(certificate) == Some(*pin));
                let authority =
                    authority.ok_or_else(|| Error::Other(OtherError(Arc::new(WrongServer))))?;
                let mut roots = RootCertStore::empty();
                roots.add(authority.clone())?;
                by(&roots)
            }
        }
    }

    /// Verifies at time `now`. If the clock can't be right, a certificate's start of validity is
    /// not held against the server: we use the earliest moment at which all certificates had begun,
    /// and certificates that ended before that stay invalid.
    fn check_at_plausible_time(
        &self,
        now: UnixTime,
        check: impl Fn(UnixTime) -> Result<(), Error>,
    ) -> Result<(), Error> {
        if now >= self.earliest {
            return check(now);
        }
        let mut time = self.earliest;
        for _ in 0..MAX_CHAIN {
            match check(time) {
                Err(Error::InvalidCertificate(CertificateError::NotValidYetContext {
                    not_before,
                    ..
                })) if not_before > time => {
                    time = not_before;
                }
                outcome => return outcome,
            }
        }
        check(time)
    }
}

impl ServerCertVerifier for Verifier {
    fn verify_server_cert(
        &self,
        end_entity: &CertificateDer<'_>,
        intermediates: &[CertificateDer<'_>],
        server_name: &ServerName<'_>,
        _ocsp_response: &[u8],
        now: UnixTime,
    ) -> Result<ServerCertVerified, Error> {
        self.verify(end_entity, intermediates, server_name, now)
            .map(|()| ServerCertVerified::assertion())
    }

    fn verify_tls12_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signature: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        verify_tls12_signature(message, certificate, signature, &self.algorithms)
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signature: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        verify_tls13_signature(message, certificate, signature, &self.algorithms)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        self.algorithms.supported_schemes()
    }
}

#[cfg(test)]
mod tests {
    use rcgen::{
        BasicConstraints, CertificateParams, DnType, ExtendedKeyUsagePurpose, IsCa, Issuer,
        KeyPair, date_time_ymd,
    };

    use super::*;

    const BUILT_MS: u64 = BEGINNING_MS;
    const DAY_MS: u64 = 86_400_000;

    struct Authority {
        issuer: Issuer<'static, KeyPair>,
        certificate: CertificateDer<'static>,
    }

    impl Authority {
        fn new(name: &str) -> Self {
            let mut params = CertificateParams::new(Vec::new()).expect("no names");
            params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
            params.distinguished_name.push(DnType::CommonName, name);
            let key = KeyPair::generate().expect("a key");
            let certificate = params.self_signed(&key).expect("signed").der().clone();
            Self { issuer: Issuer::new(params, key), certificate }
        }

        fn pin(&self) -> CaPin {
            pin_of(&self.certificate).expect("a certificate")
        }

        /// For `server.lab`, good from the first day of `from` until that of `until`.
        fn server(
            &self,
            from: i32,
            until: i32,
            purpose: ExtendedKeyUsagePurpose,
        ) -> CertificateDer<'static> {
            let mut params = CertificateParams::new(vec!["server.lab".to_owned()]).expect("a name");
            params.extended_key_usages = vec![purpose];
            (params.not_before, params.not_after) =
                (date_time_ymd(from, 1, 1), date_time_ymd(until, 1, 1));
            let key = KeyPair::generate().expect("a key");
            params.signed_by(&key, &self.issuer).expect("signed").der().clone()
        }
    }

    fn verifier(anchor: Anchor) -> Verifier {
        let algorithms = ring::default_provider().signature_verification_algorithms;
        Verifier { anchor, algorithms, earliest: at(BUILT_MS) }
    }

    fn check(
        verifier: &Verifier,
        server: &CertificateDer<'_>,
        chain: &[CertificateDer<'_>],
        name: &str,
        now_ms: u64,
    ) -> Result<(), Error> {
        verifier.verify(server, chain, &name.to_owned().try_into().expect("a name"), at(now_ms))
    }

    #[test]
    fn only_the_pinned_authority_is_trusted_under_any_name() {
        let (own, other) = (Authority::new("own"), Authority::new("other"));
        let pinned = verifier(Anchor::Pin(own.pin()));
        let good = own.server(2025, 2100, ExtendedKeyUsagePurpose::ServerAuth);
        let chain = [own.certificate.clone()];
        assert_eq!(check(&pinned, &good, &chain, "10.0.0.1", BUILT_MS), Ok(()));
        let foreign = other.server(2025, 2100, ExtendedKeyUsagePurpose::ServerAuth);
        let refused = check(
            &pinned,
            &foreign,
            std::slice::from_ref(&other.certificate),
            "server.lab",
            BUILT_MS,
        );
        assert!(matches!(refused, Err(Error::Other(_))), "{refused:?}");
        // Sending the pinned certificate beside another server's certificate proves nothing.
        let both = [other.certificate.clone(), own.certificate.clone()];
        assert!(check(&pinned, &foreign, &both, "server.lab", BUILT_MS).is_err());
        // Nor does a certificate for another purpose.
        let client = own.server(2025, 2100, ExtendedKeyUsagePurpose::ClientAuth);
        assert!(check(&pinned, &client, &chain, "server.lab", BUILT_MS).is_err());
    }

    #[test]
    fn system_roots_verify_the_server_name() {
        let own = Authority::new("own");
        let mut roots = RootCertStore::empty();
        roots.add(own.certificate.clone()).expect("an authority");
        let by_roots = verifier(Anchor::Roots(roots));
        let server = own.server(2025, 2100, ExtendedKeyUsagePurpose::ServerAuth);
        assert_eq!(check(&by_roots, &server, &[], "server.lab", BUILT_MS), Ok(()));
        assert!(check(&by_roots, &server, &[], "other.lab", BUILT_MS).is_err());
        assert!(
            check(
                &verifier(Anchor::Roots(RootCertStore::empty())),
                &server,
                &[],
                "server.lab",
                BUILT_MS
            )
            .is_err()
        );
    }

    #[test]
    fn impossible_clock_ignores_the_start_of_validity() {
        let own = Authority::new("own");
        let pinned = verifier(Anchor::Pin(own.pin()));
        let chain = [own.certificate.clone()];
        let later = own.server(2030, 2031, ExtendedKeyUsagePurpose::ServerAuth);
        for impossible_ms in [0, BUILT_MS - 1] {
            assert_eq!(check(&pinned, &later, &chain, "server.lab", impossible_ms), Ok(()));
        }
        // A clock that may be right is trusted, both ways.
        let year_2040_ms = BUILT_MS + 14 * 366 * DAY_MS;
        for possible_ms in [BUILT_MS, year_2040_ms] {
            assert!(check(&pinned, &later, &chain, "server.lab", possible_ms).is_err());
        }
        // A certificate that ended before the program was built has ended, whatever the clock
        // shows.
        let past = own.server(2020, 2025, ExtendedKeyUsagePurpose::ServerAuth);
        for now_ms in [0, BUILT_MS] {
            assert!(check(&pinned, &past, &chain, "server.lab", now_ms).is_err());
        }
    }

    #[test]
    fn build_time_is_read_from_source_date_epoch() {
        assert_eq!(built_ms(None), BEGINNING_MS);
        assert_eq!(built_ms(Some("1800000000")), 1_800_000_000_000);
        for nothing in ["", "0", "-5", "1800000000x", "99999999999999999999"] {
            assert_eq!(built_ms(Some(nothing)), BEGINNING_MS, "{nothing}");
        }
    }

    #[test]
    fn only_pinned_clients_request_the_pinned_certificate() {
        let clock = Clock { now_ms: || BUILT_MS, earliest_ms: BUILT_MS };
        let pinned = Trust::Pinned(Authority::new("own").pin()).client_config(clock);
        assert!(pinned.alpn_protocols.iter().any(|protocol| protocol == PINNED_PROTOCOL));
        assert!(Trust::System.client_config(clock).alpn_protocols.is_empty());
    }
}
