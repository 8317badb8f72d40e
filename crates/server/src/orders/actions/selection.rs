//! The robots that an order selects: all of them are known and in the person's scope, or the whole
//! order is refused. A partial order would be a surprise.

use serde::{Deserialize, Serialize};
use task_proto::ids::selector::Selector;
use task_proto::{RobotId, RobotName};

use super::error::OrderError;
use crate::domain::person::Person;
use crate::store::{KnownRobot, MatchingRobots, Store, Transaction};

/// A robot that an order selected, in the form stored with the order's answer.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct SelectedRobot {
    pub id: RobotId,
    pub name: RobotName,
}

/// The robots that match this selector, sorted by name; an error if none match, or if one is
/// outside the person's scope.
pub(super) async fn select(
    write: &mut Transaction,
    by: &Person,
    selector: &Selector,
) -> Result<Vec<KnownRobot>, OrderError> {
    require_selected(by, write.robots().matching(selector, &by.scope).await?, selector)
}

/// The robots that [`select`] would give to an order now.
pub(super) async fn preview(
    store: &Store,
    by: &Person,
    selector: &Selector,
) -> Result<Vec<SelectedRobot>, OrderError> {
    let matching = store.robots().matching(selector, &by.scope).await?;
    let robots = require_selected(by, matching, selector)?;
    Ok(robots.into_iter().map(matched).collect())
}

fn require_selected(
    by: &Person,
    matching: MatchingRobots,
    selector: &Selector,
) -> Result<Vec<KnownRobot>, OrderError> {
    let robots = require_known(matching)?;
    if robots.is_empty() {
        return Err(OrderError::NoRobotsMatch(quoted(selector)));
    }
    check_scope(by, &robots, || quoted(selector))?;
    Ok(robots)
}

/// The robots that match. A name that no robot of the person's has is a mistake that would go
/// unnoticed.
pub(super) fn require_known(matching: MatchingRobots) -> Result<Vec<KnownRobot>, OrderError> {
    if matching.unknown.is_empty() {
        Ok(matching.robots)
    } else {
        Err(OrderError::UnknownRobots(matching.unknown))
    }
}

/// Refuses a whole order if one of its robots is outside the person's scope. `selection` names the
/// selection in the error.
pub(super) fn check_scope(
    by: &Person,
    robots: &[KnownRobot],
    selection: impl FnOnce() -> String,
) -> Result<(), OrderError> {
    let outside = robots
        .iter()
        .filter(|robot| !by.scope.covers(&robot.id, &robot.name, &robot.labels))
        .count();
    if outside == 0 {
        return Ok(());
    }
    let (selected, selection, person, scope) =
        (robots.len(), selection(), by.name.clone(), by.scope.to_string());
    Err(OrderError::OutOfScope { outside, selected, selection, person, scope })
}

pub(super) fn matched(robot: KnownRobot) -> SelectedRobot {
    SelectedRobot { id: robot.id, name: robot.name }
}

/// A selector in an error.
pub(super) fn quoted(selector: &Selector) -> String {
    let text: String = selector.to_string().chars().take(80).collect();
    format!("{text:?}")
}
