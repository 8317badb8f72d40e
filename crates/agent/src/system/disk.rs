//! Checks whether a package fits on the disk: blob, unpacked tree, build and a reserve, before any
//! transfer. This module never frees any space.

use std::io;
use std::path::Path;
use std::time::Duration;

use task_proto::desired::PackageRef;
use task_proto::packages::manifest::{BuildTool, TaskManifest};

/// Disk cost of a file beyond its bytes: a block that is only partly used, and an inode.
const BYTES_PER_ENTRY: u64 = 4096 + 256;
/// A build and its install tree together take about this many times the sources.
const BUILD_FACTOR: u64 = 2;

/// Pause before a full disk is checked again: a person has to make space.
pub const FULL_PAUSE: Duration = Duration::from_secs(5 * 60);
/// With less than this free, a failure may be due to lack of space.
const FULL_BYTES: u64 = 16 * 1024 * 1024;

/// The bytes that one package needs, by purpose.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Need {
    /// The missing part of the compressed content.
    pub blob: u64,
    pub tree: u64,
    /// Build and install trees.
    pub build: u64,
    /// Bytes that must stay free for everything else on the machine.
    pub reserve: u64,
}

/// There is not enough space. The error's text is the failure's text and has all the figures.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "{free} of {total} bytes are free, {} are needed: {} for the package, {} for its tree, {} for the build, {} in reserve",
    need.total(), need.blob, need.tree, need.build, need.reserve
)]
pub struct DiskFull {
    /// Free bytes on the data directory's file system.
    pub free: u64,
    /// Size of the file system in bytes.
    pub total: u64,
    /// The room that the package would have needed.
    pub need: Need,
}

/// Space on a file system.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DiskSpace {
    /// Bytes that an ordinary user may still write.
    pub free: u64,
    pub total: u64,
}

impl Need {
    /// The room that `package` needs when `present` bytes of its content are on the disk already.
    pub fn of(package: &PackageRef, manifest: &TaskManifest, present: u64, reserve: u64) -> Self {
        let facts = &manifest.content;
        let tree = facts.tar_size.saturating_add(facts.entries.saturating_mul(BYTES_PER_ENTRY));
        let build = match manifest.build.tool {
            BuildTool::Colcon | BuildTool::Catkin => tree.saturating_mul(BUILD_FACTOR),
            BuildTool::None => 0,
        };
        Self { blob: package.content.size.saturating_sub(present), tree, build, reserve }
    }

    /// The room that one more small file needs.
    pub fn of_file(bytes: u64) -> Self {
        Self { blob: bytes.saturating_add(BYTES_PER_ENTRY), tree: 0, build: 0, reserve: 0 }
    }

    /// Sum of all needs.
    pub fn total(&self) -> u64 {
        [self.tree, self.build, self.reserve].into_iter().fold(self.blob, u64::saturating_add)
    }

    /// Checks whether the need fits into `space`.
    pub fn check(self, space: DiskSpace) -> Result<(), DiskFull> {
        if self.total() <= space.free {
            return Ok(());
        }
        Err(DiskFull { free: space.free, total: space.total, need: self })
    }
}

impl DiskSpace {
    /// Whether the disk is nearly full, so that hardly anything can be written.
    pub fn is_full(self) -> bool {
        self.free < FULL_BYTES
    }
}

/// The room on the file system that holds `path`.
pub fn space(path: &Path) -> io::Result<DiskSpace> {
    let stat = nix::sys::statvfs::statvfs(path)?;
    let block = stat.fragment_size();
    Ok(DiskSpace {
        free: stat.blocks_available().saturating_mul(block),
        total: stat.blocks().saturating_mul(block),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const NEED: Need = Need { blob: 10, tree: 20, build: 40, reserve: 30 };

    #[test]
    fn refusal_text_has_all_figures() {
        assert_eq!(NEED.check(DiskSpace { free: 100, total: 500 }), Ok(()));
        let full = NEED.check(DiskSpace { free: 99, total: 500 }).unwrap_err();
        assert_eq!(
            full.to_string(),
            "99 of 500 bytes are free, 100 are needed: 10 for the package, 20 for its tree, 40 for the build, 30 in reserve"
        );
    }

    #[test]
    fn nearly_full_disk_counts_as_full() {
        assert!(DiskSpace { free: FULL_BYTES - 1, total: u64::MAX }.is_full());
        assert!(!DiskSpace { free: FULL_BYTES, total: u64::MAX }.is_full());
    }

    #[test]
    fn huge_sizes_do_not_wrap() {
        let need = Need { blob: u64::MAX, tree: u64::MAX, ..NEED };
        assert!(need.check(DiskSpace { free: u64::MAX - 1, total: u64::MAX }).is_err());
    }

    #[test]
    fn real_file_system_reports_its_space() {
        let space = space(Path::new("/")).unwrap();
        assert!(space.free <= space.total && space.total > 0);
    }
}
