//! Owns the output and the questions at the terminal; it never asks the server.

pub(super) mod confirm;
pub(super) mod course;
pub(super) mod output;
pub(super) mod password;
pub(super) mod progress;
pub(super) mod shown;
pub(super) mod view;
