//! The ledger holds the accepted desired state, the steps under way and the started processes. The
//! agent writes the ledger before each step, so that after kill -9 or a power cut the next agent
//! continues from there. Ledger types are neither wire types nor observations. Times are
//! [`crate::system::clock`]'s milliseconds since boot and are valid only in the boot that they
//! name. The ledger decides nothing: decisions are the plan's work.

use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use task_proto::trust::envelope::Envelope;
use task_proto::{Generation, TaskName};

use crate::system::durable;
use crate::task::run::ActiveRun;

mod gate;
mod record;

pub use gate::{GateAnswer, GateQuestion, GateRecord, GateStep};
pub use record::{FinishedRun, LostFiles, OutputUpload, Preparation, TaskRecord};

/// The version of the file's format that this agent reads and writes.
pub const FORMAT: u32 = 1;
/// The largest file that is read as a ledger.
const MAX_BYTES: u64 = 64 * 1024 * 1024;

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

/// The ledger could not be written or read.
#[derive(Debug, thiserror::Error)]
#[error("cannot use the ledger {path}")]
pub struct LedgerError {
    path: PathBuf,
    source: io::Error,
}

/// The result of reading the ledger file.
#[derive(Debug)]
pub enum LedgerFile {
    Valid(Box<Ledger>),
    /// No file: a first start.
    Missing,
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
    pub fn removal_message(&self) -> Option<String> {
        let because = match self.removed_because.as_str() {
            "" => String::new(),
            because => format!(" ({because})"),
        };
        let text = || {
            format!(
                "the server does not accept this robot's token{because}: no new work is started"
            )
        };
        self.removed.then(text)
    }

