//! What the driver may do to the robot, behind one trait, so that its logic is tested against a
//! fake without disk, processes or time. [`crate::reconcile::robot::Robot`] is the real one.
//! Effects decide nothing.

use std::future::Future;

use bytes::Bytes;
use task_proto::desired::{BlobRef, DesiredState, PackageRef};
use task_proto::report::{HostFacts, Progress};
use task_proto::{Digest, TaskName};
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

use crate::task::ledger::{
    ActiveRun, Collection, GateQuestion, Ledger, LedgerError, ProcessRecord,
};
use crate::task::observed::{Health, Prepared, ProcessState, RobotFacts, TrustFacts};
use crate::task::plan::{Done, StepFailure};
use crate::transfer::parts::Asks;

/// Milliseconds by the clocks an agent looks at.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Now {
    /// Since boot.
    pub boot_ms: u64,
    /// Since the Unix epoch, as far as the robot knows.
    pub wall_ms: u64,
}

/// Everything the driver does to the robot. Each method may be called again after a crash: doing it
/// twice is harmless.
pub trait Effects: Send + Sync + 'static {
    /// What the clocks show.
    fn now(&self) -> Now;

    /// Writes the ledger. Once this returns it survives a power cut.
    fn write_ledger(&self, ledger: &Ledger) -> Result<(), LedgerError>;

    /// Whether a person at the robot said `hold`.
    fn is_held(&self) -> bool;

    /// Whether the robot has a gate that is to be asked.
    fn is_gated(&self) -> bool;

    /// What packages may require of this robot, apart from the labels the server knows better, with
    /// the ROS that was last seen.
    fn robot_facts(&self) -> RobotFacts;

    /// Looks at what ROS there is now: a person may have installed what a task lacked.
    fn look_for_ros(&self) -> impl Future<Output = ()> + Send;

    /// What the reports say of the machine.
    fn host_facts(&self) -> HostFacts;

    /// Each task's last run, found without the ledger: one that lives, else one that has ended, so
    /// that a job that was done is not done again.
    fn survivors(&self) -> impl Future<Output = Vec<(TaskName, ActiveRun)>> + Send;

    /// What is on the disk of this version.
    fn prepared(&self, package: &PackageRef) -> impl Future<Output = Prepared> + Send;

    /// What became of a process.
    fn process(
        &self,
        task: &TaskName,
        process: &ProcessRecord,
    ) -> impl Future<Output = ProcessState> + Send;

    /// Resolves when a process that lived has ended. Dropping it does nothing to the process.
    fn process_ended(
        &self,
        task: &TaskName,
        process: &ProcessRecord,
    ) -> impl Future<Output = ()> + Send;

    /// Begins to compare what ROS says of this run, whose process lives, with what its package
    /// promises, bringing its lifecycle nodes to active and setting its parameters unless
    /// `process.ready` says that this was done. It goes on until the receiver is dropped. A package
    /// that promises nothing holds since its process was started.
    fn watch(&self, task: &TaskName, run: &ActiveRun) -> watch::Receiver<Health>;

    /// How many versions may be prepared at the same time.
    fn parallel_tasks(&self) -> usize;

    /// Notes what a desired state says of who has signed what, and begins to get it; and takes on
    /// the settings in it.
    fn heed(&self, state: &DesiredState);

    /// What the robot goes by when it asks who has signed a package.
    fn trust_facts(&self) -> TrustFacts;

    /// Finds out whether enough of the trusted publishers have signed it, so that it may be begun.
    fn check_signers(
        &self,
        package: &PackageRef,
        cancel: &CancellationToken,
    ) -> impl Future<Output = Result<(), StepFailure>> + Send;

    /// Deletes the gathered bytes of all contents but these.
    fn keep_parts(&self, wanted: &[Digest]);

    /// Pulls the manifest, unless the server tells this robot to come back later.
    fn pull_manifest(
        &self,
        package: &PackageRef,
        cancel: &CancellationToken,
    ) -> impl Future<Output = Result<Done, StepFailure>> + Send;

    /// Takes blobs that came with an order and are what their digests say; those that came before
    /// are of no more use.
    fn offer(&self, blobs: Vec<(BlobRef, Bytes)>);

    /// Pulls and unpacks the content, likewise.
    fn pull_content(
        &self,
        package: &PackageRef,
        progress: &watch::Sender<Progress>,
        cancel: &CancellationToken,
    ) -> impl Future<Output = Result<Done, StepFailure>> + Send;

    /// Gathers the parts of the content that the server pushes, pulls what does not come, and
    /// unpacks it.
    fn gather_content(
        &self,
        package: &PackageRef,
        progress: &watch::Sender<Progress>,
        asks: &watch::Sender<Asks>,
        cancel: &CancellationToken,
    ) -> impl Future<Output = Result<Done, StepFailure>> + Send;

    /// Builds it.
    fn build(
        &self,
        package: &PackageRef,
        cancel: &CancellationToken,
    ) -> impl Future<Output = Result<(), StepFailure>> + Send;

    /// Asks the robot's gate; a failure is the reason of its no.
    fn ask_gate(
        &self,
        task: &TaskName,
        question: &GateQuestion,
    ) -> impl Future<Output = Result<(), StepFailure>> + Send;

    /// Makes the run's version the current one and starts the process that its record names; gives
    /// the process id.
    fn start(
        &self,
        task: &TaskName,
        run: &ActiveRun,
    ) -> impl Future<Output = Result<u32, StepFailure>> + Send;

    /// Stops the run's process and all it started, in good order: its lifecycle nodes first.
    /// Afterwards none of it is left on the graph.
    fn stop(
        &self,
        task: &TaskName,
        run: &ActiveRun,
    ) -> impl Future<Output = Result<(), StepFailure>> + Send;

    /// Brings the files of an ended run to the server.
    fn collect(
        &self,
        task: &TaskName,
        files: &Collection,
        progress: &watch::Sender<Progress>,
        cancel: &CancellationToken,
    ) -> impl Future<Output = Result<(), StepFailure>> + Send;

    /// Deletes the versions that are not in `kept`, and what ended runs left.
    fn prune(
        &self,
        task: &TaskName,
        kept: &[Digest],
        running: Option<&ProcessRecord>,
    ) -> impl Future<Output = Result<(), StepFailure>> + Send;

    /// Deletes a task with all that belongs to it.
    fn remove(&self, task: &TaskName) -> impl Future<Output = Result<(), StepFailure>> + Send;
}
