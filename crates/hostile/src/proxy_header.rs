//! The header of the PROXY protocol, with which a balancer begins a connection.

use futures_util::FutureExt as _;
use taskd::net::proxy_protocol::{HeaderError, Parsed, parse, read_header};
use tokio::io::AsyncReadExt as _;

/// The longest header that the parser accepts.
const MAX_BYTES: usize = 16 + 4096;

/// The beginning of a connection: the reader agrees with the parser, however the bytes are split,
/// and takes no byte beyond the header.
pub fn proxy_header(bytes: &[u8]) {
    let parsed = parse(bytes);
    for split in [0, 1, 12, 15, 16, 20] {
        let (first, second) = bytes.split_at(split.min(bytes.len()));
        let mut stream = first.chain(second);
        let read = read_header(&mut stream).now_or_never().expect("all bytes are there");
        match parsed {
            Ok(Parsed::Header(header)) => {
                let mut left = Vec::new();
                let ended = stream.read_to_end(&mut left).now_or_never();
                ended.expect("all bytes are there").expect("in memory");
                assert_eq!((read, &left[..]), (Ok(header), &bytes[header.length..]));
            }
            Ok(Parsed::Incomplete(length)) => {
                assert!(bytes.len() < length && length <= MAX_BYTES, "{length}");
                let is_empty = bytes.is_empty();
                let ended = if is_empty { HeaderError::Empty } else { HeaderError::Truncated };
                assert_eq!(read, Err(ended));
            }
            Err(error) => assert_eq!(read, Err(error)),
        }
    }
}
