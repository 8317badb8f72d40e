//! Makes a package of a directory: checks the directory, packs its files, and describes them as OCI
//! blobs and manifest. The same directory gives the same digests, for every user, on every machine,
//! at any time.

use std::io::{BufWriter, Write as _};
use std::path::Path;

use task_proto::Digest;
use task_proto::desired::{BlobRef, PackageRef};
use task_proto::packages::manifest::{
    CONTENT_RATIO_FREE_BYTES, MAX_CONTENT_RATIO, MAX_MANIFEST_BYTES, TaskManifest,
};
use task_proto::packages::oci::ImageManifest;
use tempfile::NamedTempFile;

use super::{Launch, PackageError, Packed, Problem, archive, source};

/// A manifest and its bytes, for existing content.
#[derive(Debug)]
pub struct PackageDescription {
    /// The reference that pins the package.
    pub package: PackageRef,
    /// The manifest as the OCI config blob.
    pub config_bytes: Vec<u8>,
    /// The OCI manifest that names both blobs.
    pub manifest_bytes: Vec<u8>,
}

/// The package of this manifest and this content.
pub fn describe(
    manifest: &TaskManifest,
    content: BlobRef,
) -> Result<PackageDescription, PackageError> {
    let config_bytes = json(manifest)?;
    let config = blob(&config_bytes);
    let manifest_bytes = json(&ImageManifest::package(config, content))?;
    let package = PackageRef {
        name: manifest.name.clone(),
        version: manifest.version.clone(),
        manifest: blob(&manifest_bytes),
        config,
        content,
    };
    Ok(PackageDescription { package, config_bytes, manifest_bytes })
}

/// Packs `dir`. Reads every file once and blocks meanwhile.
pub fn pack(dir: &Path) -> Result<Packed, PackageError> {
    pack_with(dir, None, &std::env::temp_dir())
}

/// Packs with the content's temporary file in the directory `temporary`.
pub fn pack_into(dir: &Path, temporary: &Path) -> Result<Packed, PackageError> {
    pack_with(dir, None, temporary)
}

/// Packs `dir` to run as `launch` says, in place of the directory's own `[run]`.
pub fn pack_with_launch(dir: &Path, launch: &Launch) -> Result<Packed, PackageError> {
    pack_with(dir, Some(launch), &std::env::temp_dir())
}

fn pack_with(
    dir: &Path,
    launch: Option<&Launch>,
    temporary: &Path,
) -> Result<Packed, PackageError> {
    let source::Source { mut manifest, tree } = source::read(dir, launch)?;
    let failed = |source| PackageError::Io {
        what: "can't write the packed content to a temporary file (see TMPDIR)".to_owned(),
        source,
    };
    let mut content = NamedTempFile::with_prefix_in("taskd-content-", temporary).map_err(failed)?;
    let mut output = BufWriter::with_capacity(256 * 1024, content.as_file_mut());
    let (content_blob, facts) = archive::write(&tree, &mut output)?;
    output.flush().map_err(failed)?;
    drop(output);
    if facts.tar_size
        > content_blob.size.saturating_mul(MAX_CONTENT_RATIO).max(CONTENT_RATIO_FREE_BYTES)
    {
        let reason = format!(
            "compresses more than {MAX_CONTENT_RATIO} times ({} to {} bytes), which robots refuse; exclude sparse or empty files",
            facts.tar_size, content_blob.size
        );
        return Err(invalid(dir, ".", reason));
    }
    manifest.content = facts;
    let PackageDescription { package, config_bytes, manifest_bytes } =
        describe(&manifest, content_blob)?;
    if config_bytes.len() > MAX_MANIFEST_BYTES {
        let reason = format!("makes a manifest of more than {MAX_MANIFEST_BYTES} bytes");
        return Err(invalid(dir, "task.toml", reason));
    }
    Ok(Packed { package, manifest, config_bytes, manifest_bytes, content })
}

fn invalid(dir: &Path, file: &str, reason: String) -> PackageError {
    PackageError::Invalid {
        dir: dir.to_owned(),
        problems: vec![Problem { file: file.to_owned(), reason }],
    }
}

/// Compact JSON with fields in declaration order and sorted maps: one text for each value.
fn json<T: serde::Serialize>(value: &T) -> Result<Vec<u8>, PackageError> {
    serde_json::to_vec(value).map_err(|error| PackageError::Io {
        what: "can't write the task manifest".to_owned(),
        source: error.into(),
    })
}

fn blob(bytes: &[u8]) -> BlobRef {
    BlobRef { digest: Digest::of(bytes), size: bytes.len() as u64 }
}

