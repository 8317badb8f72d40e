//! Paths in the agent's data directory:
//!
//! ```text
//! identity.json                     the identity of this robot (0600)
//! ledger.json                       the orders, and the progress of each
//! publishers.json                   the accepted list of publishers, if the server has one
//! blobs/sha256/<hex>.part           bytes of a package's content that have arrived so far
//! blobs/sha256/<hex>.parts          the same for parts, which arrive in any order: a file with holes
//! blobs/sha256/<hex>.parts-note     list of the parts on the disk
//! accounts.json                     account of each task
//! staging/                          trees being unpacked; emptied at every start
//! survey/                           script of the last probe of the ROS installations
//! logs/                             messages of nodes that belong to no task
//! tasks/<name>/current              link to the active version
//! tasks/<name>/run/                 the shim's files: pid, exit status
//! tasks/<name>/logs/                output of the task, its build and its nodes
//! tasks/<name>/home/                home directory of the task, if it has an account of its own
//! tasks/<name>/build_home/          home directory of its builds
//! tasks/<name>/uploads.json         uploads under way
//! tasks/<name>/<hex>.signatures     publishers' signatures of a version, out of the task's reach
//! tasks/<name>/<hex>.seal           digests of the unpacked and built files of a version
//! tasks/<name>/<hex>/               one version, by the digest of its OCI manifest
//!   task.json                       the task manifest, byte for byte as it was pulled
//!   src/  build/  install/  run.sh  read-only to the task
//!   work/                           the directory that the task runs in
//!   node_logs/                      log files of its nodes
//! ```
//!
//! This module owns the names and the rules for cleaning up. The contents of the files belong to
//! the modules that write them.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use task_proto::{Digest, TaskName};

use crate::system::durable;

/// The flag file by which `hold` and `release` communicate with the agent.
pub const HOLD_FILE: &str = "hold";

/// Name prefix of a directory while it is being removed; no task or version can have such a name.
/// If a directory were removed in place, a power cut would leave a partial tree where a whole one
/// is expected.
const REMOVED: &str = ".removed-";
/// Suffix of the file with a version's signatures, after the version's name.
const SIGNATURES: &str = ".signatures";
/// Suffix of the file with the digests of a version's unpacked and built files.
const SEAL: &str = ".seal";

/// The agent's data directory.
#[derive(Debug, Clone)]
pub struct DataDir {
    root: PathBuf,
}

/// Files and directories of one task.
#[derive(Debug, Clone)]
pub struct TaskDir {
    root: PathBuf,
}

/// Files and directories of one version of a task.
#[derive(Debug, Clone)]
pub struct VersionDir {
    root: PathBuf,
}

impl DataDir {
    /// The directory at `root`, which is made absolute; nothing is created yet.
    pub fn new(root: &Path) -> io::Result<Self> {
        Ok(Self { root: std::path::absolute(root)? })
    }

    pub fn root(&self) -> &Path {
        &self.root
    }

    /// File with the robot's identity.
    pub fn identity(&self) -> PathBuf {
        self.root.join("identity.json")
    }

    /// File with the agent's state of its tasks.
    pub fn ledger(&self) -> PathBuf {
        self.root.join("ledger.json")
    }

    /// File with the list of publishers that the agent obeys.
    pub fn publishers(&self) -> PathBuf {
        self.root.join("publishers.json")
    }

    /// File with the account of each task.
    pub fn accounts(&self) -> PathBuf {
        self.root.join("accounts.json")
    }

    /// File that collects a blob's bytes while they are being pulled.
    pub fn blob_part(&self, digest: &Digest) -> PathBuf {
        self.blobs().join(format!("{}.part", digest.hex()))
    }

    /// File that collects a blob's bytes while they are pushed in parts.
    pub fn blob_parts(&self, digest: &Digest) -> PathBuf {
        self.blobs().join(format!("{}.parts", digest.hex()))
    }

    /// File that records which of those parts are on the disk.
    pub fn blob_parts_note(&self, digest: &Digest) -> PathBuf {
        self.blobs().join(format!("{}.parts-note", digest.hex()))
    }

    /// Directory where trees are unpacked before they are renamed into place.
    pub fn staging(&self) -> PathBuf {
        self.root.join("staging")
    }

