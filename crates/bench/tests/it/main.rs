//! The end-to-end tests: the real programs, started as processes, and the rules all of the source keeps.

mod tidy;
