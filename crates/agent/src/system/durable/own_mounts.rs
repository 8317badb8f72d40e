//! For tests: a place in which what is mounted is seen by nobody else and gone with the test.

use nix::mount::{MsFlags, mount};
use nix::sched::{CloneFlags, unshare};

/// Does `work` in a thread that may mount what it likes. Where only root may do that, it is said
/// that it is left out.
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
