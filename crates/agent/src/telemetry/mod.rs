//! Data about the robot on its way to the server: vitals, and the files that runs bring back. It changes nothing.

pub mod outputs;
pub mod vitals;
