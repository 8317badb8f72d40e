//! Hostile and honest archives against the unpacker. No archive changes anything outside the
//! staging directory.

use std::collections::BTreeMap;
use std::fs;
use std::io::{self, Read};
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::Path;

use proptest::prelude::*;
use task_archive::{Limits, Refusal, UnpackError, unpack};
use task_proto::packages::manifest::ContentFacts;

use crate::archive::{Header, Tar, compress, seal};

/// A directory with something worth protecting beside the staging directory.
struct Site {
    dir: tempfile::TempDir,
}

impl Site {
    fn new() -> Self {
        let dir = tempfile::tempdir().unwrap();
        fs::create_dir(dir.path().join("neighbour")).unwrap();
        fs::write(dir.path().join("neighbour/secret"), "kept").unwrap();
        Self { dir }
    }

    /// Unpacks; checks that nothing but the staging directory has changed.
    fn unpack(
        &self,
        content: &[u8],
        facts: &ContentFacts,
        limits: &Limits,
    ) -> Result<(), UnpackError> {
        let staging = self.dir.path().join("staging");
        let before = snapshot(self.dir.path(), &staging);
        let result = unpack(content, content.len() as u64, facts, limits, &staging);
        assert_eq!(snapshot(self.dir.path(), &staging), before);
        if let Ok(()) = result {
            assert_stays_inside(&staging);
        }
        result
    }

    fn path(&self, name: &str) -> std::path::PathBuf {
        self.dir.path().join("staging").join(name)
    }
}

fn snapshot(dir: &Path, except: &Path) -> BTreeMap<String, (u32, u64, Vec<u8>)> {
    let mut found = BTreeMap::new();
    for entry in fs::read_dir(dir).unwrap() {
        let path = entry.unwrap().path();
        if path == except {
            continue;
        }
        let metadata = path.symlink_metadata().unwrap();
        let content = if metadata.is_file() { fs::read(&path).unwrap() } else { Vec::new() };
        found.insert(path.display().to_string(), (metadata.mode(), metadata.nlink(), content));
        if metadata.is_dir() {
            found.extend(snapshot(&path, except));
        }
    }
    found
}

/// Every link of the tree that leads somewhere leads into the tree; there are only files,
/// directories and links.
fn assert_stays_inside(root: &Path) {
    let root = root.canonicalize().unwrap();
    let mut dirs = vec![root.clone()];
    while let Some(dir) = dirs.pop() {
        for entry in fs::read_dir(dir).unwrap() {
            let path = entry.unwrap().path();
            let metadata = path.symlink_metadata().unwrap();
            if metadata.is_symlink() {
                if let Ok(target) = path.canonicalize() {
                    assert!(
                        target.starts_with(&root),
                        "{} leads to {}",
                        path.display(),
                        target.display()
                    );
                }
                continue;
            }
            let mode = metadata.mode() & 0o7777;
            assert!(
                mode == 0o644 && metadata.is_file() || mode == 0o755,
                "{} has {mode:o}",
                path.display()
            );
            if metadata.is_dir() {
                dirs.push(path);
            }
        }
    }
}

fn refusal(tar: &Tar) -> String {
    refusal_of(&tar.compressed(), &tar.facts(), &Limits::default())
}

fn refusal_of(content: &[u8], facts: &ContentFacts, limits: &Limits) -> String {
    match Site::new().unpack(content, facts, limits) {
        Err(UnpackError::Refused(refusal)) => refusal.to_string(),
        other => panic!("not refused but {other:?}"),
    }
}

