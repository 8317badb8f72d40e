//! Runs `task_hostile::selector` without end.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| task_hostile::selector(bytes));
