//! Wire types shared by server, agent and bench: everything that crosses the network or a disk both
//! sides read. It never does I/O and never reads a clock; randomness and time are arguments or
//! explicit constructors.

#![warn(missing_docs)]

pub mod api;
pub mod audit;
pub mod checkup;
pub mod desired;
pub mod digest;
pub mod envelope;
pub mod expected;
pub mod id;
pub mod line;
pub mod log;
pub mod manifest;
pub mod oci;
pub mod output;
pub mod part;
pub mod person;
pub mod pin;
pub mod publisher;
pub mod report;
pub mod request;
pub mod ros;
pub mod selector;
pub mod settings;
pub mod time;
pub mod token;
pub mod topic;
pub mod vitals;

pub use digest::Digest;
pub use id::{
    AbsolutePath, DeploymentId, Generation, InstanceId, MacAddress, RepositoryName, RobotId,
    RobotName, Tag, TaskName, TokenId, UserName, Version,
};
pub use pin::CaPin;
