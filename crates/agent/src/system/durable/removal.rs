//! Removes untrusted directory trees: of any depth, with paths above the length limit, full of
//! links. The removal uses a bounded number of descriptors and a bounded stack, works by
//! descriptors alone and follows no link.

use std::ffi::OsStr;
use std::fs;
use std::io;
use std::os::fd::{AsFd, AsRawFd as _, OwnedFd};
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};

use nix::NixPath;
use nix::errno::Errno;
use nix::fcntl::{AT_FDCWD, OFlag, openat, renameat};
use nix::sys::stat::{Mode, fstat};
use nix::unistd::{UnlinkatFlags, unlinkat};

/// Maximum number of levels open at a time, with two descriptors each.
const MAX_LEVELS: usize = 32;
/// Name prefix, before a number, of a directory that was moved up.
const MOVED_UP: &str = ".deeper-";

/// Removes a directory with all its contents, or a file or link, if it exists. No link is followed.
pub fn remove_dir_all(path: &Path) -> io::Result<()> {
    match unlinkat(AT_FDCWD, path, UnlinkatFlags::NoRemoveDir) {
        Ok(()) | Err(Errno::ENOENT) => return Ok(()),
        Err(Errno::EISDIR) => {}
        Err(error) => return Err(error.into()),
    }
    let top = open_dir(AT_FDCWD, path)?;
    let mut removal = Removal { top: &top, moved: 0 };
    loop {
        let before = removal.moved;
        removal.empty(&top, MAX_LEVELS)?;
        if removal.moved == before {
            return remove_empty(AT_FDCWD, path);
        }
    }
}

/// The removal of one tree.
struct Removal<'a> {
    top: &'a OwnedFd,
    /// Number of directories that were moved up to the top.
    moved: u64,
}

impl Removal<'_> {
    /// Removes the contents of `dir`. Directories more than `levels` below it are moved to the top,
    /// for a later pass.
    fn empty(&mut self, dir: &OwnedFd, levels: usize) -> io::Result<()> {
        for entry in fs::read_dir(by_descriptor(dir))? {
            let name = entry?.file_name();
            match unlinkat(dir, name.as_os_str(), UnlinkatFlags::NoRemoveDir) {
                Ok(()) | Err(Errno::ENOENT) => continue,
                Err(Errno::EISDIR) => {}
                Err(error) => return Err(error.into()),
            }
            let below = open_dir(dir, name.as_os_str())?;
            if levels == 0 {
                self.move_up(dir, &name)?;
            } else {
                self.empty(&below, levels - 1)?;
                remove_empty(dir, name.as_os_str())?;
            }
        }
        Ok(())
    }

    fn move_up(&mut self, dir: &OwnedFd, name: &OsStr) -> io::Result<()> {
        loop {
            let place = format!("{MOVED_UP}{}", self.moved);
            self.moved += 1;
            match renameat(dir, name, self.top, place.as_str()) {
                // The name is taken: there are no more such names than entries.
                Err(Errno::ENOTEMPTY | Errno::EEXIST | Errno::ENOTDIR) => {}
                moved => return Ok(moved?),
            }
        }
    }
}

/// Opens a directory and gives it the mode that its removal needs: a build may leave directories
/// that even their owner can't change.
fn open_dir(at: impl AsFd, name: &(impl NixPath + ?Sized)) -> io::Result<OwnedFd> {
    let flags = OFlag::O_PATH | OFlag::O_DIRECTORY | OFlag::O_NOFOLLOW | OFlag::O_CLOEXEC;
    let dir = openat(at, name, flags, Mode::empty())?;
    if !Mode::from_bits_truncate(fstat(&dir)?.st_mode).contains(Mode::S_IRWXU) {
        fs::set_permissions(by_descriptor(&dir), fs::Permissions::from_mode(0o700))?;
    }
    Ok(dir)
}

fn remove_empty(at: impl AsFd, name: &(impl NixPath + ?Sized)) -> io::Result<()> {
    match unlinkat(at, name, UnlinkatFlags::RemoveDir) {
        Ok(()) | Err(Errno::ENOENT) => Ok(()),
        Err(error) => Err(error.into()),
    }
}

fn by_descriptor(dir: &OwnedFd) -> PathBuf {
    format!("/proc/self/fd/{}", dir.as_raw_fd()).into()
}

#[cfg(test)]
mod tests {
    use nix::sys::stat::mkdirat;

    use super::*;

    /// Too deep for a stack of two megabytes with one recursive call per level, and for the
    /// available descriptors.
    const DEPTH: usize = 20_000;

    #[test]
    fn tree_deeper_than_any_path_is_removed() {
        let temp = tempfile::tempdir().expect("a directory");
        let tree = temp.path().join("tree");
        let outside = temp.path().join("outside");
        fs::create_dir(&tree).expect("made");
        fs::write(&outside, "kept").expect("written");
        // These names conflict with those of directories that are moved up.
        fs::write(tree.join(format!("{MOVED_UP}0")), "").expect("written");
        fs::create_dir_all(tree.join(format!("{MOVED_UP}1/full"))).expect("made");
        let mut dir = open_dir(AT_FDCWD, &tree).expect("opened");
        for level in 0..DEPTH {
            mkdirat(&dir, "deeper", Mode::S_IRWXU).expect("made");
            nix::unistd::symlinkat(&outside, &dir, "link").expect("linked");
            let below = open_dir(&dir, "deeper").expect("opened");
            if level % 100 == 0 {
                mkdirat(&below, "locked", Mode::empty()).expect("made");
            }
            dir = below;
        }
        drop(dir);
        remove_dir_all(&tree).expect("removed");
        assert!(!tree.exists());
        assert_eq!(fs::read(&outside).expect("read"), b"kept");
    }
}
