//! Owns the roles of people and the audit of their acts; it never checks a caller and never stores
//! an entry.

pub mod audit;
pub mod roles;
