//! Changes to many robots at once: to all that match, or to none.

use task_proto::api::{BulkLabels, MatchedRobot};
use task_proto::id::Labels;
use task_proto::selector::Selector;

use super::robots::{check_labels, matched, removal, shown_labels};
use super::{ActionError, Actions, IdempotencyKey, all_known, check_scope, quoted};
use crate::domain::person::Person;
use crate::orders::advance::advance;
use crate::orders::changes::{Change, Consequences};
use crate::store::{Act, Deed, KnownRobot, Write};

impl Actions {
    /// Sets and removes labels of the matching robots. The robots have to be in the person's scope
    /// before and after. Returns the matching robots, also those without a change; `online` is left
    /// false. A dry run only checks whether the change is possible.
    pub async fn label_robots(
        &self,
        by: &Person,
        key: Option<&IdempotencyKey>,
        order: &BulkLabels,
    ) -> Result<Vec<MatchedRobot>, ActionError> {
        let BulkLabels { selector, set, remove, dry_run } = order;
        if set.is_empty() && remove.is_empty() {
            return Err(ActionError::Invalid {
                key: "set",
                reason: "no label is to be set or removed".to_owned(),
            });
        }
        if let Some(both) = remove.iter().find(|key| set.contains_key(*key)) {
            let reason = format!("{both} is to be set as well");
            return Err(ActionError::Invalid { key: "remove", reason });
        }
        let request = format!("label {selector} {} {remove:?}", shown_labels(set));
        let key = key.filter(|_| !dry_run);
        let mut write = self.store.begin().await?;
        if let Some(answer) = self.answered_before(&mut write, by, key, &request).await? {
            return Ok(answer);
        }
        let robots = meant(&mut write, by, selector).await?;
        let relabelled = |robot: &KnownRobot| {
            let kept = robot.labels.iter().filter(|(key, _)| !remove.contains(*key));
            let labels: Labels =
                kept.chain(set).map(|(key, value)| (key.clone(), value.clone())).collect();
            check_labels(&labels)?;
            Ok(KnownRobot { labels, ..robot.clone() })
        };
        let after = robots.iter().map(relabelled).collect::<Result<Vec<_>, ActionError>>()?;
        check_scope(by, &after, || format!("{} with the new labels", quoted(selector)))?;
        if *dry_run {
            return Ok(robots.into_iter().map(matched).collect());
        }
        let changed: Vec<&KnownRobot> = after
            .iter()
            .zip(&robots)
            .filter(|(after, before)| after != before)
            .map(|(after, _)| after)
            .collect();
        write.update_labels(&changed).await?;
        let removed: Vec<&str> = remove.iter().map(|key| key.as_str()).collect();
        let deed = Deed::by(by, Act::BulkLabels, selector)
            .with_some("set", (!set.is_empty()).then(|| shown_labels(set)))
            .with_some("remove", (!removed.is_empty()).then(|| removed.join(",")))
            .with("count", robots.len());
        let now_ms = self.clock.now_ms();
        write.audit(&deed, now_ms).await?;
        let answer: Vec<MatchedRobot> = robots.iter().cloned().map(matched).collect();
        self.remember_answer(&mut write, by, key, &request, &answer, now_ms).await?;
        write.commit().await?;
        for robot in changed {
            self.changes.announce(Change::Robot(robot.id.clone()));
        }
        self.changes.announce(Change::Scopes);
        self.changes.announce_rights();
        Ok(answer)
    }

    /// Removes the robots that match, like [`Actions::remove_robot`] each.
    pub async fn remove_robots(
        &self,
        by: &Person,
        key: Option<&IdempotencyKey>,
        selector: &Selector,
    ) -> Result<Vec<MatchedRobot>, ActionError> {
        let request = format!("remove {selector}");
        let now_ms = self.clock.now_ms();
        let mut write = self.store.begin().await?;
        if let Some(answer) = self.answered_before(&mut write, by, key, &request).await? {
            return Ok(answer);
        }
        let robots = meant(&mut write, by, selector).await?;
        let mut consequences = self.take_away(&mut write, &robots, now_ms).await?;
        let touched = consequences.deployments.clone();
        advance(&mut write, &self.chooser, touched, now_ms, &mut consequences).await?;
        for robot in &robots {
            write.audit(&removal(by, robot), now_ms).await?;
        }
        let deed = Deed::by(by, Act::BulkRemove, selector).with("count", robots.len());
        write.audit(&deed, now_ms).await?;
        let answer: Vec<MatchedRobot> = robots.iter().cloned().map(matched).collect();
        self.remember_answer(&mut write, by, key, &request, &answer, now_ms).await?;
        write.commit().await?;
        self.announce_removed(&robots, consequences);
        Ok(answer)
    }

    /// Ends all that is ordered of `robots`, their tokens and themselves.
    pub(super) async fn take_away(
        &self,
        write: &mut Write,
        robots: &[KnownRobot],
        now_ms: u64,
    ) -> Result<Consequences, ActionError> {
        let ids: Vec<_> = robots.iter().map(|robot| robot.id.clone()).collect();
        let deployments = write.end_all_of_robots(&ids, now_ms).await?;
        write.revoke_tokens(&ids, now_ms).await?;
        write.remove_robots(&ids, now_ms).await?;
        Ok(Consequences { deployments, ..Consequences::default() })
    }

    /// To be called after the commit.
    pub(super) fn announce_removed(&self, robots: &[KnownRobot], consequences: Consequences) {
        for robot in robots {
            self.envelopes.forget(&robot.id);
            self.changes.announce(Change::RobotRemoved(Box::new(robot.clone())));
        }
        self.changes.publish(consequences);
    }
}

/// The robots that match a selector; an error if there are none, or if one is outside the person's
/// scope.
async fn meant(
    write: &mut Write,
    by: &Person,
    selector: &Selector,
) -> Result<Vec<KnownRobot>, ActionError> {
    let robots = all_known(write.matching_robots(selector, &by.scope).await?)?;
    if robots.is_empty() {
        return Err(ActionError::NoRobotsMatch(quoted(selector)));
    }
    check_scope(by, &robots, || quoted(selector))?;
    Ok(robots)
}
