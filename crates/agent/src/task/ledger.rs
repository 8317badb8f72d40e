//! The ledger holds the accepted desired state, the steps under way and the started processes. The
//! agent writes the ledger before each step, so that after kill -9 or a power cut the next agent
//! continues from there. Ledger types are neither wire types nor observations. Times are
//! [`crate::system::clock`]'s milliseconds since boot and are valid only in the boot that they
//! name. The ledger decides nothing: decisions are the plan's work.

use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use task_proto::desired::{Delivery, DesiredTask, PackageRef, Wanted};
use task_proto::envelope::Envelope;
use task_proto::manifest::{OnBoot, TaskKind};
use task_proto::report::{Failure, FailureCode, Phase};
use task_proto::{DeploymentId, Digest, Generation, TaskName};

use crate::system::durable;

mod asked;
mod rules;

pub use asked::{GateAnswer, GateQuestion, GateRecord, GateStep};
pub use rules::RunRules;

/// A run that is restarted more often than this without a calm stretch has failed. At the longest
/// backoff that takes over an hour: enough time to plug a sensor in again.
pub const MAX_RESTARTS_IN_A_ROW: u32 = 100;

/// The version of the file's format that this agent reads and writes.
pub const FORMAT: u32 = 1;
/// The largest file that is read as a ledger.
const MAX_BYTES: u64 = 64 * 1024 * 1024;
/// The maximum number of finished runs remembered per task.
const MAX_FINISHED: usize = 32;

/// The agent's persistent state.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Ledger {
    pub format: u32,
    /// How many times the agent has been started.
    pub start: u64,
    /// The boot that all times in the ledger refer to.
    pub boot_id: String,
    /// The last desired state that was accepted.
    pub accepted: Option<Accepted>,
    /// The server does not accept this robot's token: it was removed or revoked there.
    pub removed: bool,
    /// The server's reason for the removal; empty if unknown.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub removed_because: String,
    /// The tasks on this robot.
    pub tasks: BTreeMap<TaskName, TaskRecord>,
}

/// A desired state that was verified and accepted. The signed envelope is kept and verified again
/// at each start.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Accepted {
    /// The generation of the state.
    pub generation: Generation,
    pub envelope: Envelope,
}

/// The state of one task.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TaskRecord {
    /// The task as last requested by the desired state.
    pub order: DesiredTask,
    /// The progress of the ordered version up to its start.
    pub preparation: Preparation,
    /// The run that is kept alive: of the ordered version or, until that is staged, of the previous
    /// version.
    pub active: Option<ActiveRun>,
    /// The run that comes back if the active run, which replaced it, does not become ready.
    #[serde(default)]
    pub fallback: Option<ActiveRun>,
    /// The version that was active before.
    pub previous: Option<PackageRef>,
    /// Runs that have ended for good, the oldest first. They keep an order that comes back from
    /// running twice.
    pub finished: Vec<FinishedRun>,
    /// Ended runs with output files to upload, the oldest first.
    #[serde(default)]
    pub collections: Vec<Collection>,
    /// The last run with lost output files.
    #[serde(default)]
    pub lost: Option<LostFiles>,
    /// The current question to the robot's gate about this task, and its answer.
    #[serde(default)]
    pub gate: Option<GateRecord>,
    /// The number of process starts of this task.
    #[serde(default)]
    pub starts: u64,
    /// The phase as last reported.
    pub phase: Phase,
    /// The time at which the task entered `phase`.
    pub phase_since_ms: u64,
}

/// The progress of a version on its way to be started.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Preparation {
    /// `assigned` to `staged`, `deferred`, or one of the ends `failed` and `unmet`.
    pub phase: Phase,
    /// The number of attempts in that phase.
    pub attempts: u32,
    /// No attempt before this time.
    pub retry_at_ms: u64,
    /// Why the preparation failed, is unmet or waits.
    pub failure: Option<Failure>,
    /// Service or job; known once the manifest is there.
    pub kind: Option<TaskKind>,
}

