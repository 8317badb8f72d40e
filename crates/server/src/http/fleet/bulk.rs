//! Changes to many robots at once.

use axum::Json;
use axum::extract::State;
use http::HeaderMap;
use task_proto::api::{BulkLabels, BulkRemove, IDEMPOTENCY_KEY, MatchedRobot, MatchedRobots};

use super::robots::gone;
use crate::domain::person::Person;
use crate::http::App;
use crate::http::error::ApiError;
use crate::http::extract::{JsonBody, idempotency_key};
use crate::http::openapi::OrderKey;
use crate::http::views::complete_matched;
use crate::orders::actions::IdempotencyKey;

/// Sets and removes labels of many robots: of all the selected robots or of none.
#[utoipa::path(post, path = "/api/v1/bulk/labels", tag = "robots", params(OrderKey),
    responses((status = 404, description = "`unknown_robots`: the selector names robots that there are not."),
        (status = 409, description = "`no_robots_match`, or `idempotency_key_reused` for another order.")))]
pub(in crate::http) async fn labels(
    State(app): State<App>,
    by: Person,
    headers: HeaderMap,
    JsonBody(order): JsonBody<BulkLabels>,
) -> Result<Json<MatchedRobots>, ApiError> {
    Ok(completed(&app, app.actions.label_robots(&by, order_key(&headers)?.as_ref(), &order).await?))
}

/// Removes many robots: all the selected robots or none.
#[utoipa::path(post, path = "/api/v1/bulk/remove", tag = "robots", params(OrderKey),
    responses((status = 404, description = "`unknown_robots`: the selector names robots that there are not."),
        (status = 409, description = "`no_robots_match`, or `idempotency_key_reused` for another order.")))]
pub(in crate::http) async fn remove(
    State(app): State<App>,
    by: Person,
    headers: HeaderMap,
    JsonBody(order): JsonBody<BulkRemove>,
) -> Result<Json<MatchedRobots>, ApiError> {
    if order.dry_run {
        return Ok(completed(&app, app.actions.matching_robots(&by, &order.selector).await?));
    }
    let removed =
        app.actions.remove_robots(&by, order_key(&headers)?.as_ref(), &order.selector).await?;
    let answer = completed(&app, removed);
    answer.robots.iter().for_each(|robot| gone(&app, &robot.id));
    Ok(answer)
}

/// The idempotency key of an order, if present: it identifies a repeated order.
fn order_key(headers: &HeaderMap) -> Result<Option<IdempotencyKey>, ApiError> {
    headers.get(IDEMPOTENCY_KEY).map(|key| idempotency_key(Some(key))).transpose()
}

fn completed(app: &App, mut robots: Vec<MatchedRobot>) -> Json<MatchedRobots> {
    complete_matched(&mut robots, &app.presence, app.clock.now_ms());
    Json(MatchedRobots { robots })
}
