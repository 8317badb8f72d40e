//! Owns the output and the questions at the terminal; it never asks the server.

pub(super) mod confirm;
pub(super) mod output;
pub(super) mod password;
pub(super) mod printed_lines;
pub(super) mod progress;
pub(super) mod transfer_eta;
pub(super) mod view;
