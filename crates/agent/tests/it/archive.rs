//! Archives written byte by byte, also those that no decent writer would produce.

use task_proto::Digest;
use task_proto::packages::manifest::ContentFacts;

/// A tar archive that grows.
#[derive(Clone, Default)]
pub struct Tar {
    pub bytes: Vec<u8>,
    pub entries: u64,
}

/// One header's fields.
#[derive(Clone, Copy)]
pub struct Header<'a> {
    pub name: &'a [u8],
    pub kind: u8,
    pub mode: u32,
    pub size: u64,
    pub link: &'a [u8],
    pub prefix: &'a [u8],
}

impl Default for Header<'_> {
    fn default() -> Self {
        Self { name: b"", kind: b'0', mode: 0o644, size: 0, link: b"", prefix: b"" }
    }
}

impl Header<'_> {
    pub fn block(self) -> [u8; 512] {
        let mut block = [0; 512];
        let mut put = |at: usize, bytes: &[u8]| block[at..at + bytes.len()].copy_from_slice(bytes);
        put(0, self.name);
        put(100, format!("{:07o}", self.mode).as_bytes());
        put(108, b"0000000");
        put(116, b"0000000");
        put(124, format!("{:011o}", self.size).as_bytes());
        put(136, b"00000000000");
        put(156, &[self.kind]);
        put(157, self.link);
        put(257, b"ustar\x0000");
        put(345, self.prefix);
        seal(&mut block);
        block
    }
}

/// Puts the right checksum into a header.
pub fn seal(block: &mut [u8; 512]) {
    block[148..156].fill(b' ');
    let sum: u32 = block.iter().map(|&byte| u32::from(byte)).sum();
    block[148..156].copy_from_slice(format!("{sum:06o}\0 ").as_bytes());
}

impl Tar {
    /// A header and nothing else.
    pub fn header(mut self, header: Header) -> Self {
        self.bytes.extend(header.block());
        self.entries += u64::from(!matches!(header.kind, b'L' | b'K' | b'x' | b'g'));
        self
    }

    /// Bytes, filled up to a block.
    pub fn content(mut self, content: &[u8]) -> Self {
        self.bytes.extend(content);
        self.bytes.resize(self.bytes.len().next_multiple_of(512), 0);
        self
    }

    pub fn typed(self, kind: u8, name: &str, content: &[u8]) -> Self {
        let size = content.len() as u64;
        self.header(Header { name: name.as_bytes(), kind, size, ..Header::default() })
            .content(content)
    }

    pub fn file(self, name: &str, content: &[u8]) -> Self {
        self.typed(b'0', name, content)
    }

    pub fn dir(self, name: &str) -> Self {
        self.header(Header { name: name.as_bytes(), kind: b'5', mode: 0o755, ..Header::default() })
    }

    pub fn link(self, kind: u8, name: &str, target: &str) -> Self {
        self.header(Header {
            name: name.as_bytes(),
            kind,
            link: target.as_bytes(),
            ..Header::default()
        })
    }

    pub fn symlink(self, name: &str, target: &str) -> Self {
        self.link(b'2', name, target)
    }

    pub fn hard_link(self, name: &str, target: &str) -> Self {
        self.link(b'1', name, target)
    }

    /// PAX records for the next entry.
    pub fn pax(self, records: &[(&str, &str)]) -> Self {
        let text: String = records.iter().map(|(key, value)| pax_record(key, value)).collect();
        self.typed(b'x', "pax", text.as_bytes())
    }

    /// The end marker.
    pub fn end(mut self) -> Self {
        self.bytes.extend([0; 1024]);
        self
    }

    pub fn facts(&self) -> ContentFacts {
        ContentFacts {
            tar_digest: Digest::of(&self.bytes),
            tar_size: self.bytes.len() as u64,
            entries: self.entries,
        }
    }

    pub fn compressed(&self) -> Vec<u8> {
        compress(&self.bytes)
    }
}

pub fn compress(bytes: &[u8]) -> Vec<u8> {
    zstd::encode_all(bytes, 3).unwrap()
}

fn pax_record(key: &str, value: &str) -> String {
    let rest = format!(" {key}={value}\n");
    let length =
        (rest.len()..).find(|length| length.to_string().len() + rest.len() == *length).unwrap();
    format!("{length}{rest}")
}

/// Bytes that do not compress, the same in each run.
pub fn noise() -> Vec<u8> {
    let mut state = 1u64;
    let next = || {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 33) as u8
    };
    std::iter::repeat_with(next).take(3 << 20).collect()
}

/// A package that is large enough to be cut.
pub fn tar() -> Tar {
    Tar::default().dir("bin").file("bin/run", b"#!/bin/sh\n").file("data", &noise()).end()
}
