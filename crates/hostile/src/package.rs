//! The description of a package: the files its author wrote, and the manifest as robots read it.

use std::path::{Component, Path};

use task_agent::setup::launch;
use task_agent::setup::script::run_script;
use task_agent::system::layout::DataDir;
use task_proto::Digest;
use task_proto::packages::manifest::{Build, BuildTool, ContentFacts, TaskManifest};

use crate::messages::round_trip;

/// `task.toml`: a file without problems makes a manifest that robots read as written.
pub fn task_toml(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else { return };
    let mut problems = Vec::new();
    let file = task_package::task_toml::parse(text, &mut problems);
    let (Some(name), Some(version)) = (file.name, file.version) else { return };
    let manifest = TaskManifest {
        name,
        version,
        build: Build { tool: file.build_tool.unwrap_or_default() },
        run: file.run,
        ready: file.ready,
        parameters: file.parameters,
        outputs: file.outputs,
        requires: file.requires,
        limits: file.limits,
        exec_depends: Vec::new(),
        content: ContentFacts { tar_digest: Digest::of(b""), tar_size: 0, entries: 0 },
    };
    if problems.is_empty() {
        let written = serde_json::to_vec(&manifest).expect("a parsed value can be written");
        assert_eq!(
            serde_json::from_slice::<TaskManifest>(&written)
                .expect("a written value can be parsed"),
            manifest
        );
        self::manifest(&written);
    }
}

/// `package.xml`: each dependency is known once.
pub fn package_xml(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else { return };
    let Ok(xml) = task_package::package_xml::parse(text) else { return };
    for depends in [&xml.exec_depends, &xml.conditional_depends] {
        assert!(
            depends.is_sorted_by(|a, b| a < b) && depends.iter().all(|name| xml.depends_on(name))
        );
    }
}

/// A task manifest that breaks no rule: its paths stay in the task's own directory, and the start
/// script has each word in quotes, as one word.
pub fn manifest(bytes: &[u8]) {
    let Some(manifest) = round_trip::<TaskManifest>(bytes) else { return };
    let problems = manifest.problems();
    assert!(
        problems.iter().all(|problem| !problem.to_string().contains(char::is_control)),
        "{problems:?}"
    );
    if !problems.is_empty() {
        return;
    }
    for pattern in &manifest.outputs.paths {
        let path = Path::new(pattern);
        assert!(
            path.components().all(|part| matches!(part, Component::Normal(_) | Component::CurDir)),
            "{pattern:?}"
        );
    }
    let data = DataDir::new(Path::new("/data")).expect("absolute");
    let task = data.task(&manifest.name);
    let version = task.version(&Digest::of(b"manifest"));
    assert!(task.root().starts_with(data.root()) && version.root().starts_with(task.root()));
    let script = run_script(&manifest, &version, &[]);
    let last = script.lines().last().expect("a line");
    let words = words(last.strip_prefix("exec -- ").expect("the command"));
    assert_eq!(words, launch::of(&manifest).command);
    let lines = if manifest.build.tool == BuildTool::Colcon { 6 } else { 7 };
    assert_eq!(script.lines().count(), lines, "a value begins a line of its own:\n{script}");
}

/// The words of a shell line that has only words in single quotes.
fn words(line: &str) -> Vec<String> {
    let (mut words, mut rest) = (Vec::new(), line);
    loop {
        let mut word = String::new();
        loop {
            let (text, after) = rest
                .strip_prefix('\'')
                .and_then(|rest| rest.split_once('\''))
                .expect("a quoted text");
            word.push_str(text);
            rest = after;
            let Some(after) = rest.strip_prefix("\\'") else { break };
            word.push('\'');
            rest = after;
        }
        words.push(word);
        match rest.strip_prefix(' ') {
            Some(after) => rest = after,
            None => break,
        }
    }
    assert_eq!(rest, "", "shell behind the last word");
    words
}
