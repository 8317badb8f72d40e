//! The PROXY protocol, version 2. A balancer that forwards TCP connections begins each one with a
//! binary header that contains the address of its client. Connections from the configured addresses
//! must begin with a header, and from no other address is a header read. The format:
//! <https://www.haproxy.org/download/1.8/doc/proxy-protocol.txt>, section 2.2.

use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::io::{AsyncRead, AsyncReadExt as _};
use tokio::time::timeout;

use super::refusal_log::RefusalLog;

/// The header of a connection without a client, as balancers send it for a health check.
pub const LOCAL_HEADER: [u8; FIXED_BYTES] = *b"\r\n\r\n\0\r\nQUIT\n\x20\0\0\0";
const SIGNATURE: &[u8] = b"\r\n\r\n\0\r\nQUIT\n";
/// Length of the header's fixed part.
const FIXED_BYTES: usize = 16;
/// Maximum length of the rest: the addresses, and extensions (TLVs), which are skipped.
const MAX_REST_BYTES: usize = 4096;

// The version, 2, and the command.
const LOCAL: u8 = 0x20;
const PROXY: u8 = 0x21;

// The address family and the transport protocol.
const UNSPECIFIED: u8 = 0x00;
const TCP_V4: u8 = 0x11;
const TCP_V6: u8 = 0x21;
const UNIX_STREAM: u8 = 0x31;
const UNIX_DATAGRAM: u8 = 0x32;

/// The proxies of a listener. Clones share the log.
#[derive(Debug, Clone)]
pub struct ProxyProtocol {
    proxies: Arc<[IpAddr]>,
    log: Arc<RefusalLog>,
}

/// The beginning of a connection, as far as it is parsed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Parsed {
    Header(Header),
    /// The header continues: it has this total length, or more.
    Incomplete(usize),
}

/// The content of a complete header.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Header {
    /// The address of the proxy's client; absent for a connection of the proxy itself, or if the
    /// client has no IP address.
    pub client: Option<SocketAddr>,
    /// Total length in bytes.
    pub length: usize,
}

/// The reason why a proxy's connection has no usable header.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum HeaderError {
    #[error("it does not begin with such a header")]
    Missing,
    #[error("the header has the unknown version and command {0:#04x}")]
    Command(u8),
    #[error("the header has the unknown address family {0:#04x}")]
    Family(u8),
    #[error("the header has {0} bytes of addresses and extensions, more than {MAX_REST_BYTES}")]
    TooLong(usize),
    #[error("the header is too short for its addresses")]
    TooShort,
    #[error("it ended within the header")]
    Truncated,
    #[error("the header did not arrive in time")]
    Late,
    /// As in a health check that only connects.
    #[error("it ended before the first byte")]
    Empty,
}

impl ProxyProtocol {
    /// Expects headers from these addresses.
    pub fn new(proxies: &[IpAddr]) -> Self {
        Self { proxies: proxies.into(), log: Arc::default() }
    }

    /// Whether connections from `address` begin with a header.
    pub fn applies_to(&self, address: IpAddr) -> bool {
        self.proxies.contains(&address.to_canonical())
    }

    /// Reads the header of a connection from `proxy`. Returns the address of the client, or the
    /// proxy's own if the header has none. `None`: the connection has to close; the reason is
    /// logged.
    pub async fn client(
        &self,
        stream: &mut (impl AsyncRead + Unpin),
        proxy: SocketAddr,
        time_limit: Duration,
    ) -> Option<SocketAddr> {
        let read = timeout(time_limit, read_header(stream)).await;
        match read.unwrap_or(Err(HeaderError::Late)) {
            Ok(header) => return Some(header.client.unwrap_or(proxy)),
            Err(HeaderError::Empty) => {
                tracing::debug!(%proxy, "a proxy closed a connection without a byte")
            }
            Err(error) => self.log(proxy, error),
        }
        None
    }

    fn log(&self, proxy: SocketAddr, error: HeaderError) {
        if let Some(unreported) = self.log.refused(Instant::now()) {
            tracing::warn!(
                %proxy,
                unreported,
                "a connection was closed: the setting `proxies` names its address, so it must begin with a PROXY protocol \
                 v2 header (send-proxy-v2 in HAProxy), and {error}"
            );
        }
    }
}

/// Reads a header, and no byte beyond it.
pub async fn read_header(stream: &mut (impl AsyncRead + Unpin)) -> Result<Header, HeaderError> {
    let mut bytes = Vec::new();
    loop {
        let length = match parse(&bytes)? {
            Parsed::Header(header) => return Ok(header),
            Parsed::Incomplete(length) => length,
        };
        let mut rest = (&mut *stream).take((length - bytes.len()) as u64);
        match rest.read_buf(&mut bytes).await {
            Ok(0) | Err(_) if bytes.is_empty() => return Err(HeaderError::Empty),
            Ok(0) | Err(_) => return Err(HeaderError::Truncated),
            Ok(_) => {}
        }
    }
}

