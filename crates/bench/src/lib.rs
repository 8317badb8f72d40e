//! Measures taskd: scenarios that start real servers and simulated robots, and their results.
//! Scenarios stand on top and never call one another; see ARCHITECTURE.md.

pub mod measure;
pub mod programs;
pub mod results;
pub mod scenario;
pub mod simulated;
pub mod system;
