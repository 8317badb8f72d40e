//! The first statements of a write, which make writes wait for each other. An order waits for all
//! writes under way and runs alone. On Postgres, writes of reports run beside each other, and only
//! those with a robot in common wait. SQLite has one writer at a time, whatever it writes.

/// The statements of one kind of database. They are chosen once, when the database is opened.
#[derive(Debug)]
pub(in crate::store) struct WriteLocks {
    /// Begins a write that runs alone.
    pub(in crate::store) exclusive: &'static str,
    /// Begins a write that may run beside others of its kind.
    pub(in crate::store) shared: &'static str,
    /// The end of a query for rows of `robots r`. It keeps these rows until the end of the write.
    /// All writes take them in the order of their ids, so no two wait for each other.
    pub(in crate::store) robots: &'static str,
}

/// Both lock functions name the same lock, the number of the letters `taskd`. Each later statement
/// has to see the writes for which the first one waited: hence READ COMMITTED.
pub(in crate::store) const POSTGRES_LOCKS: WriteLocks = WriteLocks {
    exclusive: "BEGIN ISOLATION LEVEL READ COMMITTED; SELECT pg_advisory_xact_lock(499851160420)",
    shared: "BEGIN ISOLATION LEVEL READ COMMITTED; SELECT pg_advisory_xact_lock_shared(499851160420)",
    robots: "ORDER BY r.id FOR UPDATE OF r",
};

pub(in crate::store) const SQLITE_LOCKS: WriteLocks =
    WriteLocks { exclusive: "BEGIN IMMEDIATE", shared: "BEGIN IMMEDIATE", robots: "" };
