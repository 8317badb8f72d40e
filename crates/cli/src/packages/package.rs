//! `taskd package`: the store's packages, a package's contents, and the differences between two
//! packages.

use std::path::{Path, PathBuf};
use std::str::FromStr;

use clap::Subcommand;
use task_proto::api::{
    PackageDiff, PackageFile, PackageFileKind, PackageFiles, PackageList, PackageVersions,
    PackageView,
};
use task_proto::packages::manifest::{BuildTool, TaskKind, TaskManifest};
use task_proto::size::format_bytes;
use task_proto::{Digest, TaskName};

use super::export;
use crate::api::complete;
use crate::display::confirm::confirm_irreversible;
use crate::display::output::table::Columns;
use crate::display::output::{facts, robots, say, short_digest, time};
use crate::{CommandError, Outcome, Session};

#[derive(Debug, Subcommand)]
pub enum Action {
    /// List all packages, or the versions of one package
    List {
        /// Only this package
        #[arg(add = complete::packages())]
        name: Option<TaskName>,
    },
    /// Show the versions of a package, or the manifest of one version
    Info {
        /// NAME, NAME:VERSION or NAME@DIGEST
        #[arg(add = complete::packages())]
        package: PackageName,
    },
    /// List the files of a package
    Files {
        /// NAME (the newest version), NAME:VERSION or NAME@DIGEST
        #[arg(add = complete::packages())]
        package: PackageName,
    },
    /// Show the differences between two versions of a package
    Diff {
        /// First version, as NAME:VERSION or NAME@DIGEST
        #[arg(add = complete::packages())]
        from: PackageName,
        /// Second version, as VERSION or DIGEST
        to: String,
    },
    /// Delete a version that no robot uses
    Rm {
        /// NAME:VERSION or NAME@DIGEST
        #[arg(add = complete::packages())]
        package: PackageName,
        /// Skip the confirmation prompt
        #[arg(short, long)]
        yes: bool,
    },
    /// Export a package to a directory or an archive
    Export {
        /// NAME (the newest version), NAME:VERSION or NAME@DIGEST
        #[arg(add = complete::packages())]
        package: PackageName,
        /// A new or empty directory, or a file that ends in .tar or .tar.zst [default: a directory
        /// with the package's name]
        to: Option<PathBuf>,
    },
}

/// A package reference from the command line.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PackageName {
    pub(crate) name: TaskName,
    /// A version or a manifest's digest.
    pub(crate) version: Option<String>,
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
        let name = name.parse().map_err(|error: task_proto::ids::InvalidId| error.to_string())?;
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

