//! Fuzz target: calls `task_hostile::proxy_header` on generated inputs.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| task_hostile::proxy_header(bytes));
