//! Runs `task_hostile::envelope` without end.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| task_hostile::envelope(bytes));
