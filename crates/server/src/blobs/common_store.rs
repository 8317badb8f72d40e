//! The servers' common store of blobs: objects hold the bytes, rows of the database say which
//! object holds which blob. An object's name is used once, so a write never meets a deletion. This
//! module knows no local copy and never decides which blobs are needed.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use futures_util::{StreamExt as _, TryStreamExt as _};
use task_proto::Digest;
use task_proto::ids::digest::Algorithm;
use task_proto::time::millis;

use super::objects::{ListedObject, Object, Objects, ObjectsError};
use super::{BlobError, common_store_error};
use crate::domain::blob_store_url::BlobStoreUrl;
use crate::store::{Store, StoreError, StoredBlob};

/// Time for which an object without a row is left alone: its row may be about to be written.
const ORPHAN_AGE: Duration = Duration::from_secs(24 * 60 * 60);
/// Time limit of the question whether the store answers.
const PROBE_TIMEOUT: Duration = Duration::from_secs(4);
/// Objects that are compared with the rows at once.
const LIST_BATCH: usize = 512;

/// The reason why the common store can't be used.
#[derive(Debug, thiserror::Error)]
pub enum CommonStoreError {
    #[error(transparent)]
    Objects(#[from] ObjectsError),
    /// The database names another store.
    #[error(
        "blobs.store: {url} is not the store that holds this database's blobs (its object taskd-store {found}): is the \
         directory mounted, is the bucket the right one?"
    )]
    OtherStore { url: String, found: &'static str },
    /// The store belongs to another database, whose servers would delete our objects.
    #[error(
        "blobs.store: {url} belongs to another database (it has an object taskd-store): name an empty directory or \
         bucket, or copy that database with taskd database copy"
    )]
    Foreign { url: String },
    /// The first use of a store needs its answer.
    #[error("blobs.store: {url} does not answer")]
    Silent { url: String, source: Box<BlobError> },
    #[error(transparent)]
    Store(#[from] StoreError),
}

/// The common store. Clones share it.
#[derive(Clone)]
pub struct CommonStore {
    store: Store,
    objects: Objects,
    url: Arc<str>,
    /// The store's own name, by which we know that it is the right one.
    name: Arc<str>,
    /// Locked while [`Self::problem`] waits for the store.
    probing: Arc<tokio::sync::Mutex<()>>,
}

impl CommonStore {
    /// Opens the store of this setting. Its first use gives it a name; later, a store without this
    /// name is refused. A store that does not answer may be opened again: local copies are readable.
    pub async fn open(store: Store, url: &BlobStoreUrl) -> Result<Self, CommonStoreError> {
        let objects = Objects::connect(url)?;
        let url = url.to_string();
        let recorded = store.stored_blobs().store_name().await?;
        let found = objects.read_name().await;
        let name = match (recorded, found) {
            (Some(recorded), Ok(Some(found))) if recorded == found => recorded,
            (Some(_), Ok(Some(_))) => {
                return Err(CommonStoreError::OtherStore { url, found: "has another name" });
            }
            // An earlier start ended in between, so no object was ever written.
            (Some(recorded), Ok(None)) if !store.stored_blobs().has_any().await? => {
                name_objects(&objects, &url, &recorded).await?;
                recorded
            }
            (Some(_), Ok(None)) => {
                return Err(CommonStoreError::OtherStore { url, found: "is missing" });
            }
            (Some(recorded), Err(error)) => {
                let error = &error as &dyn std::error::Error;
                tracing::error!(error, "blobs.store: {url} does not answer; pushes are refused");
                recorded
            }
            (None, Ok(None)) => {
                let name = format!("{:032x}", rand::random::<u128>());
                let recorded = store.stored_blobs().name_store(&name).await?;
                name_objects(&objects, &url, &recorded).await?;
                recorded
            }
            (None, Ok(Some(_))) => return Err(CommonStoreError::Foreign { url }),
            (None, Err(source)) => {
                return Err(CommonStoreError::Silent { url, source: source.into() });
            }
        };
        let (url, name) = (url.into(), name.into());
        Ok(Self { store, objects, url, name, probing: Arc::default() })
    }

    /// The reason why the store can't be used now, or `None`. A mount that hangs keeps one thread,
    /// not one for each call.
    pub async fn problem(&self) -> Option<String> {
        let silent = || Some(format!("{}: it does not answer", self.url));
        let Ok(probing) = self.probing.clone().try_lock_owned() else { return silent() };
        let store = self.clone();
        let probe = tokio::spawn(async move {
            let checked = store.check_name().await;
            drop(probing);
            checked
        });
        let error = match tokio::time::timeout(PROBE_TIMEOUT, probe).await {
            Ok(Ok(Ok(()))) => return None,
            Ok(Ok(Err(error))) => error,
            Ok(Err(_)) | Err(_) => return silent(),
        };
        let causes = std::iter::successors(std::error::Error::source(&error), |e| e.source());
        let text = format!("{}: {error}", self.url);
        Some(causes.fold(text, |text, cause| format!("{text}: {cause}")))
    }

    /// Fails if the store does not answer, or is not the one that holds our objects.
    async fn check_name(&self) -> Result<(), BlobError> {
        match self.objects.read_name().await? {
            Some(found) if *found == *self.name => Ok(()),
            _ => Err(BlobError::OtherStore),
        }
    }

    pub(super) async fn find(&self, digest: Digest) -> Result<Option<StoredBlob>, BlobError> {
        Ok(self.store.stored_blobs().find(&digest).await?)
    }

    pub(super) async fn touch(&self, digest: Digest, now_ms: u64) -> Result<bool, BlobError> {
        Ok(self.store.stored_blobs().touch(&digest, now_ms).await?)
    }

