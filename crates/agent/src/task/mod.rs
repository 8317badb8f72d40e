//! The state of tasks and the pure decision about the next step. It has no effects: those are a trait.

pub mod effects;
pub mod ledger;
pub mod observed;
pub mod plan;
