//! Tracks which parts of a blob are present and which missing parts were requested. The memory is
//! bounded by the number of parts that a blob may have. This module never sees a part's bytes.

use task_proto::messages::part::{PartLayout, PartRange};

/// Format marker at the start of a note.
const NOTE_FORMAT: [u8; 4] = *b"pt1\n";

/// The parts of one blob.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct PartMap {
    cut: PartLayout,
    present: Bits,
    requested: Bits,
    bytes: u64,
}

impl PartMap {
    /// A map of a blob whose first `prefix` bytes are present.
    pub(super) fn new(cut: PartLayout, prefix: u64) -> Self {
        let mut map = Self {
            cut,
            present: Bits::new(cut.count()),
            requested: Bits::new(cut.count()),
            bytes: 0,
        };
        for index in (0..cut.count()).take_while(|&index| cut.range(index).end <= prefix) {
            map.take(index);
        }
        map
    }

    /// The blob's division into parts.
    pub(super) fn cut(&self) -> PartLayout {
        self.cut
    }

    /// Number of bytes present.
    pub(super) fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Whether the part is present.
    pub(super) fn has(&self, index: u32) -> bool {
        self.present.has(index)
    }

    /// Marks the part as present; false if the part was present before.
    pub(super) fn take(&mut self, index: u32) -> bool {
        let is_new = index < self.cut.count() && self.present.set(index);
        if is_new {
            let range = self.cut.range(index);
            self.bytes += range.end - range.start;
        }
        is_new
    }

    /// Whether all parts are present.
    pub(super) fn is_whole(&self) -> bool {
        self.missing().next().is_none()
    }

    /// Number of bytes before the first gap.
    pub(super) fn prefix(&self) -> u64 {
        let first_gap = self.missing().next().unwrap_or(self.cut.count());
        self.cut.range(first_gap).start
    }

    /// Requests all missing parts below `index`; true if there are any.
    pub(super) fn request_below(&mut self, index: u32) -> bool {
        let missing: Vec<u32> = self.missing().take_while(|&missing| missing < index).collect();
        missing.iter().for_each(|&missing| {
            self.requested.set(missing);
        });
        !missing.is_empty()
    }

    pub(super) fn clear_request(&mut self) {
        self.requested = Bits::new(self.cut.count());
    }

    /// Requested parts that are still missing.
    pub(super) fn requested(&self) -> Vec<PartRange> {
        PartRange::runs(self.missing().filter(|&index| self.requested.has(index)))
    }

    /// Encodes the parts that are present, for a later agent process.
    pub(super) fn note(&self) -> Vec<u8> {
        let words = self.present.0.iter().flat_map(|word| word.to_be_bytes());
        NOTE_FORMAT.into_iter().chain(self.cut.part_bytes().to_be_bytes()).chain(words).collect()
    }

    /// Decodes a note about a blob of `size` bytes; `None` if the note is not valid.
    pub(super) fn of_note(note: &[u8], size: u64) -> Option<Self> {
        let (part_bytes, words) = note.strip_prefix(&NOTE_FORMAT)?.split_first_chunk::<4>()?;
        let mut map = Self::new(PartLayout::new(size, u32::from_be_bytes(*part_bytes)).ok()?, 0);
        let (words, rest) = words.as_chunks::<8>();
        if !rest.is_empty() || words.len() != map.present.0.len() {
            return None;
        }
        let present = Bits(words.iter().map(|word| u64::from_be_bytes(*word)).collect());
        for index in (0..map.cut.count()).filter(|&index| present.has(index)) {
            map.take(index);
        }
        Some(map)
    }

    fn missing(&self) -> impl Iterator<Item = u32> {
        // Skip full words first: a large blob has a million parts, and usually most of them are
        // present or most are missing.
        let words = self.present.0.iter().zip(0u32..).filter(|(word, _)| **word != u64::MAX);
        let indexes = words.flat_map(|(word, at)| {
            (0..64).filter(move |bit| word >> bit & 1 == 0).map(move |bit| at * 64 + bit)
        });
        indexes.take_while(|&index| index < self.cut.count())
    }
}

