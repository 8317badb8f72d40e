//! Health of the server's components. One background job checks the components and keeps the last
//! verdict on each. `/readyz` only reads the verdicts, so requests cost nothing, regardless of
//! their number. Other jobs add components of their own.

use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::task::JoinHandle;
use tokio::time::{MissedTickBehavior, interval, timeout};
use tokio_util::sync::CancellationToken;

use crate::blobs::CommonStore;
use crate::broker::{Broker, Health};
use crate::store::Store;
use crate::system::data_directory::disk_space;

/// Interval between two checks of the database and the disk.
const CHECK_INTERVAL: Duration = Duration::from_secs(5);
/// Time limit for the answer of one component.
const CHECK_TIMEOUT: Duration = Duration::from_secs(5);
/// A file system with less free space than this, in bytes, counts as full.
const MIN_FREE_BYTES: u64 = 16 << 20;
/// On a small file system, the threshold is the total size divided by this number.
const MIN_FREE_SHARE: u64 = 64;

/// A component that the server needs to work.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Component {
    /// Healthy if the database answers.
    Database,
    /// Healthy if the MQTT broker serves.
    Broker,
    /// Healthy if the data directory is writable.
    Disk,
    /// Healthy if the common store of blobs answers; only known if there is one.
    Blobs,
}

impl Component {
    /// The component's key in the answer of `/readyz`.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Database => "database",
            Self::Broker => "broker",
            Self::Disk => "disk",
            Self::Blobs => "blobs",
        }
    }

    /// Whether the server is of no use without this component. Without the common store of blobs,
    /// which all servers would miss at once, it still takes reports and orders.
    pub const fn is_vital(self) -> bool {
        !matches!(self, Self::Blobs)
    }
}

/// The last verdict on each component: `None` for a healthy one, otherwise the problem. Clones
/// share the verdicts.
#[derive(Debug, Clone, Default)]
pub struct Readiness {
    verdicts: Arc<Mutex<BTreeMap<Component, Option<String>>>>,
    draining: CancellationToken,
    stopping: CancellationToken,
}

impl Readiness {
    /// Replaces the verdict on a component.
    pub fn set(&self, component: Component, problem: Option<String>) {
        self.lock().insert(component, problem);
    }

    /// The verdicts on all components checked so far.
    pub fn verdicts(&self) -> BTreeMap<Component, Option<String>> {
        self.lock().clone()
    }

    /// From now on the server is not ready, because its clients are to use others.
    pub fn begin_drain(&self) {
        self.draining.cancel();
    }

    /// The same, because the server is about to stop.
    pub fn begin_stop(&self) {
        self.stopping.cancel();
        self.draining.cancel();
    }

    /// Whether clients are to use other servers.
    pub fn is_draining(&self) -> bool {
        self.draining.is_cancelled()
    }

    /// Whether the server is about to stop.
    pub fn is_stopping(&self) -> bool {
        self.stopping.is_cancelled()
    }

    fn lock(&self) -> MutexGuard<'_, BTreeMap<Component, Option<String>>> {
        // Every change under this lock is one insertion.
        self.verdicts.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The job that checks database, broker, disk and the common store of blobs.
pub struct ReadinessCheck {
    pub readiness: Readiness,
    pub store: Store,
    pub broker: Broker,
    /// The probe of the data directory.
    pub disk: DiskProbe,
    /// The common store of blobs, if there is one.
    pub blobs: Option<CommonStore>,
}

impl ReadinessCheck {
    /// Checks all components once.
    pub async fn check(&mut self) {
        let common = self.blobs.clone();
        let blobs = async move {
            match common {
                Some(store) => Some(store.problem().await),
                None => None,
            }
        };
        let (database, disk, blobs) =
            tokio::join!(timeout(CHECK_TIMEOUT, self.store.ping()), self.disk.problem(), blobs);
        if let Some(problem) = blobs {
            self.readiness.set(Component::Blobs, problem);
        }
        self.readiness.set(
            Component::Database,
            match database {
                Ok(Ok(())) => self.store.state().problem(),
                Ok(Err(_)) => {
                    self.store.state().problem().or_else(|| Some("a statement failed".to_owned()))
                }
                Err(_) => Some("it does not answer".to_owned()),
            },
        );
        self.readiness.set(Component::Disk, disk);
        self.readiness.set(Component::Broker, broker_problem(&self.broker.health().borrow()));
    }

