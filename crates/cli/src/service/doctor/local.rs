//! The checks of `taskd doctor` on the machine of the server that need nothing of a server: its
//! directory and the disk. No file is opened.

use std::io;
use std::os::unix::fs::MetadataExt as _;
use std::path::Path;

use nix::sys::statvfs::statvfs;
use nix::unistd::{AccessFlags, access, geteuid};
use task_proto::checkup::Checkup;
use task_proto::size::format_bytes;

/// Below this free space the database may be unable to grow.
const LOW_BYTES: u64 = 256 << 20;
/// Below this share of free space the operator should act.
const LOW_PERCENT: u64 = 10;

/// Checks `data` and its disk. False if the directory is another account's, so that no further check
/// of a server there makes sense.
pub(crate) fn check(checkup: &mut Checkup, data: &Path) -> bool {
    if let Some(owner) = foreign_owner(data) {
        checkup.notice(
            "data",
            format!(
                "{} belongs to user {owner} and is not readable by this account",
                data.display()
            ),
            "run taskd doctor as that user to check the directory, the disk and the limits",
        );
        return false;
    }
    directory(checkup, data);
    disk(checkup, data);
    true
}

/// The owner of the directory, if the directory belongs to another account and is closed to this
/// one.
fn foreign_owner(data: &Path) -> Option<u32> {
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
        None => checkup.good("data", format!("{} is writable", data.display())),
        Some((part, error)) => checkup.bad(
            "data",
            format!("{}: {error}", part.display()),
            "run taskd serve as the directory's owner, or change the owner (chown -R)",
        ),
    }
}

fn disk(checkup: &mut Checkup, data: &Path) {
    let space = match statvfs(data) {
        Ok(space) => space,
        Err(error) => {
            return checkup.bad(
                "space",
                format!("{}: {}", data.display(), error.desc()),
                "check the file system",
            );
        }
    };
    let size = space.fragment_size();
    let (free, total) = (space.blocks_available() * size, space.blocks() * size);
    let found = format!("{} of {} free", format_bytes(free), format_bytes(total));
    let remedy = "delete package versions that no robot uses (taskd package rm), or move the directory to a larger disk";
    match (free < LOW_BYTES, free < total / 100 * LOW_PERCENT) {
        (true, _) => checkup.bad("space", found, remedy),
        (false, true) => checkup.notice("space", found, remedy),
        (false, false) => checkup.good("space", found),
    }
}
