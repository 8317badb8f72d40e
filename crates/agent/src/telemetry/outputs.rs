//! Brings files of an ended run to the server: finds them, pushes each as a blob, then says which
//! run they are of. The order of things is the registry's: nothing is listed before all of it is
//! there. Doing it again after a crash is harmless and sends only what the server lacks. It decides
//! nothing about the run.

mod find;
mod push;

use std::io;
use std::path::PathBuf;
use std::time::Duration;

use task_proto::output::{MAX_FILES, OutputSet};
use task_proto::report::Progress;
use task_proto::{DeploymentId, RobotId, TaskName, Version};
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

use crate::system::task_user::{self, TaskUser};

pub use push::Registry;

/// Which files to bring back, and of what.
#[derive(Debug, Clone)]
pub struct OutputOrder {
    /// The robot.
    pub robot_id: RobotId,
    /// The task.
    pub task: TaskName,
    /// Its version.
    pub version: Version,
    /// The order.
    pub deployment: DeploymentId,
    /// Which of its runs.
    pub run: u64,
    /// The directory the task ran in.
    pub directory: PathBuf,
    /// Whom it ran as; `None`: whoever the agent is. The files are read with its rights.
    pub user: Option<TaskUser>,
    /// The patterns of `outputs.paths`.
    pub patterns: Vec<String>,
    /// Where to note uploads under way, so that the next try goes on with them.
    pub notes: PathBuf,
    /// The most bytes that are brought back.
    pub max_bytes: u64,
}

/// Why files did not come back.
#[derive(Debug, thiserror::Error)]
pub enum OutputError {
    /// A pattern is none.
    #[error("outputs.paths: {pattern:?} is not a pattern: {reason}")]
    Pattern {
        /// The pattern.
        pattern: String,
        /// Why.
        reason: &'static str,
    },
    /// Beyond a limit.
    #[error("outputs.paths: {0}")]
    TooMuch(String),
    /// The files can't be looked at as the task's user.
    #[error("cannot take the rights of the user that tasks run as")]
    User(#[source] io::Error),
    /// A file can't be read.
    #[error("cannot read {path}")]
    Read {
        /// Which.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// The note of uploads under way can't be written.
    #[error("cannot write {path}")]
    Note {
        /// Which.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// No connection, or it broke.
    #[error("the server can't be reached")]
    Unreachable(#[source] reqwest::Error),
    /// Something answered that is no registry: a captive portal, a proxy.
    #[error("something else answers in the server's place: {status} {text}")]
    NotTheServer {
        /// The HTTP status.
        status: u16,
        /// What it said.
        text: String,
    },
    /// The server is overloaded, restarting or broken.
    #[error("the server answers {status} {text}")]
    Busy {
        /// The HTTP status.
        status: u16,
        /// What it said.
        text: String,
        /// When it wants to be asked again.
        retry_after: Option<Duration>,
    },
    /// It said no.
    #[error("the server refuses {what}: {status} {text}")]
    Refused {
        /// What was asked.
        what: String,
        /// The HTTP status.
        status: u16,
        /// The registry's code of the error, if it gave one.
        code: String,
        /// What it said.
        text: String,
    },
    /// The server keeps receiving other bytes than were sent.
    #[error("the server receives other bytes than are sent: {text}")]
    Garbled {
        /// What it said.
        text: String,
    },
    /// The order was taken back.
    #[error("it was interrupted")]
    Cancelled,
}

impl OutputError {
    /// Whether trying again may help, and how long to wait at least.
    pub fn retry_after(&self) -> Option<Duration> {
        match self {
            Self::Unreachable(_) | Self::Note { .. } | Self::Cancelled => Some(Duration::ZERO),
            // What can't be read now may be readable once a file system is back.
            Self::Read { .. } | Self::User(_) | Self::Garbled { .. } => {
                Some(Duration::from_secs(30))
            }
            Self::Busy { retry_after, .. } => Some(retry_after.unwrap_or_default()),
            // A robot that is enrolled anew, or replaces its token, is known again.
            Self::NotTheServer { .. } | Self::Refused { status: 401, .. } => {
                Some(Duration::from_secs(30))
            }
            Self::Pattern { .. } | Self::TooMuch(_) | Self::Refused { .. } => None,
        }
    }
}

/// Brings the files back; gives how many. None is no error: the run may have had nothing to say.
pub async fn bring_back(
    registry: &Registry,
    order: &OutputOrder,
    progress: &watch::Sender<Progress>,
    cancel: &CancellationToken,
) -> Result<usize, OutputError> {
    let work = async {
        let found = order.clone();
        let searched = task_user::do_as(order.user.as_ref(), move || {
            find::files(&found.directory, &found.patterns, found.max_bytes)
        });
        let files = searched.await.map_err(OutputError::User)??;
        if files.is_empty() {
            return Ok(0);
        }
        let output = OutputSet {
            robot_id: order.robot_id.clone(),
            task: order.task.clone(),
            version: order.version.clone(),
            deployment: order.deployment.clone(),
            run: order.run,
            files,
        };
        push::push(registry, order, &output, progress).await?;
        Ok(output.files.len())
    };
    tokio::select! {
        done = work => done,
        () = cancel.cancelled() => Err(OutputError::Cancelled),
    }
}

/// One more file than may be.
fn too_many() -> OutputError {
    OutputError::TooMuch(format!("more than {MAX_FILES} files match"))
}
