//! Owns the MQTT messages besides the desired state: topics, reports, requests, and parts of blobs;
//! it never sends one.

pub mod part;
pub mod report;
pub mod request;
pub mod topic;
