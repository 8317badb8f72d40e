//! Holds the order of the modules. ARCHITECTURE.md has a table of the rooms of each crate, from top
//! to bottom, and one of the rooms of the page; this test compares them with the paths in the source
//! and with the page's imports. A room uses only the rooms that its row names, all of them below it,
//! and modules never use each other in a circle.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use proc_macro2::{TokenStream, TokenTree};

/// Entries of a directory of source beside its `mod.rs`, `lib.rs` and `main.rs`.
const MAX_ENTRIES: usize = 14;
/// The page's modules and styles.
const PAGE: &str = "crates/server/ui";
/// The server serves the files of the page below this path.
const PAGE_URL: &str = "/ui/";

/// A row of a table of rooms.
#[derive(Debug, PartialEq, Eq)]
struct Row {
    room: String,
    owns: String,
    uses: Vec<String>,
}

/// A module of a crate by its path, and the paths in the same crate that its file names.
#[derive(Debug)]
struct Module {
    path: Vec<String>,
    uses: BTreeSet<Vec<String>>,
}

fn repository() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").canonicalize().expect("the repository")
}

/// The tables whose first header cell is a directory of source, by that directory.
fn tables(page: &str) -> BTreeMap<String, Vec<Row>> {
    let mut tables: BTreeMap<String, Vec<Row>> = BTreeMap::new();
    let mut directory = None;
    for line in page.lines() {
        let cells: Vec<&str> = line.trim().trim_matches('|').split(" | ").map(str::trim).collect();
        match (line.starts_with('|'), cells.as_slice()) {
            (true, [name, "owns", "may use"]) if name.starts_with("crates/") => {
                directory = Some((*name).to_owned())
            }
            (true, [room, owns, uses]) if directory.is_some() && !room.starts_with("--") => {
                let named = |text: &str| {
                    text.split('`').skip(1).step_by(2).map(str::to_owned).collect::<Vec<_>>()
                };
                let row =
                    Row { room: named(room).concat(), owns: (*owns).to_owned(), uses: named(uses) };
                tables.entry(directory.clone().unwrap_or_default()).or_default().push(row);
            }
            (true, _) => {}
            (false, _) => directory = None,
        }
    }
    tables
}

/// The first paragraph of the comment that opens a file, on one line. `mark` begins its lines.
fn first_paragraph(source: &str, mark: &str) -> String {
    let lines = source.lines().map_while(|line| line.strip_prefix(mark)).map(str::trim);
    lines.take_while(|line| !line.is_empty()).collect::<Vec<_>>().join(" ")
}

/// All paths that begin with `crate`, `super` or `self`, tests left out.
fn paths(tokens: TokenStream, found: &mut Vec<Vec<String>>) {
    let tokens: Vec<TokenTree> = tokens.into_iter().collect();
    let mut at = 0;
    while at < tokens.len() {
        match &tokens[at] {
            TokenTree::Ident(name) if name == "mod" && is_ident(tokens.get(at + 1), "tests") => {
                at += 2
            }
            TokenTree::Ident(name)
                if ["crate", "super", "self"].contains(&name.to_string().as_str()) =>
            {
                path(&tokens, at, Vec::new(), found);
            }
            TokenTree::Group(group) => paths(group.stream(), found),
            _ => {}
        }
        at += 1;
    }
}

fn is_ident(token: Option<&TokenTree>, name: &str) -> bool {
    matches!(token, Some(TokenTree::Ident(ident)) if ident == name)
}

fn is_mark(token: Option<&TokenTree>, expected: char) -> bool {
    matches!(token, Some(TokenTree::Punct(mark)) if mark.as_char() == expected)
}

