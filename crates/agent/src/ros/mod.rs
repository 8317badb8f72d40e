//! The ROS graph: the process that takes part in it, the readiness of tasks, and the examination of
//! installations. It starts and stops no task.

pub mod graph;
pub mod graph_access;
pub mod node_logs;
pub mod probe;
pub mod readiness;
pub mod watcher;
