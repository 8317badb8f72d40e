//! The checks of `taskd doctor` that need the server's own code: its settings, the limit of open
//! files, its database and its ports. The database is opened only if no server runs.

use std::io;
use std::net::{SocketAddr, TcpListener};
use std::path::Path;

use nix::sys::resource::{Resource, getrlimit};
use task_cli::INTEGRITY_REMEDY;
use task_cli::local_server::is_locked;
use task_proto::checkup::Checkup;

use crate::config::{Config, ServeFlags};
use crate::net::open_files;
use crate::store::{check_at_rest, check_postgres, lock_holder};

/// Checks a server's settings for `data`, and the preconditions of a server there if none answers.
pub async fn check_server(checkup: &mut Checkup, data: &Path, is_up: bool) {
    let flags = ServeFlags { config: None, settings: vec![("data", data.display().to_string())] };
    match Config::load(&flags, std::env::vars_os()) {
        Ok(config) => {
            files(checkup, &config);
            if !is_up {
                database(checkup, data, &config).await;
                ports(checkup, data, &config);
            }
        }
        Err(error) => {
            checkup.bad("settings", error.to_string(), "correct the setting named in the message")
        }
    }
}

/// Whether a server could use its database: the structure of a SQLite file without a running server
/// is sound, or Postgres can be used and no other server holds its lock.
async fn database(checkup: &mut Checkup, data: &Path, config: &Config) {
    if let Some(servers) = config.postgres() {
        match check_postgres(servers).await {
            Ok(server) => {
                checkup.good("database", format!("{server} answers and takes writes"));
                lock(checkup, servers, config.standby).await;
            }
            Err(error) => checkup.bad(
                "database",
                format!("{:#}", anyhow::Error::from(error)),
                "start Postgres, promote a standby, or correct the setting `database`; see docs/server.md",
            ),
        }
        return;
    }
    let path = data.join("taskd.sqlite");
    if config.database.is_some() || !path.exists() || is_locked(data).is_ok_and(|is_up| is_up) {
        return;
    }
    match check_at_rest(&path).await {
        Ok(None) => checkup
            .good("integrity", format!("a quick check of {} found no problem", path.display())),
        Ok(Some(finding)) => {
            checkup.bad(
                "integrity",
                format!("{} is corrupt: {finding}", path.display()),
                INTEGRITY_REMEDY,
            );
        }
        Err(error) => checkup.bad(
            "integrity",
            format!("{} can't be checked: {:#}", path.display(), anyhow::Error::from(error)),
            "check the file system",
        ),
    }
}

async fn lock(checkup: &mut Checkup, url: &str, is_standby: bool) {
    match lock_holder(url).await {
        Ok(None) => {}
        Ok(Some(holder)) if is_standby => {
            checkup.good("lock", format!("{holder} uses the database; a standby would wait"));
        }
        Ok(Some(holder)) => checkup.notice(
            "lock",
            format!("{holder} uses the database"),
            "a second server is refused: set standby = true, or name another database",
        ),
        Err(error) => checkup.bad(
            "lock",
            format!("{:#}", anyhow::Error::from(error)),
            "check the log of the database server",
        ),
    }
}

fn files(checkup: &mut Checkup, config: &Config) {
    let Ok((_, most)) = getrlimit(Resource::RLIMIT_NOFILE) else { return };
    let (allowed, wanted) =
        (usize::try_from(most).unwrap_or(usize::MAX), open_files::files_needed(config));
    match open_files::check(config, allowed) {
        Err(too_few) => checkup.bad("files", too_few.to_string(), "raise the limit, or a server started from here will not start"),
        Ok(()) if allowed >= wanted => {
            checkup.good("files", format!("a server started from here may open {most} files"));
        }
        Ok(()) => checkup.notice(
            "files",
            format!("a server started from here may open {most} files, of up to {wanted} needed"),
            "raise the limit (LimitNOFILE= in the unit, ulimit -n here); otherwise it accepts fewer connections",
        ),
    }
}

/// Whether a server could bind its ports.
fn ports(checkup: &mut Checkup, data: &Path, config: &Config) {
    if is_locked(data).is_ok_and(|is_up| is_up) {
        return checkup.bad(
            "server",
            "a server is running on this directory but does not answer",
            "check its log and its addresses (addresses.json in the directory)",
        );
    }
    checkup.bad("server", "no server is running on this directory", "start it: taskd serve");
    let mut listeners = vec![("http", config.http)];
    if config.broker.is_none() {
        listeners.push(("mqtt", config.mqtt));
    }
    for (setting, address) in listeners {
        match try_bind(address) {
            Ok(()) => checkup.good("port", format!("{address} is free for --{setting}")),
            Err(error) => checkup.bad(
                "port",
                format!("{address} is not available for --{setting}: {error}"),
                "stop the program that uses it (ss -ltnp), or choose another address",
            ),
        }
    }
}

fn try_bind(address: SocketAddr) -> io::Result<()> {
    TcpListener::bind(address).map(drop)
}
