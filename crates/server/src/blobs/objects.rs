//! The objects of the servers' common store: a bucket, or a directory that all have mounted. Every
//! wait has a limit. This module knows no digest's meaning and no row of the database.

use std::fs::{self, File};
use std::io::{self, Read as _};
use std::os::unix::fs::FileExt as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use futures_util::stream::BoxStream;
use futures_util::{StreamExt as _, TryStreamExt as _};
use object_store::aws::{AmazonS3Builder, AmazonS3ConfigKey};
use object_store::local::LocalFileSystem;
use object_store::path::Path as Location;
use object_store::{
    ClientOptions, Error, GetResultPayload, ObjectStore, ObjectStoreExt as _, RetryConfig,
    WriteMultipart,
};
use task_proto::ids::digest::Algorithm;
use tokio_util::io::ReaderStream;

use super::{BlobError, modified_ms, on_disk};
use crate::domain::blob_store_url::{BlobStoreUrl, S3Bucket};

/// An object up to this size is written by one request, a larger one in parts of at least this.
const PART_BYTES: u64 = 8 << 20;
/// The most parts of one object, below S3's limit of 10,000.
const MAX_PARTS: u64 = 9_000;
/// Parts of one object that are under way at once.
const CONCURRENT_PARTS: usize = 2;
/// Bytes read from a file at once.
const READ_BYTES: usize = 1 << 20;
/// Time limit of an answer, and of a part's way to the store.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(60);
/// Time limit for the end of an object in parts, which a directory writes to its disk then.
const COMPLETE_TIMEOUT: Duration = Duration::from_secs(10 * 60);
const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);
/// Time limit of the repetitions of a failed request.
const RETRY_TIMEOUT: Duration = Duration::from_secs(10);
const RETRIES: usize = 4;
/// The object with the store's own name.
const NAME_OBJECT: &str = "taskd-store";
const MAX_NAME_BYTES: u64 = 256;
/// The largest file with an S3 key.
const MAX_CREDENTIALS_BYTES: u64 = 64 * 1024;

/// The reason why the setting `blobs.store` can't be used.
#[derive(Debug, thiserror::Error)]
pub enum ObjectsError {
    #[error("blobs.store: the directory {} can't be used", path.display())]
    Directory { path: PathBuf, source: Error },
    #[error("blobs.store: the file of credentials {} can't be read", path.display())]
    Credentials { path: PathBuf, source: io::Error },
    #[error(
        "blobs.store: the file of credentials {} has no lines aws_access_key_id = … and aws_secret_access_key = …",
        path.display()
    )]
    NoKey { path: PathBuf },
    #[error("blobs.store: the S3 client can't be set up")]
    Client(#[source] Error),
}

/// A request to the store that got no answer in time.
#[derive(Debug, thiserror::Error)]
#[error("no answer within {} s", after.as_secs())]
struct TimedOut {
    after: Duration,
}

/// The access to the store. Clones share it.
#[derive(Clone)]
pub(super) struct Objects {
    store: Arc<dyn ObjectStore>,
    /// The directory, if the store is one.
    directory: Option<PathBuf>,
}

/// An object's size and bytes.
pub(super) struct Object {
    pub(super) bytes: u64,
    pub(super) content: BoxStream<'static, Result<Bytes, BlobError>>,
}

/// An object of the list.
pub(super) struct ListedObject {
    pub(super) name: String,
    pub(super) modified_ms: u64,
}

impl Objects {
    /// Prepares the access; asks nothing of an S3 server.
    pub(super) fn connect(url: &BlobStoreUrl) -> Result<Self, ObjectsError> {
        match url {
            BlobStoreUrl::Directory(path) => {
                let failed = |source| ObjectsError::Directory { path: path.clone(), source };
                let store = LocalFileSystem::new_with_prefix(path).map_err(failed)?;
                let store = Arc::new(store.with_fsync(true));
                Ok(Self { store, directory: Some(path.clone()) })
            }
            BlobStoreUrl::S3(bucket) => Ok(Self { store: Arc::new(s3(bucket)?), directory: None }),
        }
    }

