//! Several servers' blobs in one common store: a directory, and an S3 server. Each test has real
//! files, a real database and, for S3, versitygw over a directory, so tests may look at the objects
//! and change them.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Stdio};
use std::time::Duration;

use bytes::Bytes;
use futures_util::TryStreamExt as _;
use task_proto::Digest;
use task_proto::ids::digest::Algorithm;
use taskd::blobs::collector;
use taskd::blobs::{BlobSettings, Blobs, CommonStore, CommonStoreError, Content};
use taskd::domain::blob_store_url::BlobStoreUrl;
use tempfile::TempDir;

use crate::corruption::eventually;
use crate::database::TestDatabase;
use crate::postgres_cluster::free_port;

const DAY_MS: u64 = 24 * 60 * 60 * 1000;
/// Later than the times of all files that a test writes.
const NOW_MS: u64 = 4_000_000_000_000;
const GRACE: Duration = Duration::from_secs(3600);
const MB: usize = 1 << 20;
/// Time limit that only a hanging test exceeds.
const PATIENCE: Duration = Duration::from_secs(60);

/// A store whose objects are files below a directory.
pub struct Objects {
    directory: TempDir,
    gateway: Option<Gateway>,
}

/// An S3 server over a directory of buckets.
struct Gateway {
    process: Child,
    port: u16,
}

impl Drop for Gateway {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

impl Gateway {
    #[expect(clippy::disallowed_methods, reason = "the test starts the S3 server")]
    fn start(directory: &Path, port: u16) -> Self {
        let program = std::env::var("TASKD_TEST_VERSITYGW").expect(
            "TASKD_TEST_VERSITYGW is not set: run ./scripts/test, or set it to what \
             scripts/need versitygw prints",
        );
        let process = std::process::Command::new(program)
            .args(["--access", "test", "--secret", "swordfish", "--region", "us-east-1"])
            .args(["--port", &format!("127.0.0.1:{port}"), "--quiet", "posix"])
            .arg(directory.join("buckets"))
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .expect("it starts");
        Self { process, port }
    }

    async fn answers(&self) {
        eventually("the S3 server answers", async || {
            tokio::net::TcpStream::connect(("127.0.0.1", self.port)).await.is_ok()
        })
        .await;
    }
}

impl Objects {
    pub fn in_directory() -> Self {
        let directory = TempDir::new().expect("a directory");
        fs::create_dir(directory.path().join("store")).expect("made");
        Self { directory, gateway: None }
    }

    pub async fn in_s3() -> Self {
        let directory = TempDir::new().expect("a directory");
        fs::create_dir_all(directory.path().join("buckets/fleet")).expect("made");
        let key = "[default]\naws_access_key_id = test\naws_secret_access_key = swordfish\n";
        fs::write(directory.path().join("key"), key).expect("written");
        let gateway = Gateway::start(directory.path(), free_port());
        gateway.answers().await;
        Self { directory, gateway: Some(gateway) }
    }

    /// The value of the setting `blobs.store`.
    pub fn setting(&self) -> String {
        match &self.gateway {
            None => format!("file://{}", self.root().display()),
            Some(Gateway { port, .. }) => format!(
                "s3://fleet?endpoint=http://127.0.0.1:{port}&region=us-east-1&credentials={}",
                self.directory.path().join("key").display()
            ),
        }
    }

    pub fn url(&self) -> BlobStoreUrl {
        self.setting().parse().expect("valid")
    }

    fn root(&self) -> PathBuf {
        self.directory.path().join(if self.gateway.is_some() { "buckets/fleet" } else { "store" })
    }

    /// The files of all objects that hold, or held, a blob.
    pub fn files(&self) -> BTreeSet<PathBuf> {
        files_below(&self.root().join("sha256"))
    }

