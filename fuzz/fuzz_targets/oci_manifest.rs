//! Fuzz target: calls `task_hostile::oci_manifest` on generated inputs.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| task_hostile::oci_manifest(bytes));
