//! The names in an archive: which entry may have which name, and where links lead. Unpacking and
//! reading share these rules. This module touches no file.

use std::collections::BTreeMap;

use super::{Entry, Kind, Limits, Refusal};

/// Maximum number of path components that one symbolic link may resolve through, including those of
/// other links.
const MAX_LINK_STEPS: usize = 255;
/// All paths and link targets together. They are held in memory.
const MAX_NAMES_BYTES: usize = 16 << 20;

/// The names so far.
pub(super) struct Names {
    nodes: BTreeMap<String, Node>,
    nodes_limit: u64,
    bytes: usize,
}

enum Node {
    /// `announced` by its own entry, or only implied by a path below the directory.
    Directory {
        announced: bool,
    },
    File,
    Symlink {
        target: String,
    },
}

impl Names {
    pub(super) fn new(limits: &Limits) -> Self {
        Self { nodes: BTreeMap::new(), nodes_limit: limits.entries, bytes: 0 }
    }

    /// Adds an entry's name; returns the directories that the entry needs and that were missing,
    /// from the top.
    pub(super) fn add(&mut self, entry: &Entry) -> Result<Vec<String>, Refusal> {
        let Entry { path, kind } = entry;
        match kind {
            Kind::Directory => self.directory(path),
            Kind::File { .. } => self.claim(path, Node::File),
            Kind::Symlink { target } if target.starts_with('/') => Err(escape_error(path, target)),
            Kind::Symlink { target } => {
                self.bytes += target.len();
                self.claim(path, Node::Symlink { target: target.clone() })
            }
            Kind::HardLink { target } if !matches!(self.nodes.get(target), Some(Node::File)) => {
                let reason =
                    format!("a hard link must name an earlier file of the archive, not {target:?}");
                Err(Refusal::entry(path.as_bytes(), reason))
            }
            Kind::HardLink { .. } => self.claim(path, Node::File),
        }
    }

    /// The symbolic links with their targets, after a check that none of them leads out of the
    /// archive.
    pub(super) fn symlinks(&self) -> Result<Vec<(&str, &str)>, Refusal> {
        let mut links = Vec::new();
        for (path, node) in &self.nodes {
            if let Node::Symlink { target } = node {
                self.check_symlink(path, target)?;
                links.push((path.as_str(), target.as_str()));
            }
        }
        Ok(links)
    }

    fn directory(&mut self, path: &str) -> Result<Vec<String>, Refusal> {
        if path.is_empty() {
            return Ok(Vec::new());
        }
        if let Some(Node::Directory { announced: announced @ false }) = self.nodes.get_mut(path) {
            *announced = true;
            return Ok(Vec::new());
        }
        let mut made = self.claim(path, Node::Directory { announced: true })?;
        made.push(path.to_owned());
        Ok(made)
    }

    /// Takes `path` for `node`, with the directories above; an error if the path is already taken.
    fn claim(&mut self, path: &str, node: Node) -> Result<Vec<String>, Refusal> {
        let mut implied = Vec::new();
        for (end, _) in path.match_indices('/') {
            let above = &path[..end];
            let reason = match self.nodes.get(above) {
                Some(Node::Directory { .. }) => continue,
                None => {
                    self.insert(above, Node::Directory { announced: false })?;
                    implied.push(above.to_owned());
                    continue;
                }
                Some(Node::File) => "is a file",
                Some(Node::Symlink { .. }) => "is a symbolic link",
            };
            return Err(Refusal::entry(path.as_bytes(), format!("{above:?} above it {reason}")));
        }
        if self.nodes.contains_key(path) {
            return Err(Refusal::entry(path.as_bytes(), "duplicate name"));
        }
        self.insert(path, node)?;
        Ok(implied)
    }

    fn insert(&mut self, path: &str, node: Node) -> Result<(), Refusal> {
        self.bytes += path.len();
        self.nodes.insert(path.to_owned(), node);
        if self.nodes.len() as u64 > self.nodes_limit {
            let (found, limit) = (self.nodes.len() as u64, self.nodes_limit);
            return Err(Refusal::Limit { what: "files, directories and links", found, limit });
        }
        if self.bytes > MAX_NAMES_BYTES {
            let (found, limit) = (self.bytes as u64, MAX_NAMES_BYTES as u64);
            return Err(Refusal::Limit { what: "bytes of names", found, limit });
        }
        Ok(())
    }

    /// Follows a link through the tree as the kernel would, other links included. A missing path
    /// counts as a directory: a build may create one.
    fn check_symlink(&self, path: &str, target: &str) -> Result<(), Refusal> {
        let mut at: Vec<&str> = split(path).0.split('/').filter(|part| !part.is_empty()).collect();
        let mut ahead: Vec<&str> = target.rsplit('/').collect();
        let mut steps = 0;
        while let Some(part) = ahead.pop() {
            steps += 1;
            if steps > MAX_LINK_STEPS {
                return Err(Refusal::entry(
                    path.as_bytes(),
                    "the symbolic link leads through too many others",
                ));
            }
            match part {
                "" | "." => continue,
                ".." if at.pop().is_none() => return Err(escape_error(path, target)),
                ".." => continue,
                name => at.push(name),
            }
            if let Some(Node::Symlink { target: next }) = self.nodes.get(&at.join("/")) {
                at.pop();
                ahead.extend(next.rsplit('/'));
            }
        }
        Ok(())
    }
}

fn escape_error(path: &str, target: &str) -> Refusal {
    Refusal::entry(path.as_bytes(), format!("the symbolic link to {target:?} leaves the package"))
}

pub(super) fn split(path: &str) -> (&str, &str) {
    path.rsplit_once('/').unwrap_or(("", path))
}
