//! The wire as bytes: every document has a golden file, and a change of one shows in review.

mod fleet;
mod golden;
mod operation;
mod people;
