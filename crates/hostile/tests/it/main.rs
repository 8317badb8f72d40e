//! The short run: every kept input, then the same changes of them each time, through every target.

mod corpus;
mod targets;
