//! Runs `task_hostile::part` without end.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| task_hostile::part(bytes));
