//! The ledger: what the agent accepted, what it was doing and what it started. Written before each
//! step, so that after kill -9 or a power cut the next agent goes on where this one was. Ledger
//! types are neither wire types nor what is observed; times are [`crate::system::clock`]'s
//! milliseconds since boot and mean something only in the boot they name. It decides nothing: that
//! is the plan's work.

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
/// backoff that is over an hour: enough for a sensor to be plugged in again.
pub const MAX_RESTARTS_IN_A_ROW: u32 = 100;

/// The version of the file's format that this agent reads and writes.
pub const FORMAT: u32 = 1;
/// The largest file that is read as a ledger.
const MAX_BYTES: u64 = 64 * 1024 * 1024;
/// The most finished runs remembered of one task.
const MAX_FINISHED: usize = 32;

/// Everything the agent must not forget.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Ledger {
    /// See [`FORMAT`].
    pub format: u32,
    /// How many times the agent has been started.
    pub start: u64,
    /// The boot in which the times below were taken.
    pub boot_id: String,
    /// The last desired state that was accepted.
    pub accepted: Option<Accepted>,
    /// The server does not accept this robot's token: it was removed or revoked there.
    pub removed: bool,
    /// The server's reason for that; empty if it is not known.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub removed_because: String,
    /// The tasks on this robot.
    pub tasks: BTreeMap<TaskName, TaskRecord>,
}

/// A desired state that was verified and accepted. It is kept as it was signed and verified again
/// at each start.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Accepted {
    /// Its generation.
    pub generation: Generation,
    /// The signed bytes.
    pub envelope: Envelope,
}

/// One task.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TaskRecord {
    /// What the desired state last asked for.
    pub order: DesiredTask,
    /// How far the ordered version has come before its start.
    pub preparation: Preparation,
    /// The run that is kept alive, of the ordered version or, until that is staged, of the one
    /// before.
    pub active: Option<ActiveRun>,
    /// The run that comes back should the active one, which took its place, not get ready.
    #[serde(default)]
    pub fallback: Option<ActiveRun>,
    /// The version that was active before.
    pub previous: Option<PackageRef>,
    /// Runs that have ended for good, the oldest first. An order that comes back is not done twice.
    pub finished: Vec<FinishedRun>,
    /// Ended runs whose files are still to be brought back, the oldest first.
    #[serde(default)]
    pub collections: Vec<Collection>,
    /// The last run whose files did not come back.
    #[serde(default)]
    pub lost: Option<LostFiles>,
    /// What the robot's gate was asked about this task, while that matters.
    #[serde(default)]
    pub gate: Option<GateRecord>,
    /// Starts of a process of this task.
    #[serde(default)]
    pub starts: u64,
    /// The phase as it was last reported.
    pub phase: Phase,
    /// Since when.
    pub phase_since_ms: u64,
}

/// How far a version has come on its way to be started.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Preparation {
    /// `assigned` to `staged`, `deferred`, or one of the ends `failed` and `unmet`.
    pub phase: Phase,
    /// Tries of that phase.
    pub attempts: u32,
    /// Not before this time.
    pub retry_at_ms: u64,
    /// Why it failed, is unmet or waits.
    pub failure: Option<Failure>,
    /// Known once the manifest is there.
    pub kind: Option<TaskKind>,
}

/// A run of one version, alive or meant to be.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ActiveRun {
    /// The order that asked for it.
    pub deployment: DeploymentId,
    /// Which of the order's runs.
    pub run: u64,
    /// What runs.
    pub package: PackageRef,
    /// How it is to be run.
    pub rules: RunRules,
    /// The process that was started last and is not known to have ended.
    pub process: Option<ProcessRecord>,
    /// Starts of a process that the restart policy made.
    pub restarts: u32,
    /// Those of them since it last ran calmly.
    pub restarts_in_a_row: u32,
    /// No start before this time.
    pub retry_at_ms: u64,
    /// When the first process of this boot was started.
    pub first_start_ms: u64,
    /// Whether a process of this run was ever ready.
    pub ever_ready: bool,
    /// Whether one was started in this boot, so that the robot's gate need not be asked again.
    #[serde(default)]
    pub admitted: bool,
    /// Whether one was ever started, so that it goes on and is not begun.
    #[serde(default)]
    pub ever_started: bool,
    /// Set once the run is over for good.
    pub end: Option<End>,
}

/// A process that was, or was about to be, started.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ProcessRecord {
    /// Its run directory's name; one directory is one start.
    pub dir: String,
    /// The boot it was started in.
    pub boot_id: String,
    /// When.
    pub started_ms: u64,
    /// Its id, once it is known.
    pub pid: Option<u32>,
    /// Whether it counted as running.
    pub ready: bool,
    /// Set once it is to be stopped for a reason of its own.
    #[serde(default)]
    pub condemned: Option<Condemned>,
}

/// Why a process is stopped that the order would have go on.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Condemned {
    /// What it failed in.
    pub failure: Failure,
    /// Whether the restart policy may start another.
    pub again: bool,
}

/// A run that is over.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct FinishedRun {
    /// The order.
    pub deployment: DeploymentId,
    /// Its run.
    pub run: u64,
    /// What came of it.
    pub end: End,
}

/// What came of a run.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct End {
    /// A final phase.
    pub phase: Phase,
    /// Why, where it is no success.
    pub failure: Option<Failure>,
}

