//! The robot's gate: a program of the robot's owner that is asked before a task is started, stopped
//! or switched, and may say not now. Exit code 0 is yes, every other is no, and the first lines it
//! wrote are why. It is run with a time limit, its output is bounded, and nothing of it is left
//! afterwards. When it is asked, and what its answer means, is the plan's to say.

use std::collections::BTreeMap;
use std::io::{self, PipeReader, Read as _};
use std::path::{Path, PathBuf};
use std::time::Duration;

use task_proto::report::{Failure, FailureCode};
use task_proto::{RobotId, TaskName};

use crate::config::{GateConfig, GateDefault};
use crate::process::containment::{Containment, ContainmentError, KillOnDrop, RUN_DIR_VARIABLE};
use crate::process::program::{self, ExitStatus};
use crate::task::ledger::{GateQuestion, GateStep};

/// How much of what it writes is read as its reason.
const MAX_REASON_BYTES: u64 = 1024;
/// How many lines of that.
const MAX_REASON_LINES: usize = 3;
/// How long its processes may take to be gone once they are killed.
const KILL_TIMEOUT: Duration = Duration::from_secs(10);
/// How long the rest of the output may take then.
const DRAIN_TIMEOUT: Duration = Duration::from_secs(2);

/// The program, and what it is run with.
#[derive(Debug, Clone)]
pub struct Gate {
    config: GateConfig,
    robot: RobotId,
    directory: PathBuf,
}

/// Why there is no answer.
#[derive(Debug, thiserror::Error)]
pub enum GateError {
    /// It could not be run.
    #[error("cannot run the gate {}", .program.display())]
    Run {
        /// The program.
        program: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// It did not answer.
    #[error("the gate {} did not answer within {} s", .program.display(), .timeout.as_secs())]
    Hung {
        /// The program.
        program: PathBuf,
        /// Its limit.
        timeout: Duration,
    },
    /// A signal ended it.
    #[error("the gate {} crashed: {status}", .program.display())]
    Crashed {
        /// The program.
        program: PathBuf,
        /// How it ended.
        status: ExitStatus,
    },
    /// Its processes could not be found or ended.
    #[error(transparent)]
    Containment(#[from] ContainmentError),
}

impl Gate {
    /// The gate of `robot`, which is run in `directory`.
    pub fn new(config: GateConfig, robot: RobotId, directory: &Path) -> Self {
        Self { config, robot, directory: directory.to_owned() }
    }

    /// Asks it, run with `environment`. A failure is the reason of a no; what it is when there is
    /// no answer is a setting.
    pub async fn ask(
        &self,
        task: &TaskName,
        question: &GateQuestion,
        environment: &BTreeMap<String, String>,
    ) -> Result<(), Failure> {
        let error = match self.run(task, question, environment).await {
            Ok(answer) => {
                return answer.map_err(|reason| Failure::new(FailureCode::GATE_REFUSED, reason));
            }
            Err(error) => error,
        };
        let text = crate::system::error_chain::chain(&error);
        match self.config.default {
            GateDefault::Allow => {
                tracing::warn!(%task, "{text}: by the robot's setting that means yes");
                Ok(())
            }
            GateDefault::Deny => Err(Failure::new(FailureCode::GATE_FAILED, text)),
        }
    }

    async fn run(
        &self,
        task: &TaskName,
        question: &GateQuestion,
        environment: &BTreeMap<String, String>,
    ) -> Result<Result<(), String>, GateError> {
        let program = || PathBuf::from(self.config.command.first().cloned().unwrap_or_default());
        let failed = |source| GateError::Run { program: program(), source };
        // The path need not exist: by it the gate's processes are found again.
        let mark = self.directory.join("gate").join(task.as_str());
        let processes = KillOnDrop::new(Containment::new(&mark, None, None));
        // An agent that was killed may have left one that hangs.
        processes.end(KILL_TIMEOUT).await?;
        let (reader, writer) = io::pipe().map_err(failed)?;
        let mut environment = environment.clone();
        environment.extend(self.asked(task, question, &mark));
        let mut child =
            program::spawn_gate(&self.config.command, &self.directory, &environment, writer)
                .map_err(failed)?;
        let reading = tokio::task::spawn_blocking(move || reason(reader));
        let ended = tokio::time::timeout(self.config.timeout, child.wait()).await;
        // The output ends when the last process that could write any has.
        processes.end(KILL_TIMEOUT).await?;
        let status = match ended {
            Ok(status) => ExitStatus::from(status.map_err(failed)?),
            Err(_) => {
                return Err(GateError::Hung { program: program(), timeout: self.config.timeout });
            }
        };
        let reason = match tokio::time::timeout(DRAIN_TIMEOUT, reading).await {
            Ok(Ok(reason)) => reason,
            // A process of it got away and still writes, or nothing could be read.
            _ => String::new(),
        };
        match status {
            ExitStatus::Code(0) => Ok(Ok(())),
            ExitStatus::Code(code) if reason.is_empty() => {
                Ok(Err(format!("the gate said no and gave no reason (exit code {code})")))
            }
            ExitStatus::Code(_) => Ok(Err(reason)),
            ExitStatus::Signal(_) => Err(GateError::Crashed { program: program(), status }),
        }
    }

    /// The question, as variables.
    fn asked(
        &self,
        task: &TaskName,
        question: &GateQuestion,
        mark: &Path,
    ) -> [(String, String); 7] {
        [
            ("TASKD_GATE_STEP", question.step.as_str().to_owned()),
            ("TASKD_TASK", task.to_string()),
            ("TASKD_VERSION", question.version.to_string()),
            ("TASKD_DEPLOYMENT", question.deployment.to_string()),
            ("TASKD_RUN", question.run.to_string()),
            ("TASKD_ROBOT", self.robot.to_string()),
            (RUN_DIR_VARIABLE, mark.display().to_string()),
        ]
        .map(|(name, value)| (name.to_owned(), value))
    }
}

impl GateStep {
    /// The step as the gate reads it.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Start => "start",
            Self::Stop => "stop",
            Self::Switch => "switch",
        }
    }
}

/// The first lines of what a gate writes; the rest is read, so that it need not wait, and dropped.
fn reason(mut output: PipeReader) -> String {
    let mut bytes = Vec::new();
    // What can't be read is no reason; the exit code is the answer.
    let _ = output.by_ref().take(MAX_REASON_BYTES).read_to_end(&mut bytes);
    let _ = io::copy(&mut output, &mut io::sink());
    let text = String::from_utf8_lossy(&bytes);
    let lines = text.lines().map(str::trim).filter(|line| !line.is_empty()).take(MAX_REASON_LINES);
    lines.collect::<Vec<_>>().join("\n")
}
