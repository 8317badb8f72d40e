//! TLS of both listeners: with the operator's own certificate, or with one issued by the server's
//! private authority. A client that pinned that authority always gets the latter. Certificates
//! change while connections live, without affecting them. This module accepts no connections and
//! enforces no handshake timeout: the listeners do both.

mod authority;
mod client;
mod files;

use std::fmt;
use std::io;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError, RwLock};
use std::time::Duration;

use rustls::crypto::ring;
use rustls::server::{ClientHello, ResolvesServerCert};
use rustls::sign::CertifiedKey;
use rustls::{ClientConfig, ServerConfig};
use task_proto::CaPin;
use task_proto::trust::pin::PINNED_PROTOCOL;
use task_transport::Trust;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio_rustls::TlsAcceptor;
use tokio_rustls::server::TlsStream;
use tokio_util::sync::CancellationToken;

use self::authority::{Audience, Authority};
use self::client::AnyKey;
pub use self::client::ClientProof;
use self::files::Files;
use crate::config::TlsSettings;
use crate::system::clock::Clock;
use crate::system::data_directory::{DataDirectory, DataError};
use crate::system::host::host_name;

/// Interval at which the authority issues new certificates, to include names and addresses that the
/// machine has gained meanwhile.
const RENEWAL: Duration = Duration::from_secs(7 * 86_400);

