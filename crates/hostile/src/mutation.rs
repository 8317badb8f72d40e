//! Changes inputs as a fuzzer would, but always the same way for the same seed: a test that failed
//! once fails again.

/// Numbers that often break parsers.
const NUMBERS: [u64; 12] = [
    0,
    1,
    0x7f,
    0x80,
    0xff,
    0x7fff,
    0xffff,
    0x7fff_ffff,
    0xffff_ffff,
    i64::MAX as u64,
    u64::MAX - 1,
    u64::MAX,
];
/// Texts that often break parsers.
const TEXTS: [&[u8]; 12] = [
    b"\0",
    b"\n",
    b"\x1b[31m",
    b"\"",
    b"\\",
    b"'",
    b"..",
    b"/",
    b"../../etc/x",
    b"\xff",
    b"{{{{{{{{",
    b"18446744073709551616",
];
/// The longest input that we make.
const MAX_BYTES: usize = 64 * 1024;

/// An endless source of changed inputs.
pub struct Mutation {
    state: u64,
}

impl Mutation {
    /// A source with the seed `seed`.
    pub fn new(seed: u64) -> Self {
        Self { state: seed }
    }

    /// One of `corpus`, or nothing if there are none, changed in one to eight places.
    pub fn next(&mut self, corpus: &[Vec<u8>]) -> Vec<u8> {
        let mut bytes = self.pick(corpus);
        for _ in 0..=self.below(8) {
            self.change(&mut bytes, corpus);
        }
        bytes.truncate(MAX_BYTES);
        bytes
    }

    fn change(&mut self, bytes: &mut Vec<u8>, corpus: &[Vec<u8>]) {
        let at = self.below(bytes.len() + 1);
        let end = (at + 1 + self.below(16)).min(bytes.len());
        match self.below(8) {
            0 if at < bytes.len() => bytes[at] ^= 1 << self.below(8),
            1 if at < bytes.len() => bytes[at] = self.random() as u8,
            2 => drop(bytes.drain(at.min(end)..end)),
            3 => bytes.truncate(at),
            4 => drop(bytes.splice(at..at, TEXTS[self.below(TEXTS.len())].iter().copied())),
            5 => {
                let number = NUMBERS[self.below(NUMBERS.len())];
                let length = 1 << self.below(4);
                let all =
                    if self.below(2) == 0 { number.to_le_bytes() } else { number.to_be_bytes() };
                let bytes_of_it =
                    if self.below(2) == 0 { &all[..length] } else { &all[8 - length..] };
                let end = (at + length).min(bytes.len());
                drop(bytes.splice(at..end, bytes_of_it.iter().copied()));
            }
            6 => {
                let again = bytes[at.min(end)..end].to_vec();
                drop(bytes.splice(at..at, again));
            }
            _ => {
                let other = self.pick(corpus);
                let from = self.below(other.len() + 1);
                bytes.truncate(at);
                bytes.extend_from_slice(&other[from..]);
            }
        }
    }

    fn pick(&mut self, corpus: &[Vec<u8>]) -> Vec<u8> {
        if corpus.is_empty() { Vec::new() } else { corpus[self.below(corpus.len())].clone() }
    }

    fn below(&mut self, limit: usize) -> usize {
        (self.random() % limit.max(1) as u64) as usize
    }

    /// SplitMix64: small, and independent of crate versions.
    fn random(&mut self) -> u64 {
        self.state = self.state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut mixed = self.state;
        mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        mixed ^ (mixed >> 31)
    }
}
