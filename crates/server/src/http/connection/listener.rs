//! The accept loop: limits the number of connections, bounds the time a client may take, including
//! a proxy's header and the TLS handshake, and closes connections. Knows no routes.

use std::convert::Infallible;
use std::io;
use std::net::{IpAddr, SocketAddr};
use std::pin::{Pin, pin};
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::{Duration, Instant};

use axum::Router;
use axum::body::Body;
use axum::extract::ConnectInfo;
use bytes::Bytes;
use futures_util::FutureExt as _;
use http::Request;
use http_body::{Frame, SizeHint};
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, watch};
use tokio::time::{Sleep, timeout};
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;
use tower::ServiceExt as _;

use super::traffic::HttpTotals;
use crate::net::http_connections::{Connection, HttpConnections};
use crate::net::proxy_protocol::ProxyProtocol;
use crate::net::tls::{ClientProof, Tls};
use crate::net::unauthenticated::{UnauthenticatedConnection, UnauthenticatedConnections};

/// Grace period for a connection without a valid token when its slot is needed: enough to sign in
/// or to load a page.
const GRACE: Duration = Duration::from_secs(3);
/// Time limit for a request's head, including the first one of a connection, and for an idle
/// keep-alive connection.
const HEAD_TIMEOUT: Duration = Duration::from_secs(20);
/// Longest pause of a client within a request body.
const BODY_PAUSE: Duration = Duration::from_secs(30);
/// Minimum number of body bytes per [`BODY_PAUSE`] of waiting. Even the slowest links deliver more.
const MIN_BODY_BYTES: usize = 16 * 1024;
/// How long a client may leave sent bytes unread.
const WRITE_PAUSE: Duration = Duration::from_secs(60);
/// Largest request head, in bytes.
const MAX_HEAD_BYTES: usize = 64 * 1024;
/// One in this many connections is reserved for holders that are within their share.
const RESERVED_SHARE: usize = 16;
/// Pause of the listener after it has cut one connection for another.
const EVICTION_PAUSE: Duration = Duration::from_millis(1);
/// How long the listener waits for a free slot before it checks the holders again.
const RECHECK_INTERVAL: Duration = Duration::from_millis(250);
/// Pause after an accept that failed for a local reason, for example a lack of file descriptors.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

#[derive(Debug, Clone)]
pub struct Limits {
    /// Concurrent connections. When nearly all are taken, the holder with the most loses its
    /// oldest. When no holder exceeds its share, connections without a request are closed,
    /// connections without a valid token are closed in any case, and new ones wait in the
    /// listener's backlog.
    pub max_connections: usize,
    /// Connections per address that have shown no valid token yet. A further one replaces the
    /// oldest.
    pub max_silent_per_address: usize,
    /// Addresses of reverse proxies, which carry many clients per connection. A proxy's connections
    /// count as silent until their first request, and are closed between requests only.
    pub proxies: Arc<[IpAddr]>,
    /// The balancers, which begin each connection with the address of its client.
    pub proxy_protocol: ProxyProtocol,
    /// Time limit for a proxy's header, and for a TLS handshake.
    pub handshake_timeout: Duration,
}

/// The router to serve, and the records of its connections and traffic.
pub struct Service {
    pub router: Router,
    /// TLS settings; `None` serves plain HTTP.
    pub tls: Option<Tls>,
    /// The register of connections by holder.
    pub connections: Arc<HttpConnections>,
    /// Byte and connection totals.
    pub traffic: Arc<HttpTotals>,
}

/// State shared by all connections.
struct ServerContext {
    router: Router,
    /// TLS settings; `None` serves plain HTTP.
    tls: Option<Tls>,
    handshake_timeout: Duration,
    proxies: Arc<[IpAddr]>,
    proxy_protocol: ProxyProtocol,
    unauthenticated: Arc<UnauthenticatedConnections>,
    /// The tasks of all connections.
    connections: TaskTracker,
    traffic: Arc<HttpTotals>,
    stop: CancellationToken,
    /// Aborts the connections that are still open after the patience of `stop`.
    abort: CancellationToken,
}

