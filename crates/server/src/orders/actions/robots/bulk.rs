//! Changes to many robots at once: to all that match, or to none.

use task_proto::api::BulkLabels;
use task_proto::ids::Labels;
use task_proto::ids::selector::Selector;

use super::{RobotActions, RobotError, check_labels, delete_records, format_labels, removal_event};
use crate::domain::person::Person;
use crate::orders::actions::OrderError;
use crate::orders::actions::idempotency::{IdempotencyKey, store_answer, stored_answer};
use crate::orders::actions::selection::{check_scope, matched, preview, quoted, select_known};
use crate::orders::changes::Change;
use crate::orders::rollout;
use crate::store::{AuditAction, AuditEvent, KnownRobot, SelectedRobot};

impl RobotActions {
    /// Sets and removes labels of the matching robots. The robots have to be in the person's scope
    /// before and after. Returns the matching robots, also those without a change. A dry run only
    /// checks whether the change is possible.
    pub async fn label_selected(
        &self,
        by: &Person,
        key: Option<&IdempotencyKey>,
        order: &BulkLabels,
    ) -> Result<Vec<SelectedRobot>, RobotError> {
        let BulkLabels { selector, set, remove, dry_run } = order;
        if set.is_empty() && remove.is_empty() {
            let reason = "expected at least one label to set or remove";
            return Err(OrderError::invalid("set", reason).into());
        }
        if let Some(both) = remove.iter().find(|key| set.contains_key(*key)) {
            let reason = format!("{both} is also in set");
            return Err(OrderError::invalid("remove", reason).into());
        }
        let request = format!("label {selector} {} {remove:?}", format_labels(set));
        let key = key.filter(|_| !dry_run);
        let mut write = self.store.begin().await?;
        if let Some(answer) = stored_answer(&mut write, by, key, &request).await? {
            return Ok(answer);
        }
        let robots = select_known(&mut write, by, selector).await?;
        let relabelled = |robot: &KnownRobot| {
            let kept = robot.labels.iter().filter(|(key, _)| !remove.contains(*key));
            let labels: Labels =
                kept.chain(set).map(|(key, value)| (key.clone(), value.clone())).collect();
            check_labels(&labels)?;
            Ok(KnownRobot { labels, ..robot.clone() })
        };
        let after = robots.iter().map(relabelled).collect::<Result<Vec<_>, OrderError>>()?;
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
        write.robots().update_labels(&changed).await?;
        let removed: Vec<&str> = remove.iter().map(|key| key.as_str()).collect();
        let event = AuditEvent::by(by, AuditAction::BulkLabels, selector)
            .with_some("set", (!set.is_empty()).then(|| format_labels(set)))
            .with_some("remove", (!removed.is_empty()).then(|| removed.join(",")))
            .with("count", robots.len());
        let now_ms = self.clock.now_ms();
        write.audit().record(&event, now_ms).await?;
        let answer: Vec<SelectedRobot> = robots.iter().cloned().map(matched).collect();
        store_answer(&mut write, by, key, &request, &answer, now_ms).await?;
        write.commit().await?;
        self.changes.notify_robots(changed.iter().map(|robot| robot.id.clone()));
        for robot in changed {
            self.changes.announce(Change::Robot(robot.id.clone()));
        }
        self.changes.announce(Change::Scopes);
        self.changes.announce_rights();
        Ok(answer)
    }

    /// Removes the robots that match, like [`RobotActions::remove`] each.
    pub async fn remove_selected(
        &self,
        by: &Person,
        key: Option<&IdempotencyKey>,
        selector: &Selector,
    ) -> Result<Vec<SelectedRobot>, RobotError> {
        let request = format!("remove {selector}");
        let now_ms = self.clock.now_ms();
        let mut write = self.store.begin().await?;
        if let Some(answer) = stored_answer(&mut write, by, key, &request).await? {
            return Ok(answer);
        }
        let robots = select_known(&mut write, by, selector).await?;
        let mut notifications = delete_records(&mut write, &robots, now_ms).await?;
        let touched = notifications.deployments.clone();
        rollout::apply(&mut write, &self.planner, touched, now_ms, &mut notifications).await?;
        for robot in &robots {
            write.audit().record(&removal_event(by, robot), now_ms).await?;
        }
        let event =
            AuditEvent::by(by, AuditAction::BulkRemove, selector).with("count", robots.len());
        write.audit().record(&event, now_ms).await?;
        let answer: Vec<SelectedRobot> = robots.iter().cloned().map(matched).collect();
        store_answer(&mut write, by, key, &request, &answer, now_ms).await?;
        write.commit().await?;
        self.announce_removed(&robots, notifications);
        Ok(answer)
    }

    /// The robots that [`RobotActions::remove_selected`] would remove now, sorted by name; an error
    /// if there are none.
    pub async fn preview_removal(
        &self,
        by: &Person,
        selector: &Selector,
    ) -> Result<Vec<SelectedRobot>, RobotError> {
        Ok(preview(&self.store, by, selector).await?)
    }
}
