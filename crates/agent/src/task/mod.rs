//! The state of tasks on disk and the pure decision about the next step. It never acts: effects are
//! a trait.

pub mod effects;
pub mod ledger;
pub mod observed;
pub mod plan;
pub mod run;
pub mod timing;
