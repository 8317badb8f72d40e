//! The tree that grows in a directory. Every path is reached from the root's descriptor, one component at a
//! time and without following links; symbolic links come last, when nothing is written through them any more.

use std::collections::BTreeMap;
use std::fs::{File, Permissions};
use std::io;
use std::os::fd::OwnedFd;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use nix::errno::Errno;
use nix::fcntl::{AtFlags, OFlag, open, openat};
use nix::sys::stat::{Mode, mkdirat};
use nix::unistd::{linkat, symlinkat};

use super::{Limits, Refusal, UnpackError};

const DIRECTORY_MODE: u32 = 0o755;
const FILE_MODE: u32 = 0o644;
const EXECUTABLE_MODE: u32 = 0o755;
/// How many components one symbolic link may lead through, those of other links included.
const MAX_LINK_STEPS: usize = 255;
/// All paths and link targets together. They are held in memory.
const MAX_NAMES_BYTES: usize = 16 << 20;

pub(super) struct Tree {
    root: PathBuf,
    root_fd: OwnedFd,
    nodes: BTreeMap<String, Node>,
    nodes_limit: u64,
    names_bytes: usize,
    /// The directory used last: entries come sorted, so it is mostly the next one's as well.
    open: Option<(String, OwnedFd)>,
}

enum Node {
    /// `announced` by an entry of its own, or only implied by a path below it.
    Directory {
        announced: bool,
    },
    File,
    Symlink {
        target: String,
    },
}

impl Tree {
    /// Makes the directory `root`, which must not be there yet; its parent must.
    pub(super) fn create(root: &Path, limits: &Limits) -> Result<Self, UnpackError> {
        let disk = |source| UnpackError::Disk { path: root.to_owned(), source };
        std::fs::create_dir(root).map_err(disk)?;
        let flags = OFlag::O_DIRECTORY | OFlag::O_NOFOLLOW | OFlag::O_CLOEXEC;
        let root_fd = open(root, flags, Mode::empty()).map_err(|errno| disk(errno.into()))?;
        std::fs::set_permissions(root, Permissions::from_mode(DIRECTORY_MODE)).map_err(disk)?;
        Ok(Self {
            root: root.to_owned(),
            root_fd,
            nodes: BTreeMap::new(),
            nodes_limit: limits.entries,
            names_bytes: 0,
            open: None,
        })
    }

    pub(super) fn directory(&mut self, path: &str) -> Result<(), UnpackError> {
        if path.is_empty() {
            return Ok(());
        }
        if let Some(Node::Directory { announced: announced @ false }) = self.nodes.get_mut(path) {
            *announced = true;
            return Ok(());
        }
        self.claim(path, Node::Directory { announced: true })?;
        self.make_directory(path)
    }

    /// Creates a file to write to.
    pub(super) fn file(&mut self, path: &str, executable: bool) -> Result<File, UnpackError> {
        self.claim(path, Node::File)?;
        let mode = if executable { EXECUTABLE_MODE } else { FILE_MODE };
        let (parent, name) = split(path);
        let flags = OFlag::O_WRONLY | OFlag::O_CREAT | OFlag::O_EXCL | OFlag::O_NOFOLLOW | OFlag::O_CLOEXEC;
        let file = openat(self.open_directory(parent)?, name, flags, Mode::from_bits_truncate(mode));
        let file = File::from(file.map_err(|errno| self.disk(path, errno))?);
        // The creation mode alone would depend on the umask.
        file.set_permissions(Permissions::from_mode(mode)).map_err(|source| self.disk(path, source))?;
        Ok(file)
    }

    /// Notes a symbolic link; it is made at the end.
    pub(super) fn symlink(&mut self, path: &str, target: String) -> Result<(), UnpackError> {
        if target.starts_with('/') {
            return Err(leaves(path, &target).into());
        }
        self.names_bytes += target.len();
        self.claim(path, Node::Symlink { target })
    }

    /// Gives a file of this archive that was unpacked before a second name.
    pub(super) fn hard_link(&mut self, path: &str, target: &str) -> Result<(), UnpackError> {
        if !matches!(self.nodes.get(target), Some(Node::File)) {
            let reason = format!("a hard link must name an earlier file of the archive, not {target:?}");
            return Err(Refusal::entry(path.as_bytes(), reason).into());
        }
        self.claim(path, Node::File)?;
        let (target_parent, target_name) = split(target);
        let target_parent = self.walk(target_parent).map_err(|errno| self.disk(target, errno))?;
        let (parent, name) = split(path);
        let made = linkat(target_parent, target_name, self.open_directory(parent)?, name, AtFlags::empty());
        made.map_err(|errno| self.disk(path, errno))
    }

