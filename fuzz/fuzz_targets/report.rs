//! Runs `task_hostile::report` without end.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| task_hostile::report(bytes));