    fn file_of(&self, digest: Digest) -> PathBuf {
        let prefix = format!("{}.", digest.hex());
        let of_digest = |path: &PathBuf| {
            path.file_name().is_some_and(|name| name.to_string_lossy().starts_with(&prefix))
        };
        let mut found = self.files().into_iter().filter(of_digest);
        found.next().unwrap_or_else(|| panic!("no object holds {digest}"))
    }

    /// Makes the store unreachable.
    fn stop(&mut self) {
        match &mut self.gateway {
            Some(gateway) => {
                gateway.process.kill().expect("killed");
                gateway.process.wait().expect("ended");
            }
            None => fs::rename(self.root(), self.directory.path().join("away")).expect("renamed"),
        }
    }

    async fn start(&mut self) {
        match &mut self.gateway {
            Some(gateway) => {
                *gateway = Gateway::start(self.directory.path(), gateway.port);
                gateway.answers().await;
            }
            None => fs::rename(self.directory.path().join("away"), self.root()).expect("renamed"),
        }
    }
}

pub fn files_below(directory: &Path) -> BTreeSet<PathBuf> {
    let Ok(entries) = fs::read_dir(directory) else { return BTreeSet::new() };
    entries.map(|entry| entry.expect("an entry").path()).filter(|path| path.is_file()).collect()
}

/// The blobs of one server.
struct Node {
    blobs: Blobs,
    data: TempDir,
}

impl Node {
    async fn start(database: &TestDatabase, objects: &Objects) -> Self {
        Self::start_with(database, objects, BlobSettings::default()).await
    }

    async fn start_with(
        database: &TestDatabase,
        objects: &Objects,
        settings: BlobSettings,
    ) -> Self {
        let data = TempDir::new().expect("a directory");
        let common =
            CommonStore::open(database.store.clone(), &objects.url()).await.expect("opens");
        let blobs = Blobs::open_with(data.path(), settings, common).expect("opens");
        Self { blobs, data }
    }

    async fn put(&self, bytes: &[u8]) -> Digest {
        let bytes = Bytes::copy_from_slice(bytes);
        self.blobs.put(Algorithm::Sha256, bytes, NOW_MS).await.expect("stored")
    }

    /// The whole blob; `None` if it is absent, an error if the answer breaks off.
    async fn read(&self, digest: Digest) -> Result<Option<Vec<u8>>, std::io::Error> {
        match self.blobs.content(digest).await.map_err(std::io::Error::other)? {
            None => Ok(None),
            Some(Content::Local(blob)) => {
                Ok(Some(blob.read().await.map_err(std::io::Error::other)?.to_vec()))
            }
            Some(Content::Arriving(arrival)) => {
                let range = 0..arrival.size();
                let pieces: Vec<Bytes> = arrival.content(range).try_collect().await?;
                Ok(Some(pieces.concat()))
            }
            Some(Content::Elsewhere { .. }) => panic!("it has no bytes"),
        }
    }

    /// Waits until the copy is in the cache.
    async fn has_copy(&self, digest: Digest) {
        let file = self.copy(digest);
        eventually("the blob is in the cache", async || {
            tokio::task::yield_now().await;
            file.exists()
        })
        .await;
    }

    fn copy(&self, digest: Digest) -> PathBuf {
        self.data.path().join("blob-cache/sha256").join(digest.hex())
    }

    fn cached_bytes(&self) -> u64 {
        let files = files_below(&self.data.path().join("blob-cache/sha256"));
        files.iter().filter_map(|file| fs::metadata(file).ok()).map(|file| file.len()).sum()
    }
}

/// Bytes that differ at every place and for every seed.
fn content(seed: u8, length: usize) -> Vec<u8> {
    let word = |at: u32| at.wrapping_mul(2_654_435_761).wrapping_add(u32::from(seed)).to_le_bytes();
    (0..length as u32 / 4).flat_map(word).collect()
}

/// Runs each test with a directory on both databases, and with an S3 server.
macro_rules! on_all_stores {
    ($($test:ident),* $(,)?) => {
        mod directory_and_sqlite {
            $(#[tokio::test(flavor = "multi_thread")] async fn $test() {
                super::$test(crate::database::sqlite().await, super::Objects::in_directory()).await;
            })*
        }
        mod directory_and_postgres {
            $(#[tokio::test(flavor = "multi_thread")] async fn $test() {
                super::$test(crate::database::postgres().await, super::Objects::in_directory())
                    .await;
            })*
        }
        mod s3_and_postgres {
            $(#[tokio::test(flavor = "multi_thread")] async fn $test() {
                super::$test(crate::database::postgres().await, super::Objects::in_s3().await)
                    .await;
            })*
        }
    };
}

