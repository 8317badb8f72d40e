//! The real robot. Each effect is a call to the module that owns the work; the module's error
//! becomes a failure code and text. The robot holds no state beside its settings.

use std::error::Error;
use std::path::{Path, PathBuf};
use std::sync::{Arc, RwLock};
use std::time::Duration;

use bytes::Bytes;
use task_proto::desired::settings::RobotSettings;
use task_proto::desired::{BlobRef, DesiredState, PackageRef, RobotDescription};
use task_proto::error_chain::chain;
use task_proto::messages::report::{
    Failure, FailureCode, HostFacts, Isolation, Progress, TaskAccounts,
};
use task_proto::packages::manifest::TaskManifest;
use task_proto::time::millis;
use task_proto::{DeploymentId, Digest, MacAddress, RobotId, TaskName};
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

use self::outcomes::{
    blocking_io, build_failure, fetch_failure, outputs_code, pull_outcome, retryable_failure,
};
use self::resolved::ResolvedSettings;
use self::trees::Purpose;
use crate::config::Config;
use crate::config::trust::{PackageUse, Trust};
use crate::install::builder::{self, BuildLimits, BuildSpec};
use crate::install::fetch::{self, FetchError, Fetcher};
use crate::install::signature_policy::SignaturePolicy;
use crate::logs;
use crate::logs::LogSpec;
use crate::logs::forwarder::ForwardSettings;
use crate::process::call_filter;
use crate::process::cgroup::{Cgroups, RunLimits};
use crate::process::program::ExitStatus;
use crate::process::run_dir::RunSpec;
use crate::process::supervisor::{RunState, Supervisor, SupervisorError};
use crate::reconcile::gate::Gate;
use crate::ros::graph::GraphProgram;
use crate::ros::graph_access::GraphAccess;
use crate::ros::readiness::Promise;
use crate::ros::watcher::{WatchedRun, Watcher};
use crate::setup::environment;
use crate::setup::installation;
use crate::setup::installation::Installation;
use crate::setup::launch;
use crate::setup::script;
use crate::system::accounts::Accounts;
use crate::system::battery;
use crate::system::clock;
use crate::system::disk;
use crate::system::disk::Need;
use crate::system::durable;
use crate::system::layout::{DataDir, VersionDir};
use crate::system::task_user::{TaskUser, TaskUserError};
use crate::task::effects::{Effects, Now};
use crate::task::ledger::{GateQuestion, Ledger, LedgerError, OutputUpload};
use crate::task::observed::{
    Exit, Health, Prepared, ProcessState, RobotFacts, SignatureVerdict, TrustFacts,
};
use crate::task::plan::{Done, StepFailure};
use crate::task::run::{ActiveRun, ProcessRecord};
use crate::telemetry::outputs::{self, OutputSpec, Registry};
use crate::transfer::parts::PartRequest;
use crate::transfer::parts::PartSubscriptions;

mod graph;
mod outcomes;
mod resolved;
mod ros;
mod runs;
mod signers;
mod task_environment;
mod trees;

/// The marker file in a version's directory after its build.
const BUILT_MARKER: &str = "built";
/// The copy of the ledger's run record in a run's directory, written before the start in case the
/// ledger is lost.
const RUN_RECORD: &str = "run.json";
/// How much of the end of a log goes into a failure's text, without its times.
const TAIL_BYTES: u64 = 3072;

pub struct Robot {
    data: DataDir,
    fetcher: Arc<Fetcher>,
    /// The signature policy of a robot that requires more than its server's word.
    signature_policy: Option<Arc<SignaturePolicy>>,
    part_subscriptions: PartSubscriptions,
    gate: Option<Gate>,
    registry: Registry,
    robot: RobotId,
    /// The robot's name and labels at the server.
    description: RwLock<RobotDescription>,
    supervisor: Supervisor,
    watcher: Watcher,
    graph: GraphAccess,
    /// The last known ROS installations.
    ros: RwLock<Vec<Installation>>,
    /// The robot's own settings.
    own: Config,
    /// The effective settings: the robot's own combined with the server's.
    resolved: RwLock<Arc<ResolvedSettings>>,
    forward: watch::Sender<ForwardSettings>,
    cgroups: Option<Cgroups>,
    task_user: Result<Option<TaskUser>, TaskUserError>,
    /// Whether tasks and builds are denied system calls.
    filter_calls: bool,
    accounts: Accounts,
    mac: MacAddress,
}