    /// Log of the messages on ROS topics from nodes that belong to no task.
    pub fn ros_log(&self) -> PathBuf {
        self.root.join("logs").join("ros.log")
    }

    pub fn task(&self, name: &TaskName) -> TaskDir {
        TaskDir { root: self.tasks().join(name.as_str()) }
    }

    /// The directories that lead to a task's files.
    pub fn path_dirs(&self, name: &TaskName) -> [PathBuf; 3] {
        [self.root.clone(), self.tasks(), self.task(name).root]
    }

    /// Removes partial work of an agent that died: partly unpacked or partly removed trees. Call it
    /// only at start: a pull in progress would lose its tree. An entry that can't be removed does
    /// not stop the removal of the others.
    pub fn clean_leftovers(&self) -> io::Result<()> {
        let tasks = entries(&self.tasks())?;
        let mut outcomes = vec![durable::remove_dir_all(&self.staging()), remove_marked(&tasks)];
        outcomes.extend(
            tasks.iter().filter(|path| path.is_dir()).map(|task| remove_marked(&entries(task)?)),
        );
        outcomes.into_iter().collect()
    }

    /// Removes all partial blobs except those of the blobs in `wanted`.
    pub fn clean_parts(&self, wanted: &[Digest]) -> io::Result<()> {
        let of_blob = |digest| {
            [self.blob_part(digest), self.blob_parts(digest), self.blob_parts_note(digest)]
        };
        let keep: Vec<PathBuf> = wanted.iter().flat_map(of_blob).collect();
        for path in entries(&self.blobs())? {
            if !keep.contains(&path) {
                durable::remove_file(&path)?;
            }
        }
        Ok(())
    }

    /// The names of all tasks that have a directory.
    pub fn task_names(&self) -> io::Result<Vec<TaskName>> {
        Ok(entries(&self.tasks())?
            .iter()
            .filter_map(|path| file_name(path)?.parse().ok())
            .collect())
    }

    fn blobs(&self) -> PathBuf {
        self.root.join("blobs").join("sha256")
    }

    fn tasks(&self) -> PathBuf {
        self.root.join("tasks")
    }
}

impl TaskDir {
    pub fn root(&self) -> &Path {
        &self.root
    }

    pub fn run(&self) -> PathBuf {
        self.root.join("run")
    }

    /// Directory of all logs of the task.
    pub fn logs(&self) -> PathBuf {
        self.root.join("logs")
    }

    /// Log of the task's output.
    pub fn output_log(&self) -> PathBuf {
        self.logs().join("task.log")
    }

    /// Log of the messages of the task's nodes on ROS topics.
    pub fn ros_log(&self) -> PathBuf {
        self.logs().join("ros.log")
    }

    /// Log of the last build's output.
    pub fn build_log(&self) -> PathBuf {
        self.logs().join("build.log")
    }

    /// The home directory of the user that the task runs as.
    pub fn home(&self) -> PathBuf {
        self.root.join("home")
    }

    /// The home directory of its builds.
    pub fn build_home(&self) -> PathBuf {
        self.root.join("build_home")
    }

    /// File with the output uploads that are under way. The task has no access, because the file
    /// names the destination of the robot's token.
    pub fn uploads(&self) -> PathBuf {
        self.root.join("uploads.json")
    }

    /// The version whose package has this manifest digest.
    pub fn version(&self, manifest: &Digest) -> VersionDir {
        VersionDir { root: self.root.join(manifest.hex()) }
    }

    /// File with the publishers' signatures of that version.
    pub fn signatures(&self, manifest: &Digest) -> PathBuf {
        self.root.join(format!("{}{SIGNATURES}", manifest.hex()))
    }

    /// File with the digests of the version's unpacked and built files. The task has no access.
    pub fn seal(&self, manifest: &Digest) -> PathBuf {
        self.root.join(format!("{}{SEAL}", manifest.hex()))
    }

    /// The version that `current` points to.
    pub fn current(&self) -> Option<Digest> {
        digest_of(&fs::read_link(self.current_link()).ok()?)
    }

    /// Points `current` to a version.
    pub fn set_current(&self, manifest: &Digest) -> io::Result<()> {
        durable::write_link(&self.current_link(), Path::new(&manifest.hex()))
    }

    /// Every version that has a directory.
    pub fn versions(&self) -> io::Result<Vec<Digest>> {
        Ok(entries(&self.root)?.iter().filter_map(|path| digest_of(path)).collect())
    }

