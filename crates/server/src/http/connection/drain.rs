//! Reads the unread rest of a request's body. Otherwise the connection of a client that was refused
//! early would have to be closed: the client would see a reset instead of the refusal, or its next
//! request would get no answer. Many clients read no answer before they have sent their whole body,
//! so the limit is on the time that the rest takes, not on its length.

use std::pin::Pin;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use axum::body::Body;
use axum::extract::Request;
use bytes::Bytes;
use futures_util::StreamExt as _;
use http::header;
use http_body::{Frame, SizeHint};

/// Time limit for the rest of the body.
const DRAIN_TIMEOUT: Duration = Duration::from_secs(30);
/// How long the sender may be silent.
const IDLE_TIMEOUT: Duration = Duration::from_secs(5);
/// Time by which the refusal has gone out. A client that has announced its body would send the
/// whole body if asked for more before the refusal.
const HEAD_START: Duration = Duration::from_millis(100);

/// Wraps the body of a request; for `axum::middleware::map_request`, outermost.
pub async fn drain_unread(request: Request) -> Request {
    let expects_continue = request.headers().contains_key(header::EXPECT);
    request.map(|body| Body::new(DrainedBody { body: Some(body), expects_continue }))
}

struct DrainedBody {
    /// Taken when the body has ended.
    body: Option<Body>,
    /// The client sends no body before the server asks for the body, or before the client's wait
    /// for that request ends.
    expects_continue: bool,
}

impl http_body::Body for DrainedBody {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        self.expects_continue = false;
        let Some(body) = self.body.as_mut() else { return Poll::Ready(None) };
        let frame = ready!(Pin::new(body).poll_frame(context));
        if !matches!(frame, Some(Ok(_))) {
            self.body = None;
        }
        Poll::Ready(frame)
    }

    fn is_end_stream(&self) -> bool {
        self.body.as_ref().is_none_or(http_body::Body::is_end_stream)
    }

    fn size_hint(&self) -> SizeHint {
        self.body.as_ref().map_or(SizeHint::with_exact(0), http_body::Body::size_hint)
    }
}

impl Drop for DrainedBody {
    fn drop(&mut self) {
        let rest = self.body.take().filter(|body| !http_body::Body::is_end_stream(body));
        let head_start = if self.expects_continue { HEAD_START } else { Duration::ZERO };
        if let (Some(rest), Ok(runtime)) = (rest, tokio::runtime::Handle::try_current()) {
            runtime.spawn(tokio::time::timeout(DRAIN_TIMEOUT, drain(rest, head_start)));
        }
    }
}

async fn drain(rest: Body, head_start: Duration) {
    tokio::time::sleep(head_start).await;
    let mut rest = rest.into_data_stream();
    while let Ok(Some(Ok(_))) = tokio::time::timeout(IDLE_TIMEOUT, rest.next()).await {}
}