/// A newly accepted connection.
struct Accepted {
    stream: TcpStream,
    peer: SocketAddr,
    permit: Option<OwnedSemaphorePermit>,
    /// True while the connection's slot is needed.
    at_capacity: watch::Receiver<bool>,
}

/// A newly accepted client.
struct AcceptedClient {
    peer: SocketAddr,
    silent: UnauthenticatedConnection,
    /// The identity that the client has proven in the TLS handshake.
    proof: ClientProof,
    /// True while the connection's slot is needed.
    at_capacity: watch::Receiver<bool>,
    handle: Connection,
}

/// Serves until `stop`, then waits at most `patience` for requests under way.
pub async fn serve(
    listener: TcpListener,
    service: Service,
    limits: Limits,
    stop: CancellationToken,
    patience: Duration,
) {
    let Service { router, tls, connections: registry, traffic } = service;
    let limit = ConnectionLimit::new(limits.max_connections, registry);
    let unauthenticated = UnauthenticatedConnections::new(limits.max_silent_per_address);
    let connections = TaskTracker::new();
    let abort = CancellationToken::new();
    let Limits { handshake_timeout, proxies, proxy_protocol, .. } = limits;
    let context = Arc::new(ServerContext {
        router,
        tls,
        handshake_timeout,
        proxies,
        proxy_protocol,
        unauthenticated,
        connections: connections.clone(),
        traffic,
        stop,
        abort: abort.clone(),
    });
    loop {
        let (stream, peer, permit) = tokio::select! {
            () = context.stop.cancelled() => break,
            accepted = accept(&listener, &limit) => accepted,
        };
        let at_capacity = limit.at_capacity.subscribe();
        let accepted = Accepted { stream, peer, permit, at_capacity };
        if context.proxy_protocol.applies_to(peer.ip()) {
            connections.spawn(context.clone().serve_proxied(accepted));
        } else {
            context.clone().spawn_client(accepted);
        }
    }
    drop(listener);
    connections.close();
    if timeout(patience, connections.wait()).await.is_err() {
        tracing::warn!("requests did not end in time and are cut off");
    }
    abort.cancel();
}

impl ServerContext {
    /// Reads the header of a proxy's connection, then serves the proxy's client.
    async fn serve_proxied(self: Arc<Self>, mut accepted: Accepted) {
        let Accepted { stream, peer, at_capacity, .. } = &mut accepted;
        let silent = self.unauthenticated.add_proxied(Instant::now());
        let client = tokio::select! {
            client = self.proxy_protocol.client(stream, *peer, self.handshake_timeout) => client,
            () = evicted(&silent, at_capacity.clone()) => None,
            () = self.stop.cancelled() => None,
        };
        drop(silent);
        if let Some(peer) = client {
            self.spawn_client(Accepted { peer, ..accepted });
        }
    }

    fn spawn_client(self: Arc<Self>, accepted: Accepted) {
        let Accepted { stream, peer, permit, at_capacity } = accepted;
        let client = AcceptedClient {
            peer,
            silent: self.unauthenticated.add(peer.ip(), Instant::now()),
            proof: ClientProof::NotRequested,
            at_capacity,
            handle: Connection::default(),
        };
        let connections = self.connections.clone();
        // Two kinds of task: the task of a plain connection then does not reserve the memory of an
        // encrypted one.
        if self.tls.is_some() {
            connections.spawn(async move {
                self.serve_tls_client(stream, client).await;
                drop(permit);
            });
        } else {
            connections.spawn(async move {
                self.serve_client(self.timed_stream(stream, client.handle.clone()), client).await;
                drop(permit);
            });
        }
    }

    fn timed_stream(&self, stream: TcpStream, handle: Connection) -> TimedStream {
        // Answers are small and latency-sensitive. A failure here costs only latency.
        let _ = stream.set_nodelay(true);
        self.traffic.connection();
        TimedStream { stream, stalled: None, traffic: self.traffic.clone(), handle }
    }

