//! Runs `task_hostile::desired` without end.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| task_hostile::desired(bytes));