#[cfg(test)]
mod tests {
    use std::fs::{self, Permissions};
    use std::os::unix::fs::{PermissionsExt as _, symlink};
    use std::path::PathBuf;

    use proptest::prelude::*;
    use tempfile::TempDir;

    use super::*;

    const TASK: &str = "name = \"plain\"\nversion = \"1.0.0\"\n[run]\nexec = [\"./run.sh\"]\n";
    const XML: &str = "<package format=\"3\"><name>talker</name><version>1.0.0</version><description>d</description>\
        <maintainer email=\"a@example.org\">A</maintainer><license>Apache-2.0</license><exec_depend>rclpy</exec_depend>\
        <export><build_type>ament_python</build_type></export></package>";
    const LAUNCH: &str = "[run]\nlaunch = [\"talker\", \"talker.launch.py\"]\n";

    /// A file of a tree: path, content, executable or not.
    type Entry<'a> = (&'a str, &'a str, bool);

    fn tree(entries: &[Entry<'_>]) -> TempDir {
        let dir = tempfile::tempdir().unwrap();
        for (path, content, executable) in entries {
            let path = dir.path().join(path);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(&path, content).unwrap();
            fs::set_permissions(
                &path,
                Permissions::from_mode(if *executable { 0o755 } else { 0o644 }),
            )
            .unwrap();
        }
        dir
    }

    fn plain() -> TempDir {
        tree(&[
            ("task.toml", TASK, false),
            ("run.sh", "#!/bin/sh\n", true),
            ("data/a.txt", "a", false),
        ])
    }

    fn talker() -> TempDir {
        tree(&[
            ("task.toml", LAUNCH, false),
            ("package.xml", XML, false),
            ("setup.py", "", false),
            ("launch/talker.launch.py", "", false),
        ])
    }

    fn problems(dir: &TempDir) -> Vec<String> {
        match pack(dir.path()) {
            Err(PackageError::Invalid { problems, .. }) => {
                problems.iter().map(ToString::to_string).collect()
            }
            other => panic!("{other:?}"),
        }
    }

    /// Asserts that the tree is refused for exactly one reason, which contains `expected`.
    fn refused(dir: &TempDir, expected: &str) {
        let problems = problems(dir);
        assert!(
            problems.len() == 1 && problems[0].contains(expected),
            "expected {expected:?}, got {problems:#?}"
        );
    }

    fn names(packed: &Packed) -> Vec<String> {
        let plain = zstd::decode_all(fs::File::open(packed.content.path()).unwrap()).unwrap();
        assert_eq!(Digest::of(&plain), packed.manifest.content.tar_digest);
        assert_eq!(plain.len() as u64, packed.manifest.content.tar_size);
        let mut archive = tar::Archive::new(&plain[..]);
        archive
            .entries()
            .unwrap()
            .map(|entry| entry.unwrap().path().unwrap().display().to_string())
            .collect()
    }

    #[test]
    fn fixed_tree_has_a_fixed_digest() {
        let long = format!("data/{}/{}.txt", "d".repeat(120), "f".repeat(120));
        let dir = plain();
        fs::create_dir_all(dir.path().join(&long).parent().unwrap()).unwrap();
        fs::write(dir.path().join(&long), "long").unwrap();
        symlink("data/a.txt", dir.path().join("link")).unwrap();
        let packed = pack(dir.path()).unwrap();
        let digests = [
            packed.manifest.content.tar_digest,
            packed.package.content.digest,
            packed.package.manifest.digest,
        ];
        // A change here means that the digest of every package changes: say so in the commit.
        assert_eq!(
            digests.map(|digest| digest.to_string()),
            [
                "sha256:b984965207a08d0b5f8338d17ef09f9d528b5552df2560d6b92c00b97bb23410",
                "sha256:2bc9b808f6af3c89bde1b446c5ad3b35d69d908170a637ff9d60f3485aaf283d",
                "sha256:01f715d7ca62db3933e0273b1bb661ba10351532158f1a11cfced692a2021e0a"
            ]
        );
        assert_eq!(names(&packed).len() as u64, packed.manifest.content.entries);
    }

    #[test]
    fn blobs_match_the_manifest() {
        let packed = pack(plain().path()).unwrap();
        let content = fs::read(packed.content.path()).unwrap();
        assert_eq!(blob(&content), packed.package.content);
        let manifest: ImageManifest = serde_json::from_slice(&packed.manifest_bytes).unwrap();
        assert_eq!(manifest.package_blobs(), Some((packed.package.config, packed.package.content)));
        assert_eq!(
            serde_json::from_slice::<task_proto::packages::manifest::TaskManifest>(
                &packed.config_bytes
            )
            .unwrap(),
            packed.manifest
        );
        assert_eq!(names(&packed), ["data", "data/a.txt", "run.sh", "task.toml"]);
    }

    #[test]
    fn excluded_files_are_not_packed() {
        let dir = talker();
        for path in [
            ".git/config",
            "talker/__pycache__/x.pyc",
            "build/x",
            "install/x",
            "log/x",
            "data/big.bag",
            "data/keep",
            "sub/build/x",
        ] {
            let path = dir.path().join(path);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, "x").unwrap();
        }
        fs::write(dir.path().join(".taskdignore"), "# recordings\n*.bag\n").unwrap();
        let packed = pack(dir.path()).unwrap();
        assert_eq!(
            names(&packed),
            [
                "data",
                "data/keep",
                "launch",
                "launch/talker.launch.py",
                "package.xml",
                "setup.py",
                "sub",
                "sub/build",
                "sub/build/x",
                "talker",
                "task.toml"
            ]
        );
        fs::write(dir.path().join("task.toml"), TASK.replace("./run.sh", "install/x")).unwrap();
        fs::set_permissions(dir.path().join("install/x"), Permissions::from_mode(0o755)).unwrap();
        fs::remove_file(dir.path().join("package.xml")).unwrap();
        fs::write(dir.path().join("build/COLCON_IGNORE"), "").unwrap();
        let packed = names(&pack(dir.path()).unwrap());
        assert!(packed.contains(&"install/x".to_owned()) && packed.contains(&"log/x".to_owned()));
        assert!(!packed.contains(&"build".to_owned()));
        fs::write(dir.path().join(".taskdignore"), "!keep\n").unwrap();
        refused(&dir, ".taskdignore: line 1: \"!keep\": negated patterns are not supported");
    }