impl Robot {
    /// The robot with its data in `data`.
    pub fn new(
        data: DataDir,
        (fetcher, part_subscriptions): (Fetcher, PartSubscriptions),
        registry: Registry,
        config: &Config,
        robot: &RobotId,
        mac: MacAddress,
    ) -> Self {
        let resolved = ResolvedSettings::of(config, RobotSettings::default());
        let cgroups = Cgroups::find();
        let task_user = TaskUser::find(config.task_user.as_deref());
        let user = task_user.as_ref().ok().and_then(Option::as_ref);
        let program = GraphProgram::of_this_agent(data.root(), cgroups.clone(), user);
        let graph = GraphAccess::of_robot(mac, data.clone(), program);
        graph.limit(config.limits.log_bytes);
        let fetcher = Arc::new(fetcher);
        let signature_policy = config.trust.clone().map(|settings| {
            let trust = Trust::open(settings, data.publishers());
            Arc::new(SignaturePolicy::new(trust, fetcher.clone(), data.clone()))
        });
        let task_user = TaskUser::find(config.task_user.as_deref())
            .and_then(|user| user.map(|user| user.check_access(data.root())).transpose());
        if let Err(error) = &task_user {
            tracing::warn!(%error, "tasks can't run");
        }
        let accounts_data = data.clone();
        let gate = config.gate.clone().map(|gate| Gate::new(gate, data.root()));
        Self {
            data,
            fetcher,
            signature_policy,
            part_subscriptions,
            gate,
            registry,
            robot: robot.clone(),
            description: RwLock::default(),
            watcher: Watcher::new(graph.clone(), Supervisor::of_this_program(cgroups.clone())),
            graph,
            supervisor: Supervisor::of_this_program(cgroups.clone()),
            cgroups,
            filter_calls: call_filter::is_wanted(config.seccomp, matches!(&task_user, Ok(Some(_)))),
            task_user,
            accounts: Accounts::new(accounts_data, config.task_uids.clone()),
            ros: RwLock::new(resolved.installations()),
            own: config.clone(),
            forward: watch::Sender::new(config.forward),
            resolved: RwLock::new(resolved),
            mac,
        }
    }

    fn version(&self, package: &PackageRef) -> VersionDir {
        self.data.task(&package.name).version(&package.manifest.digest)
    }

    /// The manifest on the disk, verified as if it came from the server.
    async fn manifest(&self, package: &PackageRef) -> Result<TaskManifest, StepFailure> {
        self.fetcher.manifest(package, &CancellationToken::new()).await.map_err(fetch_failure)
    }

    fn run_dir(&self, task: &TaskName, process: &ProcessRecord) -> PathBuf {
        self.data.task(task).run().join(&process.dir)
    }

    fn log(&self, task: &TaskName) -> LogSpec {
        let mut log = LogSpec::at(self.data.task(task).output_log());
        log.max_bytes = self.resolved().config.limits.log_bytes.unwrap_or(log.max_bytes);
        log
    }

    /// The version's promises about the ROS graph; none if its manifest is gone.
    fn promise(&self, package: &PackageRef) -> Promise {
        fetch::stored_manifest(&self.data, package)
            .map_or_else(Promise::default, |manifest| Promise::of(&manifest))
    }

