//! Reads server-sent events: the data of each as JSON. Names, ids and comments are passed over.

use reqwest::Response;
use serde::de::DeserializeOwned;

/// The largest event that is read.
const MAX_EVENT_BYTES: usize = 1024 * 1024;

/// The event stream of one response.
pub(crate) struct Events {
    response: Response,
    buffer: Vec<u8>,
}

impl Events {
    pub(crate) fn of(response: Response) -> Self {
        Self { response, buffer: Vec::new() }
    }

    /// The next event of this type; others are skipped. `None` at the end, or when an event is too
    /// large. Cancel-safe: bytes already read stay in the buffer.
    pub(crate) async fn next<T: DeserializeOwned>(&mut self) -> Result<Option<T>, reqwest::Error> {
        loop {
            while let Some(event) = take_event(&mut self.buffer) {
                if let Ok(event) = serde_json::from_slice(&event) {
                    return Ok(Some(event));
                }
            }
            match self.response.chunk().await? {
                Some(chunk) if self.buffer.len() + chunk.len() <= MAX_EVENT_BYTES => {
                    self.buffer.extend_from_slice(&chunk);
                }
                _ => return Ok(None),
            }
        }
    }
}

/// Takes the data of the first whole event out of `buffer`; empty if the event has none.
fn take_event(buffer: &mut Vec<u8>) -> Option<Vec<u8>> {
    let end = buffer.windows(2).position(|pair| pair == b"\n\n")?;
    let event: Vec<u8> = buffer.drain(..end + 2).collect();
    let lines = event.split(|byte| *byte == b'\n');
    let data: Vec<&[u8]> = lines
        .filter_map(|line| line.strip_prefix(b"data:"))
        .map(<[u8]>::trim_ascii_start)
        .collect();
    Some(data.join(&b'\n'))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn events_are_taken_whole_and_in_order() {
        let mut buffer =
            b": hello\nretry: 2000\n\nevent: lines\ndata: {\"a\":\ndata:1}\n\nevent: x\nda"
                .to_vec();
        assert_eq!(take_event(&mut buffer), Some(Vec::new()));
        assert_eq!(take_event(&mut buffer), Some(b"{\"a\":\n1}".to_vec()));
        assert_eq!(take_event(&mut buffer), None);
        buffer.extend_from_slice(b"ta: 2\n\n");
        assert_eq!(take_event(&mut buffer), Some(b"2".to_vec()));
        assert!(buffer.is_empty());
    }
}
