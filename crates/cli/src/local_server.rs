//! Owns the view of a server on this machine from outside, through its data directory; it never
//! changes the directory and never delays a server's start.

use std::fs::{File, TryLockError};
use std::io;
use std::path::Path;

use task_proto::data_directory::{ADDRESSES, Addresses, LOCK};

/// Whether a server runs from the directory at `path`, which need not exist.
///
/// # Errors
///
/// This account has no permission to read the directory.
pub fn is_locked(path: &Path) -> io::Result<bool> {
    match File::open(path.join(LOCK)) {
        Ok(lock) => Ok(matches!(lock.try_lock_shared(), Err(TryLockError::WouldBlock))),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(false),
        Err(error) => Err(error),
    }
}

/// The addresses that the server of this directory published there. The file of a server that was
/// killed since does not count: another process may listen on its addresses by now.
///
/// # Errors
///
/// This account has no permission to read the directory.
pub fn addresses(path: &Path) -> io::Result<Option<Addresses>> {
    if !is_locked(path)? {
        return Ok(None);
    }
    let published = std::fs::read(path.join(ADDRESSES)).ok();
    Ok(published.and_then(|text| serde_json::from_slice(&text).ok()))
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// A running server, as far as the commands see it. Dropping it is a kill: the addresses stay.
    pub(crate) struct RunningServer<'a> {
        directory: &'a Path,
        _lock: File,
    }

    impl<'a> RunningServer<'a> {
        /// Locks the directory and removes the addresses that a killed server left there.
        pub(crate) fn start(directory: &'a Path) -> Self {
            let lock = File::create(directory.join(LOCK)).expect("a file");
            lock.try_lock().expect("no other server");
            let _ = std::fs::remove_file(directory.join(ADDRESSES));
            Self { directory, _lock: lock }
        }

        pub(crate) fn publish(&self, addresses: &Addresses) {
            let text = serde_json::to_vec(addresses).expect("json");
            std::fs::write(self.directory.join(ADDRESSES), text).expect("written");
        }
    }

    #[test]
    fn addresses_count_while_their_server_runs() {
        let directory = tempfile::tempdir().expect("a directory");
        let path = directory.path();
        let found = || (is_locked(path).expect("told"), addresses(path).expect("told"));
        assert_eq!(found(), (false, None));
        let server = RunningServer::start(path);
        assert_eq!(found(), (true, None));
        let published = Addresses { http: "a:1".to_owned(), mqtt: "a:2".to_owned(), ca_pin: None };
        server.publish(&published);
        assert_eq!(found(), (true, Some(published)));
        drop(server);
        assert_eq!(found(), (false, None));
        assert!(!is_locked(&path.join("none")).expect("told"));
    }
}