    /// The resource limits of the task: from its package, else from this robot's settings.
    fn limits(&self, manifest: &TaskManifest) -> RunLimits {
        let limits = &manifest.limits;
        let settings = self.resolved().task_limits;
        RunLimits {
            memory_bytes: limits
                .memory_mb
                .map(|megabytes| megabytes << 20)
                .or(settings.memory_bytes),
            cpu_weight: limits.cpu_weight,
            pids: limits.pids.map(u64::from).or(settings.pids),
            filter_calls: self.filter_calls,
        }
    }
}

impl Effects for Robot {
    fn now(&self) -> Now {
        Now { boot_ms: clock::boot_ms(), wall_ms: clock::wall_ms() }
    }

    fn write_ledger(&self, ledger: &Ledger) -> Result<(), LedgerError> {
        ledger.write(&self.data.ledger())
    }

    fn is_held(&self) -> bool {
        self.data.root().join(crate::system::layout::HOLD_FILE).exists()
    }

    fn is_gated(&self) -> bool {
        self.gate.is_some()
    }

    fn robot_facts(&self) -> RobotFacts {
        let installations = Some(self.installations());
        let no_task_user = self.task_user.as_ref().err().map(TaskUserError::to_string);
        RobotFacts {
            arch: std::env::consts::ARCH.to_owned(),
            labels: None,
            installations,
            no_task_user,
        }
    }

    async fn probe_ros(&self) {
        self.probe_installations().await;
    }

    fn host_facts(&self) -> HostFacts {
        let installations = self.installations();
        let resolved = self.resolved();
        let isolates = self.cgroups.as_ref().is_some_and(Cgroups::isolates);
        HostFacts {
            agent_version: env!("CARGO_PKG_VERSION").to_owned(),
            hostname: std::fs::read_to_string("/proc/sys/kernel/hostname")
                .unwrap_or_default()
                .trim()
                .to_owned(),
            arch: std::env::consts::ARCH.to_owned(),
            mac: Some(self.mac),
            ros_distros: installation::all_distros(&installations),
            disk_free_bytes: disk::space(self.data.root()).map_or(0, |room| room.free),
            ros: environment::ros_facts(&installations, &resolved.environment),
            battery_percent: battery::percent(Path::new(battery::SUPPLIES)),
            isolation: if isolates { Isolation::Cgroup } else { Isolation::None },
            accounts: self.task_user.as_ref().ok().map(|user| match user {
                Some(_) if self.accounts.are_per_task() => TaskAccounts::PerTask,
                Some(_) => TaskAccounts::Shared,
                None => TaskAccounts::Agent,
            }),
            publishers: self
                .signature_policy
                .as_ref()
                .map(|signature_policy| signature_policy.version()),
            settings: resolved.effective.clone(),
        }
    }

    async fn survivors(&self) -> Vec<(TaskName, ActiveRun)> {
        let mut survivors = Vec::new();
        for task in self.data.task_names().unwrap_or_default() {
            let mut last = None;
            for entry in
                std::fs::read_dir(self.data.task(&task).run()).into_iter().flatten().flatten()
            {
                let record = std::fs::read(entry.path().join(RUN_RECORD)).ok();
                let Some(run) =
                    record.and_then(|bytes| serde_json::from_slice::<ActiveRun>(&bytes).ok())
                else {
                    continue;
                };
                match self.supervisor.observe(&entry.path()).await {
                    Ok(RunState::Running { .. }) => last = Some((true, run)),
                    Ok(RunState::Exited(_) | RunState::OutOfMemory { .. } | RunState::Gone)
                        if !matches!(last, Some((true, _))) =>
                    {
                        last = Some((false, run));
                    }
                    _ => {}
                }
            }
            survivors.extend(last.map(|(_, run)| (task, run)));
        }
        survivors
    }

