//! One digest for each tree of a version, unpacked and built. The digests are stored beside the
//! version's directory, where only the agent writes, and compared before each start, so that only
//! the content of the signed package runs. A digest covers the names, kinds, contents, link targets
//! and execute bits of all entries, not their owners and times.

use std::ffi::OsString;
use std::fs::{self, File};
use std::io::{self, Read as _};
use std::os::unix::ffi::OsStrExt as _;
use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;

use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};
use task_proto::Digest;

use crate::system::durable;
use crate::system::layout::VersionDir;
use crate::system::task_user;
use crate::system::untrusted_file;

/// Largest seal file that is read.
const MAX_BYTES: u64 = 64 * 1024;
/// Deepest tree that is read.
const MAX_DEPTH: usize = task_user::MAX_DEPTH;

/// The digests of a version's trees.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Seal {
    /// Digest of the unpacked package.
    src: Digest,
    /// Digest of the built tree; absent if the version has none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    install: Option<Digest>,
}

/// The tree that does not match its seal.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SealMismatch {
    Source,
    Install,
}

impl Seal {
    /// Computes the seal of the trees on the disk.
    pub fn of(version: &VersionDir) -> io::Result<Self> {
        let install = match tree(&version.install()) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => None,
            digest => Some(digest?),
        };
        Ok(Self { src: tree(&version.src())?, install })
    }

    /// Reads the seal stored at `path`. An unreadable seal matches no tree.
    pub fn read(path: &Path) -> io::Result<Option<Result<Self, serde_json::Error>>> {
        match untrusted_file::read(path, MAX_BYTES) {
            Ok(bytes) => Ok(Some(serde_json::from_slice(&bytes))),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// Stores the seal at `path`.
    pub fn write(&self, path: &Path) -> io::Result<()> {
        durable::write(path, &serde_json::to_vec(self)?, 0o600)
    }

    /// The first tree of `version` that does not match this seal.
    pub fn mismatch(&self, version: &VersionDir) -> io::Result<Option<SealMismatch>> {
        let now = match Self::of(version) {
            // The package is missing, or contains an entry that no package contains.
            Err(error)
                if matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::InvalidData) =>
            {
                return Ok(Some(SealMismatch::Source));
            }
            now => now?,
        };
        Ok(match (now.src == self.src, now.install == self.install) {
            (true, true) => None,
            (false, _) => Some(SealMismatch::Source),
            (true, false) => Some(SealMismatch::Install),
        })
    }
}

impl std::fmt::Display for SealMismatch {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Source => "src was changed after unpacking",
            Self::Install => "install was changed after the build",
        })
    }
}

/// The digest of the tree at `root`.
fn tree(root: &Path) -> io::Result<Digest> {
    if !fs::symlink_metadata(root)?.is_dir() {
        return Err(io::Error::new(io::ErrorKind::InvalidData, "not a directory"));
    }
    let mut hasher = Sha256::new();
    add_directory(&mut hasher, root, 0)?;
    Ok(Digest::from_sha256(hasher.finalize().into()))
}

/// Hashes the kind, name and content of each entry. All fields have a known length or a terminator,
/// so that two different trees never give the same bytes.
fn add_directory(hasher: &mut Sha256, dir: &Path, depth: usize) -> io::Result<()> {
    if depth > MAX_DEPTH {
        return Err(io::Error::new(
            io::ErrorKind::InvalidData,
            format!("it is more than {MAX_DEPTH} levels deep"),
        ));
    }
    let names = fs::read_dir(dir)?.map(|entry| Ok(entry?.file_name()));
    let mut names = names.collect::<io::Result<Vec<OsString>>>()?;
    names.sort();
    for name in names {
        let path = dir.join(&name);
        let about = fs::symlink_metadata(&path)?;
        if about.is_dir() {
            add_text(hasher, b'd', name.as_bytes());
            add_directory(hasher, &path, depth + 1)?;
            hasher.update(b"u");
        } else if about.is_symlink() {
            add_text(hasher, b'l', name.as_bytes());
            add_text(hasher, b't', fs::read_link(&path)?.as_os_str().as_bytes());
        } else {
            let is_executable = about.permissions().mode() & 0o100 != 0;
            add_text(hasher, if is_executable { b'x' } else { b'f' }, name.as_bytes());
            add_content(hasher, untrusted_file::open(&path)?)?;
        }
    }
    Ok(())
}

