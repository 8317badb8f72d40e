//! MQTT 3.1.1 as far as thousands of measuring clients need the protocol, at the least cost:
//! packets are built once and sent as bytes, and of incoming packets only type, packet id and
//! payload are read. A real robot's client is in `simulated/robot`.

use std::io;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::time::Duration;

use anyhow::{Context as _, bail, ensure};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::tcp::{OwnedReadHalf, OwnedWriteHalf};
use tokio::net::{TcpSocket, TcpStream};

/// Time limit for one answer of a broker.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(60);
/// No packet that is measured is larger.
const MAX_PACKET_BYTES: usize = 1024 * 1024;
/// Clients per source address: limited by the address's ports.
const CLIENTS_PER_ADDRESS: usize = 20_000;

/// Credentials of a client.
pub struct Login<'a> {
    pub client_id: &'a str,
    /// User name and password, if the broker requires them.
    pub credentials: Option<(&'a str, &'a str)>,
}

/// A connection to a broker that has let us in.
pub struct Link {
    pub reader: Reader,
    pub writer: OwnedWriteHalf,
}

/// The receiving half of a connection.
pub struct Reader {
    half: OwnedReadHalf,
    bytes: Vec<u8>,
    used: usize,
}

/// Packets that a client may receive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Packet<'a> {
    /// CONNACK with this code.
    Connected(u8),
    /// SUBACK with the first filter's code.
    Subscribed(u8),
    /// A message. The packet id is 0 for QoS 0.
    Message {
        packet_id: u16,
        payload: &'a [u8],
    },
    Acknowledged(u16),
    Other,
}

impl Link {
    /// Connects as the `number`th client of a run; the number determines the client's loopback
    /// address.
    pub async fn connect(
        broker: SocketAddr,
        number: usize,
        login: &Login<'_>,
    ) -> anyhow::Result<Self> {
        let stream = tokio::time::timeout(ANSWER_TIMEOUT, open(broker, number))
            .await
            .context("no connection in time")??;
        let (half, mut writer) = stream.into_split();
        writer.write_all(&connect_packet(login)?).await.context("CONNECT could not be sent")?;
        let mut link = Self { reader: Reader { half, bytes: Vec::new(), used: 0 }, writer };
        match link.reader.next_within_timeout("CONNACK").await? {
            Packet::Connected(0) => Ok(link),
            other => bail!("the broker answers CONNECT with {other:?}"),
        }
    }

    /// Subscribes with QoS 1, and waits until that is confirmed.
    pub async fn subscribe(&mut self, filter: &str) -> anyhow::Result<()> {
        let mut body = vec![0, 1];
        put_text(&mut body, filter)?;
        body.push(1);
        self.writer
            .write_all(&packet(0x82, &body)?)
            .await
            .context("SUBSCRIBE could not be sent")?;
        match self.reader.next_within_timeout("SUBACK").await? {
            Packet::Subscribed(code) if code <= 2 => Ok(()),
            other => bail!("the broker answers SUBSCRIBE with {other:?}"),
        }
    }
}

impl Reader {
    async fn next_within_timeout(&mut self, what: &'static str) -> anyhow::Result<Packet<'_>> {
        tokio::time::timeout(ANSWER_TIMEOUT, self.next())
            .await
            .with_context(|| format!("no {what} within {ANSWER_TIMEOUT:?}"))?
    }

    /// The next packet. Cancel-safe: bytes are taken from the buffer only when the packet is whole.
    pub async fn next(&mut self) -> anyhow::Result<Packet<'_>> {
        loop {
            if let Some((start, end)) = self.whole()? {
                let first = self.bytes[self.used];
                self.used = end;
                return parse_packet(first, &self.bytes[start..end]);
            }
            self.bytes.drain(..self.used);
            self.used = 0;
            if self.bytes.is_empty() {
                // Thousands of idle clients hold no buffers.
                self.bytes.shrink_to(0);
                self.half.readable().await.context("the connection broke")?;
            }
            self.bytes.reserve(1024);
            if self.half.read_buf(&mut self.bytes).await.context("the connection broke")? == 0 {
                bail!("the broker closed the connection");
            }
        }
    }

    /// Range of the first packet's body; `None` while the packet is incomplete.
    fn whole(&self) -> anyhow::Result<Option<(usize, usize)>> {
        let rest = &self.bytes[self.used..];
        let mut length = 0;
        for (index, byte) in rest.iter().skip(1).take(4).enumerate() {
            length |= usize::from(byte & 0x7f) << (7 * index);
            if byte & 0x80 == 0 {
                ensure!(length <= MAX_PACKET_BYTES, "the broker sends a packet of {length} bytes");
                let start = self.used + 2 + index;
                let end = start + length;
                return Ok((end <= self.bytes.len()).then_some((start, end)));
            }
        }
        ensure!(rest.len() < 5, "the broker sends no MQTT");
        Ok(None)
    }
}

/// The acknowledgement of a message.
pub fn acknowledgement(packet_id: u16) -> [u8; 4] {
    let [high, low] = packet_id.to_be_bytes();
    [0x40, 2, high, low]
}

