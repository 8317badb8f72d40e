//! The body of a robot's transfer: paced by the limits, and counted until its end.

use std::pin::Pin;
use std::task::{Context, Poll, ready};

use bytes::Bytes;
use futures_util::FutureExt as _;
use http_body::{Body, Frame, SizeHint};
use tokio::time::{Instant, Sleep, sleep_until};

use super::Transfer;

/// A paced body around another one.
pub struct TransferBody<B> {
    body: B,
    transfer: Transfer,
    /// Bytes received from the inner body and not yet overtaken on.
    held: Bytes,
    /// The number of those bytes that are next, and when.
    next: Option<(usize, Pin<Box<Sleep>>)>,
}

impl Transfer {
    /// Sends `body` as this transfer.
    pub fn carry<B>(self, body: B) -> TransferBody<B> {
        TransferBody { body, transfer: self, held: Bytes::new(), next: None }
    }
}

impl<B: Body<Data = Bytes> + Unpin> Body for TransferBody<B> {
    type Data = Bytes;
    type Error = B::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, B::Error>>> {
        let this = &mut *self;
        while this.held.is_empty() {
            match ready!(Pin::new(&mut this.body).poll_frame(context))
                .transpose()?
                .map(Frame::into_data)
            {
                Some(Ok(bytes)) => this.held = bytes,
                Some(Err(trailers)) => return Poll::Ready(Some(Ok(trailers))),
                None => return Poll::Ready(None),
            }
        }
        let length = match &mut this.next {
            Some((length, due)) => {
                ready!(due.poll_unpin(context));
                *length
            }
            None => match this.transfer.reserve(this.held.len() as u64) {
                None => this.held.len(),
                Some((bytes, at)) => {
                    let length = usize::try_from(bytes).unwrap_or(usize::MAX).min(this.held.len());
                    if at > Instant::now() {
                        let mut due = Box::pin(sleep_until(at));
                        let polled = due.poll_unpin(context);
                        this.next = Some((length, due));
                        ready!(polled);
                    }
                    length
                }
            },
        };
        this.next = None;
        this.transfer.sent(length as u64);
        Poll::Ready(Some(Ok(Frame::data(this.held.split_to(length)))))
    }

    fn is_end_stream(&self) -> bool {
        self.held.is_empty() && self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        let held = self.held.len() as u64;
        let (hint, mut all) = (self.body.size_hint(), SizeHint::new());
        all.set_lower(hint.lower() + held);
        if let Some(upper) = hint.upper() {
            all.set_upper(upper + held);
        }
        all
    }
}
