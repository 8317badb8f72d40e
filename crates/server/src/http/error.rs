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
use crate::orders::actions::{DeploymentError, OrderError, PersonError, RobotError};
use crate::orders::desired_states::DesiredStateError;
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
        let message = "this robot was revoked: enroll it again with a token made for it";
        Self::new(StatusCode::UNAUTHORIZED, ROBOT_REVOKED, message)
    }

    /// 403: the robot waits to be approved.
    pub fn awaits_approval() -> Self {
        let message =
            "this robot waits for approval: an administrator approves it with taskd robot approve";
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
            "internal error; see the server's log",
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
            error if error.is_store_unavailable() => {
                tracing::warn!(error = &error as &dyn std::error::Error, "blobs.store failed");
                Self::unavailable(error.to_string())
            }
            BlobError::Database(error) => error.into(),
            error => Self::internal(&error),
        }
    }
}

/// A fault is logged once where it is noticed, not for each request that it fails.
impl From<Fault> for ApiError {
    fn from(fault: Fault) -> Self {
        match fault {
            Fault::Corrupt => {
                let message = "the server's database is corrupt and accepts no changes until it is repaired; run taskd doctor";
                Self::new(StatusCode::SERVICE_UNAVAILABLE, DATABASE_CORRUPT, message)
            }
            Fault::Full => Self::disk_full(),
            Fault::Unreachable => {
                Self::unavailable("the server's database does not answer; try again")
            }
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

impl From<OrderError> for ApiError {
    fn from(error: OrderError) -> Self {
        let (status, code) = match error {
            OrderError::Store(error) => return error.into(),
            OrderError::Invalid { .. } => return Self::invalid(error.to_string()),
            OrderError::NoRobotsMatch(_) => (StatusCode::CONFLICT, "no_robots_match"),
            OrderError::UnknownRobots(_) => (StatusCode::NOT_FOUND, "unknown_robots"),
            OrderError::OutOfScope { .. } => (StatusCode::FORBIDDEN, "out_of_scope"),
            OrderError::IdempotencyKeyReused(_) => (StatusCode::CONFLICT, "idempotency_key_reused"),
        };
        Self::new(status, code, error.to_string())
    }
}

impl From<RobotError> for ApiError {
    fn from(error: RobotError) -> Self {
        let message = error.to_string();
        let code = match error {
            RobotError::Order(error) => return error.into(),
            RobotError::NotFound(_) | RobotError::EnrollmentTokenNotFound(_) => {
                return Self::not_found(message);
            }
            RobotError::TokenRefused => return Self::unauthorized(message),
            RobotError::TokenForOther { .. } => {
                return Self::new(StatusCode::FORBIDDEN, "token_for_other_robot", message);
            }
            RobotError::TooManyPending(_) => return Self::too_many(message),
            RobotError::TooManyEnrollments { seconds } => {
                return Self { retry_after_s: seconds, ..Self::too_many(message) };
            }
            RobotError::NameTaken(_) => "name_taken",
            RobotError::MacKnown { .. } => "mac_known",
            RobotError::EnrolledAgain(_) => "enrolled_anew",
            RobotError::NotPending(_) => "not_pending",
        };
        Self::conflict(code, message)
    }
}

impl From<DeploymentError> for ApiError {
    fn from(error: DeploymentError) -> Self {
        let message = error.to_string();
        let code = match error {
            DeploymentError::Order(error) => return error.into(),
            DeploymentError::NotFound(_) => return Self::not_found(message),
            DeploymentError::PackageNotFound(..) => {
                return Self::new(StatusCode::NOT_FOUND, "package_not_found", message);
            }
            DeploymentError::TooLargeForInline { .. } => {
                return Self::new(StatusCode::UNPROCESSABLE_ENTITY, "package_too_large", message);
            }
            DeploymentError::Cancelled(_) => "deployment_cancelled",
            DeploymentError::NothingToCancel(_) => "nothing_to_cancel",
            DeploymentError::NotPaused { .. } => "not_paused",
            DeploymentError::NothingToRetry(_) => "nothing_to_retry",
            DeploymentError::NothingToRollBack(_) => "nothing_to_roll_back",
        };
        Self::conflict(code, message)
    }
}

impl From<PersonError> for ApiError {
    fn from(error: PersonError) -> Self {
        let message = error.to_string();
        let code = match error {
            PersonError::Order(error) => return error.into(),
            PersonError::PasswordFailed => return Self::internal(&error),
            PersonError::UserNotFound(_) | PersonError::TokenNotFound(_) => {
                return Self::not_found(message);
            }
            PersonError::SignInRefused => return Self::unauthorized(message),
            PersonError::NotPermitted(_) => return Self::forbidden(message),
            PersonError::NoRole { .. } => {
                return Self::new(StatusCode::FORBIDDEN, "no_role", message);
            }
            PersonError::NoName => return Self::new(StatusCode::FORBIDDEN, "no_name", message),
            PersonError::TooManySignIns => return Self::too_many(message),
            PersonError::SignInBlocked { seconds } => {
                return Self { retry_after_s: seconds, ..Self::too_many(message) };
            }
            PersonError::UserExists(_) => "user_exists",
            PersonError::ManagedByProvider(_) => "of_provider",
            PersonError::LastAdministrator(_) => "last_administrator",
        };
        Self::conflict(code, message)
    }
}

impl From<DesiredStateError> for ApiError {
    fn from(error: DesiredStateError) -> Self {
        match error {
            DesiredStateError::RobotNotFound(_) => Self::not_found(error.to_string()),
            DesiredStateError::Diverged(_) => Self::conflict("diverged", error.to_string()),
            DesiredStateError::Store(error) => error.into(),
        }
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
