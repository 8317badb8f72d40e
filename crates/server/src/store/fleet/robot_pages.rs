//! A list of robots in pages, cut by name: nothing comes twice when one is added meanwhile.

use task_proto::api::RobotView;
use task_proto::selector::Selector;
use task_proto::{RobotId, RobotName};

use crate::domain::person::Scope;
use crate::store::{Store, StoreError};

/// Some of the robots, sorted by name.
#[derive(Debug)]
pub struct RobotPage {
    /// As [`Store::robots`] has them.
    pub robots: Vec<RobotView>,
    /// The last one's name, if there are further ones.
    pub next: Option<RobotName>,
    /// How many all pages have.
    pub total: u64,
}

impl Store {
    /// The first `limit` robots in a scope that `selector` means, whose names come after `after`.
    /// All are looked at, of few is everything read.
    pub async fn robots_page(
        &self,
        scope: &Scope,
        selector: Option<&Selector>,
        after: Option<&RobotName>,
        limit: usize,
    ) -> Result<RobotPage, StoreError> {
        let mut known = self.known_robots(scope).await?;
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
        Ok(RobotPage { robots: self.robots_among(&page).await?, next, total })
    }
}
