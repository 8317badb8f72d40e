//! Downloads a blob into a file that is complete and verified, or absent.

use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;
use std::time::Duration;

use reqwest::Method;
use sha2::{Digest as _, Sha256};
use task_proto::Digest;
use tempfile::NamedTempFile;
use tokio::io::AsyncWriteExt as _;
use tokio::time::timeout;

use crate::{CommandError, Session};

/// The longest pause of the server in the middle of a file.
const IDLE_TIMEOUT: Duration = Duration::from_secs(60);
/// Time limit for one file.
const TOTAL_TIMEOUT: Duration = Duration::from_secs(24 * 60 * 60);

/// The bytes at `url` in a new file in `directory`, which is deleted with its handle unless the
/// file is persisted.
pub(crate) async fn download(
    session: &Session,
    url: &str,
    digest: Digest,
    directory: &Path,
) -> Result<NamedTempFile, CommandError> {
    let failed = |source| CommandError::Io {
        what: format!("can't write to {}", directory.display()),
        source,
    };
    // The permissions of a normal new file of this user, once the file is complete.
    let readable = std::fs::Permissions::from_mode(0o666);
    let file =
        tempfile::Builder::new().permissions(readable).tempfile_in(directory).map_err(failed)?;
    let mut writer = tokio::fs::File::from_std(file.reopen().map_err(failed)?);
    // A large file may take long, as long as the transfer makes progress.
    let mut response = session
        .client
        .send(|| session.client.request(Method::GET, url).timeout(TOTAL_TIMEOUT))
        .await?;
    let mut hash = Sha256::new();
    loop {
        let chunk = timeout(IDLE_TIMEOUT, response.chunk()).await;
        let chunk =
            chunk.map_err(|_| failed(std::io::Error::other("the server stopped sending")))?;
        let Some(chunk) = chunk.map_err(|source| session.client.unreachable(source))? else {
            break;
        };
        hash.update(&chunk);
        writer.write_all(&chunk).await.map_err(failed)?;
    }
    writer.flush().await.map_err(failed)?;
    let got = Digest::from_sha256(hash.finalize().into());
    if got != digest {
        return Err(failed(std::io::Error::other(format!(
            "digest mismatch: expected {digest}, got {got}"
        ))));
    }
    Ok(file)
}

/// Moves the downloaded file to its place, replacing an existing file.
pub(crate) fn put(file: NamedTempFile, path: &Path) -> Result<(), CommandError> {
    let failed =
        |source| CommandError::Io { what: format!("can't write {}", path.display()), source };
    file.persist(path).map(drop).map_err(|error| failed(error.error))
}
