//! The server's directory: created on the first start and locked while a server runs. It holds the
//! signing key, the private certificate authority, the secret from which robots' passwords at an
//! external broker are derived, the first operator's token and the bound addresses. In a cluster
//! the keys may be in a directory that all servers share, and then they are only read. This module
//! never touches the database or the blobs in the directory, except for their file modes.

use std::fs::{DirBuilder, File, OpenOptions, Permissions, TryLockError};
use std::io::{self, Write as _};
use std::os::unix::fs::{
    DirBuilderExt as _, MetadataExt as _, OpenOptionsExt as _, PermissionsExt as _,
};
use std::path::{Path, PathBuf};

use task_proto::data_directory::{
    ADDRESSES, AUTHORITY_CERTIFICATE, AUTHORITY_KEY, Addresses, BROKER_SECRET, LOCK,
    OPERATOR_TOKEN, SIGNING_KEY,
};
use task_proto::ids::digest::{hex, unhex};
use task_proto::trust::envelope::SigningKey;
use task_proto::trust::token::{Token, TokenKind};

/// Free space and size of the file system that holds `path`, in bytes.
pub(crate) fn disk_space(path: &Path) -> Option<(u64, u64)> {
    let stat = nix::sys::statvfs::statvfs(path).ok()?;
    let block = stat.fragment_size();
    Some((stat.blocks_available().saturating_mul(block), stat.blocks().saturating_mul(block)))
}

/// A directory that this process holds locked until the value is dropped.
#[derive(Debug)]
pub struct DataDirectory {
    path: PathBuf,
    lock: File,
    /// The directory with the cluster's keys, in place of own ones.
    secrets: Option<PathBuf>,
}

