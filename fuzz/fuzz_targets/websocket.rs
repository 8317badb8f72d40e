//! Runs `task_hostile::websocket` without end.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| task_hostile::websocket(bytes));
