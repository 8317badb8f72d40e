//! Fuzz target: calls `task_hostile::mqtt_session` on generated inputs.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| task_hostile::mqtt_session(bytes));
