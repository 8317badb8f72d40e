//! Pending output of a session: small packets, and at most one payload that is shared with other
//! sessions and therefore never copied. This module knows nothing of MQTT.

use std::io::IoSlice;

use bytes::{Buf, Bytes, BytesMut};

/// Buffers above this size are released when they are empty.
const MAX_IDLE_BYTES: usize = 8 * 1024;

/// Pending bytes, in the order of writing.
#[derive(Debug, Default)]
pub(super) struct Output {
    before: BytesMut,
    shared: Bytes,
    after: BytesMut,
}

impl Output {
    pub(super) fn is_empty(&self) -> bool {
        !self.has_remaining()
    }

    /// The buffer for the next packet.
    pub(super) fn packets(&mut self) -> &mut BytesMut {
        if self.shared.is_empty() { &mut self.before } else { &mut self.after }
    }

    /// Adds a payload without copying it. Call this only when no other payload is pending.
    pub(super) fn share(&mut self, payload: Bytes) {
        debug_assert!(self.shared.is_empty() && self.after.is_empty(), "one at a time");
        self.shared = payload;
    }

    /// The bytes that this session alone holds.
    pub(super) fn own_bytes(&self) -> usize {
        self.before.len() + self.after.len()
    }

    /// The bytes of the shared payload that are not written yet.
    pub(super) fn shared_bytes(&self) -> usize {
        self.shared.len()
    }

    /// Releases large buffers of an idle connection.
    pub(super) fn release_if_idle(&mut self) {
        release_if_idle(&mut self.before);
        release_if_idle(&mut self.after);
    }
}

/// Releases a buffer's memory, if the buffer is large and empty.
pub(super) fn release_if_idle(buffer: &mut BytesMut) {
    if buffer.is_empty() && buffer.capacity() > MAX_IDLE_BYTES {
        *buffer = BytesMut::new();
    }
}

impl Buf for Output {
    fn remaining(&self) -> usize {
        self.before.len() + self.shared.len() + self.after.len()
    }

    fn chunk(&self) -> &[u8] {
        let chunks: [&[u8]; 3] = [&self.before, &self.shared, &self.after];
        chunks.into_iter().find(|chunk| !chunk.is_empty()).unwrap_or_default()
    }

    fn chunks_vectored<'a>(&'a self, slices: &mut [IoSlice<'a>]) -> usize {
        let chunks: [&[u8]; 3] = [&self.before, &self.shared, &self.after];
        let filled = chunks.into_iter().filter(|chunk| !chunk.is_empty()).zip(slices);
        filled.map(|(chunk, slice)| *slice = IoSlice::new(chunk)).count()
    }

    fn advance(&mut self, mut count: usize) {
        let parts: [&mut dyn Buf; 3] = [&mut self.before, &mut self.shared, &mut self.after];
        for part in parts {
            let step = count.min(part.remaining());
            part.advance(step);
            count -= step;
        }
        assert_eq!(count, 0, "no more is written than there is");
        if self.shared.is_empty() {
            // Releases the payload, which would still be held as an empty slice.
            self.shared = Bytes::new();
            if self.before.is_empty() {
                std::mem::swap(&mut self.before, &mut self.after);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn packets_keep_their_order_around_a_shared_payload() {
        for step in 1..20 {
            let mut output = Output::default();
            output.packets().extend_from_slice(b"head");
            output.share(Bytes::from_static(b"payload"));
            output.packets().extend_from_slice(b"tail");
            assert_eq!((output.own_bytes(), output.shared_bytes(), output.remaining()), (8, 7, 15));
            let mut written = Vec::new();
            while output.has_remaining() {
                let mut slices = [IoSlice::new(&[]); 4];
                let count = output.chunks_vectored(&mut slices);
                let all: Vec<u8> =
                    slices[..count].iter().flat_map(|slice| slice.iter().copied()).collect();
                assert!(all.starts_with(output.chunk()) && !output.chunk().is_empty());
                let now = &all[..step.min(all.len())];
                written.extend_from_slice(now);
                let length = now.len();
                output.advance(length);
                if written.len() == 15 {
                    output.packets().extend_from_slice(b"!");
                }
            }
            assert_eq!(written, b"headpayloadtail!", "{step} bytes at a time");
        }
    }
}
