//! Runs `task_hostile::archive` without end.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| task_hostile::archive(bytes));