#[test]
fn valid_archive_is_unpacked() {
    let long = format!("{}/{}", "d".repeat(120), "f".repeat(130));
    let big: Vec<u8> = (0..300_000u32).flat_map(u32::to_le_bytes).collect();
    let tar = Tar::default()
        .header(Header { name: b"./", kind: b'5', mode: 0o755, ..Header::default() })
        .dir("pkg/")
        .file("pkg/big", &big)
        .header(Header { name: b"run", mode: 0o775, ..Header::default() })
        .header(Header { name: b"file", prefix: b"some/prefix", ..Header::default() })
        .typed(b'L', "././@LongLink", format!("{long}\0").as_bytes())
        .file("cut", b"long")
        .pax(&[("path", "päx/näme"), ("mtime", "1.5"), ("uid", "0")])
        .file("cut", b"pax")
        .dir("päx/")
        .symlink("pkg/alias", "../run")
        .symlink("pkg/dangling", "../built/later")
        .hard_link("pkg/same", "pkg/big")
        .end();
    let site = Site::new();
    site.unpack(&tar.compressed(), &tar.facts(), &Limits::default()).unwrap();
    assert_eq!(fs::read(site.path("pkg/big")).unwrap(), big);
    assert_eq!(fs::read(site.path(&long)).unwrap(), b"long");
    assert_eq!(fs::read(site.path("päx/näme")).unwrap(), b"pax");
    assert_eq!(fs::read_link(site.path("pkg/alias")).unwrap(), Path::new("../run"));
    assert_eq!(fs::metadata(site.path("pkg/same")).unwrap().nlink(), 2);
    assert_eq!(fs::metadata(site.path("run")).unwrap().permissions().mode() & 0o7777, 0o755);
    assert!(site.path("some/prefix/file").is_file());
}

fn assert_refused<const N: usize>(cases: [(Tar, &str); N]) {
    for (at, (tar, reason)) in cases.into_iter().enumerate() {
        let refused = refusal(&tar.end());
        assert!(refused.contains(reason), "case {at}: {refused:?} does not say {reason:?}");
    }
}

