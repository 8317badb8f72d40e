//! Reads files in directories where a task may write. A task may replace a file by a link, pipe,
//! device or endless file. Such a replacement is not followed or opened, and never blocks the
//! reader. A [`Directory`] is entered one component at a time, so that no link on the path is
//! followed either; [`open`] does not check the directories above its file.

use std::ffi::OsString;
use std::fs::{self, File};
use std::io::{self, Read as _};
use std::os::fd::{AsFd, AsRawFd as _, OwnedFd};
use std::path::{Component, Path, PathBuf};

use nix::NixPath;
use nix::errno::Errno;
use nix::fcntl::{AT_FDCWD, OFlag, openat};
use nix::sys::stat::{FileStat, Mode, SFlag, fstat};

/// A directory that a task may change while it is being read.
#[derive(Debug)]
pub struct Directory(OwnedFd);

/// The type of a directory entry; links are not followed.
#[derive(Debug)]
pub enum Entry {
    Directory(Directory),
    /// A regular file, with its size in bytes.
    File(u64),
    /// A link, a pipe, a socket or a device.
    Other,
}

impl Directory {
    /// The directory at `path`. A task may own the last component, but not those above.
    pub fn open(path: &Path) -> io::Result<Self> {
        let flags = OFlag::O_PATH | OFlag::O_DIRECTORY | OFlag::O_NOFOLLOW | OFlag::O_CLOEXEC;
        Ok(Self(openat(AT_FDCWD, path, flags, Mode::empty())?))
    }

    /// The names in the directory, in no order.
    pub fn names(&self) -> io::Result<impl Iterator<Item = io::Result<OsString>> + use<>> {
        Ok(fs::read_dir(by_descriptor(&self.0))?.map(|entry| entry.map(|entry| entry.file_name())))
    }

    /// The entry `name`; `None` where it no longer exists.
    pub fn entry(&self, name: &str) -> io::Result<Option<Entry>> {
        let found = match find(&self.0, name) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            found => found?,
        };
        let about = fstat(&found)?;
        Ok(Some(match kind(&about) {
            SFlag::S_IFDIR => Entry::Directory(Self(found)),
            SFlag::S_IFREG => Entry::File(about.st_size.unsigned_abs()),
            _ => Entry::Other,
        }))
    }

    /// Opens the regular file at `path`, which leads downward from this directory.
    pub fn file(&self, path: &Path) -> io::Result<File> {
        let mut names = path.components().collect::<Vec<_>>();
        let last = names.pop().ok_or(io::ErrorKind::InvalidInput)?;
        let mut dir = None;
        for name in names {
            let Component::Normal(name) = name else {
                return Err(io::ErrorKind::InvalidInput.into());
            };
            let flags = OFlag::O_PATH | OFlag::O_DIRECTORY | OFlag::O_NOFOLLOW | OFlag::O_CLOEXEC;
            dir = Some(openat(dir.as_ref().unwrap_or(&self.0), name, flags, Mode::empty())?);
        }
        let Component::Normal(last) = last else { return Err(io::ErrorKind::InvalidInput.into()) };
        open_found(&find(dir.as_ref().unwrap_or(&self.0), last)?)
    }
}

/// Opens a regular file for reading.
pub fn open(path: &Path) -> io::Result<File> {
    open_found(&find(AT_FDCWD, path)?)
}

/// The bytes of a regular file, which may have `max_bytes` at most.
pub fn read(path: &Path, max_bytes: u64) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    open(path)?.take(max_bytes.saturating_add(1)).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > max_bytes {
        return Err(io::Error::other(format!("more than {max_bytes} bytes")));
    }
    Ok(bytes)
}

/// A descriptor that only names the entry (`O_PATH`): nothing is opened by it.
fn find(at: impl AsFd, name: &(impl NixPath + ?Sized)) -> io::Result<OwnedFd> {
    let flags = OFlag::O_PATH | OFlag::O_NOFOLLOW | OFlag::O_CLOEXEC;
    Ok(openat(at, name, flags, Mode::empty())?)
}

/// Opens the found entry, if it is a regular file. This opens the same file even if its name has
/// another file by now.
fn open_found(found: &OwnedFd) -> io::Result<File> {
    match kind(&fstat(found)?) {
        SFlag::S_IFREG => File::open(by_descriptor(found)),
        SFlag::S_IFLNK => Err(Errno::ELOOP.into()),
        _ => Err(io::Error::new(io::ErrorKind::InvalidData, "not a regular file")),
    }
}

fn kind(about: &FileStat) -> SFlag {
    SFlag::from_bits_truncate(about.st_mode & SFlag::S_IFMT.bits())
}

fn by_descriptor(descriptor: &OwnedFd) -> PathBuf {
    format!("/proc/self/fd/{}", descriptor.as_raw_fd()).into()
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use super::*;

    #[test]
    fn only_a_regular_file_of_bounded_size_is_read() {
        let temp = tempfile::tempdir().expect("temp dir");
        let at = |name: &str| temp.path().join(name);
        std::fs::write(at("file"), "four").expect("written");
        assert_eq!(read(&at("file"), 4).expect("read"), b"four");
        assert!(read(&at("file"), 3).is_err());
        symlink(at("file"), at("link")).expect("linked");
        symlink("/dev/zero", at("zeros")).expect("linked");
        nix::unistd::mkfifo(&at("pipe"), Mode::S_IRWXU).expect("a pipe");
        for name in ["link", "zeros", "pipe", "."] {
            assert!(read(&at(name), 4).is_err(), "{name}");
        }
    }

    #[test]
    fn pipe_in_place_of_a_file_is_not_opened() {
        let temp = tempfile::tempdir().expect("temp dir");
        let pipe = temp.path().join("pipe");
        nix::unistd::mkfifo(&pipe, Mode::S_IRWXU).expect("a pipe");
        // If there were a reader, even for a moment, the writer could open the pipe.
        let writer = std::thread::spawn({
            let pipe = pipe.clone();
            move || File::options().write(true).open(pipe).expect("opened")
        });
        for _ in 0..10_000 {
            assert!(open(&pipe).is_err());
        }
        assert!(!writer.is_finished(), "the pipe was opened");
        let _reader = File::open(&pipe).expect("opened");
        writer.join().expect("let in");
    }

    #[test]
    fn link_on_the_way_to_a_file_is_not_followed() {
        let temp = tempfile::tempdir().expect("temp dir");
        let root = temp.path().join("root");
        std::fs::create_dir_all(root.join("inner")).expect("made");
        std::fs::write(root.join("inner/file"), "own").expect("written");
        std::fs::create_dir(temp.path().join("outside")).expect("made");
        std::fs::write(temp.path().join("outside/file"), "secret").expect("written");
        symlink("../outside", root.join("out")).expect("linked");
        let dir = Directory::open(&root).expect("opened");
        assert!(dir.file(Path::new("inner/file")).is_ok());
        for path in ["out/file", "../outside/file", "/etc/passwd", "", "inner", "."] {
            assert!(dir.file(Path::new(path)).is_err(), "{path}");
        }
        assert!(Directory::open(&root.join("out")).is_err());
        assert!(matches!(dir.entry("out"), Ok(Some(Entry::Other))));
        assert!(matches!(dir.entry("nothing"), Ok(None)));
    }
}
