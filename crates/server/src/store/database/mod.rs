//! Owns the way to the database: connections, their faults, migrations, checks, copies, and the
//! lock that admits one server; it never knows what the tables of the fleet mean.

pub(super) mod connections;
pub(super) mod copy;
pub(super) mod dialect;
pub(super) mod fault;
pub(super) mod guard;
pub(super) mod integrity;
pub(super) mod migrate;
pub(super) mod primary;
pub(super) mod probe;
pub(super) mod sessions;
pub(super) mod state;
pub(super) mod write_locks;
