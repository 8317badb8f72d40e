//! Orders about deployments: create, cancel, resume, and the server's own: expire.

use std::collections::BTreeSet;

use task_proto::api::{CreateDeployment, DeliveryChoice, MAX_PRIORITY, MIN_PRIORITY, PackageView};
use task_proto::desired::PackageRef;
use task_proto::manifest::TaskKind;
use task_proto::report::Phase;
use task_proto::{DeploymentId, RobotId, UserName};

use super::approval::give_up_pending;
use super::robots::lifetime_ms;
use super::{ActionError, Actions, DAY_MS, IdempotencyKey, all_known, check_scope, quoted};
use crate::domain::delivery::shown_bytes;
use crate::domain::person::Person;
use crate::domain::rollout::Tally;
use crate::orders::advance::{advance, parts};
use crate::orders::changes::{Change, Consequences};
use crate::orders::chooser::{Chooser, travelling_bytes};
use crate::store::{Act, Deed, NewDeployment, Revocable, StillRunning, Write};

/// Lifetime of an idempotency key.
const KEY_LIFETIME_MS: u64 = 30 * DAY_MS;

impl Actions {
    /// Orders `package`, which the caller has looked up for `order`, on the robots that match now.
    /// The same key with the same order gives the same deployment.
    pub async fn create_deployment(
        &self,
        by: &Person,
        key: &IdempotencyKey,
        order: &CreateDeployment,
        package: &PackageView,
    ) -> Result<DeploymentId, ActionError> {
        let request = creation(order);
        let now_ms = self.clock.now_ms();
        let lifetime_ms = match order.expires_in_s {
            Some(seconds) => lifetime_ms("expires_in_s", seconds)?,
            None => self.settings.assignment_lifetime_ms,
        };
        if order.batch == Some(0) {
            return Err(ActionError::Invalid {
                key: "batch",
                reason: "expected at least 1 robot".to_owned(),
            });
        }
        if !(MIN_PRIORITY..=MAX_PRIORITY).contains(&order.priority) {
            let reason =
                format!("expected {MIN_PRIORITY} to {MAX_PRIORITY}, not {}", order.priority);
            return Err(ActionError::Invalid { key: "priority", reason });
        }
        let mut write = self.store.begin().await?;
        if let Some(answer) = self.answered_before(&mut write, by, key, &request).await? {
            return Ok(answer);
        }
        self.check_fits(order, package)?;
        let robots = all_known(write.matching_robots(&order.selector, &by.scope).await?)?;
        if robots.is_empty() {
            return Err(ActionError::NoRobotsMatch(quoted(&order.selector)));
        }
        check_scope(by, &robots, || quoted(&order.selector))?;
        let robots: Vec<RobotId> = robots.into_iter().map(|robot| robot.id).collect();
        let (kind, expires_at_ms) = (package.manifest.run.kind, now_ms + lifetime_ms);
        let placed =
            Placed { package: &package.package, kind, order, robots: &robots, expires_at_ms };
        let mut consequences = Consequences::default();
        let id = placed.place(&mut write, &self.chooser, now_ms, &mut consequences).await?;
        let task = &package.package.name;
        let deed = Deed::by(by, Act::DeploymentCreate, &id)
            .with("package", format!("{task} {}", package.package.version))
            .with("manifest", package.package.manifest.digest)
            .with("robots", &order.selector)
            .with("count", robots.len());
        write.audit(&deed, now_ms).await?;
        self.remember_answer(&mut write, by, key, &request, &id, now_ms).await?;
        write.commit().await?;
        self.changes.publish(consequences);
        Ok(id)
    }

    /// Inline packages must fit into one announcement.
    pub(super) fn check_fits(
        &self,
        order: &CreateDeployment,
        package: &PackageView,
    ) -> Result<(), ActionError> {
        let (size, most) = (travelling_bytes(&package.package), self.chooser.inline_bytes());
        if order.delivery != DeliveryChoice::Inline || size <= most {
            return Ok(());
        }
        let exact = |bytes: u64| {
            if shown_bytes(size) == shown_bytes(most) {
                format!("{bytes} B")
            } else {
                shown_bytes(bytes)
            }
        };
        let package = format!("{} {}", package.package.name, package.package.version);
        Err(ActionError::TooLargeForInline { package, size: exact(size), most: exact(most) })
    }

