//! `taskd login` and `taskd logout`: exchanges name and password for a token, which is kept in a file of its owner's, by
//! server, until it is signed out or ends.

use std::collections::BTreeMap;
use std::fs::{DirBuilder, OpenOptions};
use std::io::{self, Write as _};
use std::os::unix::fs::{DirBuilderExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::Args;
use serde::{Deserialize, Serialize};
use task_proto::api::{AccessToken, LogIn};
use task_proto::token::Token;
use task_proto::{CaPin, UserName};

use super::client::Client;
use super::output::{say, time};
use super::password;
use super::user::PasswordFrom;
use super::{CommandError, Connection, Outcome};
use crate::config::lifetime;

/// Who signs in.
#[derive(Debug, Args)]
pub struct LoginOrder {
    /// The user's name
    user: UserName,
    /// How long to stay signed in, like 12h [default: 30d, which is also the most]
    #[arg(long, value_name = "TIME", value_parser = lifetime)]
    ttl: Option<Duration>,
    #[command(flatten)]
    from: PasswordFrom,
}

pub(super) async fn log_in(connection: &Connection, order: LoginOrder) -> Result<Outcome, CommandError> {
    let client = Client::anonymous(connection)?;
    let path = path().ok_or_else(|| CommandError::Usage("neither XDG_CONFIG_HOME nor HOME is set".to_owned()))?;
    let password = password::ask(order.from.password_stdin, &format!("password of {}", order.user))?.reveal();
    let request = LogIn { user: order.user, password, ttl_s: order.ttl.map(|ttl| ttl.as_secs()) };
    let token: AccessToken = client.once("/login", &request).await?;
    let mut kept = Kept::read(&path)?;
    kept.servers.insert(client.base().to_owned(), token.token);
    kept.last = Some(client.base().to_owned());
    if let Some(pin) = connection.pin {
        kept.pins.insert(client.base().to_owned(), pin);
    }
    kept.write(&path)?;
    say(&format!("signed in at {} as {} until {}", client.base(), token.user, time(token.expires_at_ms)));
    Ok(Outcome::Succeeded)
}

pub(super) async fn log_out(connection: &Connection) -> Result<Outcome, CommandError> {
    let client = Client::anonymous(connection)?;
    let base = client.base().to_owned();
    let unknown = || CommandError::Usage(format!("you are not signed in at {base}"));
    let path = path().ok_or_else(unknown)?;
    let token = Kept::read(&path)?.servers.remove(&base).ok_or_else(unknown)?;
    // It may have ended by itself, which comes to the same. One that the server may still take is not forgotten.
    match client.with_token(&token)?.delete("/session").await {
        Err(error) if error.outcome() != Outcome::NotAllowed => return Err(error.into()),
        _ => {}
    }
    let mut kept = Kept::read(&path)?;
    kept.servers.remove(&base);
    kept.last.take_if(|last| *last == base);
    kept.write(&path)?;
    say(&format!("signed out at {base}"));
    Ok(Outcome::Succeeded)
}

/// The token that is kept for the server at `base`.
pub(super) fn kept_token(base: &str) -> Option<Token> {
    Kept::read(&path()?).ok()?.servers.remove(base)?.parse().ok()
}

/// The pin that was given when somebody signed in to the server at `base`.
pub(super) fn kept_pin(base: &str) -> Option<CaPin> {
    Kept::read(&path()?).ok()?.pins.remove(base)
}

/// The server that was signed in to last, unless it was signed out of.
pub(super) fn last_server() -> Option<String> {
    Kept::read(&path()?).ok()?.last
}

/// `credentials.json`: tokens by the server's URL.
#[derive(Default, Serialize, Deserialize)]
struct Kept {
    servers: BTreeMap<String, String>,
    /// The pins that were given with them.
    #[serde(default)]
    pins: BTreeMap<String, CaPin>,
    /// The server that is meant where none is named.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    last: Option<String>,
}

fn path() -> Option<PathBuf> {
    let set = |name| std::env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from);
    let base = set("XDG_CONFIG_HOME").or_else(|| set("HOME").map(|home| home.join(".config")))?;
    Some(base.join("taskd/credentials.json"))
}

impl Kept {
    fn read(path: &Path) -> Result<Self, CommandError> {
        let failed = |source| CommandError::Io { what: format!("can't read {}", path.display()), source };
        match std::fs::read(path) {
            Ok(bytes) => serde_json::from_slice(&bytes).map_err(|error| failed(error.into())),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(Self::default()),
            Err(error) => Err(failed(error)),
        }
    }

    /// Only its owner may read it; it is there whole or not at all.
    fn write(&self, path: &Path) -> Result<(), CommandError> {
        let written = || {
            let directory = path.parent().unwrap_or(Path::new("."));
            DirBuilder::new().recursive(true).mode(0o700).create(directory)?;
            let partial = path.with_extension(format!("{:08x}", rand::random::<u32>()));
            let mut file = OpenOptions::new().create_new(true).write(true).mode(0o600).open(&partial)?;
            file.write_all(&serde_json::to_vec_pretty(self)?)?;
            file.sync_all()?;
            std::fs::rename(&partial, path)
        };
        written().map_err(|source| CommandError::Io { what: format!("can't write {}", path.display()), source })
    }
}
