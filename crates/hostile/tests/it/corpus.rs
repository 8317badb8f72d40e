//! The kept inputs: where they are, and how a target is run over them.

use std::fs;
use std::panic::{AssertUnwindSafe, catch_unwind, set_hook, take_hook};
use std::path::PathBuf;
use std::sync::Once;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread;

use task_hostile::{Mutation, TARGETS, Target};

/// What the changes begin with.
const SEED: u64 = 5;
/// Panics of the threads that serve: one in a session's task ends that session, and nobody hears of
/// it.
static PANICS: AtomicUsize = AtomicUsize::new(0);

pub fn directory() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../fuzz/corpus")
}

/// The inputs kept for `target`, by name.
pub fn kept(target: &str) -> Vec<(String, Vec<u8>)> {
    let directory = directory().join(target);
    let entries =
        fs::read_dir(&directory).unwrap_or_else(|error| panic!("{}: {error}", directory.display()));
    let mut kept: Vec<_> = entries
        .map(|entry| {
            let entry = entry.expect("an entry");
            (
                entry.file_name().to_string_lossy().into_owned(),
                fs::read(entry.path()).expect("readable"),
            )
        })
        .collect();
    kept.sort();
    kept
}

/// Runs the target of this name over what is kept for it and over changes of that.
pub fn run(name: &str) {
    static HOOK: Once = Once::new();
    HOOK.call_once(|| {
        let shown = take_hook();
        set_hook(Box::new(move |panic| {
            if thread::current().name().is_some_and(|name| name.starts_with("tokio")) {
                PANICS.fetch_add(1, Ordering::SeqCst);
            }
            shown(panic);
        }));
    });
    let target = TARGETS.iter().find(|target| target.name == name).expect("a target of this name");
    let kept = kept(name);
    assert!(!kept.is_empty(), "nothing is kept for {name}");
    for (file, bytes) in &kept {
        check(target, bytes, &format!("fuzz/corpus/{name}/{file}"));
    }
    let kept: Vec<Vec<u8>> = kept.into_iter().map(|(_, bytes)| bytes).collect();
    let mut mutation = Mutation::new(SEED);
    for number in 0..target.tries {
        check(target, &mutation.next(&kept), &format!("change {number} of what is kept"));
    }
}

fn check(target: &Target, bytes: &[u8], what: &str) {
    let before = PANICS.load(Ordering::SeqCst);
    let ended = catch_unwind(AssertUnwindSafe(|| (target.run)(bytes)));
    let name = target.name;
    let harmless = ended.is_ok() && PANICS.load(Ordering::SeqCst) == before;
    assert!(
        harmless,
        "{name} does not bear {what}; keep it in fuzz/corpus/{name}: \"{}\"",
        bytes.escape_ascii()
    );
}
