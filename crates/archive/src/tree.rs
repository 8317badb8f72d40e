//! Creates the tree in a directory. Every path is opened from the root's descriptor, one component
//! at a time and without following links; symbolic links are created last, when no more files are
//! written.

use std::fs::{File, Permissions};
use std::io;
use std::os::fd::OwnedFd;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use nix::errno::Errno;
use nix::fcntl::{AtFlags, OFlag, open, openat};
use nix::sys::stat::{Mode, mkdirat};
use nix::unistd::{linkat, symlinkat};

use super::names::{Names, split};
use super::{Entry, Kind, Limits, UnpackError};

const DIRECTORY_MODE: u32 = 0o755;
const FILE_MODE: u32 = 0o644;
const EXECUTABLE_MODE: u32 = 0o755;

pub(super) struct Tree {
    root: PathBuf,
    root_fd: OwnedFd,
    names: Names,
    /// The directory used last: entries are sorted, so the next entry is mostly in the same
    /// directory.
    open: Option<(String, OwnedFd)>,
}

impl Tree {
    /// Creates the directory `root`, which must not exist; its parent must.
    pub(super) fn create(root: &Path, limits: &Limits) -> Result<Self, UnpackError> {
        let disk = |source| UnpackError::Disk { path: root.to_owned(), source };
        std::fs::create_dir(root).map_err(disk)?;
        let flags = OFlag::O_DIRECTORY | OFlag::O_NOFOLLOW | OFlag::O_CLOEXEC;
        let root_fd = open(root, flags, Mode::empty()).map_err(|errno| disk(errno.into()))?;
        std::fs::set_permissions(root, Permissions::from_mode(DIRECTORY_MODE)).map_err(disk)?;
        Ok(Self { root: root.to_owned(), root_fd, names: Names::new(limits), open: None })
    }

    /// Creates the entry's object: directories, a second name of a file, or the file to write to. A
    /// symbolic link is only recorded.
    pub(super) fn add(&mut self, entry: &Entry) -> Result<Option<File>, UnpackError> {
        for directory in self.names.add(entry)? {
            self.make_directory(&directory)?;
        }
        match &entry.kind {
            Kind::Directory | Kind::Symlink { .. } => Ok(None),
            Kind::File { executable, .. } => self.file(&entry.path, *executable).map(Some),
            Kind::HardLink { target } => self.hard_link(&entry.path, target).map(|()| None),
        }
    }

    fn file(&mut self, path: &str, executable: bool) -> Result<File, UnpackError> {
        let mode = if executable { EXECUTABLE_MODE } else { FILE_MODE };
        let (parent, name) = split(path);
        let flags =
            OFlag::O_WRONLY | OFlag::O_CREAT | OFlag::O_EXCL | OFlag::O_NOFOLLOW | OFlag::O_CLOEXEC;
        let file =
            openat(self.open_directory(parent)?, name, flags, Mode::from_bits_truncate(mode));
        let file = File::from(file.map_err(|errno| self.disk(path, errno))?);
        // The creation mode alone would depend on the umask.
        file.set_permissions(Permissions::from_mode(mode))
            .map_err(|source| self.disk(path, source))?;
        Ok(file)
    }

    fn hard_link(&mut self, path: &str, target: &str) -> Result<(), UnpackError> {
        let (target_parent, target_name) = split(target);
        let target_parent = self.walk(target_parent).map_err(|errno| self.disk(target, errno))?;
        let (parent, name) = split(path);
        let made = linkat(
            target_parent,
            target_name,
            self.open_directory(parent)?,
            name,
            AtFlags::empty(),
        );
        made.map_err(|errno| self.disk(path, errno))
    }

    /// Creates the symbolic links, after a check that none of them leads out of the tree.
    pub(super) fn finish(mut self) -> Result<(), UnpackError> {
        let links = self.names.symlinks()?;
        let links: Vec<_> =
            links.into_iter().map(|(path, target)| (path.to_owned(), target.to_owned())).collect();
        for (path, target) in links {
            let (parent, name) = split(&path);
            let made = symlinkat(target.as_str(), self.open_directory(parent)?, name);
            made.map_err(|errno| self.disk(&path, errno))?;
        }
        Ok(())
    }

    fn make_directory(&mut self, path: &str) -> Result<(), UnpackError> {
        let (parent, name) = split(path);
        let made =
            mkdirat(self.open_directory(parent)?, name, Mode::from_bits_truncate(DIRECTORY_MODE));
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

    fn disk(&self, path: &str, source: impl Into<io::Error>) -> UnpackError {
        UnpackError::Disk { path: self.root.join(path), source: source.into() }
    }
}
