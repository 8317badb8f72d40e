//! Input from the network to a participant of the ROS graph: datagrams, and samples of
//! discovery in them.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::{Cell, RefCell};

use rustdds::fuzzing::Receiver;

/// The most memory that one input may leave allocated on a thread.
const MAX_KEPT_BYTES: usize = 64 << 20;
/// The most memory that one input may allocate in total: a datagram of 64 KiB can have thousands of
/// submessages.
const MAX_TAKEN_BYTES: usize = 256 << 20;
/// The most datagrams of one input.
const MAX_DATAGRAMS: usize = 64;

thread_local! {
    static TAKEN: Cell<usize> = const { Cell::new(0) };
    static KEPT: Cell<usize> = const { Cell::new(0) };
    static LARGEST: Cell<usize> = const { Cell::new(0) };
    static RECEIVER: RefCell<Receiver> = RefCell::new(Receiver::new());
}

/// The system's allocator, with a count of allocated bytes per thread. Programs that run [`rtps`]
/// install it; otherwise nothing is counted.
pub struct Counting;

// SAFETY: all is passed on to the system's allocator as it comes.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count(layout.size(), 0);
        // SAFETY: as the caller promises.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        count(layout.size(), 0);
        // SAFETY: as the caller promises.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn realloc(&self, memory: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count(size, layout.size());
        // SAFETY: as the caller promises.
        unsafe { System.realloc(memory, layout, size) }
    }

    unsafe fn dealloc(&self, memory: *mut u8, layout: Layout) {
        count(0, layout.size());
        // SAFETY: as the caller promises.
        unsafe { System.dealloc(memory, layout) }
    }
}

fn count(taken: usize, freed: usize) {
    // A thread that is ending has nothing to count any more.
    let _ = TAKEN.try_with(|all| all.set(all.get().saturating_add(taken)));
    let _ = KEPT.try_with(|kept| kept.set(kept.get().saturating_add(taken).saturating_sub(freed)));
    let _ = LARGEST.try_with(|largest| largest.set(largest.get().max(taken)));
}

/// Datagrams, each after two bytes with its length, and the same bytes as discovery samples.
/// Nothing panics or hangs, no single allocation is larger than the largest assembled sample, and
/// little memory is kept.
pub fn rtps(bytes: &[u8]) {
    RECEIVER.with_borrow_mut(|receiver| {
        // Memory allocated at the first use does not belong to the input.
        receiver.idle();
        let kept_before = KEPT.get();
        TAKEN.set(0);
        LARGEST.set(0);
        let mut rest = bytes;
        for _ in 0..MAX_DATAGRAMS {
            let [low, high, behind @ ..] = rest else { break };
            let length = usize::from(u16::from_le_bytes([*low, *high])).min(behind.len());
            let (datagram, next) = behind.split_at(length);
            receiver.datagram(datagram);
            receiver.discovery_sample(datagram);
            rest = next;
        }
        receiver.idle();
        let (taken, largest) = (TAKEN.get(), LARGEST.get());
        let kept = KEPT.get().saturating_sub(kept_before);
        assert!(largest <= MAX_KEPT_BYTES / 2, "one allocation of {largest} bytes");
        assert!(taken <= MAX_TAKEN_BYTES, "{taken} bytes were taken");
        assert!(kept <= MAX_KEPT_BYTES, "{kept} bytes were kept");
    });
}
