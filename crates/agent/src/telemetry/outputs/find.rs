//! Finds the files that match `outputs.paths`: regular files below one directory. Links are neither
//! followed nor uploaded, because a task could point them at files that belong to others. Pipes,
//! sockets and devices are not opened or uploaded.

use std::collections::BTreeMap;
use std::io::{self, Read as _};
use std::path::Path;

use sha2::{Digest as _, Sha256};
use task_proto::Digest;
use task_proto::desired::BlobRef;
use task_proto::ids::OutputPath;
use task_proto::packages::output::{MAX_FILES, OutputFile};

use super::{OutputError, too_many_files};
use crate::system::untrusted_file::{Directory, Entry};

/// Most names examined for one pattern.
const MAX_EXAMINED_NAMES: usize = 200_000;
/// Deepest directory that is searched.
const MAX_DEPTH: usize = 48;

/// The matching files, sorted by path, with their digests.
pub(super) fn files(
    directory: &Path,
    patterns: &[String],
    max_bytes: u64,
) -> Result<Vec<OutputFile>, OutputError> {
    let mut found = BTreeMap::new();
    let patterns = patterns.iter().map(|pattern| parts(pattern)).collect::<Result<Vec<_>, _>>()?;
    let unreadable = |below: &str| {
        let path = directory.join(below);
        move |source| OutputError::Read { path, source }
    };
    let root = match Directory::open(directory) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
        opened => opened.map_err(unreadable(""))?,
    };
    for parts in patterns {
        let mut search =
            Search { found: &mut found, left: MAX_EXAMINED_NAMES, unreadable: &unreadable };
        search.descend(&root, "", &parts, 0)?;
    }
    let bytes: u64 = found.values().sum();
    if bytes > max_bytes {
        return Err(OutputError::TooMuch(format!(
            "the files have {bytes} bytes; the limit is {max_bytes} (limits.output_bytes of this robot)"
        )));
    }
    let hashed = found.into_iter().map(|(path, size)| {
        let blob =
            hash(&root, Path::new(path.as_str()), size).map_err(unreadable(path.as_str()))?;
        Ok(OutputFile { path, blob })
    });
    hashed.collect()
}

/// Splits a pattern at its slashes.
fn parts(pattern: &str) -> Result<Vec<glob::Pattern>, OutputError> {
    let invalid = |reason| OutputError::Pattern { pattern: pattern.to_owned(), reason };
    let parts = pattern.split('/').filter(|part| !part.is_empty() && *part != ".");
    parts
        .map(|part| match part {
            ".." => Err(invalid("it must stay below the task's directory")),
            part => glob::Pattern::new(part).map_err(|error| invalid(error.msg)),
        })
        .collect()
}

struct Search<'a, F> {
    found: &'a mut BTreeMap<OutputPath, u64>,
    left: usize,
    /// Builds an error for a path below the root.
    unreadable: &'a F,
}

impl<F, E> Search<'_, F>
where
    F: Fn(&str) -> E,
    E: FnOnce(io::Error) -> OutputError,
{
    /// Searches for `parts` in `directory`, whose path below the root is `prefix`.
    fn descend(
        &mut self,
        directory: &Directory,
        prefix: &str,
        parts: &[glob::Pattern],
        depth: usize,
    ) -> Result<(), OutputError> {
        let Some((part, rest)) = parts.split_first() else { return Ok(()) };
        let is_any_depth = part.as_str() == "**";
        if is_any_depth {
            // `**` also matches no directory at all.
            self.descend(directory, prefix, rest, depth)?;
        }
        let unreadable = self.unreadable;
        for name in directory.names().map_err(unreadable(prefix))? {
            let name = name.map_err(unreadable(prefix))?;
            self.left = self.left.checked_sub(1).ok_or_else(|| {
                OutputError::TooMuch(format!(
                    "the search would examine more than {MAX_EXAMINED_NAMES} names"
                ))
            })?;
            // A name that is not printable text can't appear in a manifest either.
            let Ok(name) = name.into_string() else { continue };
            if !is_any_depth && !part.matches(&name) {
                continue;
            }
            let below = if prefix.is_empty() { name.clone() } else { format!("{prefix}/{name}") };
            match directory.entry(&name).map_err(unreadable(&below))? {
                Some(Entry::Directory(inner)) if depth < MAX_DEPTH => {
                    let rest = if is_any_depth { parts } else { rest };
                    self.descend(&inner, &below, rest, depth + 1)?;
                }
                Some(Entry::File(size)) if rest.is_empty() => self.add(&below, size)?,
                _ => {}
            }
        }
        Ok(())
    }

    fn add(&mut self, below: &str, size: u64) -> Result<(), OutputError> {
        let Ok(name) = below.parse::<OutputPath>() else { return Ok(()) };
        self.found.insert(name, size);
        if self.found.len() > MAX_FILES { Err(too_many_files()) } else { Ok(()) }
    }
}

