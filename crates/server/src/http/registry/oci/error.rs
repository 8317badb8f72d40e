//! The distribution specification's error bodies: `{"errors":[{"code","message","detail"}]}`, with
//! its codes. Internal causes are logged and never sent.

use crate::http::openapi::{self, Draft};
use axum::Json;
use axum::response::{IntoResponse, Response};
use http::header::{ALLOW, RETRY_AFTER, WWW_AUTHENTICATE};
use http::{HeaderValue, StatusCode};
use serde_json::{Value, json};
use task_proto::Digest;

use crate::blobs::BlobError;
use crate::http::error::{ApiError, DATABASE_CORRUPT};
use crate::link::transfers::RetryLater;
use crate::store::{Fault, StoreError};

/// Seconds until a retry is useful when something has to be collected first.
const COLLECTION_S: u64 = 300;

/// Our own code for a corrupt database, for which the specification has none.
const CORRUPT: &str = "DATABASE_CORRUPT";

/// Our own code for a part of the server that can't be reached.
const UNAVAILABLE: &str = "UNAVAILABLE";

/// Seconds until a retry is useful when the common store of blobs does not answer.
const STORE_RETRY_S: u64 = 5;

/// An error answer of the registry.
#[derive(Debug)]
pub struct OciError {
    status: StatusCode,
    code: &'static str,
    messages: Vec<(String, Value)>,
    allow: Option<&'static str>,
    retry_after_s: Option<u64>,
}

impl OciError {
    fn new(status: StatusCode, code: &'static str, message: impl Into<String>) -> Self {
        Self {
            status,
            code,
            messages: vec![(message.into(), Value::Null)],
            allow: None,
            retry_after_s: None,
        }
    }

    /// 401: the caller is not authenticated.
    pub fn unauthorized() -> Self {
        let message = "log in with any user name and a token as the password";
        Self::new(StatusCode::UNAUTHORIZED, "UNAUTHORIZED", message)
    }

    /// 403: the caller lacks the permission.
    pub fn denied(message: impl Into<String>) -> Self {
        Self::new(StatusCode::FORBIDDEN, "DENIED", message)
    }

    /// 409: the content can't be changed or deleted, because robots should have it, or because of
    /// its tag.
    pub fn conflict(message: impl Into<String>) -> Self {
        Self::new(StatusCode::CONFLICT, "DENIED", message)
    }

    /// 404: not an endpoint of the specification.
    pub fn no_endpoint() -> Self {
        Self::new(
            StatusCode::NOT_FOUND,
            "UNSUPPORTED",
            "this is not an endpoint of the distribution API",
        )
    }

    /// 405: the endpoint does not support this method.
    pub fn method(allow: &'static str) -> Self {
        let error = Self::new(
            StatusCode::METHOD_NOT_ALLOWED,
            "UNSUPPORTED",
            "the endpoint does not support this method",
        );
        Self { allow: Some(allow), ..error }
    }

    /// 400: not a valid repository name.
    pub fn name_invalid(error: &task_proto::ids::InvalidId) -> Self {
        Self::new(StatusCode::BAD_REQUEST, "NAME_INVALID", error.to_string())
    }

    /// 400: the path is not text, so it contains no valid name.
    pub fn path_invalid() -> Self {
        Self::new(StatusCode::BAD_REQUEST, "NAME_INVALID", "the path is not UTF-8")
    }

    /// 404: no such repository.
    pub fn name_unknown() -> Self {
        Self::new(StatusCode::NOT_FOUND, "NAME_UNKNOWN", "there is no such repository")
    }

    /// 400: not a valid tag.
    pub fn tag_invalid(error: &task_proto::ids::InvalidId) -> Self {
        Self::new(StatusCode::BAD_REQUEST, "TAG_INVALID", error.to_string())
    }

    /// 400: not a digest, or not the digest of the content.
    pub fn digest_invalid(message: impl Into<String>) -> Self {
        Self::new(StatusCode::BAD_REQUEST, "DIGEST_INVALID", message)
    }