    /// Removes every version except those in `kept` and the current one, and the remains of earlier
    /// removals.
    pub fn prune(&self, kept: &[Digest]) -> io::Result<()> {
        remove_marked(&entries(&self.root)?)?;
        let current = self.current();
        for digest in self.versions()? {
            if !kept.contains(&digest) && current != Some(digest) {
                remove_tree(self.version(&digest).root())?;
            }
        }
        for path in entries(&self.root)? {
            let version = file_name(&path)
                .and_then(|name| {
                    [SIGNATURES, SEAL].iter().find_map(|suffix| name.strip_suffix(suffix))
                })
                .map(Path::new);
            let version = version.and_then(digest_of);
            if version.is_some_and(|digest| !kept.contains(&digest) && current != Some(digest)) {
                durable::remove_file(&path)?;
            }
        }
        Ok(())
    }

    /// Removes the task's directory with all its contents.
    pub fn remove(&self) -> io::Result<()> {
        remove_tree(&self.root)
    }

    fn current_link(&self) -> PathBuf {
        self.root.join("current")
    }
}

impl VersionDir {
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// The task manifest, byte for byte as it was pulled.
    pub fn manifest(&self) -> PathBuf {
        self.root.join("task.json")
    }

    /// The unpacked package. This directory only exists complete: a tree is renamed to this path
    /// when all of it is on the disk.
    pub fn src(&self) -> PathBuf {
        self.root.join("src")
    }

    /// The build tool's intermediate files.
    pub fn build(&self) -> PathBuf {
        self.root.join("build")
    }

    pub fn install(&self) -> PathBuf {
        self.root.join("install")
    }

    /// The working directory of the task. Files that the task writes here stay until the version is
    /// removed.
    pub fn work(&self) -> PathBuf {
        self.root.join("work")
    }

    /// Directory where the nodes of a run write their own log files.
    pub fn node_logs(&self) -> PathBuf {
        self.root().join("node_logs")
    }

    /// The generated script that starts the task.
    pub fn run_script(&self) -> PathBuf {
        self.root.join("run.sh")
    }
}

/// Removes a directory atomically: at any moment it is either complete or absent. The call fails
/// while any part of it is left, also from an earlier attempt.
fn remove_tree(dir: &Path) -> io::Result<()> {
    let Some(name) = file_name(dir) else { return Ok(()) };
    let removed = dir.with_file_name(format!("{REMOVED}{name}"));
    durable::remove_dir_all(&removed)?;
    if !dir.exists() {
        return Ok(());
    }
    durable::rename(dir, &removed)?;
    durable::remove_dir_all(&removed)
}

/// Removes all directories that are marked as being removed, as far as possible.
fn remove_marked(paths: &[PathBuf]) -> io::Result<()> {
    let is_marked = |path: &&PathBuf| file_name(path).is_some_and(|name| name.starts_with(REMOVED));
    let outcomes: Vec<_> =
        paths.iter().filter(is_marked).map(|path| durable::remove_dir_all(path)).collect();
    outcomes.into_iter().collect()
}

/// A directory's entries, sorted; none if the directory does not exist.
fn entries(dir: &Path) -> io::Result<Vec<PathBuf>> {
    let listing = match fs::read_dir(dir) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
        other => other?,
    };
    let mut paths = listing.map(|entry| Ok(entry?.path())).collect::<io::Result<Vec<_>>>()?;
    paths.sort();
    Ok(paths)
}

fn file_name(path: &Path) -> Option<&str> {
    path.file_name()?.to_str()
}

fn digest_of(path: &Path) -> Option<Digest> {
    format!("sha256:{}", file_name(path)?).parse().ok()
}

#[cfg(test)]
mod tests {
    use nix::mount::{MsFlags, mount, umount};

    use super::*;
    use crate::system::durable::own_mounts::with_own_mounts;

