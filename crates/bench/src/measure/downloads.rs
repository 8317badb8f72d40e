//! Many connections that fetch one path over and over, at the lowest cost that the kernel allows:
//! bytes are counted and discarded unread, or decrypted if they are encrypted, so that the
//! measurement shows the server's work. The module knows neither digests nor tokens.

use std::io;
use std::net::SocketAddr;
use std::os::fd::AsRawFd as _;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context as _, bail, ensure};
use nix::sys::socket::{MsgFlags, recv};
use rustls::ClientConfig;
use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _, Interest};
use tokio::net::TcpStream;
use tokio::sync::Barrier;
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;

/// Bytes decrypted at a time.
const DECRYPTED_BYTES: usize = 64 * 1024;
/// Maximum bytes discarded by one call.
const DISCARD_BYTES: usize = 1024 * 1024;
/// The servers under measurement send no longer heads.
const MAX_HEAD_BYTES: usize = 16 * 1024;
/// Time limit for a server to accept and answer.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(120);
/// Connections opened at a time.
const CONCURRENT_CONNECTS: usize = 64;

/// A request: server, path, token and the expected size.
#[derive(Clone)]
pub struct Target {
    pub address: SocketAddr,
    /// TLS configuration; `None`: plain text.
    pub tls: Option<Arc<ClientConfig>>,
    /// The path with its leading slash.
    pub path: String,
    /// The bearer token, if one is needed.
    pub token: Option<String>,
    /// The expected size of the body: any other is a failure.
    pub size: u64,
}

impl Target {
    fn request(&self) -> Vec<u8> {
        let token = self
            .token
            .as_ref()
            .map_or(String::new(), |token| format!("Authorization: Bearer {token}\r\n"));
        format!("GET {} HTTP/1.1\r\nHost: {}\r\n{token}\r\n", self.path, self.address).into_bytes()
    }
}

/// The end of each connection's loop.
#[derive(Debug, Clone, Copy)]
pub enum Until {
    Fetches(u64),
    Elapsed(Duration),
}

/// Results of all connections, from the moment when all were open to the end of the last one.
#[derive(Debug, Clone, Copy)]
pub struct Downloads {
    /// Number of complete answers.
    pub fetches: u64,
    /// Bytes in their bodies.
    pub bytes: u64,
    /// From the first request to the end of the last answer.
    pub wall: Duration,
}

/// Opens one connection for each of `targets` and fetches until all are done. `started` is called
/// once all are open, right before the first request. One failed fetch fails the run: a server that
/// refuses requests does less work.
pub async fn download(
    targets: &[Target],
    until: Until,
    started: impl FnOnce(),
) -> anyhow::Result<Downloads> {
    let streams = connect_all(targets).await?;
    let start = Arc::new(Barrier::new(targets.len() + 1));
    let stop = Arc::new(AtomicBool::new(false));
    let counts = Arc::new([AtomicU64::new(0), AtomicU64::new(0)]);
    let tasks: Vec<_> = streams
        .into_iter()
        .zip(targets.iter().cloned())
        .map(|(mut stream, target)| {
            let start = start.clone();
            let stop = stop.clone();
            let counts = counts.clone();
            tokio::spawn(async move {
                let request = target.request();
                start.wait().await;
                let mut left = match until {
                    Until::Fetches(fetches) => fetches,
                    Until::Elapsed(_) => u64::MAX,
                };
                while left > 0 && !stop.load(Ordering::Relaxed) {
                    fetch(&mut stream, &request, target.size).await?;
                    counts[0].fetch_add(1, Ordering::Relaxed);
                    counts[1].fetch_add(target.size, Ordering::Relaxed);
                    left -= 1;
                }
                anyhow::Ok(())
            })
        })
        .collect();
    started();
    let begun = Instant::now();
    start.wait().await;
    if let Until::Elapsed(time) = until {
        tokio::time::sleep(time).await;
        stop.store(true, Ordering::Relaxed);
    }
    for task in tasks {
        task.await.context("a download broke down")??;
    }
    let [fetches, bytes] = [0, 1].map(|index: usize| counts[index].load(Ordering::Relaxed));
    Ok(Downloads { fetches, bytes, wall: begun.elapsed() })
}

