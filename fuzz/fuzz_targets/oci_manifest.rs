//! Runs `task_hostile::oci_manifest` without end.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| task_hostile::oci_manifest(bytes));