/// A run of one version, alive or meant to be.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ActiveRun {
    /// The deployment that ordered the run.
    pub deployment: DeploymentId,
    /// The run number within the deployment.
    pub run: u64,
    /// The package that runs.
    pub package: PackageRef,
    /// The rules of the run, from its manifest.
    pub rules: RunRules,
    /// The last started process that is not known to have ended.
    pub process: Option<ProcessRecord>,
    /// The number of starts by the restart policy.
    pub restarts: u32,
    /// The number of restarts since the last calm stretch.
    pub restarts_in_a_row: u32,
    /// No start before this time.
    pub retry_at_ms: u64,
    /// When the first process of this boot was started.
    pub first_start_ms: u64,
    /// Whether a process of this run was ever ready.
    pub ever_ready: bool,
    /// Whether a process was started in this boot, so that the robot's gate need not be asked
    /// again.
    #[serde(default)]
    pub admitted: bool,
    /// Whether a process was ever started, so that a start continues the run rather than begins it.
    #[serde(default)]
    pub ever_started: bool,
    /// Set once the run is over for good.
    pub end: Option<End>,
}

/// A process that was started or was about to be started.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ProcessRecord {
    /// The name of the run directory; each start has its own directory.
    pub dir: String,
    /// The boot in which the process was started.
    pub boot_id: String,
    /// Milliseconds since boot at the start.
    pub started_ms: u64,
    /// The process id, once known.
    pub pid: Option<u32>,
    /// Whether the process has become ready.
    pub ready: bool,
    /// Set once the process is to be stopped because of a failure.
    #[serde(default)]
    pub condemned: Option<Condemned>,
}

/// Why a process is stopped although the order wants the run to continue.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Condemned {
    /// The failure of the process.
    pub failure: Failure,
    /// Whether the restart policy may start another process.
    pub again: bool,
}

/// A run that is over.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct FinishedRun {
    /// The deployment that ordered the run.
    pub deployment: DeploymentId,
    /// The run number within the deployment.
    pub run: u64,
    /// The outcome of the run.
    pub end: End,
}

/// The outcome of a run.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct End {
    pub phase: Phase,
    /// The reason, if the run did not succeed.
    pub failure: Option<Failure>,
}

/// An ended run with output files to upload.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Collection {
    /// The deployment that ordered the run.
    pub deployment: DeploymentId,
    /// The run number within the deployment.
    pub run: u64,
    /// The package that ran.
    pub package: PackageRef,
    pub kind: TaskKind,
    /// When the run ended, or when this boot began.
    pub since_ms: u64,
    /// The number of failed attempts.
    pub attempts: u32,
    /// No attempt before this time.
    pub retry_at_ms: u64,
    /// Why the last attempt failed.
    pub failure: Option<Failure>,
}

/// A run with lost output files.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct LostFiles {
    /// The deployment that ordered the run.
    pub deployment: DeploymentId,
    /// The run number within the deployment.
    pub run: u64,
    /// Why the files were lost.
    pub failure: Failure,
}

/// The ledger could not be written or read.
#[derive(Debug, thiserror::Error)]
#[error("cannot use the ledger {path}")]
pub struct LedgerError {
    path: PathBuf,
    source: io::Error,
}

/// The result of reading the ledger file.
#[derive(Debug)]
pub enum Found {
    Ledger(Box<Ledger>),
    /// No file: a first start.
    Nothing,
    /// A file that is not a ledger of this format. The file was moved to this path, with all its
    /// content.
    Unreadable(PathBuf),
}

impl Ledger {
    /// A new ledger, for a robot that was never started or after the loss of its ledger. A start
    /// counter above all earlier counters makes the server treat this agent's reports as newer than
    /// those before the loss.
    pub fn new(start: u64) -> Self {
        Self {
            format: FORMAT,
            start,
            boot_id: String::new(),
            accepted: None,
            removed: false,
            removed_because: String::new(),
            tasks: BTreeMap::new(),
        }
    }

    /// The message for people while the server does not accept the robot's token.
    pub fn removal(&self) -> Option<String> {
        let because = match self.removed_because.as_str() {
            "" => String::new(),
            because => format!(" ({because})"),
        };
        let text = || {
            format!("the server does not accept this robot's token{because}: nothing new is begun")
        };
        self.removed.then(text)
    }

