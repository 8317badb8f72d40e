//! Changes to many robots at once.

use axum::Json;
use axum::extract::State;
use http::HeaderMap;
use task_macros::operation;
use task_proto::api::{BulkLabels, BulkRemove, IDEMPOTENCY_KEY, MatchedRobots};

use super::live_robots::LiveRobots;
use crate::domain::person::Person;
use crate::http::error::ApiError;
use crate::http::extract::{JsonBody, idempotency_key};
use crate::http::openapi::{OrderKey, OrderRefusals};
use crate::http::views::Views;
use crate::orders::actions::{IdempotencyKey, RobotActions};

/// Sets and removes labels of many robots: of all the selected robots or of none.
#[operation(tag = "robots", params(OrderKey), responses(OrderRefusals))]
pub(in crate::http) async fn labels(
    State(robots): State<RobotActions>,
    State(views): State<Views>,
    by: Person,
    headers: HeaderMap,
    JsonBody(order): JsonBody<BulkLabels>,
) -> Result<Json<MatchedRobots>, ApiError> {
    let labelled = robots.label_selected(&by, order_key(&headers)?.as_ref(), &order).await?;
    Ok(Json(views.matched(labelled)))
}

/// Removes many robots: all the selected robots or none.
#[operation(tag = "robots", params(OrderKey), responses(OrderRefusals))]
pub(in crate::http) async fn remove(
    State(robots): State<RobotActions>,
    State(views): State<Views>,
    State(live): State<LiveRobots>,
    by: Person,
    headers: HeaderMap,
    JsonBody(order): JsonBody<BulkRemove>,
) -> Result<Json<MatchedRobots>, ApiError> {
    if order.dry_run {
        let selected = robots.preview_removal(&by, &order.selector).await?;
        return Ok(Json(views.matched(selected)));
    }
    let removed =
        robots.remove_selected(&by, order_key(&headers)?.as_ref(), &order.selector).await?;
    // Their last presence is part of the answer.
    let answer = views.matched(removed);
    answer.robots.iter().for_each(|robot| live.removed(&robot.id));
    Ok(Json(answer))
}

/// The idempotency key of an order, if present: it identifies a repeated order.
fn order_key(headers: &HeaderMap) -> Result<Option<IdempotencyKey>, ApiError> {
    headers.get(IDEMPOTENCY_KEY).map(|key| idempotency_key(Some(key))).transpose()
}