on_all_stores! {
    blob_of_one_server_is_read_at_another,
    blob_is_fetched_once_for_all_who_wait,
    range_of_an_arriving_blob_is_exact,
    wrong_bytes_are_never_given_out_whole,
    missing_object_makes_a_blob_absent,
    collector_takes_nothing_that_a_pusher_of_another_server_found,
    collected_blob_is_gone_at_every_server,
    object_without_a_row_is_no_blob_and_goes_after_a_day,
    second_push_leaves_one_object,
    cache_stays_within_its_bound_and_keeps_files_in_use,
    cached_blobs_are_read_without_the_store_and_pushes_are_refused,
    foreign_store_is_refused,
}

async fn blob_of_one_server_is_read_at_another(database: TestDatabase, objects: Objects) {
    let (one, other) =
        (Node::start(&database, &objects).await, Node::start(&database, &objects).await);
    for length in [0, 4, MB, 20 * MB + 4] {
        let bytes = content(1, length);
        let digest = one.put(&bytes).await;
        assert_eq!(fs::read(one.copy(digest)).expect("a copy"), bytes);
        let described = other.blobs.describe(digest).await.expect("answers").expect("there");
        assert_eq!(described.size(), bytes.len() as u64);
        assert!(!other.copy(digest).exists(), "a description fetches nothing");
        assert!(other.read(digest).await.expect("arrives") == Some(bytes.clone()));
        other.has_copy(digest).await;
        let blob = other.blobs.get(digest).await.expect("answers").expect("there");
        assert!(blob.read().await.expect("reads") == bytes);
    }
    let unknown = Digest::of(b"unknown");
    assert!(other.read(unknown).await.expect("answers").is_none());
    assert!(!other.blobs.touch(unknown, NOW_MS).await.expect("answers"));
}

async fn blob_is_fetched_once_for_all_who_wait(database: TestDatabase, objects: Objects) {
    let (one, other) =
        (Node::start(&database, &objects).await, Node::start(&database, &objects).await);
    let bytes = content(2, 12 * MB);
    let digest = one.put(&bytes).await;
    let readers: Vec<_> = (0..16)
        .map(|_| {
            let blobs = other.blobs.clone();
            tokio::spawn(async move { blobs.content(digest).await })
        })
        .collect();
    let partial = other.data.path().join("blob-cache/partial");
    let mut most = 0;
    let mut arrivals = Vec::new();
    for reader in readers {
        most = most.max(files_below(&partial).len());
        match reader.await.expect("no panic").expect("answers").expect("there") {
            Content::Arriving(arrival) => arrivals.push(arrival),
            Content::Local(blob) => assert_eq!(blob.digest(), digest),
            Content::Elsewhere { .. } => panic!("it has no bytes"),
        }
    }
    assert!(most <= 1, "{most} fetches at once");
    for arrival in arrivals {
        let range = 0..arrival.size();
        let pieces: Vec<Bytes> = arrival.content(range).try_collect().await.expect("arrives");
        assert!(pieces.concat() == bytes);
    }
    // The copy answers from now on.
    other.has_copy(digest).await;
    fs::remove_file(objects.file_of(digest)).expect("removed");
    assert!(other.read(digest).await.expect("reads") == Some(bytes));
}