    /// Reads the ledger at `path`. An unreadable ledger is moved aside, not deleted.
    pub fn read(path: &Path) -> Result<Found, LedgerError> {
        let failed = |source| LedgerError { path: path.to_owned(), source };
        let bytes = match read_limited(path) {
            Ok(bytes) => bytes,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Found::Nothing),
            Err(error) => return Err(failed(error)),
        };
        match serde_json::from_slice::<Self>(&bytes) {
            Ok(ledger) if ledger.format == FORMAT => Ok(Found::Ledger(Box::new(ledger))),
            _ => {
                let aside = free_name_beside(path);
                durable::rename(path, &aside).map_err(failed)?;
                Ok(Found::Unreadable(aside))
            }
        }
    }

    /// Reads the ledger without changing anything, for `status`.
    pub fn peek(path: &Path) -> Result<Option<Self>, LedgerError> {
        let failed = |source| LedgerError { path: path.to_owned(), source };
        match read_limited(path) {
            Ok(bytes) => {
                serde_json::from_slice(&bytes).map(Some).map_err(|error| failed(error.into()))
            }
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(failed(error)),
        }
    }

    /// Writes the ledger so that it survives a power cut.
    pub fn write(&self, path: &Path) -> Result<(), LedgerError> {
        let failed = |source| LedgerError { path: path.to_owned(), source };
        let bytes = serde_json::to_vec(self).map_err(|error| failed(error.into()))?;
        durable::write(path, &bytes, 0o600).map_err(failed)
    }

    /// Clears the parts of the records that are meaningless to a new agent and, in a new boot, the
    /// times of the previous boot.
    pub fn enter_boot(&mut self, boot_id: &str, now_ms: u64) {
        for record in self.tasks.values_mut() {
            // The robot may have taken on a load since its gate allowed the step.
            record.gate.take_if(|gate| gate.answer == Some(GateAnswer::Allowed));
        }
        if self.boot_id == boot_id {
            return;
        }
        self.boot_id = boot_id.to_owned();
        for record in self.tasks.values_mut() {
            record.phase_since_ms = now_ms;
            record.preparation.retry_at_ms = 0;
            if let Some(gate) = &mut record.gate {
                gate.retry_at_ms = 0;
            }
            for collection in &mut record.collections {
                (collection.since_ms, collection.retry_at_ms) = (now_ms, 0);
            }
            // A resource that was missing when the run was given up may be there again.
            if let Some(active) = record.active.as_mut().filter(|active| active.is_worn_out()) {
                active.end = None;
            }
            for run in [&mut record.active, &mut record.fallback].into_iter().flatten() {
                (run.retry_at_ms, run.first_start_ms, run.admitted) = (0, now_ms, false);
                run.restarts_in_a_row = 0;
            }
        }
    }
}

fn read_limited(path: &Path) -> io::Result<Vec<u8>> {
    use std::io::Read as _;
    let mut bytes = Vec::new();
    std::fs::File::open(path)?.take(MAX_BYTES).read_to_end(&mut bytes)?;
    Ok(bytes)
}

/// The first of `ledger.json.broken-1`, `-2`, … that does not exist; the ninth is used again.
fn free_name_beside(path: &Path) -> PathBuf {
    let name = |n: u32| PathBuf::from(format!("{}.broken-{n}", path.display()));
    (1..9).map(name).find(|candidate| !candidate.exists()).unwrap_or_else(|| name(9))
}

impl Preparation {
    /// Whether the version is still being prepared. A version that has run before may be prepared
    /// anew.
    pub fn is_under_way(&self) -> bool {
        matches!(self.phase, Phase::Fetching | Phase::Building)
    }
}

impl TaskRecord {
    /// The record of a new order.
    pub fn new(order: DesiredTask, now_ms: u64) -> Self {
        let mut record = Self {
            order,
            preparation: Preparation::default(),
            active: None,
            fallback: None,
            previous: None,
            finished: Vec::new(),
            collections: Vec::new(),
            lost: None,
            gate: None,
            starts: 0,
            phase: Phase::Assigned,
            phase_since_ms: now_ms,
        };
        record.settle_phase(now_ms);
        record
    }

    /// The record of a run that was found after the ledger was lost. The run counts as ordered
    /// until the server has sent the desired state.
    pub fn of_survivor(task: TaskName, run: ActiveRun, now_ms: u64) -> Self {
        let order = DesiredTask {
            task,
            deployment: run.deployment.clone(),
            package: run.package.clone(),
            wanted: Wanted::Running,
            run: run.run,
            delivery: Delivery::default(),
            priority: 0,
        };
        let mut record = Self::new(order, now_ms);
        record.active = Some(ActiveRun { ever_started: true, ..run });
        record.settle_phase(now_ms);
        record
    }

    /// How the ordered run ended, if it has ended: either now, or before the order came back.
    pub fn end_of_order(&self) -> Option<&End> {
        if let Some(active) = self.active.as_ref().filter(|active| active.is_for(&self.order)) {
            return active.end.as_ref();
        }
        let same = |run: &&FinishedRun| {
            run.deployment == self.order.deployment && run.run == self.order.run
        };
        self.finished.iter().rev().find(same).map(|run| &run.end)
    }

