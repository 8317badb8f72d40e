//! Pulls until the bytes match the ordered digest. A network that flips bytes is a network fault
//! like a cut, and TCP does not detect every flip. Bytes with another digest are pulled again as a
//! whole a few times, and then repaired range by range. If the digest still differs, the server is
//! at fault, and the error says so.

use std::sync::Arc;
use std::time::Duration;

use task_proto::desired::{BlobRef, PackageRef};
use task_proto::messages::report::Progress;
use task_proto::packages::manifest::TaskManifest;
use task_proto::{Digest, RepositoryName};
use tokio::sync::{OwnedMutexGuard, watch};
use tokio_util::sync::CancellationToken;

use super::{FetchError, Fetcher};

/// Number of full repeats for bytes with another digest. After that, ranges are compared.
const MAX_FULL_RETRIES: u32 = 2;

impl Fetcher {
    /// Pulls a content. A `.part` damaged by a power cut and wrong pushed parts are pulled again as
    /// well.
    pub(super) async fn pull_until_verified(
        &self,
        package: &PackageRef,
        manifest: &TaskManifest,
        progress: &watch::Sender<Progress>,
        cancel: &CancellationToken,
        lock: Arc<OwnedMutexGuard<()>>,
    ) -> Result<(), FetchError> {
        for retry in 1..=MAX_FULL_RETRIES {
            match self.pull_content(package, manifest, progress, cancel, lock.clone()).await {
                Err(FetchError::DigestMismatch { reason, .. }) => {
                    tracing::warn!(package = %package.name, reason, retry, "received wrong bytes; pulling them again");
                }
                ended => return ended,
            }
            self.discard(package)?;
            cancel
                .run_until_cancelled(tokio::time::sleep(self.pause_before(retry)))
                .await
                .ok_or(FetchError::Cancelled)?;
        }
        match self.pull_content(package, manifest, progress, cancel, lock.clone()).await {
            Err(FetchError::DigestMismatch { .. })
                if self.present(package)? == package.content.size => {}
            ended => return ended.map_err(FetchError::confirmed),
        }
        tracing::warn!(package = %package.name, "received wrong bytes again; comparing ranges");
        let repaired = cancel.run_until_cancelled(self.repair_content(package, &lock)).await;
        repaired.ok_or(FetchError::Cancelled)??;
        self.pull_content(package, manifest, progress, cancel, lock)
            .await
            .map_err(FetchError::confirmed)
    }

    /// Pulls a blob into memory. Bytes with another digest are pulled again, as for a content.
    pub(super) async fn pull_whole(
        &self,
        repository: &RepositoryName,
        blob: BlobRef,
    ) -> Result<Vec<u8>, FetchError> {
        let mut retry = 0;
        loop {
            let is_last = retry == MAX_FULL_RETRIES;
            let error = match self.pull_once(repository, blob).await {
                Ok(bytes) if Digest::of(&bytes) == blob.digest => return Ok(bytes),
                Ok(bytes) if is_last => {
                    let bytes = self
                        .repaired(repository, blob, bytes)
                        .await
                        .map_err(FetchError::confirmed)?;
                    let found = Digest::of(&bytes);
                    let is_repaired = found == blob.digest;
                    return is_repaired
                        .then_some(bytes)
                        .ok_or(FetchError::digest_mismatch(blob.digest, found).confirmed());
                }
                Ok(bytes) => FetchError::digest_mismatch(blob.digest, Digest::of(&bytes)),
                Err(error @ FetchError::DigestMismatch { .. }) if !is_last => error,
                Err(error) => return Err(error.confirmed()),
            };
            retry += 1;
            tracing::warn!(digest = %blob.digest, %error, retry, "received wrong bytes; pulling them again");
            tokio::time::sleep(self.pause_before(retry)).await;
        }
    }

    async fn pull_once(
        &self,
        repository: &RepositoryName,
        blob: BlobRef,
    ) -> Result<Vec<u8>, FetchError> {
        let request = || self.request(repository, blob);
        let download = self.start(request, repository, blob, 0..blob.size).await?;
        download.collect(blob.size).await
    }

    fn pause_before(&self, retry: u32) -> Duration {
        self.settings().reconnect_wait.mul_f64(rand::random::<f64>() * f64::from(retry))
    }
}
