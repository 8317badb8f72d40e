//! Uploads output files of an ended run to the server: finds them, pushes each as a blob, then
//! registers them with the run. The registry dictates the order: an output is listed only after all
//! its files are stored. A repetition after a crash is harmless and sends only the files that the
//! server lacks. This module decides nothing about the run.

mod find;
mod push;

use std::io;
use std::path::PathBuf;
use std::time::Duration;

use task_proto::messages::report::Progress;
use task_proto::packages::output::{MAX_FILES, OutputSet};
use task_proto::{DeploymentId, RobotId, TaskName, Version};
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

use crate::system::task_user::{self, TaskUser};

pub use push::Registry;

/// The files to upload, and the run that they belong to.
#[derive(Debug, Clone)]
pub struct OutputSpec {
    pub robot_id: RobotId,
    pub task: TaskName,
    /// Version of the task.
    pub version: Version,
    /// The deployment that ordered the run.
    pub deployment: DeploymentId,
    /// Number of the run.
    pub run: u64,
    /// Working directory of the task.
    pub directory: PathBuf,
    /// Account of the task. The files are read with its rights; `None` is the agent's own
    /// account.
    pub user: Option<TaskUser>,
    /// The patterns of `outputs.paths`.
    pub patterns: Vec<String>,
    /// File that records uploads in progress, so that the next attempt resumes them.
    pub notes: PathBuf,
    /// Most bytes to upload.
    pub max_bytes: u64,
}

/// Reasons why files were not uploaded.
#[derive(Debug, thiserror::Error)]
pub enum OutputError {
    /// A pattern is invalid.
    #[error("outputs.paths: {pattern:?} is not a pattern: {reason}")]
    Pattern { pattern: String, reason: &'static str },
    /// The files exceed a limit.
    #[error("outputs.paths: {0}")]
    TooMuch(String),
    /// The agent can't switch to the task's user.
    #[error("cannot read the outputs as the user of the task")]
    User(#[source] io::Error),
    /// A file can't be read.
    #[error("cannot read {path}")]
    Read {
        path: PathBuf,
        /// The operating system's error.
        source: io::Error,
    },
    /// The record of uploads in progress can't be written.
    #[error("cannot write {path}")]
    Note {
        path: PathBuf,
        /// The operating system's error.
        source: io::Error,
    },
    /// The connection failed or broke.
    #[error("the server can't be reached")]
    Unreachable(#[source] reqwest::Error),
    /// The answer does not come from a registry, but from a captive portal or a proxy.
    #[error("another program answers at the server's address: {status} {text}")]
    NotTheServer {
        status: u16,
        /// Text of the answer.
        text: String,
    },
    /// The server is overloaded, restarting or broken.
    #[error("the server answered {status} {text}")]
    Busy {
        status: u16,
        /// Text of the answer.
        text: String,
        /// Wait that the server requests.
        retry_after: Option<Duration>,
    },
    /// The server refused the request.
    #[error("the server refuses {what}: {status} {text}")]
    Refused {
        /// Subject of the request.
        what: String,
        status: u16,
        /// The registry's error code, if the answer has one.
        code: String,
        /// Text of the answer.
        text: String,
    },
    /// The server repeatedly receives other bytes than we send.
    #[error("the server receives other bytes than we send: {text}")]
    Corrupted {
        /// Text of the answer.
        text: String,
    },
    /// The upload was cancelled.
    #[error("the upload was cancelled")]
    Cancelled,
}

impl OutputError {
    /// The shortest wait before the next attempt; `None` if another attempt can't help.
    pub fn retry_after(&self) -> Option<Duration> {
        match self {
            Self::Unreachable(_) | Self::Note { .. } | Self::Cancelled => Some(Duration::ZERO),
            // An unreadable file may become readable once its file system is back.
            Self::Read { .. } | Self::User(_) | Self::Corrupted { .. } => {
                Some(Duration::from_secs(30))
            }
            Self::Busy { retry_after, .. } => Some(retry_after.unwrap_or_default()),
            // The server knows a robot again after a new enrollment or a new token.
            Self::NotTheServer { .. } | Self::Refused { status: 401, .. } => {
                Some(Duration::from_secs(30))
            }
            Self::Pattern { .. } | Self::TooMuch(_) | Self::Refused { .. } => None,
        }
    }
}

/// Uploads the files and returns their number. Zero is not an error: the run may have produced no
/// output.
pub async fn upload(
    registry: &Registry,
    spec: &OutputSpec,
    progress: &watch::Sender<Progress>,
    cancel: &CancellationToken,
) -> Result<usize, OutputError> {
    let work = async {
        let found = spec.clone();
        let searched = task_user::do_as(spec.user.as_ref(), move || {
            find::files(&found.directory, &found.patterns, found.max_bytes)
        });
        let files = searched.await.map_err(OutputError::User)??;
        if files.is_empty() {
            return Ok(0);
        }
        let output = OutputSet {
            robot_id: spec.robot_id.clone(),
            task: spec.task.clone(),
            version: spec.version.clone(),
            deployment: spec.deployment.clone(),
            run: spec.run,
            files,
        };
        push::push(registry, spec, &output, progress).await?;
        Ok(output.files.len())
    };
    tokio::select! {
        done = work => done,
        () = cancel.cancelled() => Err(OutputError::Cancelled),
    }
}

/// Error for a file beyond [`MAX_FILES`].
fn too_many_files() -> OutputError {
    OutputError::TooMuch(format!("more than {MAX_FILES} files match"))
}
