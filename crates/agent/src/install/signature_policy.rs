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
use task_proto::error_chain::chain;
use task_proto::packages::publisher::{
    LIST_REPOSITORY, MAX_LIST_BYTES, MAX_LISTS, MAX_SIGNATURE_BYTES, MAX_SIGNATURES,
};
use task_proto::trust::envelope::Envelope;
use task_proto::{Digest, RepositoryName};
use tokio::task::AbortHandle;
use tokio_util::sync::CancellationToken;

use crate::config::trust::{self, ListError, PackageUse, Trust, TrustError};
use crate::install::fetch::{FetchError, Fetcher};
use crate::system::clock;
use crate::system::disk::Need;
use crate::system::layout::DataDir;
use crate::task::observed::{SignatureVerdict, TrustFacts};
use crate::task::timing::backoff_ms;

/// Most lists remembered as checked. Beyond this number all lists are checked again.
const MAX_CHECKED_LISTS: usize = 1024;
/// Longest wait before a failed fetch is repeated.
const MAX_BACKOFF_MS: u64 = 5 * 60 * 1000;

/// Reasons why a package may not be used.
#[derive(Debug, thiserror::Error)]
pub enum SignatureError {
    /// All signatures are known, and the package is not trusted.
    #[error(transparent)]
    Distrusted(#[from] TrustError),
    /// A list or a signature could not be fetched.
    #[error("cannot fetch the signatures of publishers")]
    Fetch(#[from] FetchError),
}

/// Determines which publishers vouch for packages.
pub struct SignaturePolicy {
    trust: Trust,
    fetcher: Arc<Fetcher>,
    data: DataDir,
    progress: Mutex<EvidenceProgress>,
    /// Changes with every event that may change a judgement.
    epoch: AtomicU64,
}

/// Evidence named by the server, and the results of following it.
#[derive(Default)]
struct EvidenceProgress {
    evidence: Evidence,
    /// Lists that are not fetched again.
    checked: HashSet<Digest>,
    /// Why the last list was not taken over.
    refused: Option<String>,
    /// The task that follows the latest evidence.
    follower: Option<AbortHandle>,
}

impl SignaturePolicy {
    /// Judges with `trust`, fetches with `fetcher`, and keeps signatures in `data`.
    pub fn new(trust: Trust, fetcher: Arc<Fetcher>, data: DataDir) -> Self {
        Self { trust, fetcher, data, progress: Mutex::default(), epoch: AtomicU64::new(0) }
    }

    /// Version of the publisher list in force; 0 if the settings are in force.
    pub fn version(&self) -> u64 {
        self.trust.version()
    }

    /// The facts that current judgements depend on.
    pub fn facts(&self) -> TrustFacts {
        TrustFacts {
            epoch: self.epoch.load(Ordering::Acquire),
            list_expired: self.trust.is_list_expired(clock::wall_ms()),
            refused_list: self.progress().refused.clone(),
        }
    }

    /// Records the evidence of a desired state and starts to fetch its new parts: publisher lists,
    /// and signatures of installed packages.
    pub fn follow_evidence(self: &Arc<Self>, state: &DesiredState) {
        let mut progress = self.progress();
        if progress.evidence == state.evidence {
            return;
        }
        progress.evidence = state.evidence.clone();
        let packages = state.tasks.iter().map(|task| task.package.clone()).collect();
        let following = tokio::spawn(self.clone().follow(packages));
        if let Some(before) = progress.follower.replace(following.abort_handle()) {
            before.abort();
        }
    }

    /// Judges the package by the signatures on the disk.
    pub fn verdict(&self, package: &PackageRef) -> SignatureVerdict {
        match self.check_package(package, PackageUse::New) {
            Ok(()) => SignatureVerdict::Sufficient,
            Err(_) if self.check_package(package, PackageUse::Restart).is_ok() => {
                SignatureVerdict::Stale
            }
            Err(_) => SignatureVerdict::Insufficient,
        }
    }

    /// Whether the signatures on the disk allow this use of the package.
    pub fn check_package(
        &self,
        package: &PackageRef,
        purpose: PackageUse,
    ) -> Result<(), TrustError> {
        self.trust
            .check_package(package, &self.stored_signatures(package), purpose, clock::wall_ms())
            .map(drop)
    }

    /// Like [`Self::check_package`], after fetching the available lists and signatures.
    pub async fn ensure_trusted(
        &self,
        package: &PackageRef,
        purpose: PackageUse,
        cancel: &CancellationToken,
    ) -> Result<(), SignatureError> {
        // A package that already runs does not wait for an unreachable server.
        if purpose == PackageUse::Restart && self.check_package(package, purpose).is_ok() {
            return Ok(());
        }
        let lists = self.fetch_lists(cancel).await;
        if self.check_package(package, purpose).is_ok() {
            return Ok(());
        }
        let signatures = self.fetch_signatures(package, cancel).await;
        let Err(trust_error) = self.check_package(package, purpose) else { return Ok(()) };
        let (signatures, trust_error) = match signatures {
            // This judgement includes signatures that are not on the disk.
            Ok(Err(with_fetched)) => (None, with_fetched),
            Ok(Ok(())) => (None, trust_error),
            Err(error) => (Some(error), trust_error),
        };
        // The missing list or signature might change the judgement.
        let missing = [lists.err(), signatures].into_iter().flatten();
        let may_come = |error: &FetchError| {
            error.is_retryable() || matches!(error, FetchError::Cancelled | FetchError::Disk { .. })
        };
        Err(missing
            .filter(may_come)
            .map(SignatureError::Fetch)
            .next()
            .unwrap_or(trust_error.into()))
    }

    /// Fetches the evidence of the newest state until all of it is here or can't be fetched.
    async fn follow(self: Arc<Self>, packages: Vec<PackageRef>) {
        let cancel = CancellationToken::new();
        let mut failures = 0;
        loop {
            let mut outcome = self.fetch_lists(&cancel).await;
            for package in &packages {
                let version = self.data.task(&package.name).version(&package.manifest.digest);
                // A package that is not installed is checked before its installation.
                if version.src().is_dir() && self.verdict(package) == SignatureVerdict::Insufficient
                {
                    outcome = outcome.and(self.fetch_signatures(package, &cancel).await.map(drop));
                }
            }
            // Retry after every error: a robot that gave up would never learn that a publisher is
            // no longer trusted.
            let Err(error) = outcome else { return };
            tracing::info!(error = %chain(&error), "cannot fetch the signatures of publishers yet");
            failures += 1;
            let wait_ms = backoff_ms(failures, MAX_BACKOFF_MS, rand::random()).max(1000);
            tokio::time::sleep(Duration::from_millis(wait_ms)).await;
        }
    }

    /// Fetches the lists named after the one in force, and adopts them in order.
    async fn fetch_lists(&self, cancel: &CancellationToken) -> Result<(), FetchError> {
        let repository: RepositoryName = LIST_REPOSITORY.parse().expect("a repository's name");
        for blob in self.unchecked_lists() {
            let bytes =
                match self.fetcher.small_blob(&repository, blob, MAX_LIST_BYTES, cancel).await {
                    Ok(bytes) => bytes,
                    Err(error) => {
                        if !error.is_retryable()
                            || matches!(error, FetchError::DigestMismatch { .. })
                        {
                            let text = format!(
                                "cannot fetch the list of publishers {}: {}",
                                blob.digest,
                                chain(&error)
                            );
                            if self.progress().refused.replace(text.clone()) != Some(text) {
                                self.epoch.fetch_add(1, Ordering::AcqRel);
                            }
                        }
                        return Err(error);
                    }
                };
            let refused = match serde_json::from_slice(&bytes) {
                Ok(envelope) => match self.trust.accept_list(&envelope, blob.digest) {
                    Ok(()) => None,
                    // The follower and a task that waits for a list may both have fetched this one.
                    Err(_) if self.trust.list_digest() == Some(blob.digest) => None,
                    Err(ListError::Disk(source)) => {
                        return Err(self.write_error(&self.data.publishers(), source));
                    }
                    Err(ListError::Refused(why)) => Some(why.to_string()),
                },
                Err(error) => Some(format!("not an envelope: {error}")),
            };
            match &refused {
                Some(why) => {
                    tracing::warn!(list = %blob.digest, %why, "a list of publishers was refused")
                }
                None => tracing::info!(
                    version = self.trust.version(),
                    "now using another list of publishers"
                ),
            }
            let mut progress = self.progress();
            if progress.checked.len() >= MAX_CHECKED_LISTS {
                progress.checked.clear();
            }
            progress.checked.insert(blob.digest);
            // The result of the newest list, which comes last, is stored.
            progress.refused = refused
                .map(|why| format!("the list of publishers {} was refused: {why}", blob.digest));
            self.epoch.fetch_add(1, Ordering::AcqRel);
        }
        Ok(())
    }

    /// Fetches the named signatures of a package. Keeps the valid ones if they suffice, and
    /// otherwise returns the reason.
    async fn fetch_signatures(
        &self,
        package: &PackageRef,
        cancel: &CancellationToken,
    ) -> Result<Result<(), TrustError>, FetchError> {
        let repository = RepositoryName::of_package(&package.name);
        let mut envelopes = Vec::new();
        let mut failed = None;
        let named = self.progress().evidence.signatures_of(package);
        for blob in named.into_iter().take(MAX_SIGNATURES) {
            match self.fetcher.small_blob(&repository, blob, MAX_SIGNATURE_BYTES, cancel).await {
                // Other bytes are not a signature.
                Ok(bytes) => envelopes.extend(serde_json::from_slice::<Envelope>(&bytes).ok()),
                Err(error) => failed = Some(error),
            }
        }
        // Kept signatures come last: their number may already be the most that is checked.
        envelopes.extend(self.stored_signatures(package));
        // An expired list does not invalidate a signature.
        let counted = match self.trust.check_package(
            package,
            &envelopes,
            PackageUse::Restart,
            clock::wall_ms(),
        ) {
            Ok(counted) => counted,
            Err(trust_error) => return failed.map_or(Ok(Err(trust_error)), Err),
        };
        let path = self.data.task(&package.name).signatures(&package.manifest.digest);
        trust::write_signatures(&path, &counted)
            .map_err(|source| self.write_error(&path, source))?;
        self.epoch.fetch_add(1, Ordering::AcqRel);
        Ok(Ok(()))
    }

    /// Lists named after the one in force that were not refused before.
    fn unchecked_lists(&self) -> Vec<BlobRef> {
        let progress = self.progress();
        let lists = &progress.evidence.lists[..progress.evidence.lists.len().min(MAX_LISTS)];
        let counting = self.trust.list_digest();
        let known =
            lists.iter().rposition(|list| Some(list.digest) == counting).map_or(0, |at| at + 1);
        lists[known..]
            .iter()
            .filter(|list| !progress.checked.contains(&list.digest))
            .copied()
            .collect()
    }

    fn write_error(&self, path: &Path, source: io::Error) -> FetchError {
        FetchError::disk(path, source)
            .or_disk_full(self.data.root(), Need::of_file(MAX_SIGNATURE_BYTES))
    }

    fn stored_signatures(&self, package: &PackageRef) -> Vec<Envelope> {
        trust::read_signatures(&self.data.task(&package.name).signatures(&package.manifest.digest))
    }

    fn progress(&self) -> MutexGuard<'_, EvidenceProgress> {
        // Every change under the lock is complete in itself.
        self.progress.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
