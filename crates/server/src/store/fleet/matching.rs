//! The robots that match a selector or belong to a scope, and the names in a selector that belong
//! to none. The database finds them by its indexes of names and labels; no robot is read that does
//! not match.

use serde::{Deserialize, Serialize};
use sqlx::any::{AnyArguments, AnyRow};
use sqlx::query::Query;
use sqlx::{Any, Row as _};
use task_proto::ids::selector::Selector;
use task_proto::{RobotId, RobotName, TaskName};

use super::robots::known_robot;
use super::selector_sql::{EVER_REGISTERED, ORDERABLE, REGISTERED, RobotSets};
use crate::domain::person::Scope;
use crate::store::database::dialect::Dialect;
use crate::store::repositories::Robots;
use crate::store::rows::id;
use crate::store::{KnownRobot, Store, StoreError, Transaction};

/// A robot that an order selected, in the form stored with the order's answer.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct SelectedRobot {
    pub id: RobotId,
    pub name: RobotName,
}

/// The result of a selector.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MatchingRobots<T> {
    /// The matching robots of all scopes, sorted by name.
    pub robots: Vec<T>,
    /// Whether each of these robots is in the scope.
    pub in_scope: Vec<bool>,
    /// Names and ids in the selector that belong to no robot of the scope, sorted.
    pub unknown: Vec<RobotName>,
}

impl<T> MatchingRobots<T> {
    /// The number of robots outside the scope.
    pub fn outside(&self) -> usize {
        self.in_scope.iter().filter(|is_own| !*is_own).count()
    }
}

/// The columns of a [`SelectedRobot`].
const SELECTED: &str = "r.id, r.name";
/// The columns of a [`KnownRobot`].
const KNOWN: &str = "r.id, r.name, r.mac, r.labels";

impl Robots<&Store> {
    /// The robots that match `selector` now, without those that wait for approval. With `task`,
    /// only robots that should have the task.
    pub async fn matching(
        self,
        selector: &Selector,
        scope: &Scope,
        task: Option<&TaskName>,
    ) -> Result<MatchingRobots<SelectedRobot>, StoreError> {
        let unknown = self.unknown_among(ORDERABLE, selector, scope).await?;
        let query = matching(self.0.dialect, SELECTED, selector, scope, task);
        read_matching(query.fetch_all(&self.0.reads).await?, unknown, selected_robot)
    }

    /// The names and ids in a selector that belong to no robot of a scope, sorted.
    pub async fn unknown(
        self,
        selector: &Selector,
        scope: &Scope,
    ) -> Result<Vec<RobotName>, StoreError> {
        self.unknown_among(REGISTERED, selector, scope).await
    }

    async fn unknown_among(
        self,
        among: &'static str,
        selector: &Selector,
        scope: &Scope,
    ) -> Result<Vec<RobotName>, StoreError> {
        match unknown(self.0.dialect, among, selector, scope) {
            Some(query) => names(query.fetch_all(&self.0.reads).await?),
            None => Ok(Vec::new()),
        }
    }

    /// The robots in a scope.
    pub async fn ids_in(self, scope: &Scope) -> Result<Vec<RobotId>, StoreError> {
        let rows = self.in_scope("r.id", scope).await?;
        rows.iter().map(|row| id("robots.id", row.try_get("id")?)).collect()
    }

    /// These columns of the registered `robots r` in a scope.
    pub(super) async fn in_scope(
        self,
        columns: &str,
        scope: &Scope,
    ) -> Result<Vec<AnyRow>, StoreError> {
        let query = in_scope(self.0.dialect, REGISTERED, columns, scope);
        Ok(query.fetch_all(&self.0.reads).await?)
    }
}

impl Robots<&mut Transaction> {
    /// The robots that match `selector` now, without those that wait for approval. With `task`,
    /// only robots that should have the task.
    pub async fn matching(
        &mut self,
        selector: &Selector,
        scope: &Scope,
        task: Option<&TaskName>,
    ) -> Result<MatchingRobots<SelectedRobot>, StoreError> {
        let unknown = self.unknown(selector, scope).await?;
        let query = matching(self.0.dialect, SELECTED, selector, scope, task);
        read_matching(query.fetch_all(self.0.connection()).await?, unknown, selected_robot)
    }

    /// The robots that match `selector` now, without those that wait for approval, with all that is
    /// known of them.
    pub async fn matching_known(
        &mut self,
        selector: &Selector,
        scope: &Scope,
    ) -> Result<MatchingRobots<KnownRobot>, StoreError> {
        let unknown = self.unknown(selector, scope).await?;
        let query = matching(self.0.dialect, KNOWN, selector, scope, None);
        read_matching(query.fetch_all(self.0.connection()).await?, unknown, known_robot)
    }

