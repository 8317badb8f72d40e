//! ROS installations, launchers and the scripts made for them, as pure text. It starts nothing.

pub mod environment;
pub mod installation;
pub mod launch;
pub mod script;
pub mod underlay;
