//! The reasons why any order can be refused, whatever its noun: an invalid value, a selection of
//! robots, an idempotency key, the database. The nouns add their own.

use task_proto::{RobotName, UserName};

use crate::store::StoreError;

/// Why an order was refused, for reasons that orders of all nouns share. No part of a refused order
/// is carried out.
#[derive(Debug, thiserror::Error)]
pub enum OrderError {
    /// A request that makes no sense.
    #[error("{key}: {reason}")]
    Invalid {
        key: &'static str,
        /// Why the value is invalid.
        reason: String,
    },
    /// The selector matches no robot, or no robot that has the task.
    #[error("no robots match {0}")]
    NoRobotsMatch(String),
    /// The selector names robots that do not exist or are outside the person's scope.
    #[error("selector: no registered robot has the name or id {}; nothing was done", join_names(.0))]
    UnknownRobots(Vec<RobotName>),
    /// Some of the selected robots are outside the person's scope.
    #[error("{}", out_of_scope_text(*outside, *selected, selection, person, scope))]
    OutOfScope {
        /// Number of robots outside the scope.
        outside: usize,
        /// Number of selected robots.
        selected: usize,
        /// The part of the request that selects the robots.
        selection: String,
        /// The user with the limited scope.
        person: UserName,
        scope: String,
    },
    /// The key came with another order before.
    #[error("the idempotency key {0:?} was used for another order")]
    IdempotencyKeyReused(String),
    #[error("the database failed")]
    Store(#[from] StoreError),
}

impl OrderError {
    pub(super) fn invalid(key: &'static str, reason: impl Into<String>) -> Self {
        Self::Invalid { key, reason: reason.into() }
    }
}

/// The first names of a possibly long list.
fn join_names(names: &[RobotName]) -> String {
    const MAX_NAMES: usize = 20;
    let shown: Vec<&str> = names.iter().take(MAX_NAMES).map(RobotName::as_str).collect();
    match names.len().saturating_sub(MAX_NAMES) {
        0 => shown.join(", "),
        more => format!("{} and {more} more", shown.join(", ")),
    }
}

fn out_of_scope_text(
    outside: usize,
    selected: usize,
    selection: &str,
    person: &UserName,
    scope: &str,
) -> String {
    if selected == 1 {
        return format!("{selection} is outside of {person}'s scope {scope:?}; nothing was done");
    }
    format!(
        "{outside} of the {selected} robots of {selection} are outside of {person}'s scope {scope:?}; nothing was done"
    )
}