async fn range_of_an_arriving_blob_is_exact(database: TestDatabase, objects: Objects) {
    let one = Node::start(&database, &objects).await;
    let bytes = content(3, 9 * MB);
    let digest = one.put(&bytes).await;
    let size = bytes.len() as u64;
    for range in [0..1, 5 * MB as u64..5 * MB as u64 + 300_000, size - 10..size, 0..0] {
        // Without room in the cache every read is a fetch.
        let settings = BlobSettings { max_cache_bytes: 0, ..BlobSettings::default() };
        let other = Node::start_with(&database, &objects, settings).await;
        let found = other.blobs.content(digest).await.expect("answers").expect("there");
        let Content::Arriving(arrival) = found else { panic!("there is no copy") };
        let pieces: Vec<Bytes> =
            arrival.content(range.clone()).try_collect().await.expect("arrives");
        let expected = &bytes[range.start as usize..range.end as usize];
        assert!(pieces.concat() == expected, "{range:?}");
    }
}

async fn wrong_bytes_are_never_given_out_whole(database: TestDatabase, objects: Objects) {
    for length in [1000, 12 * MB] {
        let (one, other) =
            (Node::start(&database, &objects).await, Node::start(&database, &objects).await);
        let bytes = content(4, length);
        let digest = one.put(&bytes).await;
        let mut wrong = bytes.clone();
        wrong[length / 2] ^= 1;
        fs::write(objects.file_of(digest), &wrong).expect("written");
        match other.read(digest).await {
            Ok(None) | Err(_) => {}
            Ok(Some(read)) => panic!("{} bytes were given out", read.len()),
        }
        eventually("the blob is absent", async || {
            other.blobs.get(digest).await.expect("answers").is_none()
        })
        .await;
        assert!(!other.copy(digest).exists());
        let partial = other.data.path().join("blob-cache/partial");
        eventually("no file is left", async || files_below(&partial).is_empty()).await;
        // A push finds it absent, and stores it again.
        assert!(!other.blobs.touch(digest, NOW_MS).await.expect("answers"));
        other.put(&bytes).await;
        let third = Node::start(&database, &objects).await;
        assert!(third.read(digest).await.expect("arrives") == Some(bytes));
    }
}

async fn missing_object_makes_a_blob_absent(database: TestDatabase, objects: Objects) {
    let (one, other) =
        (Node::start(&database, &objects).await, Node::start(&database, &objects).await);
    let (missing, short) = (one.put(&content(5, MB)).await, one.put(&content(6, MB)).await);
    fs::remove_file(objects.file_of(missing)).expect("removed");
    fs::write(objects.file_of(short), b"short").expect("written");
    for digest in [missing, short] {
        assert!(other.read(digest).await.expect("answers").is_none());
        assert!(!other.blobs.touch(digest, NOW_MS).await.expect("answers"));
    }
}

async fn collector_takes_nothing_that_a_pusher_of_another_server_found(
    database: TestDatabase,
    objects: Objects,
) {
    let (pusher, collecting) =
        (Node::start(&database, &objects).await, Node::start(&database, &objects).await);
    let later = NOW_MS + 2 * DAY_MS;
    let collect =
        async || collector::collect(&database.store, &collecting.blobs, later, GRACE).await;
    let (mut found, mut collected) = (0, 0);
    for at in 0..24 {
        let bytes = content(at, 4096);
        let digest = pusher.put(&bytes).await;
        // A pusher asks whether the blob is there, just while it is collected elsewhere.
        let (touched, removed) = tokio::join!(pusher.blobs.touch(digest, later), collect());
        let (touched, removed) = (touched.expect("answers"), removed.expect("collected").blobs);
        assert_ne!(touched, removed == 1, "found and collected, or neither");
        let third = Node::start(&database, &objects).await;
        let read = third.read(digest).await.expect("answers");
        assert_eq!(read, touched.then_some(bytes), "touched: {touched}");
        found += usize::from(touched);
        collected += removed;
    }
    assert_eq!(found + collected, 24);
    let digest = pusher.put(&content(99, 4096)).await;
    assert!(pusher.blobs.touch(digest, later).await.expect("answers"));
    assert_eq!(collect().await.expect("collected").blobs, 0, "it was found");
}

