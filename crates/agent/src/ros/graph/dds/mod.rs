//! The graph as DDS shows it: readers and writers, the conversion of names, the discovery messages,
//! and the snapshot made of them. It calls no node and reads no topic of a node.

pub mod entities;
pub mod names;
pub mod snapshot;

pub(super) mod endpoint;
pub(super) mod observer;
pub(super) mod own_node;