/// Parses the header at the beginning of `bytes`.
pub fn parse(bytes: &[u8]) -> Result<Parsed, HeaderError> {
    if !bytes.starts_with(SIGNATURE) && !SIGNATURE.starts_with(bytes) {
        return Err(HeaderError::Missing);
    }
    let Some((fixed, rest)) = bytes.split_first_chunk::<FIXED_BYTES>() else {
        return Ok(Parsed::Incomplete(FIXED_BYTES));
    };
    let [.., command, family, high, low] = *fixed;
    if !matches!(command, LOCAL | PROXY) {
        return Err(HeaderError::Command(command));
    }
    let rest_bytes = usize::from(u16::from_be_bytes([high, low]));
    if rest_bytes > MAX_REST_BYTES {
        return Err(HeaderError::TooLong(rest_bytes));
    }
    let length = FIXED_BYTES + rest_bytes;
    let Some(rest) = rest.get(..rest_bytes) else { return Ok(Parsed::Incomplete(length)) };
    let client = match (command, family) {
        (LOCAL, _) | (_, UNSPECIFIED | UNIX_STREAM | UNIX_DATAGRAM) => None,
        (_, TCP_V4) => Some(source::<4>(rest).ok_or(HeaderError::TooShort)?),
        (_, TCP_V6) => Some(source::<16>(rest).ok_or(HeaderError::TooShort)?),
        (_, family) => return Err(HeaderError::Family(family)),
    };
    Ok(Parsed::Header(Header { client, length }))
}

/// The source in the addresses: both IP addresses, then both ports, each the source's first.
fn source<const N: usize>(addresses: &[u8]) -> Option<SocketAddr>
where
    IpAddr: From<[u8; N]>,
{
    let (source, rest) = addresses.split_first_chunk::<N>()?;
    let (_destination, rest) = rest.split_first_chunk::<N>()?;
    let ([high, low, _, _], _extensions) = rest.split_first_chunk()?;
    // A balancer that listens on IPv6 may map the addresses of IPv4 clients.
    let source = IpAddr::from(*source).to_canonical();
    Some(SocketAddr::new(source, u16::from_be_bytes([*high, *low])))
}

#[cfg(test)]
mod tests {
    use std::net::Ipv4Addr;
    use std::sync::Mutex;

    use futures_util::FutureExt as _;
    use proptest::prelude::*;
    use tracing_subscriber::layer::SubscriberExt as _;

    use super::*;

    /// A header with this rest.
    fn header(command: u8, family: u8, rest: &[u8]) -> Vec<u8> {
        let length = u16::try_from(rest.len()).expect("short").to_be_bytes();
        [SIGNATURE, &[command, family], &length, rest].concat()
    }

    fn v4() -> Vec<u8> {
        header(PROXY, TCP_V4, &[192, 0, 2, 7, 10, 0, 0, 1, 0xc0, 0x01, 0x1f, 0x90])
    }

    fn client(bytes: &[u8]) -> Result<Option<String>, HeaderError> {
        match parse(bytes)? {
            Parsed::Header(header) => {
                assert_eq!(header.length, bytes.len());
                Ok(header.client.map(|client| client.to_string()))
            }
            Parsed::Incomplete(_) => panic!("the header is complete"),
        }
    }

    #[test]
    fn header_names_the_client() {
        assert_eq!(client(&v4()), Ok(Some("192.0.2.7:49153".to_owned())));
        let mut addresses = [0; 36];
        addresses[..4].copy_from_slice(&[0x20, 0x01, 0x0d, 0xb8]);
        (addresses[15], addresses[33]) = (7, 9);
        let v6 = header(PROXY, TCP_V6, &addresses);
        assert_eq!(client(&v6), Ok(Some("[2001:db8::7]:9".to_owned())));
        addresses[..16].copy_from_slice(&Ipv4Addr::new(192, 0, 2, 7).to_ipv6_mapped().octets());
        let mapped = header(PROXY, TCP_V6, &addresses);
        assert_eq!(client(&mapped), Ok(Some("192.0.2.7:9".to_owned())));
        let extended = header(PROXY, TCP_V4, &[&v4()[FIXED_BYTES..], &[4; 500]].concat());
        assert_eq!(client(&extended), Ok(Some("192.0.2.7:49153".to_owned())));
    }

    #[test]
    fn header_without_an_ip_address_names_no_client() {
        assert_eq!(client(&LOCAL_HEADER), Ok(None));
        for header in [
            header(LOCAL, TCP_V4, &v4()[FIXED_BYTES..]),
            header(LOCAL, 0xff, b"x"),
            header(PROXY, UNSPECIFIED, b""),
            header(PROXY, UNSPECIFIED, b"skipped"),
            header(PROXY, UNIX_STREAM, &[b'/'; 216]),
        ] {
            assert_eq!(client(&header), Ok(None), "{}", header.escape_ascii());
        }
    }