/// One bit per part.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Bits(Vec<u64>);

impl Bits {
    fn new(count: u32) -> Self {
        Self(vec![0; count.div_ceil(64) as usize])
    }

    fn has(&self, index: u32) -> bool {
        self.0.get((index / 64) as usize).is_some_and(|word| word >> (index % 64) & 1 == 1)
    }

    /// Sets a bit; true if the bit was clear before.
    fn set(&mut self, index: u32) -> bool {
        let Some(word) = self.0.get_mut((index / 64) as usize) else { return false };
        let before = *word;
        *word |= 1 << (index % 64);
        *word != before
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use proptest::prelude::*;

    use super::*;

    const PART: u64 = 1024;

    proptest! {
        #[test]
        fn map_matches_a_set_of_parts(size in 1..300 * PART, arrived in prop::collection::vec(0..320u32, 0..400)) {
            let mut map = PartMap::new(PartLayout::new(size, PART as u32).expect("a cut"), 0);
            let count = map.cut().count();
            let mut present = BTreeSet::new();
            for index in arrived {
                prop_assert_eq!(map.take(index), index < count && present.insert(index));
            }
            prop_assert!((0..400).all(|index| map.has(index) == present.contains(&index)));
            let bytes: u64 = present.iter().map(|&index| PART.min(size - u64::from(index) * PART)).sum();
            prop_assert_eq!((map.bytes(), map.is_whole()), (bytes, bytes == size));
            let gap = (0..count).find(|index| !present.contains(index));
            prop_assert_eq!(map.prefix(), gap.map_or(size, |gap| u64::from(gap) * PART));
            let read = PartMap::of_note(&map.note(), size);
            prop_assert_eq!(read.as_ref(), Some(&map));

            let missing: Vec<u32> = (0..count).filter(|index| !present.contains(index)).collect();
            prop_assert!(map.requested().is_empty());
            prop_assert_eq!(map.request_below(u32::MAX), !missing.is_empty());
            prop_assert_eq!(map.requested(), PartRange::runs(missing.iter().copied()));
            if let Some(&first) = missing.first() {
                map.take(first);
                prop_assert_eq!(map.requested(), PartRange::runs(missing[1..].iter().copied()));
            }
            map.clear_request();
            prop_assert!(map.requested().is_empty());
        }

        #[test]
        fn invalid_note_is_not_read(size in any::<u64>(), note in prop::collection::vec(any::<u8>(), 0..64), whole in any::<bool>()) {
            let note = if whole { [&NOTE_FORMAT[..], &note].concat() } else { note };
            if let Some(map) = PartMap::of_note(&note, size) {
                prop_assert!(map.bytes() <= size && map.prefix() <= size);
            }
        }
    }

    #[test]
    fn prefix_counts_as_whole_parts_only() {
        let cut = PartLayout::new(10 * PART + 5, PART as u32).expect("a cut");
        for (prefix, parts, bytes) in [
            (0, 0, 0),
            (PART - 1, 0, 0),
            (3 * PART, 3, 3 * PART),
            (10 * PART + 5, 11, 10 * PART + 5),
        ] {
            let mut map = PartMap::new(cut, prefix);
            assert_eq!(
                ((0..11).filter(|&index| map.has(index)).count(), map.bytes()),
                (parts, bytes)
            );
            assert_eq!(map.prefix(), bytes);
            assert_eq!(map.request_below(2), parts < 2);
        }
    }

    #[test]
    fn part_map_of_another_size_or_truncated_is_ignored() {
        let map = PartMap::new(PartLayout::new(100 * PART, PART as u32).expect("a cut"), 30 * PART);
        let note = map.note();
        assert!(PartMap::of_note(&note, 400 * PART).is_none());
        for length in 0..note.len() {
            assert!(PartMap::of_note(&note[..length], 100 * PART).is_none(), "{length}");
        }
    }
}
