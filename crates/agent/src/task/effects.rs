//! The effects that the driver may have on the robot, behind one trait. The driver's logic is
//! tested against a fake without disk, processes or time. [`crate::reconcile::robot::Robot`] is the
//! real implementation. Effects decide nothing.

use std::future::Future;

use bytes::Bytes;
use task_proto::desired::{BlobRef, DesiredState, PackageRef};
use task_proto::messages::report::{HostFacts, Progress};
use task_proto::{DeploymentId, Digest, TaskName};
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

use crate::task::ledger::{GateQuestion, Ledger, LedgerError, OutputUpload};
use crate::task::observed::{Health, Prepared, ProcessState, RobotFacts, TrustFacts};
use crate::task::plan::{Done, StepFailure};
use crate::task::run::{ActiveRun, ProcessRecord};
use crate::transfer::parts::PartRequest;

/// Readings of the agent's two clocks, in milliseconds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Now {
    pub boot_ms: u64,
    /// Since the Unix epoch, by the robot's clock, which may be wrong.
    pub wall_ms: u64,
}

/// All effects of the driver on the robot. Each method may be called again after a crash: a second
/// call is harmless.
pub trait Effects: Send + Sync + 'static {
    /// The current clock readings.
    fn now(&self) -> Now;

    /// Writes the ledger. Once this returns, the ledger survives a power cut.
    fn write_ledger(&self, ledger: &Ledger) -> Result<(), LedgerError>;

    /// Whether a person at the robot said `hold`.
    fn is_held(&self) -> bool;

    /// Whether the robot has a gate to ask.
    fn is_gated(&self) -> bool;

    /// Facts about this robot that packages may require, with the last known ROS installations. The
    /// labels are not included: the server holds them.
    fn robot_facts(&self) -> RobotFacts;

    /// Inspects the installed ROS distributions again: a person may have installed a missing
    /// dependency.
    fn probe_ros(&self) -> impl Future<Output = ()> + Send;

    /// The facts about the machine that reports contain.
    fn host_facts(&self) -> HostFacts;

    /// Each task's last run, found without the ledger: a live run, else an ended run, so that a
    /// completed job does not run again.
    fn survivors(&self) -> impl Future<Output = Vec<(TaskName, ActiveRun)>> + Send;

    /// The files of this version on the disk.
    fn prepared(&self, package: &PackageRef) -> impl Future<Output = Prepared> + Send;

    /// The observed state of a process.
    fn process(
        &self,
        task: &TaskName,
        process: &ProcessRecord,
    ) -> impl Future<Output = ProcessState> + Send;

    /// Resolves when a live process has ended. Dropping the future does not affect the process.
    fn process_ended(
        &self,
        task: &TaskName,
        process: &ProcessRecord,
    ) -> impl Future<Output = ()> + Send;

    /// Begins to compare the ROS graph with the promises of the package of this run. The run's
    /// process must be alive. Also brings the run's lifecycle nodes to active and sets its
    /// parameters, unless the run says that its process is ready. Watching continues until the
    /// receiver is dropped. A package without promises is healthy from the start of its process.
    fn watch(&self, task: &TaskName, run: &ActiveRun) -> watch::Receiver<Health>;

    /// The maximum number of versions that are prepared concurrently.
    fn parallel_tasks(&self) -> usize;

    /// Records the signature evidence of a desired state, begins to fetch the evidence, and adopts
    /// the settings in the state.
    fn apply_state(&self, state: &DesiredState);

    /// The facts by which the robot decides whether a package is trusted.
    fn trust_facts(&self) -> TrustFacts;

    /// Checks that enough of the trusted publishers have signed the package, so that work on the
    /// package may begin.
    fn check_signers(
        &self,
        package: &PackageRef,
        cancel: &CancellationToken,
    ) -> impl Future<Output = Result<(), StepFailure>> + Send;

    /// Deletes the gathered bytes of all contents that are not in `wanted`.
    fn retain_parts(&self, wanted: &[Digest]);

    /// Pulls the manifest, unless the server tells this robot to come back later.
    fn pull_manifest(
        &self,
        package: &PackageRef,
        cancel: &CancellationToken,
    ) -> impl Future<Output = Result<Done, StepFailure>> + Send;

    /// Takes blobs that came with an order, their digests verified. Blobs of earlier orders are
    /// discarded.
    fn offer(&self, blobs: Vec<(BlobRef, Bytes)>);

    /// Pulls and unpacks the content, unless the server tells this robot to come back later.
    fn pull_content(
        &self,
        package: &PackageRef,
        progress: &watch::Sender<Progress>,
        cancel: &CancellationToken,
    ) -> impl Future<Output = Result<Done, StepFailure>> + Send;

    /// Gathers the parts of the content that the server pushes, pulls the missing parts, and
    /// unpacks the content.
    fn gather_content(
        &self,
        package: &PackageRef,
        progress: &watch::Sender<Progress>,
        part_requests: &watch::Sender<PartRequest>,
        cancel: &CancellationToken,
    ) -> impl Future<Output = Result<Done, StepFailure>> + Send;

    /// Builds the unpacked package for a run of this deployment.
    fn build(
        &self,
        package: &PackageRef,
        deployment: &DeploymentId,
        cancel: &CancellationToken,
    ) -> impl Future<Output = Result<(), StepFailure>> + Send;

    /// Asks the robot's gate; a failure holds the reason of the refusal.
    fn query_gate(
        &self,
        task: &TaskName,
        question: &GateQuestion,
    ) -> impl Future<Output = Result<(), StepFailure>> + Send;

    /// Makes the run's version the current one and starts the process named in the run's record.
    /// Returns the process id.
    fn start(
        &self,
        task: &TaskName,
        run: &ActiveRun,
    ) -> impl Future<Output = Result<u32, StepFailure>> + Send;

    /// Stops the run's process and all its descendants in order: lifecycle nodes first. Afterwards
    /// none of the run's nodes is left on the graph.
    fn stop(
        &self,
        task: &TaskName,
        run: &ActiveRun,
    ) -> impl Future<Output = Result<(), StepFailure>> + Send;

    /// Uploads the output files of an ended run to the server.
    fn upload_outputs(
        &self,
        task: &TaskName,
        files: &OutputUpload,
        progress: &watch::Sender<Progress>,
        cancel: &CancellationToken,
    ) -> impl Future<Output = Result<(), StepFailure>> + Send;

    /// Deletes the versions that are not in `kept`, and the leftovers of ended runs.
    fn prune(
        &self,
        task: &TaskName,
        kept: &[Digest],
        running: Option<&ProcessRecord>,
    ) -> impl Future<Output = Result<(), StepFailure>> + Send;

    /// Deletes a task with all its files.
    fn remove(&self, task: &TaskName) -> impl Future<Output = Result<(), StepFailure>> + Send;
}
