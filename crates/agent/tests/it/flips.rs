//! A proxy that flips bytes on their way, as memory that fails in a switch does after the checksums
//! were made anew.

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};

/// Which byte of the answer's body is flipped, by the number of its connection; nothing for one
/// without a fault.
pub type Fault = fn(u64) -> Option<u64>;

/// The address of the proxy for `server`, and its number of flipped bytes.
pub async fn proxy(server: SocketAddr, fault: Fault) -> (SocketAddr, Arc<AtomicU64>) {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let (address, flipped) = (listener.local_addr().unwrap(), Arc::<AtomicU64>::default());
    let count = flipped.clone();
    tokio::spawn(async move {
        for number in 0.. {
            let Ok((client, _)) = listener.accept().await else { return };
            let Ok(upstream) = TcpStream::connect(server).await else { return };
            tokio::spawn(carry(client, upstream, fault(number), count.clone()));
        }
    });
    (address, flipped)
}

async fn carry(
    client: TcpStream,
    upstream: TcpStream,
    fault: Option<u64>,
    flipped: Arc<AtomicU64>,
) {
    let (mut from_client, mut to_client) = client.into_split();
    let (mut from_server, mut to_server) = upstream.into_split();
    let up = async {
        let _ = tokio::io::copy(&mut from_client, &mut to_server).await;
        let _ = to_server.shutdown().await;
    };
    let down = async {
        // Of the first answer of the connection; how much of its body has passed, once its head
        // has.
        let (mut head, mut passed) = (Vec::new(), None);
        let mut buffer = vec![0; 64 * 1024];
        while let Ok(count @ 1..) = from_server.read(&mut buffer).await {
            let mut body = 0;
            if passed.is_none() {
                let before = head.len();
                head.extend_from_slice(&buffer[..count]);
                if let Some(end) = head.windows(4).position(|window| window == b"\r\n\r\n") {
                    (body, passed) = (end + 4 - before, Some(0));
                }
            }
            if let Some(passed) = &mut passed {
                let length = (count - body) as u64;
                if let Some(at) = fault.filter(|at| (*passed..*passed + length).contains(at)) {
                    buffer[body + (at - *passed) as usize] ^= 0x10;
                    flipped.fetch_add(1, Ordering::Relaxed);
                }
                *passed += length;
            }
            if to_client.write_all(&buffer[..count]).await.is_err() {
                break;
            }
        }
        let _ = to_client.shutdown().await;
    };
    tokio::join!(up, down);
}