/// A connection to a server.
enum Stream {
    Plain(TcpStream),
    Encrypted(Box<TlsStream<TcpStream>>),
}

async fn connect(target: &Target) -> io::Result<Stream> {
    let stream = TcpStream::connect(target.address).await?;
    Ok(match &target.tls {
        None => Stream::Plain(stream),
        Some(tls) => {
            let name = target.address.ip().into();
            Stream::Encrypted(Box::new(
                TlsConnector::from(tls.clone()).connect(name, stream).await?,
            ))
        }
    })
}

async fn connect_all(targets: &[Target]) -> anyhow::Result<Vec<Stream>> {
    let mut streams = Vec::with_capacity(targets.len());
    for group in targets.chunks(CONCURRENT_CONNECTS) {
        let opening = futures_util::future::join_all(group.iter().map(connect));
        for opened in tokio::time::timeout(ANSWER_TIMEOUT, opening)
            .await
            .context("the server accepts no connection")?
        {
            streams.push(opened.context("the server does not accept a connection")?);
        }
    }
    Ok(streams)
}

async fn fetch(stream: &mut Stream, request: &[u8], size: u64) -> anyhow::Result<()> {
    let whole = async {
        let thrown_away = match stream {
            Stream::Plain(stream) => {
                let left = ask(stream, request, size).await?;
                discard(stream, left).await
            }
            Stream::Encrypted(stream) => {
                let left = ask(stream, request, size).await?;
                decrypt(stream, left).await
            }
        };
        thrown_away.context("the answer broke off")
    };
    tokio::time::timeout(ANSWER_TIMEOUT, whole).await.context("the server does not answer")?
}

/// Sends the request; returns how many bytes of the body remain.
async fn ask<S: AsyncRead + AsyncWrite + Unpin>(
    stream: &mut S,
    request: &[u8],
    size: u64,
) -> anyhow::Result<u64> {
    stream.write_all(request).await.context("the request could not be sent")?;
    stream.flush().await.context("the request could not be sent")?;
    let after_head = read_head(stream, size).await?;
    size.checked_sub(after_head).context("more came than the answer's length")
}

/// Reads the head of an answer; returns how many bytes of the body came with the head.
async fn read_head<S: AsyncRead + Unpin>(stream: &mut S, size: u64) -> anyhow::Result<u64> {
    let mut bytes = Vec::with_capacity(1024);
    loop {
        if stream.read_buf(&mut bytes).await.context("the answer's head broke off")? == 0 {
            bail!("the server closed the connection instead of answering");
        }
        if let Some(end) = bytes.windows(4).position(|four| four == b"\r\n\r\n") {
            check_head(&bytes[..end], size)?;
            return Ok((bytes.len() - end - 4) as u64);
        }
        ensure!(bytes.len() < MAX_HEAD_BYTES, "the answer's head has no end");
        bytes.reserve(1024);
    }
}

fn check_head(head: &[u8], size: u64) -> anyhow::Result<()> {
    let head = String::from_utf8_lossy(head);
    let mut lines = head.split("\r\n");
    let status = lines.next().unwrap_or_default();
    ensure!(status.starts_with("HTTP/1.1 200 "), "the server answers {status:?}");
    let length = lines
        .filter_map(|line| line.split_once(':'))
        .find(|(name, _)| name.eq_ignore_ascii_case("content-length"))
        .and_then(|(_, value)| value.trim().parse::<u64>().ok());
    ensure!(length == Some(size), "an answer of {length:?} bytes instead of {size}");
    Ok(())
}

