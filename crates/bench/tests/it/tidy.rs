//! Holds the countable rules of style: each file states its purpose, files and functions stay
//! short, and each test that the table of attacks names exists. The test reads formatted source as
//! text and never judges anything that needs understanding.

use std::path::{Path, PathBuf};

/// Lines of a file before its unit tests.
const MAX_FILE_LINES: usize = 700;
/// Lines of a function, from its signature to its closing brace.
const MAX_FUNCTION_LINES: usize = 130;

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

/// The functions of formatted source: name and number of lines. A function ends at the first
/// closing brace that is indented as its signature is.
fn function_lengths(source: &str) -> Vec<(String, usize)> {
    let lines: Vec<&str> = source.lines().collect();
    let mut lengths = Vec::new();
    for (start, line) in lines.iter().enumerate() {
        let code = line.trim_start();
        let indent = line.len() - code.len();
        let (qualifiers, name) = code.split_once("fn ").unwrap_or(("not a signature", ""));
        let is_signature = qualifiers.split_whitespace().all(|word| {
            word.starts_with("pub")
                || matches!(word, "async" | "const" | "unsafe" | "extern" | "\"C\"")
        });
        if !is_signature || code.ends_with(';') || code.ends_with('}') {
            continue;
        }
        let end = lines[start..].iter().position(|l| {
            l.trim_start().starts_with('}') && l.len() - l.trim_start().len() == indent
        });
        lengths.push((
            name.split('(').next().unwrap_or(name).to_owned(),
            end.map_or(1, |end| end + 1),
        ));
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
        problems.push(format!(
            "{name}: {length} lines before its tests, more than {MAX_FILE_LINES}: split it by noun"
        ));
    }
    for (function, length) in function_lengths(body) {
        if length > MAX_FUNCTION_LINES {
            problems.push(format!(
                "{name}: {function} has {length} lines, more than {MAX_FUNCTION_LINES}"
            ));
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
            problems(
                &path.strip_prefix(crates).expect("below crates").display().to_string(),
                &source,
            )
        })
        .collect();
    assert!(found.is_empty(), "\n{}", found.join("\n"));
}

/// The texts in backquotes in the column "shown by" of a page's tables.
fn tests_named(page: &str) -> Vec<&str> {
    let (mut column, mut named) = (None, Vec::new());
    for line in page.lines() {
        let cells: Vec<&str> = line.split('|').map(str::trim).collect();
        match cells.iter().position(|cell| *cell == "shown by") {
            Some(at) => column = Some(at),
            None if !line.starts_with('|') => column = None,
            None => {}
        }
        if let Some(cell) = column.and_then(|at| cells.get(at)) {
            named.extend(cell.split('`').skip(1).step_by(2));
        }
    }
    named
}

#[test]
fn every_test_in_a_table_of_attacks_exists() {
    let crates = Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("workspace");
    let mut files = Vec::new();
    rust_files(crates, &mut files);
    // The page's are not in Rust.
    let page_tests = std::fs::read_dir(crates.join("server/tests/page")).expect("readable");
    files.extend(page_tests.map(|entry| entry.expect("an entry").path()));
    let sources: Vec<String> =
        files.iter().map(|path| std::fs::read_to_string(path).expect("readable")).collect();
    for (name, least) in [("people.md", 20), ("security.md", 40)] {
        let page =
            std::fs::read_to_string(crates.join("../docs").join(name)).expect("readable page");
        let named = tests_named(&page);
        assert!(named.len() >= least, "found only {} tests in the tables of {name}", named.len());
        let is_there = |test: &str| {
            sources.iter().any(|source| {
                source.contains(&format!("fn {test}("))
                    || source.contains(&format!("\ntest('{test}'"))
            })
        };
        let absent: Vec<_> = named.iter().filter(|test| !is_there(test)).collect();
        assert!(absent.is_empty(), "docs/{name} names tests that are not there: {absent:?}");
    }
    let page = "| a | shown by |\n|---|---|\n| `no` | `x_y`, `z` |\n\n| b | c |\n| d | `no` |\n";
    assert_eq!(tests_named(page), ["x_y", "z"]);
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
