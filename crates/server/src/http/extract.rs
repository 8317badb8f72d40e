//! Extractors for handlers: JSON bodies, path and query parameters, the idempotency key. Invalid
//! input is refused here in the API's error shape, naming the field.

use std::fmt::Display;
use std::str::FromStr;

use axum::extract::{FromRequest, FromRequestParts, RawPathParams, Request};
use bytes::Bytes;
use http::request::Parts;
use http::{HeaderValue, StatusCode, header};
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value;
use task_proto::api::MAX_PAGE_ENTRIES;

use super::error::ApiError;
use crate::orders::actions::{IdempotencyKey, InvalidIdempotencyKey};

/// A JSON body from an operator. Unknown fields are refused: an order with an ignored field would
/// be carried out only in part.
pub struct JsonBody<T>(pub T);

/// A JSON body from an agent, which may be newer than this server: unknown fields are ignored.
pub struct TolerantJson<T>(pub T);

impl<S: Send + Sync, T: DeserializeOwned + Serialize> FromRequest<S> for JsonBody<T> {
    type Rejection = ApiError;

    async fn from_request(request: Request, state: &S) -> Result<Self, ApiError> {
        let body = json_bytes(request, state).await?;
        let value: T = parse_json(&body)?;
        refuse_unknown_fields(&body, &value)?;
        Ok(Self(value))
    }
}

impl<S: Send + Sync, T: DeserializeOwned> FromRequest<S> for TolerantJson<T> {
    type Rejection = ApiError;

    async fn from_request(request: Request, state: &S) -> Result<Self, ApiError> {
        parse_json(&json_bytes(request, state).await?).map(Self)
    }
}

async fn json_bytes<S: Send + Sync>(request: Request, state: &S) -> Result<Bytes, ApiError> {
    let content_type =
        request.headers().get(header::CONTENT_TYPE).and_then(|value| value.to_str().ok());
    let media_type = content_type.unwrap_or_default().split(';').next().unwrap_or_default().trim();
    if !media_type.eq_ignore_ascii_case("application/json") {
        let message = "Content-Type: expected application/json";
        return Err(ApiError::new(
            StatusCode::UNSUPPORTED_MEDIA_TYPE,
            "unsupported_media_type",
            message,
        ));
    }
    Bytes::from_request(request, state).await.map_err(|rejection| match rejection.status() {
        StatusCode::PAYLOAD_TOO_LARGE => ApiError::new(
            StatusCode::PAYLOAD_TOO_LARGE,
            "too_large",
            "the body is larger than this route allows",
        ),
        _ => ApiError::invalid("the body ended before it was complete"),
    })
}

/// Parses JSON; an error names the field by its path.
pub fn parse_json<T: DeserializeOwned>(body: &[u8]) -> Result<T, ApiError> {
    let mut parser = serde_json::Deserializer::from_slice(body);
    let value = serde_path_to_error::deserialize(&mut parser).map_err(|error| {
        let path = error.path().to_string();
        let place = if matches!(path.as_str(), "." | "?") { "the body".to_owned() } else { path };
        ApiError::invalid(format!("{place}: {}", error.into_inner()))
    })?;
    parser.end().map_err(|error| ApiError::invalid(format!("the body: {error}")))?;
    Ok(value)
}

/// A field is known if the value, serialized again, has it.
fn refuse_unknown_fields<T: Serialize>(body: &[u8], value: &T) -> Result<(), ApiError> {
    let given: serde_json::Map<String, Value> = parse_json(body)?;
    let known = serde_json::to_value(value).map_err(|error| ApiError::internal(&error))?;
    match unknown_field(&given, &known) {
        Some(unknown) => {
            let shown: String = unknown.chars().take(80).collect();
            Err(ApiError::invalid(format!("{shown}: there is no such field")))
        }
        None => Ok(()),
    }
}

/// The path of an unknown field, at any depth of the body. In nested values, null and {} are the
/// same as an absent field, which is not serialized.
fn unknown_field(given: &serde_json::Map<String, Value>, known: &Value) -> Option<String> {
    given.iter().find_map(|(key, value)| {
        let Some(known) = known.get(key) else { return Some(key.clone()) };
        let is_present = |(_, value): &(&String, &Value)| {
            !value.is_null() && value.as_object().is_none_or(|o| !o.is_empty())
        };
        let present = value.as_object()?.iter().filter(is_present);
        let given = present.map(|(key, value)| (key.clone(), value.clone())).collect();
        Some(format!("{key}.{}", unknown_field(&given, known)?))
    })
}

