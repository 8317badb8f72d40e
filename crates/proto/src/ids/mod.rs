//! Owns the names, numbers and digests that identify things, and the selectors of robots by them;
//! it never looks anything up.

pub mod digest;
mod id;
pub mod selector;

pub(crate) use id::serde_by_text;
pub use id::{
    AbsolutePath, DeploymentId, Generation, GraphName, InstanceId, InvalidId, LabelKey, LabelValue,
    Labels, MacAddress, NodeName, OutputPath, RepositoryName, RequestId, RobotId, RobotName, Tag,
    TaskName, TokenId, UserName, Version,
};