    #[test]
    fn package_xml_provides_keys_missing_in_task_toml() {
        let packed = pack(talker().path()).unwrap();
        assert_eq!(
            (packed.manifest.name.as_str(), packed.manifest.version.as_str()),
            ("talker", "1.0.0")
        );
        assert_eq!(packed.manifest.exec_depends, ["rclpy"]);
        let dir = talker();
        fs::write(
            dir.path().join("task.toml"),
            format!("name = \"other\"\nversion = \"2\"\n{LAUNCH}"),
        )
        .unwrap();
        let packed = pack(dir.path()).unwrap();
        assert_eq!(
            (packed.manifest.name.as_str(), packed.manifest.version.as_str()),
            ("other", "2")
        );
    }

    #[test]
    fn packages_ignored_by_build_tools_are_not_checked() {
        let add = |dir: &TempDir, path: &str, text: &str| {
            let path = dir.path().join(path);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        };
        let bad = XML.replace(
            "<build_type>ament_python</build_type>",
            "<build_type>ament_cmake</build_type>",
        );
        let dir = talker();
        add(&dir, "test/fixtures/package.xml", &bad);
        pack(dir.path()).expect("a package's own files are no packages");
        let dir = tree(&[(
            "task.toml",
            &LAUNCH.replacen(
                "[run]",
                "name = \"all\"\nversion = \"1\"\n[build]\ntool = \"colcon\"\n[run]",
                1,
            ),
            false,
        )]);
        for (path, text) in [
            ("src/talker/package.xml", XML),
            ("src/talker/setup.py", ""),
            ("src/talker/launch/talker.launch.py", ""),
        ] {
            add(&dir, path, text);
        }
        add(&dir, "third_party/old/package.xml", &bad);
        refused(&dir, "third_party/old/CMakeLists.txt: is missing");
        add(&dir, "third_party/COLCON_IGNORE", "");
        pack(dir.path()).expect("nobody looks there");
    }

    #[test]
    fn missing_parts_are_named_with_their_file() {
        refused(&tree(&[("a", "", false)]), "task.toml: is missing, as is package.xml");
        refused(
            &tree(&[("package.xml", XML, false), ("setup.py", "", false)]),
            "task.toml: is missing; package.xml does not specify",
        );
        let dir = tree(&[("task.toml", "[run]\nexec = [\"true\"]\n", false)]);
        assert_eq!(
            problems(&dir),
            ["task.toml: name: is missing", "task.toml: version: is missing"]
        );
        let nothing = tree(&[("task.toml", "name = \"x\"\nversion = \"1\"\n", false)]);
        refused(&nothing, "task.toml: run: give either \"launch\" or \"exec\"");
        let odd_name = tree(&[
            ("task.toml", "[run]\nexec = [\"true\"]\n", false),
            ("package.xml", &XML.replace(">talker<", ">My_Talker<"), false),
            ("setup.py", "", false),
        ]);
        refused(&odd_name, "package.xml: <name>: \"My_Talker\" is not a valid package name");
    }