/// Follows one path from `at`; a group of a `use` continues it in several ways.
fn path(
    tokens: &[TokenTree],
    mut at: usize,
    mut segments: Vec<String>,
    found: &mut Vec<Vec<String>>,
) {
    loop {
        match tokens.get(at) {
            Some(TokenTree::Ident(name)) => segments.push(name.to_string()),
            Some(TokenTree::Group(group)) => {
                let inside: Vec<TokenTree> = group.stream().into_iter().collect();
                let is_comma = |token: &TokenTree| is_mark(Some(token), ',');
                inside.split(is_comma).for_each(|item| path(item, 0, segments.clone(), found));
                return;
            }
            _ => break,
        }
        if !is_mark(tokens.get(at + 1), ':') || !is_mark(tokens.get(at + 2), ':') {
            break;
        }
        at += 3;
    }
    found.push(segments);
}

/// A path as seen from the crate, for a module that names it.
fn absolute(module: &[String], path: &[String]) -> Option<Vec<String>> {
    let mut base = module.to_vec();
    let mut rest = path;
    match path.first().map(String::as_str)? {
        "crate" => {
            base.clear();
            rest = &path[1..];
        }
        "self" => rest = &path[1..],
        _ => {
            while let Some(("super", after)) =
                rest.split_first().map(|(first, after)| (first.as_str(), after))
            {
                base.pop()?;
                rest = after;
            }
        }
    }
    base.extend(rest.iter().cloned());
    Some(base)
}

/// The modules below `source`, the crate's own files at the top included.
fn modules(source: &Path) -> Vec<Module> {
    let mut modules = Vec::new();
    let mut directories = vec![source.to_owned()];
    while let Some(directory) = directories.pop() {
        for entry in fs::read_dir(&directory).expect("a directory") {
            let file = entry.expect("an entry").path();
            if file.is_dir() {
                directories.push(file);
                continue;
            }
            let stem = file.file_stem().and_then(|stem| stem.to_str()).unwrap_or_default();
            if file.extension().is_none_or(|extension| extension != "rs") || stem == "tests" {
                continue;
            }
            let inside = file.strip_prefix(source).expect("below the source");
            let parents =
                inside.parent().into_iter().flat_map(Path::iter).filter_map(|name| name.to_str());
            let mut path: Vec<String> = parents.map(str::to_owned).collect();
            if path.iter().any(|name| name == "tests") {
                continue;
            }
            if !["mod", "lib", "main"].contains(&stem) {
                path.push(stem.to_owned());
            }
            let text = fs::read_to_string(&file).expect("source");
            let tokens: TokenStream =
                text.parse().unwrap_or_else(|error| panic!("{}: {error}", file.display()));
            let mut found = Vec::new();
            paths(tokens, &mut found);
            let uses = found.iter().filter_map(|used| absolute(&path, used)).collect();
            modules.push(Module { path, uses });
        }
    }
    modules
}

/// The files of the page that a module of it loads, as they stand in the source: imports, dynamic
/// imports and workers.
fn imports(source: &str) -> Vec<&str> {
    let code = source.lines().filter(|line| !line.trim_start().starts_with(['/', '*']));
    let loads = ["from '", "import '", "import('", "Worker('"];
    code.flat_map(|line| loads.iter().filter_map(move |load| Some(line.split_once(load)?.1)))
        .filter_map(|rest| Some(rest.split_once('\'')?.0))
        .filter(|name| name.starts_with('.') || name.starts_with(PAGE_URL))
        .collect()
}

/// The path of a module of the page that `from` imports as `name`: a list of directories, and the
/// name without its extension. None if it is not of JavaScript or leaves the page.
fn imported(from: &[String], name: &str) -> Option<Vec<String>> {
    let (mut path, relative) = match name.strip_prefix(PAGE_URL) {
        Some(name) => (Vec::new(), name),
        None => (from[..from.len().checked_sub(1)?].to_vec(), name),
    };
    for segment in relative.strip_suffix(".js")?.split('/') {
        match segment {
            "." => {}
            ".." => drop(path.pop()?),
            name => path.push(name.to_owned()),
        }
    }
    Some(path)
}

