//! A package's files: walks the directory, leaves out ignored files, and refuses files that must
//! not be distributed. The walk follows no link and opens no file but `.taskdignore`.

use std::collections::BTreeMap;
use std::fs::{self, Metadata};
use std::os::unix::fs::{FileTypeExt as _, PermissionsExt as _};
use std::path::{Path, PathBuf};

use task_proto::packages::manifest::{
    MAX_CONTENT_DEPTH, MAX_CONTENT_ENTRIES, MAX_CONTENT_PATH_BYTES, MAX_CONTENT_TAR_BYTES,
};

use super::{PackageError, Problem};

/// The file of patterns that are left out.
const IGNORE_FILE: &str = ".taskdignore";
/// Names that are never packed, at any depth.
const NEVER_PACKED: [&str; 3] = [".git", "__pycache__", IGNORE_FILE];

/// A package's files by path, which is relative, with `/`. A map sorts paths bytewise, so a
/// directory precedes its contents.
#[derive(Debug)]
pub(super) struct Tree {
    pub(super) root: PathBuf,
    pub(super) entries: BTreeMap<String, Entry>,
}

/// A file, a directory or a link.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Entry {
    Directory,
    File { size: u64, executable: bool },
    Link { target: String },
}

impl Tree {
    /// Walks `root`. With `built_on_robot` a build's products at the top are left out: the robot
    /// makes its own.
    pub(super) fn walk(
        root: &Path,
        built_on_robot: bool,
        problems: &mut Vec<Problem>,
    ) -> Result<Self, PackageError> {
        let patterns = read_patterns(root, problems)?;
        let mut walk =
            TreeWalk { patterns, built_on_robot, bytes: 0, entries: BTreeMap::new(), problems };
        let mut pending = vec![String::new()];
        while let Some(directory) = pending.pop() {
            walk.directory(root, &directory, &mut pending)?;
            if walk.entries.len() as u64 > MAX_CONTENT_ENTRIES {
                walk.refuse(".", format!("has more than {MAX_CONTENT_ENTRIES} files"));
                break;
            }
        }
        if walk.bytes > MAX_CONTENT_TAR_BYTES {
            walk.refuse(".", format!("has more than {MAX_CONTENT_TAR_BYTES} bytes"));
        }
        Ok(Self { root: root.to_owned(), entries: walk.entries })
    }

    /// The entry at `path`; links in the last part are followed as long as they stay in the tree.
    pub(super) fn resolve(&self, path: &str) -> Option<&Entry> {
        const MAX_LINKS: usize = 16;
        let mut path = normalized(path)?;
        for _ in 0..MAX_LINKS {
            match self.entries.get(&path)? {
                Entry::Link { target } => {
                    let parent = path.rsplit_once('/').map_or("", |(parent, _)| parent);
                    path = normalized(&format!("{parent}/{target}"))?;
                }
                entry => return Some(entry),
            }
        }
        None
    }
}

struct TreeWalk<'p> {
    patterns: Vec<Pattern>,
    built_on_robot: bool,
    bytes: u64,
    entries: BTreeMap<String, Entry>,
    problems: &'p mut Vec<Problem>,
}