    /// The phase of the order, and the failure behind it.
    pub fn standing(&self) -> (Phase, Option<&Failure>) {
        let active = self.active.as_ref().filter(|active| active.is_for(&self.order));
        if self.order.wanted == Wanted::Stopped
            && self.active.as_ref().is_none_or(|active| active.process.is_none())
        {
            return (Phase::Stopped, None);
        }
        if let Some((_, refusal)) =
            self.refusal().filter(|(question, _)| self.concerns_order(question))
        {
            return (Phase::Deferred, Some(refusal));
        }
        if self
            .collections
            .iter()
            .any(|files| files.kind == TaskKind::Job && files.is_for(&self.order))
        {
            return (Phase::Running, None);
        }
        if let Some(end) = self.end_of_order() {
            return (end.phase, end.failure.as_ref());
        }
        match active {
            Some(active) if active.process.as_ref().is_some_and(|process| process.ready) => {
                (Phase::Running, None)
            }
            Some(active) if active.process.is_none() && self.preparation.is_under_way() => {
                (self.preparation.phase, self.preparation.failure.as_ref())
            }
            Some(_) => (Phase::Starting, None),
            None => (self.preparation.phase, self.preparation.failure.as_ref()),
        }
    }

    /// The question that the robot's gate refused, and the reason.
    pub fn refusal(&self) -> Option<(&GateQuestion, &Failure)> {
        match &self.gate {
            Some(GateRecord { question, answer: Some(GateAnswer::Refused(failure)), .. }) => {
                Some((question, failure))
            }
            _ => None,
        }
    }

    /// Whether the gate's answer to `question` affects the phase of the order, and not only the
    /// restart of an older run.
    pub fn concerns_order(&self, question: &GateQuestion) -> bool {
        let same = question.deployment == self.order.deployment && question.run == self.order.run;
        question.step == GateStep::Stop || same
    }

    /// Brings the stored phase up to date after any change.
    pub fn settle_phase(&mut self, now_ms: u64) {
        let phase = self.standing().0;
        if phase != self.phase {
            self.phase = phase;
            self.phase_since_ms = now_ms;
        }
    }

    /// Makes room for `successor`. Remembers the active run's end and version and, if the run was
    /// good and does not come back anyway, the run itself.
    pub fn retire_active(&mut self, successor: &ActiveRun) {
        let is_good = |run: &&mut ActiveRun| {
            run.ever_ready && run.end.is_none() && run.rules.kind == TaskKind::Service
        };
        if let Some(good) = self.active.as_mut().filter(is_good) {
            (good.process, good.retry_at_ms, good.restarts_in_a_row) = (None, 0, 0);
            self.fallback.clone_from(&self.active);
        }
        self.lay_down_active(&successor.package);
        // A failed job stays failed: starting another version cannot undo its effects.
        let is_job = successor.rules.kind == TaskKind::Job;
        self.fallback.take_if(|fallback| is_job || fallback.package == successor.package);
        if let Some(fallback) = &self.fallback {
            self.previous = Some(fallback.package.clone());
        }
    }

    /// A run that the operator had stopped neither starts nor comes back in place of the new order.
    pub fn forget_stopped(&mut self, next: &DesiredTask, now_ms: u64) {
        self.fallback = None;
        match &mut self.active {
            Some(active) if active.is_for(next) => {
                (active.ever_ready, active.first_start_ms) = (false, now_ms)
            }
            _ => self.lay_down_active(&next.package),
        }
    }

    /// Removes the active run and remembers its end. Its version is remembered as well, unless
    /// `next` is the same version.
    fn lay_down_active(&mut self, next: &PackageRef) {
        let Some(active) = self.active.take() else { return };
        if active.package != *next {
            self.previous = Some(active.package);
        }
        if let Some(end) = active.end {
            self.finish(active.deployment, active.run, end);
        }
    }

    /// Remembers the outcome of a run.
    pub fn finish(&mut self, deployment: DeploymentId, run: u64, end: End) {
        self.finished.retain(|other| other.deployment != deployment || other.run != run);
        self.finished.push(FinishedRun { deployment, run, end });
        let surplus = self.finished.len().saturating_sub(MAX_FINISHED);
        self.finished.drain(..surplus);
    }

