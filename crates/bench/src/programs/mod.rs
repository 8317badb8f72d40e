//! Owns the programs under measurement, taskd and those it is compared with, and the input that
//! they get; it never measures.

pub mod database;
pub mod encryption;
pub(crate) mod enrollment;
pub mod package;
pub(crate) mod peer;
pub mod server;
pub mod taskd;
