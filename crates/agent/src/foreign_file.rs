//! Reading files that lie where a task may write. What a task puts in their place — a link, a pipe, a file without end —
//! neither leads elsewhere nor keeps the reader waiting. Directories on the way are not looked at: where that matters the
//! reader has the task's own rights (see [`crate::task_user::TaskUser::with_its_rights`]).

use std::fs::{File, OpenOptions};
use std::io::{self, Read as _};
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::Path;

use nix::fcntl::OFlag;

/// Opens a regular file for reading.
pub fn open(path: &Path) -> io::Result<File> {
    let flags = OFlag::O_NOFOLLOW | OFlag::O_NONBLOCK;
    let file = OpenOptions::new().read(true).custom_flags(flags.bits()).open(path)?;
    if file.metadata()?.is_file() { Ok(file) } else { Err(io::Error::other("it is not a regular file")) }
}

/// The bytes of a regular file, which may be `max_bytes` at most.
pub fn read(path: &Path, max_bytes: u64) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    open(path)?.take(max_bytes.saturating_add(1)).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > max_bytes {
        return Err(io::Error::other(format!("it has more than {max_bytes} bytes")));
    }
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use nix::sys::stat::Mode;

    use super::*;

    #[test]
    fn only_a_regular_file_of_bounded_size_is_read() {
        let temp = tempfile::tempdir().expect("temp dir");
        let at = |name: &str| temp.path().join(name);
        std::fs::write(at("file"), "four").expect("written");
        assert_eq!(read(&at("file"), 4).expect("read"), b"four");
        assert!(read(&at("file"), 3).is_err());
        std::os::unix::fs::symlink(at("file"), at("link")).expect("linked");
        std::os::unix::fs::symlink("/dev/zero", at("zeros")).expect("linked");
        nix::unistd::mkfifo(&at("pipe"), Mode::S_IRWXU).expect("a pipe");
        for name in ["link", "zeros", "pipe", "."] {
            assert!(read(&at(name), 4).is_err(), "{name}");
        }
    }
}