    #[test]
    fn unbuildable_package_is_refused() {
        let with = |task: &str, files: &[Entry<'_>]| {
            let dir = tree(files);
            fs::write(dir.path().join("task.toml"), task).unwrap();
            dir
        };
        let head = "name = \"x\"\nversion = \"1\"\n";
        let colcon = format!("{head}[build]\ntool = \"colcon\"\n[run]\nexec = [\"true\"]\n");
        refused(&with(&colcon, &[]), "task.toml: build.tool: colcon needs a package.xml");
        refused(
            &with(LAUNCH, &[("package.xml", XML, false), ("talker.launch.py", "", false)]),
            "setup.py: is missing; colcon needs it",
        );
        refused(
            &with(&format!("{head}{LAUNCH}"), &[]),
            "task.toml: run.launch: needs a package.xml to build \"talker\" from",
        );
        let mail = XML.replace("a@example.org", "a@localhost");
        refused(
            &with(
                LAUNCH,
                &[
                    ("package.xml", &mail, false),
                    ("setup.py", "", false),
                    ("talker.launch.py", "", false),
                ],
            ),
            "package.xml: <maintainer>: \"a@localhost\" is not a valid e-mail address; colcon would silently ignore",
        );
        let no_type = XML.replace("<build_type>ament_python</build_type>", "");
        refused(
            &with(
                &format!("{head}[run]\nexec = [\"true\"]\n"),
                &[("package.xml", &no_type, false)],
            ),
            "package.xml: export.build_type: is missing; set build.tool in task.toml",
        );
        let other = "[run]\nlaunch = [\"nav2\", \"x.launch.py\"]\n";
        refused(
            &with(other, &[("package.xml", XML, false), ("setup.py", "", false)]),
            "run.launch: \"nav2\" is neither in this directory nor an exec_depend",
        );
        let missing = "[run]\nlaunch = [\"talker\", \"other.launch.py\"]\n";
        refused(
            &with(missing, &[("package.xml", XML, false), ("setup.py", "", false)]),
            "\"other.launch.py\" is not in the package",
        );
    }

    #[test]
    fn package_command_must_exist_and_be_executable() {
        let with = |command: &str| {
            let dir = plain();
            fs::write(dir.path().join("task.toml"), TASK.replace("./run.sh", command)).unwrap();
            dir
        };
        refused(&with("./gone.sh"), "task.toml: run.exec: \"./gone.sh\" is not in this directory");
        refused(&with("data/a.txt"), "task.toml: run.exec: \"data/a.txt\" is not executable");
        refused(&with("./data"), "task.toml: run.exec: \"./data\" is not a file");
        for good in ["python3", "/usr/bin/env", "run.sh", "data/../run.sh"] {
            assert!(pack(with(good).path()).is_ok(), "{good}");
        }
        let dir = talker();
        for (command, reason) in [
            ("install/other/lib/other/x", "has no package \"other\""),
            ("lib/x", "must start with src/ or install/"),
            ("src/gone", "is not in this directory"),
        ] {
            fs::write(dir.path().join("task.toml"), format!("[run]\nexec = [\"{command}\"]\n"))
                .unwrap();
            refused(&dir, reason);
        }
        fs::write(
            dir.path().join("task.toml"),
            "[run]\nexec = [\"install/talker/lib/talker/talker\"]\n",
        )
        .unwrap();
        assert!(pack(dir.path()).is_ok());
    }

    #[test]
    fn install_trees_are_packed_unless_they_are_links() {
        let task = format!("name = \"talker\"\nversion = \"1\"\n{LAUNCH}");
        let launch = "install/talker/share/talker/launch/talker.launch.py";
        assert!(pack(tree(&[("task.toml", &task, false), (launch, "", false)]).path()).is_ok());
        let at_top = launch.strip_prefix("install/").unwrap();
        assert!(pack(tree(&[("task.toml", &task, false), (at_top, "", false)]).path()).is_ok());
        let other = "install/talker/share/talker/package.xml";
        refused(
            &tree(&[("task.toml", &task, false), (other, "", false)]),
            "\"talker.launch.py\" is not in the install tree under share/talker",
        );
        let linked = tree(&[("task.toml", &task, false), (launch, "", false)]);
        symlink("/ws/build/talker/x.py", linked.path().join("install/talker/x.py")).unwrap();
        refused(
            &linked,
            "install/talker/x.py: is a link to \"/ws/build/talker/x.py\": the tree was built with --symlink-install",
        );
        let egg = "install/talker/lib/python3/site-packages/talker.egg-link";
        refused(
            &tree(&[("task.toml", &task, false), (launch, "", false), (egg, "/ws", false)]),
            "built with --symlink-install",
        );
    }

