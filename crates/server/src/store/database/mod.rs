//! Owns the way to the database: connections, their faults, migrations and checks; it never knows
//! what the tables mean.

pub(super) mod connections;
pub(super) mod fault;
pub(super) mod integrity;
pub(super) mod migrate;
pub(super) mod state;
