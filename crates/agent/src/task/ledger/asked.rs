//! What the robot's gate was asked about a task, as the ledger keeps it. It asks nothing itself.

use serde::{Deserialize, Serialize};
use task_proto::report::Failure;
use task_proto::{DeploymentId, Version};

/// What the robot's gate was asked, and what it said.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct GateRecord {
    /// The question.
    pub question: GateQuestion,
    /// The last answer to it.
    pub answer: Option<GateAnswer>,
    /// How often the answer was no.
    pub refusals: u32,
    /// It is not asked again before this time.
    pub retry_at_ms: u64,
}

/// A question to the robot's gate.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct GateQuestion {
    /// What is about to be done.
    pub step: GateStep,
    /// With which order's run.
    pub deployment: DeploymentId,
    /// Which of its runs.
    pub run: u64,
    /// Of which version.
    pub version: Version,
}

/// What the robot's gate may forbid.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GateStep {
    /// To start a task that does not run.
    Start,
    /// To stop one that runs.
    Stop,
    /// To replace one version by another.
    Switch,
}

/// What the robot's gate said.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GateAnswer {
    /// Yes.
    Allowed,
    /// Not now, and why.
    Refused(Failure),
}
