//! Step outcomes for the plan: each module's error as a failure code and text, and whether to
//! retry.

use std::error::Error;
use std::path::Path;

use task_proto::error_chain::chain;
use task_proto::messages::report::{Failure, FailureCode};
use task_proto::time::millis;

use crate::install::builder::BuildError;
use crate::install::fetch::FetchError;
use crate::system::disk;
use crate::task::plan::{Done, StepFailure};
use crate::telemetry::outputs::OutputError;

pub(super) fn pull_outcome(outcome: Result<(), FetchError>) -> Result<Done, StepFailure> {
    match outcome {
        Ok(()) => Ok(Done::Complete),
        Err(error) => match error.retry_later() {
            Some(wait) => Ok(Done::RetryLater { at_least_ms: millis(wait) }),
            None => Err(fetch_failure(error)),
        },
    }
}

/// Does disk work in a thread that may block; a failure is retried.
pub(super) async fn blocking_io(
    work: impl FnOnce() -> std::io::Result<()> + Send + 'static,
) -> Result<(), StepFailure> {
    let done = tokio::task::spawn_blocking(work).await.map_err(std::io::Error::other);
    done.flatten().map_err(|error| retryable_failure(FailureCode::IO_ERROR, &error, 0))
}

pub(super) fn fetch_failure(error: FetchError) -> StepFailure {
    // A cancelled pull is not a failure: the driver discards its outcome.
    let code = error.code().unwrap_or(FailureCode::INTERRUPTED);
    if error.is_retryable() || matches!(error, FetchError::Cancelled) {
        let least_ms = error.retry_after().map_or(0, millis);
        return retryable_failure(code, &error, least_ms);
    }
    permanent_failure(code, &error)
}

/// The failure of a build. On a full disk, the one that holds `root`, a failed build says little
/// about the package, so the build is retried.
pub(super) fn build_failure(error: BuildError, root: &Path) -> StepFailure {
    let Some(code) = error.code() else {
        return retryable_failure(FailureCode::BUILD_FAILED, &error, 0);
    };
    match disk::space(root) {
        Ok(room) if room.is_full() => {
            let text = format!("{} of {} bytes are free; {}", room.free, room.total, chain(&error));
            let least_ms = millis(disk::FULL_PAUSE);
            StepFailure {
                failure: Failure::new(FailureCode::DISK_FULL, text),
                retry_after_ms: Some(least_ms),
            }
        }
        _ => permanent_failure(code, &error),
    }
}

pub(super) fn outputs_code(error: &OutputError) -> FailureCode {
    match error {
        OutputError::Unreachable(_)
        | OutputError::NotTheServer { .. }
        | OutputError::Busy { .. } => FailureCode::SERVER_UNREACHABLE,
        OutputError::Corrupted { .. } => FailureCode::DIGEST_MISMATCH,
        OutputError::Read { .. } | OutputError::User(_) | OutputError::Note { .. } => {
            FailureCode::IO_ERROR
        }
        OutputError::Cancelled => FailureCode::INTERRUPTED,
        OutputError::Pattern { .. } | OutputError::TooMuch(_) | OutputError::Refused { .. } => {
            FailureCode::OUTPUTS_LOST
        }
    }
}

pub(super) fn permanent_failure(code: FailureCode, error: &dyn Error) -> StepFailure {
    StepFailure { failure: Failure::new(code, chain(error)), retry_after_ms: None }
}

pub(super) fn retryable_failure(
    code: FailureCode,
    error: &dyn Error,
    least_ms: u64,
) -> StepFailure {
    StepFailure { failure: Failure::new(code, chain(error)), retry_after_ms: Some(least_ms) }
}
