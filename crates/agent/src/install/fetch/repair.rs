//! Mends bytes that came with another digest than the ordered one. A digest of the whole does not
//! say where the fault is, so each range is fetched anew over connections of its own until two
//! copies agree on each byte; the copy that came first counts as one. What comes of it is held
//! against the digest by the caller. Nothing here decides when to mend.

use std::fs::OpenOptions;
use std::os::unix::fs::FileExt as _;
use std::sync::Arc;

use task_proto::RepositoryName;
use task_proto::desired::{BlobRef, PackageRef};
use tokio::sync::OwnedMutexGuard;

use super::pushed::on_disk;
use super::{FetchError, Fetcher};

/// The shortest range: of a small content few are needed.
const MIN_RANGE_BYTES: u64 = 256 * 1024;
/// The longest, of which a few copies are held in memory.
const MAX_RANGE_BYTES: u64 = 4 * 1024 * 1024;
/// Into how many ranges a content is cut.
const RANGES: u64 = 64;
/// How often a range is fetched. With the copy that came first, two of which are to agree.
const MAX_COPIES: usize = 8;
/// Up to how many bytes before its range a copy begins. A fault that damages the same place of each
/// answer then damages another byte each time.
const MAX_LEAD_BYTES: u64 = 4096;

impl Fetcher {
    /// Mends the `.part` of a content, all of whose bytes are there. The turn is held by writes
    /// that outlive this.
    pub(super) async fn repair_content(
        &self,
        package: &PackageRef,
        turn: &Arc<OwnedMutexGuard<()>>,
    ) -> Result<(), FetchError> {
        let (repository, blob) = (RepositoryName::of_package(&package.name), package.content);
        let part = self.data.blob_part(&blob.digest);
        let file = OpenOptions::new().read(true).write(true).open(&part);
        let file = Arc::new(file.map_err(|source| FetchError::disk(&part, source))?);
        for (from, length) in ranges(blob.size) {
            let (read, mut first) = (file.clone(), vec![0; length]);
            let first =
                on_disk(&part, move || read.read_exact_at(&mut first, from).map(|()| first))
                    .await?;
            if let Some(agreed) = self.agreed(&repository, blob, from, first).await? {
                let (written, turn) = (file.clone(), turn.clone());
                on_disk(&part, move || written.write_all_at(&agreed, from).map(|()| drop(turn)))
                    .await?;
            }
        }
        Ok(())
    }

    /// The same of a blob that is held in memory.
    pub(super) async fn repaired(
        &self,
        repository: &RepositoryName,
        blob: BlobRef,
        mut bytes: Vec<u8>,
    ) -> Result<Vec<u8>, FetchError> {
        for (from, length) in ranges(blob.size) {
            let range = from as usize..from as usize + length;
            if let Some(agreed) =
                self.agreed(repository, blob, from, bytes[range.clone()].to_vec()).await?
            {
                bytes[range].copy_from_slice(&agreed);
            }
        }
        Ok(bytes)
    }

    /// What copies of a range agree on; `None` if that is what came `first`.
    async fn agreed(
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
                // A damaged head of an answer reads as one about other bytes, a cut is a cut.
                Err(error @ FetchError::DigestMismatch { .. }) => failure = Some(error),
                Err(error) if error.is_cut() => failure = Some(error),
                Err(error) => return Err(error),
            }
            if let Some(agreed) = majority(&copies) {
                return Ok(Some(agreed));
            }
        }
        let reason =
            format!("{} copies of those from byte {from} on agree on nothing", copies.len());
        Err(failure.unwrap_or(FetchError::DigestMismatch { digest: blob.digest, reason }))
    }

    async fn copy_of(
        &self,
        repository: &RepositoryName,
        blob: BlobRef,
        from: u64,
        length: usize,
    ) -> Result<Vec<u8>, FetchError> {
        let (lead, end) = (rand::random_range(1..=MAX_LEAD_BYTES), from + length as u64);
        let piece = async |from, end| {
            self.download_range(repository, blob, from..end).await?.collect(end - from).await
        };
        if lead <= from {
            return Ok(piece(from - lead, end).await?.split_off(lead as usize));
        }
        // Nothing is before it: what comes first is asked for by itself.
        let middle = (from + lead).min(end);
        let mut bytes = piece(from, middle).await?;
        if middle < end {
            bytes.extend(piece(middle, end).await?);
        }
        Ok(bytes)
    }
}

/// Where the ranges of `size` bytes begin, and how long each is.
fn ranges(size: u64) -> impl Iterator<Item = (u64, usize)> {
    let length = size.div_ceil(RANGES).clamp(MIN_RANGE_BYTES, MAX_RANGE_BYTES);
    (0..size.div_ceil(length))
        .map(move |index| (index * length, length.min(size - index * length) as usize))
}

/// The bytes that at least two of the copies have, and more of them than have anything else; `None`
/// while one has not got as many.
fn majority(copies: &[Vec<u8>]) -> Option<Vec<u8>> {
    let (first, others) = copies.split_first()?;
    let mut agreed = first.clone();
    for (at, byte) in agreed.iter_mut().enumerate() {
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
    Some(agreed)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn majority_needs_two_copies_that_agree_on_each_byte() {
        let copies =
            |texts: &[&str]| texts.iter().map(|text| text.as_bytes().to_vec()).collect::<Vec<_>>();
        let agreed = |texts: &[&str]| {
            majority(&copies(texts)).map(|bytes| String::from_utf8_lossy(&bytes).into_owned())
        };
        assert_eq!(agreed(&["abc"]), None);
        assert_eq!(agreed(&["abc", "abx"]), None);
        assert_eq!(
            agreed(&["abc", "abx", "ybc"]).as_deref(),
            Some("abc"),
            "each copy has a fault of its own"
        );
        assert_eq!(agreed(&["abx", "abc", "abx", "abc"]), None, "two against two");
        assert_eq!(agreed(&["abx", "abc", "abc"]).as_deref(), Some("abc"));
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
