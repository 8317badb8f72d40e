//! The robots that match a selector, and the names in the selector that match none.

use task_proto::RobotName;
use task_proto::ids::selector::Selector;

use super::robots::{KNOWN, known_robot};
use crate::domain::person::Scope;
use crate::store::repositories::Robots;
use crate::store::{KnownRobot, Store, StoreError, Transaction};

/// Selects the robots that can take orders.
const ORDERABLE: &str =
    "SELECT id, name, mac, labels FROM robots WHERE removed_at_ms IS NULL AND awaits_approval = 0";

/// The result of a selector.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct MatchingRobots {
    /// The matching robots of all scopes, sorted by name.
    pub robots: Vec<KnownRobot>,
    /// Names and ids in the selector that belong to no robot of the scope, sorted.
    pub unknown: Vec<RobotName>,
}

impl Robots<&Store> {
    /// The robots that match `selector` now, sorted by name, without those that wait for approval.
    pub async fn matching(
        self,
        selector: &Selector,
        scope: &Scope,
    ) -> Result<MatchingRobots, StoreError> {
        matching(sqlx::query(ORDERABLE).fetch_all(&self.0.reads).await?, selector, scope)
    }

    /// The names and ids in a selector that belong to no robot of a scope, sorted.
    pub async fn unknown(
        self,
        selector: &Selector,
        scope: &Scope,
    ) -> Result<Vec<RobotName>, StoreError> {
        if selector.names().is_empty() {
            return Ok(Vec::new());
        }
        Ok(matching(sqlx::query(KNOWN).fetch_all(&self.0.reads).await?, selector, scope)?.unknown)
    }
}

impl Robots<&mut Transaction> {
    /// The robots that match `selector` now, sorted by name, without those that wait for approval.
    pub async fn matching(
        &mut self,
        selector: &Selector,
        scope: &Scope,
    ) -> Result<MatchingRobots, StoreError> {
        matching(sqlx::query(ORDERABLE).fetch_all(self.0.connection()).await?, selector, scope)
    }
}

fn matching(
    rows: Vec<sqlx::any::AnyRow>,
    selector: &Selector,
    scope: &Scope,
) -> Result<MatchingRobots, StoreError> {
    let mut robots = rows.iter().map(known_robot).collect::<Result<Vec<_>, _>>()?;
    let mut names = selector.names();
    if !names.is_empty() {
        for robot in
            robots.iter().filter(|robot| scope.covers(&robot.id, &robot.name, &robot.labels))
        {
            names.remove(robot.name.as_str());
            names.remove(robot.id.as_str());
        }
    }
    let unknown = names.into_iter().collect();
    robots.retain(|robot| selector.matches(&robot.id, &robot.name, &robot.labels));
    robots.sort_by(|one, other| one.name.cmp(&other.name));
    Ok(MatchingRobots { robots, unknown })
}