/// The only parameter of the path, parsed. A value that does not parse names no existing resource.
pub struct PathParam<T>(pub T);

impl<S: Send + Sync, T: FromStr<Err: Display>> FromRequestParts<S> for PathParam<T> {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, ApiError> {
        let missing = || ApiError::not_found("there is nothing at this path");
        let params =
            RawPathParams::from_request_parts(parts, state).await.map_err(|_| missing())?;
        let (_, text) = params.iter().next().ok_or_else(missing)?;
        text.parse().map(Self).map_err(|error: T::Err| ApiError::not_found(error.to_string()))
    }
}

/// The two parameters of the path, parsed. A value that does not parse names no existing resource.
pub struct PathParams<A, B>(pub A, pub B);

impl<S, A, B> FromRequestParts<S> for PathParams<A, B>
where
    S: Send + Sync,
    A: FromStr<Err: Display>,
    B: FromStr<Err: Display>,
{
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, ApiError> {
        let missing = || ApiError::not_found("there is nothing at this path");
        let params =
            RawPathParams::from_request_parts(parts, state).await.map_err(|_| missing())?;
        let mut texts = params.iter().map(|(_, text)| text);
        let first = texts.next().ok_or_else(missing)?;
        let first =
            first.parse().map_err(|error: A::Err| ApiError::not_found(error.to_string()))?;
        let second = texts.next().ok_or_else(missing)?;
        let second =
            second.parse().map_err(|error: B::Err| ApiError::not_found(error.to_string()))?;
        Ok(Self(first, second))
    }
}

/// The query's parameters. Only the fields of the handler's struct are known; others are refused.
pub struct QueryParams<T>(pub T);

impl<S: Send + Sync, T: DeserializeOwned> FromRequestParts<S> for QueryParams<T> {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, _state: &S) -> Result<Self, ApiError> {
        axum::extract::Query::<T>::try_from_uri(&parts.uri)
            .map(|query| Self(query.0))
            .map_err(|rejection| ApiError::invalid(format!("the query: {}", rejection.body_text())))
    }
}

/// Checks the number of entries per page.
pub fn page_limit(limit: Option<u32>) -> Result<Option<u32>, ApiError> {
    match limit {
        None | Some(1..=MAX_PAGE_ENTRIES) => Ok(limit),
        Some(other) => {
            Err(ApiError::invalid(format!("limit: expected 1 to {MAX_PAGE_ENTRIES}, not {other}")))
        }
    }
}

/// Parses the key that makes an order safe to repeat.
pub fn idempotency_key(value: Option<&HeaderValue>) -> Result<IdempotencyKey, ApiError> {
    let value = value
        .ok_or_else(|| ApiError::invalid("Idempotency-Key: the header is required for an order"))?;
    let key = value.to_str().unwrap_or_default().parse();
    key.map_err(|error: InvalidIdempotencyKey| ApiError::invalid(error.to_string()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use task_proto::api::CreateDeployment;

    #[test]
    fn invalid_body_names_the_field() {
        let digest = task_proto::Digest::of(b"x");
        let body = |rest: &str| {
            format!(r#"{{"package": "talker", "manifest": "{digest}", "selector": "*"{rest}}}"#)
        };
        let cases = [
            ("{".to_owned(), "the body: EOF"),
            ("[]".to_owned(), "the body: "),
            (r#"{"package": "talker"}"#.to_owned(), "the body: missing field `manifest`"),
            (body(r#", "batch": "two""#), "batch: invalid type"),
            (body(r#", "batch": -1"#), "batch: invalid value"),
            (body(r#", "delivery": "by-pigeon""#), "delivery: unknown variant `by-pigeon`"),
            (body("} x"), "the body: trailing"),
            (r#"{"package": "No!"}"#.to_owned(), "package: \"No!\" is not a valid package name"),
        ];
        for (text, expected) in cases {
            let error = parse_json::<CreateDeployment>(text.as_bytes()).expect_err(expected);
            assert!(error.message.starts_with(expected), "{} / {expected}", error.message);
        }
        let misspelt = body(r#", "selektor": "*""#);
        let order: CreateDeployment = parse_json(misspelt.as_bytes()).expect("parses");
        let error = refuse_unknown_fields(misspelt.as_bytes(), &order).expect_err("refused");
        assert_eq!(error.message, "selektor: there is no such field");
        assert!(refuse_unknown_fields(body(r#", "dry_run": true"#).as_bytes(), &order).is_ok());
    }
}
