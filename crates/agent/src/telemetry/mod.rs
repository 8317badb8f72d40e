//! Data on its way to the server: vitals of the robot and the output files of runs. It changes
//! nothing on the robot.

pub mod outputs;
pub mod vitals;
