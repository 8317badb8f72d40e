//! Fuzz target: calls `task_hostile::task_toml` on generated inputs.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| task_hostile::task_toml(bytes));
