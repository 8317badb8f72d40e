//! A fake robot that records the driver's calls and behaves as the test says.

use std::collections::BTreeSet;
use std::sync::Mutex;

use bytes::Bytes;
use task_proto::desired::{BlobRef, PackageRef};
use task_proto::messages::report::{Failure, FailureCode, HostFacts};
use task_proto::packages::manifest::{
    Build, ContentFacts, Outputs, Ready, Requires, Run, TaskManifest,
};
use task_proto::{DeploymentId, Digest, Generation};

use crate::process::program::ExitStatus;
use crate::reconcile::driver::*;
use crate::setup::installation::Installation;
use crate::task::effects::Now;
use crate::task::ledger::{GateQuestion, GateStep, LedgerError, OutputUpload};
use crate::task::observed::{Exit, SignatureVerdict};
use crate::task::plan::{Done, StepFailure};
use crate::task::run::ProcessRecord;

#[derive(Default)]
pub(super) struct Fake {
    state: Mutex<State>,
    /// While set, pulls of content wait to be cancelled.
    pub(super) slow: std::sync::atomic::AtomicBool,
    /// Changes when a process has ended.
    exited: watch::Sender<()>,
    /// The number of content pulls that were told to come back later.
    pub(super) pulls: watch::Sender<u32>,
    /// The number of observations of processes with an undeterminable state.
    pub(super) looks: watch::Sender<u64>,
    /// The missing parts, as announced by the gathering step.
    pub(super) part_requests: watch::Sender<PartRequest>,
}

#[derive(Default)]
pub(super) struct State {
    pub(super) manifests: BTreeSet<Digest>,
    pub(super) contents: BTreeSet<Digest>,
    pub(super) alive: BTreeSet<String>,
    pub(super) started: Vec<(DeploymentId, u64)>,
    cancelled: u32,
    /// The waits, in milliseconds, that the next content pulls are told; the last one comes first.
    pub(super) retry_later: Vec<u64>,
    /// The blobs that came with the newest order.
    pub(super) offered: Vec<(BlobRef, Bytes)>,
    /// The tasks of the pulled contents, in order.
    pub(super) pulled: Vec<TaskName>,
    pub(super) kept_parts: Vec<Vec<Digest>>,
    pub(super) ledgers: Vec<Ledger>,
    pub(super) held: bool,
    /// The reading of the robot's clock, if it is wrong.
    pub(super) wall_ms: Option<u64>,
    pub(super) disk_full: bool,
    /// The failures of stops and removals, if any.
    pub(super) stop: Option<StepFailure>,
    pub(super) removal: Option<StepFailure>,
    /// The dependencies that packages declare, those that the robot has, and those that the last
    /// inspection saw.
    pub(super) exec_depends: Vec<String>,
    pub(super) ros_packages: BTreeSet<String>,
    seen_packages: BTreeSet<String>,
    /// The answer of the robot's gate, if there is one, and the questions it was asked.
    pub(super) gate: Option<Result<(), String>>,
    pub(super) asked: Vec<GateStep>,
    /// The outcome of an upload, unless it hangs, and the runs of the uploaded files.
    pub(super) upload: Option<Result<(), StepFailure>>,
    pub(super) collected: Vec<u64>,
    /// Whether the processes are jobs with output files.
    pub(super) jobs: bool,
    /// The exit code of each ended process.
    exits: Vec<(String, i32)>,
    /// Whether the state of ended processes cannot be determined.
    pub(super) hangs: bool,
    /// Versions without a trusted signature, and the trust facts.
    pub(super) untrusted: BTreeSet<Digest>,
    pub(super) trust: TrustFacts,
    /// The states with recorded evidence, and the versions with checked signers.
    pub(super) applied: Vec<Generation>,
    pub(super) checked: Vec<Digest>,
    /// Versions that never become ready.
    pub(super) bad: BTreeSet<Digest>,
    /// Versions whose files the next start finds changed, and deletes.
    pub(super) changed: BTreeSet<Digest>,
    /// The health of every live process.
    health: watch::Sender<Health>,
}

impl Fake {
    pub(super) fn state<T>(&self, look: impl FnOnce(&mut State) -> T) -> T {
        look(&mut self.state.lock().expect("no test panicked"))
    }

    /// Ends the live process.
    pub(super) fn exit(&self, code: i32) {
        self.state(|state| {
            let ended = std::mem::take(&mut state.alive);
            state.exits.extend(ended.into_iter().map(|dir| (dir, code)));
        });
        self.exited.send_replace(());
    }

    pub(super) fn sees(&self, health: Health) {
        self.state(|state| state.health.send_replace(health));
    }
}

impl Effects for Fake {
    fn now(&self) -> Now {
        let wall_ms =
            self.state(|state| state.wall_ms).unwrap_or_else(crate::system::clock::wall_ms);
        Now { boot_ms: crate::system::clock::boot_ms(), wall_ms }
    }