/// A message with QoS 1. The packet id is not 0.
pub fn message(topic: &str, packet_id: u16, payload: &[u8]) -> anyhow::Result<Vec<u8>> {
    let mut body = Vec::with_capacity(topic.len() + payload.len() + 4);
    put_text(&mut body, topic)?;
    body.extend(packet_id.to_be_bytes());
    body.extend(payload);
    packet(0x32, &body)
}

async fn open(broker: SocketAddr, number: usize) -> io::Result<TcpStream> {
    let socket = if broker.is_ipv4() { TcpSocket::new_v4()? } else { TcpSocket::new_v6()? };
    if let IpAddr::V4(host) = broker.ip()
        && host.is_loopback()
    {
        let last = u8::try_from(1 + number / CLIENTS_PER_ADDRESS).unwrap_or(254);
        socket.bind(SocketAddr::new(Ipv4Addr::new(127, 0, 0, last).into(), 0))?;
    }
    socket.set_nodelay(true)?;
    // Thousands of ports would otherwise be taken for a minute after each run.
    socket.set_zero_linger()?;
    socket.connect(broker).await
}

fn connect_packet(login: &Login<'_>) -> anyhow::Result<Vec<u8>> {
    const KEEP_ALIVE_S: u16 = 600;
    let mut body = vec![0, 4, b'M', b'Q', b'T', b'T', 4];
    body.push(if login.credentials.is_some() { 0b1100_0010 } else { 0b10 });
    body.extend(KEEP_ALIVE_S.to_be_bytes());
    put_text(&mut body, login.client_id)?;
    for text in login.credentials.iter().flat_map(|(user, password)| [user, password]) {
        put_text(&mut body, text)?;
    }
    packet(0x10, &body)
}

fn put_text(body: &mut Vec<u8>, text: &str) -> anyhow::Result<()> {
    body.extend(u16::try_from(text.len()).context("a text too long for MQTT")?.to_be_bytes());
    body.extend(text.as_bytes());
    Ok(())
}

fn packet(first: u8, body: &[u8]) -> anyhow::Result<Vec<u8>> {
    ensure!(body.len() <= MAX_PACKET_BYTES, "a packet of {} bytes", body.len());
    let mut packet = vec![first];
    let mut left = body.len();
    loop {
        let byte = (left & 0x7f) as u8;
        left >>= 7;
        packet.push(if left > 0 { byte | 0x80 } else { byte });
        if left == 0 {
            break;
        }
    }
    packet.extend(body);
    Ok(packet)
}

fn parse_packet(first: u8, body: &[u8]) -> anyhow::Result<Packet<'_>> {
    let number = |at: usize| -> anyhow::Result<u16> {
        let bytes = body.get(at..at + 2).context("the broker sends a packet that is too short")?;
        Ok(u16::from_be_bytes([bytes[0], bytes[1]]))
    };
    Ok(match first >> 4 {
        2 => Packet::Connected(*body.get(1).context("a CONNACK without a code")?),
        9 => Packet::Subscribed(*body.get(2).context("a SUBACK without a code")?),
        4 => Packet::Acknowledged(number(0)?),
        3 => {
            let topic_end = 2 + usize::from(number(0)?);
            let (packet_id, start) = if first & 0b110 == 0 {
                (0, topic_end)
            } else {
                (number(topic_end)?, topic_end + 2)
            };
            Packet::Message {
                packet_id,
                payload: body.get(start..).context("a message that is too short")?,
            }
        }
        _ => Packet::Other,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn packets_round_trip() {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.expect("bound");
        let address = listener.local_addr().expect("an address");
        let payload = vec![7; 300];
        let broker = tokio::spawn({
            let payload = payload.clone();
            async move {
                let (mut stream, _) = listener.accept().await.expect("accepted");
                let mut connect = [0; 2 + 12 + 1 + 2 + 1 + 2 + 1];
                stream.read_exact(&mut connect).await.expect("CONNECT");
                assert_eq!(connect[0], 0x10);
                assert_eq!(&connect[12..], b"\0\x01c\0\x01u\0\x01p");
                stream.write_all(&[0x20, 2, 0, 0]).await.expect("CONNACK");
                let sent =
                    [message("a/b", 9, &payload).expect("built"), acknowledgement(3).to_vec()]
                        .concat();
                // In two pieces, so that the first one ends within a packet.
                stream.write_all(&sent[..100]).await.expect("sent");
                stream.flush().await.expect("flushed");
                stream.write_all(&sent[100..]).await.expect("sent");
            }
        });
        let login = Login { client_id: "c", credentials: Some(("u", "p")) };
        let mut link = Link::connect(address, 0, &login).await.expect("connected");
        assert_eq!(
            link.reader.next().await.expect("received"),
            Packet::Message { packet_id: 9, payload: &payload }
        );
        assert_eq!(link.reader.next().await.expect("received"), Packet::Acknowledged(3));
        broker.await.expect("no panic");
        assert!(link.reader.next().await.is_err(), "the connection has ended");
    }
}