    #[test]
    fn invalid_header_is_refused() {
        let too_long = [SIGNATURE, &[PROXY, TCP_V4, 0x10, 0x01]].concat();
        for (bytes, error) in [
            (b"PROXY TCP4 192.0.2.7 10.0.0.1 49153 8080\r\n".to_vec(), HeaderError::Missing),
            (b"G".to_vec(), HeaderError::Missing),
            (header(0x11, TCP_V4, &v4()[FIXED_BYTES..]), HeaderError::Command(0x11)),
            (header(0x22, TCP_V4, &v4()[FIXED_BYTES..]), HeaderError::Command(0x22)),
            (header(PROXY, 0x12, &v4()[FIXED_BYTES..]), HeaderError::Family(0x12)),
            (header(PROXY, TCP_V4, &[1; 11]), HeaderError::TooShort),
            (header(PROXY, TCP_V6, &[1; 35]), HeaderError::TooShort),
            (too_long, HeaderError::TooLong(4097)),
        ] {
            assert_eq!(parse(&bytes), Err(error), "{}", bytes.escape_ascii());
        }
    }

    #[test]
    fn invalid_headers_of_proxies_are_logged_once_with_the_setting() {
        /// Keeps the messages.
        #[derive(Clone, Default)]
        struct Messages(Arc<Mutex<Vec<String>>>);
        impl<S: tracing::Subscriber> tracing_subscriber::Layer<S> for Messages {
            fn on_event(
                &self,
                event: &tracing::Event<'_>,
                _: tracing_subscriber::layer::Context<'_, S>,
            ) {
                let mut text = String::new();
                event.record(&mut |field: &tracing::field::Field, value: &dyn std::fmt::Debug| {
                    text += &format!("{field}={value:?} ");
                });
                if *event.metadata().level() == tracing::Level::WARN {
                    self.0.lock().expect("no panic").push(text);
                }
            }
        }
        let (messages, proxy) = (Messages::default(), SocketAddr::from(([10, 0, 0, 1], 9)));
        let subscriber = tracing_subscriber::registry().with(messages.clone());
        let protocol = ProxyProtocol::new(&[proxy.ip()]);
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build();
        let runtime = runtime.expect("a runtime");
        let read = |mut bytes: &[u8]| {
            runtime.block_on(protocol.client(&mut bytes, proxy, Duration::from_secs(9)))
        };
        tracing::subscriber::with_default(subscriber, || {
            assert_eq!(read(&LOCAL_HEADER), Some(proxy));
            assert_eq!(read(b""), None);
            assert!(messages.0.lock().expect("no panic").is_empty());
            assert_eq!((read(b"GET / HTTP/1.1\r\n\r\n"), read(&v4()[..20])), (None, None));
        });
        let messages = messages.0.lock().expect("no panic");
        assert_eq!(messages.len(), 1, "{messages:?}");
        assert!(messages[0].contains("`proxies`") && messages[0].contains("10.0.0.1"));
    }

    #[test]
    fn header_is_expected_from_proxies_only() {
        let protocol = ProxyProtocol::new(&[[10, 0, 0, 1].into()]);
        for (address, applies) in
            [("10.0.0.1", true), ("::ffff:10.0.0.1", true), ("10.0.0.2", false), ("::1", false)]
        {
            assert_eq!(protocol.applies_to(address.parse().expect("an address")), applies);
        }
    }

    /// Arbitrary bytes, most of them after a valid beginning.
    fn beginnings() -> impl Strategy<Value = Vec<u8>> {
        let fixed = (
            prop_oneof![Just(LOCAL), Just(PROXY), any::<u8>()],
            prop_oneof![Just(TCP_V4), Just(TCP_V6), Just(UNIX_STREAM), any::<u8>()],
            prop_oneof![0..64_u16, any::<u16>()],
        );
        let rest = prop::collection::vec(any::<u8>(), 0..300);
        let valid = (fixed, rest.clone()).prop_map(|((command, family, length), rest)| {
            [SIGNATURE, &[command, family], &length.to_be_bytes(), &rest].concat()
        });
        prop_oneof![4 => valid, 1 => rest]
    }

    proptest! {
        #[test]
        fn arbitrary_bytes_do_not_panic_and_reading_ends_with_the_header(bytes in beginnings()) {
            let mut stream = &bytes[..];
            let read = read_header(&mut stream).now_or_never().expect("all bytes are there");
            match parse(&bytes) {
                Ok(Parsed::Header(header)) => {
                    prop_assert_eq!(read, Ok(header));
                    prop_assert_eq!(stream, &bytes[header.length..]);
                    for end in 0..header.length {
                        let Ok(Parsed::Incomplete(length)) = parse(&bytes[..end]) else {
                            panic!("half a header counts")
                        };
                        prop_assert!(end < length && length <= header.length);
                    }
                }
                Ok(Parsed::Incomplete(length)) => {
                    prop_assert!(bytes.len() < length && length <= FIXED_BYTES + MAX_REST_BYTES);
                    prop_assert!(read.is_err());
                }
                Err(error) => prop_assert_eq!(read, Err(error)),
            }
        }
    }
}
