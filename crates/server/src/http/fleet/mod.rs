//! Owns the routes about robots and the routes that robots call; never decides which tasks a robot
//! should run.

pub(super) mod ask;
pub(super) mod broker;
pub(super) mod bulk;
pub(super) mod enroll;
pub(super) mod feed;
pub(super) mod forward;
pub(super) mod history;
pub(super) mod live_robots;
pub(super) mod logs;
pub(super) mod mqtt;
pub(super) mod outputs;
pub(super) mod robots;
pub(super) mod vitals;
