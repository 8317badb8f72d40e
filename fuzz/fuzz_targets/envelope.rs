//! Fuzz target: calls `task_hostile::envelope` on generated inputs.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| task_hostile::envelope(bytes));
