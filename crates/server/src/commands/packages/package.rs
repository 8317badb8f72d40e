//! `taskd package`: the store's packages, a package's contents, and the differences between two
//! packages.

use std::path::{Path, PathBuf};
use std::str::FromStr;

use clap::Subcommand;
use task_proto::api::{
    PackageDiff, PackageFile, PackageFileKind, PackageFiles, PackageList, PackageVersions,
    PackageView,
};
use task_proto::manifest::{BuildTool, TaskKind, TaskManifest};
use task_proto::{Digest, TaskName};

use super::export;
use crate::commands::api::complete;
use crate::commands::display::confirm::always;
use crate::commands::display::output::table::Columns;
use crate::commands::display::output::{bytes, facts, robots, say, time};
use crate::commands::{CommandError, Outcome, Session};

/// What to do with packages.
#[derive(Debug, Subcommand)]
pub enum Action {
    /// List all packages, or the versions of one
    List {
        /// Only this one
        #[arg(add = complete::packages())]
        name: Option<TaskName>,
    },
    /// Show a package: its versions and where they run, or one version's manifest
    Info {
        /// Its name, NAME:VERSION or NAME@DIGEST
        #[arg(add = complete::packages())]
        package: PackageName,
    },
    /// List a package's files
    Files {
        /// Its name, NAME:VERSION or NAME@DIGEST; a name alone is its newest version
        #[arg(add = complete::packages())]
        package: PackageName,
    },
    /// Show which files differ between two versions of a package
    Diff {
        /// The first, as NAME:VERSION or NAME@DIGEST
        #[arg(add = complete::packages())]
        from: PackageName,
        /// The version (or digest) of the second
        to: String,
    },
    /// Delete a version that no robot needs
    Rm {
        /// NAME:VERSION or NAME@DIGEST
        #[arg(add = complete::packages())]
        package: PackageName,
        /// Don't ask
        #[arg(short, long)]
        yes: bool,
    },
    /// Write a package's files to a directory or an archive
    Export {
        /// Its name, NAME:VERSION or NAME@DIGEST; a name alone is its newest version
        #[arg(add = complete::packages())]
        package: PackageName,
        /// A directory that does not exist yet or is empty, or a file that ends with .tar or
        /// .tar.zst [default: a directory of the package's name]
        to: Option<PathBuf>,
    },
}

/// A package reference from the command line.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PackageName {
    pub(in crate::commands) name: TaskName,
    /// A version or a manifest's digest.
    pub(in crate::commands) version: Option<String>,
}

impl FromStr for PackageName {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        let (name, version) = match (text.split_once('@'), text.split_once(':')) {
            (Some((name, digest)), _) => {
                digest.parse::<Digest>().map_err(|error| error.to_string())?;
                (name, Some(digest))
            }
            (None, Some((name, version))) => {
                version.parse::<task_proto::Version>().map_err(|error| error.to_string())?;
                (name, Some(version))
            }
            (None, None) => (text, None),
        };
        let name = name.parse().map_err(|error: task_proto::id::InvalidId| error.to_string())?;
        Ok(Self { name, version: version.map(str::to_owned) })
    }
}

impl std::fmt::Display for PackageName {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match &self.version {
            None => write!(f, "{}", self.name),
            Some(digest) if digest.contains(':') => write!(f, "{}@{digest}", self.name),
            Some(version) => write!(f, "{}:{version}", self.name),
        }
    }
}

pub(in crate::commands) async fn run(
    session: &Session,
    action: Action,
) -> Result<Outcome, CommandError> {
    match action {
        Action::List { name } => list(session, name.as_ref()).await?,
        Action::Info { package } => info(session, &package).await?,
        Action::Files { package } => files(session, &package).await?,
        Action::Diff { from, to } => diff(session, &from, &to).await?,
        Action::Rm { package, yes } => {
            let Some(version) = &package.version else {
                let text = format!(
                    "{package}: say which version, as {package}:VERSION (taskd package list {package})"
                );
                return Err(CommandError::Usage(text));
            };
            always(&format!("delete the package {package}"), yes)?;
            session.client.delete(&format!("/packages/{}/{version}", package.name)).await?;
            say(&format!("deleted {package}"));
        }
        Action::Export { package, to } => {
            let view = find(session, &package).await?;
            let to = to.unwrap_or_else(|| Path::new(view.package.name.as_str()).to_owned());
            export::export(session, &view, &to).await?;
        }
    }
    Ok(Outcome::Succeeded)
}

/// The requested version, or the newest if none is named.
pub(in crate::commands) async fn find(
    session: &Session,
    package: &PackageName,
) -> Result<PackageView, CommandError> {
    let list: PackageList = session.client.get("/packages", &[]).await?;
    let is_meant = |view: &PackageView| {
        let known = &view.package;
        let version = package.version.as_deref();
        known.name == package.name
            && version.is_none_or(|version| {
                version == known.version.as_str() || version == known.manifest.digest.to_string()
            })
    };
    let found = list.packages.into_iter().find(is_meant);
    found.ok_or_else(|| CommandError::Usage(format!("the server has no package {package}")))
}