    /// Checks the database and the disk at intervals, and the broker whenever its health changes,
    /// until `stop`.
    pub async fn run(mut self, stop: CancellationToken) {
        let mut health = self.broker.health();
        let mut ticks = interval(CHECK_INTERVAL);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        // The first tick would be due at once, but the server has checked before it listened.
        ticks.reset();
        loop {
            tokio::select! {
                () = stop.cancelled() => return,
                _ = ticks.tick() => self.check().await,
                Ok(()) = health.changed() => {
                    self.readiness.set(Component::Broker, broker_problem(&health.borrow_and_update()));
                }
            }
        }
    }
}

fn broker_problem(health: &Health) -> Option<String> {
    match health {
        Health::Serving => None,
        Health::Recovering(problem) | Health::Failed(problem) => Some(problem.clone()),
    }
}

/// Writes a small file into the data directory, one write at a time: a file system that hangs
/// blocks one thread, not one per check.
pub struct DiskProbe {
    data: PathBuf,
    check_timeout: Duration,
    running: Option<JoinHandle<io::Result<()>>>,
}

impl DiskProbe {
    /// A probe of this directory.
    pub fn new(data: PathBuf) -> Self {
        Self { data, check_timeout: CHECK_TIMEOUT, running: None }
    }

    /// The reason why the data directory is not writable, or `None`.
    async fn problem(&mut self) -> Option<String> {
        let data = self.data.clone();
        let probe = self
            .running
            .get_or_insert_with(|| tokio::task::spawn_blocking(move || probe_disk(&data)));
        let finished = timeout(self.check_timeout, probe).await.ok();
        if finished.is_some() {
            self.running = None;
        }
        match finished {
            Some(Ok(Ok(()))) => None,
            Some(Ok(Err(error))) if error.kind() == io::ErrorKind::StorageFull => {
                let free = disk_space(&self.data).map_or(0, |(free, _)| free);
                Some(format!("the data directory's disk is full: {free} bytes are free"))
            }
            Some(Ok(Err(error))) => {
                Some(format!("the data directory can't be written: {}", error.kind()))
            }
            Some(Err(_)) => Some("the data directory can't be checked".to_owned()),
            None => Some("the data directory does not answer".to_owned()),
        }
    }
}

fn probe_disk(data: &Path) -> io::Result<()> {
    std::fs::write(data.join(".ready"), b"ready\n")?;
    // The file is short and exists already, so this write may succeed where others fail. Therefore
    // we also check the free space.
    match disk_space(data) {
        Some((free, total)) if free < MIN_FREE_BYTES.min(total / MIN_FREE_SHARE) => {
            Err(io::ErrorKind::StorageFull.into())
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn disk_probe_names_the_problem_and_recovers() {
        let parent = tempfile::tempdir().expect("a directory");
        let data = parent.path().join("data");
        let mut probe = DiskProbe::new(data.clone());
        let problem = probe.problem().await.expect("the directory is missing");
        assert_eq!(problem, "the data directory can't be written: entity not found");
        std::fs::create_dir(&data).expect("made");
        assert_eq!(probe.problem().await, None);
    }

    #[tokio::test]
    async fn disk_probe_that_hangs_runs_once_and_its_end_is_noticed() {
        let data = tempfile::tempdir().expect("a directory");
        let (release, held) = tokio::sync::oneshot::channel::<()>();
        let hanging = tokio::spawn(async move {
            held.await.expect("released");
            Ok(())
        });
        let mut probe = DiskProbe {
            data: data.path().to_owned(),
            check_timeout: Duration::from_millis(1),
            running: Some(hanging),
        };
        for _ in 0..3 {
            assert_eq!(
                probe.problem().await.as_deref(),
                Some("the data directory does not answer")
            );
        }
        assert!(!data.path().join(".ready").exists(), "a second write was begun");
        release.send(()).expect("it waits");
        probe.check_timeout = CHECK_TIMEOUT;
        assert_eq!(probe.problem().await, None);
    }
}
