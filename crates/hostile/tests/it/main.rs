//! The short run: every kept input, then the same changes of them each time, through every target.

mod corpus;
mod targets;

/// Counts what the target for RTPS takes.
#[global_allocator]
static MEMORY: task_hostile::Counting = task_hostile::Counting;
