//! The robots that an order selects: all of them are known and in the person's scope, or the whole
//! order is refused. A partial order would be a surprise.

use task_proto::RobotName;
use task_proto::ids::selector::Selector;

use super::error::OrderError;
use crate::domain::person::Person;
use crate::store::{KnownRobot, MatchingRobots, SelectedRobot, Store, Transaction};

/// The robots that match this selector, sorted by name; an error if none match, or if one is
/// outside the person's scope.
pub(super) async fn select(
    write: &mut Transaction,
    by: &Person,
    selector: &Selector,
) -> Result<Vec<SelectedRobot>, OrderError> {
    require_selected(by, write.robots().matching(selector, &by.scope, None).await?, selector)
}

/// Does as [`select`], with all that is known of the robots.
pub(super) async fn select_known(
    write: &mut Transaction,
    by: &Person,
    selector: &Selector,
) -> Result<Vec<KnownRobot>, OrderError> {
    require_selected(by, write.robots().matching_known(selector, &by.scope).await?, selector)
}

/// The robots that [`select`] would give to an order now.
pub(super) async fn preview(
    store: &Store,
    by: &Person,
    selector: &Selector,
) -> Result<Vec<SelectedRobot>, OrderError> {
    require_selected(by, store.robots().matching(selector, &by.scope, None).await?, selector)
}

/// The robots of a selector's result; an error if there are none, or if one is outside the person's
/// scope.
pub(super) fn require_selected<T>(
    by: &Person,
    matching: MatchingRobots<T>,
    selector: &Selector,
) -> Result<Vec<T>, OrderError> {
    let outside = matching.outside();
    let MatchingRobots { robots, unknown, .. } = matching;
    require_known(unknown)?;
    if robots.is_empty() {
        return Err(OrderError::NoRobotsMatch(quoted(selector)));
    }
    refuse_outside(by, outside, robots.len(), || quoted(selector))?;
    Ok(robots)
}

/// Refuses a selector with names and ids that belong to no robot of the person's: a mistake that
/// would go unnoticed.
pub(super) fn require_known(unknown: Vec<RobotName>) -> Result<(), OrderError> {
    if unknown.is_empty() { Ok(()) } else { Err(OrderError::UnknownRobots(unknown)) }
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
    refuse_outside(by, outside, robots.len(), selection)
}

/// Refuses a whole order if `outside` of its `selected` robots are outside the person's scope.
fn refuse_outside(
    by: &Person,
    outside: usize,
    selected: usize,
    selection: impl FnOnce() -> String,
) -> Result<(), OrderError> {
    if outside == 0 {
        return Ok(());
    }
    let (selection, person, scope) = (selection(), by.name.clone(), by.scope.to_string());
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
