//! Where everything lies in the agent's data directory:
//!
//! ```text
//! identity.json                     who this robot is (0600)
//! ledger.json                       what the agent was doing
//! publishers.json                   the list of publishers it goes by, if it was shown one
//! blobs/sha256/<hex>.part           bytes of a package's content that have arrived so far
//! blobs/sha256/<hex>.parts          the same where they come as parts in any order: a file with holes
//! blobs/sha256/<hex>.parts-note     which of its parts are on the disk
//! accounts.json                     which account each task runs under
//! staging/                          trees being unpacked; emptied at every start
//! survey/                           what was last asked about the ROS installations
//! logs/                             what nodes say that are of no task
//! tasks/<name>/current              link to the active version
//! tasks/<name>/run/                 the shim's files: pid, exit status
//! tasks/<name>/logs/                the task's and the build's output, and what its nodes say on ROS topics
//! tasks/<name>/home/                the task's home directory, where it runs as a user of its own
//! tasks/<name>/build_home/          that of its builds
//! tasks/<name>/uploads.json         which uploads of its files are under way
//! tasks/<name>/<hex>.signatures     what publishers have signed about a version, out of the task's reach
//! tasks/<name>/<hex>.seal           what was unpacked and built of a version, by digests
//! tasks/<name>/<hex>/               one version, by the digest of its OCI manifest
//!   task.json                       the task manifest, byte for byte as it was pulled
//!   src/  build/  install/  run.sh  read-only to the task
//!   work/                           the directory that the task runs in
//!   node_logs/                      what its nodes write into logs of their own
//! ```
//!
//! It owns names, and what may be cleaned away; what is in the files is their owners' affair.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use task_proto::{Digest, TaskName};

use crate::system::durable;

/// The flag file by which `hold` and `release` speak to the agent.
pub const HOLD_FILE: &str = "hold";

/// What a directory is called while it is being removed; no task or version can have such a name.
/// Were it removed in place, a power cut would leave half a tree where a whole one is expected.
const REMOVED: &str = ".removed-";
/// What follows a version's name in that of the file with its signatures.
const SIGNATURES: &str = ".signatures";
/// And in that of the file that says what was unpacked and built.
const SEAL: &str = ".seal";

/// The agent's data directory.
#[derive(Debug, Clone)]
pub struct DataDir {
    root: PathBuf,
}

/// What belongs to one task.
#[derive(Debug, Clone)]
pub struct TaskDir {
    root: PathBuf,
}

/// What belongs to one version of a task.
#[derive(Debug, Clone)]
pub struct VersionDir {
    root: PathBuf,
}

impl DataDir {
    /// The directory at `root`, which is made absolute; nothing is created yet.
    pub fn new(root: &Path) -> io::Result<Self> {
        Ok(Self { root: std::path::absolute(root)? })
    }

    /// The directory itself.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Who this robot is.
    pub fn identity(&self) -> PathBuf {
        self.root.join("identity.json")
    }

    /// What the agent was doing.
    pub fn ledger(&self) -> PathBuf {
        self.root.join("ledger.json")
    }

    /// The list of publishers the agent goes by.
    pub fn publishers(&self) -> PathBuf {
        self.root.join("publishers.json")
    }

    /// Which account each task runs under.
    pub fn accounts(&self) -> PathBuf {
        self.root.join("accounts.json")
    }

    /// Where a blob's bytes gather while they are being pulled.
    pub fn blob_part(&self, digest: &Digest) -> PathBuf {
        self.blobs().join(format!("{}.part", digest.hex()))
    }

    /// Where a blob's bytes gather while they are pushed in parts.
    pub fn blob_parts(&self, digest: &Digest) -> PathBuf {
        self.blobs().join(format!("{}.parts", digest.hex()))
    }

    /// Which of those parts are there.
    pub fn blob_parts_note(&self, digest: &Digest) -> PathBuf {
        self.blobs().join(format!("{}.parts-note", digest.hex()))
    }

    /// Where trees are unpacked before they get their place.
    pub fn staging(&self) -> PathBuf {
        self.root.join("staging")
    }

    /// What nodes say on ROS topics that are of no task.
    pub fn ros_log(&self) -> PathBuf {
        self.root.join("logs").join("ros.log")
    }

    /// One task's directory.
    pub fn task(&self, name: &TaskName) -> TaskDir {
        TaskDir { root: self.tasks().join(name.as_str()) }
    }

    /// The directories on the way to what belongs to a task.
    pub fn way_to(&self, name: &TaskName) -> [PathBuf; 3] {
        [self.root.clone(), self.tasks(), self.task(name).root]
    }

    /// Removes what an agent that died left half done: trees half unpacked or half removed. Only at
    /// start: a pull in progress would lose its tree. What can't be removed keeps nothing else from
    /// it.
    pub fn clean_leftovers(&self) -> io::Result<()> {
        let tasks = entries(&self.tasks())?;
        let mut outcomes = vec![durable::remove_dir_all(&self.staging()), remove_marked(&tasks)];
        outcomes.extend(
            tasks.iter().filter(|path| path.is_dir()).map(|task| remove_marked(&entries(task)?)),
        );
        outcomes.into_iter().collect()
    }

    /// Removes all gathered bytes except those of the blobs in `wanted`.
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
    /// The directory itself.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// The shim's files.
    pub fn run(&self) -> PathBuf {
        self.root.join("run")
    }

    /// Where all its logs are.
    pub fn logs(&self) -> PathBuf {
        self.root.join("logs")
    }

    /// The task's output.
    pub fn output_log(&self) -> PathBuf {
        self.logs().join("task.log")
    }