    /// The deployment that an earlier order with this `key` and `order` created. A repeated order
    /// is answered even if its package was deleted.
    pub async fn deployment_ordered_before(
        &self,
        by: &Person,
        key: &IdempotencyKey,
        order: &CreateDeployment,
    ) -> Result<Option<DeploymentId>, ActionError> {
        let mut write = self.store.begin().await?;
        self.answered_before(&mut write, by, key, &creation(order)).await
    }

    /// Cancels a deployment: where the deployment has not settled, the package it replaced is
    /// desired again; a running service goes on. The call is idempotent; a deployment that is over
    /// everywhere is left unchanged.
    pub async fn cancel_deployment(
        &self,
        by: &Person,
        id: &DeploymentId,
    ) -> Result<(), ActionError> {
        let now_ms = self.clock.now_ms();
        let mut write = self.store.begin().await?;
        let is_cancelled = is_cancelled(&mut write, id).await?;
        check_deployment(&mut write, by, id).await?;
        if is_cancelled {
            return Ok(());
        }
        let robots: Vec<RobotId> =
            write.revocable(id).await?.into_iter().map(|row| row.robot).collect();
        if robots.is_empty() && !write.may_be_put_back(id).await? {
            return Err(ActionError::NothingToCancel(id.clone()));
        }
        write.adopt_diverged(&robots, now_ms).await?;
        write.mark_cancelled(id, now_ms).await?;
        let taken = write.revocable(id).await?;
        let mut consequences =
            take_back(&mut write, &self.chooser, &taken, Phase::Cancelled, now_ms).await?;
        write.skip_as_previous(id).await?;
        consequences.deployments.insert(id.clone());
        write.audit(&Deed::by(by, Act::DeploymentCancel, id), now_ms).await?;
        write.commit().await?;
        self.changes.publish(consequences);
        Ok(())
    }

    /// Resumes a paused deployment; the failures so far no longer count. If the deployment is not
    /// paused, the error says why no further batch begins.
    pub async fn resume_deployment(
        &self,
        by: &Person,
        id: &DeploymentId,
    ) -> Result<(), ActionError> {
        let now_ms = self.clock.now_ms();
        let mut write = self.store.begin().await?;
        let is_cancelled = is_cancelled(&mut write, id).await?;
        check_deployment(&mut write, by, id).await?;
        if is_cancelled {
            return Err(ActionError::DeploymentCancelled(id.clone()));
        }
        let Some(open) = write.rollout(id).await?.filter(|open| open.rollout.paused) else {
            drop(write);
            return Err(self.not_paused(id).await?);
        };
        let tally = Tally::of(open.failed, parts(&self.chooser, &open, now_ms));
        write.resume(id, open.rollout.forgiven.max(tally.failures())).await?;
        write.audit(&Deed::by(by, Act::DeploymentResume, id), now_ms).await?;
        let touched = BTreeSet::from([id.clone()]);
        let mut consequences =
            Consequences { deployments: touched.clone(), ..Consequences::default() };
        advance(&mut write, &self.chooser, touched, now_ms, &mut consequences).await?;
        write.commit().await?;
        self.changes.publish(consequences);
        Ok(())
    }

    /// The error for resuming a deployment that is not paused, with the reason.
    async fn not_paused(&self, id: &DeploymentId) -> Result<ActionError, ActionError> {
        let found = self.store.deployment(id, false).await?;
        let mut view = found.ok_or_else(|| ActionError::DeploymentNotFound(id.clone()))?;
        let assignments = view.assignments.get_or_insert_default();
        let offline =
            self.chooser.offline_ms(assignments.iter().map(|one| &one.robot), self.clock.now_ms());
        assignments
            .iter_mut()
            .zip(offline)
            .for_each(|(one, offline_ms)| one.online = offline_ms.is_none());
        Ok(ActionError::NotPaused { id: id.clone(), why: view.awaited().to_string() })
    }

    /// Begins batches that are due because robots have reconnected or stay offline. To be called
    /// when a robot has connected, and every few seconds.
    pub async fn advance_rollouts(&self) -> Result<(), ActionError> {
        let open = self.store.open_rollouts().await?;
        if open.is_empty() {
            return Ok(());
        }
        let now_ms = self.clock.now_ms();
        let mut write = self.store.begin_keeping_rights().await?;
        let mut consequences = Consequences::default();
        advance(&mut write, &self.chooser, open, now_ms, &mut consequences).await?;
        // Without a change there is nothing to commit.
        if !consequences.deployments.is_empty() {
            write.commit().await?;
            self.changes.publish(consequences);
        }
        Ok(())
    }

