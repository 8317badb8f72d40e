//! The content's bytes: a tree as tar+zstd, byte-identical for the same tree on every machine at
//! any time. Bytes stream from the files through tar, hash, zstd and hash into the output; no file
//! is held in memory as a whole.

use std::fs::File;
use std::io::{self, BufReader, Read, Write};

use sha2::{Digest as _, Sha256};
use tar::{EntryType, Header};
use task_proto::Digest;
use task_proto::desired::BlobRef;
use task_proto::packages::manifest::ContentFacts;

use super::PackageError;
use super::tree::{Entry, Tree};

/// zstd's own default: half the speed of the fastest, and the next levels gain a few percent for
/// twice the time.
const ZSTD_LEVEL: i32 = 3;
/// 2000-01-01: the modification time of all files. Not zero, because Python's zip and wheel tools
/// refuse times before 1980.
const MTIME_S: u64 = 946_684_800;

/// Writes `tree` to `output`. Returns the compressed blob and its description.
pub(super) fn write(
    tree: &Tree,
    output: &mut impl Write,
) -> Result<(BlobRef, ContentFacts), PackageError> {
    let output_failed =
        |source| PackageError::Io { what: "can't write the packed content".to_owned(), source };
    let mut compressed = HashingWriter::new(output);
    // One thread and no zstd checksum: the digest covers everything.
    let encoder = zstd::Encoder::new(&mut compressed, ZSTD_LEVEL).map_err(output_failed)?;
    let mut archive = tar::Builder::new(HashingWriter::new(encoder));
    for (path, entry) in &tree.entries {
        append(&mut archive, tree, path, entry)?;
    }
    let plain = archive.into_inner().map_err(output_failed)?;
    let (tar_digest, tar_size, encoder) = plain.finish();
    encoder.finish().map_err(output_failed)?;
    let (digest, size, _) = compressed.finish();
    Ok((
        BlobRef { digest, size },
        ContentFacts { tar_digest, tar_size, entries: tree.entries.len() as u64 },
    ))
}

fn append<W: Write>(
    archive: &mut tar::Builder<W>,
    tree: &Tree,
    path: &str,
    entry: &Entry,
) -> Result<(), PackageError> {
    let failed = |source| PackageError::Io { what: format!("can't pack {path}"), source };
    let mut header = Header::new_gnu();
    header.set_mtime(MTIME_S);
    header.set_uid(0);
    header.set_gid(0);
    header.set_mode(0o755);
    header.set_size(0);
    match entry {
        Entry::Directory => {
            header.set_entry_type(EntryType::Directory);
            archive.append_data(&mut header, path, io::empty()).map_err(failed)
        }
        Entry::Link { target } => {
            header.set_entry_type(EntryType::Symlink);
            archive.append_link(&mut header, path, target).map_err(failed)
        }
        Entry::File { size, executable } => {
            header.set_entry_type(EntryType::Regular);
            header.set_size(*size);
            header.set_mode(if *executable { 0o755 } else { 0o644 });
            let file = File::open(tree.root.join(path)).map_err(failed)?;
            let mut content =
                BufReader::with_capacity(256 * 1024, FixedSizeReader { file, left: *size });
            archive.append_data(&mut header, path, &mut content).map_err(failed)
        }
    }
}

/// A file that must keep the size in its header: a file that grows or shrinks meanwhile would
/// corrupt the archive.
struct FixedSizeReader {
    file: File,
    left: u64,
}

impl Read for FixedSizeReader {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let changed = || io::Error::other("the file changed while it was packed");
        if self.left == 0 {
            // Reading one byte more shows whether the file has grown.
            return match self.file.read(&mut [0])? {
                0 => Ok(0),
                _ => Err(changed()),
            };
        }
        let wanted = buffer.len().min(usize::try_from(self.left).unwrap_or(usize::MAX));
        let count = self.file.read(&mut buffer[..wanted])?;
        if count == 0 {
            return Err(changed());
        }
        self.left -= count as u64;
        Ok(count)
    }
}

/// Hashes and counts the bytes passing through.
struct HashingWriter<W> {
    inner: W,
    hasher: Sha256,
    size: u64,
}

impl<W: Write> HashingWriter<W> {
    fn new(inner: W) -> Self {
        Self { inner, hasher: Sha256::new(), size: 0 }
    }

    fn finish(self) -> (Digest, u64, W) {
        (Digest::from_sha256(self.hasher.finalize().into()), self.size, self.inner)
    }
}

impl<W: Write> Write for HashingWriter<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let count = self.inner.write(bytes)?;
        self.hasher.update(&bytes[..count]);
        self.size += count as u64;
        Ok(count)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.inner.flush()
    }
}
