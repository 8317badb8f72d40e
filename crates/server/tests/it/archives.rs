//! One table of archives and manifests, and two verdicts on each: that of a push, and that of the
//! function by which robots unpack. They must be the same.

use reqwest::StatusCode;
use serde_json::{Value, json};
use task_archive::{Limits, UnpackError, unpack};
use task_proto::Digest;
use task_proto::ids::digest::Algorithm;
use task_proto::packages::manifest::ContentFacts;
use task_proto::packages::oci::{ImageManifest, MANIFEST_TYPE};

use crate::registry::TestRegistry;

/// A content, its description in the manifest, and the words of the refusal; none: the content is
/// accepted.
struct Case {
    name: &'static str,
    content: Vec<u8>,
    facts: ContentFacts,
    refused: Option<&'static str>,
}

impl Case {
    fn new(
        name: &'static str,
        content: Vec<u8>,
        facts: ContentFacts,
        refused: Option<&'static str>,
    ) -> Self {
        Self { name, content, facts, refused }
    }
}

/// An entry: path, type, link target and data.
type EntryOf<'a> = (&'a str, tar::EntryType, &'a str, &'a [u8]);

fn tar_of(entries: &[EntryOf<'_>]) -> Vec<u8> {
    let mut archive = tar::Builder::new(Vec::new());
    for (path, kind, target, data) in entries {
        let mut header = tar::Header::new_ustar();
        header.set_entry_type(*kind);
        header.set_size(data.len() as u64);
        header.set_mode(0o644);
        // The `tar` crate refuses to write some of these names.
        let bytes = header.as_mut_bytes();
        bytes[..path.len()].copy_from_slice(path.as_bytes());
        bytes[157..157 + target.len()].copy_from_slice(target.as_bytes());
        header.set_cksum();
        archive.append(&header, *data).expect("in memory");
    }
    archive.into_inner().expect("in memory")
}

fn facts(tar: &[u8], entries: u64) -> ContentFacts {
    ContentFacts { tar_digest: Digest::of(tar), tar_size: tar.len() as u64, entries }
}

fn frame(bytes: &[u8]) -> Vec<u8> {
    zstd::encode_all(bytes, 1).expect("in memory")
}

fn skippable(bytes: &[u8]) -> Vec<u8> {
    [&0x184D_2A5F_u32.to_le_bytes()[..], &(bytes.len() as u32).to_le_bytes(), bytes].concat()
}

/// A frame that takes a window of 128 MiB to read.
fn wide_frame(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = zstd::Encoder::new(Vec::new(), 1).expect("an encoder");
    encoder.window_log(27).expect("a window");
    std::io::Write::write_all(&mut encoder, bytes).expect("in memory");
    encoder.finish().expect("in memory")
}

fn frames(tar: &[u8]) -> Vec<Case> {
    let (whole, good) = (frame(tar), facts(tar, 2));
    let (head, tail) = tar.split_at(700);
    let case = |name, content: Vec<u8>, refused| Case::new(name, content, good, refused);
    vec![
        case("one frame", whole.clone(), None),
        case("two frames", [frame(head), frame(tail)].concat(), None),
        case("a frame for each block", tar.chunks(512).flat_map(frame).collect(), None),
        case("an empty frame behind", [whole.clone(), frame(b"")].concat(), None),
        case(
            "skippable frames",
            [skippable(b"x"), frame(head), skippable(&[0; 9]), frame(tail)].concat(),
            None,
        ),
        case("a skippable frame behind", [whole.clone(), skippable(b"signature")].concat(), None),
        case("bytes behind the frame", [whole.clone(), b"more".to_vec()].concat(), Some("zstd")),
        case(
            "a second frame with more",
            [whole.clone(), frame(b"more")].concat(),
            Some("uncompressed bytes"),
        ),
        case(
            "a second frame that is cut",
            [frame(head), frame(tail)[..20].to_vec()].concat(),
            Some("zstd"),
        ),
        case(
            "a skippable frame that is cut",
            [whole.clone(), skippable(b"x")[..8].to_vec()].concat(),
            Some("zstd"),
        ),
        case(
            "a second frame with a wide window",
            [frame(head), wide_frame(tail)].concat(),
            Some("zstd"),
        ),
        case("no frame", b"content".to_vec(), Some("zstd")),
        case("nothing", Vec::new(), Some("")),
    ]
}

fn manifests(tar: &[u8]) -> Vec<Case> {
    let (whole, good) = (frame(tar), facts(tar, 2));
    let case = |name, facts, refused| Case::new(name, whole.clone(), facts, Some(refused));
    let sha512 = Algorithm::Sha512.digest(tar);
    vec![
        case(
            "another digest",
            ContentFacts { tar_digest: Digest::of(b"other"), ..good },
            "content.tar_digest",
        ),
        case(
            "a digest that nobody compares",
            ContentFacts { tar_digest: sha512, ..good },
            "is not a SHA-256 digest",
        ),
        case(
            "more bytes",
            ContentFacts { tar_size: good.tar_size + 512, ..good },
            "the task manifest says",
        ),
        case(
            "fewer bytes",
            ContentFacts { tar_size: good.tar_size - 512, ..good },
            "the task manifest says",
        ),
        case("more entries", ContentFacts { entries: 3, ..good }, "entries in the archive: 2"),
        case("fewer entries", ContentFacts { entries: 1, ..good }, "entries in the archive: 2"),
    ]
}

fn names() -> Vec<Case> {
    use tar::EntryType as Type;
    let of = |name, entries: &[EntryOf<'_>], refused| {
        let tar = tar_of(entries);
        Case::new(name, frame(&tar), facts(&tar, entries.len() as u64), refused)
    };
    let file = |path| (path, Type::Regular, "", &b"x"[..]);
    vec![
        of("a link within", &[file("a"), ("b/c", Type::Symlink, "../a", b"")], None),
        of(
            "a link that leaves",
            &[("b/c", Type::Symlink, "../../a", b"")],
            Some("leaves the package"),
        ),
        of(
            "a link through another",
            &[("a", Type::Symlink, "b/..", b""), ("c", Type::Symlink, "a/../..", b"")],
            Some("leaves"),
        ),
        of("an absolute link", &[("b", Type::Symlink, "/etc", b"")], Some("leaves the package")),
        of(
            "a file below a link",
            &[("b", Type::Symlink, "c", b""), file("b/x")],
            Some("is a symbolic link"),
        ),
        of("a file below a file", &[file("b"), file("b/x")], Some("is a file")),
        of("a name twice", &[file("b"), file("./b")], Some("duplicate name")),
        of("a hard link to nothing", &[("b", Type::Link, "c", b"")], Some("an earlier file")),
        of("a second name", &[file("c"), ("b", Type::Link, "c", b"")], None),
        of("a way out", &[file("../b")], Some("'..'")),
        of("a device", &[("b", Type::Char, "", b"")], Some("devices")),
    ]
}

/// The reason for which a robot would not unpack the archive.
fn unpacked(case: &Case) -> Result<(), String> {
    let directory = tempfile::tempdir().expect("a directory");
    let size = case.content.len() as u64;
    match unpack(
        &case.content[..],
        size,
        &case.facts,
        &Limits::default(),
        &directory.path().join("tree"),
    ) {
        Ok(()) => Ok(()),
        Err(UnpackError::Refused(refusal)) => Err(refusal.to_string()),
        Err(error) => panic!("{}: {error}", case.name),
    }
}

/// The reason for which the registry rejects the archive.
async fn pushed(registry: &TestRegistry, case: &Case) -> Result<(), String> {
    let task = json!({
        "name": "talker", "version": "1.0.0", "run": { "exec": ["true"] }, "content": case.facts,
    });
    let content = registry.push_blob("talker", &case.content).await;
    let config = registry.push_blob("talker", task.to_string().as_bytes()).await;
    let package = ImageManifest::package(config, content);
    let answer = registry
        .put_manifest("/v2/talker/manifests/1.0.0?force=true", MANIFEST_TYPE, &package)
        .await;
    if answer.status() == StatusCode::CREATED {
        return Ok(());
    }
    assert_eq!(answer.status(), StatusCode::BAD_REQUEST, "{}", case.name);
    let body: Value = answer.json().await.expect("an error body");
    assert_eq!(body["errors"][0]["code"], "MANIFEST_INVALID");
    let message = body["errors"][0]["message"].as_str().expect("text");
    Err(message
        .strip_prefix("robots would refuse the package's archive: ")
        .unwrap_or_else(|| panic!("{message}"))
        .to_owned())
}

#[tokio::test]
async fn push_and_robot_agree_on_every_archive() {
    use tar::EntryType as Type;
    let tar =
        tar_of(&[("main.sh", Type::Regular, "", &[b'x'; 900]), ("data", Type::Directory, "", b"")]);
    let registry = TestRegistry::start().await;
    for case in frames(&tar).into_iter().chain(manifests(&tar)).chain(names()) {
        let (push, robot) = (pushed(&registry, &case).await, unpacked(&case));
        assert_eq!(push, robot, "{}", case.name);
        match (case.refused, robot) {
            (None, verdict) => assert_eq!(verdict, Ok(()), "{}", case.name),
            (Some(words), Err(reason)) => {
                assert!(reason.contains(words), "{}: {reason}", case.name)
            }
            (Some(words), Ok(())) => panic!("{} is accepted, not refused for {words:?}", case.name),
        }
    }
}
