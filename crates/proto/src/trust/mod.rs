//! Owns the proofs between machines: signed envelopes and their keys, bearer tokens, and pins of
//! certificate authorities; it never keeps one.

pub mod envelope;
pub mod pin;
pub mod token;