    async fn prepared(&self, package: &PackageRef) -> Prepared {
        let task = self.data.task(&package.name);
        let version = self.version(package);
        let manifest = fetch::stored_manifest(&self.data, package);
        Prepared {
            content: version.src().is_dir(),
            built: manifest
                .as_ref()
                .is_some_and(|manifest| trees::is_built(&version, manifest.build.tool)),
            manifest,
            versions: task.versions().unwrap_or_default(),
            signatures: self
                .signature_policy
                .as_ref()
                .map_or(SignatureVerdict::Sufficient, |signature_policy| {
                    signature_policy.verdict(package)
                }),
        }
    }

    async fn process(&self, task: &TaskName, process: &ProcessRecord) -> ProcessState {
        let exit = |status, out_of_memory_bytes| {
            let last_lines = logs::last_lines(&self.log(task).path, TAIL_BYTES);
            ProcessState::Ended(Exit { status, out_of_memory_bytes, last_lines })
        };
        // A start that hangs must not keep the caller waiting: the caller asks again.
        match self.supervisor.observe_within(&self.run_dir(task, process), Duration::ZERO).await {
            Ok(RunState::NeverStarted) => ProcessState::NeverStarted,
            Ok(RunState::Running { pid, .. }) => ProcessState::Alive { pid },
            Ok(RunState::Exited(status)) => exit(Some(status), None),
            Ok(RunState::OutOfMemory { limit_bytes }) => {
                exit(Some(ExitStatus::Signal(9)), Some(limit_bytes))
            }
            Ok(RunState::Gone) => exit(None, None),
            Err(error) if error.is_malformed() && runs::is_from_earlier_boot(process) => {
                exit(None, None)
            }
            Err(error) => {
                tracing::error!(%task, error = %chain(&error), "cannot determine the state of the process");
                ProcessState::Unknown
            }
        }
    }

    async fn process_ended(&self, task: &TaskName, process: &ProcessRecord) {
        if let Err(error) = self.supervisor.wait(&self.run_dir(task, process)).await {
            tracing::error!(%task, error = %chain(&error), "cannot watch the process");
        }
    }

    fn watch(&self, task: &TaskName, run: &ActiveRun) -> watch::Receiver<Health> {
        let watched = run.process().map(|process| WatchedRun {
            dir: self.run_dir(task, process),
            started_ms: process.started_ms,
            was_ready: run.is_ready(),
        });
        let watched = watched.unwrap_or_default();
        let facts = self.ros_facts_of(&watched.dir);
        self.open_graph(&run.package, facts.as_ref());
        self.watcher.watch(watched, self.promise(&run.package), facts)
    }

    fn parallel_tasks(&self) -> usize {
        self.resolved().config.parallel_tasks
    }

    fn apply_state(&self, state: &DesiredState) {
        self.adopt(&state.settings);
        self.describe(&state.robot);
        self.signature_policy
            .iter()
            .for_each(|signature_policy| signature_policy.follow_evidence(state));
    }

    fn trust_facts(&self) -> TrustFacts {
        self.signature_policy
            .as_ref()
            .map(|signature_policy| signature_policy.facts())
            .unwrap_or_default()
    }

    async fn check_signers(
        &self,
        package: &PackageRef,
        cancel: &CancellationToken,
    ) -> Result<(), StepFailure> {
        self.check_signatures(package, PackageUse::New, cancel).await
    }

    fn retain_parts(&self, wanted: &[Digest]) {
        if let Err(error) = self.data.clean_parts(wanted) {
            tracing::warn!(%error, "cannot remove the parts of packages that are no longer ordered");
        }
    }

    async fn pull_manifest(
        &self,
        package: &PackageRef,
        cancel: &CancellationToken,
    ) -> Result<Done, StepFailure> {
        self.recheck_signatures(package)?;
        pull_outcome(self.fetcher.manifest(package, cancel).await.map(drop))
    }

    fn offer(&self, blobs: Vec<(BlobRef, Bytes)>) {
        self.fetcher.add_inline_blobs(blobs);
    }