    #[test]
    fn pruning_keeps_the_current_version_and_those_named() {
        let dir = tempfile::tempdir().unwrap();
        let data = DataDir::new(dir.path()).unwrap();
        let task = data.task(&"talker".parse().unwrap());
        let [old, previous, current] = [b"1", b"2", b"3"].map(|bytes| Digest::of(bytes));
        for digest in [old, previous, current] {
            durable::create_dir_all(&task.version(&digest).src()).unwrap();
            fs::write(task.signatures(&digest), "[]").unwrap();
            fs::write(task.seal(&digest), "{}").unwrap();
        }
        assert_eq!(task.current(), None);
        task.set_current(&old).unwrap();
        task.set_current(&current).unwrap();
        task.prune(&[previous]).unwrap();
        let mut left = vec![previous, current];
        left.sort();
        assert_eq!((task.current(), task.versions().unwrap()), (Some(current), left));
        assert_eq!(
            [old, previous, current].map(|digest| task.signatures(&digest).exists()),
            [false, true, true]
        );
        assert_eq!(
            [old, previous, current].map(|digest| task.seal(&digest).exists()),
            [false, true, true]
        );
        assert_eq!(data.task_names().unwrap(), ["talker".parse().unwrap()]);
        task.remove().unwrap();
        assert_eq!(data.task_names().unwrap(), []);
    }

    #[test]
    fn half_removed_tree_never_counts_as_complete() {
        let dir = tempfile::tempdir().unwrap();
        let data = DataDir::new(dir.path()).unwrap();
        data.clean_leftovers().unwrap();
        let task = data.task(&"talker".parse().unwrap());
        let [kept, half] = [b"1", b"2"].map(|bytes| Digest::of(bytes));
        durable::create_dir_all(&task.version(&kept).src()).unwrap();
        // A power cut in the middle of a removal leaves this state.
        let marked = task.root().join(format!("{REMOVED}{}", half.hex()));
        durable::create_dir_all(&marked.join("src")).unwrap();
        durable::create_dir_all(&data.tasks().join(".removed-gone/run")).unwrap();
        durable::create_dir_all(&data.staging().join("x")).unwrap();
        assert_eq!((task.versions().unwrap(), data.task_names().unwrap().len()), (vec![kept], 1));
        // The version is installed again and removed again while the rest of the first removal
        // still exists.
        durable::create_dir_all(&task.version(&half).src()).unwrap();
        task.prune(&[kept]).unwrap();
        assert!(!marked.exists() && !task.version(&half).root().exists());
        durable::create_dir_all(&marked.join("src")).unwrap();
        data.clean_leftovers().unwrap();
        assert!(!marked.exists() && !data.staging().exists());
        assert_eq!(entries(&data.tasks()).unwrap(), [task.root()]);
    }

    #[test]
    fn failed_removal_does_not_stop_the_cleaning_of_others() {
        let dir = tempfile::tempdir().unwrap();
        let data = DataDir::new(dir.path()).unwrap();
        let task = data.task(&"talker".parse().unwrap());
        let marked = data.tasks().join(".removed-talker");
        let other = data.tasks().join(".removed-zipper");
        durable::create_dir_all(&task.root().join("busy")).unwrap();
        durable::create_dir_all(&other).unwrap();
        with_own_mounts(|| {
            // A directory cannot be removed while something is mounted there.
            let busy = task.root().join("busy");
            mount(Some("tmpfs"), &busy, Some("tmpfs"), MsFlags::empty(), None::<&str>).unwrap();
            task.remove().unwrap_err();
            assert!(marked.exists() && !task.root().exists());
            task.remove().unwrap_err();
            data.clean_leftovers().unwrap_err();
            assert!(!other.exists());
            umount(&marked.join("busy")).unwrap();
            task.remove().unwrap();
            assert!(!marked.exists());
        });
    }

    #[test]
    fn cleaning_keeps_wanted_parts_only() {
        let dir = tempfile::tempdir().unwrap();
        let data = DataDir::new(dir.path()).unwrap();
        let wanted = Digest::of(b"wanted");
        let other = Digest::of(b"other");
        data.clean_parts(&[]).unwrap();
        durable::create_dir_all(&data.blobs()).unwrap();
        for digest in [wanted, other] {
            fs::write(data.blob_part(&digest), "…").unwrap();
            fs::write(data.blob_parts(&digest), "…").unwrap();
            fs::write(data.blob_parts_note(&digest), "…").unwrap();
        }
        data.clean_parts(&[wanted]).unwrap();
        let left =
            [data.blob_part(&wanted), data.blob_parts(&wanted), data.blob_parts_note(&wanted)];
        assert_eq!(entries(&data.blobs()).unwrap(), left);
    }
}
