//! MQTT over WebSocket (MQTT 3.1.1, section 6): a stream of bytes in binary frames, for both ends.
//! The connection begins as an HTTP request, and therefore passes proxies that allow only HTTP.

pub mod frame;

use std::io;
use std::pin::Pin;
use std::task::{Context, Poll, ready};

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use bytes::{Buf as _, BytesMut};
use http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header};
use sha1::{Digest as _, Sha1};
use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _, ReadBuf};

use self::frame::{Decoder, NORMAL, Opcode, Piece, Role, Violation, encode};

/// Name of the WebSocket subprotocol (MQTT 3.1.1, section 6).
pub const MQTT: &str = "mqtt";
/// The GUID that both ends hash behind the client's key (RFC 6455, section 1.3).
const KEY_SUFFIX: &str = "258EAFA5-E914-47DA-95CA-C5AB0DC85B11";
/// The head of the answer that a client reads.
const MAX_HEAD_BYTES: usize = 16 * 1024;
/// Maximum number of headers in the answer.
const MAX_HEADERS: usize = 64;
/// Payload of one frame, in bytes.
const FRAME_BYTES: usize = 16 * 1024;
/// Encoded and not written yet, before nothing more is taken.
const MAX_UNWRITTEN_BYTES: usize = 32 * 1024;
/// Limit on consecutive frames that carry no byte of MQTT: pings, pongs, empty frames. They cost
/// time, and no other limit counts them.
const MAX_EMPTY_FRAMES: usize = 64;
/// Maximum number of bytes per read.
const READ_BYTES: usize = 8 * 1024;

