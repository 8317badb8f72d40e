//! A list of robots in pages, cut by name: an insertion meanwhile repeats no robot.

use task_proto::ids::selector::Selector;
use task_proto::{RobotId, RobotName};

use crate::domain::person::Scope;
use crate::store::repositories::Robots;
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
    /// query checks all robots, but reads the full rows of these few only.
    pub async fn page(
        self,
        scope: &Scope,
        selector: Option<&Selector>,
        after: Option<&RobotName>,
        limit: usize,
    ) -> Result<RobotPage, StoreError> {
        let mut known = self.known(scope).await?;
        if let Some(selector) = selector {
            known.retain(|robot| selector.matches(&robot.id, &robot.name, &robot.labels));
        }
        let total = known.len() as u64;
        known.retain(|robot| after.is_none_or(|after| robot.name > *after));
        known.sort_by(|one, other| one.name.cmp(&other.name));
        let has_more = known.len() > limit;
        known.truncate(limit);
        let next = known.last().filter(|_| has_more).map(|last| last.name.clone());
        let page: Vec<RobotId> = known.into_iter().map(|robot| robot.id).collect();
        Ok(RobotPage { robots: self.among(&page).await?, next, total })
    }
}
