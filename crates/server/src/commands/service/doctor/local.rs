//! The checks of `taskd doctor` on the machine of the server: its directory, the disk, the limit of
//! open files, its settings and its ports. No secret is opened. The database is opened only if no
//! server runs, for a check.

use std::io;
use std::net::{SocketAddr, TcpListener};
use std::os::unix::fs::MetadataExt as _;
use std::path::Path;

use nix::sys::resource::{Resource, getrlimit};
use nix::sys::statvfs::statvfs;
use nix::unistd::{AccessFlags, access, geteuid};
use task_proto::checkup::Checkup;

use super::INTEGRITY_MEND;
use crate::commands::display::output::bytes;
use crate::config::{Config, ServeFlags};
use crate::net::open_files;
use crate::store::check_at_rest;
use crate::system::data_directory::is_locked;

/// Below this free space the database may be unable to grow.
const LOW_BYTES: u64 = 256 << 20;
/// Below this share of free space the operator should act.
const LOW_PERCENT: u64 = 10;

/// Checks `data`, and the preconditions of a server there if none answers.
pub(in crate::commands) async fn check(checkup: &mut Checkup, data: &Path, is_up: bool) {
    if let Some(owner) = anothers(data) {
        return checkup.notice(
            "data",
            format!("{} is user {owner}'s, and this account must not look into it", data.display()),
            "run taskd doctor as that user to have the directory, the disk and the limits looked at",
        );
    }
    directory(checkup, data);
    disk(checkup, data);
    let flags = ServeFlags { config: None, settings: vec![("data", data.display().to_string())] };
    match Config::load(&flags, std::env::vars_os()) {
        Ok(config) => {
            files(checkup, &config);
            if !is_up {
                database(checkup, data, &config).await;
                ports(checkup, data, &config);
            }
        }
        Err(error) => checkup.bad("settings", error.to_string(), "mend the setting that it names"),
    }
}

/// The owner of the directory, if the directory belongs to another account and is closed to this
/// one.
fn anothers(data: &Path) -> Option<u32> {
    let owner = std::fs::metadata(data).ok()?.uid();
    let is_closed = access(data, AccessFlags::R_OK | AccessFlags::X_OK).is_err();
    (is_closed && owner != geteuid().as_raw()).then_some(owner)
}

fn directory(checkup: &mut Checkup, data: &Path) {
    let writable = AccessFlags::R_OK | AccessFlags::W_OK | AccessFlags::X_OK;
    let mut parts = vec![data.to_owned()];
    parts.extend(
        ["taskd.sqlite", "taskd.sqlite-wal", "blobs"]
            .map(|part| data.join(part))
            .into_iter()
            .filter(|part| part.exists()),
    );
    match parts.iter().find_map(|part| {
        let flags = if part.is_dir() { writable } else { AccessFlags::R_OK | AccessFlags::W_OK };
        access(part, flags).err().map(|error| (part, io::Error::from(error)))
    }) {
        None => checkup.good("data", format!("{} can be written", data.display())),
        Some((part, error)) => checkup.bad(
            "data",
            format!("{}: {error}", part.display()),
            "serve as the directory's owner, or give it to the account that serves (chown -R)",
        ),
    }
}

/// Whether the structure of a SQLite file without a running server is sound.
async fn database(checkup: &mut Checkup, data: &Path, config: &Config) {
    let path = data.join("taskd.sqlite");
    if config.database.is_some() || !path.exists() || is_locked(data).is_ok_and(|is_up| is_up) {
        return;
    }
    match check_at_rest(&path).await {
        Ok(None) => checkup
            .good("integrity", format!("a quick check of {} found nothing wrong", path.display())),
        Ok(Some(finding)) => {
            checkup.bad(
                "integrity",
                format!("{} is corrupt: {finding}", path.display()),
                INTEGRITY_MEND,
            );
        }
        Err(error) => checkup.bad(
            "integrity",
            format!("{} can't be checked: {:#}", path.display(), anyhow::Error::from(error)),
            "look at the file system",
        ),
    }
}

fn disk(checkup: &mut Checkup, data: &Path) {
    let room = match statvfs(data) {
        Ok(room) => room,
        Err(error) => {
            return checkup.bad(
                "space",
                format!("{}: {}", data.display(), error.desc()),
                "look at the file system",
            );
        }
    };
    let size = room.fragment_size();
    let (free, total) = (room.blocks_available() * size, room.blocks() * size);
    let found = format!("{} of {} free", bytes(free), bytes(total));
    let mend = "delete versions of packages that no robot needs (taskd package rm), or give the directory a larger disk";
    match (free < LOW_BYTES, free < total / 100 * LOW_PERCENT) {
        (true, _) => checkup.bad("space", found, mend),
        (false, true) => checkup.notice("space", found, mend),
        (false, false) => checkup.good("space", found),
    }
}

fn files(checkup: &mut Checkup, config: &Config) {
    let Ok((_, most)) = getrlimit(Resource::RLIMIT_NOFILE) else { return };
    let (allowed, wanted) =
        (usize::try_from(most).unwrap_or(usize::MAX), open_files::wanted(config));
    match open_files::check(config, allowed) {
        Err(too_few) => checkup.bad("files", too_few.to_string(), "a server started from here would not start"),
        Ok(()) if allowed >= wanted => {
            checkup.good("files", format!("a server started from here may have {most} files open"));
        }
        Ok(()) => checkup.notice(
            "files",
            format!("a server started from here may have {most} files open, for up to {wanted} connections and files"),
            "raise the limit (LimitNOFILE= in its unit, ulimit -n here), or it takes fewer connections",
        ),
    }
}

/// Whether a server could bind its ports.
fn ports(checkup: &mut Checkup, data: &Path, config: &Config) {
    if is_locked(data).is_ok_and(|is_up| is_up) {
        return checkup.bad(
            "server",
            "one runs from this directory and does not answer",
            "look at its log and at its addresses (addresses.json in the directory)",
        );
    }
    checkup.bad("server", "none runs from this directory", "start it: taskd serve");
    let mut listeners = vec![("http", config.http)];
    if config.broker.is_none() {
        listeners.push(("mqtt", config.mqtt));
    }
    for (setting, address) in listeners {
        match bound(address) {
            Ok(()) => checkup.good("port", format!("{address} is free for --{setting}")),
            Err(error) => checkup.bad(
                "port",
                format!("{address} can't be had for --{setting}: {error}"),
                "end the program that has it (ss -ltnp), or give the server another address",
            ),
        }
    }
}

fn bound(address: SocketAddr) -> io::Result<()> {
    TcpListener::bind(address).map(drop)
}
