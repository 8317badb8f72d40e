//! The wire as bytes: every document has a golden file, and a change of one shows in review.

mod golden;
mod people;
