//! A blob's bytes as the body of an HTTP answer: slices of bounded size, and a length known from the start. Whatever
//! would wait for the disk is done on a blocking thread, so that one cold blob never stalls the other connections.

use std::io;
use std::ops::Range;
use std::path::Path;
use std::pin::Pin;
use std::task::{Context, Poll, ready};

use bytes::Bytes;
use http_body::{Body, Frame, SizeHint};
use tokio::task::JoinHandle;

use super::{Blob, BlobError, Source, on_disk};

/// The most bytes handed out at once.
const SLICE_BYTES: u64 = 256 * 1024;
/// The most bytes that are looked at ahead for whether they are in memory, in one system call. They may be thrown out again
/// before they are sent; then a page is read where it should not be, which costs other connections a moment.
const LOOK_AHEAD_BYTES: usize = 1024 * 1024;
/// Reading one byte in each of these brings a slice into memory; no page is smaller.
const PAGE_BYTES: usize = 4096;

/// Part of a blob, on its way to a client.
pub struct BlobBody {
    blob: Blob,
    left: Range<u64>,
    /// Up to where it was in memory when that was looked at last.
    in_memory_until: u64,
    /// The next slice, while it is being fetched from the disk.
    pending: Option<JoinHandle<io::Result<Bytes>>>,
}

impl BlobBody {
    pub(super) fn new(blob: Blob, range: Range<u64>) -> Self {
        debug_assert!(range.end <= blob.size);
        Self { blob, in_memory_until: range.start, left: range, pending: None }
    }

    /// The next slice if it is in memory; else starts to fetch it.
    fn next_slice(&mut self) -> io::Result<Option<Bytes>> {
        let start = self.left.start;
        let length = usize::try_from(SLICE_BYTES.min(self.left.end - start)).map_err(io::Error::other)?;
        let blob = self.blob.clone();
        if let Source::Mapped(_) = self.blob.source {
            let slice = blob.read_at(start, length)?;
            if start + length as u64 <= self.in_memory_until {
                return Ok(Some(slice));
            }
            let left = usize::try_from(self.left.end - start).unwrap_or(LOOK_AHEAD_BYTES);
            let ahead = blob.read_at(start, left.min(LOOK_AHEAD_BYTES))?;
            let resident = bytes_in_memory(&ahead);
            self.in_memory_until = start + resident as u64;
            if resident >= length {
                return Ok(Some(slice));
            }
            self.pending = Some(tokio::task::spawn_blocking(move || {
                bring_into_memory(&slice);
                Ok(slice)
            }));
        } else {
            self.pending = Some(tokio::task::spawn_blocking(move || blob.read_at(start, length)));
        }
        Ok(None)
    }
}

impl Body for BlobBody {
    type Data = Bytes;
    type Error = io::Error;

    fn poll_frame(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<io::Result<Frame<Bytes>>>> {
        if self.left.is_empty() {
            return Poll::Ready(None);
        }
        let ready = if self.pending.is_none() { self.next_slice()? } else { None };
        let slice = match (ready, self.pending.as_mut()) {
            (Some(slice), _) => slice,
            (None, Some(pending)) => {
                let fetched = ready!(Pin::new(pending).poll(context));
                self.pending = None;
                fetched.map_err(io::Error::other)??
            }
            (None, None) => return Poll::Ready(None),
        };
        self.left.start += slice.len() as u64;
        Poll::Ready(Some(Ok(Frame::data(slice))))
    }

    fn is_end_stream(&self) -> bool {
        self.left.is_empty()
    }

    fn size_hint(&self) -> SizeHint {
        SizeHint::with_exact(self.left.end - self.left.start)
    }
}

impl Blob {
    /// The bytes of `range`, which lies inside the blob: mapped ones are not copied, only brought into memory.
    pub async fn slice(&self, range: Range<u64>) -> Result<Bytes, BlobError> {
        debug_assert!(range.end <= self.size);
        let blob = self.clone();
        on_disk(move || {
            let length = usize::try_from(range.end - range.start).unwrap_or(usize::MAX);
            let slice = blob.read_at(range.start, length);
            let slice = slice.map_err(BlobError::disk("read", Path::new(&blob.digest.hex())))?;
            if let Source::Mapped(_) = blob.source {
                bring_into_memory(&slice);
            }
            Ok(slice)
        })
        .await
    }
}

/// How many of these mapped bytes, counted from the first, can be read without waiting for the disk. Too few cost only a
/// detour.
fn bytes_in_memory(slice: &[u8]) -> usize {
    // SAFETY: `sysconf` only reads its argument.
    let page = usize::try_from(unsafe { libc::sysconf(libc::_SC_PAGESIZE) }).unwrap_or(PAGE_BYTES).max(PAGE_BYTES);
    let before = slice.as_ptr().addr() % page;
    let mut resident = [0_u8; LOOK_AHEAD_BYTES / PAGE_BYTES + 1];
    let length = (before + slice.len()).min(resident.len() * page);
    // SAFETY: the range lies in one mapping, since a mapping begins on a page and the slice is part of it; there is a byte
    // for each of its pages.
    let status = unsafe { libc::mincore(slice.as_ptr().sub(before).cast_mut().cast(), length, resident.as_mut_ptr()) };
    if status != 0 {
        return 0;
    }
    let pages = resident.iter().take_while(|byte| **byte & 1 == 1).count();
    (pages * page).saturating_sub(before).min(slice.len())
}

fn bring_into_memory(slice: &[u8]) {
    for page in slice.chunks(PAGE_BYTES) {
        std::hint::black_box(page[0]);
    }
    std::hint::black_box(slice.last());
}