    /// Reads the ledger at `path`. An unreadable ledger is moved aside, not deleted.
    pub fn read(path: &Path) -> Result<LedgerFile, LedgerError> {
        let failed = |source| LedgerError { path: path.to_owned(), source };
        let bytes = match read_limited(path) {
            Ok(bytes) => bytes,
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                return Ok(LedgerFile::Missing);
            }
            Err(error) => return Err(failed(error)),
        };
        match serde_json::from_slice::<Self>(&bytes) {
            Ok(ledger) if ledger.format == FORMAT => Ok(LedgerFile::Valid(Box::new(ledger))),
            _ => {
                let aside = unused_backup_path(path);
                durable::rename(path, &aside).map_err(failed)?;
                Ok(LedgerFile::Unreadable(aside))
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
            if let Some(restoring) = &mut record.restoring {
                restoring.retry_at_ms = 0;
            }
            if let Some(gate) = &mut record.gate {
                gate.retry_at_ms = 0;
            }
            for collection in &mut record.collections {
                (collection.since_ms, collection.retry_at_ms) = (now_ms, 0);
            }
            let enter_boot = |run: ActiveRun| run.enter_boot(now_ms);
            record.active = record.active.take().map(enter_boot);
            record.fallback = record.fallback.take().map(enter_boot);
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
fn unused_backup_path(path: &Path) -> PathBuf {
    let name = |n: u32| PathBuf::from(format!("{}.broken-{n}", path.display()));
    (1..9).map(name).find(|candidate| !candidate.exists()).unwrap_or_else(|| name(9))
}

#[cfg(test)]
mod tests {
    use task_proto::desired::{BlobRef, Delivery, DesiredTask, PackageRef, TargetState};
    use task_proto::messages::report::{Failure, FailureCode, Phase};
    use task_proto::packages::manifest::TaskManifest;
    use task_proto::{DeploymentId, Digest};

    use super::*;
    use crate::task::run::{End, MAX_RESTARTS_IN_A_ROW, ProcessRecord, RunRules};
    use crate::task::timing::Moment;

    fn order() -> DesiredTask {
        let blob = BlobRef { digest: Digest::of(b"1"), size: 1 };
        let name: TaskName = "talker".parse().expect("valid");
        let version = "1.0".parse().expect("valid");
        DesiredTask {
            task: name.clone(),
            deployment: DeploymentId::random(),
            package: PackageRef { name, version, manifest: blob, config: blob, content: blob },
            wanted: TargetState::Running,
            run: 1,
            delivery: Delivery::PushPull,
            priority: 0,
        }
    }

    #[test]
    fn ledger_reads_back_and_survives_a_crash_while_it_is_written() {
        let dir = tempfile::tempdir().expect("a directory");
        let path = dir.path().join("ledger.json");
        assert!(matches!(Ledger::read(&path), Ok(LedgerFile::Missing)));
        let mut ledger = Ledger::new(3);
        let order = order();
        ledger.tasks.insert(order.task.clone(), TaskRecord::new(order, 5));
        ledger.write(&path).expect("written");
        // The leftover of a crash half way through the next write.
        std::fs::write(dir.path().join("ledger.json.tmp"), "{\"format\":1,").expect("written");
        let Ok(LedgerFile::Valid(read)) = Ledger::read(&path) else {
            panic!("the ledger is there")
        };
        assert_eq!(*read, ledger);
        ledger.write(&path).expect("written again");
    }

    #[test]
    fn ledger_that_is_cut_off_or_of_another_format_is_moved_aside() {
        let dir = tempfile::tempdir().expect("a directory");
        let path = dir.path().join("ledger.json");
        Ledger::new(3).write(&path).expect("written");
        let whole = std::fs::read(&path).expect("read");
        let newer =
            String::from_utf8(whole.clone()).expect("text").replace("\"format\":1", "\"format\":2");
        let cuts = (0..whole.len()).step_by(7).map(|length| whole[..length].to_vec());
        for bytes in cuts.chain([newer.into_bytes(), vec![0; 4096]]) {
            std::fs::write(&path, &bytes).expect("written");
            let Ok(LedgerFile::Unreadable(aside)) = Ledger::read(&path) else {
                panic!("taken for a ledger: {bytes:?}")
            };
            assert!(!path.exists());
            assert_eq!(std::fs::read(&aside).expect("kept"), bytes);
        }
    }

    #[test]
    fn ledger_of_an_agent_without_rollback_is_read() {
        let mut ledger = Ledger::new(3);
        let order = order();
        let mut record = TaskRecord::new(order.clone(), 5);
        let manifest = serde_json::json!({
            "name": "talker", "version": "1.0", "run": {"exec": ["true"]},
            "content": {"tar_digest": Digest::of(b""), "tar_size": 0, "entries": 0},
        });
        let rules =
            RunRules::from(&serde_json::from_value::<TaskManifest>(manifest).expect("manifest"));
        let (dir, boot_id) = ("d.1.1.1".to_owned(), "boot".to_owned());
        let process = ProcessRecord { dir, boot_id, started_ms: 1, pid: Some(7) };
        let run = ActiveRun::of(&order, rules, 1).begin(process).become_ready();
        // Such an agent did not write whether the gate had admitted the run in this boot.
        record.active = Some(run.enter_boot(1));
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
    fn ledger_of_an_earlier_agent_is_written_as_it_was_read() {
        let golden = include_str!("ledger/golden.json");
        let ledger: Ledger = serde_json::from_str(golden).expect("read");
        assert_eq!(serde_json::to_string(&ledger).expect("json"), golden.trim_end());
    }

    #[test]
    fn full_disk_drops_the_previous_version() {
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
    fn new_boot_resets_times() {
        let mut ledger = Ledger::new(1);
        let order = order();
        let mut record = TaskRecord::new(order.clone(), 900_000);
        record.preparation.retry_at_ms = 950_000;
        record.restoring = Some(record.preparation.clone());
        ledger.tasks.insert(order.task.clone(), record);
        ledger.enter_boot("second", 10);
        let record = &ledger.tasks[&order.task];
        assert_eq!((record.phase_since_ms, record.preparation.retry_at_ms), (10, 0));
        assert_eq!(record.restoring, Some(record.preparation.clone()));
    }

    #[test]
    fn exhausted_service_is_retried_after_a_reboot() {
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
            let at = Moment { boot_id: "first", now_ms: 5, jitter: 0.0 };
            let run = ActiveRun::of(&order, rules, 1).become_ready();
            let run = (0..restarts_in_a_row).fold(run, |run, _| run.restart(&at));
            record.active = Some(run.finish(End::without_failure(Phase::Failed)));
            ledger.tasks.insert(order.task.clone(), record);
            ledger.enter_boot("second", 10);
            let record = &ledger.tasks[&order.task];
            assert_eq!(
                record.active.as_ref().expect("active").restarts_in_a_row(),
                0,
                "each boot has its own"
            );
            record.order_phase().0
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
