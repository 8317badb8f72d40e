//! The directory that a task runs in. The task owns this directory; the package's trees beside it
//! are read-only to the task. Links lead from here to those trees, so that a package finds its
//! files at their usual paths: `./start.sh` for a package without a build, `src/` and `install/`
//! for one that is built. Before each start every name of the package is restored. Files that the
//! task has written under other names stay.

use std::fs;
use std::io;
use std::os::unix::fs::{MetadataExt as _, symlink};
use std::path::{Path, PathBuf};

use task_proto::packages::manifest::BuildTool;

use crate::system::durable;
use crate::system::layout::VersionDir;
use crate::system::task_user::{MAX_DEPTH, TaskUser};

/// Names in a version's directory that no task wrote. All others are files that a task wrote there
/// when the version's directory was its working directory.
const OWN_NAMES: [&str; 10] = [
    "src",
    "build",
    "install",
    "log",
    "task.json",
    "run.sh",
    "build.sh",
    "built",
    "work",
    "node_logs",
];

/// Creates the directory if necessary, and the links in it. No process of the task may run.
pub fn refresh(tool: BuildTool, version: &VersionDir, user: Option<&TaskUser>) -> io::Result<()> {
    let work = version.work();
    durable::create_dir_all(&work)?;
    let link = || match tool {
        BuildTool::None => link_below(&version.src(), &work, 0),
        BuildTool::Colcon | BuildTool::Catkin => {
            [version.src(), version.install()].iter().try_for_each(|tree| match tree.file_name() {
                Some(name) => link_to(tree, &work.join(name)),
                None => Ok(()),
            })
        }
    };
    let Some(user) = user else { return link() };
    user.hand_over(&work)?;
    // A task controls the content of its directory, so the links are made with the task's rights
    // only.
    user.run_with_file_rights(link)?
}

/// Links every file in `from` to the same name in `to`. Directories are created, not linked, so
/// that a task may write into them.
fn link_below(from: &Path, to: &Path, depth: usize) -> io::Result<()> {
    if depth > MAX_DEPTH {
        return Err(io::Error::other(format!(
            "a directory lies more than {MAX_DEPTH} levels deep"
        )));
    }
    for entry in fs::read_dir(from)? {
        let entry = entry?;
        let place = to.join(entry.file_name());
        if !entry.file_type()?.is_dir() {
            link_to(&entry.path(), &place)?;
            continue;
        }
        if !fs::symlink_metadata(&place).is_ok_and(|about| about.is_dir()) {
            durable::remove_dir_all(&place)?;
            fs::create_dir(&place)?;
        }
        link_below(&entry.path(), &place, depth + 1)?;
    }
    Ok(())
}

fn link_to(target: &Path, place: &Path) -> io::Result<()> {
    if fs::read_link(place).is_ok_and(|found| found == target) {
        return Ok(());
    }
    durable::remove_dir_all(place)?;
    symlink(target, place)
}

/// When an earlier agent gave a version to the account of all tasks, at its first start. The
/// package was unpacked before this time, and files that the task wrote are younger.
pub fn handed_over(version: &VersionDir) -> io::Result<(i64, i64)> {
    let about = fs::symlink_metadata(version.manifest())?;
    Ok((about.ctime(), about.ctime_nsec()))
}

/// Moves files that a task has written since that time from the package's directory, its former
/// working directory, to its current one. Only the agent may have rights to the version by now;
/// otherwise the file that is checked may not be the file that is moved.
pub fn move_written(tool: BuildTool, version: &VersionDir, since: (i64, i64)) -> io::Result<()> {
    let mut found = Vec::new();
    if tool == BuildTool::None {
        find_newer(&version.src(), &version.work(), since, 0, &mut found)?;
    } else {
        for entry in fs::read_dir(version.root())? {
            let entry = entry?;
            if !OWN_NAMES.iter().any(|own| entry.file_name() == *own) {
                found.push((entry.path(), version.work().join(entry.file_name())));
            }
        }
    }
    for (from, to) in found {
        if let Some(parent) = to.parent() {
            durable::create_dir_all(parent)?;
        }
        // The file's owner changes together with its directory's.
        fs::rename(from, to)?;
    }
    Ok(())
}

