//! Gets what publishers have signed: follows the lists that desired states name, and finds out
//! whether a package may be used. What to make of the bytes is [`crate::config::trust`]'s to say;
//! where they come from proves nothing.

use std::collections::HashSet;
use std::io;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use task_proto::desired::{BlobRef, DesiredState, Evidence, PackageRef};
use task_proto::envelope::Envelope;
use task_proto::publisher::{
    LIST_REPOSITORY, MAX_LIST_BYTES, MAX_LISTS, MAX_SIGNATURE_BYTES, MAX_SIGNATURES,
};
use task_proto::{Digest, RepositoryName};
use tokio::task::AbortHandle;
use tokio_util::sync::CancellationToken;

use crate::config::trust::{self, Distrust, NotTaken, Trust, Use};
use crate::install::fetch::{FetchError, Fetcher};
use crate::system::clock;
use crate::system::disk::Need;
use crate::system::error_chain::chain;
use crate::system::layout::DataDir;
use crate::task::observed::{TrustFacts, Vouched};
use crate::task::plan::backoff_ms;

/// Lists that are remembered as judged; beyond it all are looked at again.
const MAX_JUDGED: usize = 1024;
/// The longest wait before what could not be had is asked for again.
const MAX_BACKOFF_MS: u64 = 5 * 60 * 1000;

