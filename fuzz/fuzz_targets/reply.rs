//! Runs `task_hostile::reply` without end.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| task_hostile::reply(bytes));
