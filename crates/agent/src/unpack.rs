//! From a package's tar+zstd bytes to a tree in the staging directory, in one pass and in bounded memory. It refuses,
//! and says why, whatever a packer would not write: the bytes may come from anyone until their digest is known.
//!
//! Invariants: nothing is created outside the staging directory, no symbolic link is ever followed, and no byte is
//! written beyond what the task manifest announced. It never hashes and never renames; see `fetch`.

mod entry;
mod tree;

use std::io::{self, BufRead, BufReader, Read, Write};
use std::path::{Path, PathBuf};

use task_proto::manifest::{
    CONTENT_RATIO_FREE_BYTES, ContentFacts, MAX_CONTENT_DEPTH, MAX_CONTENT_ENTRIES, MAX_CONTENT_RATIO,
    MAX_CONTENT_TAR_BYTES,
};

use self::entry::{Entry, Kind};
use self::tree::Tree;

const BLOCK_BYTES: usize = 512;
const COPY_BUFFER_BYTES: usize = 128 * 1024;
/// The decoder holds a frame's whole window in memory. 2^24 is what zstd's levels up to 19 need, and a little more.
const WINDOW_LOG_MAX: u32 = 24;

/// How large a package may get on this robot. The default is what a packer holds to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Uncompressed bytes.
    pub bytes: u64,
    /// Files, directories and links, those that paths imply included.
    pub entries: u64,
    /// Components of a path.
    pub depth: usize,
    /// Uncompressed bytes for one compressed byte. Small packages may compress as well as they like: a bomb needs room.
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

/// What was found in an archive. Names are shown escaped and cut, so that a hostile one stays harmless in a log.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Refusal {
    /// A number of the archive is above a limit of this robot, or is not what its manifest says.
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
    fn entry(name: &[u8], reason: impl Into<String>) -> Self {
        Self::Entry { name: shown(name), reason: reason.into() }
    }
}

/// Unpacks `content`, which has `content_size` compressed bytes, into the new directory `staging`. What it created is
/// left there in either case. Reads `content` to its end only if all is well.
pub fn unpack(
    content: impl Read,
    content_size: u64,
    facts: &ContentFacts,
    limits: &Limits,
    staging: &Path,
) -> Result<(), UnpackError> {
    admit(content_size, facts, limits)?;
    let mut archive = Archive::new(content, facts.tar_size)?;
    let mut tree = Tree::create(staging, limits)?;
    let mut buffer = vec![0; COPY_BUFFER_BYTES];
    let mut entries = 0;
    while let Some(Entry { path, kind }) = entry::next(&mut archive, limits.depth)? {
        entries += 1;
        if entries > facts.entries {
            return Err(not_as_announced("entries in the archive", entries, facts.entries).into());
        }
        match kind {
            Kind::Directory => tree.directory(&path)?,
            Kind::Symlink { target } => tree.symlink(&path, target)?,
            Kind::HardLink { target } => tree.hard_link(&path, &target)?,
            Kind::File { size, executable } => {
                let mut file = tree.file(&path, executable)?;
                archive.copy(size, &mut buffer, |bytes| {
                    file.write_all(bytes).map_err(|source| UnpackError::Disk { path: staging.join(&path), source })
                })?;
            }
        }
    }
    archive.finish(&mut buffer)?;
    if entries != facts.entries {
        return Err(not_as_announced("entries in the archive", entries, facts.entries).into());
    }
    tree.finish()
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
    Ok(())
}

fn not_as_announced(what: &'static str, found: u64, announced: u64) -> Refusal {
    Refusal::NotAsAnnounced { what, found, announced }
}

/// A name for people: escaped, and cut to a length that fits a line.
fn shown(name: &[u8]) -> String {
    let text: String = String::from_utf8_lossy(name).chars().take(100).collect();
    format!("{text:?}")
}

/// The uncompressed archive as a stream of blocks, cut at the announced size.
struct Archive<R: Read> {
    decoder: zstd::stream::read::Decoder<'static, BufReader<Source<R>>>,
    position: u64,
    size: u64,
}

/// Remembers that the error came from the source and not from the decoder.
struct Source<R> {
    content: R,
    failed: bool,
}