    async fn pull_content(
        &self,
        package: &PackageRef,
        progress: &watch::Sender<Progress>,
        cancel: &CancellationToken,
    ) -> Result<Done, StepFailure> {
        self.recheck_signatures(package)?;
        let manifest = match self.fetcher.manifest(package, cancel).await {
            Ok(manifest) => manifest,
            Err(error) => return pull_outcome(Err(error)),
        };
        let done = pull_outcome(self.fetcher.content(package, &manifest, progress, cancel).await)?;
        self.seal_pulled(package, &manifest, done).await
    }

    async fn gather_content(
        &self,
        package: &PackageRef,
        progress: &watch::Sender<Progress>,
        part_requests: &watch::Sender<PartRequest>,
        cancel: &CancellationToken,
    ) -> Result<Done, StepFailure> {
        self.recheck_signatures(package)?;
        let manifest = match self.fetcher.manifest(package, cancel).await {
            Ok(manifest) => manifest,
            Err(error) => return pull_outcome(Err(error)),
        };
        let told = (progress, part_requests);
        let done = pull_outcome(
            self.fetcher
                .pushed_content(package, &manifest, &self.part_subscriptions, told, cancel)
                .await,
        )?;
        self.seal_pulled(package, &manifest, done).await
    }

    async fn build(
        &self,
        package: &PackageRef,
        deployment: &DeploymentId,
        cancel: &CancellationToken,
    ) -> Result<(), StepFailure> {
        self.recheck_signatures(package)?;
        let manifest = self.manifest(package).await?;
        let version = self.version(package);
        let tool = manifest.build.tool;
        self.verify(package, tool, Purpose::Build).await?;
        let user = self.accounts_of(&package.name)?.map(|pair| pair.build);
        let home = self.data.task(&package.name).build_home();
        let environment = self.environment_of(package, deployment, user.as_ref(), &home)?;
        let spec = BuildSpec {
            tool,
            underlays: self.setup_files(&manifest)?,
            environment,
            log: self.data.task(&package.name).build_log(),
            limits: BuildLimits { filter_calls: self.filter_calls, ..self.resolved().build_limits },
            version: version.clone(),
            user,
            cgroups: self.cgroups.clone(),
        };
        builder::build(&spec, cancel)
            .await
            .map_err(|error| build_failure(error, self.data.root()))?;
        self.seal(package, tool).await?;
        let marker = version.root().join(BUILT_MARKER);
        durable::write(&marker, b"", 0o600).map_err(|source| {
            let error = FetchError::disk(&marker, source);
            fetch_failure(error.or_disk_full(self.data.root(), Need::of_file(0)))
        })
    }

    async fn query_gate(
        &self,
        task: &TaskName,
        question: &GateQuestion,
    ) -> Result<(), StepFailure> {
        let Some(gate) = &self.gate else { return Ok(()) };
        let answer = gate.query(task, question, &self.robot_environment()).await;
        answer.map_err(|failure| StepFailure { failure, retry_after_ms: Some(0) })
    }