    pub(super) async fn untouched_since(&self, before_ms: u64) -> Result<Vec<Digest>, BlobError> {
        Ok(self.store.stored_blobs().untouched_since(before_ms).await?)
    }

    pub(super) async fn used_bytes(&self) -> Result<u64, BlobError> {
        Ok(self.store.stored_blobs().used_bytes().await?)
    }

    /// Stores a verified file as this blob, unless the blob is stored. On return, every server has
    /// it.
    pub(super) async fn put(
        &self,
        digest: Digest,
        file: &Path,
        bytes: u64,
        now_ms: u64,
    ) -> Result<(), BlobError> {
        // Most pushes bring new blobs, so the look comes before the write.
        if self.find(digest).await?.is_some() && self.touch(digest, now_ms).await? {
            return Ok(());
        }
        let blob = self.write_object(digest, file, bytes).await?;
        self.record(blob, now_ms).await
    }

    /// Records a complete object as its blob's. If another push was first, our object goes again.
    pub(super) async fn record(&self, blob: StoredBlob, now_ms: u64) -> Result<(), BlobError> {
        let recorded = self.store.stored_blobs().insert(&blob, now_ms).await?;
        if recorded != blob.object {
            self.delete_object(&blob).await;
        }
        Ok(())
    }

    /// The object of a stored blob. `None` if the blob turns out to be absent: its row is removed
    /// if the object is missing in a store that otherwise answers, so that a push stores it again.
    pub(super) async fn read(&self, blob: &StoredBlob) -> Result<Option<Object>, BlobError> {
        match self.objects.get(&blob.object).await? {
            Some(object) if object.bytes == blob.bytes => Ok(Some(object)),
            Some(_) => {
                self.remove_damaged(blob).await?;
                Ok(None)
            }
            None => {
                // A directory that is not mounted has no objects either.
                self.check_name().await?;
                self.remove_damaged(blob).await?;
                Ok(None)
            }
        }
    }

    /// Makes a blob absent whose object does not hold its bytes. The object stays for a while.
    pub(super) async fn remove_damaged(&self, blob: &StoredBlob) -> Result<(), BlobError> {
        if self.store.stored_blobs().remove_damaged(blob).await? {
            tracing::error!(
                digest = %blob.digest, object = blob.object,
                "an object of blobs.store does not hold its blob: push the package again"
            );
        }
        Ok(())
    }

    /// Removes those of `candidates` that nothing needs and no pusher asked for since `before_ms`.
    /// Returns them.
    pub(super) async fn remove_unneeded(
        &self,
        candidates: &[Digest],
        before_ms: u64,
    ) -> Result<Vec<Digest>, BlobError> {
        let removed = self.store.stored_blobs().remove_unneeded(candidates, before_ms).await?;
        for blob in &removed {
            self.delete_object(blob).await;
        }
        Ok(removed.into_iter().map(|blob| blob.digest).collect())
    }

    /// Deletes objects that hold no blob and are older than a day: their server was killed between
    /// object and row. Returns their number.
    pub(super) async fn remove_orphans(&self, now_ms: u64) -> Result<usize, BlobError> {
        // In another store, all objects would be without a row.
        self.check_name().await?;
        let before_ms = now_ms.saturating_sub(millis(ORPHAN_AGE));
        self.objects.remove_abandoned(before_ms).await?;
        let mut removed = 0;
        for algorithm in Algorithm::ALL {
            let old = |object: &ListedObject| object.modified_ms < before_ms;
            let listed = self.objects.list(algorithm);
            let names = listed.try_filter_map(|object| {
                let name = old(&object).then_some(object.name);
                async move { Ok(name) }
            });
            let mut batches = names.try_chunks(LIST_BATCH).boxed();
            while let Some(batch) = batches.try_next().await.map_err(|error| error.1)? {
                for object in self.store.stored_blobs().unknown_objects(batch).await? {
                    self.objects.delete(&object).await?;
                    removed += 1;
                }
            }
        }
        Ok(removed)
    }

    /// Deletes an object that no row names. A failure leaves an orphan.
    async fn delete_object(&self, blob: &StoredBlob) {
        if let Err(error) = self.objects.delete(&blob.object).await {
            let error = &error as &dyn std::error::Error;
            tracing::warn!(error, object = blob.object, "an unneeded object stays for some days");
        }
    }

    /// Writes the file as a new object of the blob, without a row.
    pub(super) async fn write_object(
        &self,
        digest: Digest,
        file: &Path,
        bytes: u64,
    ) -> Result<StoredBlob, BlobError> {
        let object = new_object_name(digest);
        // A later mount hides the files that are written while it is missing.
        if self.objects.is_directory() {
            self.check_name().await?;
        }
        self.objects.put(&object, file, bytes).await?;
        if self.objects.is_directory() {
            self.check_name().await?;
        }
        Ok(StoredBlob { digest, bytes, object })
    }

    /// Reads a new object back. Fails if it is missing.
    pub(super) async fn read_object(&self, blob: &StoredBlob) -> Result<Object, BlobError> {
        let missing = || common_store_error("find an object")(std::io::Error::other("missing"));
        self.objects.get(&blob.object).await?.ok_or_else(missing)
    }
}

async fn name_objects(objects: &Objects, url: &str, name: &str) -> Result<(), CommonStoreError> {
    let silent =
        |source: BlobError| CommonStoreError::Silent { url: url.to_owned(), source: source.into() };
    objects.write_name(name).await.map_err(silent)
}

/// A name that no object ever had.
fn new_object_name(digest: Digest) -> String {
    let (algorithm, hex) = (digest.algorithm().as_str(), digest.hex());
    format!("{algorithm}/{hex}.{:016x}", rand::random::<u64>())
}