impl TreeWalk<'_> {
    fn directory(
        &mut self,
        root: &Path,
        directory: &str,
        pending: &mut Vec<String>,
    ) -> Result<(), PackageError> {
        let shown = root.join(directory);
        let unreadable =
            |source| PackageError::Io { what: format!("can't read {}", shown.display()), source };
        for item in fs::read_dir(&shown).map_err(unreadable)? {
            let item = item.map_err(unreadable)?;
            let name = item.file_name();
            let prefix = if directory.is_empty() { String::new() } else { format!("{directory}/") };
            let Some(name) = name.to_str().filter(|name| !name.chars().any(char::is_control))
            else {
                self.refuse(
                    &format!("{prefix}{}", name.display()),
                    "the name is not printable UTF-8".to_owned(),
                );
                continue;
            };
            let path = format!("{prefix}{name}");
            let metadata = item.metadata().map_err(unreadable)?;
            if self.is_excluded(&item.path(), &path, name, metadata.is_dir()) {
                continue;
            }
            if path.len() > MAX_CONTENT_PATH_BYTES || path.split('/').count() > MAX_CONTENT_DEPTH {
                self.refuse(
                    &path,
                    format!("the path is longer than {MAX_CONTENT_PATH_BYTES} bytes or deeper than {MAX_CONTENT_DEPTH} directories"),
                );
                continue;
            }
            if let Some(entry) = self.entry(&item.path(), &path, &metadata)? {
                if entry == Entry::Directory {
                    pending.push(path.clone());
                }
                self.entries.insert(path, entry);
            }
        }
        Ok(())
    }

    fn entry(
        &mut self,
        full: &Path,
        path: &str,
        metadata: &Metadata,
    ) -> Result<Option<Entry>, PackageError> {
        let kind = metadata.file_type();
        if kind.is_dir() {
            return Ok(Some(Entry::Directory));
        }
        if kind.is_file() {
            self.bytes = self.bytes.saturating_add(metadata.len());
            // The owner's bit alone: the other bits depend on the umask of the
            // checkout.
            let executable = metadata.permissions().mode() & 0o100 != 0;
            return Ok(Some(Entry::File { size: metadata.len(), executable }));
        }
        if kind.is_symlink() {
            let target = fs::read_link(full).map_err(|source| PackageError::Io {
                what: format!("can't read the link {}", full.display()),
                source,
            })?;
            return Ok(self.link(path, &target));
        }
        let what = if kind.is_fifo() {
            "a FIFO"
        } else if kind.is_socket() {
            "a socket"
        } else {
            "a device"
        };
        self.refuse(path, format!("is {what}; only files, directories and links can be packed"));
        Ok(None)
    }

    fn link(&mut self, path: &str, target: &Path) -> Option<Entry> {
        let Some(text) =
            target.to_str().filter(|text| !text.is_empty() && !text.chars().any(char::is_control))
        else {
            self.refuse(path, "the link's target is not printable UTF-8".to_owned());
            return None;
        };
        if let Some(reason) = link_refusal(path, text) {
            self.refuse(path, reason);
            return None;
        }
        Some(Entry::Link { target: text.to_owned() })
    }

    fn is_excluded(&self, full: &Path, path: &str, name: &str, is_directory: bool) -> bool {
        // Beside an install tree that is the package, only files that colcon itself marks as its
        // own are excluded.
        let is_product = || match path {
            "install" => self.built_on_robot,
            "build" | "log" => self.built_on_robot || full.join("COLCON_IGNORE").exists(),
            _ => false,
        };
        NEVER_PACKED.contains(&name)
            || (is_directory && is_product())
            || self.patterns.iter().any(|pattern| pattern.matches(path, name, is_directory))
    }

    fn refuse(&mut self, path: &str, reason: String) {
        // A tree of ten thousand bad links needs no list of them all.
        const MAX_PROBLEMS: usize = 50;
        if self.problems.len() < MAX_PROBLEMS {
            self.problems.push(Problem { file: path.to_owned(), reason });
        }
    }
}

/// Why the link at `path` to `target` can't travel, if so.
fn link_refusal(path: &str, target: &str) -> Option<String> {
    let parts: Vec<_> = target.split('/').filter(|part| !part.is_empty() && *part != ".").collect();
    let up = parts.iter().take_while(|part| **part == "..").count();
    let depth = path.matches('/').count();
    let leaves = target.starts_with('/') || up > depth;
    let out_of_install = path.starts_with("install/") && (leaves || up == depth);
    if out_of_install || (leaves && ["/build/", "/src/"].iter().any(|place| target.contains(place)))
    {
        return Some(format!(
            "is a link to {target:?}: the tree was built with --symlink-install and is incomplete without the \
             targets of its links; rebuild without --symlink-install"
        ));
    }
    if leaves {
        return Some(format!("is a link to {target:?}, outside the package directory"));
    }
    // After another link ".." would differ from the text.
    parts[up..]
        .contains(&"..")
        .then(|| format!("is a link to {target:?}; \"..\" is only allowed at the start"))
}

/// `path` without empty and `.` parts and with `..` resolved by the text; `None` if the path leaves
/// the tree.
fn normalized(path: &str) -> Option<String> {
    let mut parts = Vec::new();
    for part in path.split('/') {
        match part {
            "" | "." => {}
            ".." => drop(parts.pop()?),
            part => parts.push(part),
        }
    }
    Some(parts.join("/"))
}

/// A line of `.taskdignore`.
#[derive(Debug)]
struct Pattern {
    glob: String,
    /// The pattern has a slash, so it matches whole paths and not names.
    anchored: bool,
    only_directories: bool,
}

