//! The `taskbench` binary.

fn main() {}
