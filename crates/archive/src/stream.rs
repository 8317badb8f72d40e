//! The uncompressed archive as a stream of blocks with a fixed end.

use std::io::{self, BufRead as _, BufReader, Read};

use sha2::{Digest as _, Sha256};
use task_proto::Digest;
use task_proto::packages::manifest::CONTENT_RATIO_FREE_BYTES;
use zstd::stream::read::Decoder;

use super::{COPY_BUFFER_BYTES, Compression, Refusal, UnpackError};

pub(super) const BLOCK_BYTES: usize = 512;
/// The decoder holds a frame's whole window in memory. zstd's levels up to 19 need at most 2^24,
/// and a little more.
const WINDOW_LOG_MAX: u32 = 24;

/// Bound of a counted quantity.
#[derive(Debug, Clone, Copy)]
pub(super) enum Bound {
    /// Exactly the announced number.
    Exactly(u64),
    /// More are too many.
    AtMost(u64),
}

impl Bound {
    fn most(self) -> u64 {
        match self {
            Self::Exactly(most) | Self::AtMost(most) => most,
        }
    }

    /// Checks a running count of `found`.
    pub(super) fn check(self, what: &'static str, found: u64) -> Result<(), Refusal> {
        match self {
            Self::Exactly(announced) if found > announced => {
                Err(Refusal::NotAsAnnounced { what, found, announced })
            }
            Self::AtMost(limit) if found > limit => Err(Refusal::Limit { what, found, limit }),
            Self::Exactly(_) | Self::AtMost(_) => Ok(()),
        }
    }

    /// Checks a final count of `found`.
    pub(super) fn check_end(self, what: &'static str, found: u64) -> Result<(), Refusal> {
        match self {
            Self::Exactly(announced) if found != announced => {
                Err(Refusal::NotAsAnnounced { what, found, announced })
            }
            _ => self.check(what, found),
        }
    }
}

/// The archive, block by block.
pub(super) struct Blocks<R: Read> {
    bytes: Bytes<R>,
    position: u64,
    size: Bound,
    /// Maximum ratio of uncompressed to compressed bytes.
    ratio: u64,
    /// Running digest of the uncompressed bytes, and the announced digest, if any.
    digest: Option<(Sha256, Digest)>,
}

enum Bytes<R: Read> {
    Plain(BufReader<Source<R>>),
    Zstd(Decoder<'static, BufReader<Source<R>>>),
}

/// Counts, and remembers that the error came from the source and not from the decoder.
struct Source<R> {
    content: R,
    taken: u64,
    failed: bool,
}

impl<R: Read> Read for Source<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let result = self.content.read(buffer);
        self.failed |=
            result.as_ref().is_err_and(|error| error.kind() != io::ErrorKind::Interrupted);
        self.taken += *result.as_ref().unwrap_or(&0) as u64;
        result
    }
}

impl<R: Read> Bytes<R> {
    fn source(&self) -> &Source<R> {
        match self {
            Self::Plain(reader) => reader.get_ref(),
            Self::Zstd(decoder) => decoder.get_ref().get_ref(),
        }
    }

    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        match self {
            Self::Plain(reader) => reader.read(buffer),
            Self::Zstd(decoder) => decoder.read(buffer),
        }
    }

    /// Whether bytes follow the last byte read.
    fn has_more(&mut self) -> io::Result<bool> {
        match self {
            Self::Plain(reader) => reader.fill_buf().map(|rest| !rest.is_empty()),
            Self::Zstd(decoder) => decoder.get_mut().fill_buf().map(|rest| !rest.is_empty()),
        }
    }
}

impl<R: Read> Blocks<R> {
    pub(super) fn new(
        content: R,
        compression: Compression,
        size: Bound,
        ratio: u64,
    ) -> Result<Self, UnpackError> {
        let source = Source { content, taken: 0, failed: false };
        let bytes = match compression {
            Compression::None => Bytes::Plain(BufReader::with_capacity(COPY_BUFFER_BYTES, source)),
            // RFC 8878 allows several frames, and skippable ones. The window's limit holds for each
            // frame, since only one window is held at a time; all other limits cover the bytes of
            // all frames together.
            Compression::Zstd => Decoder::new(source)
                .and_then(|mut decoder| decoder.window_log_max(WINDOW_LOG_MAX).map(|()| decoder))
                .map(Bytes::Zstd)
                .map_err(UnpackError::Source)?,
        };
        Ok(Self { bytes, position: 0, size, ratio, digest: None })
    }