impl<R: Read> Read for Source<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let result = self.content.read(buffer);
        self.failed |= result.as_ref().is_err_and(|error| error.kind() != io::ErrorKind::Interrupted);
        result
    }
}

impl<R: Read> Archive<R> {
    fn new(content: R, size: u64) -> Result<Self, UnpackError> {
        // One frame only: each further one could announce a window and a size of its own.
        let decoder = zstd::stream::read::Decoder::new(Source { content, failed: false })
            .and_then(|mut decoder| decoder.window_log_max(WINDOW_LOG_MAX).map(|()| decoder.single_frame()))
            .map_err(UnpackError::Source)?;
        Ok(Self { decoder, position: 0, size })
    }

    /// The uncompressed bytes that may still come.
    fn remaining(&self) -> u64 {
        self.size - self.position
    }

    fn damaged(&self, reason: impl Into<String>) -> UnpackError {
        Refusal::Damaged { at: self.position, reason: reason.into() }.into()
    }

    /// Reads up to the buffer's length; 0 at the end.
    fn read(&mut self, buffer: &mut [u8]) -> Result<usize, UnpackError> {
        let count = loop {
            match self.decoder.read(buffer) {
                Ok(count) => break count,
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) if self.decoder.get_ref().get_ref().failed => return Err(UnpackError::Source(error)),
                Err(error) => return Err(self.damaged(format!("zstd: {error}"))),
            }
        };
        if count as u64 > self.remaining() {
            let found = self.position + count as u64;
            return Err(not_as_announced("uncompressed bytes, so far", found, self.size).into());
        }
        self.position += count as u64;
        Ok(count)
    }

    fn read_exact(&mut self, mut buffer: &mut [u8]) -> Result<(), UnpackError> {
        while !buffer.is_empty() {
            match self.read(buffer)? {
                0 => return Err(self.damaged("it ends too early")),
                count => buffer = &mut buffer[count..],
            }
        }
        Ok(())
    }

    fn block(&mut self) -> Result<[u8; BLOCK_BYTES], UnpackError> {
        let mut block = [0; BLOCK_BYTES];
        self.read_exact(&mut block)?;
        Ok(block)
    }

    /// Hands on the next `size` bytes in pieces and skips what fills their last block.
    fn copy(
        &mut self,
        size: u64,
        buffer: &mut [u8],
        mut take: impl FnMut(&[u8]) -> Result<(), UnpackError>,
    ) -> Result<(), UnpackError> {
        let mut left = size;
        while left > 0 {
            let piece = &mut buffer[..left.min(COPY_BUFFER_BYTES as u64) as usize];
            self.read_exact(piece)?;
            take(piece)?;
            left -= piece.len() as u64;
        }
        let padding = (BLOCK_BYTES as u64 - size % BLOCK_BYTES as u64) % BLOCK_BYTES as u64;
        self.read_exact(&mut buffer[..padding as usize])
    }

    /// The next `size` bytes, which the caller has bounded.
    fn collect(&mut self, size: u64) -> Result<Vec<u8>, UnpackError> {
        let mut bytes = Vec::with_capacity(size as usize);
        let mut buffer = vec![0; COPY_BUFFER_BYTES];
        self.copy(size, &mut buffer, |piece| {
            bytes.extend_from_slice(piece);
            Ok(())
        })?;
        Ok(bytes)
    }

    /// After the end marker there is nothing but zeros, in the announced number, and nothing behind the frame.
    fn finish(mut self, buffer: &mut [u8]) -> Result<(), UnpackError> {
        loop {
            match self.read(buffer)? {
                0 => break,
                count if buffer[..count].iter().all(|&byte| byte == 0) => {}
                _ => return Err(self.damaged("there are bytes after its end marker")),
            }
        }
        if self.remaining() > 0 {
            return Err(not_as_announced("uncompressed bytes", self.position, self.size).into());
        }
        let behind = self.decoder.get_mut().fill_buf().map_err(UnpackError::Source)?.len();
        if behind > 0 {
            return Err(self.damaged("there are bytes after its zstd frame"));
        }
        Ok(())
    }
}
