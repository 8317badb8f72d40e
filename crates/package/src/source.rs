//! A package directory's own description: `task.toml`, with absent keys taken from `package.xml`,
//! merged into a task manifest, and the files of the package. The reader collects all problems
//! before it gives up.

use std::fs;
use std::io;
use std::path::Path;

use task_proto::Digest;
use task_proto::ids::InvalidId;
use task_proto::packages::manifest::{Build, BuildTool, ContentFacts, TaskManifest};

use super::package_xml::{self, BuildType, PackageXml};
use super::task_toml::{self, TaskToml};
use super::text_file::read_text;
use super::tree::Tree;
use super::{Launch, PackageError, Problem, rules};

/// A directory that can become a package.
#[derive(Debug)]
pub(super) struct Source {
    /// The manifest; its content facts are zeros until the content is packed.
    pub(super) manifest: TaskManifest,
    pub(super) tree: Tree,
}

/// Reads and checks `dir`, with `launch` in place of its own launch file if given.
pub(super) fn read(dir: &Path, launch: Option<&Launch>) -> Result<Source, PackageError> {
    let invalid = |problems| PackageError::Invalid { dir: dir.to_owned(), problems };
    let not_a_directory = |reason: &str| {
        invalid(vec![Problem { file: dir.display().to_string(), reason: reason.to_owned() }])
    };
    match fs::metadata(dir) {
        Ok(metadata) if metadata.is_dir() => {}
        Ok(_) => return Err(not_a_directory("is not a directory")),
        Err(error) if error.kind() == io::ErrorKind::NotFound => {
            return Err(not_a_directory("no such directory"));
        }
        Err(source) => {
            return Err(PackageError::Io { what: format!("can't read {}", dir.display()), source });
        }
    }
    let mut problems = Vec::new();
    let toml = read_text(dir, task_toml::FILE, &mut problems)?;
    let xml = read_text(dir, package_xml::FILE, &mut problems)?;
    // Without task.toml, the caller has to provide the launch file.
    let has_launch_file = launch.is_some() && xml.is_some();
    if toml.is_none() && !has_launch_file && problems.is_empty() {
        let reason = match xml {
            Some(_) => {
                "is missing; package.xml does not specify how to run the package: add [run] with launch or exec"
            }
            None => {
                "is missing, as is package.xml; a package needs at least a task.toml with name, version and [run]"
            }
        };
        problems.push(Problem { file: task_toml::FILE.to_owned(), reason: reason.to_owned() });
        return Err(invalid(problems));
    }
    let before = problems.len();
    let mut toml = toml.map(|text| task_toml::parse(&text, &mut problems)).unwrap_or_default();
    // A key with an invalid value must not be reported as absent as well.
    let toml_is_complete = problems.len() == before;
    let xml = xml.and_then(|text| match package_xml::parse(&text) {
        Ok(xml) => Some(xml),
        Err(reason) => {
            problems.push(Problem { file: package_xml::FILE.to_owned(), reason });
            None
        }
    });
    if let Some(launch) = launch {
        let name = xml
            .as_ref()
            .map(|xml| xml.name.clone())
            .or_else(|| toml.name.as_ref().map(ToString::to_string));
        launch.apply(&mut toml.run, &mut toml.ready, &name.unwrap_or_default());
    }
    let tool = build_tool(&toml, xml.as_ref(), &mut problems);
    let tree = Tree::walk(dir, tool != BuildTool::None, &mut problems)?;
    let manifest = merge(toml, toml_is_complete, xml.as_ref(), tool, &mut problems);
    match manifest {
        Some(mut manifest) if toml_is_complete => {
            rules::check(&manifest, &tree, &mut problems)?;
            // A robot looks for the others among its own packages.
            manifest.exec_depends.retain(|name| !rules::is_in_install_tree(&tree, name));
            if problems.is_empty() { Ok(Source { manifest, tree }) } else { Err(invalid(problems)) }
        }
        _ => Err(invalid(problems)),
    }
}

/// `build.tool`, or the build tool implied by `package.xml`.
fn build_tool(toml: &TaskToml, xml: Option<&PackageXml>, problems: &mut Vec<Problem>) -> BuildTool {
    let (None, Some(xml)) = (toml.build_tool, xml) else {
        return toml.build_tool.unwrap_or(BuildTool::None);
    };
    let reason = match &xml.build_type {
        BuildType::One(name) => match name.as_str() {
            "ament_python" | "ament_cmake" | "cmake" => return BuildTool::Colcon,
            "catkin" => return BuildTool::Catkin,
            other => format!(
                "export.build_type: {other:?} is not one of ament_python, ament_cmake, cmake and catkin"
            ),
        },
        BuildType::Absent => "export.build_type: is missing".to_owned(),
        BuildType::Several(names) => {
            format!("export.build_type: multiple values ({})", names.join(", "))
        }
    };
    let reason =
        format!("{reason}; set build.tool in task.toml: \"colcon\", \"catkin\" or \"none\"");
    problems.push(Problem { file: package_xml::FILE.to_owned(), reason });
    BuildTool::None
}

/// The manifest, if name and version are present. `task.toml` wins.
fn merge(
    toml: TaskToml,
    toml_is_complete: bool,
    xml: Option<&PackageXml>,
    tool: BuildTool,
    problems: &mut Vec<Problem>,
) -> Option<TaskManifest> {
    let mut missing = |key: &'static str, text: Option<&String>, invalid: Option<InvalidId>| {
        let reason = match (text.filter(|text| !text.is_empty()), invalid) {
            (Some(_), Some(invalid)) => {
                format!("<{key}>: {invalid}; set another {key} in task.toml")
            }
            _ if toml_is_complete => {
                let hint = if xml.is_some() { ", also in package.xml" } else { "" };
                problems.push(Problem {
                    file: task_toml::FILE.to_owned(),
                    reason: format!("{key}: is missing{hint}"),
                });
                return;
            }
            _ => return,
        };
        problems.push(Problem { file: package_xml::FILE.to_owned(), reason });
    };
    let name = toml.name.or_else(|| {
        let text = xml.map(|xml| &xml.name);
        let parsed = text.map(|text| text.parse());
        if !matches!(parsed, Some(Ok(_))) {
            missing("name", text, parsed.clone().and_then(Result::err));
        }
        parsed.and_then(Result::ok)
    });
    let version = toml.version.or_else(|| {
        let text = xml.map(|xml| &xml.version);
        let parsed = text.map(|text| text.parse());
        if !matches!(parsed, Some(Ok(_))) {
            missing("version", text, parsed.clone().and_then(Result::err));
        }
        parsed.and_then(Result::ok)
    });
    Some(TaskManifest {
        name: name?,
        version: version?,
        build: Build { tool },
        run: toml.run,
        ready: toml.ready,
        parameters: toml.parameters,
        outputs: toml.outputs,
        requires: toml.requires,
        limits: toml.limits,
        exec_depends: xml.map(|xml| xml.exec_depends.clone()).unwrap_or_default(),
        content: ContentFacts { tar_digest: Digest::of(b""), tar_size: 0, entries: 0 },
    })
}
