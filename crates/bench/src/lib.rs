//! Measures taskd: scenarios that start real servers and simulated robots, and their results.
//! Scenarios stand on top and never call one another; see ARCHITECTURE.md.

pub mod axis;
pub mod clock;
pub mod compare;
mod downloads;
pub mod encryption;
mod enrolment;
pub mod fleet;
pub mod link;
pub mod load;
pub mod load_report;
pub mod machine;
pub mod measure;
mod mqtt;
pub mod package;
mod peer;
pub mod plot;
pub mod process;
pub mod progress;
pub mod report;
pub mod robot;
pub mod robots;
pub mod run;
pub mod scenario;
pub mod server;
mod simulated;
pub mod taskd;