fn find_newer(
    from: &Path,
    to: &Path,
    than: (i64, i64),
    depth: usize,
    found: &mut Vec<(PathBuf, PathBuf)>,
) -> io::Result<()> {
    if depth > MAX_DEPTH {
        return Err(io::Error::other(format!(
            "a directory lies more than {MAX_DEPTH} levels deep"
        )));
    }
    for entry in fs::read_dir(from)? {
        let (entry, about) =
            entry.and_then(|entry| entry.metadata().map(|about| (entry, about)))?;
        let place = to.join(entry.file_name());
        if about.is_dir() {
            find_newer(&entry.path(), &place, than, depth + 1, found)?;
        } else if (about.mtime(), about.mtime_nsec()) > than {
            found.push((entry.path(), place));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt as _;

    use task_proto::Digest;

    use super::*;
    use crate::system::layout::DataDir;

    fn version(root: &Path) -> VersionDir {
        let version =
            DataDir::new(root).expect("a directory").task(&"talker".parse().expect("valid"));
        let version = version.version(&Digest::of(b"manifest"));
        fs::create_dir_all(version.src().join("maps/old")).expect("made");
        fs::write(version.src().join("start.sh"), "start").expect("written");
        fs::write(version.src().join("maps/base.pgm"), "base").expect("written");
        symlink("start.sh", version.src().join("link")).expect("linked");
        version
    }

    #[test]
    fn refresh_restores_package_links_and_keeps_written_files() {
        let temp = tempfile::tempdir().expect("a directory");
        let version = version(temp.path());
        let work = version.work();
        refresh(BuildTool::None, &version, None).expect("made");
        assert_eq!(fs::read(work.join("start.sh")).expect("there"), b"start");
        assert_eq!(fs::read(work.join("link")).expect("there"), b"start");
        fs::write(work.join("maps/new.pgm"), "new").expect("written beside");
        fs::remove_file(work.join("start.sh")).expect("removed");
        fs::write(work.join("start.sh"), "another").expect("exchanged");
        fs::remove_dir_all(work.join("maps/old")).expect("removed");
        symlink("/etc", work.join("maps/old")).expect("exchanged");
        refresh(BuildTool::None, &version, None).expect("made again");
        assert_eq!(fs::read(work.join("start.sh")).expect("there"), b"start");
        assert_eq!(fs::read(work.join("maps/new.pgm")).expect("stays"), b"new");
        assert!(fs::symlink_metadata(work.join("maps/old")).expect("there").is_dir());
    }

    #[test]
    fn built_package_has_links_to_its_trees() {
        let temp = tempfile::tempdir().expect("a directory");
        let version = version(temp.path());
        fs::create_dir_all(version.install()).expect("made");
        refresh(BuildTool::Colcon, &version, None).expect("made");
        assert_eq!(
            fs::read_link(version.work().join("install")).expect("a link"),
            version.install()
        );
        assert_eq!(fs::read(version.work().join("src/start.sh")).expect("there"), b"start");
    }

    #[test]
    fn files_written_into_the_package_move_to_the_work_dir() {
        let temp = tempfile::tempdir().expect("a directory");
        let version = version(temp.path());
        // The manifest's owner changes at the first start, after the package was unpacked.
        fs::write(version.manifest(), "{}").expect("written");
        fs::set_permissions(version.manifest(), fs::Permissions::from_mode(0o644)).expect("set");
        let since = handed_over(&version).expect("there");
        let new = version.src().join("maps/new.pgm");
        // Two writes may get the same file timestamp.
        while fs::metadata(&new).map_or(true, |new| (new.mtime(), new.mtime_nsec()) <= since) {
            fs::write(&new, "new").expect("written");
        }
        move_written(BuildTool::None, &version, since).expect("moved");
        assert_eq!(fs::read(version.work().join("maps/new.pgm")).expect("moved"), b"new");
        assert!(!new.exists() && version.src().join("maps/base.pgm").exists());
        fs::create_dir(version.root().join("results")).expect("made");
        move_written(BuildTool::Colcon, &version, since).expect("moved");
        assert!(version.work().join("results").is_dir() && version.src().is_dir());
    }
}