    /// Sets the expected digest of the uncompressed bytes.
    pub(super) fn with_digest(mut self, digest: Digest) -> Self {
        self.digest = Some((Sha256::new(), digest));
        self
    }

    /// Checks an entry's size against the limits.
    pub(super) fn check_entry(&self, size: u64) -> Result<(), UnpackError> {
        let left = self.size.most() - self.position;
        match self.size {
            Bound::Exactly(_) if size > left => Err(self.damaged(format!(
                "an entry of {size} bytes is longer than the rest of the archive"
            ))),
            Bound::AtMost(_) => {
                Ok(self.size.check("uncompressed bytes", self.position.saturating_add(size))?)
            }
            Bound::Exactly(_) => Ok(()),
        }
    }

    pub(super) fn damaged(&self, reason: impl Into<String>) -> UnpackError {
        Refusal::Damaged { at: self.position, reason: reason.into() }.into()
    }

    /// Reads up to the buffer's length; 0 at the end.
    fn read(&mut self, buffer: &mut [u8]) -> Result<usize, UnpackError> {
        let count = loop {
            match self.bytes.read(buffer) {
                Ok(count) => break count,
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) if self.bytes.source().failed => return Err(UnpackError::Source(error)),
                Err(error) => return Err(self.damaged(format!("zstd: {error}"))),
            }
        };
        let found = self.position + count as u64;
        self.size.check("uncompressed bytes, so far", found)?;
        let limit =
            self.bytes.source().taken.saturating_mul(self.ratio).max(CONTENT_RATIO_FREE_BYTES);
        Bound::AtMost(limit).check("uncompressed bytes for this compressed size", found)?;
        self.position = found;
        if let Some((hasher, _)) = &mut self.digest {
            hasher.update(&buffer[..count]);
        }
        Ok(count)
    }

    fn read_exact(&mut self, mut buffer: &mut [u8]) -> Result<(), UnpackError> {
        while !buffer.is_empty() {
            match self.read(buffer)? {
                0 => return Err(self.damaged("the archive ends too early")),
                count => buffer = &mut buffer[count..],
            }
        }
        Ok(())
    }

    pub(super) fn block(&mut self) -> Result<[u8; BLOCK_BYTES], UnpackError> {
        let mut block = [0; BLOCK_BYTES];
        self.read_exact(&mut block)?;
        Ok(block)
    }

    /// Passes on the next `size` bytes in pieces and skips the padding of their last block.
    pub(super) fn copy(
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
    pub(super) fn collect(&mut self, size: u64) -> Result<Vec<u8>, UnpackError> {
        let mut bytes = Vec::with_capacity(size as usize);
        let mut buffer = vec![0; COPY_BUFFER_BYTES];
        self.copy(size, &mut buffer, |piece| {
            bytes.extend_from_slice(piece);
            Ok(())
        })?;
        Ok(bytes)
    }

    /// Checks the end: only zeros after the end marker, in the announced number, no bytes after
    /// them, and the announced digest.
    pub(super) fn finish(&mut self, buffer: &mut [u8]) -> Result<(), UnpackError> {
        loop {
            match self.read(buffer)? {
                0 => break,
                count if buffer[..count].iter().all(|&byte| byte == 0) => {}
                _ => return Err(self.damaged("bytes follow the end marker")),
            }
        }
        self.size.check_end("uncompressed bytes", self.position)?;
        if self.bytes.has_more().map_err(UnpackError::Source)? {
            return Err(self.damaged("bytes follow the end of the archive"));
        }
        if let Some((hasher, announced)) = self.digest.take() {
            let found = Digest::from_sha256(hasher.finalize().into());
            if found != announced {
                return Err(Refusal::OtherDigest {
                    found: found.into(),
                    announced: announced.into(),
                }
                .into());
            }
        }
        Ok(())
    }
}
