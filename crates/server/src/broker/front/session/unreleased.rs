//! The QoS 2 messages that a client has sent and not released. MQTT 3.1.1 permits one for each
//! packet id, so they are stored as bits: 8 KiB for all of them, and no memory for a client without
//! any.

#[derive(Debug, Default)]
pub(super) struct Unreleased {
    bits: Vec<u64>,
}

impl Unreleased {
    pub(super) fn contains(&self, id: u16) -> bool {
        let (word, bit) = place(id);
        self.bits.get(word).is_some_and(|bits| bits & bit != 0)
    }

    pub(super) fn insert(&mut self, id: u16) {
        let (word, bit) = place(id);
        if self.bits.len() <= word {
            self.bits.resize(word + 1, 0);
        }
        self.bits[word] |= bit;
    }

    pub(super) fn remove(&mut self, id: u16) {
        let (word, bit) = place(id);
        if let Some(bits) = self.bits.get_mut(word) {
            *bits &= !bit;
        }
    }
}

/// The index of the word, and the bit within the word.
fn place(id: u16) -> (usize, u64) {
    (usize::from(id / 64), 1 << (id % 64))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_packet_id_has_its_own_place() {
        let mut unreleased = Unreleased::default();
        for id in 1..=u16::MAX {
            assert!(!unreleased.contains(id));
            unreleased.insert(id);
            assert!(unreleased.contains(id));
        }
        assert_eq!(unreleased.bits.len(), 1024);
        for id in (1..=u16::MAX).step_by(2) {
            unreleased.remove(id);
        }
        assert!((1..=u16::MAX).all(|id| unreleased.contains(id) == (id % 2 == 0)));
        Unreleased::default().remove(7);
    }
}
