//! Fuzz target: calls `task_hostile::rtps` on generated inputs.
#![no_main]

#[global_allocator]
static MEMORY: task_hostile::Counting = task_hostile::Counting;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| task_hostile::rtps(bytes));
