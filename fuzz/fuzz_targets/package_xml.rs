//! Runs `task_hostile::package_xml` without end.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| task_hostile::package_xml(bytes));
