//! From a package's archive to its entries, and to a tree in a directory, in one pass and in
//! bounded memory. The reader refuses all input that a packer would not write, with a reason: the
//! bytes are untrusted until their digest is known.
//!
//! Invariants: nothing is created outside the given directory, no symbolic link is ever followed,
//! and no byte is written beyond the size that the task manifest announced, or the limits allow.
//! [`check`] reads an archive by the same rules and writes nothing: a server that accepts a package
//! and a robot that unpacks the package come to the same verdict. Neither hashes the compressed
//! bytes, and neither renames files.

#![warn(missing_docs)]

mod entry;
mod names;
mod stream;
mod tree;

use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};

use task_proto::Digest;
use task_proto::ids::digest::Algorithm;
use task_proto::packages::manifest::{
    CONTENT_RATIO_FREE_BYTES, ContentFacts, MAX_CONTENT_DEPTH, MAX_CONTENT_ENTRIES,
    MAX_CONTENT_RATIO, MAX_CONTENT_TAR_BYTES,
};

pub use self::entry::{Entry, Kind};
use self::names::Names;
use self::stream::{Blocks, Bound};
use self::tree::Tree;

const COPY_BUFFER_BYTES: usize = 128 * 1024;

/// Size limits of a package. The default is the packer's own limit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Maximum uncompressed size in bytes.
    pub bytes: u64,
    /// Files, directories and links, including directories implied by paths.
    pub entries: u64,
    /// Components of a path.
    pub depth: usize,
    /// Maximum ratio of uncompressed to compressed bytes. Small packages are exempt: a bomb needs
    /// room.
    pub ratio: u64,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            bytes: MAX_CONTENT_TAR_BYTES,
            entries: MAX_CONTENT_ENTRIES,
            depth: MAX_CONTENT_DEPTH,
            ratio: MAX_CONTENT_RATIO,
        }
    }
}

/// The reason why unpacking failed.
#[derive(Debug, thiserror::Error)]
pub enum UnpackError {
    /// The archive violates the rules for packages.
    #[error(transparent)]
    Refused(#[from] Refusal),
    /// The compressed bytes could not be read to their end.
    #[error("the package could not be read to its end")]
    Source(#[source] io::Error),
    /// A write to the disk failed.
    #[error("cannot write {}", path.display())]
    Disk {
        /// The path being written.
        path: PathBuf,
        /// The error of the operating system.
        source: io::Error,
    },
}

/// Why an archive is refused. Names are shown escaped and cut, so that a hostile name stays
/// harmless in a log.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Refusal {
    /// A number of the archive is above a limit.
    #[error("{what}: {found}, where at most {limit} are allowed")]
    Limit {
        /// The quantity that was counted.
        what: &'static str,
        /// The number found in the archive.
        found: u64,
        /// The maximum number that is allowed.
        limit: u64,
    },
    /// The archive differs from the description in its manifest.
    #[error("{what}: {found}, where the task manifest says {announced}")]
    NotAsAnnounced {
        /// The quantity that was counted.
        what: &'static str,
        /// The number found in the archive.
        found: u64,
        /// The number announced by the manifest.
        announced: u64,
    },
    /// The uncompressed archive differs from the description in its manifest.
    #[error(
        "the uncompressed archive hashes to {found}, \
         where the task manifest says {announced} (content.tar_digest)"
    )]
    OtherDigest {
        /// The digest of the bytes read.
        found: Box<Digest>,
        /// The digest announced by the manifest.
        announced: Box<Digest>,
    },
    /// The manifest describes the uncompressed archive by a digest algorithm that is not supported.
    #[error("content.tar_digest: {0} is not a SHA-256 digest")]
    DigestAlgorithm(Box<Digest>),
    /// An entry is not allowed in a package.
    #[error("entry {name}: {reason}")]
    Entry {
        /// The path of the entry.
        name: String,
        /// Why the entry is refused.
        reason: String,
    },
    /// The bytes are not a tar archive, or readers would disagree about them.
    #[error("damaged archive at byte {at}: {reason}")]
    Damaged {
        /// Offset in the uncompressed archive.
        at: u64,
        /// Why the archive is refused.
        reason: String,
    },
}

impl Refusal {
    /// About the entry with this name.
    pub fn entry(name: &[u8], reason: impl Into<String>) -> Self {
        Self::Entry { name: shown(name), reason: reason.into() }
    }
}

/// Compression of an archive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Compression {
    /// A plain tar archive.
    None,
    /// zstd frames: one or more, with skippable frames between them.
    Zstd,
}

/// Unpacks `content`, which has `content_size` compressed bytes, into the new directory `staging`,
/// whose parent exists. On success and on failure, created files stay there. Reads `content` to its
/// end only on success.
pub fn unpack(
    content: impl Read,
    content_size: u64,
    facts: &ContentFacts,
    limits: &Limits,
    staging: &Path,
) -> Result<(), UnpackError> {
    unpack_all(Entries::announced(content, content_size, facts, limits)?, limits, staging)
}