    /// What its nodes say on ROS topics.
    pub fn ros_log(&self) -> PathBuf {
        self.logs().join("ros.log")
    }

    /// The output of its last build.
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

    /// Which uploads of its files are under way: out of the task's reach, because it says where the
    /// robot's token goes.
    pub fn uploads(&self) -> PathBuf {
        self.root.join("uploads.json")
    }

    /// The version whose package has this manifest digest.
    pub fn version(&self, manifest: &Digest) -> VersionDir {
        VersionDir { root: self.root.join(manifest.hex()) }
    }

    /// What publishers have signed about that version.
    pub fn signatures(&self, manifest: &Digest) -> PathBuf {
        self.root.join(format!("{}{SIGNATURES}", manifest.hex()))
    }

    /// What was unpacked and built of that version, by digests: out of the task's reach.
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

    /// Removes every version except those in `kept` and the current one, and what is left of
    /// earlier ones.
    pub fn prune(&self, kept: &[Digest]) -> io::Result<()> {
        remove_marked(&entries(&self.root)?)?;
        let current = self.current();
        for digest in self.versions()? {
            if !kept.contains(&digest) && current != Some(digest) {
                remove_whole(self.version(&digest).root())?;
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

    /// Removes the task with all it left.
    pub fn remove(&self) -> io::Result<()> {
        remove_whole(&self.root)
    }

    fn current_link(&self) -> PathBuf {
        self.root.join("current")
    }
}

impl VersionDir {
    /// The directory itself.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// The task manifest, byte for byte as it was pulled.
    pub fn manifest(&self) -> PathBuf {
        self.root.join("task.json")
    }

    /// The unpacked package. It exists only whole: it is renamed here when all of it is on the
    /// disk.
    pub fn src(&self) -> PathBuf {
        self.root.join("src")
    }

    /// The build tool's intermediate files.
    pub fn build(&self) -> PathBuf {
        self.root.join("build")
    }

    /// What was built.
    pub fn install(&self) -> PathBuf {
        self.root.join("install")
    }

    /// The directory that the task runs in: what it writes there stays until the version goes.
    pub fn work(&self) -> PathBuf {
        self.root.join("work")
    }

    /// Where the nodes of a run write logs of their own.
    pub fn node_logs(&self) -> PathBuf {
        self.root().join("node_logs")
    }

    /// The generated script that starts the task.
    pub fn run_script(&self) -> PathBuf {
        self.root.join("run.sh")
    }
}

/// Removes a directory so that it is there whole or not at all, at any moment. It is not done while
/// anything is left of it, also of an earlier try.
fn remove_whole(dir: &Path) -> io::Result<()> {
    let Some(name) = file_name(dir) else { return Ok(()) };
    let removed = dir.with_file_name(format!("{REMOVED}{name}"));
    durable::remove_dir_all(&removed)?;
    if !dir.exists() {
        return Ok(());
    }
    durable::rename(dir, &removed)?;
    durable::remove_dir_all(&removed)
}

/// Removes what is marked as being removed, all that can be.
fn remove_marked(paths: &[PathBuf]) -> io::Result<()> {
    let is_marked = |path: &&PathBuf| file_name(path).is_some_and(|name| name.starts_with(REMOVED));
    let outcomes: Vec<_> =
        paths.iter().filter(is_marked).map(|path| durable::remove_dir_all(path)).collect();
    outcomes.into_iter().collect()
}

/// A directory's entries, sorted; none if it is not there.
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
    fn what_was_half_removed_is_never_taken_for_whole() {
        let dir = tempfile::tempdir().unwrap();
        let data = DataDir::new(dir.path()).unwrap();
        data.clean_leftovers().unwrap();
        let task = data.task(&"talker".parse().unwrap());
        let [kept, half] = [b"1", b"2"].map(|bytes| Digest::of(bytes));
        durable::create_dir_all(&task.version(&kept).src()).unwrap();
        // As a power cut in the middle of removing leaves it.
        let marked = task.root().join(format!("{REMOVED}{}", half.hex()));
        durable::create_dir_all(&marked.join("src")).unwrap();
        durable::create_dir_all(&data.tasks().join(".removed-gone/run")).unwrap();
        durable::create_dir_all(&data.staging().join("x")).unwrap();
        assert_eq!((task.versions().unwrap(), data.task_names().unwrap().len()), (vec![kept], 1));
        // The version comes back and is removed again while the rest of the first removal is still
        // there.
        durable::create_dir_all(&task.version(&half).src()).unwrap();
        task.prune(&[kept]).unwrap();
        assert!(!marked.exists() && !task.version(&half).root().exists());
        durable::create_dir_all(&marked.join("src")).unwrap();
        data.clean_leftovers().unwrap();
        assert!(!marked.exists() && !data.staging().exists());
        assert_eq!(entries(&data.tasks()).unwrap(), [task.root()]);
    }

    #[test]
    fn a_removal_that_fails_is_not_done_and_keeps_no_other_from_being_cleaned_up() {
        let dir = tempfile::tempdir().unwrap();
        let data = DataDir::new(dir.path()).unwrap();
        let task = data.task(&"talker".parse().unwrap());
        let marked = data.tasks().join(".removed-talker");
        let other = data.tasks().join(".removed-zipper");
        durable::create_dir_all(&task.root().join("busy")).unwrap();
        durable::create_dir_all(&other).unwrap();
        with_own_mounts(|| {
            // Nobody can remove it while something is mounted there.
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
        let (wanted, other) = (Digest::of(b"wanted"), Digest::of(b"other"));
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
