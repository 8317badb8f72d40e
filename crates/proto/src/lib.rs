//! Wire types shared by server, agent and bench: everything that crosses the network or a disk both
//! sides read. It never does I/O and never reads a clock; randomness and time are arguments or
//! explicit constructors.

#![warn(missing_docs)]

pub mod api;
pub mod checkup;
pub mod data_directory;
pub mod desired;
pub mod ids;
pub mod messages;
pub mod packages;
pub mod people;
pub mod telemetry;
mod text;
pub mod trust;

pub use ids::digest::Digest;
pub use ids::{
    AbsolutePath, DeploymentId, Generation, InstanceId, MacAddress, RepositoryName, RobotId,
    RobotName, Tag, TaskName, TokenId, UserName, Version,
};
pub use text::{error_chain, expected, line, log_format, size, time, toml_keys};
pub use trust::pin::CaPin;
