//! Holds the countable rules of style: each file says what it is for, files and functions stay short.
//! It reads formatted source as text and never judges anything that needs understanding.

use std::path::{Path, PathBuf};

/// Lines of a file before its unit tests.
const MAX_FILE_LINES: usize = 550;
/// Lines of a function, from its signature to its closing brace.
const MAX_FUNCTION_LINES: usize = 80;

fn rust_files(dir: &Path, found: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(dir).expect("readable directory") {
        let path = entry.expect("entry").path();
        if path.is_dir() && path.file_name().is_some_and(|name| name != "target") {
            rust_files(&path, found);
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            found.push(path);
        }
    }
}

/// The functions of formatted source: name and number of lines. A function ends at the first closing brace that is
/// indented as its signature is.
fn function_lengths(source: &str) -> Vec<(String, usize)> {
    let lines: Vec<&str> = source.lines().collect();
    let mut lengths = Vec::new();
    for (start, line) in lines.iter().enumerate() {
        let code = line.trim_start();
        let indent = line.len() - code.len();
        let (qualifiers, name) = code.split_once("fn ").unwrap_or(("not a signature", ""));
        let is_signature = qualifiers
            .split_whitespace()
            .all(|word| word.starts_with("pub") || matches!(word, "async" | "const" | "unsafe" | "extern" | "\"C\""));
        if !is_signature || code.ends_with(';') || code.ends_with('}') {
            continue;
        }
        let end = lines[start..]
            .iter()
            .position(|l| l.trim_start().starts_with('}') && l.len() - l.trim_start().len() == indent);
        lengths.push((name.split('(').next().unwrap_or(name).to_owned(), end.map_or(1, |end| end + 1)));
    }
    lengths
}

fn problems(name: &str, source: &str) -> Vec<String> {
    let mut problems = Vec::new();
    if !source.starts_with("//!") {
        problems.push(format!("{name}: does not begin with //! and what the file is for"));
    }
    let body = source.split("\n#[cfg(test)]\nmod tests").next().unwrap_or(source);
    let length = body.lines().count();
    if length > MAX_FILE_LINES {
        problems.push(format!("{name}: {length} lines before its tests, more than {MAX_FILE_LINES}: split it by noun"));
    }
    for (function, length) in function_lengths(body) {
        if length > MAX_FUNCTION_LINES {
            problems.push(format!("{name}: {function} has {length} lines, more than {MAX_FUNCTION_LINES}"));
        }
    }
    problems
}

#[test]
fn files_and_functions_are_tidy() {
    let crates = Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("workspace");
    let mut files = Vec::new();
    rust_files(crates, &mut files);
    assert!(files.len() > 20, "found only {} files below {}", files.len(), crates.display());
    let found: Vec<String> = files
        .iter()
        .flat_map(|path| {
            let source = std::fs::read_to_string(path).expect("readable source");
            problems(&path.strip_prefix(crates).expect("below crates").display().to_string(), &source)
        })
        .collect();
    assert!(found.is_empty(), "\n{}", found.join("\n"));
}

#[test]
fn untidy_source_is_found() {
    assert_eq!(problems("a.rs", "//! A.\n\nfn short() {\n}\n"), Vec::<String>::new());
    assert_eq!(problems("a.rs", "fn short() {}\n").len(), 1);
    let long_function = format!(
        "//! A.\n\n    pub(crate) async fn long(\n    ) {{\n{}    }}\n",
        "        x();\n".repeat(MAX_FUNCTION_LINES)
    );
    assert_eq!(problems("a.rs", &long_function).len(), 1);
    assert_eq!(problems("a.rs", &format!("//! A.\n{}", "x\n".repeat(MAX_FILE_LINES))).len(), 1);
}
