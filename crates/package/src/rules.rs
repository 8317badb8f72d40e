//! Checks whether a package could be built and started: the manifest against the package's files.
//! Conditions that only a robot can check (its underlay, its architecture) are left to the robot.

use task_proto::packages::manifest::{BuildTool, TaskManifest};

use super::package_xml::{self, PackageXml};
use super::text_file::read_text;
use super::tree::{Entry, Tree};
use super::{PackageError, Problem, task_toml};

/// A ROS package in the tree.
struct RosPackage {
    /// Its directory; empty for the top.
    directory: String,
    xml: PackageXml,
}

/// Adds every reason why `manifest` and `tree` could not run to `problems`.
pub(super) fn check(
    manifest: &TaskManifest,
    tree: &Tree,
    problems: &mut Vec<Problem>,
) -> Result<(), PackageError> {
    for problem in manifest.problems() {
        problems.push(Problem { file: task_toml::FILE.to_owned(), reason: problem.to_string() });
    }
    let built = manifest.build.tool != BuildTool::None;
    let packages = if built { ros_packages(tree, problems)? } else { Vec::new() };
    if built {
        check_build(manifest.build.tool, &packages, tree, problems);
    }
    check_install_tree(tree, problems);
    if let Some([package, file]) = &manifest.run.launch {
        check_launch(manifest, tree, &packages, [package, file], problems);
    }
    if let Some(command) = manifest.run.exec.as_ref().and_then(|exec| exec.first()) {
        check_exec(manifest.build.tool, tree, &packages, command, problems);
    }
    Ok(())
}

/// Marker files that make build tools skip their directory.
const IGNORED_BY: [&str; 3] = ["COLCON_IGNORE", "AMENT_IGNORE", "CATKIN_IGNORE"];

/// Every package.xml in the tree, as the build tool will find them.
fn ros_packages(tree: &Tree, problems: &mut Vec<Problem>) -> Result<Vec<RosPackage>, PackageError> {
    const MAX_PACKAGES: usize = 1000;
    let mut packages = Vec::new();
    let found = tree
        .entries
        .keys()
        .filter(|path| file_name(path) == package_xml::FILE && is_searched(tree, parent(path)));
    for path in found.take(MAX_PACKAGES) {
        let Some(text) = read_text(&tree.root, path, problems)? else { continue };
        let directory = parent(path).to_owned();
        match package_xml::parse(&text) {
            Ok(xml) => packages.push(RosPackage { directory, xml }),
            // The package.xml at the top was read, and its errors were reported, before.
            Err(_) if directory.is_empty() => {}
            Err(reason) => problems.push(Problem { file: path.clone(), reason }),
        }
    }
    Ok(packages)
}

/// Whether build tools search `directory` for a package: not with a marker file, and not below
/// another package.
fn is_searched(tree: &Tree, directory: &str) -> bool {
    let has = |directory: &str, file: &str| match directory {
        "" => tree.entries.contains_key(file),
        directory => tree.entries.contains_key(&format!("{directory}/{file}")),
    };
    let is_ignored = |directory: &str| IGNORED_BY.iter().any(|file| has(directory, file));
    let mut above =
        std::iter::successors(Some(directory), |below| (!below.is_empty()).then(|| parent(below)));
    above.all(|at| !is_ignored(at) && (at == directory || !has(at, package_xml::FILE)))
}

/// The parent directory of a path; "" at the top.
fn parent(path: &str) -> &str {
    path.rsplit_once('/').map_or("", |(parent, _)| parent)
}

fn file_name(path: &str) -> &str {
    path.rsplit_once('/').map_or(path, |(_, name)| name)
}

fn check_build(tool: BuildTool, packages: &[RosPackage], tree: &Tree, problems: &mut Vec<Problem>) {
    let name = if tool == BuildTool::Colcon { "colcon" } else { "catkin" };
    if packages.is_empty() {
        let reason = format!(
            "build.tool: {name} needs a package.xml, which is missing; use \"none\" for plain files"
        );
        problems.push(Problem { file: task_toml::FILE.to_owned(), reason });
    }
    for RosPackage { directory, xml } in packages {
        let at = |file: &str| {
            if directory.is_empty() { file.to_owned() } else { format!("{directory}/{file}") }
        };
        for reason in &xml.invalid {
            let reason = format!("{reason}; {name} would silently ignore the package");
            problems.push(Problem { file: at(package_xml::FILE), reason });
        }
        let build_file = match &xml.build_type {
            package_xml::BuildType::One(kind) if kind == "ament_python" => "setup.py",
            package_xml::BuildType::One(kind)
                if matches!(kind.as_str(), "ament_cmake" | "cmake" | "catkin") =>
            {
                "CMakeLists.txt"
            }
            _ => continue,
        };
        if tree.resolve(&at(build_file)).is_none() {
            problems.push(Problem {
                file: at(build_file),
                reason: format!("is missing; {name} needs it to build {:?}", xml.name),
            });
        }
    }
}

