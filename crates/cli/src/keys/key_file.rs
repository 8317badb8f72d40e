//! A publisher's key pair on disk: a private file readable by its owner only, and beside it a
//! public file. The server never sees the private file.

use std::fs::{File, OpenOptions};
use std::io::{self, Read as _, Write as _};
use std::os::unix::fs::{MetadataExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};

use task_proto::ids::digest::{hex, unhex};
use task_proto::trust::envelope::{PublicKey, SigningKey};

/// First bytes of a private key file, so that secret scanners find the file.
const PRIVATE: &str = "taskd-private-key ed25519 ";
/// More than either file has.
const MAX_BYTES: u64 = 4096;

/// Why a key can't be used.
#[derive(Debug, thiserror::Error)]
pub enum KeyError {
    /// The file can't be created or read.
    #[error("{} can't be used", path.display())]
    Io { path: PathBuf, source: io::Error },
    /// Accounts other than its owner can read or write a private key.
    #[error("{} has mode {mode:03o}: a private key must be readable by its owner only (chmod 600)", path.display())]
    Exposed { path: PathBuf, mode: u32 },
    /// The file is not a private key.
    #[error("{} does not contain a private key; create one with taskd key new", path.display())]
    NotPrivate { path: PathBuf },
    /// Neither a public key nor a file with a public key.
    #[error("{0:?} is neither a public key nor a file that contains one")]
    NotPublic(String),
}

/// Creates a key: the private half at `path`, the public half at `path` and `.pub`. Existing files
/// are never replaced.
pub fn create(path: &Path) -> Result<PublicKey, KeyError> {
    let key = SigningKey::random();
    let private = format!("{PRIVATE}{}\n", hex(&key.to_bytes()));
    let public = key.public_key();
    write_new(path, &private, 0o600)?;
    let written = write_new(&public_path(path), &format!("{public}\n"), 0o644);
    if written.is_err() {
        // Half a key pair is of no use, and nothing uses the key yet.
        let _ = std::fs::remove_file(path);
    }
    written.map(|()| public)
}

/// The private key in a file that is its owner's alone.
pub fn read(path: &Path) -> Result<SigningKey, KeyError> {
    let failed = |source| KeyError::Io { path: path.to_owned(), source };
    let file = File::open(path).map_err(failed)?;
    let mode = file.metadata().map_err(failed)?.mode() & 0o777;
    let mut text = String::new();
    file.take(MAX_BYTES).read_to_string(&mut text).map_err(failed)?;
    let seed = text.strip_prefix(PRIVATE).and_then(|digits| unhex(digits.trim()));
    let seed = seed.ok_or_else(|| KeyError::NotPrivate { path: path.to_owned() })?;
    if mode & 0o077 != 0 {
        return Err(KeyError::Exposed { path: path.to_owned(), mode });
    }
    Ok(SigningKey::from_bytes(seed))
}

/// A public key from an argument: the key's text, a file with the key, or the private key beside
/// such a file.
pub fn public(text: &str) -> Result<PublicKey, KeyError> {
    let from_file = |path: &Path| {
        let mut text = String::new();
        File::open(path).ok()?.take(MAX_BYTES).read_to_string(&mut text).ok()?;
        text.trim().parse().ok()
    };
    let path = Path::new(text);
    let key = text
        .trim()
        .parse()
        .ok()
        .or_else(|| from_file(path))
        .or_else(|| from_file(&public_path(path)));
    key.ok_or_else(|| KeyError::NotPublic(text.chars().take(80).collect()))
}

/// The file with the public half.
pub fn public_path(path: &Path) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".pub");
    name.into()
}

fn write_new(path: &Path, text: &str, mode: u32) -> Result<(), KeyError> {
    let write = || {
        let mut file = OpenOptions::new().create_new(true).write(true).mode(mode).open(path)?;
        file.write_all(text.as_bytes())?;
        file.sync_all()
    };
    write().map_err(|source| KeyError::Io { path: path.to_owned(), source })
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt as _;

    use super::*;

    #[test]
    fn key_file_is_private_and_reads_back() {
        let dir = tempfile::tempdir().expect("temp dir");
        let path = dir.path().join("ada.key");
        let made = create(&path).expect("made");
        assert_eq!(read(&path).expect("read").public_key(), made);
        let mode =
            |path: &Path| std::fs::metadata(path).expect("there").permissions().mode() & 0o777;
        assert_eq!(mode(&path), 0o600);
        for named in
            [made.to_string(), path.display().to_string(), format!("{}.pub", path.display())]
        {
            assert_eq!(public(&named).expect("named"), made, "{named}");
        }
        assert!(matches!(create(&path), Err(KeyError::Io { .. })), "a key is never replaced");
        assert!(matches!(read(&public_path(&path)), Err(KeyError::NotPrivate { .. })));
        assert_eq!(read(&path).expect("read").public_key(), made);
        for open in [0o640, 0o604, 0o620] {
            std::fs::set_permissions(&path, std::fs::Permissions::from_mode(open)).expect("set");
            assert!(matches!(read(&path), Err(KeyError::Exposed { .. })), "{open:o}");
        }
    }

    #[test]
    fn invalid_key_error_does_not_repeat_the_content() {
        let dir = tempfile::tempdir().expect("temp dir");
        let path = dir.path().join("other");
        write_new(&path, "a secret of another kind", 0o600).expect("written");
        let error = read(&path).err().expect("refused").to_string();
        assert!(
            error.contains("does not contain a private key") && !error.contains("secret"),
            "{error}"
        );
        let named = path.display().to_string();
        assert_eq!(
            public(&named).expect_err("refused").to_string(),
            format!("{named:?} is neither a public key nor a file that contains one")
        );
    }
}
