//! Runs `task_hostile::mqtt_session` without end.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| task_hostile::mqtt_session(bytes));
