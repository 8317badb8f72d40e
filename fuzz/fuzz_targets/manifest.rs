//! Runs `task_hostile::manifest` without end.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| task_hostile::manifest(bytes));