/// The reason why there is no usable certificate.
#[derive(Debug, thiserror::Error)]
pub enum TlsError {
    /// The private authority can't be stored.
    #[error(transparent)]
    Data(#[from] DataError),
    /// The private authority can't be created, or can't issue a certificate.
    #[error("the private certificate authority can't make a certificate")]
    Authority(#[from] rcgen::Error),
    /// The issued certificate can't be used.
    #[error("the private certificate authority made a certificate that can't be used")]
    Unusable(#[source] rustls::Error),
    /// One of the operator's files can't be read.
    #[error("can't read {}", path.display())]
    Unreadable {
        path: PathBuf,
        /// The operating system's error.
        source: io::Error,
    },
    /// The file has unexpected content.
    #[error("{} does not hold {expected} in PEM", path.display())]
    Content { path: PathBuf, expected: &'static str },
    /// The certificate and the key do not belong together, or are of an unknown kind.
    #[error("the certificate in {} can't be used with the key in {}", certificate.display(), key.display())]
    Unfit { certificate: PathBuf, key: PathBuf, source: rustls::Error },
}

/// The TLS configuration of the server. Clones share the same state.
#[derive(Clone)]
pub struct Tls(Arc<Parts>);

struct Parts {
    acceptor: TlsAcceptor,
    resolver: Arc<CertificateResolver>,
    authority: Authority,
    own: Option<Mutex<Files>>,
    settings: TlsSettings,
    clock: Clock,
}

#[derive(Debug)]
struct CertificateResolver(RwLock<Certificates>);

#[derive(Debug, Clone)]
struct Certificates {
    /// For clients that request the pinned authority's certificate.
    pinned: Arc<CertifiedKey>,
    /// For all other clients.
    common: Arc<CertifiedKey>,
}

impl ResolvesServerCert for CertificateResolver {
    fn resolve(&self, hello: ClientHello<'_>) -> Option<Arc<CertifiedKey>> {
        let requests_pinned =
            hello.alpn().is_some_and(|mut asked| asked.any(|protocol| protocol == PINNED_PROTOCOL));
        let certificates = self.0.read().unwrap_or_else(PoisonError::into_inner);
        Some(if requests_pinned {
            certificates.pinned.clone()
        } else {
            certificates.common.clone()
        })
    }
}

impl Tls {
    /// Reads or creates the certificates. Here an unusable operator's file is an error; later it is
    /// not.
    pub fn open(
        settings: TlsSettings,
        data: &DataDirectory,
        clock: Clock,
    ) -> Result<Self, TlsError> {
        let authority = Authority::open(data)?;
        let mut own = settings.own_files().map(|(certificate, key)| Files::new(certificate, key));
        let now_ms = clock.now_ms();
        let names = names_of_this_machine(&settings.names);
        let common = match own.as_mut().map(Files::read_if_changed).transpose()?.flatten() {
            Some(own) => own,
            None => authority.issue(Audience::Browsers, &names, now_ms)?,
        };
        let pinned = authority.issue(Audience::Robots, &names, now_ms)?;
        let certificates = Certificates { pinned: Arc::new(pinned), common: Arc::new(common) };
        let resolver = Arc::new(CertificateResolver(RwLock::new(certificates)));
        let builder = ServerConfig::builder_with_provider(Arc::new(ring::default_provider()));
        let builder = builder.with_safe_default_protocol_versions().map_err(TlsError::Unusable)?;
        let builder = match settings.client_certificates {
            true => builder.with_client_cert_verifier(AnyKey::new()),
            false => builder.with_no_client_auth(),
        };
        let mut config = builder.with_cert_resolver(resolver.clone());
        // When all robots reconnect at once, resumption halves the work of a handshake, and tickets
        // need no memory on the server.
        config.ticketer = ring::Ticketer::new().map_err(TlsError::Unusable)?;
        config.send_tls13_tickets = 1;
        let acceptor = TlsAcceptor::from(Arc::new(config));
        Ok(Self(Arc::new(Parts {
            acceptor,
            resolver,
            authority,
            own: own.map(Mutex::new),
            settings,
            clock,
        })))
    }

    /// Performs the handshake and returns the client's proof. Has no timeout.
    pub async fn accept<S: AsyncRead + AsyncWrite + Unpin>(
        &self,
        stream: S,
    ) -> io::Result<(TlsStream<S>, ClientProof)> {
        let stream = self.0.acceptor.accept(stream).await?;
        let proof = match self.0.settings.client_certificates {
            true => ClientProof::of(stream.get_ref().1.peer_certificates()),
            false => ClientProof::NotRequested,
        };
        Ok((stream, proof))
    }

    /// The private authority's pin.
    pub fn pin(&self) -> CaPin {
        self.0.authority.pin()
    }

    /// The pin that is announced to robots; `None` if the system's root certificates vouch for the
    /// operator's own certificate.
    pub fn announced_pin(&self) -> Option<CaPin> {
        self.0.settings.announces_pin().then(|| self.pin())
    }

    /// The configuration with which this process connects to itself.
    pub fn client_config(&self) -> Arc<ClientConfig> {
        Arc::new(Trust::Pinned(self.pin()).client_config(Clock::for_certificates()))
    }

    /// Loads changes of the operator's files. On an error the certificates stay unchanged.
    pub fn reload(&self) -> Result<(), TlsError> {
        let Some(own) = &self.0.own else { return Ok(()) };
        let changed = own.lock().unwrap_or_else(PoisonError::into_inner).read_if_changed()?;
        if let Some(changed) = changed {
            self.0.resolver.write().common = Arc::new(changed);
            tracing::info!("loaded the new certificate; new connections use it");
        }
        Ok(())
    }

    /// Issues new certificates by the private authority.
    fn renew(&self) -> Result<(), TlsError> {
        let (authority, now_ms) = (&self.0.authority, self.0.clock.now_ms());
        let names = names_of_this_machine(&self.0.settings.names);
        let pinned = Arc::new(authority.issue(Audience::Robots, &names, now_ms)?);
        let common = match self.0.own {
            Some(_) => None,
            None => Some(Arc::new(authority.issue(Audience::Browsers, &names, now_ms)?)),
        };
        let mut certificates = self.0.resolver.write();
        certificates.pinned = pinned;
        if let Some(common) = common {
            certificates.common = common;
        }
        Ok(())
    }

    /// Checks for new files, and renews the authority's certificates, until `stop`.
    pub async fn keep_current(self, stop: CancellationToken) {
        let mut looks = tokio::time::interval(self.0.settings.check_interval);
        let mut renewals = tokio::time::interval(RENEWAL);
        looks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        // The first tick comes at once, and all certificates are new at that time.
        renewals.tick().await;
        loop {
            let task = tokio::select! {
                () = stop.cancelled() => return,
                _ = looks.tick() => Self::reload,
                _ = renewals.tick() => Self::renew,
            };
            let tls = self.clone();
            let outcome = tokio::task::spawn_blocking(move || task(&tls)).await;
            if let Ok(Err(error)) = outcome {
                self.log_error(&error);
            }
        }
    }

    fn log_error(&self, error: &TlsError) {
        let error = error as &dyn std::error::Error;
        tracing::warn!(error, "the certificate could not be reloaded; the old one stays in use");
    }
}

impl CertificateResolver {
    fn write(&self) -> std::sync::RwLockWriteGuard<'_, Certificates> {
        self.0.write().unwrap_or_else(PoisonError::into_inner)
    }
}

impl fmt::Debug for Tls {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Tls").field("pin", &self.pin()).finish_non_exhaustive()
    }
}

/// The names and addresses of this machine, as far as known, and the operator's additional ones. A
/// client that trusts a pin does not check names.
fn names_of_this_machine(further: &[String]) -> Vec<String> {
    let mut names = vec!["localhost".to_owned()];
    names.extend(host_name());
    let interfaces = nix::ifaddrs::getifaddrs().into_iter().flatten();
    names.extend(interfaces.filter_map(|interface| {
        let address = interface.address?;
        let v4 = address.as_sockaddr_in().map(|address| address.ip().to_string());
        v4.or_else(|| address.as_sockaddr_in6().map(|address| address.ip().to_string()))
    }));
    names.extend(further.iter().cloned());
    names.sort();
    names.dedup();
    names
}
