//! For tests: a mount namespace in which mounts are invisible to other processes and disappear with
//! the test.

use nix::mount::{MsFlags, mount};
use nix::sched::{CloneFlags, unshare};

/// Runs `work` in a thread that may mount file systems. Where only root may mount, prints that the
/// test is skipped.
pub(crate) fn with_own_mounts(work: impl FnOnce() + Send) {
    let enter = || {
        unshare(CloneFlags::CLONE_NEWNS)?;
        mount(None::<&str>, "/", None::<&str>, MsFlags::MS_REC | MsFlags::MS_PRIVATE, None::<&str>)
    };
    std::thread::scope(|scope| {
        let working = scope.spawn(|| match enter() {
            Ok(()) => work(),
            Err(error) => eprintln!("unavailable: this user can't have mounts of its own: {error}"),
        });
        working.join().expect("the work is done");
    });
}