const COLUMNS: Columns = Columns {
    name: "name",
    narrow: &["name", "version", "manifest", "size", "pushed"],
    wide: &["kind", "build", "ros", "arch", "unpacked", "digest"],
};

async fn list(session: &Session, name: Option<&TaskName>) -> Result<(), CommandError> {
    let mut list: PackageList = session.client.get("/packages", &[]).await?;
    list.packages.retain(|view| name.is_none_or(|name| view.package.name == *name));
    session.output.result(&list, &COLUMNS, |list| list.packages.iter().map(row).collect())
}

fn row(view: &PackageView) -> Vec<String> {
    let PackageView { package, pushed_at_ms, manifest } = view;
    vec![
        package.name.to_string(),
        package.version.to_string(),
        short(&package.manifest.digest),
        bytes(package.content.size),
        time(*pushed_at_ms),
        kind(manifest).to_owned(),
        tool(manifest).to_owned(),
        any(&manifest.requires.ros_distro),
        any(&manifest.requires.arch),
        bytes(manifest.content.tar_size),
        package.manifest.digest.to_string(),
    ]
}

/// A digest prefix long enough to tell versions apart.
pub(in crate::commands) fn short(digest: &Digest) -> String {
    digest.hex()[..12].to_owned()
}

fn kind(manifest: &TaskManifest) -> &'static str {
    match manifest.run.kind {
        TaskKind::Service => "service",
        TaskKind::Job => "job",
    }
}

fn tool(manifest: &TaskManifest) -> &'static str {
    match manifest.build.tool {
        BuildTool::Colcon => "colcon",
        BuildTool::Catkin => "catkin",
        BuildTool::None => "none",
    }
}

fn any(names: &[String]) -> String {
    if names.is_empty() { "any".to_owned() } else { names.join(" ") }
}

const VERSIONS: Columns = Columns {
    name: "version",
    narrow: &["version", "manifest", "size", "pushed", "robots"],
    wide: &["kind", "build", "ros", "arch", "digest"],
};

async fn info(session: &Session, package: &PackageName) -> Result<(), CommandError> {
    let versions: PackageVersions =
        session.client.get(&format!("/packages/{}", package.name), &[]).await?;
    if package.version.is_some() {
        let view = find(session, package).await?;
        let name = |view: &PackageView| format!("{}:{}", view.package.name, view.package.version);
        return session.output.described(&view, name, |view| {
            describe(view, used(&versions, &view.package.manifest.digest))
        });
    }
    session.output.result(&versions, &VERSIONS, |versions| {
        let row = |view: &PackageView| {
            let digest = &view.package.manifest.digest;
            vec![
                view.package.version.to_string(),
                short(digest),
                bytes(view.package.content.size),
                time(view.pushed_at_ms),
                used(versions, digest).to_string(),
                kind(&view.manifest).to_owned(),
                tool(&view.manifest).to_owned(),
                any(&view.manifest.requires.ros_distro),
                any(&view.manifest.requires.arch),
                digest.to_string(),
            ]
        };
        versions.versions.iter().map(row).collect()
    })
}

/// The number of robots that should run the package.
fn used(versions: &PackageVersions, digest: &Digest) -> u64 {
    versions
        .running
        .iter()
        .find(|running| running.manifest == *digest)
        .map_or(0, |running| running.robots)
}

fn describe(view: &PackageView, used: u64) -> String {
    let PackageView { package, pushed_at_ms, manifest } = view;
    let run = match (&manifest.run.launch, &manifest.run.exec) {
        (Some([ros_package, file]), _) => format!("launch {ros_package} {file}"),
        (None, exec) => exec.iter().flatten().cloned().collect::<Vec<_>>().join(" "),
    };
    let content = &manifest.content;
    let mut shown = vec![
        ("package", package.name.to_string()),
        ("version", package.version.to_string()),
        ("manifest", package.manifest.digest.to_string()),
        ("pushed", time(*pushed_at_ms)),
        ("content", format!("{} ({})", package.content.digest, bytes(package.content.size))),
        ("unpacked", format!("{}, {} entries", bytes(content.tar_size), content.entries)),
        ("kind", kind(manifest).to_owned()),
        ("build", tool(manifest).to_owned()),
        ("run", run),
    ];
    let arguments: Vec<String> =
        manifest.run.args.iter().map(|(name, value)| format!("{name}:={value}")).collect();
    let labels = manifest.requires.labels.iter().map(|(key, value)| format!("{key}={value}"));
    let lists = [
        ("arguments", arguments),
        (
            "ready",
            manifest
                .ready
                .nodes
                .iter()
                .chain(&manifest.ready.services)
                .chain(manifest.ready.topics.keys())
                .cloned()
                .collect(),
        ),
        ("lifecycle", manifest.ready.lifecycle.clone()),
        (
            "needs",
            labels
                .chain(manifest.requires.ros_distro.clone())
                .chain(manifest.requires.arch.clone())
                .collect(),
        ),
        ("depends on", manifest.exec_depends.clone()),
        ("outputs", manifest.outputs.paths.clone()),
    ];
    shown.extend(
        lists
            .into_iter()
            .filter(|(_, list)| !list.is_empty())
            .map(|(key, list)| (key, list.join(" "))),
    );
    shown.push(("ordered for", robots(used)));
    facts(shown)
}