    /// 404: no such blob in the repository.
    pub fn blob_unknown() -> Self {
        Self::new(StatusCode::NOT_FOUND, "BLOB_UNKNOWN", "the repository has no such blob")
    }

    /// 400: the description of a chunk is invalid.
    pub fn upload_invalid(message: impl Into<String>) -> Self {
        Self::new(StatusCode::BAD_REQUEST, "BLOB_UPLOAD_INVALID", message)
    }

    /// 404: no such upload.
    pub fn upload_unknown() -> Self {
        Self::new(
            StatusCode::NOT_FOUND,
            "BLOB_UPLOAD_UNKNOWN",
            BlobError::UploadUnknown.to_string(),
        )
    }

    /// 400: not the announced number of bytes.
    pub fn size_invalid(message: impl Into<String>) -> Self {
        Self::new(StatusCode::BAD_REQUEST, "SIZE_INVALID", message)
    }

    /// 413: more bytes than are accepted.
    pub fn too_large(message: impl Into<String>) -> Self {
        Self::new(StatusCode::PAYLOAD_TOO_LARGE, "SIZE_INVALID", message)
    }

    /// 416: the range is outside the content.
    pub fn range_invalid(message: impl Into<String>) -> Self {
        Self::new(StatusCode::RANGE_NOT_SATISFIABLE, "RANGE_INVALID", message)
    }

    /// 404: no such manifest in the repository.
    pub fn manifest_unknown() -> Self {
        Self::new(StatusCode::NOT_FOUND, "MANIFEST_UNKNOWN", "the repository has no such manifest")
    }

    /// 400: an invalid manifest, with the reason.
    pub fn manifest_invalid(message: impl Into<String>) -> Self {
        Self::new(StatusCode::BAD_REQUEST, "MANIFEST_INVALID", message)
    }

    /// 400: a manifest with parts that are not in the repository.
    pub fn parts_unknown(parts: &[Digest]) -> Self {
        let message = "the manifest needs a blob that is not in the repository";
        let messages =
            parts.iter().map(|part| (message.to_owned(), json!({ "digest": part }))).collect();
        Self {
            status: StatusCode::BAD_REQUEST,
            code: "MANIFEST_BLOB_UNKNOWN",
            messages,
            allow: None,
            retry_after_s: None,
        }
    }

    /// 400: an invalid query. The specification has no code for this.
    pub fn query_invalid(message: &'static str) -> Self {
        Self::new(StatusCode::BAD_REQUEST, "UNSUPPORTED", message)
    }