/// Traces of `colcon build --symlink-install` that are no links: they name directories of the
/// machine that built.
fn check_install_tree(tree: &Tree, problems: &mut Vec<Problem>) {
    let develop = |path: &&String| path.starts_with("install/") && path.ends_with(".egg-link");
    if let Some(path) = tree.entries.keys().find(develop) {
        let reason = "points into the build directory: the tree was built with --symlink-install and is incomplete \
                      without it; rebuild without --symlink-install";
        problems.push(Problem { file: path.clone(), reason: reason.to_owned() });
    }
}

fn check_launch(
    manifest: &TaskManifest,
    tree: &Tree,
    packages: &[RosPackage],
    [package, file]: [&str; 2],
    problems: &mut Vec<Problem>,
) {
    let mut refuse = |reason: String| {
        problems.push(Problem {
            file: task_toml::FILE.to_owned(),
            reason: format!("run.launch: {reason}"),
        })
    };
    let has_file = |prefix: &str| {
        tree.entries.iter().any(|(path, entry)| {
            *entry != Entry::Directory
                && path
                    .strip_prefix(prefix)
                    .is_some_and(|rest| rest == file || rest.ends_with(&format!("/{file}")))
        })
    };
    if manifest.build.tool == BuildTool::None {
        let shares = shares(package);
        if !is_in_install_tree(tree, package) {
            refuse(format!(
                "needs a package.xml to build {package:?} from, or an install/ tree that contains it"
            ));
        } else if !shares.iter().any(|share| has_file(share)) {
            refuse(format!("{file:?} is not in the install tree under share/{package}"));
        }
        return;
    }
    match packages.iter().find(|candidate| candidate.xml.name == package) {
        Some(found) => {
            let prefix = if found.directory.is_empty() {
                String::new()
            } else {
                format!("{}/", found.directory)
            };
            if !has_file(&prefix) {
                refuse(format!("{file:?} is not in the package {package:?}"));
            }
        }
        None if packages.iter().any(|found| found.xml.depends_on(package)) => {}
        None => refuse(format!(
            "{package:?} is neither in this directory nor an exec_depend of package.xml"
        )),
    }
}

/// Directories of an install tree with the share files of `package`: isolated or merged, and in
/// install/ or the directory itself.
fn shares(package: &str) -> [String; 4] {
    let isolated = |top: &str| format!("{top}{package}/share/{package}/");
    let merged = |top: &str| format!("{top}share/{package}/");
    [isolated("install/"), merged("install/"), isolated(""), merged("")]
}

/// Whether the tree brings `package` built.
pub(super) fn is_in_install_tree(tree: &Tree, package: &str) -> bool {
    let shares = shares(package);
    tree.entries.keys().any(|path| shares.iter().any(|share| path.starts_with(share)))
}

/// A command with a slash is a file of the package, unless the path is absolute. docs/package.md
/// describes the base directory of relative paths.
fn check_exec(
    tool: BuildTool,
    tree: &Tree,
    packages: &[RosPackage],
    command: &str,
    problems: &mut Vec<Problem>,
) {
    if !command.contains('/') || command.starts_with('/') {
        return;
    }
    let mut refuse = |reason: String| {
        problems.push(Problem {
            file: task_toml::FILE.to_owned(),
            reason: format!("run.exec: {reason}"),
        })
    };
    let path = command.trim_start_matches("./");
    let in_tree = match tool {
        BuildTool::None => path,
        BuildTool::Colcon | BuildTool::Catkin => {
            match (path.strip_prefix("src/"), path.strip_prefix("install/")) {
                (Some(path), _) => path,
                (None, Some(product)) => {
                    let package = product.split('/').next().unwrap_or_default();
                    let shared = ["bin", "lib", "share"].contains(&package);
                    if !shared
                        && !packages.is_empty()
                        && !packages.iter().any(|found| found.xml.name == package)
                    {
                        refuse(format!("{command:?}: this directory has no package {package:?}"));
                    }
                    return;
                }
                (None, None) => {
                    refuse(format!(
                        "{command:?}: the path of a built package must start with src/ or install/"
                    ));
                    return;
                }
            }
        }
    };
    match tree.resolve(in_tree) {
        Some(Entry::File { executable: true, .. }) => {}
        Some(Entry::File { .. }) => refuse(format!(
            "{command:?} is not executable; use chmod +x, or specify its interpreter"
        )),
        Some(_) => refuse(format!("{command:?} is not a file")),
        None => refuse(format!("{command:?} is not in this directory")),
    }
}