/// Unpacks an archive without a manifest: only the limits bound its size.
pub fn unpack_unannounced(
    content: impl Read,
    compression: Compression,
    limits: &Limits,
    staging: &Path,
) -> Result<(), UnpackError> {
    unpack_all(Entries::unannounced(content, compression, limits)?, limits, staging)
}

fn unpack_all<R: Read>(
    mut entries: Entries<R>,
    limits: &Limits,
    staging: &Path,
) -> Result<(), UnpackError> {
    let mut tree = Tree::create(staging, limits)?;
    while let Some(entry) = entries.next()? {
        if let Some(mut file) = tree.add(&entry)? {
            entries.content(|bytes| {
                file.write_all(bytes)
                    .map_err(|source| UnpackError::Disk { path: staging.join(&entry.path), source })
            })?;
        }
    }
    tree.finish()
}

/// Reads `content` as [`unpack`] does, to the same verdict, and writes nothing.
pub fn check(
    content: impl Read,
    content_size: u64,
    facts: &ContentFacts,
    limits: &Limits,
) -> Result<(), UnpackError> {
    let mut entries = Entries::announced(content, content_size, facts, limits)?;
    let mut names = Names::new(limits);
    while let Some(entry) = entries.next()? {
        names.add(&entry)?;
    }
    names.symlinks()?;
    Ok(())
}

/// The entries of an archive, in order. Bytes between entries are checked as they are read;
/// duplicate names and links that lead out of the archive are not checked.
pub struct Entries<R: Read> {
    blocks: Blocks<R>,
    depth: usize,
    count: u64,
    bound: Bound,
    /// Bytes of the last entry that were not taken.
    pending: u64,
    buffer: Vec<u8>,
}

impl<R: Read> Entries<R> {
    /// Entries of `content`, which has `content_size` compressed bytes and is described by its task
    /// manifest.
    pub fn announced(
        content: R,
        content_size: u64,
        facts: &ContentFacts,
        limits: &Limits,
    ) -> Result<Self, UnpackError> {
        admit(content_size, facts, limits)?;
        let blocks =
            Blocks::new(content, Compression::Zstd, Bound::Exactly(facts.tar_size), u64::MAX)?;
        Ok(Self::new(blocks.with_digest(facts.tar_digest), limits, Bound::Exactly(facts.entries)))
    }

    /// Limits for an archive without a manifest.
    pub fn unannounced(
        content: R,
        compression: Compression,
        limits: &Limits,
    ) -> Result<Self, UnpackError> {
        let blocks = Blocks::new(content, compression, Bound::AtMost(limits.bytes), limits.ratio)?;
        Ok(Self::new(blocks, limits, Bound::AtMost(limits.entries)))
    }

    fn new(blocks: Blocks<R>, limits: &Limits, bound: Bound) -> Self {
        Self {
            blocks,
            depth: limits.depth,
            count: 0,
            bound,
            pending: 0,
            buffer: vec![0; COPY_BUFFER_BYTES],
        }
    }

    /// The next entry; unread content of the previous entry is skipped. `None` once the archive has
    /// been read to its end and is complete.
    #[expect(
        clippy::should_implement_trait,
        reason = "it can fail, and lends nothing that an iterator could give"
    )]
    pub fn next(&mut self) -> Result<Option<Entry>, UnpackError> {
        self.content(|_| Ok(()))?;
        let Some(entry) = entry::next(&mut self.blocks, self.depth)? else {
            self.blocks.finish(&mut self.buffer)?;
            self.bound.check_end("entries in the archive", self.count)?;
            return Ok(None);
        };
        self.count += 1;
        self.bound.check("entries in the archive", self.count)?;
        if let Kind::File { size, .. } = entry.kind {
            self.pending = size;
        }
        Ok(Some(entry))
    }

    /// Passes the last entry's content on in pieces, if the entry is a file.
    pub fn content(
        &mut self,
        take: impl FnMut(&[u8]) -> Result<(), UnpackError>,
    ) -> Result<(), UnpackError> {
        let size = std::mem::take(&mut self.pending);
        self.blocks.copy(size, &mut self.buffer, take)
    }
}

/// Checks the sizes that the manifest announces against the limits, before anything is written.
fn admit(content_size: u64, facts: &ContentFacts, limits: &Limits) -> Result<(), Refusal> {
    let unpacked_limit = content_size.saturating_mul(limits.ratio).max(CONTENT_RATIO_FREE_BYTES);
    for (what, found, limit) in [
        ("uncompressed bytes", facts.tar_size, limits.bytes),
        ("uncompressed bytes for this compressed size", facts.tar_size, unpacked_limit),
        ("entries in the archive", facts.entries, limits.entries),
    ] {
        if found > limit {
            return Err(Refusal::Limit { what, found, limit });
        }
    }
    match facts.tar_digest.algorithm() {
        Algorithm::Sha256 => Ok(()),
        Algorithm::Sha512 => Err(Refusal::DigestAlgorithm(facts.tar_digest.into())),
    }
}

/// A name for people: escaped, and cut to a length that fits a line.
fn shown(name: &[u8]) -> String {
    let text: String = String::from_utf8_lossy(name).chars().take(100).collect();
    format!("{text:?}")
}