    /// Writes the file's content as an object. On return it is stored for good.
    pub(super) async fn put(&self, object: &str, path: &Path, bytes: u64) -> Result<(), BlobError> {
        let (location, path) = (Location::from(object), path.to_owned());
        let opened = path.clone();
        let file = on_disk(move || File::open(&opened).map_err(BlobError::disk("open", &opened)));
        let file = Arc::new(file.await?);
        if bytes <= PART_BYTES {
            let content = read_at(&file, &path, 0, bytes).await?;
            return limited("write an object", self.store.put(&location, content.into()))
                .await
                .map(drop);
        }
        let upload = limited("begin an object", self.store.put_multipart(&location)).await?;
        let part_bytes = usize::try_from(PART_BYTES.max(bytes.div_ceil(MAX_PARTS)));
        let mut upload =
            WriteMultipart::new_with_chunk_size(upload, part_bytes.unwrap_or(usize::MAX));
        let sent = send(&mut upload, &file, &path, bytes).await;
        if let Err(error) = sent {
            // Best effort: without an answer the store keeps the parts until its own rule ends
            // them.
            let _ = limited("abort an object", upload.abort()).await;
            return Err(error);
        }
        match tokio::time::timeout(COMPLETE_TIMEOUT, upload.finish()).await {
            Ok(finished) => finished.map(drop).map_err(failed("complete an object")),
            Err(_) => Err(timed_out("complete an object", COMPLETE_TIMEOUT)),
        }
    }

    /// The object; `None` if there is none of this name.
    pub(super) async fn get(&self, object: &str) -> Result<Option<Object>, BlobError> {
        let location = Location::from(object);
        let found = match tokio::time::timeout(ANSWER_TIMEOUT, self.store.get(&location)).await {
            Ok(Err(Error::NotFound { .. })) => return Ok(None),
            Ok(found) => found.map_err(failed("read an object"))?,
            Err(_) => return Err(timed_out("read an object", ANSWER_TIMEOUT)),
        };
        let failed = failed("read an object");
        let content = match found.payload {
            GetResultPayload::File(file, _) => {
                let file = tokio::fs::File::from_std(file);
                let content = ReaderStream::with_capacity(file, READ_BYTES);
                content.map_err(super::common_store_error("read an object")).boxed()
            }
            GetResultPayload::Stream(content) => content.map_err(failed).boxed(),
        };
        Ok(Some(Object { bytes: found.meta.size, content: with_timeout(content) }))
    }

    /// Deletes the object, if there is one.
    pub(super) async fn delete(&self, object: &str) -> Result<(), BlobError> {
        let location = Location::from(object);
        match tokio::time::timeout(ANSWER_TIMEOUT, self.store.delete(&location)).await {
            Ok(Err(Error::NotFound { .. })) => Ok(()),
            Ok(deleted) => deleted.map_err(failed("delete an object")),
            Err(_) => Err(timed_out("delete an object", ANSWER_TIMEOUT)),
        }
    }

