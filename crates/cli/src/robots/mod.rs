//! Owns the commands about robots, their logs and their ROS graphs; it never orders work.

pub(super) mod enroll_token;
pub(super) mod logs;
pub(super) mod robot;
pub(super) mod robot_settings;
pub(super) mod robot_view;
pub(super) mod ros;
pub(super) mod selection;
pub(super) mod top;
