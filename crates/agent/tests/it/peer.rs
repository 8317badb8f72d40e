//! A scriptable MQTT 3.1.1 peer for the agent's sessions: refuses subscriptions, keeps its own
//! time, sends packets that no honest broker would, breaks off. It implements as much of the
//! protocol as an agent uses.

use std::collections::BTreeSet;
use std::sync::{Arc, Mutex};

use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::tcp::OwnedReadHalf;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{mpsc, watch};
use tokio_util::sync::CancellationToken;

/// Packets that the peer has received.
#[derive(Debug, Default, Clone)]
pub struct Seen {
    /// Sessions there were.
    pub sessions: u32,
    /// Topics that the session is subscribed to.
    pub topics: BTreeSet<String>,
    /// SUBSCRIBE packets for parts that were refused.
    pub refused: u32,
    /// Messages at QoS 1 and 2 that the agent is done with.
    pub acknowledged: u32,
    /// Messages of the agent: topic and bytes.
    pub heard: Vec<(String, Vec<u8>)>,
}

/// Channel of the packets for a session, and the means to end the session.
type Line = (mpsc::UnboundedSender<Vec<u8>>, CancellationToken);

/// The peer.
pub struct Peer {
    pub port: u16,
    pub seen: watch::Sender<Seen>,
    /// Whether parts may be subscribed to.
    pub allows_parts: watch::Sender<bool>,
    session: Arc<Mutex<Option<Line>>>,
    next_id: Mutex<u16>,
}

impl Peer {
    pub async fn start() -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let peer = Self {
            port: listener.local_addr().unwrap().port(),
            seen: watch::Sender::default(),
            allows_parts: watch::Sender::new(true),
            session: Arc::default(),
            next_id: Mutex::new(0),
        };
        let (seen, allows, current) =
            (peer.seen.clone(), peer.allows_parts.clone(), peer.session.clone());
        tokio::spawn(async move {
            while let Ok((stream, _)) = listener.accept().await {
                let end = CancellationToken::new();
                let (out, messages) = mpsc::unbounded_channel();
                *current.lock().unwrap() = Some((out.clone(), end.clone()));
                let session = serve(stream, seen.clone(), allows.clone(), out, messages);
                tokio::spawn(async move { end.run_until_cancelled(session).await });
            }
        });
        peer
    }

    /// Waits until the peer has received the expected packets.
    pub async fn until(&self, what: &str, expected: impl FnMut(&Seen) -> bool) -> Seen {
        let mut seen = self.seen.subscribe();
        let found = seen.wait_for(expected);
        crate::harness::within(what, found).await.unwrap().clone()
    }

    /// Waits until the agent subscribes to a topic that ends so.
    pub async fn subscribed(&self, end: &str) {
        self.until("a subscription", |seen| seen.topics.iter().any(|topic| topic.ends_with(end)))
            .await;
    }

    /// Publishes to the current session, regardless of its subscriptions.
    pub fn publish(&self, topic: &str, qos: u8, message: &[u8]) {
        let mut body = text(topic);
        if qos > 0 {
            let mut id = self.next_id.lock().unwrap();
            *id = *id % 60_000 + 1;
            body.extend(id.to_be_bytes());
        }
        body.extend(message);
        let session = self.session.lock().unwrap();
        // To an agent that has just gone nothing is sent.
        let _ = session.as_ref().unwrap().0.send(packet(0x30 | qos << 1, &body));
    }

    /// Breaks the session off.
    pub fn cut(&self) {
        if let Some((_, end)) = &*self.session.lock().unwrap() {
            end.cancel();
        }
    }
}

async fn serve(
    stream: TcpStream,
    seen: watch::Sender<Seen>,
    allows: watch::Sender<bool>,
    out: mpsc::UnboundedSender<Vec<u8>>,
    mut messages: mpsc::UnboundedReceiver<Vec<u8>>,
) {
    let (mut input, mut output) = stream.into_split();
    let writing = async {
        while let Some(message) = messages.recv().await {
            if output.write_all(&message).await.is_err() {
                break;
            }
        }
    };
    let reading = async {
        while let Some((kind, body)) = read(&mut input).await {
            answer(kind, &body, &seen, &allows, &out);
        }
    };
    tokio::select! {
        () = writing => {}
        () = reading => {}
    }
}

fn answer(
    kind: u8,
    body: &[u8],
    seen: &watch::Sender<Seen>,
    allows: &watch::Sender<bool>,
    out: &mpsc::UnboundedSender<Vec<u8>>,
) {
    let id = || [body[0], body[1]];
    let send = |packet: Vec<u8>| out.send(packet).unwrap();
    match kind >> 4 {
        1 => {
            seen.send_modify(|seen| {
                seen.sessions += 1;
                seen.topics.clear();
            });
            send(packet(0x20, &[0, 0]));
        }
        3 => {
            let (topic, rest) = take_text(body);
            let rest = if kind & 0x06 == 0 { rest } else { &rest[2..] };
            seen.send_modify(|seen| seen.heard.push((topic, rest.to_vec())));
            if kind & 0x06 != 0 {
                let at = 2 + usize::from(u16::from_be_bytes(id()));
                send(packet(0x40, &body[at..at + 2]));
            }
        }
        4 | 7 => seen.send_modify(|seen| seen.acknowledged += 1),
        5 => send(packet(0x62, &id())),
        8 => {
            let (topic, options) = take_text(&body[2..]);
            let granted = !topic.contains("/p/") || *allows.borrow();
            send(packet(0x90, &[id()[0], id()[1], if granted { options[0] } else { 0x80 }]));
            seen.send_modify(|seen| match granted {
                true => seen.topics.extend([topic]),
                false => seen.refused += 1,
            });
        }
        10 => {
            let (topic, _) = take_text(&body[2..]);
            seen.send_modify(|seen| seen.topics.retain(|other| *other != topic));
            send(packet(0xb0, &id()));
        }
        12 => send(packet(0xd0, &[])),
        _ => {}
    }
}

async fn read(input: &mut OwnedReadHalf) -> Option<(u8, Vec<u8>)> {
    let kind = input.read_u8().await.ok()?;
    let mut length = 0;
    for shift in [0, 7, 14, 21] {
        let byte = input.read_u8().await.ok()?;
        length |= usize::from(byte & 0x7f) << shift;
        if byte & 0x80 == 0 {
            break;
        }
    }
    let mut body = vec![0; length];
    input.read_exact(&mut body).await.ok()?;
    Some((kind, body))
}

fn packet(kind: u8, body: &[u8]) -> Vec<u8> {
    let mut packet = vec![kind];
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
    packet
}

fn text(text: &str) -> Vec<u8> {
    let length = u16::try_from(text.len()).unwrap();
    [&length.to_be_bytes(), text.as_bytes()].concat()
}

fn take_text(bytes: &[u8]) -> (String, &[u8]) {
    let (length, rest) = bytes.split_first_chunk::<2>().unwrap();
    let (text, rest) = rest.split_at(usize::from(u16::from_be_bytes(*length)));
    (String::from_utf8(text.to_vec()).unwrap(), rest)
}
