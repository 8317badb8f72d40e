//! Owns publishers' keys and the command about them; it never sends a private key anywhere.

pub(super) mod key;
pub mod key_file;
