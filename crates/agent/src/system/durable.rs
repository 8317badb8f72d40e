//! Changes to the file system that survive a power cut: once a function of this module returns, a
//! reader finds the new state, and until then the old one, never a mixture. The module does not
//! interpret the files.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Write};
use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};

use nix::fcntl::OFlag;

#[cfg(test)]
pub(crate) mod own_mounts;
mod removal;

pub use removal::remove_dir_all;

/// Replaces the file at `path` by one that contains `bytes` and has `mode`. One writer per path at
/// a time.
pub fn write(path: &Path, bytes: &[u8], mode: u32) -> io::Result<()> {
    let temporary = beside(path, ".tmp");
    // A file left by a crash must not pass its mode on to the new file, and must not be followed if
    // it is a link.
    remove_file(&temporary)?;
    let mut file = OpenOptions::new().write(true).create_new(true).mode(mode).open(&temporary)?;
    file.set_permissions(fs::Permissions::from_mode(mode))?;
    file.write_all(bytes)?;
    file.sync_all()?;
    rename(&temporary, path)
}

/// Makes `path` a symbolic link to `target`, replacing an existing link or file.
pub fn write_link(path: &Path, target: &Path) -> io::Result<()> {
    let temporary = beside(path, ".tmp");
    remove_file(&temporary)?;
    std::os::unix::fs::symlink(target, &temporary)?;
    rename(&temporary, path)
}

/// Renames `from` to `to`. The contents of `from` must have been synced before.
pub fn rename(from: &Path, to: &Path) -> io::Result<()> {
    fs::rename(from, to)?;
    sync_dir(parent(to))?;
    if parent(from) != parent(to) {
        sync_dir(parent(from))?;
    }
    Ok(())
}

/// Creates a directory and its parents, accessible to their owner only: the contents belong to the
/// agent.
pub fn create_dir_all(path: &Path) -> io::Result<()> {
    if path.is_dir() {
        return Ok(());
    }
    if let Some(parent) = path.parent().filter(|parent| !parent.as_os_str().is_empty()) {
        create_dir_all(parent)?;
    }
    match fs::DirBuilder::new().mode(0o700).create(path) {
        Ok(()) => sync_dir(parent(path)),
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists && path.is_dir() => Ok(()),
        Err(error) => Err(error),
    }
}

/// Removes a file or link, if it exists.
pub fn remove_file(path: &Path) -> io::Result<()> {
    absent_is_fine(fs::remove_file(path))
}

/// Flushes all data of the file system that holds the directory `path` to the disk. One call covers
/// a whole tree: syncing its files one by one takes many times as long. A link, pipe or device at
/// `path` is refused unopened.
pub fn sync_file_system(path: &Path) -> io::Result<()> {
    Ok(nix::unistd::syncfs(open_dir(path, OFlag::O_NOFOLLOW)?)?)
}

/// Flushes a directory's entries to the disk.
pub fn sync_dir(path: &Path) -> io::Result<()> {
    open_dir(path, OFlag::empty())?.sync_all()
}

/// Opens a directory. Other file types are refused without being opened: a pipe would block the
/// caller, and opening a device may already have an effect.
fn open_dir(path: &Path, flags: OFlag) -> io::Result<File> {
    let flags = OFlag::O_DIRECTORY | flags;
    OpenOptions::new().read(true).custom_flags(flags.bits()).open(path)
}

fn beside(path: &Path, suffix: &str) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(suffix);
    PathBuf::from(name)
}

fn parent(path: &Path) -> &Path {
    match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    }
}

fn absent_is_fine(result: io::Result<()>) -> io::Result<()> {
    match result {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        other => other,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn write_replaces_content_and_mode_after_any_crash() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("identity.json");
        fs::write(&path, "old").unwrap();
        fs::write(beside(&path, ".tmp"), "half of somet").unwrap();
        write(&path, b"new", 0o600).unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"new");
        assert_eq!(fs::metadata(&path).unwrap().permissions().mode() & 0o7777, 0o600);
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
    }

    #[test]
    fn symlink_is_swapped_and_its_old_target_stays() {
        let dir = tempfile::tempdir().unwrap();
        let current = dir.path().join("current");
        let old = dir.path().join("old");
        fs::create_dir(&old).unwrap();
        write_link(&current, Path::new("old")).unwrap();
        write_link(&current, Path::new("new")).unwrap();
        assert_eq!(fs::read_link(&current).unwrap(), Path::new("new"));
        assert!(old.is_dir());
    }

    #[test]
    fn removing_unlocks_directories_and_follows_no_link() {
        let dir = tempfile::tempdir().unwrap();
        let tree = dir.path().join("tree");
        let outside = dir.path().join("outside");
        create_dir_all(&tree.join("locked/inner")).unwrap();
        fs::write(&outside, "kept").unwrap();
        std::os::unix::fs::symlink(&outside, tree.join("locked/link")).unwrap();
        fs::set_permissions(tree.join("locked"), fs::Permissions::from_mode(0o500)).unwrap();
        remove_dir_all(&tree).unwrap();
        remove_dir_all(&tree).unwrap();
        assert!(!tree.exists());
        assert_eq!(fs::read(&outside).unwrap(), b"kept");
    }
}
