//! The few pieces of SQL that differ between SQLite and Postgres, beside the locks of writes. They
//! are chosen once, when the database is opened, and contain no statement.

/// Pieces of SQL for one kind of database.
#[derive(Debug)]
pub(in crate::store) struct Dialect {
    /// The texts of a JSON list, in a column `value`. `{}` is the list.
    texts: &'static str,
    /// The pairs of a JSON list of lists of two texts, in columns `key` and `value`. `{}` is the
    /// list.
    pairs: &'static str,
    /// The labels of `robots r`, as rows with the columns `key` and `value`.
    pub(in crate::store) labels: &'static str,
    /// Makes the order of a text column that of its bytes.
    pub(in crate::store) bytewise: &'static str,
}

pub(in crate::store) const SQLITE: Dialect = Dialect {
    texts: "SELECT value FROM json_each({})",
    pairs: "SELECT json_extract(value, '$[0]') AS key, json_extract(value, '$[1]') AS value FROM json_each({})",
    labels: "json_each(r.labels)",
    bytewise: "",
};

pub(in crate::store) const POSTGRES: Dialect = Dialect {
    texts: "SELECT value FROM json_array_elements_text(CAST({} AS json))",
    pairs: "SELECT value ->> 0 AS key, value ->> 1 AS value FROM json_array_elements(CAST({} AS json))",
    labels: "json_each_text(CAST(r.labels AS json))",
    bytewise: "COLLATE \"C\"",
};

impl Dialect {
    /// A query for the texts of the JSON list in a parameter, in a column `value`.
    pub(in crate::store) fn texts(&self, parameter: usize) -> String {
        self.texts.replace("{}", &format!("CAST(${parameter} AS TEXT)"))
    }

    /// A query for the pairs of the JSON list in a parameter, in columns `key` and `value`.
    pub(in crate::store) fn pairs(&self, parameter: usize) -> String {
        self.pairs.replace("{}", &format!("CAST(${parameter} AS TEXT)"))
    }

    /// A migration's text, which is written for SQLite.
    pub(in crate::store) fn translate(&self, migration: &str) -> String {
        migration.replace(SQLITE.labels, self.labels)
    }
}