    /// Ends assignments past their time limit, and removes old idempotency keys, tokens that have
    /// ended and robots that were never approved. To be called about once a minute. Returns the
    /// users of those tokens.
    pub async fn expire(&self) -> Result<BTreeSet<UserName>, ActionError> {
        let now_ms = self.clock.now_ms();
        let mut write = self.store.begin().await?;
        write.forget_orders(now_ms.saturating_sub(KEY_LIFETIME_MS)).await?;
        let users = write.forget_ended_tokens(now_ms).await?;
        let given_up = give_up_pending(&mut write, now_ms).await?;
        let overdue = write.overdue(now_ms).await?;
        let consequences =
            take_back(&mut write, &self.chooser, &overdue, Phase::Expired, now_ms).await?;
        write.commit().await?;
        self.changes.publish(consequences);
        given_up
            .into_iter()
            .for_each(|robot| self.changes.announce(Change::RobotRemoved(Box::new(robot))));
        Ok(users)
    }
}

/// A package that is ordered on robots.
pub(super) struct Placed<'a> {
    pub(super) package: &'a PackageRef,
    pub(super) kind: TaskKind,
    /// The order to place.
    pub(super) order: &'a CreateDeployment,
    pub(super) robots: &'a [RobotId],
    pub(super) expires_at_ms: u64,
}

impl Placed<'_> {
    /// Stores the deployment with its assignments, and advances all deployments that may go on now,
    /// including this one. Where the package runs already, nothing begins unless `restart` is set.
    pub(super) async fn place(
        &self,
        write: &mut Write,
        chooser: &Chooser,
        now_ms: u64,
        consequences: &mut Consequences,
    ) -> Result<DeploymentId, ActionError> {
        let &Self { package, kind, order, robots, expires_at_ms } = self;
        let id = DeploymentId::random();
        let new = NewDeployment { id: &id, package, kind, order, expires_at_ms };
        write.insert_deployment(&new, now_ms).await?;
        let mut touched = write.assign(&id, &package.name, robots, now_ms).await?;
        if !order.restart {
            write.settle_running(&id, now_ms).await?;
            for StillRunning { robot, failed, earlier } in
                write.settle_still_running(&id, &package.name, now_ms).await?
            {
                consequences.rings.insert(robot);
                consequences.deployments.extend([failed, earlier]);
            }
        }
        touched.insert(id.clone());
        consequences.deployments.extend(touched.iter().cloned());
        advance(write, chooser, touched, now_ms, consequences).await?;
        Ok(id)
    }
}

/// An order to create a deployment, in the form stored with its idempotency key.
fn creation(order: &CreateDeployment) -> String {
    format!("Create {}", serde_json::to_string(order).expect("an order always has a JSON form"))
}

async fn is_cancelled(write: &mut Write, id: &DeploymentId) -> Result<bool, ActionError> {
    write.is_cancelled(id).await?.ok_or_else(|| ActionError::DeploymentNotFound(id.clone()))
}

/// Whether all robots of a deployment are the person's.
async fn check_deployment(
    write: &mut Write,
    by: &Person,
    id: &DeploymentId,
) -> Result<(), ActionError> {
    if by.scope.is_everything() {
        return Ok(());
    }
    let robots = write.robots_of_deployment(id).await?;
    check_scope(by, &robots, || format!("deployment {id}"))
}

/// Ends `taken` in `phase`, restores the assignments that they replaced, and advances the rollouts
/// this touches.
async fn take_back(
    write: &mut Write,
    chooser: &Chooser,
    taken: &[Revocable],
    phase: Phase,
    now_ms: u64,
) -> Result<Consequences, ActionError> {
    let taken_back = write.take_back(taken, phase, now_ms).await?;
    let touched: BTreeSet<DeploymentId> = taken
        .iter()
        .flat_map(|row| row.previous.iter().chain([&row.deployment]))
        .cloned()
        .collect();
    let mut consequences = Consequences {
        robots: taken.iter().map(|row| row.robot.clone()).collect(),
        rings: taken_back.into_iter().collect(),
        deployments: touched.clone(),
        ..Consequences::default()
    };
    advance(write, chooser, touched, now_ms, &mut consequences).await?;
    Ok(consequences)
}
