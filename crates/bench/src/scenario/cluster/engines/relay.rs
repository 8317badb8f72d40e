//! A TCP relay that can be cut: then it passes nothing on and closes nothing, like a network that
//! drops packets. With several targets, a connection goes to the first that accepts it.

use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;

use anyhow::Context as _;
use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tokio::task::JoinHandle;

/// Bytes read at a time.
const CHUNK: usize = 64 * 1024;

/// A running relay. Dropping it ends the connections through it that are cut, and accepts no more.
pub struct Relay {
    pub port: u16,
    is_cut: watch::Sender<bool>,
    accepting: JoinHandle<()>,
}

impl Relay {
    /// Listens on a free port and passes connections on to the first of `targets` that accepts.
    pub async fn start(targets: Vec<SocketAddr>) -> anyhow::Result<Self> {
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).await.context("a relay")?;
        let port = listener.local_addr().context("a relay")?.port();
        let (is_cut, cut) = watch::channel(false);
        let targets = Arc::new(targets);
        let accepting = tokio::spawn(async move {
            while let Ok((client, _)) = listener.accept().await {
                tokio::spawn(pass_on(client, targets.clone(), cut.clone()));
            }
        });
        Ok(Self { port, is_cut, accepting })
    }

    /// Passes nothing on from now on, or everything again.
    pub fn set_cut(&self, cut: bool) {
        self.is_cut.send_replace(cut);
    }
}

impl Drop for Relay {
    fn drop(&mut self) {
        self.accepting.abort();
    }
}

async fn pass_on(client: TcpStream, targets: Arc<Vec<SocketAddr>>, mut cut: watch::Receiver<bool>) {
    if cut.wait_for(|cut| !cut).await.is_err() {
        return;
    }
    for target in targets.iter() {
        let Ok(server) = TcpStream::connect(target).await else { continue };
        let _ = (client.set_nodelay(true), server.set_nodelay(true));
        let (client_in, client_out) = client.into_split();
        let (server_in, server_out) = server.into_split();
        // Either side that ends ends both.
        tokio::select! {
            () = copy(client_in, server_out, cut.clone()) => {}
            () = copy(server_in, client_out, cut) => {}
        }
        return;
    }
}

async fn copy(
    mut from: impl AsyncRead + Unpin,
    mut to: impl AsyncWrite + Unpin,
    mut cut: watch::Receiver<bool>,
) {
    let mut chunk = vec![0; CHUNK];
    while let Ok(count @ 1..) = from.read(&mut chunk).await {
        if cut.wait_for(|cut| !cut).await.is_err() || to.write_all(&chunk[..count]).await.is_err() {
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn relay_that_is_cut_passes_nothing_until_it_goes_on() {
        let echo = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).await.expect("a port");
        let target = echo.local_addr().expect("bound");
        tokio::spawn(async move {
            let (mut peer, _) = echo.accept().await.expect("a connection");
            let (mut from, mut to) = peer.split();
            let _ = tokio::io::copy(&mut from, &mut to).await;
        });
        let closed = SocketAddr::from((Ipv4Addr::LOCALHOST, 1));
        let relay = Relay::start(vec![closed, target]).await.expect("listens");
        let mut client =
            TcpStream::connect((Ipv4Addr::LOCALHOST, relay.port)).await.expect("connects");
        let mut byte = [0];
        client.write_all(b"a").await.expect("sent");
        client.read_exact(&mut byte).await.expect("answered");
        relay.set_cut(true);
        client.write_all(b"b").await.expect("sent");
        let wait = std::time::Duration::from_millis(100);
        assert!(tokio::time::timeout(wait, client.read_exact(&mut byte)).await.is_err());
        relay.set_cut(false);
        client.read_exact(&mut byte).await.expect("answered");
        assert_eq!(&byte, b"b");
    }
}