/// The modules of the page below `source`, without those of others in `vendor`.
fn page_modules(source: &Path) -> Vec<Module> {
    let mut modules = Vec::new();
    let mut directories = vec![source.to_owned()];
    while let Some(directory) = directories.pop() {
        for entry in fs::read_dir(&directory).expect("a directory") {
            let file = entry.expect("an entry").path();
            if file.is_dir() && !file.ends_with("vendor") {
                directories.push(file);
            } else if file.extension().is_some_and(|extension| extension == "js") {
                let inside = file.strip_prefix(source).expect("below the source");
                let inside = inside.with_extension("");
                let path: Vec<String> =
                    inside.iter().filter_map(|name| name.to_str()).map(str::to_owned).collect();
                let text = fs::read_to_string(&file).expect("source");
                modules.push(page_module(path, &text));
            }
        }
    }
    modules
}

fn page_module(path: Vec<String>, source: &str) -> Module {
    let found = imports(source).into_iter().map(|name| {
        imported(&path, name).unwrap_or_else(|| panic!("{} imports {name}", path.join("/")))
    });
    let uses = found.collect();
    Module { path, uses }
}

/// Imports of files that do not exist, and circles of files: in JavaScript each file is a module of
/// its own, also the one that a directory is named after.
fn page_violations(modules: &[Module], exists: impl Fn(&str) -> bool) -> Vec<String> {
    let mut violations = Vec::new();
    let mut graph: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    for Module { path, uses } in modules {
        let module = path.join("/");
        let uses: BTreeSet<String> = uses.iter().map(|used| used.join("/")).collect();
        let absent = uses.iter().filter(|used| !exists(used));
        violations
            .extend(absent.map(|used| format!("{module} imports {used}, which is not there")));
        graph.insert(module, uses);
    }
    let names: Vec<String> = graph.keys().cloned().collect();
    graph.values_mut().for_each(|uses| uses.retain(|used| names.contains(used)));
    let circle = circle(&graph).map(|circle| format!("a circle of {}", circle.join(" → ")));
    violations.extend(circle);
    violations
}

/// Which of the entries of `directory` use which others of them.
fn siblings(modules: &[Module], directory: &[String]) -> BTreeMap<String, BTreeSet<String>> {
    let depth = directory.len();
    let entry =
        |path: &[String]| path.starts_with(directory).then(|| path.get(depth).cloned()).flatten();
    let entries: BTreeSet<String> =
        modules.iter().filter_map(|module| entry(&module.path)).collect();
    let mut graph: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    for module in modules {
        let Some(from) = entry(&module.path) else { continue };
        let to = module.uses.iter().filter_map(|used| entry(used));
        let others = to.filter(|to| *to != from && entries.contains(to));
        graph.entry(from.clone()).or_default().extend(others);
    }
    graph
}

/// A circle in the graph, if there is one: each entry uses the next, the last one the first.
fn circle(graph: &BTreeMap<String, BTreeSet<String>>) -> Option<Vec<String>> {
    let mut left = graph.clone();
    loop {
        let free: Vec<String> =
            left.iter().filter(|(_, uses)| uses.is_empty()).map(|(name, _)| name.clone()).collect();
        if free.is_empty() {
            break;
        }
        left.retain(|name, _| !free.contains(name));
        left.values_mut().for_each(|uses| uses.retain(|name| !free.contains(name)));
    }
    let mut way = vec![left.keys().next()?.clone()];
    loop {
        let next = left[way.last()?].first()?.clone();
        if let Some(at) = way.iter().position(|name| *name == next) {
            return Some(way.split_off(at));
        }
        way.push(next);
    }
}

