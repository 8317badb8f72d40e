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
/// Reading one byte in each of these brings a slice into memory; no page is smaller.
const PAGE_BYTES: usize = 4096;

/// Part of a blob, on its way to a client.
pub struct BlobBody {
    blob: Blob,
    left: Range<u64>,
    /// The next slice, while it is being fetched from the disk.
    pending: Option<JoinHandle<io::Result<Bytes>>>,
}

impl BlobBody {
    pub(super) fn new(blob: Blob, range: Range<u64>) -> Self {
        debug_assert!(range.end <= blob.size);
        Self { blob, left: range, pending: None }
    }

    /// The next slice if it is in memory; else starts to fetch it.
    fn next_slice(&mut self) -> io::Result<Option<Bytes>> {
        let start = self.left.start;
        let length = usize::try_from(SLICE_BYTES.min(self.left.end - start)).map_err(io::Error::other)?;
        let blob = self.blob.clone();
        if let Source::Mapped(_) = self.blob.source {
            let slice = blob.read_at(start, length)?;
            if is_in_memory(&slice) {
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

/// Whether reading these mapped bytes would not wait for the disk. An answer of "no" costs only a detour.
fn is_in_memory(slice: &[u8]) -> bool {
    // SAFETY: `sysconf` only reads its argument.
    let page = usize::try_from(unsafe { libc::sysconf(libc::_SC_PAGESIZE) }).unwrap_or(PAGE_BYTES);
    let before = slice.as_ptr().addr() % page;
    let length = before + slice.len();
    let mut resident = vec![0_u8; length.div_ceil(page)];
    // SAFETY: the range lies in one mapping, since a mapping begins on a page and the slice is part of it; the vector has
    // a byte for each of its pages.
    let status = unsafe { libc::mincore(slice.as_ptr().sub(before).cast_mut().cast(), length, resident.as_mut_ptr()) };
    status == 0 && resident.iter().all(|byte| byte & 1 == 1)
}

fn bring_into_memory(slice: &[u8]) {
    for page in slice.chunks(PAGE_BYTES) {
        std::hint::black_box(page[0]);
    }
    std::hint::black_box(slice.last());
}
