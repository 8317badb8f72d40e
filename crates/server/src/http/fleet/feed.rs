//! The feed of recent events, filtered by the scope of the asking person.

use std::collections::HashSet;

use axum::Json;
use axum::extract::State;
use serde::Deserialize;
use task_proto::api::{FeedPage, MAX_FEED_ENTRIES};
use utoipa::IntoParams;

use crate::domain::person::{Person, Scope};
use crate::http::App;
use crate::http::error::ApiError;
use crate::http::extract::QueryParams;
use crate::orders::feed::FeedAudience;
use crate::store::KnownRobot;

/// Default number of listed entries.
const LISTED: usize = 100;

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
#[utoipa::path(get, path = "/api/v1/feed", tag = "server")]
pub(in crate::http) async fn feed(
    State(app): State<App>,
    by: Person,
    QueryParams(query): QueryParams<Query>,
) -> Result<Json<FeedPage>, ApiError> {
    let limit = query.limit.map_or(LISTED, |limit| limit as usize);
    if !(1..=MAX_FEED_ENTRIES).contains(&limit) {
        return Err(ApiError::invalid(format!(
            "limit: expected 1 to {MAX_FEED_ENTRIES}, not {limit}"
        )));
    }
    let mut theirs = HashSet::new();
    let mut known = HashSet::new();
    if !by.scope.is_everything() {
        theirs.extend(app.store.robots_in(&by.scope).await?);
        known.extend(app.store.robots_in(&Scope::everything()).await?);
    }
    // A robot's current labels decide, as everywhere else. An entry also holds the labels at its
    // time: for a removed robot, those are all that is left.
    let is_theirs_now = |robot: &KnownRobot| match known.contains(&robot.id) {
        true => theirs.contains(&robot.id),
        false => by.scope.covers(&robot.id, &robot.name, &robot.labels),
    };
    let mut entries = Vec::new();
    for (entry, audience) in app.feed.after(query.after.unwrap_or(0)) {
        let is_theirs = match audience {
            FeedAudience::Everybody => true,
            _ if by.scope.is_everything() => true,
            FeedAudience::Unlimited => false,
            FeedAudience::Robot(robot) => is_theirs_now(&robot),
        };
        if is_theirs {
            entries.push(entry);
        }
    }
    match query.after {
        Some(_) => entries.truncate(limit),
        None => drop(entries.drain(..entries.len().saturating_sub(limit))),
    }
    Ok(Json(FeedPage { entries }))
}
