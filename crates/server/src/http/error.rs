//! The API's one error shape: a status, a stable code for programs and a sentence for people.
//! Internal causes are logged and never sent to callers.

use std::io;

use axum::Json;
use axum::response::{IntoResponse, Response};
use http::{HeaderValue, StatusCode, header};
use serde_json::json;
use task_proto::api;

use crate::blobs::BlobError;
use crate::domain::person::Person;
use crate::orders::actions::ActionError;
use crate::orders::report_writer::ReportError;
use crate::store::{Fault, StoreError};

/// The code of [`ApiError::robot_revoked`].
pub(super) const ROBOT_REVOKED: &str = "robot_revoked";

/// The code for a corrupt database.
pub(super) const DATABASE_CORRUPT: &str = "database_corrupt";

/// An error answer of the API.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ApiError {
    pub status: StatusCode,
    pub code: &'static str,
    /// The error message, which names the caller's own key.
    pub message: String,
    /// Seconds until a retry is useful, for statuses that allow one.
    pub retry_after_s: u64,
}

/// Default time until a retry, in seconds.
const RETRY_AFTER_S: u64 = 5;

impl ApiError {
    /// An error of any kind.
    pub fn new(status: StatusCode, code: &'static str, message: impl Into<String>) -> Self {
        Self { status, code, message: message.into(), retry_after_s: RETRY_AFTER_S }
    }

    /// 400: the request can't be understood.
    pub fn invalid(message: impl Into<String>) -> Self {
        Self::new(StatusCode::BAD_REQUEST, "invalid_request", message)
    }

    /// 401: the caller is not authenticated.
    pub fn unauthorized(message: impl Into<String>) -> Self {
        Self::new(StatusCode::UNAUTHORIZED, "unauthorized", message)
    }

    /// 401: the robot was revoked.
    pub fn robot_revoked() -> Self {
        let message =
            "this robot was revoked: it comes back only by an enrolment with a token made for it";
        Self::new(StatusCode::UNAUTHORIZED, ROBOT_REVOKED, message)
    }

    /// 403: the robot waits to be approved.
    pub fn awaits_approval() -> Self {
        let message =
            "this robot waits to be approved: an administrator does that with taskd robot approve";
        Self::new(StatusCode::FORBIDDEN, api::AWAITS_APPROVAL, message)
    }

    /// 403: the caller lacks the permission.
    pub fn forbidden(message: impl Into<String>) -> Self {
        Self::new(StatusCode::FORBIDDEN, "forbidden", message)
    }

    /// 403: the resource is outside the person's scope.
    pub fn out_of_scope(what: impl std::fmt::Display, by: &Person) -> Self {
        let message =
            format!("{what} is outside of {}'s scope {:?}", by.name, by.scope.to_string());
        Self::new(StatusCode::FORBIDDEN, "out_of_scope", message)
    }

    /// 404: the resource does not exist.
    pub fn not_found(message: impl Into<String>) -> Self {
        Self::new(StatusCode::NOT_FOUND, "not_found", message)
    }

    /// 409: the request conflicts with the current state.
    pub fn conflict(code: &'static str, message: impl Into<String>) -> Self {
        Self::new(StatusCode::CONFLICT, code, message)
    }

    /// 429: the caller exceeds a limit.
    pub fn too_many(message: impl Into<String>) -> Self {
        Self::new(StatusCode::TOO_MANY_REQUESTS, "too_many_requests", message)
    }

    /// 503: temporarily unavailable; the caller is expected to try again.
    pub fn unavailable(message: impl Into<String>) -> Self {
        Self::new(StatusCode::SERVICE_UNAVAILABLE, "unavailable", message)
    }

