//! The questions to the robot's gate and their answers, as stored in the ledger. This module asks
//! nothing itself.

use serde::{Deserialize, Serialize};
use task_proto::messages::report::Failure;
use task_proto::{DeploymentId, Version};

/// A question to the robot's gate, with its answer.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct GateRecord {
    pub question: GateQuestion,
    /// The last answer to the question.
    pub answer: Option<GateAnswer>,
    /// The number of refusals.
    pub refusals: u32,
    /// The gate is not asked again before this time.
    pub retry_at_ms: u64,
}

/// A question to the robot's gate.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct GateQuestion {
    /// The step in question.
    pub step: GateStep,
    /// The deployment that ordered the run.
    pub deployment: DeploymentId,
    /// The run number within the deployment.
    pub run: u64,
    /// The version that the step concerns.
    pub version: Version,
}

/// A step that the robot's gate may forbid.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GateStep {
    /// Start a task that does not run.
    Start,
    /// Stop a task that runs.
    Stop,
    /// Replace one version by another.
    Switch,
}

/// The answer of the robot's gate.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GateAnswer {
    /// The step may be done.
    Allowed,
    /// The step may not be done now; holds the reason.
    Refused(Failure),
}