/// Hashes a file up to the size that was found, because a process may keep appending to it.
pub(super) fn hash(root: &Directory, path: &Path, found: u64) -> io::Result<BlobRef> {
    let mut file = root.file(path)?.take(found);
    let mut hash = Sha256::new();
    let mut size = 0;
    let mut buffer = vec![0; 256 * 1024];
    loop {
        match file.read(&mut buffer)? {
            0 => return Ok(BlobRef { digest: Digest::from_sha256(hash.finalize().into()), size }),
            count => {
                hash.update(&buffer[..count]);
                size += count as u64;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    fn names(directory: &Path, patterns: &[&str]) -> Vec<String> {
        let patterns: Vec<String> = patterns.iter().map(|pattern| (*pattern).to_owned()).collect();
        let files = files(directory, &patterns, 1 << 20).expect("found");
        files.into_iter().map(|file| file.path.to_string()).collect()
    }

    #[test]
    fn patterns_name_regular_files_below_the_directory() {
        let temp = tempfile::tempdir().expect("temp dir");
        let root = temp.path().join("task");
        fs::create_dir_all(root.join("maps/old")).expect("made");
        for name in ["maps/a.pgm", "maps/a.yaml", "maps/b.pgm", "maps/old/c.pgm", "log.txt"] {
            fs::write(root.join(name), name).expect("written");
        }
        fs::write(temp.path().join("secret.pgm"), "secret").expect("written");
        std::os::unix::fs::symlink("../../secret.pgm", root.join("maps/link.pgm")).expect("linked");
        std::os::unix::fs::symlink("..", root.join("up")).expect("linked");
        std::os::unix::fs::symlink("/dev/zero", root.join("maps/zero.pgm")).expect("linked");
        nix::unistd::mkfifo(&root.join("maps/pipe.pgm"), nix::sys::stat::Mode::S_IRWXU)
            .expect("a pipe");

        assert_eq!(
            names(&root, &["maps/*.pgm", "maps/a.*"]),
            ["maps/a.pgm", "maps/a.yaml", "maps/b.pgm"]
        );
        assert_eq!(names(&root, &["**/*.pgm"]), ["maps/a.pgm", "maps/b.pgm", "maps/old/c.pgm"]);
        assert_eq!(
            names(&root, &["maps/**"]),
            ["maps/a.pgm", "maps/a.yaml", "maps/b.pgm", "maps/old/c.pgm"]
        );
        assert_eq!(names(&root, &["./log.txt", "nothing/*", "maps", "up/*.pgm"]), ["log.txt"]);
        let blob = files(&root, &["log.txt".to_owned()], 100).expect("found")[0].blob;
        assert_eq!(blob, BlobRef { digest: Digest::of(b"log.txt"), size: 7 });
        let dir = Directory::open(&root).expect("opened");
        assert_eq!(
            hash(&dir, Path::new("log.txt"), 3).expect("read"),
            BlobRef { digest: Digest::of(b"log"), size: 3 }
        );
        assert!(matches!(
            files(&root, &["../*".to_owned()], 100),
            Err(OutputError::Pattern { .. })
        ));
        assert!(matches!(files(&root, &["maps/*".to_owned()], 20), Err(OutputError::TooMuch(_))));
    }
}