    /// The versions that must stay on disk: the ordered, the active and the fallback version. The
    /// previous version stays only while there is room for the ordered one: it merely spares a
    /// later rollback the fetch.
    pub fn kept_versions(&self) -> Vec<Digest> {
        let lacks_room = self
            .preparation
            .failure
            .as_ref()
            .is_some_and(|failure| failure.code == FailureCode::DISK_FULL);
        let previous = self.previous.iter().filter(|_| !lacks_room);
        let runs = [&self.active, &self.fallback].into_iter().flatten().map(|run| &run.package);
        let files = self.collections.iter().map(|files| &files.package);
        let mut kept: Vec<Digest> =
            runs.chain(files).chain([&self.order.package]).chain(previous).map(digest_of).collect();
        kept.sort();
        kept.dedup();
        kept
    }
}

fn digest_of(package: &PackageRef) -> Digest {
    package.manifest.digest
}

impl ActiveRun {
    /// Whether this is the run that `order` asks for.
    pub fn is_for(&self, order: &DesiredTask) -> bool {
        self.deployment == order.deployment
            && self.run == order.run
            && self.package == order.package
    }

    /// Whether the run was good and was given up only because of too many restarts in one boot.
    fn is_worn_out(&self) -> bool {
        let is_up_at_boot =
            self.rules.kind == TaskKind::Service && self.rules.on_boot == OnBoot::Start;
        self.end.is_some()
            && self.ever_ready
            && is_up_at_boot
            && self.restarts_in_a_row >= MAX_RESTARTS_IN_A_ROW
    }

    /// Whether this is the same run, perhaps with another process.
    pub fn is_same(&self, other: &Self) -> bool {
        self.deployment == other.deployment && self.run == other.run
    }

    /// Whether a process of the run was started before. Earlier agents recorded only readiness.
    pub fn has_started(&self) -> bool {
        self.ever_started || self.ever_ready
    }
}

impl Collection {
    /// Whether these are files of the run that `order` asks for.
    pub fn is_for(&self, order: &DesiredTask) -> bool {
        self.deployment == order.deployment && self.run == order.run
    }
}

impl Default for Preparation {
    fn default() -> Self {
        Self { phase: Phase::Assigned, attempts: 0, retry_at_ms: 0, failure: None, kind: None }
    }
}

#[cfg(test)]
mod tests {
    use task_proto::desired::BlobRef;
    use task_proto::manifest::TaskManifest;

    use super::*;

    fn order() -> DesiredTask {
        let blob = BlobRef { digest: Digest::of(b"1"), size: 1 };
        let name: TaskName = "talker".parse().expect("valid");
        let version = "1.0".parse().expect("valid");
        DesiredTask {
            task: name.clone(),
            deployment: DeploymentId::random(),
            package: PackageRef { name, version, manifest: blob, config: blob, content: blob },
            wanted: Wanted::Running,
            run: 1,
            delivery: Delivery::PushPull,
            priority: 0,
        }
    }

    #[test]
    fn a_ledger_reads_back_and_survives_a_crash_while_it_is_written() {
        let dir = tempfile::tempdir().expect("a directory");
        let path = dir.path().join("ledger.json");
        assert!(matches!(Ledger::read(&path), Ok(Found::Nothing)));
        let mut ledger = Ledger::new(3);
        let order = order();
        ledger.tasks.insert(order.task.clone(), TaskRecord::new(order, 5));
        ledger.write(&path).expect("written");
        // The leftover of a crash half way through the next write.
        std::fs::write(dir.path().join("ledger.json.tmp"), "{\"format\":1,").expect("written");
        let Ok(Found::Ledger(read)) = Ledger::read(&path) else { panic!("the ledger is there") };
        assert_eq!(*read, ledger);
        ledger.write(&path).expect("written again");
    }

    #[test]
    fn a_ledger_that_is_cut_off_or_of_another_format_is_moved_aside() {
        let dir = tempfile::tempdir().expect("a directory");
        let path = dir.path().join("ledger.json");
        Ledger::new(3).write(&path).expect("written");
        let whole = std::fs::read(&path).expect("read");
        let newer =
            String::from_utf8(whole.clone()).expect("text").replace("\"format\":1", "\"format\":2");
        let cuts = (0..whole.len()).step_by(7).map(|length| whole[..length].to_vec());
        for bytes in cuts.chain([newer.into_bytes(), vec![0; 4096]]) {
            std::fs::write(&path, &bytes).expect("written");
            let Ok(Found::Unreadable(aside)) = Ledger::read(&path) else {
                panic!("taken for a ledger: {bytes:?}")
            };
            assert!(!path.exists());
            assert_eq!(std::fs::read(&aside).expect("kept"), bytes);
        }
    }