    async fn start(&self, task: &TaskName, run: &ActiveRun) -> Result<u32, StepFailure> {
        let failed = |error: &dyn Error| retryable_failure(FailureCode::START_FAILED, error, 0);
        let Some(process) = run.process() else {
            return Err(failed(&std::io::Error::other("the ledger names no process to start")));
        };
        // A version that was staged long ago may have waited for a person or the gate until its
        // publishers' list expired.
        let purpose = if run.has_started() { PackageUse::Restart } else { PackageUse::New };
        self.check_signatures(&run.package, purpose, &CancellationToken::new()).await?;
        let manifest = self.manifest(&run.package).await?;
        let version = self.version(&run.package);
        let tool = manifest.build.tool;
        let text = script::run_script(&manifest, &version, &self.setup_files_of(run, &manifest)?);
        let task_dir = self.data.task(task);
        let run_dir = self.run_dir(task, process);
        // Leftover processes of the run could change the files that are verified below.
        self.end_other_runs(&task_dir.run(), Some(&run_dir))
            .await
            .map_err(|error| failed(&error))?;
        self.verify(&run.package, tool, Purpose::Start).await?;
        let user = self.accounts_of(task)?.map(|pair| pair.run);
        let mut environment =
            self.environment_of(&run.package, &run.deployment, user.as_ref(), &task_dir.home())?;
        environment.extend(environment::graph_variables(&manifest.run.env));
        self.make_work_dir(&run.package, tool, user.clone()).await?;
        environment.extend(ros::node_logs(&version, user.as_ref()).await);
        durable::write(&version.run_script(), text.as_bytes(), 0o755)
            .map_err(|error| failed(&error))?;
        task_dir.set_current(&run.package.manifest.digest).map_err(|error| failed(&error))?;
        durable::create_dir_all(&task_dir.logs()).map_err(|error| failed(&error))?;
        let spec = RunSpec {
            assignment: run.deployment.clone(),
            script: version.run_script(),
            directory: version.work(),
            environment,
            interrupt: launch::of(&manifest).interrupt,
            log: self.log(task),
            limits: self.limits(&manifest),
            user,
            has_outputs: run.rules.has_outputs,
            cgroup: None,
        };
        let record = serde_json::to_vec(run).map_err(|error| failed(&error))?;
        durable::create_dir_all(&run_dir).map_err(|error| failed(&error))?;
        durable::write(&run_dir.join(RUN_RECORD), &record, 0o600)
            .map_err(|error| failed(&error))?;
        let facts = self.ros_facts_in(&spec.environment);
        let promise = Promise::of(&manifest);
        if let Some(what) =
            environment::unsupported_discovery(&spec.environment).filter(|_| !promise.is_empty())
        {
            let text = format!(
                "nodes on this robot use {what}, which the agent does not support: [ready] can't be checked"
            );
            let failure = Failure::new(FailureCode::GRAPH_UNAVAILABLE, text);
            return Err(StepFailure { failure, retry_after_ms: None });
        }
        self.watcher.before_start(&promise, facts.as_ref()).await.map_err(|failure| {
            // The owner of a conflicting name may go away, so a run that was ready before waits for
            // that. An obstacle to the graph may also pass.
            let may_pass = run.was_ever_ready()
                || (failure.code == FailureCode::GRAPH_UNAVAILABLE && facts.is_some());
            StepFailure { failure, retry_after_ms: may_pass.then_some(0) }
        })?;
        let started = self.supervisor.start(&run_dir, &spec).await;
        if matches!(started, Err(SupervisorError::NoAnswer))
            && let Err(error) = self.supervisor.stop(&run_dir, Duration::ZERO).await
        {
            // The process stays in the ledger until it is seen to be gone.
            tracing::warn!(%task, error = %chain(&error), "cannot end a process that may have been started");
        }
        let pid = started.map_err(|error| failed(&error))?.task.pid;
        // Leftovers of earlier runs have no further use. If they cannot be deleted, the task still
        // runs.
        if let Err(error) = self.delete_runs(&task_dir.run(), Some(&run_dir)).await {
            tracing::warn!(%task, failure = %error.failure, "cannot delete the leftovers of ended runs");
        }
        Ok(pid)
    }

    async fn stop(&self, task: &TaskName, run: &ActiveRun) -> Result<(), StepFailure> {
        let Some(process) = run.process() else { return Ok(()) };
        let grace = Duration::from_secs(u64::from(run.rules.stop_timeout_s));
        let dir = self.run_dir(task, process);
        let facts = self.ros_facts_of(&dir);
        self.watcher
            .shut_down_nodes(&dir, &self.promise(&run.package), facts.as_ref(), grace / 2)
            .await;
        let stopped = self.supervisor.stop(&dir, grace).await;
        stopped
            .map(drop)
            .map_err(|error: SupervisorError| retryable_failure(FailureCode::IO_ERROR, &error, 0))
    }

