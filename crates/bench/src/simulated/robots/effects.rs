//! A simulated robot's body: the agent's own effects for packages (fetch, verify, unpack, delete),
//! and a body without processes, ROS and a ledger on the disk for the rest. Started services run at
//! once and forever; jobs succeed at once.

use std::collections::BTreeSet;
use std::sync::{Mutex, MutexGuard, PoisonError};

use bytes::Bytes;
use task_agent::process::program::ExitStatus;
use task_agent::reconcile::robot::Robot;
use task_agent::system::clock;
use task_agent::task::effects::{Effects, Now};
use task_agent::task::ledger::{GateQuestion, Ledger, LedgerError, OutputUpload};
use task_agent::task::observed::{Exit, Health, Prepared, ProcessState, RobotFacts, TrustFacts};
use task_agent::task::plan::{Done, StepFailure};
use task_agent::task::run::{ActiveRun, ProcessRecord};
use task_agent::transfer::parts::PartRequest;
use task_proto::desired::{BlobRef, DesiredState, PackageRef};
use task_proto::messages::report::{HostFacts, Progress};
use task_proto::packages::manifest::TaskKind;
use task_proto::{DeploymentId, Digest, TaskName};
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

use super::log::{LoggedEvent, RobotLog};

/// The pid of every started task.
const PID: u32 = 1;

/// The body of one robot.
pub struct SimulatedEffects {
    robot: Robot,
    facts: HostFacts,
    health: watch::Sender<Health>,
    /// The run directories, by name, of services that were started and not stopped.
    alive: Mutex<BTreeSet<String>>,
    /// The run directories, by name, of jobs that were started and have succeeded.
    succeeded: Mutex<BTreeSet<String>>,
    log: Option<RobotLog>,
}

impl SimulatedEffects {
    /// A body around the agent's own effects, with these facts about its machine.
    pub fn new(robot: Robot, facts: HostFacts, log: Option<RobotLog>) -> Self {
        Self {
            robot,
            facts,
            health: watch::Sender::new(Health::Unknown),
            alive: Mutex::default(),
            succeeded: Mutex::default(),
            log,
        }
    }

    fn alive(&self) -> MutexGuard<'_, BTreeSet<String>> {
        self.alive.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn succeeded(&self) -> MutexGuard<'_, BTreeSet<String>> {
        self.succeeded.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Effects for SimulatedEffects {
    fn now(&self) -> Now {
        self.robot.now()
    }

    fn write_ledger(&self, _: &Ledger) -> Result<(), LedgerError> {
        // Every real robot has its own disk; here thousands would share one.
        Ok(())
    }

    fn is_held(&self) -> bool {
        false
    }

    fn is_gated(&self) -> bool {
        false
    }

    fn robot_facts(&self) -> RobotFacts {
        let arch = std::env::consts::ARCH.to_owned();
        RobotFacts { arch, labels: None, installations: Some(Vec::new()), no_task_user: None }
    }

    async fn probe_ros(&self) {}

    fn host_facts(&self) -> HostFacts {
        self.facts.clone()
    }

    async fn survivors(&self) -> Vec<(TaskName, ActiveRun)> {
        Vec::new()
    }

    async fn prepared(&self, package: &PackageRef) -> Prepared {
        self.robot.prepared(package).await
    }

    async fn process(&self, _: &TaskName, process: &ProcessRecord) -> ProcessState {
        if self.alive().contains(&process.dir) {
            return ProcessState::Alive { pid: PID };
        }
        let has_succeeded = self.succeeded().contains(&process.dir);
        let status = if has_succeeded { ExitStatus::Code(0) } else { ExitStatus::Signal(15) };
        let status = Some(status);
        ProcessState::Ended(Exit { status, out_of_memory_bytes: None, last_lines: String::new() })
    }

    async fn process_ended(&self, _: &TaskName, process: &ProcessRecord) {
        if !self.succeeded().contains(&process.dir) {
            std::future::pending().await
        }
    }

    fn watch(&self, _: &TaskName, _: &ActiveRun) -> watch::Receiver<Health> {
        self.health.send_replace(Health::Holds { since_ms: clock::boot_ms() });
        self.health.subscribe()
    }

    fn parallel_tasks(&self) -> usize {
        self.robot.parallel_tasks()
    }

    fn apply_state(&self, state: &DesiredState) {
        self.robot.apply_state(state);
    }

    fn trust_facts(&self) -> TrustFacts {
        self.robot.trust_facts()
    }

    async fn check_signers(
        &self,
        package: &PackageRef,
        cancel: &CancellationToken,
    ) -> Result<(), StepFailure> {
        self.robot.check_signers(package, cancel).await
    }

    fn retain_parts(&self, wanted: &[Digest]) {
        self.robot.retain_parts(wanted);
    }

    async fn pull_manifest(
        &self,
        package: &PackageRef,
        cancel: &CancellationToken,
    ) -> Result<Done, StepFailure> {
        self.robot.pull_manifest(package, cancel).await
    }

    async fn pull_content(
        &self,
        package: &PackageRef,
        progress: &watch::Sender<Progress>,
        cancel: &CancellationToken,
    ) -> Result<Done, StepFailure> {
        self.robot.pull_content(package, progress, cancel).await
    }

    fn offer(&self, blobs: Vec<(BlobRef, Bytes)>) {
        self.robot.offer(blobs);
    }

    async fn gather_content(
        &self,
        package: &PackageRef,
        progress: &watch::Sender<Progress>,
        part_requests: &watch::Sender<PartRequest>,
        cancel: &CancellationToken,
    ) -> Result<Done, StepFailure> {
        self.robot.gather_content(package, progress, part_requests, cancel).await
    }

    async fn build(
        &self,
        _: &PackageRef,
        _: &DeploymentId,
        _: &CancellationToken,
    ) -> Result<(), StepFailure> {
        Ok(())
    }

    async fn query_gate(&self, _: &TaskName, _: &GateQuestion) -> Result<(), StepFailure> {
        Ok(())
    }

    async fn start(&self, _: &TaskName, run: &ActiveRun) -> Result<u32, StepFailure> {
        let dir = run.process().map(|process| process.dir.clone());
        match run.rules.kind {
            TaskKind::Job => self.succeeded().extend(dir),
            TaskKind::Service => self.alive().extend(dir),
        }
        if let Some(log) = &self.log {
            let deployment = run.deployment.clone();
            log.write(LoggedEvent::Started { deployment, run: run.run }).await;
        }
        Ok(PID)
    }

    async fn stop(&self, _: &TaskName, run: &ActiveRun) -> Result<(), StepFailure> {
        if let Some(process) = run.process() {
            self.alive().remove(&process.dir);
        }
        Ok(())
    }

    async fn upload_outputs(
        &self,
        _: &TaskName,
        _: &OutputUpload,
        _: &watch::Sender<Progress>,
        _: &CancellationToken,
    ) -> Result<(), StepFailure> {
        Ok(())
    }

    async fn prune(
        &self,
        task: &TaskName,
        kept: &[Digest],
        running: Option<&ProcessRecord>,
    ) -> Result<(), StepFailure> {
        self.robot.prune(task, kept, running).await
    }

    async fn remove(&self, task: &TaskName) -> Result<(), StepFailure> {
        self.robot.remove(task).await
    }
}