/// Why a package may not be used.
#[derive(Debug, thiserror::Error)]
pub enum NotVouched {
    /// By all that was signed.
    #[error(transparent)]
    Distrusted(#[from] Distrust),
    /// Something that was signed could not be had.
    #[error("what publishers have signed can't be had")]
    Fetch(#[from] FetchError),
}

/// Finds out who vouches for packages.
pub struct Vouching {
    trust: Trust,
    fetcher: Arc<Fetcher>,
    data: DataDir,
    told: Mutex<Told>,
    /// Changes with all that may change a judgement.
    epoch: AtomicU64,
}

/// What the server said, and what came of it.
#[derive(Default)]
struct Told {
    evidence: Evidence,
    /// Lists that need not be fetched again.
    judged: HashSet<Digest>,
    /// Why the last list was not taken over.
    refused: Option<String>,
    /// Whoever follows what was said last.
    follower: Option<AbortHandle>,
}

impl Vouching {
    /// Judges by `trust`, fetches with `fetcher`, keeps signatures in `data`.
    pub fn new(trust: Trust, fetcher: Arc<Fetcher>, data: DataDir) -> Self {
        Self { trust, fetcher, data, told: Mutex::default(), epoch: AtomicU64::new(0) }
    }

    /// The version of the list of publishers that counts; 0: the settings do.
    pub fn version(&self) -> u64 {
        self.trust.version()
    }

    /// What judgements depend on now.
    pub fn facts(&self) -> TrustFacts {
        TrustFacts {
            epoch: self.epoch.load(Ordering::Acquire),
            list_is_over: self.trust.is_over(clock::wall_ms()),
            refused_list: self.told().refused.clone(),
        }
    }

    /// Notes what a desired state names, and begins to get what is new of it: lists of publishers,
    /// and signatures of what is installed.
    pub fn heed(self: &Arc<Self>, state: &DesiredState) {
        let mut told = self.told();
        if told.evidence == state.evidence {
            return;
        }
        told.evidence = state.evidence.clone();
        let packages = state.tasks.iter().map(|task| task.package.clone()).collect();
        let following = tokio::spawn(self.clone().follow(packages));
        if let Some(before) = told.follower.replace(following.abort_handle()) {
            before.abort();
        }
    }

    /// What the signatures on the disk say.
    pub fn look(&self, package: &PackageRef) -> Vouched {
        match self.judge(package, Use::Begin) {
            Ok(()) => Vouched::Yes,
            Err(_) if self.judge(package, Use::GoOn).is_ok() => Vouched::Stale,
            Err(_) => Vouched::No,
        }
    }

    /// Whether the package may be used so by the signatures on the disk.
    pub fn judge(&self, package: &PackageRef, purpose: Use) -> Result<(), Distrust> {
        self.trust.judge(package, &self.kept(package), purpose, clock::wall_ms()).map(drop)
    }

    /// The same, with the lists and signatures that are to be had.
    pub async fn vouch(
        &self,
        package: &PackageRef,
        purpose: Use,
        cancel: &CancellationToken,
    ) -> Result<(), NotVouched> {
        // What runs already is not held up by a server that is away.
        if purpose == Use::GoOn && self.judge(package, purpose).is_ok() {
            return Ok(());
        }
        let lists = self.take_lists(cancel).await;
        if self.judge(package, purpose).is_ok() {
            return Ok(());
        }
        let signatures = self.take_signatures(package, cancel).await;
        let Err(distrust) = self.judge(package, purpose) else { return Ok(()) };
        let (signatures, distrust) = match signatures {
            // It has seen more than what is on the disk.
            Ok(Err(by_all)) => (None, by_all),
            Ok(Ok(())) => (None, distrust),
            Err(error) => (Some(error), distrust),
        };
        // By what could not be had, or not be kept, it might be otherwise.
        let missing = [lists.err(), signatures].into_iter().flatten();
        let may_come = |error: &FetchError| {
            error.is_retryable() || matches!(error, FetchError::Cancelled | FetchError::Disk { .. })
        };
        Err(missing.filter(may_come).map(NotVouched::Fetch).next().unwrap_or(distrust.into()))
    }

    /// Gets what the newest state names until nothing of it is left to be had.
    async fn follow(self: Arc<Self>, packages: Vec<PackageRef>) {
        let cancel = CancellationToken::new();
        let mut failures = 0;
        loop {
            let mut outcome = self.take_lists(&cancel).await;
            for package in &packages {
                let version = self.data.task(&package.name).version(&package.manifest.digest);
                // What is not installed is looked at before it is.
                if version.src().is_dir() && self.look(package) == Vouched::No {
                    outcome = outcome.and(self.take_signatures(package, &cancel).await.map(drop));
                }
            }
            // Whatever came instead: a robot that gave up would never hear that somebody is not
            // trusted any more.
            let Err(error) = outcome else { return };
            tracing::info!(error = %chain(&error), "what publishers have signed can't be had yet");
            failures += 1;
            let wait_ms = backoff_ms(failures, MAX_BACKOFF_MS, rand::random()).max(1000);
            tokio::time::sleep(Duration::from_millis(wait_ms)).await;
        }
    }

    /// Gets the lists that were named after the one that counts, and takes them over in their
    /// order.
    async fn take_lists(&self, cancel: &CancellationToken) -> Result<(), FetchError> {
        let repository: RepositoryName = LIST_REPOSITORY.parse().expect("a repository's name");
        for blob in self.fresh_lists() {
            let bytes = match self.fetcher.small(&repository, blob, MAX_LIST_BYTES, cancel).await {
                Ok(bytes) => bytes,
                Err(error) => {
                    if !error.is_retryable() || matches!(error, FetchError::DigestMismatch { .. }) {
                        let text = format!(
                            "the list of publishers {} can't be had: {}",
                            blob.digest,
                            chain(&error)
                        );
                        if self.told().refused.replace(text.clone()) != Some(text) {
                            self.epoch.fetch_add(1, Ordering::AcqRel);
                        }
                    }
                    return Err(error);
                }
            };
            let refused = match serde_json::from_slice(&bytes) {
                Ok(envelope) => match self.trust.take(&envelope, blob.digest) {
                    Ok(()) => None,
                    // Whoever follows the lists and whoever waits for one may have got it both.
                    Err(_) if self.trust.counting() == Some(blob.digest) => None,
                    Err(NotTaken::Disk(source)) => {
                        return Err(self.not_kept(&self.data.publishers(), source));
                    }
                    Err(NotTaken::Refused(why)) => Some(why.to_string()),
                },
                Err(error) => Some(format!("it is no envelope: {error}")),
            };
            match &refused {
                Some(why) => {
                    tracing::warn!(list = %blob.digest, %why, "a list of publishers was refused")
                }
                None => tracing::info!(
                    version = self.trust.version(),
                    "goes by another list of publishers"
                ),
            }
            let mut told = self.told();
            if told.judged.len() >= MAX_JUDGED {
                told.judged.clear();
            }
            told.judged.insert(blob.digest);
            // What is said of the newest, which is the last, is what stays.
            told.refused = refused
                .map(|why| format!("the list of publishers {} was refused: {why}", blob.digest));
            self.epoch.fetch_add(1, Ordering::AcqRel);
        }
        Ok(())
    }

    /// Gets the signatures of a package that were named, and keeps those that count if they are
    /// enough; if not, says why.
    async fn take_signatures(
        &self,
        package: &PackageRef,
        cancel: &CancellationToken,
    ) -> Result<Result<(), Distrust>, FetchError> {
        let repository = RepositoryName::of_package(&package.name);
        let (mut envelopes, mut failed) = (Vec::new(), None);
        let named = self.told().evidence.signatures_of(package);
        for blob in named.into_iter().take(MAX_SIGNATURES) {
            match self.fetcher.small(&repository, blob, MAX_SIGNATURE_BYTES, cancel).await {
                // Anything else is nobody's signature.
                Ok(bytes) => envelopes.extend(serde_json::from_slice::<Envelope>(&bytes).ok()),
                Err(error) => failed = Some(error),
            }
        }
        // Those that are kept come last: they may be as many as are looked at.
        envelopes.extend(self.kept(package));
        // A list whose lifetime is over says nothing against a signature.
        let counted = match self.trust.judge(package, &envelopes, Use::GoOn, clock::wall_ms()) {
            Ok(counted) => counted,
            Err(distrust) => return failed.map_or(Ok(Err(distrust)), Err),
        };
        let path = self.data.task(&package.name).signatures(&package.manifest.digest);
        trust::write_signatures(&path, &counted).map_err(|source| self.not_kept(&path, source))?;
        self.epoch.fetch_add(1, Ordering::AcqRel);
        Ok(Ok(()))
    }

    /// The lists that were named after the one that counts and not refused before.
    fn fresh_lists(&self) -> Vec<BlobRef> {
        let told = self.told();
        let lists = &told.evidence.lists[..told.evidence.lists.len().min(MAX_LISTS)];
        let counting = self.trust.counting();
        let known =
            lists.iter().rposition(|list| Some(list.digest) == counting).map_or(0, |at| at + 1);
        lists[known..].iter().filter(|list| !told.judged.contains(&list.digest)).copied().collect()
    }

    fn not_kept(&self, path: &Path, source: io::Error) -> FetchError {
        FetchError::disk(path, source)
            .for_want_of_room(self.data.root(), Need::of_file(MAX_SIGNATURE_BYTES))
    }

    fn kept(&self, package: &PackageRef) -> Vec<Envelope> {
        trust::read_signatures(&self.data.task(&package.name).signatures(&package.manifest.digest))
    }

    fn told(&self) -> MutexGuard<'_, Told> {
        // Every change under the lock is complete in itself.
        self.told.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
