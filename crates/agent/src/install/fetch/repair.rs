//! Repairs bytes whose digest differs from the ordered one. The digest of the whole does not locate
//! the fault, so each range is fetched again over separate connections until two copies agree on
//! each byte. The first received copy counts as one. The caller checks the result against the
//! digest, and decides when to repair.

use std::fs::OpenOptions;
use std::os::unix::fs::FileExt as _;
use std::sync::Arc;

use task_proto::RepositoryName;
use task_proto::desired::{BlobRef, PackageRef};
use tokio::sync::OwnedMutexGuard;

use super::pushed::on_disk;
use super::{FetchError, Fetcher};

/// Shortest range: a small content needs few ranges.
const MIN_RANGE_BYTES: u64 = 256 * 1024;
/// Longest range. Several copies of a range are held in memory.
const MAX_RANGE_BYTES: u64 = 4 * 1024 * 1024;
/// Number of ranges of a content.
const RANGES: u64 = 64;
/// Most fetches of a range. Two copies must agree, and the first received copy counts.
const MAX_COPIES: usize = 8;
/// Most bytes before its range at which a copy begins. A fault at a fixed offset of each answer
/// then damages a different byte each time.
const MAX_LEAD_BYTES: u64 = 4096;

impl Fetcher {
    /// Repairs a complete `.part` of a content. Writes that outlive this call hold the lock.
    pub(super) async fn repair_content(
        &self,
        package: &PackageRef,
        lock: &Arc<OwnedMutexGuard<()>>,
    ) -> Result<(), FetchError> {
        let repository = RepositoryName::of_package(&package.name);
        let blob = package.content;
        let part = self.data.blob_part(&blob.digest);
        let file = OpenOptions::new().read(true).write(true).open(&part);
        let file = Arc::new(file.map_err(|source| FetchError::disk(&part, source))?);
        for (from, length) in ranges(blob.size) {
            let read = file.clone();
            let mut first = vec![0; length];
            let first =
                on_disk(&part, move || read.read_exact_at(&mut first, from).map(|()| first))
                    .await?;
            if let Some(agreed_copy) = self.agreed_copy(&repository, blob, from, first).await? {
                let written = file.clone();
                let lock = lock.clone();
                on_disk(&part, move || {
                    written.write_all_at(&agreed_copy, from).map(|()| drop(lock))
                })
                .await?;
            }
        }
        Ok(())
    }

    /// Repairs a blob in memory.
    pub(super) async fn repaired(
        &self,
        repository: &RepositoryName,
        blob: BlobRef,
        mut bytes: Vec<u8>,
    ) -> Result<Vec<u8>, FetchError> {
        for (from, length) in ranges(blob.size) {
            let range = from as usize..from as usize + length;
            if let Some(agreed_copy) =
                self.agreed_copy(repository, blob, from, bytes[range.clone()].to_vec()).await?
            {
                bytes[range].copy_from_slice(&agreed_copy);
            }
        }
        Ok(bytes)
    }

    /// Bytes of a range on which copies agree; `None` if they equal `first`.
    async fn agreed_copy(
        &self,
        repository: &RepositoryName,
        blob: BlobRef,
        from: u64,
        first: Vec<u8>,
    ) -> Result<Option<Vec<u8>>, FetchError> {
        let mut copies = vec![first];
        let mut failure = None;
        for _ in 0..MAX_COPIES {
            match self.copy_of(repository, blob, from, copies[0].len()).await {
                Ok(copy) if copies.len() == 1 && copy == copies[0] => return Ok(None),
                Ok(copy) => copies.push(copy),
                // A damaged header of an answer looks like an answer with other bytes, and a cut is
                // a cut. Both are tried again.
                Err(error @ FetchError::DigestMismatch { .. }) => failure = Some(error),
                Err(error) if error.is_cut() => failure = Some(error),
                Err(error) => return Err(error),
            }
            if let Some(agreed_copy) = majority(&copies) {
                return Ok(Some(agreed_copy));
            }
        }
        let reason = format!("{} copies of the bytes from {from} on do not agree", copies.len());
        Err(failure.unwrap_or(FetchError::DigestMismatch { digest: blob.digest, reason }))
    }

    async fn copy_of(
        &self,
        repository: &RepositoryName,
        blob: BlobRef,
        from: u64,
        length: usize,
    ) -> Result<Vec<u8>, FetchError> {
        let lead = rand::random_range(1..=MAX_LEAD_BYTES);
        let end = from + length as u64;
        let piece = async |from, end| {
            self.download_range(repository, blob, from..end).await?.collect(end - from).await
        };
        if lead <= from {
            return Ok(piece(from - lead, end).await?.split_off(lead as usize));
        }
        // Too few bytes precede the range, so its first bytes are requested separately.
        let middle = (from + lead).min(end);
        let mut bytes = piece(from, middle).await?;
        if middle < end {
            bytes.extend(piece(middle, end).await?);
        }
        Ok(bytes)
    }
}

/// Start and length of each range of `size` bytes.
fn ranges(size: u64) -> impl Iterator<Item = (u64, usize)> {
    let length = size.div_ceil(RANGES).clamp(MIN_RANGE_BYTES, MAX_RANGE_BYTES);
    (0..size.div_ceil(length))
        .map(move |index| (index * length, length.min(size - index * length) as usize))
}

/// For each byte, the value that most copies have, and at least two. `None` while a byte has no
/// such value.
fn majority(copies: &[Vec<u8>]) -> Option<Vec<u8>> {
    let (first, others) = copies.split_first()?;
    let mut agreed_copy = first.clone();
    for (at, byte) in agreed_copy.iter_mut().enumerate() {
        if others.len() > 1 && others.iter().all(|copy| copy[at] == *byte) {
            continue;
        }
        let votes = |value: u8| copies.iter().filter(|copy| copy[at] == value).count();
        let (best, count) = copies
            .iter()
            .map(|copy| (copy[at], votes(copy[at])))
            .max_by_key(|(_, count)| *count)?;
        let is_tied = copies.iter().any(|copy| copy[at] != best && votes(copy[at]) == count);
        if count < 2 || is_tied {
            return None;
        }
        *byte = best;
    }
    Some(agreed_copy)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn majority_needs_two_copies_that_agree_on_each_byte() {
        let copies =
            |texts: &[&str]| texts.iter().map(|text| text.as_bytes().to_vec()).collect::<Vec<_>>();
        let agreed_copy = |texts: &[&str]| {
            majority(&copies(texts)).map(|bytes| String::from_utf8_lossy(&bytes).into_owned())
        };
        assert_eq!(agreed_copy(&["abc"]), None);
        assert_eq!(agreed_copy(&["abc", "abx"]), None);
        assert_eq!(
            agreed_copy(&["abc", "abx", "ybc"]).as_deref(),
            Some("abc"),
            "each copy has a fault of its own"
        );
        assert_eq!(agreed_copy(&["abx", "abc", "abx", "abc"]), None, "two against two");
        assert_eq!(agreed_copy(&["abx", "abc", "abc"]).as_deref(), Some("abc"));
    }

    #[test]
    fn ranges_cover_all_bytes_once() {
        for size in [1, MIN_RANGE_BYTES, MIN_RANGE_BYTES + 1, 100 << 20, (10 << 30) + 7] {
            let mut next = 0;
            for (from, length) in ranges(size) {
                assert_eq!(from, next);
                assert!(length > 0 && length as u64 <= MAX_RANGE_BYTES);
                next += length as u64;
            }
            assert_eq!(next, size);
        }
        assert_eq!(ranges(0).count(), 0);
    }
}
