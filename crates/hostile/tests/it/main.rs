//! The short run: every stored input, and then reproducible mutations of them, through every
//! target.

mod corpus;
mod targets;

/// Counts the memory that the RTPS target allocates.
#[global_allocator]
static MEMORY: task_hostile::Counting = task_hostile::Counting;
