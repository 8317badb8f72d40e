//! The `task-agent` binary: parses the command line and hands over. It never holds logic of its own.

fn main() {}
