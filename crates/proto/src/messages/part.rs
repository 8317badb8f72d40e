//! Parts of a blob that travels over MQTT: how a blob is cut, what each message holds, and which
//! parts a robot lacks. A message is a binary header, big endian, and then the part's bytes:
//!
//! ```text
//!  0        1         2              6              10                14
//!  ┌────────┬─────────┬──────────────┬──────────────┬─────────────────┬─────────────┐
//!  │ u8 = 1 │ u8 = 0  │ u32 index    │ u32 count    │ u32 part_bytes  │ bytes …     │
//!  └────────┴─────────┴──────────────┴──────────────┴─────────────────┴─────────────┘
//!   version  reserved   from 0         of the blob    of all but the last
//! ```
//! The header is not signed. A receiver measures it against the blob's size, which comes from the
//! signed state, and the whole against the digest.

use std::ops::{Range, RangeInclusive};

use serde::{Deserialize, Serialize};

/// The header's length in bytes.
pub const HEADER_BYTES: usize = 14;
/// The version that we write, and the only one that we accept.
pub const VERSION: u8 = 1;
/// The smallest part a blob is cut into.
pub const MIN_PART_BYTES: u32 = 1024;
/// The largest part; MQTT messages can't be larger.
pub const MAX_PART_BYTES: u32 = 256 * 1024 * 1024 - 1024;
/// The default part size, unless the server's settings change it.
pub const DEFAULT_PART_BYTES: u32 = 64 * 1024;
/// The most parts of one blob: the receiver keeps track of every part.
pub const MAX_PARTS: u32 = 1 << 20;
/// The most ranges in a robot's report of missing parts; the robot reports more once those have
/// arrived.
pub const MAX_MISSING_RANGES: usize = 64;

/// How a blob is cut into parts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PartLayout {
    size: u64,
    part_bytes: u32,
    count: u32,
}

/// One part as it travels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Part<'a> {
    /// Index of the part, from 0.
    pub index: u32,
    /// Number of parts of the blob.
    pub count: u32,
    /// The size of every part but the last.
    pub part_bytes: u32,
    /// The part's bytes.
    pub bytes: &'a [u8],
}

/// A range of parts that a robot lacks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct PartRange {
    /// The first missing part, from 0.
    pub from: u32,
    /// The last missing part, inclusive.
    pub to: u32,
}

/// Why a message is not a valid part of this blob.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum PartError {
    /// The message is shorter than a header.
    #[error("a part of {0} bytes has no header")]
    Short(usize),
    /// The part was made by another version.
    #[error("a part of version {0}, expected {VERSION}")]
    Version(u8),
    /// A blob can't be cut into parts of this size.
    #[error("{size} bytes can't be cut into parts of {part_bytes}")]
    InvalidLayout {
        /// The blob's size.
        size: u64,
        /// The size of its parts.
        part_bytes: u32,
    },
    /// The header contradicts itself or the blob's size.
    #[error(
        "part {index} of {count}, {part_bytes} bytes each, with {bytes} bytes \
         does not belong to this blob"
    )]
    Foreign {
        /// Index of the part, from the header.
        index: u32,
        /// Number of parts, from the header.
        count: u32,
        /// The size of every part but the last, from the header.
        part_bytes: u32,
        /// Number of bytes after the header.
        bytes: usize,
    },
}

impl PartLayout {
    /// Cuts a blob of `size` bytes into parts of `part_bytes`. An empty blob has no parts.
    pub fn new(size: u64, part_bytes: u32) -> Result<Self, PartError> {
        let is_sized = (MIN_PART_BYTES..=MAX_PART_BYTES).contains(&part_bytes);
        let count = size.div_ceil(u64::from(part_bytes.max(1)));
        match u32::try_from(count) {
            Ok(count) if is_sized && count <= MAX_PARTS => Ok(Self { size, part_bytes, count }),
            _ => Err(PartError::InvalidLayout { size, part_bytes }),
        }
    }

    /// Number of parts.
    pub fn count(&self) -> u32 {
        self.count
    }