    #[test]
    fn special_files_are_refused_by_name() {
        let dir = plain();
        nix::unistd::mkfifo(&dir.path().join("pipe"), nix::sys::stat::Mode::S_IRWXU).unwrap();
        refused(&dir, "pipe: is a FIFO; only files");
        let dir = plain();
        let _listener = std::os::unix::net::UnixListener::bind(dir.path().join("sock")).unwrap();
        refused(&dir, "sock: is a socket; only files");
        let dir = plain();
        symlink("/etc/passwd", dir.path().join("escape")).unwrap();
        refused(&dir, "escape: is a link to \"/etc/passwd\", outside the package directory");
        let dir = plain();
        fs::remove_file(dir.path().join("task.toml")).unwrap();
        nix::unistd::mkfifo(&dir.path().join("task.toml"), nix::sys::stat::Mode::S_IRWXU).unwrap();
        assert!(problems(&dir).contains(&"task.toml: is not a regular file".to_owned()));
        std::fs::remove_file(dir.path().join("task.toml")).expect("removed");
        std::fs::write(dir.path().join("task.toml"), "#".repeat((1 << 20) + 1)).expect("written");
        assert!(problems(&dir).contains(&"task.toml: is larger than 1048576 bytes".to_owned()));
    }

    #[test]
    fn compression_bomb_is_refused_before_upload() {
        let dir = plain();
        fs::File::create(dir.path().join("zeros"))
            .unwrap()
            .set_len(CONTENT_RATIO_FREE_BYTES + 1)
            .unwrap();
        refused(&dir, "compresses more than 200 times");
    }

    /// A random tree: path → (content, executable), directories implied.
    fn files() -> impl Strategy<Value = Vec<(String, Vec<u8>, bool)>> {
        let name = prop::sample::select(vec!["a", "b", "a-b", "a.b", "ä", "Z", "0"]);
        let path = prop::collection::vec(name, 1..4)
            .prop_map(|parts| format!("tree/{}/file", parts.join("/")));
        let content = prop::collection::vec(any::<u8>(), 0..600);
        prop::collection::btree_map(path, (content, any::<bool>()), 0..12).prop_map(|files| {
            files
                .into_iter()
                .map(|(path, (content, executable))| (path, content, executable))
                .collect()
        })
    }

    fn write_tree<'a>(
        files: impl Iterator<Item = &'a (String, Vec<u8>, bool)>,
        group_bits: u32,
        mtime_s: i64,
    ) -> (TempDir, PathBuf) {
        let dir = tempfile::tempdir().unwrap();
        let root = dir.path().join(format!("package-{mtime_s}"));
        for (path, content, executable) in files {
            let path = root.join(path);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(&path, content).unwrap();
            let mode = 0o600 | group_bits | if *executable { 0o100 } else { 0 };
            fs::set_permissions(&path, Permissions::from_mode(mode)).unwrap();
            let time =
                std::time::UNIX_EPOCH + std::time::Duration::from_secs(mtime_s.unsigned_abs());
            fs::File::options().write(true).open(&path).unwrap().set_modified(time).unwrap();
        }
        fs::create_dir_all(&root).unwrap();
        fs::write(root.join("task.toml"), TASK.replace("./run.sh", "true")).unwrap();
        (dir, root)
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        #[test]
        fn same_tree_has_the_same_digest(files in files(), now in 1_000i64..2_000_000_000) {
            let (_one, first) = write_tree(files.iter(), 0o044, 5);
            let (_other, second) = write_tree(files.iter().rev(), 0, now);
            let (first, second) = (pack(&first).unwrap(), pack(&second).unwrap());
            prop_assert_eq!(&first.package, &second.package);
            prop_assert_eq!(&first.config_bytes, &second.config_bytes);
            let names = names(&first);
            prop_assert!(names.is_sorted());
            prop_assert!(files.iter().all(|(path, ..)| names.contains(path)));
        }

        #[test]
        fn another_tree_has_another_digest(files in files(), change in 0usize..12) {
            prop_assume!(!files.is_empty());
            let mut changed = files.clone();
            let at = change % changed.len();
            changed[at].1.push(0);
            let (_one, first) = write_tree(files.iter(), 0, 5);
            let (_other, second) = write_tree(changed.iter(), 0, 5);
            prop_assert_ne!(pack(&first).unwrap().package.manifest, pack(&second).unwrap().package.manifest);
        }
    }
}