/// Discards `left` bytes in the kernel: with MSG_TRUNC a TCP socket copies nothing.
async fn discard(stream: &TcpStream, mut left: u64) -> io::Result<()> {
    // Never written to, so the buffer takes no memory.
    let mut unused = vec![0_u8; DISCARD_BYTES];
    while left > 0 {
        let most = usize::try_from(left).unwrap_or(DISCARD_BYTES).min(DISCARD_BYTES);
        let taken = stream
            .async_io(Interest::READABLE, || {
                recv(stream.as_raw_fd(), &mut unused[..most], MsgFlags::MSG_TRUNC)
                    .map_err(io::Error::from)
            })
            .await?;
        if taken == 0 {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        left -= taken as u64;
    }
    Ok(())
}

/// Reads `left` bytes and throws them away.
async fn decrypt(stream: &mut TlsStream<TcpStream>, mut left: u64) -> io::Result<()> {
    let mut unused = vec![0_u8; DECRYPTED_BYTES];
    while left > 0 {
        let most = usize::try_from(left).unwrap_or(DECRYPTED_BYTES).min(DECRYPTED_BYTES);
        let taken = stream.read(&mut unused[..most]).await?;
        if taken == 0 {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        left -= taken as u64;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use rustls::ServerConfig;
    use rustls::crypto::ring;
    use rustls::pki_types::pem::PemObject as _;
    use rustls::pki_types::{CertificateDer, PrivateKeyDer};
    use task_proto::CaPin;
    use tokio::net::TcpListener;
    use tokio_rustls::TlsAcceptor;

    use super::*;
    use crate::programs::encryption::{Certificate, client_config};

    const BODY: &[u8] = &[7; 100_000];

    async fn answer<S: AsyncRead + AsyncWrite + Unpin>(mut stream: S, body: &[u8]) {
        let head = format!("HTTP/1.1 200 OK\r\nContent-Length: {}\r\n\r\n", body.len());
        let mut request = Vec::new();
        while stream.read_buf(&mut request).await.is_ok_and(|bytes| bytes > 0) {
            if request.ends_with(b"\r\n\r\n") {
                request.clear();
                stream.write_all(head.as_bytes()).await.expect("written");
                stream.write_all(body).await.expect("written");
                stream.flush().await.expect("flushed");
            }
        }
    }

    /// A server that answers every request with the body, and a target that fetches the body.
    async fn target(certificate: Option<&Certificate>, body: &'static [u8]) -> Target {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let address = listener.local_addr().expect("bound");
        let acceptor = certificate.map(|certificate| {
            let chain = CertificateDer::pem_slice_iter(certificate.chain.as_bytes())
                .collect::<Result<_, _>>();
            let key = PrivateKeyDer::from_pem_slice(certificate.key.as_bytes()).expect("a key");
            let builder = ServerConfig::builder_with_provider(Arc::new(ring::default_provider()));
            let builder = builder
                .with_safe_default_protocol_versions()
                .expect("suites")
                .with_no_client_auth();
            TlsAcceptor::from(Arc::new(
                builder.with_single_cert(chain.expect("a chain"), key).expect("a pair"),
            ))
        });
        tokio::spawn(async move {
            while let Ok((stream, _)) = listener.accept().await {
                match acceptor.clone() {
                    None => drop(tokio::spawn(answer(stream, body))),
                    Some(tls) => drop(tokio::spawn(async move {
                        answer(tls.accept(stream).await.expect("TLS"), body).await
                    })),
                }
            }
        });
        let tls = certificate.map(|certificate| Arc::new(client_config(Some(certificate.pin))));
        Target { address, tls, path: "/".to_owned(), token: None, size: BODY.len() as u64 }
    }

    #[tokio::test]
    async fn complete_responses_are_counted_and_others_fail_the_run() {
        let certificate = Certificate::new().expect("made");
        for certificate in [None, Some(&certificate)] {
            let targets = vec![target(certificate, BODY).await; 3];
            let got = download(&targets, Until::Fetches(5), || ()).await.expect("fetched");
            assert_eq!((got.fetches, got.bytes), (15, 15 * BODY.len() as u64));
            let short = target(certificate, &BODY[1..]).await;
            assert!(download(&[short], Until::Fetches(1), || ()).await.is_err());
        }
    }

    #[tokio::test]
    async fn server_with_another_certificate_is_not_measured() {
        let certificate = Certificate::new().expect("made");
        let mut target = target(Some(&certificate), BODY).await;
        target.tls = Some(Arc::new(client_config(Some(CaPin::of(b"another")))));
        assert!(download(&[target], Until::Fetches(1), || ()).await.is_err());
    }
}