    #[test]
    fn a_ledger_of_an_agent_that_knew_no_rollback_is_read() {
        let mut ledger = Ledger::new(3);
        let order = order();
        let mut record = TaskRecord::new(order.clone(), 5);
        let manifest = serde_json::json!({
            "name": "talker", "version": "1.0", "run": {"exec": ["true"]},
            "content": {"tar_digest": Digest::of(b""), "tar_size": 0, "entries": 0},
        });
        let rules =
            RunRules::from(&serde_json::from_value::<TaskManifest>(manifest).expect("manifest"));
        record.active = Some(ActiveRun {
            process: Some(ProcessRecord {
                dir: "d.1.1.1".to_owned(),
                boot_id: "boot".to_owned(),
                started_ms: 1,
                pid: Some(7),
                ready: true,
                condemned: None,
            }),
            ..ActiveRun::of(&order, rules, 1)
        });
        ledger.tasks.insert(order.task.clone(), record);
        let mut old = serde_json::to_value(&ledger).expect("json");
        let task = &mut old["tasks"]["talker"];
        let mut drop = |at: &str, keys: &[&str]| {
            let table =
                task.pointer_mut(at).and_then(serde_json::Value::as_object_mut).expect("a table");
            keys.iter().for_each(|key| assert!(table.remove(*key).is_some(), "{at} has no {key}"));
        };
        drop("", &["fallback", "gate", "starts", "collections", "lost"]);
        drop("/active", &["admitted", "ever_started"]);
        drop("/active/process", &["condemned"]);
        drop("/active/rules", &["deadline_s", "has_outputs"]);
        assert_eq!(serde_json::from_value::<Ledger>(old).expect("read"), ledger);
    }

    #[test]
    fn the_version_before_makes_room_for_the_ordered_one() {
        let mut record = TaskRecord::new(order(), 1);
        let before = PackageRef {
            manifest: BlobRef { digest: Digest::of(b"before"), size: 1 },
            ..order().package
        };
        record.previous = Some(before.clone());
        assert!(record.kept_versions().contains(&before.manifest.digest));
        record.preparation.failure = Some(Failure::new(FailureCode::DISK_FULL, "the disk is full"));
        assert_eq!(record.kept_versions(), [order().package.manifest.digest]);
    }

    #[test]
    fn another_boot_takes_the_times_out() {
        let mut ledger = Ledger::new(1);
        let order = order();
        let mut record = TaskRecord::new(order.clone(), 900_000);
        record.preparation.retry_at_ms = 950_000;
        ledger.tasks.insert(order.task.clone(), record);
        ledger.enter_boot("second", 10);
        let record = &ledger.tasks[&order.task];
        assert_eq!((record.phase_since_ms, record.preparation.retry_at_ms), (10, 0));
    }

    #[test]
    fn a_good_service_that_was_given_up_is_tried_again_in_another_boot() {
        let order = order();
        let after_boot = |restarts_in_a_row, on_boot: &str| {
            let mut ledger = Ledger::new(1);
            let mut record = TaskRecord::new(order.clone(), 5);
            let manifest = serde_json::json!({
                "name": "talker", "version": "1.0", "run": {"exec": ["true"], "on_boot": on_boot},
                "content": {"tar_digest": Digest::of(b""), "tar_size": 0, "entries": 0},
            });
            let rules = RunRules::from(
                &serde_json::from_value::<TaskManifest>(manifest).expect("manifest"),
            );
            let end = Some(End { phase: Phase::Failed, failure: None });
            let run = ActiveRun::of(&order, rules, 1);
            record.active = Some(ActiveRun { end, ever_ready: true, restarts_in_a_row, ..run });
            ledger.tasks.insert(order.task.clone(), record);
            ledger.enter_boot("second", 10);
            let record = &ledger.tasks[&order.task];
            assert_eq!(
                record.active.as_ref().expect("active").restarts_in_a_row,
                0,
                "each boot has its own"
            );
            record.standing().0
        };
        assert_eq!(after_boot(MAX_RESTARTS_IN_A_ROW, "start"), Phase::Starting);
        assert_eq!(after_boot(MAX_RESTARTS_IN_A_ROW, "hold"), Phase::Failed);
        assert_eq!(
            after_boot(MAX_RESTARTS_IN_A_ROW - 1, "start"),
            Phase::Failed,
            "it has ended for something else"
        );
    }
}
