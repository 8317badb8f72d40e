//! Runs `task_hostile::mqtt_packets` without end.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| task_hostile::mqtt_packets(bytes));
