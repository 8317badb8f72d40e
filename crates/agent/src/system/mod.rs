//! The machine: clocks, disk, accounts, identity, and the layout of the data directory. It knows no
//! tasks and opens no connection.

pub mod accounts;
pub mod battery;
pub mod clock;
pub mod disk;
pub mod durable;
pub mod identity;
pub mod layout;
pub mod permanent_address;
pub mod place;
pub mod recent_set;
pub mod task_user;
pub mod untrusted_file;
