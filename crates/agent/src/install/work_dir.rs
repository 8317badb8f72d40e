//! The directory that a task runs in. It is the task's own, and beside the trees that are read-only
//! to it; links lead from here to them, so that a package finds its files where it had them:
//! `./start.sh` for one without a build, `src/` and `install/` for one that is built. Before each
//! start every name of the package is the package's again. What the task has written under other
//! names stays.

use std::fs;
use std::io;
use std::os::unix::fs::{MetadataExt as _, symlink};
use std::path::{Path, PathBuf};

use task_proto::manifest::BuildTool;

use crate::system::durable;
use crate::system::layout::VersionDir;
use crate::system::task_user::{MAX_DEPTH, TaskUser};

/// What lies in a version's directory that no task wrote: the rest is what it wrote there when that
/// was where it ran.
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

/// Makes the directory if need be, and the links in it. No process of the task may run.
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
    // What a task has put into its directory is worth as much as its own rights.
    user.with_its_rights(link)?
}

/// Links everything in `from` to the same name in `to`: its files, not its directories, so that a
/// task may write into these.
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

/// When a version was given to the account of all tasks, as an earlier agent did at its first
/// start: the package was unpacked before, and what the task wrote is younger.
pub fn handed_over(version: &VersionDir) -> io::Result<(i64, i64)> {
    let about = fs::symlink_metadata(version.manifest())?;
    Ok((about.ctime(), about.ctime_nsec()))
}

/// Moves what a task has written since to where it runs now; it ran where its package lay. Nobody
/// but the agent may have rights to the version any more, or what is looked at is not what is
/// moved.
pub fn move_written(tool: BuildTool, version: &VersionDir, since: (i64, i64)) -> io::Result<()> {
    let mut found = Vec::new();
    if tool == BuildTool::None {
        find_younger(&version.src(), &version.work(), since, 0, &mut found)?;
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
        // It changes hands with the directory that it is in.
        fs::rename(from, to)?;
    }
    Ok(())
}

fn find_younger(
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
            find_younger(&entry.path(), &place, than, depth + 1, found)?;
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
    fn names_of_the_package_are_its_own_again_and_what_was_written_beside_them_stays() {
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
    fn package_that_is_built_has_its_trees_by_their_names() {
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
    fn what_a_task_wrote_into_its_package_moves_to_where_it_runs() {
        let temp = tempfile::tempdir().expect("a directory");
        let version = version(temp.path());
        // The manifest changes hands at the first start, after the package came.
        fs::write(version.manifest(), "{}").expect("written");
        fs::set_permissions(version.manifest(), fs::Permissions::from_mode(0o644)).expect("set");
        let since = handed_over(&version).expect("there");
        let new = version.src().join("maps/new.pgm");
        // The clock of files does not tick at each write.
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