/// An ended run whose files are to be brought back.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Collection {
    /// The order.
    pub deployment: DeploymentId,
    /// Which of its runs.
    pub run: u64,
    /// What ran.
    pub package: PackageRef,
    /// Service or job.
    pub kind: TaskKind,
    /// When it ended, or when this boot began.
    pub since_ms: u64,
    /// Tries that failed.
    pub attempts: u32,
    /// Not before this time.
    pub retry_at_ms: u64,
    /// Why the last try failed.
    pub failure: Option<Failure>,
}

/// A run whose files did not come back.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct LostFiles {
    /// The order.
    pub deployment: DeploymentId,
    /// Which of its runs.
    pub run: u64,
    /// Why.
    pub failure: Failure,
}

/// The ledger could not be written or read.
#[derive(Debug, thiserror::Error)]
#[error("cannot use the ledger {path}")]
pub struct LedgerError {
    path: PathBuf,
    source: io::Error,
}

/// What was found where the ledger should be.
#[derive(Debug)]
pub enum Found {
    /// A ledger.
    Ledger(Box<Ledger>),
    /// No file: a first start.
    Nothing,
    /// A file that is no ledger of this format; it was moved to this path and lost nothing.
    Unreadable(PathBuf),
}

impl Ledger {
    /// The ledger of a robot that was never started, or whose ledger was lost. A start counter
    /// above all earlier ones makes the server take this agent's reports for newer than those
    /// before the loss.
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

    /// What a person is told while the server does not accept the robot's token.
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

    /// Reads the ledger at `path`; one that can't be understood is moved aside, not deleted.
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

    /// Takes out of the records what means nothing to a new agent, and in a new boot the times of
    /// the one before.
    pub fn enter_boot(&mut self, boot_id: &str, now_ms: u64) {
        for record in self.tasks.values_mut() {
            // The robot may have been given a load since it said yes.
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
            // What it lacked when it was given up may be there again.
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
    /// Whether the version is on its way. For one that has run before: it is prepared anew.
    pub fn is_under_way(&self) -> bool {
        matches!(self.phase, Phase::Fetching | Phase::Building)
    }
}

impl TaskRecord {
    /// The record of an order that has just come in.
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

    /// The record of a run that was found alive when the ledger was lost: as if it were ordered,
    /// until the server has said what is.
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

    /// How the ordered run ended, if it has: now, or before the order came back.
    pub fn end_of_order(&self) -> Option<&End> {
        if let Some(active) = self.active.as_ref().filter(|active| active.is_for(&self.order)) {
            return active.end.as_ref();
        }
        let same = |run: &&FinishedRun| {
            run.deployment == self.order.deployment && run.run == self.order.run
        };
        self.finished.iter().rev().find(same).map(|run| &run.end)
    }

    /// Where the order stands.
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

    /// What the robot's gate forbids, and why.
    pub fn refusal(&self) -> Option<(&GateQuestion, &Failure)> {
        match &self.gate {
            Some(GateRecord { question, answer: Some(GateAnswer::Refused(failure)), .. }) => {
                Some((question, failure))
            }
            _ => None,
        }
    }

    /// Whether what the gate is asked decides where the order stands, and not only whether an older
    /// run goes on.
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

    /// Makes place for `successor`: remembers how the active run ended, its version and, if it was
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
        // A job that failed has failed: what it has done can't be undone by starting something
        // else.
        let is_job = successor.rules.kind == TaskKind::Job;
        self.fallback.take_if(|fallback| is_job || fallback.package == successor.package);
        if let Some(fallback) = &self.fallback {
            self.previous = Some(fallback.package.clone());
        }
    }

    /// What the operator had stopped neither starts nor comes back in place of what is ordered now.
    pub fn forget_stopped(&mut self, next: &DesiredTask, now_ms: u64) {
        self.fallback = None;
        match &mut self.active {
            Some(active) if active.is_for(next) => {
                (active.ever_ready, active.first_start_ms) = (false, now_ms)
            }
            _ => self.lay_down_active(&next.package),
        }
    }

    /// Takes the active run away and remembers how it ended and, unless that is the next one's, its
    /// version.
    fn lay_down_active(&mut self, next: &PackageRef) {
        let Some(active) = self.active.take() else { return };
        if active.package != *next {
            self.previous = Some(active.package);
        }
        if let Some(end) = active.end {
            self.finish(active.deployment, active.run, end);
        }
    }

    /// Remembers what came of a run.
    pub fn finish(&mut self, deployment: DeploymentId, run: u64, end: End) {
        self.finished.retain(|other| other.deployment != deployment || other.run != run);
        self.finished.push(FinishedRun { deployment, run, end });
        let surplus = self.finished.len().saturating_sub(MAX_FINISHED);
        self.finished.drain(..surplus);
    }

    /// The versions that must stay on disk: ordered, active, the one that may come back, and the
    /// one before while there is room for what is ordered: it lies there only so that a later
    /// rollback need not fetch it.
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

    /// Whether it was good, and was given up only for being started again too often in one boot.
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

    /// Whether a process of it was started before. An earlier agent wrote down only that one was
    /// ready.
    pub fn has_started(&self) -> bool {
        self.ever_started || self.ever_ready
    }
}

impl Collection {
    /// Whether it is of the run that `order` asks for.
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
        // What a crash half way through the next write leaves behind.
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