    /// The size of every part but the last.
    pub fn part_bytes(&self) -> u32 {
        self.part_bytes
    }

    /// The byte range of the part with this index in the blob; empty beyond the last part.
    pub fn range(&self, index: u32) -> Range<u64> {
        let from = (u64::from(index) * u64::from(self.part_bytes)).min(self.size);
        from..(from + u64::from(self.part_bytes)).min(self.size)
    }

    /// The header of the part with this index.
    pub fn header(&self, index: u32) -> [u8; HEADER_BYTES] {
        let mut header = [0; HEADER_BYTES];
        header[0] = VERSION;
        header[2..6].copy_from_slice(&index.to_be_bytes());
        header[6..10].copy_from_slice(&self.count.to_be_bytes());
        header[10..14].copy_from_slice(&self.part_bytes.to_be_bytes());
        header
    }
}

impl<'a> Part<'a> {
    /// Decodes a message for a blob of `size` bytes, with any part size that the sender chose.
    pub fn decode(message: &'a [u8], size: u64) -> Result<Self, PartError> {
        let (header, bytes) =
            message.split_first_chunk::<HEADER_BYTES>().ok_or(PartError::Short(message.len()))?;
        if header[0] != VERSION {
            return Err(PartError::Version(header[0]));
        }
        let number = |at: usize| {
            u32::from_be_bytes([header[at], header[at + 1], header[at + 2], header[at + 3]])
        };
        let (index, count, part_bytes) = (number(2), number(6), number(10));
        let layout = PartLayout::new(size, part_bytes)?;
        let range = layout.range(index);
        if count != layout.count || index >= count || range.end - range.start != bytes.len() as u64
        {
            return Err(PartError::Foreign { index, count, part_bytes, bytes: bytes.len() });
        }
        Ok(Self { index, count, part_bytes, bytes })
    }

    /// The whole message.
    pub fn encode(&self) -> Vec<u8> {
        let layout = PartLayout { size: 0, part_bytes: self.part_bytes, count: self.count };
        [&layout.header(self.index), self.bytes].concat()
    }
}

impl PartRange {
    /// The first [`MAX_MISSING_RANGES`] ranges of `missing`, which must be ascending.
    pub fn runs(missing: impl IntoIterator<Item = u32>) -> Vec<Self> {
        let mut runs: Vec<Self> = Vec::new();
        for index in missing {
            match runs.last_mut() {
                Some(last) if last.to.checked_add(1) == Some(index) => last.to = index,
                _ => runs.push(Self { from: index, to: index }),
            }
            if runs.len() > MAX_MISSING_RANGES {
                runs.pop();
                break;
            }
        }
        runs
    }