/// Why the WebSocket was not established.
#[derive(Debug, thiserror::Error)]
pub enum WebSocketError {
    /// The connection failed or was lost.
    #[error("the connection failed before the WebSocket was established")]
    Io(#[from] io::Error),
    /// An HTTP status other than 101.
    #[error("the server answered {0} instead of upgrading to MQTT over WebSocket")]
    Refused(StatusCode),
    /// The request or the answer is not one for MQTT over WebSocket.
    #[error("invalid MQTT over WebSocket handshake: {0}")]
    Malformed(&'static str),
}

/// Reads a client's request for a WebSocket and gives the headers that grant it, with status 101.
pub fn grant(request: &HeaderMap) -> Result<HeaderMap, WebSocketError> {
    if !has_token(request, &header::CONNECTION, "upgrade")
        || !has_token(request, &header::UPGRADE, "websocket")
    {
        return Err(WebSocketError::Malformed("Upgrade: websocket is missing"));
    }
    if !has_token(request, &header::SEC_WEBSOCKET_VERSION, "13") {
        return Err(WebSocketError::Malformed("Sec-WebSocket-Version is not 13"));
    }
    if !has_token(request, &header::SEC_WEBSOCKET_PROTOCOL, MQTT) {
        return Err(WebSocketError::Malformed("Sec-WebSocket-Protocol does not offer mqtt"));
    }
    let key = request.get(header::SEC_WEBSOCKET_KEY).map(HeaderValue::as_bytes).unwrap_or_default();
    if !STANDARD.decode(key).is_ok_and(|key| key.len() == 16) {
        return Err(WebSocketError::Malformed("Sec-WebSocket-Key is not 16 bytes in base64"));
    }
    let accept = HeaderValue::try_from(accept_of(key))
        .map_err(|_| WebSocketError::Malformed("Sec-WebSocket-Key"))?;
    Ok(HeaderMap::from_iter([
        (header::CONNECTION, HeaderValue::from_static("Upgrade")),
        (header::UPGRADE, HeaderValue::from_static("websocket")),
        (header::SEC_WEBSOCKET_PROTOCOL, HeaderValue::from_static(MQTT)),
        (header::SEC_WEBSOCKET_ACCEPT, accept),
    ]))
}

fn accept_of(key: &[u8]) -> String {
    let mut hash = Sha1::new();
    hash.update(key);
    hash.update(KEY_SUFFIX);
    STANDARD.encode(hash.finalize())
}

/// Whether the header's comma-separated list contains `token`.
fn has_token(headers: &HeaderMap, name: &HeaderName, token: &str) -> bool {
    let lines = headers.get_all(name).iter().filter_map(|value| value.to_str().ok());
    lines.flat_map(|line| line.split(',')).any(|word| word.trim().eq_ignore_ascii_case(token))
}

/// A WebSocket as a stream of bytes. Message boundaries are ignored.
#[derive(Debug)]
pub struct WebSocket<S> {
    stream: S,
    role: Role,
    decoder: Decoder,
    /// Read from the stream and not taken apart yet.
    input: BytesMut,
    /// Taken apart and not handed out yet.
    unread: BytesMut,
    /// Whether the other end has sent a close frame, or has violated the protocol.
    is_over: bool,
    /// Frames without a byte since the last byte.
    empty_frames: usize,
    output: BytesMut,
    /// The close code of this end; `None` answers a close frame without a code.
    closing: Option<u16>,
    /// Whether the close frame has been queued.
    is_closed: bool,
}

impl<S: AsyncRead + AsyncWrite + Unpin> WebSocket<S> {
    /// The server's end, once the request was granted.
    pub fn server(stream: S) -> Self {
        Self::new(stream, Role::Server, BytesMut::new())
    }

    /// Requests a WebSocket. `host` is the server's host name, with its port.
    pub async fn connect(mut stream: S, host: &str, path: &str) -> Result<Self, WebSocketError> {
        let key = STANDARD.encode(rand::random::<[u8; 16]>());
        let request = format!(
            "GET {path} HTTP/1.1\r\nHost: {host}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\
             Sec-WebSocket-Version: 13\r\nSec-WebSocket-Protocol: {MQTT}\r\n\
             Sec-WebSocket-Key: {key}\r\n\r\n"
        );
        stream.write_all(request.as_bytes()).await?;
        stream.flush().await?;
        let mut input = BytesMut::new();
        loop {
            if stream.read_buf(&mut input).await? == 0 {
                return Err(io::Error::from(io::ErrorKind::UnexpectedEof).into());
            }
            if let Some(length) = parse_response(&input, &key)? {
                input.advance(length);
                return Ok(Self::new(stream, Role::Client, input));
            }
            if input.len() > MAX_HEAD_BYTES {
                return Err(WebSocketError::Malformed("the answer's head is too long"));
            }
        }
    }

    fn new(stream: S, role: Role, input: BytesMut) -> Self {
        Self {
            stream,
            role,
            decoder: Decoder::new(role),
            input,
            unread: BytesMut::new(),
            is_over: false,
            empty_frames: 0,
            output: BytesMut::new(),
            closing: Some(NORMAL),
            is_closed: false,
        }
    }

    fn queue(&mut self, opcode: Opcode, payload: &[u8]) {
        let mask = (self.role == Role::Client).then(rand::random);
        encode(opcode, payload, mask, &mut self.output);
    }

    /// Stops reading from the other end, which receives the reason when this end closes.
    fn refuse(&mut self, violation: Violation) -> io::Error {
        (self.is_over, self.closing) = (true, Some(violation.code()));
        io::Error::new(io::ErrorKind::InvalidData, violation)
    }

    /// Writes pending bytes to the connection.
    fn poll_drain(&mut self, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        while !self.output.is_empty() {
            let written = ready!(Pin::new(&mut self.stream).poll_write(context, &self.output))?;
            if written == 0 {
                return Poll::Ready(Err(io::ErrorKind::WriteZero.into()));
            }
            self.output.advance(written);
        }
        // An idle connection holds no memory.
        self.output = BytesMut::new();
        Poll::Ready(Ok(()))
    }

    /// Handles the received frames; payload bytes go to `unread`.
    fn handle_input(&mut self) -> io::Result<()> {
        while self.unread.is_empty() && !self.is_over {
            let piece =
                self.decoder.decode(&mut self.input).map_err(|violation| self.refuse(violation))?;
            let has_data = matches!(&piece, Some(Piece::Data(bytes)) if !bytes.is_empty());
            self.empty_frames =
                if has_data { 0 } else { self.empty_frames + usize::from(piece.is_some()) };
            if self.empty_frames > MAX_EMPTY_FRAMES {
                return Err(self.refuse(Violation::new("too many empty frames")));
            }
            match piece {
                Some(Piece::Data(bytes)) => self.unread = bytes,
                // A client that sends pings without reading the pongs gets no more pongs.
                Some(Piece::Ping(bytes))
                    if !self.is_closed && self.output.len() < MAX_UNWRITTEN_BYTES =>
                {
                    self.queue(Opcode::Pong, &bytes);
                }
                Some(Piece::Ping(_) | Piece::Pong) => {}
                Some(Piece::Close(code)) => (self.is_over, self.closing) = (true, code),
                None => {
                    if self.input.is_empty() {
                        self.input = BytesMut::new();
                    }
                    return Ok(());
                }
            }
        }
        Ok(())
    }
}

/// The length of the answer's head if the head grants the WebSocket; `None` until the head is
/// complete.
fn parse_response(input: &[u8], key: &str) -> Result<Option<usize>, WebSocketError> {
    let mut fields = [httparse::EMPTY_HEADER; MAX_HEADERS];
    let mut answer = httparse::Response::new(&mut fields);
    let malformed = WebSocketError::Malformed;
    let parsed = answer.parse(input).map_err(|_| malformed("the answer is not HTTP"))?;
    let httparse::Status::Complete(length) = parsed else { return Ok(None) };
    let status = answer.code.and_then(|code| StatusCode::from_u16(code).ok());
    let status = status.ok_or(malformed("the answer is not HTTP"))?;
    if status != StatusCode::SWITCHING_PROTOCOLS {
        return Err(WebSocketError::Refused(status));
    }
    let field = |name: &str| {
        let field = answer.headers.iter().find(|field| field.name.eq_ignore_ascii_case(name));
        field.map(|field| field.value)
    };
    if field("sec-websocket-accept") != Some(accept_of(key.as_bytes()).as_bytes()) {
        return Err(malformed("the answer belongs to another request"));
    }
    if field("sec-websocket-protocol") != Some(MQTT.as_bytes()) {
        return Err(malformed("the server does not agree on mqtt"));
    }
    Ok(Some(length))
}

impl<S: AsyncRead + AsyncWrite + Unpin> AsyncRead for WebSocket<S> {
    fn poll_read(
        self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let this = self.get_mut();
        loop {
            this.handle_input()?;
            if !this.output.is_empty() {
                // A pong. Bytes that cannot be written now are written later; the next write
                // reports the error as well.
                let _ = this.poll_drain(context)?;
            }
            if !this.unread.is_empty() {
                let count = this.unread.len().min(buffer.remaining());
                buffer.put_slice(&this.unread.split_to(count));
                return Poll::Ready(Ok(()));
            }
            if this.is_over {
                return Poll::Ready(Ok(()));
            }
            let mut space = [0; READ_BYTES];
            let mut chunk = ReadBuf::new(&mut space);
            ready!(Pin::new(&mut this.stream).poll_read(context, &mut chunk))?;
            if chunk.filled().is_empty() {
                return Poll::Ready(Ok(()));
            }
            this.input.extend_from_slice(chunk.filled());
        }
    }
}

impl<S: AsyncRead + AsyncWrite + Unpin> AsyncWrite for WebSocket<S> {
    fn poll_write(
        self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        let this = self.get_mut();
        if this.is_closed {
            return Poll::Ready(Err(io::ErrorKind::BrokenPipe.into()));
        }
        if this.output.len() >= FRAME_BYTES {
            ready!(this.poll_drain(context))?;
        }
        let taken = &bytes[..bytes.len().min(FRAME_BYTES)];
        this.queue(Opcode::Binary, taken);
        // Accepted bytes are sent even without a flush; bytes that do not fit now go before the
        // next write.
        let _ = this.poll_drain(context)?;
        Poll::Ready(Ok(taken.len()))
    }

    fn poll_flush(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        let this = self.get_mut();
        ready!(this.poll_drain(context))?;
        Pin::new(&mut this.stream).poll_flush(context)
    }

    fn poll_shutdown(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        let this = self.get_mut();
        if !this.is_closed {
            let code = this.closing.map(u16::to_be_bytes);
            this.queue(Opcode::Close, code.as_ref().map_or(&[][..], |code| &code[..]));
            this.is_closed = true;
        }
        ready!(this.poll_drain(context))?;
        Pin::new(&mut this.stream).poll_shutdown(context)
    }
}

#[cfg(test)]
mod tests {
    use tokio::io::{DuplexStream, duplex};

    use super::*;

    /// Both ends, through the handshake that a server and a client have.
    async fn pair(room: usize) -> (WebSocket<DuplexStream>, WebSocket<DuplexStream>) {
        let (client, mut server) = duplex(room);
        let granting = async move {
            let mut request = Vec::new();
            while !request.ends_with(b"\r\n\r\n") {
                request.push(server.read_u8().await.expect("a request"));
            }
            let mut fields = [httparse::EMPTY_HEADER; 16];
            let mut parsed = httparse::Request::new(&mut fields);
            parsed.parse(&request).expect("HTTP");
            assert_eq!(parsed.path, Some("/mqtt"));
            let headers = HeaderMap::from_iter(parsed.headers.iter().map(|field| {
                (
                    field.name.parse::<HeaderName>().expect("a name"),
                    HeaderValue::from_bytes(field.value).expect("one"),
                )
            }));
            let mut answer = "HTTP/1.1 101 Switching Protocols\r\n".to_owned();
            for (name, value) in &grant(&headers).expect("granted") {
                answer.push_str(&format!("{name}: {}\r\n", value.to_str().expect("text")));
            }
            server.write_all(format!("{answer}\r\n").as_bytes()).await.expect("written");
            WebSocket::server(server)
        };
        let (client, server) =
            tokio::join!(WebSocket::connect(client, "server:8080", "/mqtt"), granting);
        (client.expect("granted"), server)
    }

    #[tokio::test]
    async fn bytes_are_carried_both_ways_until_the_close() {
        for room in [97, 1 << 20] {
            let (mut client, mut server) = pair(room).await;
            let sent: Vec<u8> = (0..300_000u32).map(|n| (n * 7 % 251) as u8).collect();
            let mut received = vec![0; sent.len()];
            let writing = async {
                client.write_all(&sent).await.expect("written");
                client.flush().await.expect("flushed");
            };
            let ((), read) = tokio::join!(writing, server.read_exact(&mut received));
            read.expect("read");
            assert!(received == sent);
            let writing = async {
                server.write_all(&sent).await.expect("written");
                server.shutdown().await.expect("closed");
            };
            let mut received = Vec::new();
            let ((), read) = tokio::join!(writing, client.read_to_end(&mut received));
            read.expect("read");
            assert!(received == sent);
            assert!(server.write_all(b"more").await.is_err());
        }
    }

    #[tokio::test]
    async fn ping_is_answered_while_idle() {
        let (client, mut server) = pair(1024).await;
        let WebSocket { mut stream, .. } = client;
        let mut ping = BytesMut::new();
        encode(Opcode::Ping, b"there?", Some([1, 2, 3, 4]), &mut ping);
        stream.write_all(&ping).await.expect("written");
        let mut nothing = [0; 8];
        let mut answer = [0; 8];
        tokio::select! {
            read = server.read(&mut nothing) => panic!("{read:?}"),
            read = stream.read_exact(&mut answer) => { read.expect("a pong"); }
        }
        assert_eq!(&answer, b"\x8a\x06there?");
    }

    fn masked(opcode: Opcode, payload: &[u8]) -> BytesMut {
        let mut frame = BytesMut::new();
        encode(opcode, payload, Some([1, 2, 3, 4]), &mut frame);
        frame
    }

    #[tokio::test]
    async fn close_frame_has_the_reason() {
        for (frame, answer) in [
            (masked(Opcode::Continuation, b"x"), &b"\x88\x02\x03\xea"[..]),
            (BytesMut::from(&b"\x81\x80\0\0\0\0"[..]), b"\x88\x02\x03\xeb"),
            (masked(Opcode::Close, b"\x03\xe9going"), b"\x88\x02\x03\xe9"),
            (masked(Opcode::Close, b""), b"\x88\x00"),
            (masked(Opcode::Binary, b"x"), b"\x88\x02\x03\xe8"),
        ] {
            let (client, mut server) = pair(1024).await;
            let WebSocket { mut stream, .. } = client;
            stream.write_all(&frame).await.expect("written");
            // The result may be data, the end or an error.
            let _ = server.read(&mut [0; 8]).await;
            server.shutdown().await.expect("closed");
            let mut received = Vec::new();
            stream.read_to_end(&mut received).await.expect("read");
            assert_eq!(received, answer, "{frame:x?}");
        }
    }

    #[tokio::test]
    async fn frames_that_carry_nothing_end_the_connection() {
        for opcode in [Opcode::Ping, Opcode::Pong, Opcode::Binary] {
            let (client, mut server) = pair(1 << 16).await;
            let WebSocket { mut stream, .. } = client;
            for _ in 0..3 {
                stream
                    .write_all(&masked(opcode, b"").repeat(MAX_EMPTY_FRAMES))
                    .await
                    .expect("written");
                stream.write_all(&masked(Opcode::Binary, b"x")).await.expect("written");
                assert_eq!(server.read_u8().await.expect("a byte"), b'x');
            }
            stream
                .write_all(&masked(opcode, b"").repeat(MAX_EMPTY_FRAMES + 1))
                .await
                .expect("written");
            let ended =
                tokio::time::timeout(std::time::Duration::from_secs(10), server.read_u8()).await;
            assert_eq!(
                ended.expect("in time").expect_err("no byte").kind(),
                io::ErrorKind::InvalidData,
                "{opcode:?}"
            );
        }
    }

    #[tokio::test]
    async fn refused_handshake_names_the_reason() {
        for (answer, expected) in [
            (&b"HTTP/1.1 404 Not Found\r\n\r\n"[..], "404"),
            (b"HTTP/1.1 101 Fine\r\nSec-WebSocket-Accept: x\r\n\r\n", "another request"),
            (b"SSH-2.0-nobody\r\n\r\n", "not HTTP"),
            (b"HTTP/1.1 101 Fi", "failed before"),
        ] {
            let (client, mut server) = duplex(4096);
            let answering = async move {
                server.write_all(answer).await.expect("written");
                server.shutdown().await.expect("ended");
                server
            };
            let (error, _server) =
                tokio::join!(WebSocket::connect(client, "server", "/mqtt"), answering);
            let error = error.expect_err("none").to_string();
            assert!(error.contains(expected), "{error}");
        }
        let (client, mut server) = duplex(4096);
        let endless =
            async move { while server.write_all(b"HTTP/1.1 101 OK\r\nx: y").await.is_ok() {} };
        let (error, ()) = tokio::join!(WebSocket::connect(client, "server", "/mqtt"), endless);
        assert!(error.is_err());
    }

    #[tokio::test]
    async fn endless_response_head_is_refused() {
        let (client, mut server) = duplex(4096);
        let endless = async move {
            let _ = server.write_all(b"HTTP/1.1 101 Fine\r\nx: ").await;
            for _ in 0..10 {
                let _ = server.write_all(&[b'y'; MAX_HEAD_BYTES]).await;
            }
        };
        let (error, ()) = tokio::join!(WebSocket::connect(client, "server", "/mqtt"), endless);
        let error = error.expect_err("none").to_string();
        assert!(error.contains("the answer's head is too long"), "{error}");
    }

    #[test]
    fn only_a_request_for_mqtt_is_granted() {
        let good = [
            ("connection", "keep-alive, Upgrade"),
            ("upgrade", "WebSocket"),
            ("sec-websocket-version", "13"),
            ("sec-websocket-protocol", "mqttv3.1, mqtt"),
            ("sec-websocket-key", "dGhlIHNhbXBsZSBub25jZQ=="),
        ];
        let headers = |leave_out: &str| {
            let pairs = good.iter().filter(|(name, _)| *name != leave_out);
            HeaderMap::from_iter(pairs.map(|(name, value)| {
                (HeaderName::from_static(name), HeaderValue::from_static(value))
            }))
        };
        let granted = grant(&headers("")).expect("granted");
        assert_eq!(granted[header::SEC_WEBSOCKET_ACCEPT], "s3pPLMBiTxaQ9kYGzzhZRbK+xOo=");
        for (name, _) in good {
            assert!(grant(&headers(name)).is_err(), "{name}");
        }
    }
}