    fn write_ledger(&self, ledger: &Ledger) -> Result<(), LedgerError> {
        if self.state(|state| state.disk_full) {
            return ledger.write(std::path::Path::new("/dev/null/ledger.json"));
        }
        self.state(|state| state.ledgers.push(ledger.clone()));
        Ok(())
    }

    fn is_held(&self) -> bool {
        self.state(|state| state.held)
    }

    fn is_gated(&self) -> bool {
        self.state(|state| state.gate.is_some())
    }

    fn robot_facts(&self) -> RobotFacts {
        let packages = self.state(|state| state.seen_packages.clone());
        let seen = Installation { packages: Some(packages), ..Installation::default() };
        RobotFacts { installations: Some(vec![seen]), ..RobotFacts::default() }
    }

    async fn probe_ros(&self) {
        self.state(|state| state.seen_packages = state.ros_packages.clone());
    }

    fn host_facts(&self) -> HostFacts {
        HostFacts::default()
    }

    async fn survivors(&self) -> Vec<(TaskName, ActiveRun)> {
        Vec::new()
    }

    async fn prepared(&self, package: &PackageRef) -> Prepared {
        self.state(|state| {
            let content = state.contents.contains(&package.manifest.digest);
            let of_jobs = |mut manifest: TaskManifest| {
                if state.jobs {
                    manifest.run.kind = task_proto::packages::manifest::TaskKind::Job;
                    manifest.outputs.paths = vec!["maps/*.pgm".to_owned()];
                }
                manifest
            };
            let manifest = || TaskManifest {
                exec_depends: state.exec_depends.clone(),
                ..of_jobs(manifest(package))
            };
            let manifest = state.manifests.contains(&package.manifest.digest).then(manifest);
            let is_trusted = !state.untrusted.contains(&package.manifest.digest);
            let signatures = if is_trusted {
                SignatureVerdict::Sufficient
            } else {
                SignatureVerdict::Insufficient
            };
            Prepared { manifest, content, built: content, versions: Vec::new(), signatures }
        })
    }

    async fn process(&self, _task: &TaskName, process: &ProcessRecord) -> ProcessState {
        self.state(|state| match state.exits.iter().find(|(dir, _)| *dir == process.dir) {
            Some(_) if state.hangs => {
                self.looks.send_modify(|looks| *looks += 1);
                ProcessState::Unknown
            }
            Some((_, code)) => ProcessState::Ended(Exit {
                status: Some(ExitStatus::Code(*code)),
                last_lines: String::new(),
                out_of_memory_bytes: None,
            }),
            None if state.alive.contains(&process.dir) => ProcessState::Alive { pid: 7 },
            None => ProcessState::NeverStarted,
        })
    }

    async fn process_ended(&self, _task: &TaskName, process: &ProcessRecord) {
        let mut exited = self.exited.subscribe();
        let ended =
            |_: &()| self.state(|state| state.exits.iter().any(|(dir, _)| *dir == process.dir));
        exited.wait_for(ended).await.expect("the fake lives");
    }

    fn watch(&self, _task: &TaskName, run: &ActiveRun) -> watch::Receiver<Health> {
        if self.state(|state| state.bad.contains(&run.package.manifest.digest)) {
            let failure = Failure::new(FailureCode::LIFECYCLE_FAILED, "it will not");
            return watch::channel(Health::Refused(failure)).1;
        }
        self.state(|state| state.health.subscribe())
    }

    fn parallel_tasks(&self) -> usize {
        2
    }

    fn apply_state(&self, desired: &DesiredState) {
        self.state(|state| state.applied.push(desired.generation));
    }

    fn trust_facts(&self) -> TrustFacts {
        self.state(|state| state.trust.clone())
    }

    async fn check_signers(
        &self,
        package: &PackageRef,
        _cancel: &CancellationToken,
    ) -> Result<(), StepFailure> {
        self.state(|state| state.checked.push(package.manifest.digest));
        let failure = Failure::new(FailureCode::UNTRUSTED_PACKAGE, "nobody has signed it");
        Err(StepFailure { failure, retry_after_ms: None })
    }

    fn retain_parts(&self, wanted: &[Digest]) {
        self.state(|state| state.kept_parts.push(wanted.to_vec()));
    }

    async fn pull_manifest(
        &self,
        package: &PackageRef,
        _cancel: &CancellationToken,
    ) -> Result<Done, StepFailure> {
        self.state(|state| state.manifests.insert(package.manifest.digest));
        Ok(Done::Complete)
    }

