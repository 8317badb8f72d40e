//! A list of robots in pages, cut by name: an insertion meanwhile repeats no robot.

use sqlx::Row as _;
use task_proto::ids::selector::Selector;
use task_proto::{RobotId, RobotName};

use super::selector_sql::{REGISTERED, RobotSets};
use crate::domain::person::Scope;
use crate::store::repositories::Robots;
use crate::store::rows::{id, number};
use crate::store::{RobotRow, Store, StoreError};

/// A page of robots, sorted by name.
#[derive(Debug)]
pub struct RobotPage {
    pub robots: Vec<RobotRow>,
    /// The last robot's name, if there are more pages.
    pub next: Option<RobotName>,
    /// The number of robots in all pages.
    pub total: u64,
}

impl Robots<&Store> {
    /// The first `limit` robots in a scope that match `selector` and have a name after `after`. The
    /// query counts all robots, but reads these few only.
    pub async fn page(
        self,
        scope: &Scope,
        selector: Option<&Selector>,
        after: Option<&RobotName>,
        limit: usize,
    ) -> Result<RobotPage, StoreError> {
        let chosen = scope.and(selector);
        let mut sets = RobotSets::new(self.0.dialect, REGISTERED);
        let set = sets.scope(&chosen);
        let condition = sets.condition(set.as_deref());
        let total = sets.query(format!("SELECT COUNT(*) FROM robots r WHERE {condition}"));
        let total: i64 = total.fetch_one(&self.0.reads).await?.try_get(0)?;
        let mut sets = RobotSets::new(self.0.dialect, REGISTERED);
        let set = sets.scope(&chosen);
        let (condition, bytewise) = (sets.condition(set.as_deref()), self.0.dialect.bytewise);
        let after = sets.parameter(after.map_or(String::new(), RobotName::to_string));
        let sql = format!(
            "SELECT r.id, r.name FROM robots r WHERE {condition} AND r.name {bytewise} > ${after}
             ORDER BY r.name {bytewise} LIMIT {}",
            limit.saturating_add(1)
        );
        let mut rows = sets.query(sql).fetch_all(&self.0.reads).await?;
        let has_more = rows.len() > limit;
        rows.truncate(limit);
        let next = match rows.last().filter(|_| has_more) {
            Some(last) => Some(id("robots.name", last.try_get("name")?)?),
            None => None,
        };
        let page = rows
            .iter()
            .map(|row| id("robots.id", row.try_get("id")?))
            .collect::<Result<Vec<RobotId>, _>>()?;
        Ok(RobotPage { robots: self.among(&page).await?, next, total: number(total) })
    }
}