    /// Makes the symbolic links, once it is known that none of them leads out of the tree.
    pub(super) fn finish(mut self) -> Result<(), UnpackError> {
        let mut links = Vec::new();
        for (path, node) in &self.nodes {
            if let Node::Symlink { target } = node {
                self.check_symlink(path, target)?;
                links.push((path.clone(), target.clone()));
            }
        }
        for (path, target) in links {
            let (parent, name) = split(&path);
            let made = symlinkat(target.as_str(), self.open_directory(parent)?, name);
            made.map_err(|errno| self.disk(&path, errno))?;
        }
        Ok(())
    }

    /// Takes `path` for `node`: makes the directories above it, refuses what is there already.
    fn claim(&mut self, path: &str, node: Node) -> Result<(), UnpackError> {
        for (end, _) in path.match_indices('/') {
            let above = &path[..end];
            let reason = match self.nodes.get(above) {
                Some(Node::Directory { .. }) => continue,
                None => {
                    self.insert(above, Node::Directory { announced: false })?;
                    self.make_directory(above)?;
                    continue;
                }
                Some(Node::File) => "is a file",
                Some(Node::Symlink { .. }) => "is a symbolic link",
            };
            return Err(Refusal::entry(path.as_bytes(), format!("{above:?} above it {reason}")).into());
        }
        if self.nodes.contains_key(path) {
            return Err(Refusal::entry(path.as_bytes(), "the name is there twice").into());
        }
        self.insert(path, node)
    }

    fn insert(&mut self, path: &str, node: Node) -> Result<(), UnpackError> {
        self.names_bytes += path.len();
        self.nodes.insert(path.to_owned(), node);
        let limit = |what, found, limit| Err(Refusal::Limit { what, found, limit }.into());
        if self.nodes.len() as u64 > self.nodes_limit {
            return limit("files, directories and links", self.nodes.len() as u64, self.nodes_limit);
        }
        if self.names_bytes > MAX_NAMES_BYTES {
            return limit("bytes of names", self.names_bytes as u64, MAX_NAMES_BYTES as u64);
        }
        Ok(())
    }

    fn make_directory(&mut self, path: &str) -> Result<(), UnpackError> {
        let (parent, name) = split(path);
        let made = mkdirat(self.open_directory(parent)?, name, Mode::from_bits_truncate(DIRECTORY_MODE));
        made.map_err(|errno| self.disk(path, errno))?;
        let directory = File::from(self.walk(path).map_err(|errno| self.disk(path, errno))?);
        let set = directory.set_permissions(Permissions::from_mode(DIRECTORY_MODE));
        set.map_err(|source| self.disk(path, source))?;
        self.open = Some((path.to_owned(), directory.into()));
        Ok(())
    }

    fn open_directory(&mut self, path: &str) -> Result<&OwnedFd, UnpackError> {
        if self.open.as_ref().is_none_or(|(open, _)| open != path) {
            let directory = self.walk(path).map_err(|errno| self.disk(path, errno))?;
            self.open = Some((path.to_owned(), directory));
        }
        Ok(self.open.as_ref().map_or(&self.root_fd, |(_, directory)| directory))
    }

    fn walk(&self, path: &str) -> Result<OwnedFd, Errno> {
        let flags = OFlag::O_DIRECTORY | OFlag::O_NOFOLLOW | OFlag::O_CLOEXEC;
        let mut directory = openat(&self.root_fd, ".", flags, Mode::empty())?;
        for name in path.split('/').filter(|name| !name.is_empty()) {
            directory = openat(&directory, name, flags, Mode::empty())?;
        }
        Ok(directory)
    }

    /// Follows a link through the tree as the kernel would, other links included. What is not there counts as a
    /// directory: a build may make it.
    fn check_symlink(&self, path: &str, target: &str) -> Result<(), Refusal> {
        let mut at: Vec<&str> = split(path).0.split('/').filter(|part| !part.is_empty()).collect();
        let mut ahead: Vec<&str> = target.rsplit('/').collect();
        let mut steps = 0;
        while let Some(part) = ahead.pop() {
            steps += 1;
            if steps > MAX_LINK_STEPS {
                return Err(Refusal::entry(path.as_bytes(), "the symbolic link leads through too many others"));
            }
            match part {
                "" | "." => continue,
                ".." if at.pop().is_none() => return Err(leaves(path, target)),
                ".." => continue,
                name => at.push(name),
            }
            if let Some(Node::Symlink { target: next }) = self.nodes.get(&at.join("/")) {
                at.pop();
                ahead.extend(next.rsplit('/'));
            }
        }
        Ok(())
    }

    fn disk(&self, path: &str, source: impl Into<io::Error>) -> UnpackError {
        UnpackError::Disk { path: self.root.join(path), source: source.into() }
    }
}

fn leaves(path: &str, target: &str) -> Refusal {
    Refusal::entry(path.as_bytes(), format!("the symbolic link to {target:?} leaves the package"))
}

fn split(path: &str) -> (&str, &str) {
    path.rsplit_once('/').unwrap_or(("", path))
}
