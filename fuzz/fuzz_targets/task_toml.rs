//! Runs `task_hostile::task_toml` without end.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| task_hostile::task_toml(bytes));
