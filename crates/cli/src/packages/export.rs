//! `taskd package export`: a package's files out of the store. The bytes are verified by their
//! digest before anything is unpacked, as strictly as on a robot, and every exported file is
//! complete.

use std::fs::File;
use std::io::{self, Read as _};
use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;

use task_archive::{Limits, unpack};
use task_proto::api::PackageView;

use crate::api::download::{download, put};
use crate::display::output::say;
use crate::{CommandError, Session};

/// Writes the package to `to`: an archive by its ending, else a directory.
pub(crate) async fn export(
    session: &Session,
    view: &PackageView,
    to: &Path,
) -> Result<(), CommandError> {
    let package = &view.package;
    let failed =
        |source| CommandError::Io { what: format!("can't write {}", to.display()), source };
    let ending =
        |end: &str| to.file_name().is_some_and(|name| name.to_string_lossy().ends_with(end));
    let (is_tar, is_compressed) = (ending(".tar"), ending(".tar.zst"));
    let is_taken = to.exists() && !to.read_dir().is_ok_and(|mut entries| entries.next().is_none());
    if !is_tar && !is_compressed && is_taken {
        return Err(CommandError::Usage(format!(
            "{} already exists and is not empty",
            to.display()
        )));
    }
    let parent = to
        .parent()
        .filter(|parent| !parent.as_os_str().is_empty())
        .unwrap_or(Path::new("."))
        .to_owned();
    std::fs::create_dir_all(&parent).map_err(failed)?;
    let url = format!("/v2/{}/blobs/{}", package.name, package.content.digest);
    let content = download(session, &url, package.content.digest, &parent).await?;
    if is_compressed {
        put(content, to)?;
    } else {
        let (view, to) = (view.clone(), to.to_owned());
        let unpacking = tokio::task::spawn_blocking(move || match is_tar {
            true => write_tar(content.reopen()?, &view, &parent, &to),
            false => write_tree(content.reopen()?, &view, &parent, &to),
        });
        unpacking.await.map_err(io::Error::other).and_then(|outcome| outcome).map_err(failed)?;
    }
    say(&format!("exported {} {} to {}", package.name, package.version, to.display()));
    Ok(())
}

fn write_tar(content: File, view: &PackageView, parent: &Path, to: &Path) -> io::Result<()> {
    let readable = std::fs::Permissions::from_mode(0o666);
    let mut file = tempfile::Builder::new().permissions(readable).tempfile_in(parent)?;
    // Reads no more than the announced size.
    io::copy(&mut zstd::Decoder::new(content)?.take(view.manifest.content.tar_size), &mut file)?;
    file.persist(to).map(drop).map_err(|error| error.error)
}

fn write_tree(mut content: File, view: &PackageView, parent: &Path, to: &Path) -> io::Result<()> {
    let beside = tempfile::Builder::new().prefix(".taskd-").tempdir_in(parent)?;
    let tree = beside.path().join("package");
    let facts = &view.manifest.content;
    unpack(&mut content, view.package.content.size, facts, &Limits::default(), &tree)
        .map_err(io::Error::other)?;
    // Replaces an empty directory, or creates a new one.
    std::fs::rename(&tree, to)
}
