//! Reads to its end what a handler left of a request's body. Otherwise the connection would have to be closed under a
//! client that was refused early: it would see a reset instead of the refusal, or its next request would get no answer.

use std::pin::Pin;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use axum::body::Body;
use axum::extract::Request;
use bytes::Bytes;
use futures_util::StreamExt as _;
use http_body::{Frame, SizeHint};

/// Of a longer rest the connection is closed: reading it would cost more than a new connection.
const MAX_REST_BYTES: usize = 1024 * 1024;
/// How long the rest may take to arrive.
const PATIENCE: Duration = Duration::from_secs(5);

/// Wraps the body of a request; for `axum::middleware::map_request`, outermost.
pub async fn drain_unread(request: Request) -> Request {
    request.map(|body| Body::new(DrainedBody { body: Some(body) }))
}

struct DrainedBody {
    /// Taken when it has ended.
    body: Option<Body>,
}

impl http_body::Body for DrainedBody {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
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
        if let (Some(rest), Ok(runtime)) = (rest, tokio::runtime::Handle::try_current()) {
            runtime.spawn(tokio::time::timeout(PATIENCE, drain(rest)));
        }
    }
}

async fn drain(rest: Body) {
    let mut rest = rest.into_data_stream();
    let mut length = 0;
    while let Some(Ok(chunk)) = rest.next().await {
        length += chunk.len();
        if length > MAX_REST_BYTES {
            return;
        }
    }
}
