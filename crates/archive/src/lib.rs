//! From a package's archive to its entries, and to a tree in a directory, in one pass and in
//! bounded memory. It refuses, and says why, whatever a packer would not write: the bytes may come
//! from anyone until their digest is known.
//!
//! Invariants: nothing is created outside the given directory, no symbolic link is ever followed,
//! and no byte is written beyond what the task manifest announced, or the limits allow. [`check`]
//! reads an archive by the same rules and writes nothing, so that a server that takes a package and
//! a robot that unpacks it come to the same verdict. It never hashes the compressed bytes and never
//! renames.

mod entry;
mod names;
mod stream;
mod tree;

use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};

use task_proto::Digest;
use task_proto::digest::Algorithm;
use task_proto::manifest::{
    CONTENT_RATIO_FREE_BYTES, ContentFacts, MAX_CONTENT_DEPTH, MAX_CONTENT_ENTRIES,
    MAX_CONTENT_RATIO, MAX_CONTENT_TAR_BYTES,
};

pub use self::entry::{Entry, Kind};
use self::names::Names;
use self::stream::{Blocks, Bound};
use self::tree::Tree;

const COPY_BUFFER_BYTES: usize = 128 * 1024;

/// How large a package may get. The default is what a packer holds to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Uncompressed bytes.
    pub bytes: u64,
    /// Files, directories and links, those that paths imply included.
    pub entries: u64,
    /// Components of a path.
    pub depth: usize,
    /// Uncompressed bytes for one compressed byte. Small packages may compress as well as they
    /// like: a bomb needs room.
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

/// Why there is no tree.
#[derive(Debug, thiserror::Error)]
pub enum UnpackError {
    /// The archive holds something a package must not.
    #[error(transparent)]
    Refused(#[from] Refusal),
    /// The compressed bytes stopped coming.
    #[error("the package's bytes stopped coming")]
    Source(#[source] io::Error),
    /// The disk did not take it.
    #[error("cannot write {}", path.display())]
    Disk {
        /// What was being written.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
}

/// What was found in an archive. Names are shown escaped and cut, so that a hostile one stays
/// harmless in a log.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Refusal {
    /// A number of the archive is above a limit.
    #[error("{what}: {found}, where at most {limit} are allowed")]
    Limit {
        /// What was counted.
        what: &'static str,
        /// How many there are.
        found: u64,
        /// How many there may be.
        limit: u64,
    },
    /// The archive is not the one its manifest describes.
    #[error("{what}: {found}, where the task manifest says {announced}")]
    NotAsAnnounced {
        /// What was counted.
        what: &'static str,
        /// How many there are.
        found: u64,
        /// How many were announced.
        announced: u64,
    },
    /// The uncompressed archive is not the one its manifest describes.
    #[error(
        "the uncompressed archive hashes to {found}, where the task manifest says {announced} (content.tar_digest)"
    )]
    OtherDigest {
        /// Its digest.
        found: Box<Digest>,
        /// The announced one.
        announced: Box<Digest>,
    },
    /// The manifest describes the uncompressed archive by a digest that nobody compares.
    #[error("content.tar_digest: {0} is no SHA-256 digest")]
    DigestAlgorithm(Box<Digest>),
    /// An entry is something a package must not hold.
    #[error("entry {name}: {reason}")]
    Entry {
        /// Its path.
        name: String,
        /// What is wrong with it.
        reason: String,
    },
    /// The bytes are not a tar archive, or one that readers would disagree about.
    #[error("damaged archive at byte {at}: {reason}")]
    Damaged {
        /// Where, in the uncompressed archive.
        at: u64,
        /// What is wrong.
        reason: String,
    },
}

impl Refusal {
    /// About the entry with this name.
    pub fn entry(name: &[u8], reason: impl Into<String>) -> Self {
        Self::Entry { name: shown(name), reason: reason.into() }
    }
}

/// How an archive travels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Compression {
    /// As it is.
    None,
    /// In zstd frames: one or more, and skippable ones between them.
    Zstd,
}

/// Unpacks `content`, which has `content_size` compressed bytes, into the new directory `staging`,
/// whose parent is there. What it created is left in either case. Reads `content` to its end only
/// if all is well.
pub fn unpack(
    content: impl Read,
    content_size: u64,
    facts: &ContentFacts,
    limits: &Limits,
    staging: &Path,
) -> Result<(), UnpackError> {
    unpack_all(Entries::announced(content, content_size, facts, limits)?, limits, staging)
}

/// The same for an archive of which nothing is known: all that it may be is what the limits allow.
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

/// An archive's entries, one after the other. What is between them is checked as they are read;
/// whether a name comes twice, or a link leads out, is not.
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
    /// Of `content`, which has `content_size` compressed bytes and is what its task manifest says.
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

    /// Of an archive of which nothing is known.
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

    /// The next entry; what was left of the last one's content is passed over. `None` once the
    /// archive has been read to its end and is whole.
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

    /// Hands on the last entry's content in pieces, if it is a file.
    pub fn content(
        &mut self,
        take: impl FnMut(&[u8]) -> Result<(), UnpackError>,
    ) -> Result<(), UnpackError> {
        let size = std::mem::take(&mut self.pending);
        self.blocks.copy(size, &mut self.buffer, take)
    }
}

/// Holds what the manifest announces against the limits, before anything is written.
fn admit(content_size: u64, facts: &ContentFacts, limits: &Limits) -> Result<(), Refusal> {
    let unpacked_limit = content_size.saturating_mul(limits.ratio).max(CONTENT_RATIO_FREE_BYTES);
    for (what, found, limit) in [
        ("uncompressed bytes", facts.tar_size, limits.bytes),
        ("uncompressed bytes for so few compressed ones", facts.tar_size, unpacked_limit),
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
