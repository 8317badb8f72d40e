//! Converts between columns and types: numbers, JSON and ids, and lists of rows as one statement's
//! `VALUES`. This module knows no table.

use serde::Serialize;
use serde::de::DeserializeOwned;
use sqlx::Row as _;
use std::str::FromStr;

use task_proto::{DeploymentId, RobotId};

use super::StoreError;

/// The most rows of one statement. With [`groups`], statements come in few lengths, so their plans
/// are reused. More rows would be slower: for each parameter SQLite searches the names of all.
const MAX_ROWS: usize = 64;

/// A stored number, which is never negative.
pub(super) fn number(stored: i64) -> u64 {
    u64::try_from(stored).unwrap_or(0)
}

/// Converts a number to be stored. Numbers from 2^63, which only a robot can make up, are stored as
/// 2^63 - 1.
pub(super) fn stored(number: u64) -> i64 {
    i64::try_from(number).unwrap_or(i64::MAX)
}

/// The priority of a deployment's row.
pub(super) fn priority(row: &sqlx::any::AnyRow) -> Result<i32, StoreError> {
    let found: i64 = row.try_get("priority")?;
    i32::try_from(found).map_err(|_| StoreError::Unreadable { column: "deployments.priority" })
}

/// A wire value as JSON text.
pub(super) fn json<T: Serialize>(value: &T) -> String {
    serde_json::to_string(value).expect("a wire type always has a JSON form")
}

/// Parses the JSON text of `column`.
pub(super) fn from_json<T: DeserializeOwned>(
    column: &'static str,
    text: &str,
) -> Result<T, StoreError> {
    serde_json::from_str(text).map_err(|_| StoreError::Unreadable { column })
}

/// Parses the JSON text of `column`, which may be empty.
pub(super) fn from_optional_json<T: DeserializeOwned>(
    column: &'static str,
    text: Option<String>,
) -> Result<Option<T>, StoreError> {
    text.map(|text| from_json(column, &text)).transpose()
}

/// A one-word wire value as text, without JSON's quotes.
pub(super) fn word<T: Serialize>(value: &T) -> String {
    json(value).trim_matches('"').to_owned()
}

/// Parses the word of `column`.
pub(super) fn from_word<T: DeserializeOwned>(
    column: &'static str,
    text: &str,
) -> Result<T, StoreError> {
    serde_json::from_value(serde_json::Value::String(text.to_owned()))
        .map_err(|_| StoreError::Unreadable { column })
}

/// Parses the id of `column`.
pub(super) fn id<T: FromStr>(column: &'static str, text: &str) -> Result<T, StoreError> {
    text.parse().map_err(|_| StoreError::Unreadable { column })
}

/// Parses the id of `column`, which may be empty.
pub(super) fn optional<T: FromStr>(
    column: &'static str,
    text: Option<String>,
) -> Result<Option<T>, StoreError> {
    text.map(|text| id(column, &text)).transpose()
}

/// The deployment and the robot of each row.
pub(super) fn deployment_robot_pairs(
    rows: Vec<(String, String)>,
) -> Result<Vec<(DeploymentId, RobotId)>, StoreError> {
    let read = |(deployment, robot): (String, String)| {
        Ok((id("assignments.deployment_id", &deployment)?, id("assignments.robot_id", &robot)?))
    };
    rows.into_iter().map(read).collect()
}

/// Cuts rows into groups of 64, 8 and 1.
pub(super) fn groups<T>(mut rows: &[T]) -> impl Iterator<Item = &[T]> {
    std::iter::from_fn(move || {
        let size = [MAX_ROWS, MAX_ROWS / 8, 1].into_iter().find(|&size| size <= rows.len())?;
        let (group, rest) = rows.split_at(size);
        rows = rest;
        Some(group)
    })
}

/// `VALUES (CAST($n AS TEXT), …), …` for `rows` rows whose columns have `types`, counting
/// parameters from `first`.
pub(super) fn values(first: usize, rows: usize, types: &[&str]) -> String {
    let mut text = String::from("VALUES ");
    for row in 0..rows {
        text.push_str(if row == 0 { "(" } else { ", (" });
        for (column, kind) in types.iter().enumerate() {
            let separator = if column == 0 { "" } else { ", " };
            text.push_str(&format!(
                "{separator}CAST(${} AS {kind})",
                first + row * types.len() + column
            ));
        }
        text.push(')');
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn number_beyond_the_column_range_is_clamped() {
        for (given, kept) in [(0, 0), (1 << 53, 1 << 53), (1 << 63, i64::MAX), (u64::MAX, i64::MAX)]
        {
            assert_eq!(stored(given), kept, "{given}");
        }
    }

    #[test]
    fn groups_cover_all_rows_in_few_lengths() {
        let rows: Vec<u32> = (0..139).collect();
        let lengths: Vec<usize> = groups(&rows).map(<[u32]>::len).collect();
        assert_eq!(lengths, [64, 64, 8, 1, 1, 1]);
        assert_eq!(groups(&rows).flatten().copied().collect::<Vec<_>>(), rows);
    }

    #[test]
    fn values_are_numbered_from_the_first_parameter() {
        assert_eq!(
            values(3, 2, &["TEXT", "BIGINT"]),
            "VALUES (CAST($3 AS TEXT), CAST($4 AS BIGINT)), (CAST($5 AS TEXT), CAST($6 AS BIGINT))"
        );
    }
}