    /// 500: an internal failure, logged here with its causes.
    pub fn internal(error: &(dyn std::error::Error + 'static)) -> Self {
        tracing::error!(error, "a request failed");
        Self::new(
            StatusCode::INTERNAL_SERVER_ERROR,
            "internal",
            "the server failed; its log says why",
        )
    }

    /// 507: the server's disk is full.
    pub fn disk_full() -> Self {
        Self::new(StatusCode::INSUFFICIENT_STORAGE, "disk_full", "the server's disk is full")
    }

    /// The server's own disk returned an error; `source` tells its kind.
    pub fn disk(error: &(dyn std::error::Error + 'static), source: &io::Error) -> Self {
        match source.kind() {
            io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => Self::disk_full(),
            _ => Self::internal(error),
        }
    }

    /// The answer in the shape of the OCI distribution specification, for everything below `/v2`.
    pub fn into_oci_response(self) -> Response {
        let code = match self.status {
            StatusCode::UNAUTHORIZED => "UNAUTHORIZED",
            StatusCode::FORBIDDEN => "DENIED",
            StatusCode::TOO_MANY_REQUESTS => "TOOMANYREQUESTS",
            StatusCode::NOT_FOUND => "NAME_UNKNOWN",
            StatusCode::INSUFFICIENT_STORAGE => "DENIED",
            _ if self.code == DATABASE_CORRUPT => "DATABASE_CORRUPT",
            StatusCode::SERVICE_UNAVAILABLE => "UNAVAILABLE",
            _ => "UNSUPPORTED",
        };
        let body = json!({ "errors": [{ "code": code, "message": self.message }] });
        // Registry clients send the password only after a Basic challenge. A page must not see a
        // challenge, or the browser would ask its user for a password.
        self.with_headers("Basic realm=\"taskd\"", Json(body))
    }

    fn with_headers(&self, challenge: &'static str, body: impl IntoResponse) -> Response {
        let mut response = (self.status, body).into_response();
        if self.status == StatusCode::UNAUTHORIZED {
            response
                .headers_mut()
                .insert(header::WWW_AUTHENTICATE, HeaderValue::from_static(challenge));
        }
        if matches!(self.status, StatusCode::TOO_MANY_REQUESTS | StatusCode::SERVICE_UNAVAILABLE) {
            response
                .headers_mut()
                .insert(header::RETRY_AFTER, HeaderValue::from(self.retry_after_s));
        }
        response
    }
}

impl IntoResponse for ApiError {
    fn into_response(self) -> Response {
        let error = api::ApiError { code: self.code.to_owned(), message: self.message.clone() };
        self.with_headers("Bearer realm=\"taskd\"", Json(api::ErrorBody { error }))
    }
}

impl From<BlobError> for ApiError {
    fn from(error: BlobError) -> Self {
        match error {
            BlobError::DiskFull | BlobError::DiskReserved { .. } => {
                Self { message: error.to_string(), ..Self::disk_full() }
            }
            error => Self::internal(&error),
        }
    }
}

/// A fault is logged once where it is noticed, not for each request that it fails.
impl From<Fault> for ApiError {
    fn from(fault: Fault) -> Self {
        match fault {
            Fault::Corrupt => {
                let message = "the server's database is corrupt, so nothing is changed until it is mended; taskd doctor says more";
                Self::new(StatusCode::SERVICE_UNAVAILABLE, DATABASE_CORRUPT, message)
            }
            Fault::Full => Self::disk_full(),
            Fault::Away => Self::unavailable("the server's database does not answer; try again"),
            Fault::Busy => Self::unavailable("the server's database is busy; try again"),
        }
    }
}

impl From<StoreError> for ApiError {
    fn from(error: StoreError) -> Self {
        match error {
            StoreError::RightsEnded => Self::unauthorized(error.to_string()),
            StoreError::TooManyActs { seconds, .. } => {
                Self { retry_after_s: seconds, ..Self::too_many(error.to_string()) }
            }
            _ => error.fault().map_or_else(|| Self::internal(&error), Self::from),
        }
    }
}

impl From<ActionError> for ApiError {
    fn from(error: ActionError) -> Self {
        let status = match error {
            ActionError::Store(error) => return error.into(),
            ActionError::PasswordFailed => return Self::internal(&error),
            ActionError::Invalid { .. } | ActionError::InvalidIdempotencyKey => {
                StatusCode::BAD_REQUEST
            }
            ActionError::TokenRefused | ActionError::SignInRefused => StatusCode::UNAUTHORIZED,
            ActionError::TokenForOther { .. }
            | ActionError::OutOfScope { .. }
            | ActionError::NotPermitted(_)
            | ActionError::NoRole { .. }
            | ActionError::NoName => StatusCode::FORBIDDEN,
            ActionError::TooManyEnrolments { seconds } => {
                return Self { retry_after_s: seconds, ..Self::too_many(error.to_string()) };
            }
            ActionError::SignInBlocked { .. }
            | ActionError::TooManySignIns
            | ActionError::TooManyPending(_) => StatusCode::TOO_MANY_REQUESTS,
            ActionError::RobotNotFound(_)
            | ActionError::DeploymentNotFound(_)
            | ActionError::PackageNotFound(..)
            | ActionError::UserNotFound(_)
            | ActionError::TokenNotFound(_)
            | ActionError::EnrolmentNotFound(_) => StatusCode::NOT_FOUND,
            ActionError::UnknownRobots(_) => StatusCode::NOT_FOUND,
            ActionError::TooLargeForInline { .. } => StatusCode::UNPROCESSABLE_ENTITY,
            ActionError::NoRobotsMatch(_)
            | ActionError::IdempotencyKeyReused(_)
            | ActionError::MacKnown { .. }
            | ActionError::NameTaken(_)
            | ActionError::EnrolledAnew(_)
            | ActionError::NotPending(_)
            | ActionError::DeploymentCancelled(_)
            | ActionError::NotPaused { .. }
            | ActionError::NothingToCancel(_)
            | ActionError::NothingToRetry(_)
            | ActionError::NothingToRollBack(_)
            | ActionError::UserExists(_)
            | ActionError::OfProvider(_)
            | ActionError::LastAdministrator(_)
            | ActionError::Diverged(_) => StatusCode::CONFLICT,
        };
        let retry_after_s = match &error {
            ActionError::SignInBlocked { seconds } => *seconds,
            _ => RETRY_AFTER_S,
        };
        Self { retry_after_s, ..Self::new(status, error.code(), error.to_string()) }
    }
}

impl From<ReportError> for ApiError {
    fn from(error: ReportError) -> Self {
        match error {
            ReportError::RobotNotFound(_) => Self::not_found(error.to_string()),
            ReportError::TokenEnded(_) => Self::unauthorized(error.to_string()),
            ReportError::NotStored(Some(fault)) => fault.into(),
            ReportError::Busy | ReportError::NotStored(None) => {
                Self::unavailable(error.to_string())
            }
        }
    }
}