    async fn pull_content(
        &self,
        package: &PackageRef,
        progress: &watch::Sender<Progress>,
        cancel: &CancellationToken,
    ) -> Result<Done, StepFailure> {
        if let Some(at_least_ms) = self.state(|state| state.retry_later.pop()) {
            progress.send_replace(Progress { done: 1, total: 2 });
            self.pulls.send_modify(|pulls| *pulls += 1);
            return Ok(Done::RetryLater { at_least_ms });
        }
        if self.slow.load(std::sync::atomic::Ordering::SeqCst) {
            cancel.cancelled().await;
            self.state(|state| state.cancelled += 1);
            let failure = Failure::new(FailureCode::IO_ERROR, "cancelled");
            return Err(StepFailure { failure, retry_after_ms: Some(0) });
        }
        self.state(|state| {
            state.pulled.push(package.name.clone());
            state.contents.insert(package.manifest.digest)
        });
        Ok(Done::Complete)
    }

    fn offer(&self, blobs: Vec<(BlobRef, Bytes)>) {
        self.state(|state| state.offered = blobs);
    }

    async fn gather_content(
        &self,
        package: &PackageRef,
        progress: &watch::Sender<Progress>,
        part_requests: &watch::Sender<PartRequest>,
        cancel: &CancellationToken,
    ) -> Result<Done, StepFailure> {
        progress.send_replace(Progress { done: 1, total: package.content.size });
        let mut said = self.part_requests.subscribe();
        loop {
            let now = said.borrow_and_update().clone();
            part_requests.send_replace(now);
            tokio::select! {
                Ok(()) = said.changed() => {}
                () = cancel.cancelled() => break,
            }
        }
        self.state(|state| state.cancelled += 1);
        let failure = Failure::new(FailureCode::IO_ERROR, "cancelled");
        Err(StepFailure { failure, retry_after_ms: Some(0) })
    }

    async fn build(
        &self,
        _package: &PackageRef,
        _deployment: &DeploymentId,
        _cancel: &CancellationToken,
    ) -> Result<(), StepFailure> {
        Ok(())
    }

    async fn query_gate(
        &self,
        _task: &TaskName,
        question: &GateQuestion,
    ) -> Result<(), StepFailure> {
        let answer = self.state(|state| {
            state.asked.push(question.step);
            state.gate.clone().expect("only then it is asked")
        });
        answer.map_err(|text| {
            let failure = Failure::new(FailureCode::GATE_REFUSED, text);
            StepFailure { failure, retry_after_ms: Some(0) }
        })
    }

    async fn start(&self, task: &TaskName, run: &ActiveRun) -> Result<u32, StepFailure> {
        self.state(|state| {
            let dir = run.process().expect("a process to start").dir.clone();
            let written =
                state.ledgers.last().and_then(|ledger| ledger.tasks.get(task)?.active.clone());
            assert_eq!(written.as_ref(), Some(run), "the ledger is written before the start");
            assert!(state.alive.is_empty(), "two processes of a task");
            let version = &run.package.manifest.digest;
            if state.changed.remove(version) {
                state.contents.remove(version);
            }
            if !state.contents.contains(version) {
                let failure = Failure::new(FailureCode::TREE_CHANGED, "src was changed");
                return Err(StepFailure { failure, retry_after_ms: Some(0) });
            }
            state.alive.insert(dir);
            state.started.push((run.deployment.clone(), run.run));
            Ok(7)
        })
    }

    async fn stop(&self, _task: &TaskName, run: &ActiveRun) -> Result<(), StepFailure> {
        let process = run.process().expect("a process to stop");
        self.state(|state| match &state.stop {
            Some(failure) => Err(failure.clone()),
            None => {
                state.alive.remove(&process.dir);
                Ok(())
            }
        })
    }

    async fn upload_outputs(
        &self,
        _task: &TaskName,
        files: &OutputUpload,
        progress: &watch::Sender<Progress>,
        cancel: &CancellationToken,
    ) -> Result<(), StepFailure> {
        let answer = self.state(|state| state.upload.clone());
        if answer.is_none() {
            progress.send_replace(Progress { done: 1, total: 2 });
            cancel.cancelled().await;
        }
        self.state(|state| state.collected.push(files.run));
        answer.unwrap_or(Ok(()))
    }

    async fn prune(
        &self,
        _task: &TaskName,
        _kept: &[Digest],
        _running: Option<&ProcessRecord>,
    ) -> Result<(), StepFailure> {
        Ok(())
    }

    async fn remove(&self, _task: &TaskName) -> Result<(), StepFailure> {
        assert!(self.state(|state| state.alive.is_empty()), "removed while it runs");
        self.state(|state| state.removal.clone()).map_or(Ok(()), Err)
    }
}

fn manifest(package: &PackageRef) -> TaskManifest {
    TaskManifest {
        name: package.name.clone(),
        version: package.version.clone(),
        build: Build::default(),
        run: Run::default(),
        ready: Ready { hold_s: 0, ..Ready::default() },
        parameters: Default::default(),
        outputs: Outputs::default(),
        requires: Requires::default(),
        limits: task_proto::packages::manifest::Limits::default(),
        exec_depends: Vec::new(),
        content: ContentFacts { tar_digest: Digest::of(b""), tar_size: 0, entries: 0 },
    }
}
