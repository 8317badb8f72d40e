//! A blob's bytes as the body of an HTTP answer: slices of bounded size, with the length known from
//! the start. Reads that would wait for the disk run on a blocking thread, so that one cold blob
//! never stalls the other connections.

use std::io;
use std::ops::Range;
use std::pin::Pin;
use std::task::{Context, Poll, ready};

use bytes::Bytes;
use futures_util::FutureExt as _;
use futures_util::future::BoxFuture;
use http_body::{Body, Frame, SizeHint};

use super::{Blob, BytesConsumer};

const SLICE_BYTES: u64 = 128 * 1024;
/// The most bytes that one system call checks for presence in memory, and that are read ahead if
/// they are absent. The kernel may evict them again before they are sent. A page is then read on
/// the wrong thread, which costs other connections a moment.
const LOOK_AHEAD_BYTES: usize = 1024 * 1024;
/// The smallest size of a memory page.
const PAGE_BYTES: usize = 4096;

/// Part of a blob, on its way to a client.
pub struct BlobBody {
    blob: Blob,
    /// The blob's mapped bytes, if the kernel reads them.
    mapped: Option<Bytes>,
    left: Range<u64>,
    /// The end of the mapped bytes that the last check found in memory.
    in_memory_until: u64,
    /// Whether the body yields to other tasks before the next slice. A client as fast as memory
    /// would otherwise keep a thread until its last byte.
    must_yield: bool,
    /// The next slice, while it is being fetched from the disk.
    pending: Option<BoxFuture<'static, io::Result<Bytes>>>,
}

impl BlobBody {
    pub(super) fn new(blob: Blob, range: Range<u64>, reader: BytesConsumer) -> Self {
        debug_assert!(range.end <= blob.size());
        let mapped = blob.mapped.clone().filter(|_| reader == BytesConsumer::Socket);
        let in_memory_until = range.start;
        Self { blob, mapped, in_memory_until, left: range, must_yield: false, pending: None }
    }

    /// The next slice if it is in memory. Otherwise starts the read.
    fn next_slice(&mut self) -> io::Result<Option<Bytes>> {
        let start = self.left.start;
        let length =
            usize::try_from(SLICE_BYTES.min(self.left.end - start)).map_err(io::Error::other)?;
        let ahead =
            usize::try_from(self.left.end - start).unwrap_or(usize::MAX).min(LOOK_AHEAD_BYTES);
        let slice = match &self.mapped {
            None => match self.blob.read_cached(start, length) {
                Some(slice) => return Ok(Some(slice)),
                None => None,
            },
            Some(mapped) => {
                let at = usize::try_from(start).map_err(io::Error::other)?;
                let slice = mapped.slice(at..at + length);
                if start + length as u64 <= self.in_memory_until {
                    return Ok(Some(slice));
                }
                let resident = bytes_in_memory(&mapped.slice(at..at + ahead));
                let is_resident = resident >= length;
                self.in_memory_until = start + if is_resident { resident } else { ahead } as u64;
                if is_resident {
                    return Ok(Some(slice));
                }
                Some(slice)
            }
        };
        let fetch = move |blob: &Blob| {
            blob.read_ahead(start, ahead)?;
            slice.map_or_else(|| blob.read_at(start, length), Ok)
        };
        self.pending = Some(self.blob.clone().with_disk_permit(fetch).boxed());
        Ok(None)
    }
}

impl Body for BlobBody {
    type Data = Bytes;
    type Error = io::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<io::Result<Frame<Bytes>>>> {
        if self.left.is_empty() {
            return Poll::Ready(None);
        }
        if std::mem::take(&mut self.must_yield) {
            context.waker().wake_by_ref();
            return Poll::Pending;
        }
        let ready = if self.pending.is_none() { self.next_slice()? } else { None };
        let slice = match (ready, self.pending.as_mut()) {
            (Some(slice), _) => slice,
            (None, Some(pending)) => {
                let fetched = ready!(pending.poll_unpin(context));
                self.pending = None;
                fetched?
            }
            (None, None) => return Poll::Ready(None),
        };
        self.left.start += slice.len() as u64;
        self.must_yield = true;
        Poll::Ready(Some(Ok(Frame::data(slice))))
    }

    fn is_end_stream(&self) -> bool {
        self.left.is_empty()
    }

    fn size_hint(&self) -> SizeHint {
        SizeHint::with_exact(self.left.end - self.left.start)
    }
}

/// The number of these mapped bytes, counted from the first, that can be read without waiting for
/// the disk. Too low a number only costs a detour.
fn bytes_in_memory(slice: &[u8]) -> usize {
    // SAFETY: `sysconf` only reads its argument.
    let page = usize::try_from(unsafe { libc::sysconf(libc::_SC_PAGESIZE) })
        .unwrap_or(PAGE_BYTES)
        .max(PAGE_BYTES);
    let before = slice.as_ptr().addr() % page;
    let mut resident = [0_u8; LOOK_AHEAD_BYTES / PAGE_BYTES + 1];
    let length = (before + slice.len()).min(resident.len() * page);
    // SAFETY: the range lies in one mapping, since a mapping begins on a page and the slice is part
    // of it; there is a byte for each of its pages.
    let status = unsafe {
        libc::mincore(slice.as_ptr().sub(before).cast_mut().cast(), length, resident.as_mut_ptr())
    };
    if status != 0 {
        return 0;
    }
    let pages = resident.iter().take_while(|byte| **byte & 1 == 1).count();
    (pages * page).saturating_sub(before).min(slice.len())
}
