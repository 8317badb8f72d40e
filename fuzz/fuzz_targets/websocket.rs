//! Fuzz target: calls `task_hostile::websocket` on generated inputs.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| task_hostile::websocket(bytes));