    async fn upload_outputs(
        &self,
        task: &TaskName,
        files: &OutputUpload,
        progress: &watch::Sender<Progress>,
        cancel: &CancellationToken,
    ) -> Result<(), StepFailure> {
        let manifest = self.manifest(&files.package).await?;
        let (directory, user) = self.output_directory(&files.package, manifest.build.tool)?;
        let spec = OutputSpec {
            robot_id: self.robot.clone(),
            task: task.clone(),
            version: files.package.version.clone(),
            deployment: files.deployment.clone(),
            run: files.run,
            directory,
            user,
            notes: self.data.task(task).uploads(),
            patterns: manifest.outputs.paths,
            max_bytes: self.resolved().output_bytes,
        };
        match outputs::upload(&self.registry, &spec, progress, cancel).await {
            Ok(count) => {
                tracing::info!(%task, run = files.run, count, "uploaded the output files");
                Ok(())
            }
            Err(error) => Err(StepFailure {
                retry_after_ms: error.retry_after().map(millis),
                failure: Failure::new(outputs_code(&error), chain(&error)),
            }),
        }
    }

    async fn prune(
        &self,
        task: &TaskName,
        kept: &[Digest],
        running: Option<&ProcessRecord>,
    ) -> Result<(), StepFailure> {
        let task = self.data.task(task);
        let kept = kept.to_vec();
        let running = running.map(|process| task.run().join(&process.dir));
        self.delete_runs(&task.run(), running.as_deref()).await?;
        blocking_io(move || task.prune(&kept)).await
    }

    async fn remove(&self, task: &TaskName) -> Result<(), StepFailure> {
        let dir = self.data.task(task);
        let ended = self.end_other_runs(&dir.run(), None).await;
        ended.map_err(|error| retryable_failure(FailureCode::IO_ERROR, &error, 0))?;
        blocking_io(move || dir.remove()).await?;
        self.accounts
            .release(task)
            .map_err(|error| retryable_failure(FailureCode::IO_ERROR, &error, 0))
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::install::fetch::FetchSettings;
    use crate::process::cgroup::RunLimits;
    use crate::process::run_dir::RunDir;
    use crate::setup::launch::Interrupt;

    /// A robot with its data in `dir` and its own settings from `file`, without a server.
    pub(super) fn robot(dir: &Path, file: &str) -> Robot {
        std::fs::write(dir.join(crate::config::FILE_NAME), file).expect("written");
        let config = Config::load(dir, std::iter::empty()).expect("loads");
        let data = DataDir::new(dir).expect("a data directory");
        let tls = task_transport::Trust::by(None).client_config(clock::for_certificates());
        let client = crate::transfer::server::client(tls).expect("a client");
        let server: reqwest::Url = "http://127.0.0.1:9/".parse().expect("a URL");
        let fetcher = Fetcher::new(
            client.clone(),
            server.clone(),
            "tskr_x".to_owned(),
            data.clone(),
            FetchSettings::default(),
        );
        let registry = Registry::new(client, server, "tskr_x".to_owned());
        let mac = "02:00:00:00:00:01".parse().expect("an address");
        Robot::new(
            data,
            (fetcher, PartSubscriptions::default()),
            registry,
            &config,
            &RobotId::random(),
            mac,
        )
    }

    /// The directory of a run in that environment. Only the run's specification has been written.
    pub(super) fn run_dir(path: &Path, environment: BTreeMap<String, String>) -> RunDir {
        let run = RunDir::create(path).expect("made");
        let spec = RunSpec {
            assignment: DeploymentId::random(),
            script: "run.sh".into(),
            directory: "/".into(),
            environment,
            interrupt: Interrupt::default(),
            log: LogSpec::at("log".into()),
            limits: RunLimits::default(),
            user: None,
            has_outputs: false,
            cgroup: None,
        };
        run.write_spec(&spec).expect("written");
        run
    }
}
