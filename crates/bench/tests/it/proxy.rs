//! A TCP proxy that counts the bytes passed and can slow them down: simulates bad Wi-Fi and
//! measures transfers. The proxy never inspects the bytes.

use std::net::SocketAddr;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};

/// A running proxy; ends with the test's runtime.
pub struct Proxy {
    pub address: SocketAddr,
    to_client: Arc<AtomicU64>,
    bytes_per_s: Arc<AtomicU64>,
    target: Arc<Mutex<SocketAddr>>,
}

impl Proxy {
    /// Listens on a port of its own and forwards to `target`, downstream at most `bytes_per_s` per
    /// connection.
    pub async fn start(target: SocketAddr, bytes_per_s: u64) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("port");
        let proxy = Self {
            address: listener.local_addr().expect("bound"),
            to_client: Arc::default(),
            bytes_per_s: Arc::new(AtomicU64::new(bytes_per_s)),
            target: Arc::new(Mutex::new(target)),
        };
        let counter = proxy.to_client.clone();
        let rate = proxy.bytes_per_s.clone();
        let target = proxy.target.clone();
        tokio::spawn(async move {
            while let Ok((client, _)) = listener.accept().await {
                let target = *target.lock().expect("no panic");
                tokio::spawn(forward(client, target, counter.clone(), rate.clone()));
            }
        });
        proxy
    }

    /// Listens without a limit, for a target that is set later.
    pub async fn nowhere() -> Self {
        Self::start(([127, 0, 0, 1], 1).into(), u64::MAX).await
    }

    /// Bytes that were passed to clients so far.
    pub fn bytes_to_clients(&self) -> u64 {
        self.to_client.load(Ordering::SeqCst)
    }

    /// Forwards new connections to another server.
    pub fn set_target(&self, target: SocketAddr) {
        *self.target.lock().expect("no panic") = target;
    }

    pub fn set_rate(&self, bytes_per_s: u64) {
        self.bytes_per_s.store(bytes_per_s, Ordering::SeqCst);
    }
}

async fn forward(
    client: TcpStream,
    target: SocketAddr,
    counter: Arc<AtomicU64>,
    rate: Arc<AtomicU64>,
) {
    let Ok(server) = TcpStream::connect(target).await else { return };
    let (mut from_client, mut to_client) = client.into_split();
    let (mut from_server, mut to_server) = server.into_split();
    let upstream = async {
        let _ = tokio::io::copy(&mut from_client, &mut to_server).await;
    };
    let downstream = async {
        let mut buffer = vec![0; 64 * 1024];
        while let Ok(count @ 1..) = from_server.read(&mut buffer).await {
            let pause = Duration::from_secs_f64(count as f64 / rate.load(Ordering::SeqCst) as f64);
            // A real timer: this delay makes the link slow.
            let (written, ()) =
                tokio::join!(to_client.write_all(&buffer[..count]), tokio::time::sleep(pause));
            if written.is_err() {
                return;
            }
            counter.fetch_add(count as u64, Ordering::SeqCst);
        }
    };
    // Either side closing ends both, as a broken link does.
    tokio::select! { () = upstream => {}, () = downstream => {} }
}
