//! Long lists, rendered once for all requests that may share the answer. A request never gets an
//! answer that was begun before the request came: while one rendering is under way, later requests
//! for the same list wait and share the next one.

use std::collections::HashMap;
use std::marker::PhantomData;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use http::{Uri, header};
use serde::Serialize;
use tokio::sync::Semaphore;
use tokio::time::Instant;

use super::error::ApiError;
use crate::domain::person::Scope;

/// Concurrent renderings: each holds the views of a whole fleet.
const RENDERINGS: usize = 2;

/// The identity of a list: requests with equal keys get equal answers.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(super) struct ListKey {
    /// The selectors of the person's scope.
    scope: Vec<String>,
    /// The path and query of the request.
    target: String,
}

impl ListKey {
    /// The list that a person with this scope gets at `uri`.
    pub(super) fn new(scope: &Scope, uri: &Uri) -> Self {
        Self {
            scope: scope.selectors().iter().map(ToString::to_string).collect(),
            target: uri.to_string(),
        }
    }
}

/// The lists being rendered.
#[derive(Debug)]
pub struct SharedLists {
    lists: Mutex<HashMap<ListKey, Arc<List>>>,
    renderings: Semaphore,
}

/// The last rendering of a list.
type List = tokio::sync::Mutex<Option<Rendering>>;

#[derive(Debug)]
struct Rendering {
    begun: Instant,
    body: Bytes,
}

/// A request's share in a list; the list is removed with its last share.
struct Share<'a> {
    lists: &'a SharedLists,
    key: ListKey,
    list: Arc<List>,
}

/// The JSON text of a `T`.
pub(super) struct SharedJson<T> {
    body: Bytes,
    of: PhantomData<fn() -> T>,
}

impl Default for SharedLists {
    fn default() -> Self {
        Self { lists: Mutex::default(), renderings: Semaphore::new(RENDERINGS) }
    }
}

impl SharedLists {
    /// The list with this key, from a rendering that begins after this call. If `render` fails,
    /// this request fails, and the next waiting request renders.
    pub(super) async fn get<T: Serialize>(
        &self,
        key: ListKey,
        render: impl Future<Output = Result<T, ApiError>>,
    ) -> Result<SharedJson<T>, ApiError> {
        let arrived_at = Instant::now();
        let share = self.share(key);
        let mut last = share.list.lock().await;
        let body = match &*last {
            Some(rendering) if rendering.begun > arrived_at => rendering.body.clone(),
            _ => {
                let _permit = self.renderings.acquire().await;
                let begun = Instant::now();
                let list = render.await?;
                let body = Bytes::from(
                    serde_json::to_vec(&list).map_err(|error| ApiError::internal(&error))?,
                );
                *last = Some(Rendering { begun, body: body.clone() });
                body
            }
        };
        drop(last);
        Ok(SharedJson { body, of: PhantomData })
    }

    fn share(&self, key: ListKey) -> Share<'_> {
        let list = self.lists().entry(key.clone()).or_default().clone();
        Share { lists: self, key, list }
    }

    fn lists(&self) -> MutexGuard<'_, HashMap<ListKey, Arc<List>>> {
        self.lists.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for Share<'_> {
    fn drop(&mut self) {
        let mut lists = self.lists.lists();
        // The map holds one reference and this share the other; others join under this lock only.
        if Arc::strong_count(&self.list) == 2 {
            lists.remove(&self.key);
        }
    }
}

impl<T> IntoResponse for SharedJson<T> {
    fn into_response(self) -> Response {
        ([(header::CONTENT_TYPE, "application/json")], self.body).into_response()
    }
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use futures_util::future::{join_all, poll_immediate};
    use tokio::sync::oneshot;

    use super::*;

    fn key(target: &'static str) -> ListKey {
        ListKey::new(&Scope::everything(), &Uri::from_static(target))
    }

    #[tokio::test]
    async fn requests_that_come_during_a_rendering_share_the_next_one() {
        let (lists, count) = (SharedLists::default(), Cell::new(0));
        let (release, held) = oneshot::channel::<()>();
        let mut first = Box::pin(lists.get(key("/robots"), async {
            held.await.expect("released");
            Ok("first")
        }));
        assert!(poll_immediate(&mut first).await.is_none());
        let later = (0..300).map(|_| {
            lists.get(key("/robots"), async {
                count.set(count.get() + 1);
                Ok("second")
            })
        });
        let mut later = Box::pin(join_all(later));
        assert!(poll_immediate(&mut later).await.is_none());
        release.send(()).expect("awaited");
        assert_eq!(&first.await.expect("rendered").body[..], b"\"first\"");
        let bodies: Vec<_> =
            later.await.into_iter().map(|list| list.expect("rendered").body).collect();
        assert!(
            bodies
                .iter()
                .all(|body| body[..] == *b"\"second\"" && body.as_ptr() == bodies[0].as_ptr())
        );
        assert_eq!(count.get(), 1);
        assert!(lists.lists().is_empty(), "nothing is kept");
    }

    #[tokio::test]
    async fn request_after_a_rendering_has_begun_does_not_get_its_answer() {
        let (lists, fleet) = (SharedLists::default(), Cell::new(1));
        let (release, held) = oneshot::channel::<()>();
        let mut before = Box::pin(lists.get(key("/robots"), async {
            let seen = fleet.get();
            held.await.expect("released");
            Ok(seen)
        }));
        assert!(poll_immediate(&mut before).await.is_none());
        fleet.set(2);
        let mut after = Box::pin(lists.get(key("/robots"), async { Ok(fleet.get()) }));
        assert!(poll_immediate(&mut after).await.is_none());
        release.send(()).expect("awaited");
        let (before, after) = tokio::join!(before, after);
        let body = |list: Result<SharedJson<i32>, ApiError>| list.expect("rendered").body;
        assert_eq!((&body(before)[..], &body(after)[..]), (&b"1"[..], &b"2"[..]));
    }

    #[tokio::test]
    async fn failed_or_dropped_rendering_leaves_the_list_to_the_next_request() {
        let lists = SharedLists::default();
        let mut dropped =
            Box::pin(lists.get(key("/robots"), std::future::pending::<Result<(), _>>()));
        assert!(poll_immediate(&mut dropped).await.is_none());
        let failed = lists.get(key("/robots"), async { Err::<(), _>(ApiError::not_found("gone")) });
        let good = lists.get(key("/robots"), async { Ok("good") });
        drop(dropped);
        let (failed, good) = tokio::join!(failed, good);
        assert_eq!(failed.err().map(|error| error.message), Some("gone".to_owned()));
        assert_eq!(&good.expect("rendered").body[..], b"\"good\"");
        let lab = Scope::of(["site=lab".parse().expect("a selector")]);
        let other = ListKey::new(&lab, &Uri::from_static("/robots"));
        assert_ne!(other, key("/robots"), "another scope is another list");
        assert!(lists.lists().is_empty());
    }
}
