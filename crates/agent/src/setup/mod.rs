//! ROS installations, launchers, and the scripts that are generated for them. It starts nothing.

pub mod environment;
pub mod installation;
pub mod launch;
pub mod script;
pub mod underlay;