    /// All objects that hold blobs of this algorithm.
    pub(super) fn list(
        &self,
        algorithm: Algorithm,
    ) -> BoxStream<'static, Result<ListedObject, BlobError>> {
        let listed = self.store.list(Some(&Location::from(algorithm.as_str())));
        let listed = listed.map_ok(|meta| ListedObject {
            name: meta.location.to_string(),
            modified_ms: u64::try_from(meta.last_modified.timestamp_millis()).unwrap_or(0),
        });
        with_timeout(listed.map_err(failed("list its objects")).boxed())
    }

    /// The name that the store has in itself; `None` if it has none.
    pub(super) async fn read_name(&self) -> Result<Option<String>, BlobError> {
        let location = Location::from(NAME_OBJECT);
        let read = async {
            let found = self.store.get(&location).await?;
            if found.meta.size > MAX_NAME_BYTES { Ok(Bytes::new()) } else { found.bytes().await }
        };
        match tokio::time::timeout(ANSWER_TIMEOUT, read).await {
            Ok(Err(Error::NotFound { .. })) => Ok(None),
            Ok(Err(error)) => Err(failed("read its name")(error)),
            Ok(Ok(name)) => Ok(Some(String::from_utf8_lossy(&name).trim().to_owned())),
            Err(_) => Err(timed_out("read its name", ANSWER_TIMEOUT)),
        }
    }

    /// Whether the store is a directory, in whose place another may be if it is not mounted.
    pub(super) fn is_directory(&self) -> bool {
        self.directory.is_some()
    }

    pub(super) async fn write_name(&self, name: &str) -> Result<(), BlobError> {
        let (location, name) = (Location::from(NAME_OBJECT), format!("{name}\n"));
        limited("write its name", self.store.put(&location, name.into())).await.map(drop)
    }

    /// Removes the incomplete files of killed servers from a directory, last written before
    /// `before_ms`. In S3 a rule of the bucket ends such parts.
    pub(super) async fn remove_abandoned(&self, before_ms: u64) -> Result<(), BlobError> {
        let Some(directory) = self.directory.clone() else { return Ok(()) };
        on_disk(move || {
            for algorithm in Algorithm::ALL {
                let directory = directory.join(algorithm.as_str());
                let entries = match fs::read_dir(&directory) {
                    Err(error) if error.kind() == io::ErrorKind::NotFound => continue,
                    entries => entries.map_err(BlobError::disk("list", &directory))?,
                };
                for entry in entries.flatten() {
                    let is_partial = entry.file_name().to_string_lossy().contains('#');
                    let modified = entry.metadata().and_then(|metadata| modified_ms(&metadata));
                    if is_partial && modified.is_ok_and(|modified| modified < before_ms) {
                        // Best effort: the next call meets the file again.
                        let _ = fs::remove_file(entry.path());
                    }
                }
            }
            Ok(())
        })
        .await
    }
}

/// Hands the file's bytes to the upload, a few parts at a time.
async fn send(
    upload: &mut WriteMultipart,
    file: &Arc<File>,
    path: &Path,
    bytes: u64,
) -> Result<(), BlobError> {
    let mut offset = 0;
    while offset < bytes {
        let length = (bytes - offset).min(READ_BYTES as u64);
        let piece = read_at(file, path, offset, length).await?;
        limited("write a part", upload.wait_for_capacity(CONCURRENT_PARTS)).await?;
        upload.put(piece);
        offset += length;
    }
    Ok(())
}

async fn read_at(
    file: &Arc<File>,
    path: &Path,
    offset: u64,
    length: u64,
) -> Result<Bytes, BlobError> {
    let (file, path) = (file.clone(), path.to_owned());
    on_disk(move || {
        let unreadable = BlobError::disk("read", &path);
        let Ok(length) = usize::try_from(length) else {
            return Err(unreadable(io::ErrorKind::OutOfMemory.into()));
        };
        let mut content = vec![0; length];
        file.read_exact_at(&mut content, offset).map_err(unreadable)?;
        Ok(content.into())
    })
    .await
}

/// Ends a stream whose next item takes too long.
fn with_timeout<T: Send + 'static>(
    items: BoxStream<'static, Result<T, BlobError>>,
) -> BoxStream<'static, Result<T, BlobError>> {
    let next = |mut items: BoxStream<'static, Result<T, BlobError>>| async move {
        match tokio::time::timeout(ANSWER_TIMEOUT, items.try_next()).await {
            Ok(next) => Ok(next?.map(|item| (item, items))),
            Err(_) => Err(timed_out("continue an answer", ANSWER_TIMEOUT)),
        }
    };
    futures_util::stream::try_unfold(items, next).boxed()
}