/// Violations of the table of rooms in the source.
fn violations(
    rows: &[Row],
    modules: &[Module],
    first_paragraphs: &BTreeMap<String, String>,
) -> Vec<String> {
    let mut violations = Vec::new();
    let graph = siblings(modules, &[]);
    let rooms: Vec<&String> = rows.iter().map(|row| &row.room).collect();
    for name in graph.keys().filter(|name| !rooms.contains(name)) {
        violations.push(format!("{name} has no row"));
    }
    for (at, row) in rows.iter().enumerate() {
        let Row { room, owns, uses } = row;
        let Some(used) = graph.get(room) else {
            violations.push(format!("{room} has a row and is not there"));
            continue;
        };
        if first_paragraphs.get(room) != Some(owns) {
            violations.push(format!(
                "{room}: its row says {owns:?}, its //! says {:?}",
                first_paragraphs.get(room)
            ));
        }
        for upward in
            uses.iter().filter(|name| rooms.iter().position(|room| room == name) <= Some(at))
        {
            violations.push(format!("{room}: its row names {upward}, which is not below it"));
        }
        for name in used.iter().filter(|name| !uses.contains(name)) {
            violations.push(format!("{room} uses {name}, which its row does not name"));
        }
        for name in uses.iter().filter(|name| !used.contains(*name)) {
            violations.push(format!("{room} does not use {name}, which its row names"));
        }
    }
    let directories: BTreeSet<Vec<String>> = modules
        .iter()
        .flat_map(|module| (0..module.path.len()).map(|depth| module.path[..depth].to_vec()))
        .collect();
    for directory in directories {
        if let Some(circle) = circle(&siblings(modules, &directory)) {
            violations.push(format!("{}: a circle of {}", directory.join("/"), circle.join(" → ")));
        }
    }
    violations
}

#[test]
fn rooms_use_only_rooms_below_them() {
    let repository = repository();
    let page = fs::read_to_string(repository.join("ARCHITECTURE.md")).expect("a page");
    let tables = tables(&page);
    let mut found = Vec::new();
    for (directory, rows) in &tables {
        let source = repository.join(directory);
        let is_page = directory == PAGE;
        let modules = if is_page { page_modules(&source) } else { modules(&source) };
        assert!(modules.len() > 20, "found only {} modules below {directory}", modules.len());
        let (main, extension, mark) =
            if is_page { (None, "js", "//") } else { (Some("mod"), "rs", "//!") };
        let paragraph = |room: &String| {
            let inside = source.join(room).join(main.unwrap_or(room)).with_extension(extension);
            let files = [inside, source.join(room).with_extension(extension)];
            let text = files.iter().find_map(|file| fs::read_to_string(file).ok())?;
            Some((room.clone(), first_paragraph(&text, mark)))
        };
        if is_page {
            let exists = |name: &str| source.join(format!("{name}.js")).is_file();
            found.extend(page_violations(&modules, exists));
        }
        let paragraphs = rows.iter().filter_map(|row| paragraph(&row.room)).collect();
        found.extend(
            violations(rows, &modules, &paragraphs)
                .into_iter()
                .map(|text| format!("{directory}: {text}")),
        );
    }
    assert_eq!(
        tables.keys().collect::<Vec<_>>(),
        [
            "crates/agent/src",
            "crates/bench/src",
            "crates/cli/src",
            "crates/proto/src",
            "crates/server/src",
            PAGE,
        ]
    );
    assert!(found.is_empty(), "\n{}", found.join("\n"));
}

#[test]
fn directories_of_source_have_about_a_dozen_entries() {
    let repository = repository();
    let mut found = BTreeMap::new();
    let mut directories: Vec<PathBuf> = [
        "agent",
        "archive",
        "bench",
        "cli",
        "hostile",
        "macros",
        "package",
        "proto",
        "server",
        "transport",
    ]
    .map(|name| repository.join("crates").join(name).join("src"))
    .to_vec();
    directories.push(repository.join(PAGE));
    while let Some(directory) = directories.pop() {
        let mut entries = BTreeSet::new();
        for entry in fs::read_dir(&directory).expect("a directory") {
            let path = entry.expect("an entry").path();
            let is_source = path.is_dir()
                || path.extension().is_some_and(|extension| {
                    ["rs", "js", "css", "html", "svg"].contains(&extension.to_str().unwrap_or(""))
                });
            let stem =
                path.file_stem().and_then(|stem| stem.to_str()).unwrap_or_default().to_owned();
            if is_source && !["mod", "lib", "main"].contains(&stem.as_str()) {
                entries.insert(stem);
            }
            if path.is_dir() && !path.ends_with("vendor") {
                directories.push(path);
            }
        }
        if entries.len() > MAX_ENTRIES {
            let name = directory.strip_prefix(&repository).expect("in the repository");
            found.insert(name.display().to_string(), entries.len());
        }
    }
    assert_eq!(found, BTreeMap::new());
}