async fn collected_blob_is_gone_at_every_server(database: TestDatabase, objects: Objects) {
    let (one, other) =
        (Node::start(&database, &objects).await, Node::start(&database, &objects).await);
    let digest = one.put(&content(7, MB)).await;
    other.read(digest).await.expect("arrives");
    other.has_copy(digest).await;
    let later = NOW_MS + 2 * DAY_MS;
    let collected = collector::collect(&database.store, &one.blobs, later, GRACE).await;
    assert_eq!(collected.expect("collected").blobs, 1);
    assert!(objects.files().is_empty() && !one.copy(digest).exists());
    assert_eq!(one.blobs.used_bytes().await.expect("counts"), 0);
    assert!(!other.blobs.touch(digest, later).await.expect("answers"), "despite its copy");
}

async fn object_without_a_row_is_no_blob_and_goes_after_a_day(
    database: TestDatabase,
    objects: Objects,
) {
    let one = Node::start(&database, &objects).await;
    let (bytes, kept) = (content(8, MB), one.put(b"kept").await);
    let digest = Digest::of(&bytes);
    // As a server leaves it that is killed between the object and its row.
    let orphan = objects.file_of(kept).with_file_name(format!("{}.0123456789abcdef", digest.hex()));
    fs::write(&orphan, &bytes).expect("written");
    assert!(one.read(digest).await.expect("answers").is_none());
    one.put(&bytes).await;
    assert_eq!(objects.files().len(), 3);

    let written = fs::metadata(&orphan).and_then(|file| file.modified()).expect("there");
    let written_ms = written.duration_since(std::time::UNIX_EPOCH).expect("later").as_millis();
    let written_ms = u64::try_from(written_ms).expect("fits");
    let collect = async |node: &Node, now_ms: u64| {
        let long = Duration::from_millis(10 * NOW_MS);
        collector::collect(&database.store, &node.blobs, now_ms, long).await.expect("collected");
    };
    collect(&one, written_ms + DAY_MS / 2).await;
    assert!(orphan.exists(), "its row may be on its way");
    collect(&one, written_ms + 3 * DAY_MS).await;
    assert!(orphan.exists(), "this server has looked three days ago");
    let other = Node::start(&database, &objects).await;
    collect(&other, written_ms + 3 * DAY_MS).await;
    assert!(!orphan.exists());
    assert_eq!(objects.files().len(), 2);
    let third = Node::start(&database, &objects).await;
    assert!(third.read(digest).await.expect("arrives") == Some(bytes));
}

async fn second_push_leaves_one_object(database: TestDatabase, objects: Objects) {
    let (one, other) =
        (Node::start(&database, &objects).await, Node::start(&database, &objects).await);
    let bytes = content(9, 2 * MB);
    let pushes = (0..8).map(|at| if at % 2 == 0 { one.put(&bytes) } else { other.put(&bytes) });
    let digests = futures_util::future::join_all(pushes).await;
    assert_eq!(digests, [Digest::of(&bytes); 8]);
    assert_eq!(objects.files().len(), 1);
    let third = Node::start(&database, &objects).await;
    assert!(third.read(digests[0]).await.expect("arrives") == Some(bytes));
}