async fn limited<T>(
    action: &'static str,
    request: impl Future<Output = object_store::Result<T>>,
) -> Result<T, BlobError> {
    match tokio::time::timeout(ANSWER_TIMEOUT, request).await {
        Ok(answer) => answer.map_err(failed(action)),
        Err(_) => Err(timed_out(action, ANSWER_TIMEOUT)),
    }
}

fn failed(action: &'static str) -> impl Fn(Error) -> BlobError + Send {
    move |error| super::common_store_error(action)(error)
}

fn timed_out(action: &'static str, after: Duration) -> BlobError {
    super::common_store_error(action)(TimedOut { after })
}

/// The client of a bucket. Its key comes from the named file, or from the environment.
fn s3(bucket: &S3Bucket) -> Result<object_store::aws::AmazonS3, ObjectsError> {
    // The client needs a provider of cryptography; another part may have named it before.
    let _ = rustls::crypto::ring::default_provider().install_default();
    let is_plaintext =
        bucket.endpoint.as_ref().is_some_and(|endpoint| endpoint.starts_with("http://"));
    let options = ClientOptions::new()
        .with_allow_http(is_plaintext)
        .with_connect_timeout(CONNECT_TIMEOUT)
        .with_read_timeout(ANSWER_TIMEOUT)
        .with_timeout_disabled();
    let retries = RetryConfig {
        max_retries: RETRIES,
        retry_timeout: RETRY_TIMEOUT,
        ..RetryConfig::default()
    };
    let mut builder = AmazonS3Builder::from_env()
        .with_bucket_name(&bucket.bucket)
        .with_client_options(options)
        .with_retry(retries)
        // Not every S3-compatible server deletes several objects by one request.
        .with_disable_bulk_delete(true);
    if let Some(endpoint) = &bucket.endpoint {
        builder = builder.with_config(AmazonS3ConfigKey::S3Endpoint, endpoint);
    }
    if let Some(region) = &bucket.region {
        builder = builder.with_region(region);
    }
    if let Some(path) = &bucket.credentials {
        let (id, secret) = read_credentials(path)?;
        builder = builder.with_access_key_id(id).with_secret_access_key(secret);
    }
    builder.build().map_err(ObjectsError::Client)
}

/// Reads a key from a file of AWS's form: the first profile of `~/.aws/credentials`.
fn read_credentials(path: &Path) -> Result<(String, String), ObjectsError> {
    let unreadable = |source| ObjectsError::Credentials { path: path.to_owned(), source };
    let mut text = String::new();
    let file = File::open(path).map_err(unreadable)?;
    file.take(MAX_CREDENTIALS_BYTES).read_to_string(&mut text).map_err(unreadable)?;
    let value = |name: &str| {
        let values = text.lines().filter_map(|line| {
            let (key, value) = line.split_once('=')?;
            (key.trim() == name).then(|| value.trim().to_owned())
        });
        values.into_iter().find(|value| !value.is_empty())
    };
    match (value("aws_access_key_id"), value("aws_secret_access_key")) {
        (Some(id), Some(secret)) => Ok((id, secret)),
        _ => Err(ObjectsError::NoKey { path: path.to_owned() }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn credentials_are_read_and_never_shown() {
        let directory = tempfile::tempdir().expect("a directory");
        let path = directory.path().join("key");
        let text =
            "[default]\n# taskd's\naws_access_key_id = AKIA1\naws_secret_access_key=s3cr=t\n";
        fs::write(&path, text).expect("written");
        let key = read_credentials(&path).expect("read");
        assert_eq!(key, ("AKIA1".to_owned(), "s3cr=t".to_owned()));
        fs::write(&path, "aws_secret_access_key = s3cret\n").expect("written");
        let message = read_credentials(&path).expect_err("incomplete").to_string();
        assert!(message.starts_with("blobs.store: ") && !message.contains("s3cret"), "{message}");
    }
}
