//! Fetches publishers' signatures: follows the publisher lists that desired states name, and
//! determines whether a package may be used. [`crate::config::trust`] judges the bytes; their
//! origin proves nothing.

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

/// Most lists remembered as judged. Beyond this number all lists are judged again.
const MAX_JUDGED: usize = 1024;
/// Longest wait before a failed fetch is repeated.
const MAX_BACKOFF_MS: u64 = 5 * 60 * 1000;

/// Reasons why a package may not be used.
#[derive(Debug, thiserror::Error)]
pub enum NotVouched {
    /// All signatures are known, and the package is not trusted.
    #[error(transparent)]
    Distrusted(#[from] Distrust),
    /// A list or a signature could not be fetched.
    #[error("what publishers have signed can't be had")]
    Fetch(#[from] FetchError),
}

/// Determines which publishers vouch for packages.
pub struct Vouching {
    trust: Trust,
    fetcher: Arc<Fetcher>,
    data: DataDir,
    told: Mutex<Told>,
    /// Changes with every event that may change a judgement.
    epoch: AtomicU64,
}

/// Evidence named by the server, and the results of following it.
#[derive(Default)]
struct Told {
    evidence: Evidence,
    /// Lists that are not fetched again.
    judged: HashSet<Digest>,
    /// Why the last list was not taken over.
    refused: Option<String>,
    /// The task that follows the latest evidence.
    follower: Option<AbortHandle>,
}

impl Vouching {
    /// Judges with `trust`, fetches with `fetcher`, and keeps signatures in `data`.
    pub fn new(trust: Trust, fetcher: Arc<Fetcher>, data: DataDir) -> Self {
        Self { trust, fetcher, data, told: Mutex::default(), epoch: AtomicU64::new(0) }
    }

    /// Version of the publisher list in force; 0 if the settings are in force.
    pub fn version(&self) -> u64 {
        self.trust.version()
    }

    /// The facts that current judgements depend on.
    pub fn facts(&self) -> TrustFacts {
        TrustFacts {
            epoch: self.epoch.load(Ordering::Acquire),
            list_is_over: self.trust.is_over(clock::wall_ms()),
            refused_list: self.told().refused.clone(),
        }
    }

    /// Records the evidence of a desired state and starts to fetch its new parts: publisher lists,
    /// and signatures of installed packages.
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

    /// Judges the package by the signatures on the disk.
    pub fn look(&self, package: &PackageRef) -> Vouched {
        match self.judge(package, Use::Begin) {
            Ok(()) => Vouched::Yes,
            Err(_) if self.judge(package, Use::GoOn).is_ok() => Vouched::Stale,
            Err(_) => Vouched::No,
        }
    }

    /// Whether the signatures on the disk allow this use of the package.
    pub fn judge(&self, package: &PackageRef, purpose: Use) -> Result<(), Distrust> {
        self.trust.judge(package, &self.kept(package), purpose, clock::wall_ms()).map(drop)
    }

    /// Like [`Self::judge`], after fetching the available lists and signatures.
    pub async fn vouch(
        &self,
        package: &PackageRef,
        purpose: Use,
        cancel: &CancellationToken,
    ) -> Result<(), NotVouched> {
        // A package that already runs does not wait for an unreachable server.
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
            // This judgement includes signatures that are not on the disk.
            Ok(Err(by_all)) => (None, by_all),
            Ok(Ok(())) => (None, distrust),
            Err(error) => (Some(error), distrust),
        };
        // The missing list or signature might change the judgement.
        let missing = [lists.err(), signatures].into_iter().flatten();
        let may_come = |error: &FetchError| {
            error.is_retryable() || matches!(error, FetchError::Cancelled | FetchError::Disk { .. })
        };
        Err(missing.filter(may_come).map(NotVouched::Fetch).next().unwrap_or(distrust.into()))
    }

    /// Fetches the evidence of the newest state until all of it is here or can't be fetched.
    async fn follow(self: Arc<Self>, packages: Vec<PackageRef>) {
        let cancel = CancellationToken::new();
        let mut failures = 0;
        loop {
            let mut outcome = self.take_lists(&cancel).await;
            for package in &packages {
                let version = self.data.task(&package.name).version(&package.manifest.digest);
                // A package that is not installed is judged before its installation.
                if version.src().is_dir() && self.look(package) == Vouched::No {
                    outcome = outcome.and(self.take_signatures(package, &cancel).await.map(drop));
                }
            }
            // Retry after every error: a robot that gave up would never learn that a publisher is
            // no longer trusted.
            let Err(error) = outcome else { return };
            tracing::info!(error = %chain(&error), "what publishers have signed can't be had yet");
            failures += 1;
            let wait_ms = backoff_ms(failures, MAX_BACKOFF_MS, rand::random()).max(1000);
            tokio::time::sleep(Duration::from_millis(wait_ms)).await;
        }
    }

    /// Fetches the lists named after the one in force, and adopts them in order.
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
                    // The follower and a task that waits for a list may both have fetched this one.
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
            // The result of the newest list, which comes last, is kept.
            told.refused = refused
                .map(|why| format!("the list of publishers {} was refused: {why}", blob.digest));
            self.epoch.fetch_add(1, Ordering::AcqRel);
        }
        Ok(())
    }

    /// Fetches the named signatures of a package. Keeps the valid ones if they suffice, and
    /// otherwise returns the reason.
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
                // Other bytes are not a signature.
                Ok(bytes) => envelopes.extend(serde_json::from_slice::<Envelope>(&bytes).ok()),
                Err(error) => failed = Some(error),
            }
        }
        // Kept signatures come last: their number may already be the most that is checked.
        envelopes.extend(self.kept(package));
        // An expired list does not invalidate a signature.
        let counted = match self.trust.judge(package, &envelopes, Use::GoOn, clock::wall_ms()) {
            Ok(counted) => counted,
            Err(distrust) => return failed.map_or(Ok(Err(distrust)), Err),
        };
        let path = self.data.task(&package.name).signatures(&package.manifest.digest);
        trust::write_signatures(&path, &counted).map_err(|source| self.not_kept(&path, source))?;
        self.epoch.fetch_add(1, Ordering::AcqRel);
        Ok(Ok(()))
    }

    /// Lists named after the one in force that were not refused before.
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
