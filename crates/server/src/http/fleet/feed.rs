//! The feed of recent events, filtered by the scope of the asking person.

use std::collections::HashSet;

use axum::Json;
use axum::extract::State;
use serde::Deserialize;
use task_macros::operation;
use task_proto::api::{FeedPage, MAX_FEED_ENTRIES};
use utoipa::IntoParams;

use crate::domain::person::{Person, Scope};
use crate::http::error::ApiError;
use crate::http::extract::QueryParams;
use crate::store::{FeedAudience, KnownRobot, Store};

/// Default number of listed entries.
const DEFAULT_LIMIT: usize = 100;

/// The query of `GET /feed`.
#[derive(Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
pub(in crate::http) struct Query {
    /// Only entries with a higher number.
    after: Option<u64>,
    /// Maximum number of entries. Default: 100.
    #[param(minimum = 1, maximum = 2000)]
    limit: Option<u32>,
}

/// Lists fleet events: the newest, or with `after` the next ones after that number.
#[operation(tag = "server")]
pub(in crate::http) async fn feed(
    State(store): State<Store>,
    by: Person,
    QueryParams(query): QueryParams<Query>,
) -> Result<Json<FeedPage>, ApiError> {
    let limit = query.limit.map_or(DEFAULT_LIMIT, |limit| limit as usize);
    if !(1..=MAX_FEED_ENTRIES).contains(&limit) {
        return Err(ApiError::invalid(format!(
            "limit: expected 1 to {MAX_FEED_ENTRIES}, not {limit}"
        )));
    }
    let mut own_robots = HashSet::new();
    let mut known = HashSet::new();
    if !by.scope.is_everything() {
        own_robots.extend(store.robots().ids_in(&by.scope).await?);
        known.extend(store.robots().ids_in(&Scope::everything()).await?);
    }
    // A robot's current labels decide, as everywhere else. An entry also holds the labels at its
    // time: for a removed robot, those are all that is left.
    let is_in_scope = |robot: &KnownRobot| match known.contains(&robot.id) {
        true => own_robots.contains(&robot.id),
        false => by.scope.covers(&robot.id, &robot.name, &robot.labels),
    };
    let mut entries = Vec::new();
    for (entry, audience) in store.feed().after(query.after.unwrap_or(0)).await? {
        let is_visible = match audience {
            FeedAudience::Everybody => true,
            _ if by.scope.is_everything() => true,
            FeedAudience::Unlimited => false,
            FeedAudience::Robot(robot) => is_in_scope(&robot),
        };
        if is_visible {
            entries.push(entry);
        }
    }
    match query.after {
        Some(_) => entries.truncate(limit),
        None => drop(entries.drain(..entries.len().saturating_sub(limit))),
    }
    Ok(Json(FeedPage { entries }))
}
