//! The robot's gate is a program of the robot's owner. The agent asks the gate before a task is
//! started, stopped or switched, and the gate may answer "not now". Exit code 0 allows the step,
//! every other code refuses it, and the first lines of output are the reason. The gate runs with a
//! time limit, its output is bounded, and none of its processes is left afterwards. The plan
//! decides when to ask and interprets the answer.

use std::collections::BTreeMap;
use std::io::{self, PipeReader, Read as _};
use std::path::{Path, PathBuf};
use std::time::Duration;

use task_proto::TaskName;
use task_proto::error_chain::chain;
use task_proto::messages::report::{Failure, FailureCode};

use crate::config::{GateConfig, GateDefault};
use crate::process::containment::{Containment, ContainmentError, KillOnDrop, RUN_DIR_VARIABLE};
use crate::process::program::{self, ExitStatus};
use crate::setup::environment::task_variables;
use crate::task::ledger::{GateQuestion, GateStep};

/// The maximum bytes of the gate's output that are read as its reason.
const MAX_REASON_BYTES: u64 = 1024;
/// The maximum lines of the reason.
const MAX_REASON_LINES: usize = 3;
/// Time limit for the gate's processes to disappear after they are killed.
const KILL_TIMEOUT: Duration = Duration::from_secs(10);
/// Time limit for the rest of the output after that.
const DRAIN_TIMEOUT: Duration = Duration::from_secs(2);

/// The gate program, with its environment.
#[derive(Debug, Clone)]
pub struct Gate {
    config: GateConfig,
    directory: PathBuf,
}

/// Why the gate gave no answer.
#[derive(Debug, thiserror::Error)]
pub enum GateError {
    /// The gate could not be run.
    #[error("cannot run the gate {}", .program.display())]
    Run {
        program: PathBuf,
        /// The operating system's error.
        source: io::Error,
    },
    /// The gate did not answer in time.
    #[error("the gate {} did not answer within {} s", .program.display(), .timeout.as_secs())]
    Hung { program: PathBuf, timeout: Duration },
    /// A signal ended the gate.
    #[error("the gate {} crashed: {status}", .program.display())]
    Crashed {
        program: PathBuf,
        /// The signal that ended the program.
        status: ExitStatus,
    },
    /// The gate's processes could not be found or ended.
    #[error(transparent)]
    Containment(#[from] ContainmentError),
}

impl Gate {
    /// The gate, run in `directory`.
    pub fn new(config: GateConfig, directory: &Path) -> Self {
        Self { config, directory: directory.to_owned() }
    }

    /// Asks the gate, run with `environment`. An error is the reason of the refusal. A setting
    /// decides how a missing answer counts.
    pub async fn query(
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
        let text = chain(&error);
        match self.config.default {
            GateDefault::Allow => {
                tracing::warn!(%task, "{text}: allowed by gate.default");
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
        // The path need not exist: it only marks the gate's processes, so that we find them again.
        let mark = self.directory.join("gate").join(task.as_str());
        let processes = KillOnDrop::new(Containment::new(&mark, None, None));
        // An agent that was killed may have left a hanging gate.
        processes.end(KILL_TIMEOUT).await?;
        let (reader, writer) = io::pipe().map_err(failed)?;
        let mut environment = environment.clone();
        environment.extend(question_environment(task, question, &mark));
        let mut child =
            program::spawn_gate(&self.config.command, &self.directory, &environment, writer)
                .map_err(failed)?;
        let reading = tokio::task::spawn_blocking(move || reason(reader));
        let ended = tokio::time::timeout(self.config.timeout, child.wait()).await;
        // The output ends when the last process that could write to it has ended.
        processes.end(KILL_TIMEOUT).await?;
        let status = match ended {
            Ok(status) => ExitStatus::from(status.map_err(failed)?),
            Err(_) => {
                return Err(GateError::Hung { program: program(), timeout: self.config.timeout });
            }
        };
        let reason = match tokio::time::timeout(DRAIN_TIMEOUT, reading).await {
            Ok(Ok(reason)) => reason,
            // A process of the gate escaped and still writes, or the output could not be read.
            _ => String::new(),
        };
        match status {
            ExitStatus::Code(0) => Ok(Ok(())),
            ExitStatus::Code(code) if reason.is_empty() => {
                Ok(Err(format!("the gate refused without a reason (exit code {code})")))
            }
            ExitStatus::Code(_) => Ok(Err(reason)),
            ExitStatus::Signal(_) => Err(GateError::Crashed { program: program(), status }),
        }
    }
}

/// The question, as environment variables.
fn question_environment(
    task: &TaskName,
    question: &GateQuestion,
    mark: &Path,
) -> impl Iterator<Item = (String, String)> {
    let asked = [
        ("TASKD_GATE_STEP", question.step.as_str().to_owned()),
        ("TASKD_RUN", question.run.to_string()),
        (RUN_DIR_VARIABLE, mark.display().to_string()),
    ];
    let asked = asked.map(|(name, value)| (name.to_owned(), value));
    task_variables(task, &question.version, &question.deployment).into_iter().chain(asked)
}

impl GateStep {
    /// The step's name in the gate's environment.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Start => "start",
            Self::Stop => "stop",
            Self::Switch => "switch",
        }
    }
}

/// The first lines of a gate's output. The rest is read and dropped, so that the gate is not
/// blocked.
fn reason(mut output: PipeReader) -> String {
    let mut bytes = Vec::new();
    // Unreadable output gives no reason; the exit code is the answer.
    let _ = output.by_ref().take(MAX_REASON_BYTES).read_to_end(&mut bytes);
    let _ = io::copy(&mut output, &mut io::sink());
    let text = String::from_utf8_lossy(&bytes);
    let lines = text.lines().map(str::trim).filter(|line| !line.is_empty()).take(MAX_REASON_LINES);
    lines.collect::<Vec<_>>().join("\n")
}
