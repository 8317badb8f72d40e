//! Deletes unneeded data: abandoned uploads, and blobs without a reference. Blobs of a package that
//! a robot should have, or may get back, are kept even if their manifest is deleted. A blob is left
//! alone for a grace time after the last request of a pusher, so that a push in progress finds the
//! blobs that it found before. The grace time is shorter for blobs that robots have dropped.

use std::time::Duration;

use task_proto::Digest;
use task_proto::time::millis;
use tokio_util::sync::CancellationToken;

use super::{BlobError, Blobs};
use crate::store::{Store, StoreError};
use crate::system::clock::Clock;

/// The most blobs deleted in one go; pushes wait that long.
const MAX_AT_ONCE: usize = 256;
/// The shortest and longest time between two collections.
const INTERVAL: [Duration; 2] = [Duration::from_secs(1), Duration::from_secs(600)];

/// The time between two searches for objects that hold no blob.
const ORPHAN_INTERVAL: Duration = Duration::from_secs(7 * 24 * 60 * 60);

/// Grace time of blobs that a robot has dropped, unless the usual grace is shorter: the robot
/// brings back more.
const DROPPED_GRACE: Duration = Duration::from_secs(3600);

/// The number of items that one collection removed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Collected {
    pub uploads: usize,
    pub blobs: usize,
}

/// The cause of a failed collection. The next one begins anew.
#[derive(Debug, thiserror::Error)]
pub enum CollectError {
    /// The blob store failed.
    #[error("unneeded blobs can't be deleted")]
    Blobs(#[from] BlobError),
    #[error("the database can't tell which blobs are needed")]
    Store(#[from] StoreError),
}

/// Collects at intervals until it is stopped, and at longer ones the more servers do the same,
/// whose number is `servers`.
pub async fn run(
    store: Store,
    blobs: Blobs,
    clock: Clock,
    grace: Duration,
    servers: impl Fn() -> u32,
    stop: CancellationToken,
) {
    let [shortest, longest] = INTERVAL;
    let mut interval = tokio::time::interval((grace / 4).clamp(shortest, longest));
    interval.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    let mut ticks_to_wait = 1;
    loop {
        // Cancel-safe: the collection itself is not part of the select.
        tokio::select! {
            () = stop.cancelled() => return,
            _ = interval.tick() => {}
        }
        ticks_to_wait -= 1;
        if ticks_to_wait > 0 {
            continue;
        }
        ticks_to_wait = servers().max(1);
        match collect(&store, &blobs, clock.now_ms(), grace).await {
            Ok(Collected { uploads: 0, blobs: 0 }) => {}
            Ok(Collected { uploads, blobs }) => {
                tracing::info!(uploads, blobs, "deleted unneeded uploads and blobs")
            }
            Err(CollectError::Store(error)) => error.log("garbage collection failed"),
            Err(error) => {
                tracing::warn!(
                    error = &error as &dyn std::error::Error,
                    "garbage collection failed"
                )
            }
        }
    }
}

/// Removes data that has been unneeded for `grace`.
pub async fn collect(
    store: &Store,
    blobs: &Blobs,
    now_ms: u64,
    grace: Duration,
) -> Result<Collected, CollectError> {
    let before = |grace: Duration| now_ms.saturating_sub(millis(grace));
    let uploads = blobs.drop_idle_uploads(before(grace)).await?;
    let mut old = blobs.untouched_since(before(grace)).await?;
    let mut dropped = store.robot_blobs().dropped().await?;
    // Most blobs are needed, and this look-up blocks no pusher. The remaining candidates are
    // checked once more below.
    let needed = store.blobs().referenced().await?;
    old.retain(|digest| !needed.contains(digest));
    dropped.retain(|digest| !needed.contains(digest));
    let removed = remove(store, blobs, &old, before(grace)).await?
        + remove(store, blobs, &dropped, before(grace.min(DROPPED_GRACE))).await?;
    let orphans = blobs.remove_orphans(now_ms, ORPHAN_INTERVAL).await?;
    if orphans > 0 {
        tracing::info!(orphans, "deleted objects of blobs.store that held no blob");
    }
    Ok(Collected { uploads, blobs: removed })
}

/// Removes those of `candidates` that are unneeded and were not requested since `before_ms`.
/// Returns their number.
async fn remove(
    store: &Store,
    blobs: &Blobs,
    candidates: &[Digest],
    before_ms: u64,
) -> Result<usize, CollectError> {
    let mut removed = 0;
    for candidates in candidates.chunks(MAX_AT_ONCE) {
        if let Some(common) = &blobs.shared.common {
            removed += blobs.remove_from_common_store(common, candidates, before_ms).await?;
            continue;
        }
        let collection = blobs.begin_collection().await;
        let mut untouched = Vec::with_capacity(candidates.len());
        for &digest in candidates {
            // A pusher may have asked for the blob since it was listed.
            if blobs.is_untouched_since(digest, before_ms).await? {
                untouched.push(digest);
            }
        }
        for digest in store.blobs().drop_unreferenced(untouched).await? {
            blobs.delete(digest, &collection).await?;
            removed += 1;
        }
    }
    Ok(removed)
}