pub(crate) async fn run(session: &Session, action: Action) -> Result<Outcome, CommandError> {
    match action {
        Action::List { name } => list(session, name.as_ref()).await?,
        Action::Info { package } => info(session, &package).await?,
        Action::Files { package } => files(session, &package).await?,
        Action::Diff { from, to } => diff(session, &from, &to).await?,
        Action::Rm { package, yes } => {
            let Some(version) = &package.version else {
                let text = format!(
                    "{package}: a version is required: {package}:VERSION (see taskd package list {package})"
                );
                return Err(CommandError::Usage(text));
            };
            confirm_irreversible(&format!("delete the package {package}"), yes)?;
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
pub(crate) async fn find(
    session: &Session,
    package: &PackageName,
) -> Result<PackageView, CommandError> {
    let list: PackageList = session.client.get("/packages", &[]).await?;
    let is_requested = |view: &PackageView| {
        let known = &view.package;
        let version = package.version.as_deref();
        known.name == package.name
            && version.is_none_or(|version| {
                version == known.version.as_str() || version == known.manifest.digest.to_string()
            })
    };
    let found = list.packages.into_iter().find(is_requested);
    found.ok_or_else(|| CommandError::Usage(format!("package {package} not found on the server")))
}

const COLUMNS: Columns = Columns {
    name: "name",
    narrow: &["name", "version", "manifest", "size", "pushed"],
    wide: &["kind", "build", "ros", "arch", "unpacked", "digest"],
};

async fn list(session: &Session, name: Option<&TaskName>) -> Result<(), CommandError> {
    let mut list: PackageList = session.client.get("/packages", &[]).await?;
    list.packages.retain(|view| name.is_none_or(|name| view.package.name == *name));
    session.output.print_list(&list, &COLUMNS, |list| list.packages.iter().map(row).collect())
}

fn row(view: &PackageView) -> Vec<String> {
    let PackageView { package, pushed_at_ms, manifest } = view;
    vec![
        package.name.to_string(),
        package.version.to_string(),
        short_digest(&package.manifest.digest),
        format_bytes(package.content.size),
        time(*pushed_at_ms),
        kind(manifest).to_owned(),
        tool(manifest).to_owned(),
        join_or_any(&manifest.requires.ros_distro),
        join_or_any(&manifest.requires.arch),
        format_bytes(manifest.content.tar_size),
        package.manifest.digest.to_string(),
    ]
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

fn join_or_any(names: &[String]) -> String {
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
        return session.output.print_object(&view, name, |view| {
            describe(view, robot_count(&versions, &view.package.manifest.digest))
        });
    }
    session.output.print_list(&versions, &VERSIONS, |versions| {
        let row = |view: &PackageView| {
            let digest = &view.package.manifest.digest;
            vec![
                view.package.version.to_string(),
                short_digest(digest),
                format_bytes(view.package.content.size),
                time(view.pushed_at_ms),
                robot_count(versions, digest).to_string(),
                kind(&view.manifest).to_owned(),
                tool(&view.manifest).to_owned(),
                join_or_any(&view.manifest.requires.ros_distro),
                join_or_any(&view.manifest.requires.arch),
                digest.to_string(),
            ]
        };
        versions.versions.iter().map(row).collect()
    })
}

/// The number of robots that should run the package.
fn robot_count(versions: &PackageVersions, digest: &Digest) -> u64 {
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
        ("content", format!("{} ({})", package.content.digest, format_bytes(package.content.size))),
        ("unpacked", format!("{}, {} entries", format_bytes(content.tar_size), content.entries)),
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
            "requires",
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
    shown.push(("deployed to", robots(used)));
    facts(shown)
}

const FILES: Columns =
    Columns { name: "path", narrow: &["mode", "size", "path"], wide: &["digest"] };

async fn files(session: &Session, package: &PackageName) -> Result<(), CommandError> {
    let digest = find(session, package).await?.package.manifest.digest;
    let path = format!("/packages/{}/{digest}/files", package.name);
    let files: PackageFiles = session.client.get(&path, &[]).await?;
    session.output.print_list(&files, &FILES, |files| files.files.iter().map(file_row).collect())
}

fn file_row(file: &PackageFile) -> Vec<String> {
    let path = match &file.target {
        Some(target) => format!("{} -> {target}", file.path),
        None => file.path.clone(),
    };
    vec![
        format!("{}{}", type_letter(file.kind), permissions(file.mode)),
        if file.kind == PackageFileKind::File { format_bytes(file.size) } else { "-".to_owned() },
        path,
        file.digest.as_ref().map_or_else(|| "-".to_owned(), Digest::to_string),
    ]
}

fn type_letter(kind: PackageFileKind) -> char {
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
        return Err(CommandError::Usage(format!("{from}: a version is required: {from}:VERSION")));
    };
    // Either reference may be complete.
    let to = match to.parse::<PackageName>() {
        Ok(PackageName { name, version: Some(version) }) if name == from.name => version,
        _ => to.to_owned(),
    };
    let path = format!("/packages/{}/diff", from.name);
    let diff: PackageDiff =
        session.client.get(&path, &[("from", version.clone()), ("to", to)]).await?;
    session.output.print_list(&diff, &DIFFERENCES, difference_rows)?;
    if diff.manifest_changed {
        say("the manifests also differ (see taskd package info)");
    }
    let count = diff.added.len() + diff.removed.len() + diff.changed.len();
    say(&format!(
        "{} added, {} removed, {} changed",
        diff.added.len(),
        diff.removed.len(),
        diff.changed.len()
    ));
    if count == 0 && !diff.manifest_changed {
        say("no differences");
    }
    Ok(())
}

fn difference_rows(diff: &PackageDiff) -> Vec<Vec<String>> {
    let row = |change: &str, path: &str, from: Option<&PackageFile>, to: Option<&PackageFile>| {
        let shown =
            |file: Option<&PackageFile>| file.map_or_else(|| "-".to_owned(), describe_content);
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

fn describe_content(file: &PackageFile) -> String {
    match (file.kind, &file.target) {
        (PackageFileKind::File, _) if file.mode & 0o111 != 0 => {
            format!("{}, executable", format_bytes(file.size))
        }
        (PackageFileKind::File, _) => format_bytes(file.size),
        (PackageFileKind::Directory, _) => "directory".to_owned(),
        (PackageFileKind::Link, target) => format!("-> {}", target.as_deref().unwrap_or("?")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn package_names_round_trip() {
        let digest = Digest::of(b"x");
        for text in ["talker", "talker:1.0.0", &format!("talker@{digest}")] {
            assert_eq!(text.parse::<PackageName>().expect(text).to_string(), text);
        }
        for text in ["", ":1", "talker:", "talker:a b", "talker@1.0.0", "a/b"] {
            assert!(text.parse::<PackageName>().is_err(), "{text}");
        }
    }

    #[test]
    fn permissions_are_formatted_like_ls() {
        assert_eq!(permissions(0o755), "rwxr-xr-x");
        assert_eq!(permissions(0o640), "rw-r-----");
    }
}
