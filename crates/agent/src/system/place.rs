//! The place of an agent: the lock file that it holds, during one boot of one machine. A copy of
//! the data directory has another lock file, and a machine that was started again has another boot.
//! An agent with the same place as an earlier one has had to wait for the lock, and so for the end
//! of that agent. This lets a server distinguish a restart from a copy. The place is determined at
//! each start and never stored.

use std::fs::File;
use std::io;
use std::os::unix::fs::MetadataExt as _;
use std::time::UNIX_EPOCH;

use task_proto::Digest;

use super::clock;

/// The place of the agent that holds this lock file.
pub fn of(lock: &File) -> io::Result<Digest> {
    let about = lock.metadata()?;
    // Not all file systems record a creation time. It distinguishes a new file from a removed one
    // with the same inode number.
    let born = about
        .created()
        .ok()
        .and_then(|born| born.duration_since(UNIX_EPOCH).ok())
        .unwrap_or_default();
    let place =
        format!("{} {} {} {}", clock::boot_id()?, about.dev(), about.ino(), born.as_nanos());
    Ok(Digest::of(place.as_bytes()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn copy_of_the_lock_file_has_another_place() {
        let dir = tempfile::tempdir().expect("a directory");
        let path = dir.path().join("lock");
        let copy = dir.path().join("copy");
        File::create(&path).expect("made");
        std::fs::copy(&path, &copy).expect("copied");
        let place = |path| of(&File::open(path).expect("opened")).expect("found out");
        assert_eq!(place(&path), place(&path));
        assert_ne!(place(&path), place(&copy));
    }
}
