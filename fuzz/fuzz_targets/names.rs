//! Runs `task_hostile::names` without end.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| task_hostile::names(bytes));