#[test]
fn paths_that_leave_or_confuse_are_refused() {
    let tar = Tar::default;
    let named = |name: &[u8]| tar().header(Header { name, ..Header::default() });
    assert_refused([
        (tar().file("/etc/passwd", b"x"), r#"entry "/etc/passwd": the path is absolute"#),
        (tar().file("../x", b"x"), "the path has '..'"),
        (tar().file("a/../../x", b"x"), "the path has '..'"),
        (tar().dir("a/.."), "the path has '..'"),
        (tar().pax(&[("path", "../x")]).file("ok", b""), "the path has '..'"),
        (tar().typed(b'L', "l", b"/abs\0").file("ok", b""), "the path is absolute"),
        (tar().file("", b"x"), "the path is empty"),
        (tar().file("./", b""), "ends with '/'"),
        (tar().file(".", b""), "would replace the package's own directory"),
        (tar().symlink(".", "x"), "would replace the package's own directory"),
        (tar().file("dir/", b""), "ends with '/'"),
        (named(b"\xff\xfe"), "not UTF-8"),
        (named(b"a\nb"), "control character"),
        (named("a\u{9b}b".as_bytes()), "control character"),
        (tar().pax(&[("path", "a\0b")]).file("ok", b""), "control character"),
        (
            tar().pax(&[("path", &"n".repeat(256))]).file("ok", b""),
            "a name is longer than 255 bytes",
        ),
        (
            tar().pax(&[("path", &"n/".repeat(600))]).file("ok", b""),
            "the path is longer than 1024 bytes",
        ),
        (tar().typed(b'L', "l", &[b'n'; 5000]).file("ok", b""), "a name is longer than 1024 bytes"),
        (
            tar().pax(&[("path", &"d/".repeat(49))]).dir("ok"),
            "the path has 49 components, where at most 48 are allowed",
        ),
    ]);
}

#[test]
fn duplicate_names_are_refused() {
    let tar = Tar::default;
    assert_refused([
        (tar().file("a", b"").file("a", b""), r#"entry "a": duplicate name"#),
        (tar().file("a", b"").file("./a", b""), "duplicate name"),
        (tar().file("a/b", b"").file("a//b", b""), "duplicate name"),
        (tar().file("a/b", b"").file("a", b""), "duplicate name"),
        (tar().dir("a").dir("a/"), "duplicate name"),
        (tar().dir("a").file("a", b""), "duplicate name"),
        (tar().file("a", b"").dir("a"), "duplicate name"),
        (tar().symlink("a", "b").file("a", b""), "duplicate name"),
        (tar().file("a", b"").file("a/b", b""), r#""a" above it is a file"#),
        (tar().symlink("a", ".").file("a/b", b""), r#""a" above it is a symbolic link"#),
        (tar().symlink("a", "../neighbour").file("a/secret", b"x"), "above it is a symbolic link"),
    ]);
}

#[test]
fn links_that_leave_the_package_are_refused() {
    let tar = Tar::default;
    assert_refused([
        (
            tar().symlink("a", "/etc"),
            r#"entry "a": the symbolic link to "/etc" leaves the package"#,
        ),
        (tar().symlink("a", ".."), "leaves the package"),
        (tar().symlink("d/a", "../../x"), "leaves the package"),
        (tar().symlink("d/a", "missing/../../../x"), "leaves the package"),
        (tar().symlink("d/e/up", "..").symlink("out", "d/e/up/../../x"), "leaves the package"),
        (tar().symlink("a/b", "..").symlink("c", "a/b/.."), "leaves the package"),
        (tar().symlink("x", "y").symlink("y", "x"), "leads through too many others"),
        (tar().symlink("x", ""), "its link target"),
        (tar().pax(&[("linkpath", "../x")]).symlink("a", "ok"), "leaves the package"),
        (tar().typed(b'K', "l", b"/etc\0").symlink("a", "ok"), "leaves the package"),
        (tar().hard_link("a", "/etc/passwd"), "its link target: the path is absolute"),
        (tar().hard_link("a", "../neighbour/secret"), "its link target: the path has '..'"),
        (
            tar().hard_link("a", "b").file("b", b""),
            "a hard link must name an earlier file of the archive",
        ),
        (tar().dir("b").hard_link("a", "b"), "a hard link must name an earlier file"),
        (tar().symlink("b", "c").hard_link("a", "b"), "a hard link must name an earlier file"),
        (tar().hard_link("a", "a"), "a hard link must name an earlier file"),
    ]);
}

#[test]
fn special_files_are_refused() {
    let tar = Tar::default;
    let moded = |mode| tar().header(Header { name: b"f", mode, ..Header::default() });
    assert_refused([
        (tar().typed(b'3', "null", b""), "devices are not accepted"),
        (tar().typed(b'4', "sda", b""), "devices are not accepted"),
        (tar().typed(b'6', "pipe", b""), "FIFOs are not accepted"),
        (tar().typed(b'S', "sparse", b""), "sparse files are not accepted"),
        (tar().typed(b'7', "contiguous", b""), r#"entries of type "7" are not accepted"#),
        (tar().typed(b's', "socket", b""), r#"entries of type "s" are not accepted"#),
        (tar().typed(b'5', "d", b"content"), "only files may have content"),
        (tar().typed(b'2', "l", b"content"), "its link target"),
        (moded(0o4755), "mode 4755 has set-id or sticky bits"),
        (moded(0o2755), "set-id"),
        (moded(0o1777), "sticky"),
    ]);
}

#[test]
fn ambiguous_headers_are_refused() {
    let tar = Tar::default;
    assert_refused([
        (tar().pax(&[("size", "0")]).file("a", b""), r#"PAX record "size" is not accepted"#),
        (tar().pax(&[("GNU.sparse.major", "1")]).file("a", b""), "GNU.sparse.major"),
        (tar().pax(&[("SCHILY.xattr.security.capability", "x")]).file("a", b""), "SCHILY.xattr"),
        (tar().pax(&[("path", "a"), ("path", "b")]).file("a", b""), "two long names"),
        (tar().pax(&[("path", "a")]).typed(b'L', "l", b"b\0").file("a", b""), "two long names"),
        (tar().typed(b'g', "g", b"10 path=x\n").file("a", b""), "PAX record"),
        (tar().typed(b'x', "x", b"99 path=x\n").file("a", b""), "a PAX record is malformed"),
        (tar().typed(b'x', "x", b"0 \n").file("a", b""), "a PAX record is malformed"),
        (tar().typed(b'x', "x", b"-1 a=b\n").file("a", b""), "a PAX record is malformed"),
        (
            tar().typed(b'x', "x", &[b'9'; 20_000]).file("a", b""),
            "PAX records are longer than 16384 bytes",
        ),
        (tar().pax(&[("path", "a")]), "a long name without an entry"),
    ]);
}

#[test]
fn invalid_archives_are_refused() {
    let honest = Tar::default().file("a", b"content").end();
    let facts = honest.facts();
    let with = |change: &dyn Fn(&mut [u8; 512])| {
        let mut tar = honest.clone();
        let mut block: [u8; 512] = tar.bytes[..512].try_into().unwrap();
        change(&mut block);
        tar.bytes[..512].copy_from_slice(&block);
        refusal(&tar)
    };
    assert!(with(&|block| block[0] ^= 1).contains("checksum is wrong"));
    let resized = |size: &'static [u8]| {
        with(&|block| {
            block[124..124 + size.len()].copy_from_slice(size);
            seal(block);
        })
    };
    assert!(resized(b"77777777777").contains("longer than the rest of the archive"));
    assert!(
        resized(b"\xff\xff\xff\xff\xff\xff\xff\xff\xff\xff\xff\xff")
            .contains("longer than the rest of the archive")
    );
    assert!(resized(b"x").contains("an entry's size is not a number"));
    let v7 = with(&|block| {
        block[257..265].fill(0);
        seal(block);
    });
    assert!(v7.contains("neither ustar nor GNU"), "{v7}");

    let limits = Limits::default();
    let whole = honest.compressed();
    for cut in 0..whole.len() {
        let refused = refusal_of(&whole[..cut], &facts, &limits);
        assert!(refused.starts_with("damaged archive at byte"), "cut at {cut}: {refused}");
    }
    for cut in (0..honest.bytes.len()).step_by(100) {
        refusal_of(&compress(&honest.bytes[..cut]), &facts, &limits);
    }
    let two_frames = [whole.clone(), compress(&[0; 512])].concat();
    assert!(refusal_of(&two_frames, &facts, &limits).contains("uncompressed bytes, so far"));
    assert!(refusal_of(&[&whole[..], b"x"].concat(), &facts, &limits).contains("zstd"));
    assert!(refusal_of(b"<html>", &facts, &limits).contains("zstd"));

    let mut garbage = honest.clone();
    garbage.bytes.extend([1; 512]);
    assert!(refusal(&garbage).contains("bytes follow the end marker"));
}

#[test]
fn manifest_facts_must_match_exactly() {
    let tar = Tar::default().file("a", b"1").file("b", b"2").end();
    let facts = tar.facts();
    let refused = |facts: ContentFacts| refusal_of(&tar.compressed(), &facts, &Limits::default());
    assert!(
        refused(ContentFacts { entries: 1, ..facts }).contains("2, where the task manifest says 1")
    );
    assert!(
        refused(ContentFacts { entries: 3, ..facts }).contains("2, where the task manifest says 3")
    );
    assert!(
        refused(ContentFacts { tar_size: facts.tar_size + 512, ..facts })
            .contains("uncompressed bytes: 3072")
    );
    assert!(
        refused(ContentFacts { tar_size: facts.tar_size - 512, ..facts })
            .contains("uncompressed bytes, so far")
    );
}

#[test]
fn limits_hold_before_and_while_unpacking() {
    let mut tar = Tar::default();
    for at in 0..20 {
        tar = tar.file(&format!("{at}/x/y"), b"");
    }
    let tar = tar.end();
    let (content, facts) = (tar.compressed(), tar.facts());
    let refused = |limits: Limits| refusal_of(&content, &facts, &limits);
    let default = Limits::default();
    assert!(refused(Limits { entries: 19, ..default }).starts_with("entries in the archive: 20"));
    assert!(
        refused(Limits { entries: 59, ..default }).starts_with("files, directories and links: 60")
    );
    assert!(refused(Limits { depth: 2, ..default }).contains("at most 2 are allowed"));
    assert!(refused(Limits { bytes: 1000, ..default }).starts_with("uncompressed bytes: "));
}

#[test]
fn archive_bomb_writes_no_more_than_announced() {
    let zeros = 256 << 20;
    let mut encoder = zstd::Encoder::new(Vec::new(), 3).unwrap();
    let header = Header { name: b"zeros", size: zeros, ..Header::default() }.block();
    io::copy(&mut header.chain(io::repeat(0).take(zeros + 1024)), &mut encoder).unwrap();
    let bomb = encoder.finish().unwrap();
    let honest = ContentFacts { tar_size: zeros + 1536, entries: 1, ..Tar::default().facts() };
    let refused = refusal_of(&bomb, &honest, &Limits::default());
    assert!(refused.starts_with("uncompressed bytes for this compressed size"), "{refused}");

    let site = Site::new();
    let lying = ContentFacts { tar_size: 1 << 20, ..honest };
    let result = site.unpack(&bomb, &lying, &Limits::default());
    assert!(matches!(result, Err(UnpackError::Refused(Refusal::Damaged { .. }))), "{result:?}");
    assert!(!site.path("zeros").exists());
}

#[test]
fn window_larger_than_the_memory_limit_is_refused() {
    let mut encoder = zstd::Encoder::new(Vec::new(), 1).unwrap();
    encoder.window_log(27).unwrap();
    io::copy(&mut io::repeat(7).take(1 << 20), &mut encoder).unwrap();
    let facts = ContentFacts { tar_size: 1 << 20, ..Tar::default().facts() };
    let refused = refusal_of(&encoder.finish().unwrap(), &facts, &Limits::default());
    assert!(refused.contains("zstd") && refused.contains("memory"), "{refused}");
}

#[test]
fn failed_source_is_no_archive_error() {
    struct Broken;
    impl Read for Broken {
        fn read(&mut self, _: &mut [u8]) -> io::Result<usize> {
            Err(io::Error::other("gone"))
        }
    }
    let tar = Tar::default().file("a", &[7; 4096]).end();
    let content = tar.compressed();
    let dir = tempfile::tempdir().unwrap();
    let source = content[..content.len() / 2].chain(Broken);
    let result = unpack(
        source,
        content.len() as u64,
        &tar.facts(),
        &Limits::default(),
        &dir.path().join("s"),
    );
    assert!(matches!(result, Err(UnpackError::Source(_))), "{result:?}");
}

/// Entries as an attacker combines them: few names, so that they meet.
fn hostile_entry() -> impl Strategy<Value = (u8, String, String, u32)> {
    let name = prop::sample::select(vec![
        "a", "b", "a/b", "a/c", "a/b/c", "../x", "/x", "./a", "b/../c", "c/", ".",
    ]);
    let target = prop::sample::select(vec![
        "a",
        "b",
        "..",
        "../..",
        "a/..",
        "../neighbour/secret",
        "/etc",
        "b/c",
        "",
    ]);
    let kind = prop::sample::select(b"0125".to_vec());
    let rare = prop::sample::select(b"3467SLKxg".to_vec());
    let kind = prop_oneof![12 => kind, 1 => rare];
    let mode = prop_oneof![9 => Just(0o644), 1 => any::<u32>().prop_map(|mode| mode & 0o7777)];
    (kind, name.prop_map(str::to_owned), target.prop_map(str::to_owned), mode)
}

proptest! {
    #![proptest_config(ProptestConfig {
        cases: 256, failure_persistence: None, ..ProptestConfig::default()
    })]

    #[test]
    fn no_combination_of_entries_escapes(entries in prop::collection::vec(hostile_entry(), 0..12)) {
        let mut tar = Tar::default();
        for (kind, name, target, mode) in &entries {
            let (name, link) = (name.as_bytes(), target.as_bytes());
            let content: &[u8] = if matches!(kind, b'0' | b'L' | b'K' | b'x') { link } else { b"" };
            let size = content.len() as u64;
            let header = Header { name, kind: *kind, mode: *mode, link, size, ..Header::default() };
            tar = tar.header(header).content(content);
        }
        let tar = tar.end();
        let _ = Site::new().unpack(&tar.compressed(), &tar.facts(), &Limits::default());
    }

    #[test]
    fn no_mutation_panics_or_escapes(
        changes in prop::collection::vec((0usize..6144, any::<u8>()), 1..8),
        reseal in any::<bool>(),
        compressed in any::<bool>(),
    ) {
        let mut tar = Tar::default()
            .dir("d")
            .file("d/f", b"content")
            .pax(&[("path", "d/g")])
            .file("cut", b"content")
            .symlink("l", "d/f")
            .hard_link("h", "d/f")
            .end();
        let facts = tar.facts();
        let mut content = tar.compressed();
        for (at, value) in changes {
            if compressed {
                let length = content.len();
                content[at % length] = value;
            } else {
                let length = tar.bytes.len();
                tar.bytes[at % length] = value;
            }
        }
        if !compressed {
            let headers = tar.bytes.chunks_exact_mut(512);
            for block in headers.filter(|block| reseal && block[257..262] == *b"ustar") {
                seal(block.try_into().unwrap());
            }
            content = tar.compressed();
        }
        let _ = Site::new().unpack(&content, &facts, &Limits::default());
    }

    #[test]
    fn random_bytes_are_refused(noise in prop::collection::vec(any::<u8>(), 0..4096)) {
        let facts = ContentFacts { tar_size: noise.len() as u64, ..Tar::default().facts() };
        prop_assert!(Site::new().unpack(&noise, &facts, &Limits::default()).is_err());
        let unpacked = Site::new().unpack(&compress(&noise), &facts, &Limits::default());
        prop_assert!(unpacked.is_err() || noise.iter().all(|&b| b == 0));
    }
}
