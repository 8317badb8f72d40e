//! Readers of the event stream at different servers, as pages are. A reader whose stream ends goes
//! to the next server.

use std::time::Duration;

use task_proto::api::Event;

use super::{Client, TRY_TIMEOUT};

/// The readers of a run.
pub(super) const READERS: usize = 5;
const AGAIN: Duration = Duration::from_millis(500);
/// How an event of the feed begins.
const FEED: &[u8] = br#"{"type":"feed""#;
/// The longest line that is kept.
const MAX_LINE_BYTES: usize = 1 << 20;

pub(super) async fn run(client: Client, reader: usize) -> anyhow::Result<()> {
    for number in (0..client.servers.len()).cycle().skip(reader) {
        let connection = {
            let mut record = client.record();
            record.feeds.push(Vec::new());
            record.feeds.len() - 1
        };
        tokio::select! {
            () = client.stop.cancelled() => return Ok(()),
            () = read(&client, number, connection) => {}
        }
        tokio::time::sleep(AGAIN).await;
    }
    Ok(())
}

/// Reads one stream to its end.
async fn read(client: &Client, server: usize, connection: usize) {
    let opening = client.servers[server].events();
    let Ok(Ok(mut stream)) = tokio::time::timeout(TRY_TIMEOUT, opening).await else { return };
    let mut rest = Vec::new();
    while let Ok(Some(bytes)) = stream.chunk().await {
        rest.extend_from_slice(&bytes);
        while let Some(end) = rest.iter().position(|byte| *byte == b'\n') {
            let line: Vec<u8> = rest.drain(..=end).collect();
            if let Some(number) = feed_number(&line) {
                client.record().feeds[connection].push(number);
            }
        }
        if rest.len() > MAX_LINE_BYTES {
            return;
        }
    }
}

/// The number of the feed's entry in a line of the stream, if it has one.
fn feed_number(line: &[u8]) -> Option<u64> {
    // Other events are many and long.
    let data = line.strip_prefix(b"data:")?.trim_ascii_start();
    if !data.starts_with(FEED) {
        return None;
    }
    match serde_json::from_slice(data) {
        Ok(Event::Feed { entry }) => Some(entry.number),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn feed_entries_are_found_in_the_stream() {
        let line = br#"data: {"type":"feed","entry":{"number":7,"at_ms":1,"kind":"robot_online","level":"info","text":"x"}}"#;
        assert_eq!(feed_number(line), Some(7));
        assert_eq!(feed_number(b"event: feed\n"), None);
        assert_eq!(feed_number(b"data: {\"type\":\"missed\"}"), None);
    }
}
