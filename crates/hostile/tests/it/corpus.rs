//! The stored inputs: where they are, and how a target is run over them.

use std::fs;
use std::panic::{AssertUnwindSafe, catch_unwind, set_hook, take_hook};
use std::path::PathBuf;
use std::sync::Once;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread;

use task_hostile::{Mutation, TARGETS, Target};

/// The seed of the mutations.
const SEED: u64 = 5;
/// Panics of the server's threads: a panic in a session's task ends only that session.
static PANICS: AtomicUsize = AtomicUsize::new(0);

pub fn directory() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../fuzz/corpus")
}

/// The stored inputs of `target`, by name.
pub fn inputs(target: &str) -> Vec<(String, Vec<u8>)> {
    let directory = directory().join(target);
    let entries =
        fs::read_dir(&directory).unwrap_or_else(|error| panic!("{}: {error}", directory.display()));
    let mut inputs: Vec<_> = entries
        .map(|entry| {
            let entry = entry.expect("an entry");
            (
                entry.file_name().to_string_lossy().into_owned(),
                fs::read(entry.path()).expect("readable"),
            )
        })
        .collect();
    inputs.sort();
    inputs
}

/// Runs the target of this name over its stored inputs and mutations of them.
pub fn run(name: &str) {
    static HOOK: Once = Once::new();
    HOOK.call_once(|| {
        let default_hook = take_hook();
        set_hook(Box::new(move |panic| {
            if thread::current().name().is_some_and(|name| name.starts_with("tokio")) {
                PANICS.fetch_add(1, Ordering::SeqCst);
            }
            default_hook(panic);
        }));
    });
    let target = TARGETS.iter().find(|target| target.name == name).expect("a target of this name");
    let inputs = inputs(name);
    assert!(!inputs.is_empty(), "no inputs are stored for {name}");
    for (file, bytes) in &inputs {
        check(target, bytes, &format!("fuzz/corpus/{name}/{file}"));
    }
    let inputs: Vec<Vec<u8>> = inputs.into_iter().map(|(_, bytes)| bytes).collect();
    let mut mutation = Mutation::new(SEED);
    for number in 0..target.tries {
        check(target, &mutation.next(&inputs), &format!("mutation {number} of the stored inputs"));
    }
}

fn check(target: &Target, bytes: &[u8], input: &str) {
    let before = PANICS.load(Ordering::SeqCst);
    let ended = catch_unwind(AssertUnwindSafe(|| (target.run)(bytes)));
    let name = target.name;
    let is_harmless = ended.is_ok() && PANICS.load(Ordering::SeqCst) == before;
    assert!(
        is_harmless,
        "{name} fails on {input}; store the input in fuzz/corpus/{name}: \"{}\"",
        bytes.escape_ascii()
    );
}
