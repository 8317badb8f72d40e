//! A package's archive as a robot unpacks it, and as the server does where someone brings a
//! directory.

use std::fs;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Component, Path};

use task_archive::{
    Compression, Entries, Kind, Limits, Refusal, UnpackError, check, unpack, unpack_unannounced,
};
use task_package::contents::list;
use task_proto::Digest;
use task_proto::packages::manifest::ContentFacts;

const LIMITS: Limits = Limits { bytes: 1 << 20, entries: 200, depth: 8, ratio: 200 };
const BLOCK_BYTES: usize = 512;
/// Positions of the checksum and of the magic in a header.
const CHECKSUM: std::ops::Range<usize> = 148..156;
const MAGIC: std::ops::Range<usize> = 257..262;

/// An archive, compressed or not. In every case, nothing outside its directory changes, and no
/// entry inside leads out, has a mode of its own, or is larger than announced (without an
/// announcement: larger than the limits). For uncompressed input, we set the checksums that its
/// headers need, and compress it.
pub fn archive(bytes: &[u8]) {
    let plain = zstd::decode_all(bytes).ok().filter(|_| bytes.len() < 64 * 1024);
    let (content, tar) = match plain {
        Some(plain) => (bytes.to_vec(), plain),
        None => {
            let tar = with_checksums(bytes);
            unannounced(&tar, Compression::None);
            (zstd::encode_all(&*tar, 1).expect("compressed"), tar)
        }
    };
    let mut facts =
        ContentFacts { tar_digest: Digest::of(&tar), tar_size: tar.len() as u64, entries: 0 };
    unannounced(&content, Compression::Zstd);
    // We find the number of entries by announcing too few.
    while let Some(found) = unpacked(&content, &facts) {
        facts.entries = facts.entries.max(found);
    }
}

/// The same bytes, with a valid checksum in every block that claims to be a header.
fn with_checksums(bytes: &[u8]) -> Vec<u8> {
    let mut tar = bytes.to_vec();
    for block in tar.chunks_exact_mut(BLOCK_BYTES).filter(|block| &block[MAGIC] == b"ustar") {
        block[CHECKSUM].fill(b' ');
        let sum: u32 = block.iter().map(|&byte| u32::from(byte)).sum();
        block[CHECKSUM].copy_from_slice(format!("{sum:06o}\0 ").as_bytes());
    }
    tar
}

/// Unpacks an archive without announced facts. Every unpacked entry must have been listed before.
fn unannounced(content: &[u8], compression: Compression) {
    let mut listed = 0;
    let mut entries = Entries::unannounced(content, compression, &LIMITS).expect("bytes in memory");
    let whole = loop {
        match entries.next() {
            Ok(Some(entry)) => {
                listed += u64::from(matches!(entry.kind, Kind::File { .. }));
                assert!(!Path::new(&entry.path).is_absolute(), "{entry:?}");
            }
            end => break end.is_ok(),
        }
    };
    let unpacked = in_staging(LIMITS.bytes, |staging| {
        unpack_unannounced(content, compression, &LIMITS, staging)
    });
    assert!(
        listed <= LIMITS.entries + 1 && (whole || unpacked.is_err()),
        "{listed} files, {unpacked:?}"
    );
}

/// Unpacks as announced. Returns the number of entries found, if more than announced. A check
/// without unpacking must come to the same verdict.
fn unpacked(content: &[u8], facts: &ContentFacts) -> Option<u64> {
    let size = content.len() as u64;
    let unpacked =
        in_staging(facts.tar_size, |staging| unpack(content, size, facts, &LIMITS, staging));
    match check(content, size, facts, &LIMITS) {
        Ok(()) => assert_eq!(unpacked, Ok(())),
        Err(UnpackError::Refused(refusal)) => assert_eq!(unpacked, Err(refusal)),
        Err(error) => panic!("the source does not fail: {error}"),
    }
    match unpacked {
        Ok(()) => {
            let listed = list(content, size, facts).expect("an archive that unpacks can be listed");
            assert!(listed.is_sorted_by(|one, next| one.path < next.path), "{listed:?}");
            None
        }
        Err(Refusal::NotAsAnnounced { what: "entries in the archive", found, announced })
            if found > announced =>
        {
            Some(found)
        }
        _ => None,
    }
}

/// Unpacks and inspects the result; returns the reason of a refusal.
fn in_staging(
    most_bytes: u64,
    unpack: impl FnOnce(&Path) -> Result<(), UnpackError>,
) -> Result<(), Refusal> {
    let outer = tempfile::tempdir().expect("a directory");
    let (staging, neighbour) = (outer.path().join("staging"), outer.path().join("neighbour"));
    fs::write(&neighbour, "untouched").expect("written");
    let result = unpack(&staging);
    let mut around: Vec<_> = fs::read_dir(outer.path())
        .expect("listed")
        .map(|entry| entry.expect("an entry").file_name())
        .collect();
    around.sort();
    assert!(
        around.iter().all(|name| name == "neighbour" || name == "staging"),
        "something was made beside: {around:?}"
    );
    assert_eq!(fs::read_to_string(&neighbour).expect("still there"), "untouched");
    if staging.exists() {
        let size = look(&staging, &staging.canonicalize().expect("a directory"), 0);
        assert!(size <= most_bytes, "{size} bytes of an archive of {most_bytes}");
    }
    match result {
        Err(UnpackError::Refused(refusal)) => {
            assert!(!refusal.to_string().contains(char::is_control), "{refusal:?}");
            Err(refusal)
        }
        Err(UnpackError::Disk { path, source }) => {
            panic!("{} should not have been tried: {source}", path.display())
        }
        Err(UnpackError::Source(error)) => panic!("the source does not fail: {error}"),
        Ok(()) => Ok(()),
    }
}

/// Checks every entry below `directory`; returns the total size of all files, with each hard-linked
/// file counted once.
fn look(directory: &Path, staging: &Path, depth: usize) -> u64 {
    assert!(depth <= 8, "{} is too deep", directory.display());
    let mut size = 0;
    for entry in fs::read_dir(directory).expect("listed") {
        let path = entry.expect("an entry").path();
        let metadata = fs::symlink_metadata(&path).expect("metadata");
        let mode = metadata.permissions().mode() & 0o7777;
        if metadata.is_symlink() {
            follow(&path, staging);
        } else if metadata.is_dir() {
            assert_eq!(mode, 0o755, "{}", path.display());
            size += look(&path, staging, depth + 1);
        } else {
            assert!(
                metadata.is_file() && matches!(mode, 0o644 | 0o755),
                "{} {mode:o}",
                path.display()
            );
            size += metadata.len() / std::os::unix::fs::MetadataExt::nlink(&metadata);
        }
    }
    size
}

/// Follows a link step by step, also over missing entries, because they may be created later.
fn follow(link: &Path, staging: &Path) {
    let mut at = link.parent().expect("a directory").canonicalize().expect("a directory");
    for part in fs::read_link(link).expect("a target").components() {
        match part {
            Component::CurDir => {}
            Component::ParentDir => drop(at.pop()),
            Component::Normal(name) => at.push(name),
            Component::RootDir | Component::Prefix(_) => panic!("{} is absolute", link.display()),
        }
        if at.is_symlink() {
            // A link that leads nowhere, or in a circle, is checked as itself.
            let Ok(end) = at.canonicalize() else { return };
            at = end;
        }
        assert!(at.starts_with(staging), "{} leads to {}", link.display(), at.display());
    }
}