const FILES: Columns =
    Columns { name: "path", narrow: &["mode", "size", "path"], wide: &["digest"] };

async fn files(session: &Session, package: &PackageName) -> Result<(), CommandError> {
    let digest = find(session, package).await?.package.manifest.digest;
    let path = format!("/packages/{}/{digest}/files", package.name);
    let files: PackageFiles = session.client.get(&path, &[]).await?;
    session.output.result(&files, &FILES, |files| files.files.iter().map(file_row).collect())
}

fn file_row(file: &PackageFile) -> Vec<String> {
    let path = match &file.target {
        Some(target) => format!("{} -> {target}", file.path),
        None => file.path.clone(),
    };
    vec![
        format!("{}{}", letter(file.kind), permissions(file.mode)),
        if file.kind == PackageFileKind::File { bytes(file.size) } else { "-".to_owned() },
        path,
        file.digest.as_ref().map_or_else(|| "-".to_owned(), Digest::to_string),
    ]
}

fn letter(kind: PackageFileKind) -> char {
    match kind {
        PackageFileKind::File => '-',
        PackageFileKind::Directory => 'd',
        PackageFileKind::Link => 'l',
    }
}

/// A mode in the format of `ls -l`.
fn permissions(mode: u32) -> String {
    let letter = |(at, letter): (u32, char)| if mode & (0o400 >> at) == 0 { '-' } else { letter };
    (0..9).zip("rwxrwxrwx".chars()).map(letter).collect()
}

const DIFFERENCES: Columns =
    Columns { name: "path", narrow: &["change", "path", "from", "to"], wide: &["digest"] };

async fn diff(session: &Session, from: &PackageName, to: &str) -> Result<(), CommandError> {
    let Some(version) = &from.version else {
        return Err(CommandError::Usage(format!("{from}: say which version, as {from}:VERSION")));
    };
    // Either reference may be complete.
    let to = match to.parse::<PackageName>() {
        Ok(PackageName { name, version: Some(version) }) if name == from.name => version,
        _ => to.to_owned(),
    };
    let path = format!("/packages/{}/diff", from.name);
    let diff: PackageDiff =
        session.client.get(&path, &[("from", version.clone()), ("to", to)]).await?;
    session.output.result(&diff, &DIFFERENCES, difference_rows)?;
    if diff.manifest_changed {
        say("the manifests differ as well: see taskd package info");
    }
    let count = diff.added.len() + diff.removed.len() + diff.changed.len();
    say(&format!(
        "{} added, {} removed, {} changed",
        diff.added.len(),
        diff.removed.len(),
        diff.changed.len()
    ));
    if count == 0 && !diff.manifest_changed {
        say("nothing differs");
    }
    Ok(())
}

fn difference_rows(diff: &PackageDiff) -> Vec<Vec<String>> {
    let row = |change: &str, path: &str, from: Option<&PackageFile>, to: Option<&PackageFile>| {
        let shown = |file: Option<&PackageFile>| file.map_or_else(|| "-".to_owned(), content_of);
        let digest = to.or(from).and_then(|file| file.digest.as_ref());
        let digest = digest.map_or_else(|| "-".to_owned(), Digest::to_string);
        vec![change.to_owned(), path.to_owned(), shown(from), shown(to), digest]
    };
    let mut rows: Vec<_> =
        diff.added.iter().map(|file| row("added", &file.path, None, Some(file))).collect();
    rows.extend(diff.removed.iter().map(|file| row("removed", &file.path, Some(file), None)));
    rows.extend(
        diff.changed
            .iter()
            .map(|file| row("changed", &file.path, Some(&file.from), Some(&file.to))),
    );
    rows.sort_by(|a, b| a[1].cmp(&b[1]));
    rows
}

fn content_of(file: &PackageFile) -> String {
    match (file.kind, &file.target) {
        (PackageFileKind::File, _) if file.mode & 0o111 != 0 => {
            format!("{}, executable", bytes(file.size))
        }
        (PackageFileKind::File, _) => bytes(file.size),
        (PackageFileKind::Directory, _) => "directory".to_owned(),
        (PackageFileKind::Link, target) => format!("-> {}", target.as_deref().unwrap_or("?")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn packages_are_named_as_elsewhere() {
        let digest = Digest::of(b"x");
        for text in ["talker", "talker:1.0.0", &format!("talker@{digest}")] {
            assert_eq!(text.parse::<PackageName>().expect(text).to_string(), text);
        }
        for text in ["", ":1", "talker:", "talker:a b", "talker@1.0.0", "a/b"] {
            assert!(text.parse::<PackageName>().is_err(), "{text}");
        }
    }

    #[test]
    fn permissions_look_as_they_do_elsewhere() {
        assert_eq!(permissions(0o755), "rwxr-xr-x");
        assert_eq!(permissions(0o640), "rw-r-----");
    }
}
