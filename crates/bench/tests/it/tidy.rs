//! Holds the countable rules of style: each file states its purpose, files and functions stay
//! short, and each test that the lists of attacks name exists. The test reads formatted source as
//! text and never judges anything that needs understanding.

use std::path::{Path, PathBuf};

/// Lines of a file before its unit tests.
const MAX_FILE_LINES: usize = 660;
/// Lines of a function, from its signature to its closing brace.
const MAX_FUNCTION_LINES: usize = 96;

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
        problems.push(format!("{name}: does not begin with //! and its purpose"));
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
fn files_and_functions_follow_the_rules() {
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

/// The entries of the list of attacks: the items below the page's heading "Attacks", each joined to
/// one line.
fn attacks(page: &str) -> Vec<String> {
    let mut entries: Vec<String> = Vec::new();
    let mut is_entry = false;
    let section = page.lines().skip_while(|line| *line != "## Attacks").skip(1);
    for line in section.take_while(|line| !line.starts_with("## ")) {
        if let Some(first) = line.strip_prefix("- ") {
            entries.push(first.to_owned());
            is_entry = true;
        } else if let (true, Some(entry), Some(rest)) =
            (is_entry, entries.last_mut(), line.strip_prefix("  "))
        {
            *entry += " ";
            *entry += rest.trim_start();
        } else {
            is_entry = false;
        }
    }
    entries
}

/// The tests that an entry names: the texts in backquotes after "Tests:".
fn tests_named(entry: &str) -> Vec<&str> {
    let tests = entry.split_once(" Tests: ").map_or("", |(_, tests)| tests);
    tests.split('`').skip(1).step_by(2).collect()
}

#[test]
fn every_test_in_a_list_of_attacks_exists() {
    let crates = Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("workspace");
    let mut files = Vec::new();
    rust_files(crates, &mut files);
    // The page's are not in Rust.
    let page_tests = std::fs::read_dir(crates.join("server/tests/page")).expect("readable");
    files.extend(page_tests.map(|entry| entry.expect("an entry").path()));
    let sources: Vec<String> =
        files.iter().map(|path| std::fs::read_to_string(path).expect("readable")).collect();
    for (name, least) in [("people.md", 30), ("security.md", 130)] {
        let page =
            std::fs::read_to_string(crates.join("../docs").join(name)).expect("readable page");
        let entries = attacks(&page);
        assert!(entries.len() >= least, "found only {} attacks in {name}", entries.len());
        let untested: Vec<_> =
            entries.iter().filter(|entry| tests_named(entry).is_empty()).collect();
        assert!(untested.is_empty(), "docs/{name} names no test for {untested:?}");
        let is_there = |test: &str| {
            sources.iter().any(|source| {
                source.contains(&format!("fn {test}("))
                    || source.contains(&format!("\ntest('{test}'"))
            })
        };
        let named = entries.iter().flat_map(|entry| tests_named(entry));
        let absent: Vec<_> = named.filter(|test| !is_there(test)).collect();
        assert!(absent.is_empty(), "docs/{name} names tests that are not there: {absent:?}");
    }
}

#[test]
fn attacks_are_read_with_their_tests() {
    let page = "- no\n## Attacks\n\nText\n  `no`\n- ✓ **A `no`.** B. Tests:\n  `x_y`, `z\n  w`\n\n\
                ### C\n\n- **D.** `no`\n\n## E\n- Tests: `no`\n";
    let entries = attacks(page);
    assert_eq!(entries, ["✓ **A `no`.** B. Tests: `x_y`, `z w`", "**D.** `no`"]);
    assert_eq!(tests_named(&entries[0]), ["x_y", "z w"]);
    assert_eq!(tests_named(&entries[1]), [""; 0]);
}

#[test]
fn rule_violations_are_found() {
    assert_eq!(problems("a.rs", "//! A.\n\nfn short() {\n}\n"), Vec::<String>::new());
    assert_eq!(problems("a.rs", "fn short() {}\n").len(), 1);
    let long_function = format!(
        "//! A.\n\n    pub(crate) async fn long(\n    ) {{\n{}    }}\n",
        "        x();\n".repeat(MAX_FUNCTION_LINES)
    );
    assert_eq!(problems("a.rs", &long_function).len(), 1);
    assert_eq!(problems("a.rs", &format!("//! A.\n{}", "x\n".repeat(MAX_FILE_LINES))).len(), 1);
}