    /// Completes the TLS handshake, then serves the connection until its end.
    async fn serve_tls_client(&self, stream: TcpStream, client: AcceptedClient) {
        let Some(tls) = &self.tls else { return };
        let handshake = tokio::select! {
            handshake = timeout(self.handshake_timeout, tls.accept(self.timed_stream(stream, client.handle.clone()))) => handshake,
            () = evicted(&client.silent, client.at_capacity.clone()) => return,
            () = self.stop.cancelled() => return,
        };
        // Failed handshakes are not logged.
        if let Ok(Ok((stream, proof))) = handshake {
            self.serve_client(stream, AcceptedClient { proof, ..client }).await;
        }
    }

    /// Serves one connection until its end.
    async fn serve_client<S>(&self, stream: S, client: AcceptedClient)
    where
        S: AsyncRead + AsyncWrite + Send + Unpin + 'static,
    {
        let AcceptedClient { peer, silent, proof, at_capacity, handle } = client;
        let (has_request, is_proxy) =
            (CancellationToken::new(), self.proxies.contains(&peer.ip().to_canonical()));
        let (router, traffic) = (self.router.clone(), self.traffic.clone());
        let origin =
            RequestOrigin { peer, is_encrypted: self.tls.is_some(), proof, handle: handle.clone() };
        let mut connection = pin!(connection(stream, origin, has_request.clone(), router, traffic));
        let evicted_if_unauthenticated = async {
            tokio::select! {
                () = handle.authenticated() => {}
                () = has_request.cancelled(), if is_proxy => {}
                () = evicted(&silent, at_capacity.clone()) => {
                    // A connection is not cut while our own token lookup is under way.
                    if !handle.is_authenticated_after_lookup().await {
                        return;
                    }
                }
            }
            drop(silent);
            std::future::pending().await
        };
        let ended = async {
            tokio::select! {
                _ = connection.as_mut() => return,
                () = graceful_end(&self.stop, &has_request, at_capacity.clone()) => connection.as_mut().graceful_shutdown(),
            }
            // Clients that disconnect or stall are not logged.
            let _ = connection.await;
        };
        tokio::select! {
            () = ended => {}
            () = evicted_if_unauthenticated => {}
            () = handle.cut() => {}
            () = self.abort.cancelled() => {}
        }
    }
}

/// The limited set of connection slots.
struct ConnectionLimit {
    free: Arc<Semaphore>,
    max: usize,
    /// True from the moment all slots are taken until more than an eighth are free.
    at_capacity: watch::Sender<bool>,
    /// The holders of the slots.
    registry: Arc<HttpConnections>,
}

impl ConnectionLimit {
    fn new(max: usize, registry: Arc<HttpConnections>) -> Self {
        Self {
            free: Arc::new(Semaphore::new(max)),
            max,
            at_capacity: watch::Sender::new(false),
            registry,
        }
    }

    /// Takes a slot. The last slots are reserved for holders within their share: a holder above
    /// its share loses its oldest connection for each new one. When no holder exceeds its share and
    /// no slot is left, connections without a request have to end.
    async fn take(&self) -> Option<OwnedSemaphorePermit> {
        if let Ok(permit) = self.free.clone().try_acquire_owned() {
            let left = self.free.available_permits();
            self.at_capacity
                .send_if_modified(|at_capacity| left > self.max / 8 && std::mem::take(at_capacity));
            if left < self.max / RESERVED_SHARE {
                self.evict_one().await;
            }
            return Some(permit);
        }
        loop {
            if !self.evict_one().await {
                self.at_capacity.send_replace(true);
            }
            // By the next check, strangers may have authenticated. The semaphore is never closed,
            // so a permit always arrives; without a permit the connection would only be uncounted.
            if let Ok(permit) = timeout(RECHECK_INTERVAL, self.free.clone().acquire_owned()).await {
                return permit.ok();
            }
        }
    }

    /// Cuts the oldest connection of the largest holder, if that holder exceeds its share. The
    /// pause keeps a holder that reconnects immediately from occupying the whole server.
    async fn evict_one(&self) -> bool {
        let is_evicted = self.registry.cut_oldest_of_largest(self.max);
        if is_evicted {
            tokio::time::sleep(EVICTION_PAUSE).await;
        }
        is_evicted
    }
}

