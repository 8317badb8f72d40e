//! Fuzz target: calls `task_hostile::mqtt_packets` on generated inputs.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| task_hostile::mqtt_packets(bytes));