fn add_text(hasher: &mut Sha256, kind: u8, text: &[u8]) {
    hasher.update([kind]);
    hasher.update((text.len() as u64).to_le_bytes());
    hasher.update(text);
}

fn add_content(hasher: &mut Sha256, mut file: File) -> io::Result<()> {
    let mut size = 0_u64;
    let mut buffer = vec![0; 128 * 1024];
    loop {
        match file.read(&mut buffer)? {
            // The size comes last: a file that grows while being read can't pass as another file
            // with a known end.
            0 => {
                hasher.update(size.to_le_bytes());
                return Ok(());
            }
            count => {
                hasher.update(&buffer[..count]);
                size += count as u64;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use super::*;
    use crate::system::layout::DataDir;

    fn version(root: &Path) -> VersionDir {
        let version =
            DataDir::new(root).expect("a directory").task(&"talker".parse().expect("valid"));
        let version = version.version(&Digest::of(b"manifest"));
        fs::create_dir_all(version.src().join("bin")).expect("made");
        fs::create_dir_all(version.install().join("lib")).expect("made");
        fs::write(version.src().join("bin/run"), "echo one").expect("written");
        fs::write(version.install().join("lib/node.py"), "print()").expect("written");
        symlink("bin/run", version.src().join("run")).expect("linked");
        version
    }

    #[test]
    fn every_change_to_a_tree_breaks_its_seal() {
        let temp = tempfile::tempdir().expect("a directory");
        type Change = fn(&VersionDir) -> io::Result<()>;
        let changes: [(SealMismatch, Change); 9] = [
            (SealMismatch::Source, |v| fs::write(v.src().join("bin/run"), "echo two")),
            (SealMismatch::Source, |v| fs::write(v.src().join("more"), "")),
            (SealMismatch::Source, |v| fs::remove_file(v.src().join("run"))),
            (SealMismatch::Source, |v| {
                fs::rename(v.src().join("bin/run"), v.src().join("bin/walk"))
            }),
            (SealMismatch::Source, |v| fs::create_dir(v.src().join("empty"))),
            (SealMismatch::Source, |v| fs::remove_dir_all(v.src())),
            (SealMismatch::Source, |v| {
                fs::set_permissions(v.src().join("bin/run"), fs::Permissions::from_mode(0o755))
            }),
            (SealMismatch::Source, |v| {
                fs::remove_file(v.src().join("run"))?;
                symlink("/bin/sh", v.src().join("run"))
            }),
            (SealMismatch::Install, |v| fs::write(v.install().join("lib/node.py"), "print(1)")),
        ];
        for (number, (expected, change)) in changes.into_iter().enumerate() {
            let version = version(&temp.path().join(number.to_string()));
            let note = version.root().join("seal");
            Seal::of(&version).expect("sealed").write(&note).expect("written");
            let seal = Seal::read(&note).expect("read").expect("there").expect("understood");
            assert_eq!(seal.mismatch(&version).expect("compared"), None);
            change(&version).expect("changed");
            assert_eq!(
                seal.mismatch(&version).expect("compared"),
                Some(expected),
                "change {number}"
            );
        }
    }

    #[test]
    fn name_that_looks_like_content_changes_the_digest() {
        let temp = tempfile::tempdir().expect("a directory");
        let [one, two] = ["one", "two"].map(|name| temp.path().join(name));
        for dir in [&one, &two] {
            fs::create_dir(dir).expect("made");
        }
        fs::write(one.join("a"), "b").expect("written");
        fs::write(two.join("ab"), "").expect("written");
        assert_ne!(tree(&one).expect("read"), tree(&two).expect("read"));
    }

    #[test]
    fn pipe_in_a_tree_breaks_its_seal_without_blocking() {
        let temp = tempfile::tempdir().expect("a directory");
        let version = version(temp.path());
        let seal = Seal::of(&version).expect("sealed");
        nix::unistd::mkfifo(&version.src().join("pipe"), nix::sys::stat::Mode::S_IRWXU)
            .expect("a pipe");
        assert_eq!(seal.mismatch(&version).expect("compared"), Some(SealMismatch::Source));
    }
}
