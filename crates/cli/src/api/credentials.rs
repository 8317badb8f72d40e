//! Credentials of `taskd login`, in a file that only its owner may read, by server. The credentials
//! are created and ended elsewhere.

use std::collections::BTreeMap;
use std::fs::{DirBuilder, OpenOptions};
use std::io::{self, Write as _};
use std::os::unix::fs::{DirBuilderExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use task_proto::CaPin;
use task_proto::trust::token::Token;

use crate::CommandError;

/// The stored token for the server at `base`.
pub(crate) fn stored_token(base: &str) -> Option<Token> {
    StoredCredentials::read(&path()?).ok()?.servers.remove(base)?.parse().ok()
}

/// The pin from the login to the server at `base`.
pub(crate) fn stored_pin(base: &str) -> Option<CaPin> {
    StoredCredentials::read(&path()?).ok()?.pins.remove(base)
}

/// The server of the last login, unless that login was signed out.
pub(crate) fn last_server() -> Option<String> {
    StoredCredentials::read(&path()?).ok()?.last
}

/// `credentials.json`: tokens by the server's URL.
#[derive(Default, Serialize, Deserialize)]
pub(crate) struct StoredCredentials {
    pub(crate) servers: BTreeMap<String, String>,
    /// The pins that were given with them.
    #[serde(default)]
    pub(crate) pins: BTreeMap<String, CaPin>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) last: Option<String>,
}

/// Path of the credentials file, if the environment defines one.
pub(crate) fn path() -> Option<PathBuf> {
    let set = |name| std::env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from);
    let base = set("XDG_CONFIG_HOME").or_else(|| set("HOME").map(|home| home.join(".config")))?;
    Some(base.join("taskd/credentials.json"))
}

impl StoredCredentials {
    /// The stored credentials; empty if there is no file yet.
    pub(crate) fn read(path: &Path) -> Result<Self, CommandError> {
        let failed =
            |source| CommandError::Io { what: format!("can't read {}", path.display()), source };
        match std::fs::read(path) {
            Ok(bytes) => serde_json::from_slice(&bytes).map_err(|error| failed(error.into())),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(Self::default()),
            Err(error) => Err(failed(error)),
        }
    }

    /// The file is readable by its owner only, and written atomically.
    pub(crate) fn write(&self, path: &Path) -> Result<(), CommandError> {
        let written = || {
            let directory = path.parent().unwrap_or(Path::new("."));
            DirBuilder::new().recursive(true).mode(0o700).create(directory)?;
            let partial = path.with_extension(format!("{:08x}", rand::random::<u32>()));
            let mut file =
                OpenOptions::new().create_new(true).write(true).mode(0o600).open(&partial)?;
            file.write_all(&serde_json::to_vec_pretty(self)?)?;
            file.sync_all()?;
            std::fs::rename(&partial, path)
        };
        written().map_err(|source| CommandError::Io {
            what: format!("can't write {}", path.display()),
            source,
        })
    }
}
