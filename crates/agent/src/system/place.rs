//! Where an agent runs: the lock file that it holds, during one boot of one machine. A copy of the
//! data directory has another lock file, and a machine that was started again another boot. An
//! agent that comes with the same place has had to wait for the lock, and so for the end of the
//! agent before it: by that a server tells a restart from a copy. It is found out at each start and
//! written down nowhere.

use std::fs::File;
use std::io;
use std::os::unix::fs::MetadataExt as _;
use std::time::UNIX_EPOCH;

use task_proto::Digest;

use super::clock;

/// The place of whatever holds this lock file.
pub fn of(lock: &File) -> io::Result<Digest> {
    let about = lock.metadata()?;
    // Not all file systems know it. It tells files apart that got the number of one that was
    // removed.
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
    fn place_is_that_of_the_file_and_not_of_a_copy() {
        let dir = tempfile::tempdir().expect("a directory");
        let (path, copy) = (dir.path().join("lock"), dir.path().join("copy"));
        File::create(&path).expect("made");
        std::fs::copy(&path, &copy).expect("copied");
        let place = |path| of(&File::open(path).expect("opened")).expect("found out");
        assert_eq!(place(&path), place(&path));
        assert_ne!(place(&path), place(&copy));
    }
}
