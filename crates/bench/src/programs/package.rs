//! Packages of a given size with incompressible bytes that were never used before, in the packer's
//! format.

use rand::rngs::SmallRng;
use rand::{Rng as _, SeedableRng as _};
use task_proto::desired::BlobRef;
use task_proto::packages::manifest::{ContentFacts, Run, TaskKind, TaskManifest};
use task_proto::{Digest, TaskName, Version};

/// The file in a package that has the wanted size.
pub const PAYLOAD_FILE: &str = "payload.bin";

/// A package that is ready to be pushed.
pub struct Package {
    pub name: TaskName,
    pub version: Version,
    /// The task manifest, JSON.
    pub config: Vec<u8>,
    pub content: Vec<u8>,
    pub payload: Digest,
}

impl Package {
    /// A package with one file of `bytes` bytes, generated from `seed`. Slow for large sizes.
    pub fn random(name: TaskName, version: Version, bytes: u64, seed: u64) -> Self {
        Self::of_kind(TaskKind::Service, name, version, bytes, seed)
    }

    /// The same for a task of this kind.
    pub fn of_kind(
        kind: TaskKind,
        name: TaskName,
        version: Version,
        bytes: u64,
        seed: u64,
    ) -> Self {
        let mut payload = vec![0; usize::try_from(bytes).unwrap_or(usize::MAX)];
        SmallRng::seed_from_u64(seed).fill_bytes(&mut payload);
        let (content, facts) = content(&payload);
        let run = Run { exec: Some(vec!["true".to_owned()]), kind, ..Run::default() };
        let manifest = TaskManifest {
            name: name.clone(),
            version: version.clone(),
            build: task_proto::packages::manifest::Build {
                tool: task_proto::packages::manifest::BuildTool::None,
            },
            run,
            ready: Default::default(),
            parameters: Default::default(),
            outputs: Default::default(),
            requires: Default::default(),
            limits: Default::default(),
            exec_depends: Vec::new(),
            content: facts,
        };
        // Plain numbers and texts can always be written.
        let config = serde_json::to_vec(&manifest).unwrap_or_default();
        Self { name, version, config, content, payload: Digest::of(&payload) }
    }

    /// Reference of the config blob.
    pub fn config_blob(&self) -> BlobRef {
        BlobRef { digest: Digest::of(&self.config), size: self.config.len() as u64 }
    }

    /// Reference of the content blob.
    pub fn content_blob(&self) -> BlobRef {
        BlobRef { digest: Digest::of(&self.content), size: self.content.len() as u64 }
    }
}

fn content(payload: &[u8]) -> (Vec<u8>, ContentFacts) {
    let mut header = tar::Header::new_ustar();
    header.set_size(payload.len() as u64);
    header.set_mode(0o644);
    header.set_entry_type(tar::EntryType::Regular);
    let mut archive = tar::Builder::new(Vec::with_capacity(payload.len() + 4096));
    let tar =
        archive.append_data(&mut header, PAYLOAD_FILE, payload).and_then(|()| archive.into_inner());
    // Writing to memory does not fail.
    let tar = tar.unwrap_or_default();
    let facts =
        ContentFacts { tar_digest: Digest::of(&tar), tar_size: tar.len() as u64, entries: 1 };
    (zstd::bulk::compress(&tar, 1).unwrap_or_default(), facts)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn payloads_have_their_size_and_differ() {
        let package = |seed| {
            let name = "a".parse().expect("a name");
            let version = "1".parse().expect("a version");
            Package::random(name, version, 100_000, seed)
        };
        let one = package(1);
        let again = package(1);
        let other = package(2);
        assert_eq!(one.content, again.content);
        assert_ne!(one.payload, other.payload);
        assert!((100_000..102_000).contains(&one.content.len()), "{}", one.content.len());
    }
}
