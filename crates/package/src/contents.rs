//! Lists the contents of a package, and the differences between two packages. An archive is read as
//! a stream and never unpacked. Any user with push rights can have pushed any bytes, so the archive
//! must satisfy all rules of a robot except those about the targets of links.

use std::cmp::Ordering;
use std::collections::BTreeMap;
use std::io::Read;

use sha2::{Digest as _, Sha256};
use task_archive::{Entries, Entry, Kind, Limits, Refusal, UnpackError};
use task_proto::Digest;
use task_proto::api::{ChangedFile, PackageDiff, PackageFile, PackageFileKind};
use task_proto::packages::manifest::{ContentFacts, TaskManifest};

/// Limit of all paths and link targets together, which are held in memory.
const MAX_NAMES_BYTES: u64 = 16 << 20;

/// The entries of `content`, sorted by path. Blocks, and reads the whole archive.
pub fn list(
    content: impl Read,
    content_size: u64,
    facts: &ContentFacts,
) -> Result<Vec<PackageFile>, UnpackError> {
    let mut entries = Entries::announced(content, content_size, facts, &Limits::default())?;
    let mut files: BTreeMap<String, PackageFile> = BTreeMap::new();
    let mut names_bytes = 0;
    while let Some(Entry { path, kind }) = entries.next()? {
        if path.is_empty() {
            continue;
        }
        let mut file = listed_file(&path, &kind, &files)?;
        if let Kind::File { .. } = kind {
            let mut hasher = Sha256::new();
            entries.content(|bytes| {
                hasher.update(bytes);
                Ok(())
            })?;
            file.digest = Some(Digest::from_sha256(hasher.finalize().into()));
        }
        names_bytes += (path.len() + file.target.as_ref().map_or(0, String::len)) as u64;
        if names_bytes > MAX_NAMES_BYTES {
            return Err(Refusal::Limit {
                what: "bytes of names",
                found: names_bytes,
                limit: MAX_NAMES_BYTES,
            }
            .into());
        }
        if files.contains_key(&path) {
            return Err(Refusal::entry(path.as_bytes(), "duplicate name").into());
        }
        files.insert(path, file);
    }
    Ok(files.into_values().collect())
}

/// An entry; a file's digest is added later. A second name of a file is shown as that file.
fn listed_file(
    path: &str,
    kind: &Kind,
    files: &BTreeMap<String, PackageFile>,
) -> Result<PackageFile, Refusal> {
    let entry = |kind, mode, size, target| PackageFile {
        path: path.to_owned(),
        kind,
        mode,
        size,
        digest: None,
        target,
    };
    match kind {
        Kind::Directory => Ok(entry(PackageFileKind::Directory, 0o755, 0, None)),
        Kind::File { size, executable } => {
            Ok(entry(PackageFileKind::File, if *executable { 0o755 } else { 0o644 }, *size, None))
        }
        Kind::Symlink { target } => {
            Ok(entry(PackageFileKind::Link, 0o777, 0, Some(target.clone())))
        }
        Kind::HardLink { target } => {
            match files.get(target).filter(|file| file.kind == PackageFileKind::File) {
                Some(file) => Ok(PackageFile { path: path.to_owned(), ..file.clone() }),
                None => Err(Refusal::entry(
                    path.as_bytes(),
                    "a hard link must name an earlier file of the archive",
                )),
            }
        }
    }
}

/// Differences between two lists of entries, both sorted by path.
pub fn diff(from: Vec<PackageFile>, to: Vec<PackageFile>) -> PackageDiff {
    let mut diff = PackageDiff::default();
    let (mut from, mut to) = (from.into_iter().peekable(), to.into_iter().peekable());
    loop {
        let order = match (from.peek(), to.peek()) {
            (Some(from), Some(to)) => from.path.cmp(&to.path),
            (Some(_), None) => Ordering::Less,
            (None, Some(_)) => Ordering::Greater,
            (None, None) => return diff,
        };
        match order {
            Ordering::Less => diff.removed.extend(from.next()),
            Ordering::Greater => diff.added.extend(to.next()),
            Ordering::Equal => {
                let changed = from.next().zip(to.next()).filter(|(from, to)| from != to);
                diff.changed.extend(changed.map(|(from, to)| ChangedFile {
                    path: to.path.clone(),
                    from,
                    to,
                }));
            }
        }
    }
}

/// Whether two manifests are equal apart from the version and the description of the files.
pub fn is_same_except_version(one: &TaskManifest, other: &TaskManifest) -> bool {
    let TaskManifest { version, content, .. } = one.clone();
    *one == TaskManifest { version, content, ..other.clone() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Packed, pack};

    fn packed(files: &[(&str, &str)]) -> Packed {
        let dir = tempfile::tempdir().unwrap();
        let task = "name = \"plain\"\nversion = \"1.0.0\"\n[run]\nexec = [\"true\"]\n";
        for (path, content) in [("task.toml", task)].iter().chain(files) {
            let path = dir.path().join(path);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(&path, content).unwrap();
        }
        std::os::unix::fs::symlink("data/a.txt", dir.path().join("link")).unwrap();
        pack(dir.path()).unwrap()
    }

    fn listed(packed: &Packed) -> Vec<PackageFile> {
        let content = std::fs::File::open(packed.content.path()).unwrap();
        list(content, packed.package.content.size, &packed.manifest.content).unwrap()
    }

    #[test]
    fn package_contents_are_listed_and_compared() {
        let old = listed(&packed(&[("data/a.txt", "a"), ("data/b.txt", "b"), ("gone.txt", "")]));
        let paths: Vec<&str> = old.iter().map(|file| file.path.as_str()).collect();
        assert_eq!(paths, ["data", "data/a.txt", "data/b.txt", "gone.txt", "link", "task.toml"]);
        assert_eq!((old[1].size, old[1].mode, old[1].digest), (1, 0o644, Some(Digest::of(b"a"))));
        assert_eq!((old[0].kind, old[0].digest), (PackageFileKind::Directory, None));
        assert_eq!(
            (old[4].kind, old[4].target.as_deref()),
            (PackageFileKind::Link, Some("data/a.txt"))
        );
        let new = listed(&packed(&[("data/a.txt", "a"), ("data/b.txt", "bb"), ("new.txt", "")]));
        let diff = diff(old, new);
        let paths =
            |files: &[PackageFile]| files.iter().map(|file| file.path.clone()).collect::<Vec<_>>();
        assert_eq!(
            (paths(&diff.added), paths(&diff.removed)),
            (vec!["new.txt".to_owned()], vec!["gone.txt".to_owned()])
        );
        assert_eq!(diff.changed.len(), 1);
        assert_eq!((diff.changed[0].from.size, diff.changed[0].to.size), (1, 2));
    }

    #[test]
    fn contents_list_of_foreign_bytes_is_refused() {
        let packed = packed(&[("data/a.txt", "a")]);
        let content = std::fs::read(packed.content.path()).unwrap();
        let facts = ContentFacts { entries: 2, ..packed.manifest.content };
        for (content, facts) in
            [(&content[..], facts), (&content[..50], packed.manifest.content), (b"x", facts)]
        {
            let refused = list(content, content.len() as u64, &facts);
            assert!(matches!(refused, Err(UnpackError::Refused(_))), "{refused:?}");
        }
    }
}