/// Resolves when a connection has to end after its current request: the server stops, or the slots
/// are needed and this connection has served a request.
async fn graceful_end(
    stop: &CancellationToken,
    has_request: &CancellationToken,
    at_capacity: watch::Receiver<bool>,
) {
    let needed = async {
        has_request.cancelled().await;
        needed(at_capacity).await;
    };
    tokio::select! {
        () = stop.cancelled() => {}
        () = needed => {}
    }
}

/// Resolves when an unauthenticated connection has to end, even during a request: a neighbour or,
/// after [`GRACE`], any other connection needs its slot. Waiting for the request would not be
/// bounded, because the client decides how long a request takes.
async fn evicted(silent: &UnauthenticatedConnection, at_capacity: watch::Receiver<bool>) {
    let needed = async {
        needed(at_capacity).await;
        tokio::time::sleep(GRACE).await;
    };
    tokio::select! {
        () = silent.evicted().cancelled() => {}
        () = needed => {}
    }
}

/// Resolves when slots are needed.
async fn needed(mut at_capacity: watch::Receiver<bool>) {
    if at_capacity.wait_for(|at_capacity| *at_capacity).await.is_err() {
        // No connection takes slots any more.
        std::future::pending().await
    }
}

async fn accept(
    listener: &TcpListener,
    limit: &ConnectionLimit,
) -> (TcpStream, SocketAddr, Option<OwnedSemaphorePermit>) {
    let permit = limit.take().await;
    loop {
        match listener.accept().await {
            Ok((stream, peer)) => return (stream, peer, permit),
            Err(error) if is_client_error(&error) => {}
            Err(error) => {
                tracing::warn!(%error, "a connection could not be accepted");
                tokio::time::sleep(ACCEPT_PAUSE).await;
            }
        }
    }
}

fn is_client_error(error: &io::Error) -> bool {
    use io::ErrorKind::{ConnectionAborted, ConnectionRefused, ConnectionReset};
    matches!(error.kind(), ConnectionAborted | ConnectionRefused | ConnectionReset)
}

/// Marks a request on an unencrypted connection: only the kernel reads the bytes of its answer.
#[derive(Debug, Clone, Copy)]
pub(in crate::http) struct Unencrypted;

/// The connection's facts that are attached to each request.
struct RequestOrigin {
    peer: SocketAddr,
    is_encrypted: bool,
    proof: ClientProof,
    handle: Connection,
}

impl RequestOrigin {
    fn attach_to<B>(&self, request: &mut Request<B>) {
        request.extensions_mut().insert(ConnectInfo(self.peer));
        request.extensions_mut().insert(self.proof.clone());
        request.extensions_mut().insert(self.handle.clone());
        if !self.is_encrypted {
            request.extensions_mut().insert(Unencrypted);
        }
    }
}

fn connection<S>(
    stream: S,
    origin: RequestOrigin,
    has_request: CancellationToken,
    router: Router,
    traffic: Arc<HttpTotals>,
) -> http1::UpgradeableConnection<
    TokioIo<S>,
    impl hyper::service::Service<
        Request<Incoming>,
        Response = http::Response<Body>,
        Error = Infallible,
        Future: Send,
    >,
>
where
    S: AsyncRead + AsyncWrite + Send + Unpin + 'static,
{
    let service = hyper::service::service_fn(move |request: Request<Incoming>| {
        has_request.cancel();
        traffic.request();
        let mut request = request.map(|body| Body::new(TimedBody::new(body)));
        origin.attach_to(&mut request);
        router.clone().oneshot(request)
    });
    http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEAD_TIMEOUT)
        .max_buf_size(MAX_HEAD_BYTES)
        .serve_connection(TokioIo::new(stream), service)
        .with_upgrades()
}

/// A socket that counts its bytes. Writes fail once the peer has read nothing for [`WRITE_PAUSE`].
struct TimedStream {
    stream: TcpStream,
    stalled: Option<Pin<Box<Sleep>>>,
    traffic: Arc<HttpTotals>,
    handle: Connection,
}