#[test]
fn upward_uses_and_cycles_are_found() {
    let module = |path: &str, source: &str| {
        let path: Vec<String> = path.split('/').map(str::to_owned).collect();
        let mut found = Vec::new();
        paths(source.parse().expect("tokens"), &mut found);
        let uses = found.iter().filter_map(|used| absolute(&path, used)).collect();
        Module { path, uses }
    };
    let page = "| crates/x/src | owns | may use |\n|---|---|---|\n\
                | `top` | The top. | `low` |\n| `low` | The low. | |\n";
    let rows = tables(page).remove("crates/x/src").expect("a table");
    let paragraphs = BTreeMap::from(
        [("top", "The top."), ("low", "The low.")].map(|(a, b)| (a.to_owned(), b.to_owned())),
    );
    let good = [
        module("top", "use crate::low::{a::A, b}; mod tests { use crate::nowhere::X; }"),
        module("low/a", "fn f() { super::b::g(); }"),
        module("low/b", "// crate::top\nconst TEXT: &str = \"crate::top\";"),
    ];
    assert_eq!(violations(&rows, &good, &paragraphs), Vec::<String>::new());
    let upward = [
        module("top", "use crate::low::A;"),
        module("low", "fn f() { select! { x => crate::top::g() } }"),
    ];
    let found = violations(&rows, &upward, &paragraphs);
    assert_eq!(found, ["low uses top, which its row does not name", ": a circle of low → top"]);
    let circle = [
        module("top", "use crate::low::a;"),
        module("low/a", "use super::b::B;"),
        module("low/b", "use super::{a::A};"),
    ];
    assert_eq!(violations(&rows, &circle, &paragraphs), ["low: a circle of a → b"]);
    assert_eq!(first_paragraph("//! One\n//! two.\n//!\n//! Three.\n", "//!"), "One two.");
}

#[test]
fn upward_imports_and_cycles_of_the_page_are_found() {
    let module = |path: &str, source: &str| {
        page_module(path.split('/').map(str::to_owned).collect(), source)
    };
    let page = "| crates/x/ui | owns | may use |\n|---|---|---|\n\
                | `top` | The top. | `low` |\n| `low` | The low. | |\n";
    let rows = tables(page).remove("crates/x/ui").expect("a table");
    let paragraphs = BTreeMap::from(
        [("top", "The top."), ("low", "The low.")].map(|(a, b)| (a.to_owned(), b.to_owned())),
    );
    let all = |modules: &[Module]| {
        let exists = |name: &str| {
            let is_module = modules.iter().any(|module| module.path.join("/") == name);
            is_module || name == "vendor/x/y.z"
        };
        [violations(&rows, modules, &paragraphs), page_violations(modules, exists)].concat()
    };
    let good = [
        module("top", "import { A } from './low/low.js';\nawait import('/ui/low/a/b.js');"),
        module("low/low", "// from '../top.js'\nimport {\n  b,\n} from './a/b.js';"),
        module("low/a/b", "import { html } from '../../vendor/x/y.z.js';\nimport data from 'top';"),
    ];
    assert_eq!(all(&good), Vec::<String>::new());
    let upward = [
        module("top", "import { A } from './low/low.js';"),
        module("low/low", "new SharedWorker('/ui/top.js', {});"),
    ];
    let found = all(&upward);
    assert_eq!(
        found,
        [
            "low uses top, which its row does not name",
            ": a circle of low → top",
            "a circle of low/low → top"
        ]
    );
    let circle = [
        module("top", "import './low/low.js';"),
        module("low/low", "import { a } from './a.js';"),
        module("low/a", "import { low } from './low.js';"),
    ];
    let found = all(&circle);
    assert_eq!(found, ["low: a circle of a → low", "a circle of low/a → low/low"]);
    let absent = [module("top", "import './low/low.js';"), module("low/low", "import './b.js';")];
    assert_eq!(all(&absent), ["low/low imports low/b, which is not there"]);
}