    pub(super) fn internal(error: &(dyn std::error::Error + 'static)) -> Self {
        tracing::error!(error, "a registry request failed");
        Self::new(
            StatusCode::INTERNAL_SERVER_ERROR,
            "UNKNOWN",
            "internal error; see the server's log",
        )
    }
}

impl From<StoreError> for OciError {
    fn from(error: StoreError) -> Self {
        match error {
            StoreError::RightsEnded => {
                Self::new(StatusCode::UNAUTHORIZED, "UNAUTHORIZED", error.to_string())
            }
            _ => error.fault().map_or_else(|| Self::internal(&error), Self::from),
        }
    }
}

impl From<Fault> for OciError {
    fn from(fault: Fault) -> Self {
        let ApiError { status, message, retry_after_s, .. } = fault.into();
        let (code, retry_after_s) = match fault {
            Fault::Corrupt => (CORRUPT, Some(retry_after_s)),
            Fault::Unreachable | Fault::Busy => (UNAVAILABLE, Some(retry_after_s)),
            Fault::Full => ("DENIED", None),
        };
        Self { retry_after_s, ..Self::new(status, code, message) }
    }
}

impl From<RetryLater> for OciError {
    fn from(retry: RetryLater) -> Self {
        let error = Self::new(StatusCode::TOO_MANY_REQUESTS, "TOOMANYREQUESTS", retry.to_string());
        Self { retry_after_s: Some(retry.retry_after_s), ..error }
    }
}

impl From<BlobError> for OciError {
    fn from(error: BlobError) -> Self {
        let message = error.to_string();
        match error {
            BlobError::UploadUnknown => Self::upload_unknown(),
            BlobError::UploadBusy => {
                Self::new(StatusCode::CONFLICT, "BLOB_UPLOAD_INVALID", message)
            }
            BlobError::TooManyUploads { .. } => {
                Self::new(StatusCode::TOO_MANY_REQUESTS, "TOOMANYREQUESTS", message)
            }
            BlobError::OutOfOrder { .. } => {
                Self::new(StatusCode::RANGE_NOT_SATISFIABLE, "BLOB_UPLOAD_INVALID", message)
            }
            BlobError::TooLarge { .. } => Self::too_large(message),
            BlobError::RobotQuotaExceeded { .. } => {
                let error = Self::new(StatusCode::TOO_MANY_REQUESTS, "TOOMANYREQUESTS", message);
                Self { retry_after_s: Some(COLLECTION_S), ..error }
            }
            BlobError::WrongDigest { .. } => Self::digest_invalid(message),
            BlobError::Interrupted(_) => {
                Self::new(StatusCode::REQUEST_TIMEOUT, "BLOB_UPLOAD_INVALID", message)
            }
            BlobError::DiskFull | BlobError::DiskReserved { .. } => {
                Self::new(StatusCode::INSUFFICIENT_STORAGE, "DENIED", message)
            }
            _ if error.is_store_unavailable() => {
                tracing::warn!(error = &error as &dyn std::error::Error, "blobs.store failed");
                let answer = Self::new(StatusCode::SERVICE_UNAVAILABLE, UNAVAILABLE, message);
                Self { retry_after_s: Some(STORE_RETRY_S), ..answer }
            }
            BlobError::Database(error) => error.into(),
            BlobError::Disk { .. }
            | BlobError::CommonStore { .. }
            | BlobError::OtherStore
            | BlobError::Fetch(_)
            | BlobError::NotMoved { .. } => Self::internal(&error),
        }
    }
}

/// For registry operations that the rest of the API calls.
impl From<OciError> for ApiError {
    fn from(error: OciError) -> Self {
        let code = match error.status {
            StatusCode::CONFLICT => "version_taken",
            StatusCode::PAYLOAD_TOO_LARGE => "too_large",
            StatusCode::INSUFFICIENT_STORAGE => "disk_full",
            StatusCode::TOO_MANY_REQUESTS => "too_many_requests",
            StatusCode::CONFLICT if error.code == "DENIED" => "package_in_use",
            StatusCode::SERVICE_UNAVAILABLE if error.code == CORRUPT => DATABASE_CORRUPT,
            StatusCode::SERVICE_UNAVAILABLE => "unavailable",
            StatusCode::INTERNAL_SERVER_ERROR => "internal",
            _ => "invalid_request",
        };
        let message =
            error.messages.into_iter().next().map_or_else(String::new, |(message, _)| message);
        Self::new(error.status, code, message)
    }
}

impl IntoResponse for OciError {
    fn into_response(self) -> Response {
        let errors = self.messages.into_iter().map(|(message, detail)| match detail {
            Value::Null => json!({ "code": self.code, "message": message }),
            detail => json!({ "code": self.code, "message": message, "detail": detail }),
        });
        let body = json!({ "errors": errors.collect::<Vec<_>>() });
        let mut response = (self.status, Json(body)).into_response();
        if self.status == StatusCode::UNAUTHORIZED {
            let challenge = HeaderValue::from_static("Basic realm=\"taskd\", charset=\"UTF-8\"");
            response.headers_mut().insert(WWW_AUTHENTICATE, challenge);
        }
        if let Some(allow) = self.allow {
            response.headers_mut().insert(ALLOW, HeaderValue::from_static(allow));
        }
        if let Some(seconds) = self.retry_after_s {
            response.headers_mut().insert(RETRY_AFTER, HeaderValue::from(seconds));
        }
        response
    }
}

impl<T: openapi::Answer> openapi::Answer for Result<T, OciError> {
    fn describe(draft: &mut Draft) {
        T::describe(draft);
    }
}
