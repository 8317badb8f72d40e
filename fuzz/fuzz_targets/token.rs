//! Runs `task_hostile::token` without end.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| task_hostile::token(bytes));