/// The reason why the directory can't be used.
#[derive(Debug, thiserror::Error)]
pub enum DataError {
    /// Another server runs from the directory.
    #[error("{} is in use: another taskd serves from it", path.display())]
    InUse { path: PathBuf },
    /// A file or the directory itself can't be created or read.
    #[error("{} can't be used", path.display())]
    Io {
        path: PathBuf,
        /// The operating system's error.
        source: io::Error,
    },
    /// Every account of the machine may put files into the directory.
    #[error(
        "{0} is writable by every user of this machine and belongs to another user: run chmod o-w {0}, \
         or use another directory", path.display()
    )]
    WorldWritable { path: PathBuf },
    /// There is no disk space for a file.
    #[error("{} can't be written, because the disk is full: free at least 16 MB on its file system", path.display())]
    Full { path: PathBuf },
    /// A file has unexpected content.
    #[error("{} does not contain {expected}; restore the file, or move it away to get a new one", path.display())]
    Content { path: PathBuf, expected: &'static str },
    /// A file that all servers of the cluster share has unexpected content.
    #[error("cluster.secrets: {} does not contain {expected}; copy the file that the other servers have", path.display())]
    SharedContent { path: PathBuf, expected: &'static str },
    /// A file that all servers of the cluster share is missing.
    #[error("cluster.secrets: {} is missing; copy the file that the other servers have, or run taskd cluster export", path.display())]
    NoSecret { path: PathBuf },
}

impl DataError {
    fn io(path: impl Into<PathBuf>) -> impl FnOnce(io::Error) -> Self {
        let path = path.into();
        move |source| match source.kind() {
            io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => Self::Full { path },
            _ => Self::Io { path, source },
        }
    }
}

impl Drop for DataDirectory {
    /// The next server may start at once, even while a process that is just being started still has
    /// our files open.
    fn drop(&mut self) {
        let _ = self.lock.unlock();
    }
}

impl DataDirectory {
    /// Creates the directory if missing, and locks it. Removes the addresses that a killed server
    /// published there.
    pub fn open(path: &Path) -> Result<Self, DataError> {
        DirBuilder::new().recursive(true).mode(0o700).create(path).map_err(DataError::io(path))?;
        let lock_path = path.join(LOCK);
        let lock = OpenOptions::new()
            .create(true)
            .truncate(false)
            .write(true)
            .mode(0o600)
            .open(&lock_path);
        let lock = lock.map_err(DataError::io(&lock_path))?;
        loop {
            match lock.try_lock() {
                Ok(()) => {
                    let data = Self { path: path.to_owned(), lock, secrets: None };
                    data.restrict_permissions()?;
                    data.unpublish();
                    return Ok(data);
                }
                // No server holds the lock: commands take it for a moment to check whether a server
                // runs.
                Err(TryLockError::WouldBlock) if lock.try_lock_shared().is_ok() => {
                    std::thread::yield_now()
                }
                Err(TryLockError::WouldBlock) => {
                    return Err(DataError::InUse { path: path.to_owned() });
                }
                Err(TryLockError::Error(source)) => {
                    return Err(DataError::Io { path: lock_path, source });
                }
            }
        }
    }

    /// Takes the keys from this directory and makes none.
    pub fn with_secrets(mut self, secrets: Option<PathBuf>) -> Self {
        self.secrets = secrets;
        self
    }

    /// Removes permissions that an earlier version, an umask or a copy has given to other accounts:
    /// no other account writes to the directory or reads its content.
    fn restrict_permissions(&self) -> Result<(), DataError> {
        let io_error = |source| DataError::Io { path: self.path.clone(), source };
        let own = std::fs::metadata(&self.path).map_err(io_error)?;
        let (mode, shown) = (own.mode(), self.path.display());
        if mode & 0o022 != 0 {
            if std::fs::set_permissions(&self.path, Permissions::from_mode(mode & 0o7755)).is_ok() {
                tracing::warn!("removed other users' write permission on {shown}");
            } else if mode & 0o002 != 0 {
                return Err(DataError::WorldWritable { path: self.path.clone() });
            } else {
                tracing::warn!(
                    "the group of {shown} can write to it and so replace the server's keys"
                );
            }
        }
        for entry in std::fs::read_dir(&self.path).map_err(io_error)? {
            let path = entry.map_err(io_error)?.path();
            // A link's target is elsewhere, and a command may remove its own file meanwhile.
            let Ok(found) = path.symlink_metadata() else { continue };
            if found.is_symlink() || found.mode() & 0o077 == 0 {
                continue;
            }
            match std::fs::set_permissions(&path, Permissions::from_mode(found.mode() & 0o700)) {
                Ok(()) => {
                    tracing::info!("removed other users' permissions on {}", path.display())
                }
                Err(error) => tracing::warn!(%error, "other users can read {}", path.display()),
            }
        }
        Ok(())
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Creates an empty directory inside; the files of an earlier server are removed. An existing
    /// directory stays, so that this takes no disk space.
    pub fn fresh_directory(&self, name: &str) -> Result<PathBuf, DataError> {
        let path = self.path.join(name);
        let clear = || {
            DirBuilder::new().recursive(true).mode(0o700).create(&path)?;
            for entry in std::fs::read_dir(&path)? {
                let entry = entry?;
                match entry.file_type()?.is_dir() {
                    true => std::fs::remove_dir_all(entry.path())?,
                    false => std::fs::remove_file(entry.path())?,
                }
            }
            Ok(())
        };
        clear().map_err(DataError::io(&path))?;
        Ok(path)
    }

    /// The path of the operator's token.
    pub fn operator_token_path(&self) -> PathBuf {
        self.secret_path(OPERATOR_TOKEN)
    }

    /// The key that signs desired states, created on the first start. Robots pin the key, so it is
    /// never replaced automatically.
    pub fn signing_key(&self) -> Result<SigningKey, DataError> {
        let seed = self.secret(SIGNING_KEY, "a signing key", || SigningKey::random().to_bytes())?;
        Ok(SigningKey::from_bytes(seed))
    }

    /// The secret from which robots' passwords at an external broker are derived, created on first
    /// use. A new secret gives all robots new passwords.
    pub fn broker_secret(&self) -> Result<[u8; 32], DataError> {
        self.secret(BROKER_SECRET, "a secret of 64 hex digits", rand::random)
    }

    /// The key of the private certificate authority, as PEM; `fresh` on the first start. Robots pin
    /// the authority.
    pub fn authority_key(&self, fresh: String) -> Result<String, DataError> {
        self.secret_text(AUTHORITY_KEY, || fresh)
    }

    /// The authority's own certificate, as PEM, for users who import it; `fresh` on the first
    /// start.
    pub fn authority_certificate(&self, fresh: String) -> Result<String, DataError> {
        self.secret_text(AUTHORITY_CERTIFICATE, || fresh)
    }

    /// The error that one of these two files is unusable.
    pub fn authority_error(&self, is_key: bool) -> DataError {
        match is_key {
            true => self.content_error(AUTHORITY_KEY, "a certificate authority's key"),
            false => {
                self.content_error(AUTHORITY_CERTIFICATE, "the certificate of the key in ca.key")
            }
        }
    }

    /// The token of the first operator, created on the first start. A cluster may have none.
    pub fn operator_token(&self) -> Result<Option<Token>, DataError> {
        let text = match self
            .secret_text(OPERATOR_TOKEN, || Token::random(TokenKind::Operator).reveal())
        {
            Err(DataError::NoSecret { .. }) => return Ok(None),
            text => text?,
        };
        match text.trim().parse::<Token>() {
            Ok(token) if token.kind() == TokenKind::Operator => Ok(Some(token)),
            _ => Err(self.content_error(OPERATOR_TOKEN, "an operator's token")),
        }
    }

    /// Tells programs on this machine where the server listens.
    pub fn publish(&self, addresses: &Addresses) -> Result<(), DataError> {
        let path = self.path.join(ADDRESSES);
        let text = serde_json::to_string(addresses)
            .map_err(|error| DataError::Io { path: path.clone(), source: error.into() })?;
        self.write_new(&path, &format!("{text}\n")).map_err(DataError::io(path))
    }

    /// Withdraws the addresses, because the server no longer listens there or soon will not.
    /// Otherwise our token could be shown to another program that listens there.
    pub fn unpublish(&self) {
        let _ = std::fs::remove_file(self.path.join(ADDRESSES));
    }

    /// The path of a key's file.
    fn secret_path(&self, name: &str) -> PathBuf {
        self.secrets.as_ref().unwrap_or(&self.path).join(name)
    }

    fn content_error(&self, name: &str, expected: &'static str) -> DataError {
        let path = self.secret_path(name);
        match self.secrets {
            Some(_) => DataError::SharedContent { path, expected },
            None => DataError::Content { path, expected },
        }
    }

    /// 32 bytes in a separate file, created on the first call.
    fn secret(
        &self,
        name: &str,
        expected: &'static str,
        create: fn() -> [u8; 32],
    ) -> Result<[u8; 32], DataError> {
        let text = self.secret_text(name, || hex(&create()))?;
        unhex(text.trim()).ok_or_else(|| self.content_error(name, expected))
    }

    /// The text of a key's file. Only the data directory's own is created if missing: a server with
    /// a key of its own would be a stranger to its cluster's robots.
    fn secret_text(
        &self,
        name: &str,
        create: impl FnOnce() -> String,
    ) -> Result<String, DataError> {
        let path = self.secret_path(name);
        if self.secrets.is_none() {
            return self.read_or_create(&path, create);
        }
        match std::fs::read_to_string(&path) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                Err(DataError::NoSecret { path })
            }
            read => read.map_err(DataError::io(path)),
        }
    }

    fn read_or_create(
        &self,
        path: &Path,
        create: impl FnOnce() -> String,
    ) -> Result<String, DataError> {
        match std::fs::read_to_string(path) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                let text = create();
                let text = text.trim_end().to_owned();
                self.write_new(path, &format!("{text}\n")).map_err(DataError::io(path))?;
                Ok(text)
            }
            other => other.map_err(DataError::io(path)),
        }
    }

    /// Writes a file of mode 0600 atomically, also across a power cut.
    fn write_new(&self, path: &Path, text: &str) -> io::Result<()> {
        let partial = path.with_extension("new");
        // A file left by a crash would keep its mode.
        if let Err(error) = std::fs::remove_file(&partial)
            && error.kind() != io::ErrorKind::NotFound
        {
            return Err(error);
        }
        let mut file =
            OpenOptions::new().create_new(true).write(true).mode(0o600).open(&partial)?;
        file.write_all(text.as_bytes())?;
        file.sync_all()?;
        std::fs::rename(&partial, path)?;
        File::open(&self.path)?.sync_all()
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicBool;
    use std::sync::atomic::Ordering::Relaxed;

    use task_cli::local_server::{self, is_locked};
    use task_proto::CaPin;

    use super::*;

    fn mode(path: &Path) -> u32 {
        std::fs::metadata(path).expect("exists").permissions().mode() & 0o777
    }

    #[test]
    fn secrets_are_created_once_with_private_modes() {
        let parent = tempfile::tempdir().expect("temp dir");
        let path = parent.path().join("deep/data");
        let data = DataDirectory::open(&path).expect("opens");
        assert_eq!(mode(&path), 0o700);
        let (key, token) =
            (data.signing_key().expect("made"), data.operator_token().expect("made"));
        assert_eq!(mode(&path.join(SIGNING_KEY)), 0o600);
        assert_eq!(mode(&data.operator_token_path()), 0o600);
        assert_eq!(data.signing_key().expect("read").to_bytes(), key.to_bytes());
        assert_eq!(data.operator_token().expect("read"), token);
        assert!(token.is_some());
        std::fs::write(path.join(SIGNING_KEY), "nonsense").expect("written");
        let message = data.signing_key().err().expect("refused").to_string();
        assert!(message.contains("signing.key does not contain a signing key"), "{message}");
    }

    #[test]
    fn shared_secrets_are_read_and_never_created() {
        let parent = tempfile::tempdir().expect("temp dir");
        let secrets = parent.path().join("secrets");
        let data = DataDirectory::open(&parent.path().join("data")).expect("opens");
        let own_key = data.signing_key().expect("made").to_bytes();
        let data = data.with_secrets(Some(secrets.clone()));
        let message = data.signing_key().err().expect("refused").to_string();
        let expected = format!("cluster.secrets: {}/signing.key is missing", secrets.display());
        assert!(message.starts_with(&expected), "{message}");
        assert!(data.broker_secret().is_err() && data.authority_key(String::new()).is_err());
        assert_eq!(data.operator_token().expect("optional"), None);
        assert!(!secrets.exists(), "nothing is created");
        std::fs::create_dir(&secrets).expect("made");
        std::fs::write(secrets.join(SIGNING_KEY), hex(&[7; 32])).expect("written");
        assert_eq!(data.signing_key().expect("read").to_bytes(), [7; 32]);
        assert_ne!(own_key, [7; 32]);
        std::fs::write(secrets.join(OPERATOR_TOKEN), "nonsense").expect("written");
        let message = data.operator_token().expect_err("refused").to_string();
        assert!(message.contains("copy the file that the other servers have"), "{message}");
    }

    #[test]
    fn permissions_of_other_users_are_removed() {
        let directory = tempfile::tempdir().expect("temp dir");
        let (path, elsewhere) = (directory.path().join("data"), directory.path().join("elsewhere"));
        std::fs::create_dir(&path).expect("made");
        std::fs::create_dir(path.join("blobs")).expect("made");
        for file in [
            &elsewhere,
            &path.join("taskd.sqlite"),
            &path.join("taskd.sqlite-wal"),
            &path.join(SIGNING_KEY),
        ] {
            std::fs::write(file, "").expect("written");
            std::fs::set_permissions(file, Permissions::from_mode(0o664)).expect("set");
        }
        std::os::unix::fs::symlink(&elsewhere, path.join("link")).expect("linked");
        std::fs::set_permissions(path.join("blobs"), Permissions::from_mode(0o775)).expect("set");
        std::fs::set_permissions(&path, Permissions::from_mode(0o777)).expect("set");
        drop(DataDirectory::open(&path).expect("opens"));
        assert_eq!(mode(&path), 0o755, "the directory stays readable");
        assert_eq!(mode(&path.join("blobs")), 0o700);
        for file in ["taskd.sqlite", "taskd.sqlite-wal", SIGNING_KEY, LOCK] {
            assert_eq!(mode(&path.join(file)), 0o600, "{file}");
        }
        assert_eq!(mode(&elsewhere), 0o664, "the target of a link stays as it was");
    }

    #[test]
    fn second_server_is_refused_until_the_first_is_gone() {
        let directory = tempfile::tempdir().expect("temp dir");
        let first = DataDirectory::open(directory.path()).expect("opens");
        assert!(matches!(DataDirectory::open(directory.path()), Err(DataError::InUse { .. })));
        assert!(is_locked(directory.path()).expect("told"));
        let kept_open = first.lock.try_clone().expect("cloned");
        drop(first);
        assert!(!is_locked(directory.path()).expect("told"));
        assert!(DataDirectory::open(directory.path()).is_ok());
        drop(kept_open);
        assert!(!is_locked(&directory.path().join("none")).expect("told"));
    }

    #[test]
    fn published_addresses_count_while_their_server_runs() {
        let directory = tempfile::tempdir().expect("temp dir");
        let found = || local_server::addresses(directory.path()).expect("told");
        let server = DataDirectory::open(directory.path()).expect("opens");
        assert_eq!(found(), None, "it does not listen yet");
        let (http, mqtt) = ("127.0.0.1:8081".to_owned(), "127.0.0.1:1884".to_owned());
        let addresses = Addresses { http, mqtt, ca_pin: Some(CaPin::of(b"an authority's key")) };
        server.publish(&addresses).expect("written");
        assert_eq!(found(), Some(addresses));
        drop(server);
        assert!(directory.path().join(ADDRESSES).exists() && found().is_none(), "it was killed");
        let _next = DataDirectory::open(directory.path()).expect("opens");
        assert_eq!(found(), None, "it does not listen yet");
    }

    #[test]
    fn lock_check_does_not_block_a_start() {
        let directory = tempfile::tempdir().expect("temp dir");
        let is_over = AtomicBool::new(false);
        std::thread::scope(|scope| {
            for _ in 0..2 {
                scope.spawn(|| {
                    while !is_over.load(Relaxed) {
                        is_locked(directory.path()).expect("told");
                    }
                });
            }
            let started = (0..1000).map(|_| DataDirectory::open(directory.path()).map(drop));
            let refused = started.filter(Result::is_err).count();
            is_over.store(true, Relaxed);
            assert_eq!(refused, 0);
        });
    }
}