    /// The names and ids in a selector that belong to no robot of a scope that can take orders,
    /// sorted.
    pub async fn unknown(
        &mut self,
        selector: &Selector,
        scope: &Scope,
    ) -> Result<Vec<RobotName>, StoreError> {
        match unknown(self.0.dialect, ORDERABLE, selector, scope) {
            Some(query) => names(query.fetch_all(self.0.connection()).await?),
            None => Ok(Vec::new()),
        }
    }

    /// The robots of a scope, including removed robots that were in it at their removal.
    pub async fn ids_ever_in(&mut self, scope: &Scope) -> Result<Vec<RobotId>, StoreError> {
        let query = in_scope(self.0.dialect, EVER_REGISTERED, "r.id", scope);
        let rows = query.fetch_all(self.0.connection()).await?;
        rows.iter().map(|row| id("robots.id", row.try_get("id")?)).collect()
    }
}

fn in_scope(
    dialect: &'static Dialect,
    among: &'static str,
    columns: &str,
    scope: &Scope,
) -> Query<'static, Any, AnyArguments> {
    let mut sets = RobotSets::new(dialect, among);
    let scope = sets.scope(scope);
    let sql = format!("SELECT {columns} FROM robots r WHERE {}", sets.condition(scope.as_deref()));
    sets.query(sql)
}

/// The robots that match, with a column that is 1 for those of the scope.
fn matching(
    dialect: &'static Dialect,
    columns: &str,
    selector: &Selector,
    scope: &Scope,
    task: Option<&TaskName>,
) -> Query<'static, Any, AnyArguments> {
    let mut sets = RobotSets::new(dialect, ORDERABLE);
    let selected = sets.selector(selector);
    let (own, join) = match sets.scope(scope) {
        None => ("1", String::new()),
        Some(scope) => (
            "CASE WHEN own.robot_id IS NULL THEN 0 ELSE 1 END",
            format!(
                "LEFT JOIN (SELECT DISTINCT robot_id FROM ({scope}) AS scoped) AS own ON own.robot_id = r.id"
            ),
        ),
    };
    let mut condition = sets.condition(selected.as_deref());
    if let Some(task) = task {
        let task = sets.parameter(task.to_string());
        condition.push_str(&format!(
            " AND r.id IN (SELECT a.robot_id FROM assignments a WHERE a.task = ${task} AND a.desired = 1)"
        ));
    }
    let own = format!("CAST({own} AS BIGINT) AS own");
    sets.query(format!("SELECT {columns}, {own} FROM robots r {join} WHERE {condition}"))
}

/// The names and ids of the selector that no robot of the scope has; `None`: it has no names.
fn unknown(
    dialect: &'static Dialect,
    among: &'static str,
    selector: &Selector,
    scope: &Scope,
) -> Option<Query<'static, Any, AnyArguments>> {
    let names = selector.names();
    if names.is_empty() {
        return None;
    }
    let mut sets = RobotSets::new(dialect, among);
    let (scope, names) = (sets.scope(scope), sets.texts(&names));
    let condition = sets.condition(scope.as_deref());
    let known = |column: &str| {
        format!("SELECT r.{column} FROM robots r WHERE {condition} AND r.{column} IN ({names})")
    };
    let sql = format!(
        "SELECT named.value AS name FROM ({names}) AS named EXCEPT {} EXCEPT {}",
        known("id"),
        known("name")
    );
    Some(sets.query(sql))
}

/// A robot that lists sort by its name.
trait Named {
    fn name(&self) -> &RobotName;
}

impl Named for SelectedRobot {
    fn name(&self) -> &RobotName {
        &self.name
    }
}

impl Named for KnownRobot {
    fn name(&self) -> &RobotName {
        &self.name
    }
}

fn read_matching<T: Named>(
    rows: Vec<AnyRow>,
    unknown: Vec<RobotName>,
    read: impl Fn(&AnyRow) -> Result<T, StoreError>,
) -> Result<MatchingRobots<T>, StoreError> {
    let read = |row: &AnyRow| Ok((read(row)?, row.try_get::<i64, _>("own")? == 1));
    let mut found = rows.iter().map(read).collect::<Result<Vec<_>, StoreError>>()?;
    found.sort_by(|(one, _), (other, _)| one.name().cmp(other.name()));
    let (robots, in_scope) = found.into_iter().unzip();
    Ok(MatchingRobots { robots, in_scope, unknown })
}

fn selected_robot(row: &AnyRow) -> Result<SelectedRobot, StoreError> {
    let name = id("robots.name", row.try_get("name")?)?;
    Ok(SelectedRobot { id: id("robots.id", row.try_get("id")?)?, name })
}

fn names(rows: Vec<AnyRow>) -> Result<Vec<RobotName>, StoreError> {
    let mut names = rows
        .iter()
        .map(|row| id("robots.name", row.try_get("name")?))
        .collect::<Result<Vec<_>, _>>()?;
    names.sort();
    Ok(names)
}
