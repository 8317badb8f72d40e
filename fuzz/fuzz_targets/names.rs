//! Fuzz target: calls `task_hostile::names` on generated inputs.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| task_hostile::names(bytes));