    /// The range within a blob of `count` parts. `None` if a robot's report makes no sense.
    pub fn within(&self, count: u32) -> Option<RangeInclusive<u32>> {
        let last = count.checked_sub(1)?;
        (self.from <= self.to && self.from <= last).then(|| self.from..=self.to.min(last))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn all_parts_together_are_the_blob(
            size in 0usize..20_000,
            part_bytes in MIN_PART_BYTES..8_192
        ) {
            let blob: Vec<u8> = (0..size).map(|at| (at % 251) as u8).collect();
            let layout = PartLayout::new(size as u64, part_bytes).expect("cut");
            let mut together = Vec::new();
            for index in 0..layout.count() {
                let range = layout.range(index);
                let bytes = &blob[range.start as usize..range.end as usize];
                let part = Part { index, count: layout.count(), part_bytes, bytes };
                let message = part.encode();
                prop_assert_eq!(&message[..HEADER_BYTES], &layout.header(index));
                prop_assert_eq!(Part::decode(&message, size as u64), Ok(part));
                together.extend_from_slice(bytes);
            }
            prop_assert_eq!(together, blob);
            prop_assert!(layout.range(layout.count()).is_empty());
        }

        /// Every accepted part lies inside the blob, for any input.
        #[test]
        fn hostile_messages_never_reach_beyond_the_blob(
            message in proptest::collection::vec(any::<u8>(), 0..3_000),
            fields in any::<[u32; 3]>(),
            small in any::<bool>(),
            size in any::<u64>(),
        ) {
            let mut message = message;
            let size = if small { size % 4_000 } else { size };
            if message.len() >= HEADER_BYTES {
                message[0] = VERSION;
                for (at, field) in [2, 6, 10].into_iter().zip(fields) {
                    let field = if small { field % 3_000 } else { field };
                    message[at..at + 4].copy_from_slice(&field.to_be_bytes());
                }
            }
            if let Ok(part) = Part::decode(&message, size) {
                let layout = PartLayout::new(size, part.part_bytes).expect("accepted");
                let range = layout.range(part.index);
                prop_assert!(part.index < part.count && part.count <= MAX_PARTS);
                prop_assert!(range.end <= size);
                prop_assert_eq!(range.end - range.start, part.bytes.len() as u64);
            }
        }

        #[test]
        fn ranges_cover_exactly_the_missing_parts(
            missing in proptest::collection::btree_set(0u32..300, 0..200)
        ) {
            let runs = PartRange::runs(missing.iter().copied());
            let within = |run: &PartRange| run.within(300).expect("in order");
            let named: Vec<u32> = runs.iter().flat_map(within).collect();
            prop_assert!(runs.len() <= MAX_MISSING_RANGES);
            let mut pairs = missing.iter().copied().zip(&named);
            prop_assert!(pairs.all(|(lacking, &named)| lacking == named));
            prop_assert!(named.len() == missing.len() || runs.len() == MAX_MISSING_RANGES);
        }
    }

    #[test]
    fn foreign_part_is_refused_with_a_reason() {
        let part = Part { index: 1, count: 2, part_bytes: 1024, bytes: &[7; 76] };
        let message = part.encode();
        assert_eq!(Part::decode(&message, 1100), Ok(part));
        let foreign =
            |index, count, bytes| PartError::Foreign { index, count, part_bytes: 1024, bytes };
        assert_eq!(Part::decode(&message, 1101), Err(foreign(1, 2, 76)));
        assert_eq!(Part::decode(&message, 3000), Err(foreign(1, 2, 76)));
        assert_eq!(
            Part::decode(&Part { index: 2, bytes: &[], ..part }.encode(), 1100),
            Err(foreign(2, 2, 0))
        );
        assert_eq!(Part::decode(&message[..13], 1100), Err(PartError::Short(13)));
        let newer: Vec<u8> = [&[2], &message[1..]].concat();
        assert_eq!(Part::decode(&newer, 1100), Err(PartError::Version(2)));
        let tiny = Part { part_bytes: 0, ..part }.encode();
        assert_eq!(
            Part::decode(&tiny, 1100),
            Err(PartError::InvalidLayout { size: 1100, part_bytes: 0 })
        );
    }

    #[test]
    fn part_layout_respects_the_limits() {
        assert_eq!(PartLayout::new(0, 1024).map(|layout| layout.count()), Ok(0));
        assert_eq!(
            PartLayout::new(100_000_000, MAX_PART_BYTES).map(|layout| layout.count()),
            Ok(1)
        );
        let most = u64::from(MAX_PARTS) * 1024;
        assert_eq!(PartLayout::new(most, 1024).map(|layout| layout.count()), Ok(MAX_PARTS));
        for (size, part_bytes) in
            [(most + 1, 1024), (u64::MAX, MAX_PART_BYTES), (1, 1023), (1, MAX_PART_BYTES + 1)]
        {
            assert_eq!(
                PartLayout::new(size, part_bytes),
                Err(PartError::InvalidLayout { size, part_bytes })
            );
        }
    }

    #[test]
    fn invalid_range_is_ignored() {
        assert_eq!(PartRange { from: 3, to: u32::MAX }.within(5), Some(3..=4));
        assert_eq!(PartRange { from: 5, to: 9 }.within(5), None);
        assert_eq!(PartRange { from: 4, to: 3 }.within(5), None);
        assert_eq!(PartRange { from: 0, to: 0 }.within(0), None);
    }
}
