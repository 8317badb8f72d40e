//! Faults of the database itself, identified by their error codes: a corrupt file, a full disk, a
//! server that is away or busy. This module only classifies errors and never reacts to them.

use std::io;

use sqlx::Error;
use sqlx::migrate::MigrateError;

/// The beginning of PgBouncer's message about a parameter that it does not know.
const UNSUPPORTED_PARAMETER: &str = "unsupported startup parameter";

/// A fault that an operator repairs, or that passes by itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fault {
    /// Pages of the database are damaged.
    Corrupt,
    /// The disk is full.
    Full,
    /// The database server can't be reached, or takes no statements now.
    Unreachable,
    /// Other users hold the resources of a statement for too long.
    Busy,
}

impl Fault {
    /// The fault that the error shows; `None` if the statement itself is wrong or refused.
    pub(in crate::store) fn of(error: &Error) -> Option<Self> {
        match error {
            Error::Io(error) if error.kind() == io::ErrorKind::StorageFull => Some(Self::Full),
            Error::Io(_) => Some(Self::Unreachable),
            Error::PoolTimedOut | Error::PoolClosed => Some(Self::Busy),
            // A pooler that refuses the driver's parameters refuses them again. It has the same code
            // for its own faults.
            Error::Database(error) if error.message().starts_with(UNSUPPORTED_PARAMETER) => None,
            Error::Database(error) => error.code().as_deref().and_then(Self::of_code),
            _ => None,
        }
    }

    /// The error in the words of the database or of the operating system, without the driver's
    /// classification before it.
    pub(in crate::store) fn description(error: &Error) -> String {
        match error {
            Error::Io(error) => error.to_string(),
            Error::Database(error) => error.message().to_owned(),
            Error::Tls(error) | Error::Configuration(error) => error.to_string(),
            error => error.to_string(),
        }
    }

    /// The fault that a failed migration shows.
    pub(in crate::store) fn of_migration(error: &MigrateError) -> Option<Self> {
        match error {
            MigrateError::Execute(error) | MigrateError::ExecuteMigration(error, _) => {
                Self::of(error)
            }
            _ => None,
        }
    }

    /// Postgres has codes of five characters, SQLite's are numbers below 10,000.
    fn of_code(code: &str) -> Option<Self> {
        match code.parse::<u16>() {
            Ok(number) if code.len() < 5 => Self::of_sqlite(number),
            _ => Self::of_postgres(code),
        }
    }

    /// Classifies SQLite's extended result code, whose low byte is the primary one.
    fn of_sqlite(code: u16) -> Option<Self> {
        /// A checksum mismatch: one of the file system, and one of the database.
        const CHECKSUM_MISMATCHES: [u16; 2] = [8458, 8202];
        /// The index of the write-ahead log could not be extended.
        const SHARED_MEMORY_SIZE: u16 = 4874;
        match (code & 0xff, code) {
            (11 | 26, _) => Some(Self::Corrupt),
            (10, code) if CHECKSUM_MISMATCHES.contains(&code) => Some(Self::Corrupt),
            (13, _) | (10, SHARED_MEMORY_SIZE) => Some(Self::Full),
            (5 | 6, _) => Some(Self::Busy),
            _ => None,
        }
    }

    fn of_postgres(code: &str) -> Option<Self> {
        match code {
            "XX001" | "XX002" => Some(Self::Corrupt),
            "53100" => Some(Self::Full),
            // Shut down, crashed, starting up, cut off for being idle, a standby.
            "57P01" | "57P02" | "57P03" | "57P05" | "25P03" | "25006" => Some(Self::Unreachable),
            // Too many connections, too little memory, a lock or a statement that took too long, a
            // deadlock. The open connections remain usable.
            "53000" | "53200" | "53300" | "53400" | "55P03" | "57014" | "40001" | "40P01" => {
                Some(Self::Busy)
            }
            _ if code.starts_with("08") => Some(Self::Unreachable),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn error_codes_of_both_databases_map_to_faults() {
        for (code, fault) in [
            ("11", Some(Fault::Corrupt)),
            ("26", Some(Fault::Corrupt)),
            ("523", Some(Fault::Corrupt)),
            ("8458", Some(Fault::Corrupt)),
            ("13", Some(Fault::Full)),
            ("4874", Some(Fault::Full)),
            ("5", Some(Fault::Busy)),
            ("517", Some(Fault::Busy)),
            ("2067", None),
            ("XX001", Some(Fault::Corrupt)),
            ("53100", Some(Fault::Full)),
            ("57P01", Some(Fault::Unreachable)),
            ("57P02", Some(Fault::Unreachable)),
            ("57P03", Some(Fault::Unreachable)),
            ("25006", Some(Fault::Unreachable)),
            ("53300", Some(Fault::Busy)),
            ("08006", Some(Fault::Unreachable)),
            ("57014", Some(Fault::Busy)),
            ("23505", None),
            ("28P01", None),
            ("3D000", None),
        ] {
            assert_eq!(Fault::of_code(code), fault, "{code}");
        }
    }
}
