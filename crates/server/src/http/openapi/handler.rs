//! Describes handlers by their own types: each argument describes the input, the return type
//! describes the answer. If the types describe no body, the attribute does.

use std::net::SocketAddr;

use axum::Json;
use axum::extract::{ConnectInfo, Extension, Path, Request, State};
use axum::response::sse::Sse;
use axum::response::{IntoResponse, NoContent, Response};
use http::{HeaderMap, StatusCode, Uri};
use utoipa::{IntoParams, ToSchema};

use super::super::auth::Caller;
use super::super::error::ApiError;
use super::super::extract::{JsonBody, PathParam, PathParams, QueryParams, TolerantJson};
use super::super::shared_lists::SharedJson;
use super::Draft;
use crate::domain::person::Person;

/// 201, with the created object.
pub(in crate::http) struct Created<T>(pub(in crate::http) T);

impl<T: serde::Serialize> IntoResponse for Created<T> {
    fn into_response(self) -> Response {
        (StatusCode::CREATED, Json(self.0)).into_response()
    }
}

/// An extractor argument of a handler.
pub(in crate::http) trait Argument {
    /// Describes the caller's part of this argument. Most arguments come from the server and
    /// describe nothing.
    fn describe(_draft: &mut Draft) {}
}

impl<S> Argument for State<S> {}
impl<T> Argument for Extension<T> {}
impl Argument for ConnectInfo<SocketAddr> {}
impl Argument for HeaderMap {}
impl Argument for Uri {}
impl Argument for Request {}
impl Argument for Caller {}
impl Argument for Person {}

/// For a handler that answers in its own way when the argument is missing.
impl<T: Argument, E> Argument for Result<T, E> {
    fn describe(draft: &mut Draft) {
        T::describe(draft);
    }
}

impl<T: ToSchema> Argument for JsonBody<T> {
    fn describe(draft: &mut Draft) {
        draft.takes_json::<T>(true);
    }
}

impl<T: ToSchema> Argument for TolerantJson<T> {
    fn describe(draft: &mut Draft) {
        draft.takes_json::<T>(false);
    }
}

impl<T: ToSchema> Argument for PathParam<T> {
    fn describe(draft: &mut Draft) {
        draft.takes_path::<T>();
    }
}

impl<A: ToSchema, B: ToSchema> Argument for PathParams<A, B> {
    fn describe(draft: &mut Draft) {
        draft.takes_path::<A>();
        draft.takes_path::<B>();
    }
}

impl<T: ToSchema> Argument for Path<T> {
    fn describe(draft: &mut Draft) {
        draft.takes_path::<T>();
    }
}

impl<T: IntoParams> Argument for QueryParams<T> {
    fn describe(draft: &mut Draft) {
        draft.takes_query::<T>();
    }
}

/// An answer of a handler.
pub(in crate::http) trait Answer {
    /// Describes the answer to the caller.
    fn describe(_draft: &mut Draft) {}
}

impl Answer for Response {}
impl<S> Answer for Sse<S> {}

impl<T: ToSchema> Answer for Json<T> {
    fn describe(draft: &mut Draft) {
        draft.gives_json::<T>(StatusCode::OK);
    }
}

impl<T: ToSchema> Answer for SharedJson<T> {
    fn describe(draft: &mut Draft) {
        draft.gives_json::<T>(StatusCode::OK);
    }
}

impl<T: ToSchema> Answer for Created<T> {
    fn describe(draft: &mut Draft) {
        draft.gives_json::<T>(StatusCode::CREATED);
    }
}

impl Answer for NoContent {
    fn describe(draft: &mut Draft) {
        draft.gives_nothing();
    }
}

impl<T: Answer> Answer for Result<T, ApiError> {
    fn describe(draft: &mut Draft) {
        T::describe(draft);
    }
}

/// A handler with the arguments `T`.
pub(in crate::http) trait Describe<T> {
    /// Adds the descriptions of the arguments and the answer.
    fn describe(&self, draft: &mut Draft);
}

macro_rules! describe_handlers {
    ($(($($argument:ident),*))*) => { $(
        impl<F, A, $($argument,)*> Describe<($($argument,)*)> for F
        where
            F: Fn($($argument),*) -> A,
            A: Future,
            A::Output: Answer,
            $($argument: Argument,)*
        {
            fn describe(&self, draft: &mut Draft) {
                $($argument::describe(draft);)*
                A::Output::describe(draft);
            }
        }
    )* };
}

describe_handlers! {
    () (T1) (T1, T2) (T1, T2, T3) (T1, T2, T3, T4) (T1, T2, T3, T4, T5) (T1, T2, T3, T4, T5, T6)
    (T1, T2, T3, T4, T5, T6, T7)
}