async fn cache_stays_within_its_bound_and_keeps_files_in_use(
    database: TestDatabase,
    objects: Objects,
) {
    let one = Node::start(&database, &objects).await;
    let settings = BlobSettings {
        max_cache_bytes: 4 * MB as u64,
        max_open_blobs: 2,
        ..BlobSettings::default()
    };
    let other = Node::start_with(&database, &objects, settings).await;
    let blobs: Vec<Vec<u8>> = (0..12).map(|seed| content(seed, MB)).collect();
    let mut digests = Vec::new();
    for bytes in &blobs {
        digests.push(one.put(bytes).await);
    }
    let used = other.blobs.get(digests[0]).await.expect("answers").expect("there");
    other.has_copy(digests[0]).await;
    for (digest, bytes) in digests.iter().zip(&blobs).skip(1) {
        assert!(other.read(*digest).await.expect("arrives").as_ref() == Some(bytes));
        other.has_copy(*digest).await;
        assert!(other.cached_bytes() <= 4 * MB as u64, "{} bytes", other.cached_bytes());
    }
    assert!(other.copy(digests[0]).exists(), "it is in use");
    assert!(!other.copy(digests[1]).exists() && other.copy(digests[11]).exists());
    assert!(used.read().await.expect("reads") == blobs[0]);
    drop(used);
    // Pushes fill the cache as well.
    for seed in 20..30 {
        other.put(&content(seed, MB)).await;
        assert!(other.cached_bytes() <= 4 * MB as u64, "{} bytes", other.cached_bytes());
    }
    assert!(!other.copy(digests[0]).exists(), "it is no longer in use");
    // A blob that is larger than the cache is given out and not kept.
    let large = content(40, 6 * MB);
    let digest = one.put(&large).await;
    assert!(other.read(digest).await.expect("arrives") == Some(large));
    let partial = other.data.path().join("blob-cache/partial");
    eventually("it is not kept", async || files_below(&partial).is_empty()).await;
    assert!(!other.copy(digest).exists());
}

async fn cached_blobs_are_read_without_the_store_and_pushes_are_refused(
    database: TestDatabase,
    mut objects: Objects,
) {
    let (one, other) =
        (Node::start(&database, &objects).await, Node::start(&database, &objects).await);
    let (cached, elsewhere) = (content(10, MB), content(11, MB));
    let (cached_digest, elsewhere_digest) = (one.put(&cached).await, other.put(&elsewhere).await);
    let problem = async || one.blobs.common_store().expect("there is one").problem().await;
    assert_eq!(problem().await, None);
    objects.stop();
    assert!(one.read(cached_digest).await.expect("reads") == Some(cached));
    let refused = tokio::time::timeout(PATIENCE, one.blobs.content(elsewhere_digest)).await;
    let refused = refused.expect("in time").err().expect("refused");
    assert!(refused.is_store_unavailable(), "{refused}");
    let new = Bytes::from(content(12, MB));
    let push = one.blobs.put(Algorithm::Sha256, new.clone(), NOW_MS);
    let refused =
        tokio::time::timeout(PATIENCE, push).await.expect("in time").expect_err("refused");
    assert!(refused.is_store_unavailable(), "{refused}");
    let text = problem().await.expect("a problem");
    assert!(text.starts_with(&objects.url().to_string()) && !text.contains("swordfish"), "{text}");
    // A server starts without the store as well.
    if objects.gateway.is_some() {
        Node::start(&database, &objects).await;
    }
    objects.start().await;
    assert_eq!(problem().await, None);
    let digest = one.blobs.put(Algorithm::Sha256, new.clone(), NOW_MS).await.expect("stored");
    assert!(other.read(digest).await.expect("arrives") == Some(new.to_vec()));
    assert!(one.read(elsewhere_digest).await.expect("arrives") == Some(elsewhere));
}

async fn foreign_store_is_refused(database: TestDatabase, objects: Objects) {
    let one = Node::start(&database, &objects).await;
    one.put(b"content").await;
    let stranger = crate::database::sqlite().await;
    let refused = CommonStore::open(stranger.store.clone(), &objects.url()).await.err();
    assert!(matches!(refused, Some(CommonStoreError::Foreign { .. })), "{refused:?}");
    let empty = Objects::in_directory();
    let refused = CommonStore::open(database.store.clone(), &empty.url()).await.err();
    assert!(matches!(refused, Some(CommonStoreError::OtherStore { .. })), "{refused:?}");
    let text = refused.expect("refused").to_string();
    assert!(text.contains("blobs.store: file:///"), "{text}");
}
