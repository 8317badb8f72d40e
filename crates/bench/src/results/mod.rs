//! Owns the results of runs: their points, files, plots and differences; it never measures.

pub mod axis;
pub mod compare;
mod files;
pub mod plot;
pub mod report;
pub mod run;