impl Pattern {
    fn matches(&self, path: &str, name: &str, is_directory: bool) -> bool {
        (is_directory || !self.only_directories)
            && glob_matches(
                self.glob.as_bytes(),
                if self.anchored { path } else { name }.as_bytes(),
            )
    }
}

fn read_patterns(root: &Path, problems: &mut Vec<Problem>) -> Result<Vec<Pattern>, PackageError> {
    let Some(text) = super::text_file::read_text(root, IGNORE_FILE, problems)? else {
        return Ok(Vec::new());
    };
    let mut patterns = Vec::new();
    for (number, line) in text.lines().enumerate() {
        let line = line.trim();
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        if line.starts_with('!') {
            let reason =
                format!("line {}: {line:?}: negated patterns are not supported", number + 1);
            problems.push(Problem { file: IGNORE_FILE.to_owned(), reason });
            continue;
        }
        let glob = line.trim_end_matches('/');
        patterns.push(Pattern {
            anchored: glob.contains('/'),
            only_directories: line.ends_with('/'),
            glob: glob.trim_start_matches('/').to_owned(),
        });
    }
    Ok(patterns)
}

/// Whether `glob` matches `text`: `?` is one character of a name, `*` any number of them, `**`
/// crosses directories.
fn glob_matches(glob: &[u8], text: &[u8]) -> bool {
    // The last star and its position: one step back is enough, for `*` as for `**`, so the time is
    // bounded by the product of the lengths.
    let (mut g, mut t) = (0, 0);
    let mut star: Option<(usize, usize)> = None;
    let mut double: Option<(usize, usize)> = None;
    while t < text.len() {
        if glob[g..].starts_with(b"**") {
            let after = g + 2 + usize::from(glob.get(g + 2) == Some(&b'/'));
            (double, star, g) = (Some((after, t)), None, after);
        } else if glob.get(g) == Some(&b'*') {
            (star, g) = (Some((g + 1, t)), g + 1);
        } else if g < glob.len() && (glob[g] == text[t] || (glob[g] == b'?' && text[t] != b'/')) {
            (g, t) = (g + 1, t + 1);
        } else if let Some((after, tried)) = star.filter(|(_, tried)| text[*tried] != b'/') {
            (star, g, t) = (Some((after, tried + 1)), after, tried + 1);
        } else if let Some((after, tried)) = double {
            (double, star, g, t) = (Some((after, tried + 1)), None, after, tried + 1);
        } else {
            return false;
        }
    }
    glob[g..].iter().all(|b| *b == b'*')
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn globs_know_names_and_paths() {
        for (glob, text) in [
            ("*.bag", "a.bag"),
            ("a*b*c", "axxbyyc"),
            ("a?c", "abc"),
            ("data/**", "data/x/y"),
            ("**/x.py", "a/b/x.py"),
            ("**/x.py", "x.py"),
            ("a/**/b", "a/x/y/b"),
            ("a/*/b", "a/x/b"),
            ("*", "anything"),
        ] {
            assert!(glob_matches(glob.as_bytes(), text.as_bytes()), "{glob} {text}");
        }
        for (glob, text) in [
            ("*.bag", "a.bags"),
            ("a/*/b", "a/x/y/b"),
            ("a?c", "a/c"),
            ("*", "a/b"),
            ("", "a"),
            ("a", ""),
        ] {
            assert!(!glob_matches(glob.as_bytes(), text.as_bytes()), "{glob} {text}");
        }
    }

    #[test]
    fn links_stay_in_the_tree() {
        for (path, target) in
            [("a", "b"), ("x/a", "../b"), ("x/a", "./b/c"), ("install/p/a", "../q/b")]
        {
            assert_eq!(link_refusal(path, target), None, "{path} -> {target}");
        }
        for (path, target, reason) in [
            ("a", "/etc/passwd", "outside the package"),
            ("a", "../b", "outside the package"),
            ("x/a", "../../b", "outside the package"),
            ("a", "b/../../c", "only allowed"),
            ("install/p/a", "/ws/build/p/a", "--symlink-install"),
            ("install/p/a", "../../src/a", "--symlink-install"),
        ] {
            let refusal = link_refusal(path, target).expect(path);
            assert!(refusal.contains(reason), "{path} -> {target}: {refusal}");
        }
    }
}
