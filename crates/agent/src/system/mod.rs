//! The machine and its files: clocks, disk, accounts, and the layout of the data directory. It knows nothing of tasks' states and speaks to no network.

pub mod accounts;
pub mod battery;
pub mod clock;
pub mod disk;
pub mod durable;
pub mod error_chain;
pub mod identity;
pub mod layout;
pub mod permanent_address;
pub mod place;
pub mod recent_set;
pub mod task_user;
pub mod untrusted_file;
