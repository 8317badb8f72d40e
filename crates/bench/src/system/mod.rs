//! Owns the machine of a run: clocks, processes, progress on the terminal, and an emulated link; it
//! never knows which program it starts.

pub mod clock;
pub mod link;
pub mod machine;
pub mod process;
pub mod progress;