impl TimedStream {
    fn watch_write(
        &mut self,
        context: &mut Context<'_>,
        polled: Poll<io::Result<usize>>,
    ) -> Poll<io::Result<usize>> {
        if let Poll::Ready(written) = &polled {
            let bytes = *written.as_ref().unwrap_or(&0);
            self.traffic.bytes_out(bytes);
            self.handle.wrote(bytes);
            self.stalled = None;
            return polled;
        }
        let timer = self.stalled.get_or_insert_with(|| Box::pin(tokio::time::sleep(WRITE_PAUSE)));
        timer.poll_unpin(context).map(|()| Err(io::ErrorKind::TimedOut.into()))
    }
}

impl AsyncRead for TimedStream {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let before = buffer.filled().len();
        let polled = Pin::new(&mut self.stream).poll_read(context, buffer);
        self.traffic.bytes_in(buffer.filled().len() - before);
        polled
    }
}

impl AsyncWrite for TimedStream {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        let polled = Pin::new(&mut self.stream).poll_write(context, bytes);
        self.watch_write(context, polled)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let polled = Pin::new(&mut self.stream).poll_write_vectored(context, slices);
        self.watch_write(context, polled)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }
}

/// A request body that fails once the client has sent nothing for [`BODY_PAUSE`] of waiting, or too
/// little in the total time of waiting.
struct TimedBody {
    body: Incoming,
    waiting: Option<PendingRead>,
    pace: BodyPace,
}

/// A wait for more of a body.
struct PendingRead {
    since: Instant,
    timer: Pin<Box<Sleep>>,
}

/// The pace of a body. Only the time spent waiting for the client counts: a slow server is not the
/// client's fault.
#[derive(Default)]
struct BodyPace {
    waited: Duration,
    bytes: usize,
}

impl BodyPace {
    /// Counts a chunk that was waited for. False if the client sends too slowly.
    fn count(&mut self, waited: Duration, bytes: usize) -> bool {
        self.waited += waited;
        self.bytes = self.bytes.saturating_add(bytes);
        if self.waited < BODY_PAUSE {
            return true;
        }
        std::mem::take(self).bytes >= MIN_BODY_BYTES
    }
}

impl TimedBody {
    fn new(body: Incoming) -> Self {
        Self { body, waiting: None, pace: BodyPace::default() }
    }
}

impl http_body::Body for TimedBody {
    type Data = Bytes;
    type Error = axum::BoxError;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, axum::BoxError>>> {
        let too_slow = || Poll::Ready(Some(Err(io::Error::from(io::ErrorKind::TimedOut).into())));
        if let Poll::Ready(frame) = Pin::new(&mut self.body).poll_frame(context) {
            let waited = self.waiting.take().map_or(Duration::ZERO, |wait| wait.since.elapsed());
            let bytes =
                frame.as_ref().and_then(|frame| frame.as_ref().ok()?.data_ref()).map(Bytes::len);
            return match bytes {
                Some(bytes) if !self.pace.count(waited, bytes) => too_slow(),
                _ => Poll::Ready(frame.map(|frame| frame.map_err(Into::into))),
            };
        }
        let new = || PendingRead {
            since: Instant::now(),
            timer: Box::pin(tokio::time::sleep(BODY_PAUSE)),
        };
        ready!(self.waiting.get_or_insert_with(new).timer.poll_unpin(context));
        too_slow()
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn trickling_body_is_refused_and_a_slow_link_is_not() {
        const SECOND: Duration = Duration::from_secs(1);
        let refused_after = |bytes_per_s: usize| {
            let mut pace = BodyPace::default();
            (1..=300).find(|_| !pace.count(SECOND, bytes_per_s))
        };
        assert_eq!(refused_after(1), Some(30));
        assert_eq!(refused_after(MIN_BODY_BYTES / 30 - 1), Some(30));
        assert_eq!(refused_after(1024), None);
        let mut pace = BodyPace::default();
        assert!((0..300).all(|_| pace.count(Duration::ZERO, 1)), "it is the server that is slow");
    }
}
