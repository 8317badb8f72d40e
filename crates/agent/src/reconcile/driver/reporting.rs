//! The driver's report: a snapshot of the ledger in wire types, published when its content changes.

use std::sync::Arc;

use task_proto::TaskName;
use task_proto::messages::report::{
    ActiveVersion, Condition, Failure, FailureCode, Phase, Report, TaskReport,
};
use task_proto::time::millis;
use tokio::time::Instant;

use super::messages::REFUSALS;
use super::{Driver, View};
use crate::reconcile::admission;
use crate::system::clock;
use crate::task::effects::Effects;
use crate::task::ledger::{LostFiles, TaskRecord};
use crate::task::observed::{Health, ProcessState, SignatureVerdict};
use crate::task::plan::Lane;
use crate::task::run::ActiveRun;
use crate::transfer::link_meter;

/// Battery changes within one step of this size are not reported.
const BATTERY_STEP_PERCENT: u8 = 5;

impl<E: Effects> Driver<E> {
    /// Publishes a snapshot if its content differs from the last one.
    pub(super) fn publish_report(&mut self) {
        let report = self.report();
        let again = std::mem::take(&mut self.report_parts_again);
        let news = self
            .link_state
            .reports
            .borrow()
            .as_ref()
            .is_none_or(|last| !has_same_content(last, &report));
        if news || again {
            self.seq = report.seq;
            self.link_state.reports.send_replace(Some(Arc::new(report)));
        }
        let settled = self.is_settled();
        self.link_state
            .settled
            .send_if_modified(|last| std::mem::replace(last, settled) != settled);
    }

    fn report(&self) -> Report {
        let now_ms = self.effects.now().boot_ms;
        let tasks = self.ledger.tasks.iter();
        Report {
            robot_id: self.agent_identity.robot_id.clone(),
            start: self.ledger.start,
            instance: self.agent_identity.instance.clone(),
            place: self.agent_identity.place,
            boot_id: self.agent_identity.boot_id.clone(),
            seq: self.seq + 1,
            observed_generation: self.observed,
            uptime_ms: millis(self.started.elapsed()),
            host: self.effects.host_facts(),
            conditions: self.all_conditions(),
            link: self.link_state.meter.facts(Instant::now()),
            tasks: tasks
                .map(|(task, record)| task_report(task, record, self.views.get(task), now_ms))
                .collect(),
        }
    }

    fn all_conditions(&self) -> Vec<Condition> {
        let condition =
            |code: &str, text: &str| Condition { code: code.to_owned(), text: text.to_owned() };
        let mut conditions: Vec<Condition> =
            self.conditions.iter().map(|(code, text)| condition(code, text)).collect();
        if self.held {
            conditions.push(condition(
                "held",
                "no task is started or switched until a person at the robot releases it",
            ));
        }
        conditions.extend(self.ledger.removal_message().map(|text| condition("removed", &text)));
        if let Some(text) = &self.robot.no_task_user {
            conditions.push(condition(FailureCode::NO_TASK_USER.as_str(), text));
        }
        let wall_ms = self.effects.now().wall_ms;
        if self.desired.as_ref().is_some_and(|state| admission::is_expired(state, wall_ms)) {
            conditions.push(condition(
                "state_expired",
                "the desired state has expired: no new work is started",
            ));
        }
        if wall_ms < clock::PROGRAM_EXISTS_SINCE_MS {
            let text = format!(
                "this robot's clock is wrong: it shows {}, when this agent did not exist yet",
                &task_proto::time::timestamp(wall_ms)[..10]
            );
            conditions.push(condition("clock_wrong", &text));
        }
        if let Some(text) = &self.trust.refused_list {
            conditions.push(condition("publishers_refused", text));
        }
        let failed_steps: Vec<&str> =
            self.views.values().filter_map(|view| view.failed_step.as_deref()).collect();
        if !failed_steps.is_empty() {
            conditions.push(condition("step_failed", &failed_steps.join("; ")));
        }
        conditions.extend(self.state_unavailable.clone());
        conditions
    }

    /// Whether the server may skip sending the state again. The answer is no after half of the
    /// state's lifetime, so that the server sends the state newly signed, and no while the robot
    /// refuses a state.
    fn is_settled(&self) -> bool {
        let Some(state) = &self.desired else { return false };
        let half_ms =
            state.issued_at_ms + state.expires_at_ms.saturating_sub(state.issued_at_ms) / 2;
        let refused = REFUSALS.iter().any(|code| self.conditions.contains_key(code));
        !refused && self.effects.now().wall_ms < half_ms
    }
}

/// Whether two snapshots differ only in fields that always change.
fn has_same_content(last: &Report, next: &Report) -> bool {
    let without_times = |report: &Report| {
        let mut report = report.clone();
        (report.seq, report.uptime_ms, report.host.disk_free_bytes) = (0, 0, 0);
        (report.host.battery_percent, report.link) = (None, None);
        report.tasks.iter_mut().for_each(|task| task.phase_ms = 0);
        report
    };
    let battery =
        |report: &Report| report.host.battery_percent.map(|percent| percent / BATTERY_STEP_PERCENT);
    without_times(last) == without_times(next)
        && battery(last) == battery(next)
        && !link_meter::is_news(last.link.as_ref(), next.link.as_ref())
}

/// Why the active run is degraded: something that was there is missing, an older run than ordered
/// waits for its files or may not start again, or the run's output files cannot be uploaded.
fn degraded(record: &TaskRecord, view: Option<&View>) -> Option<Failure> {
    let ready = record.active.as_ref().is_some_and(ActiveRun::is_ready);
    match view.map(|view| &view.health) {
        Some(Health::Missing(missing)) if ready => Some(missing.failure()),
        _ => {
            let refusal = record.refusal().filter(|(question, _)| !record.concerns_order(question));
            let of_order = |lost: &&LostFiles| {
                lost.deployment == record.order.deployment && lost.run == record.order.run
            };
            let files = record.collections.iter().find_map(|files| files.failure.as_ref());
            let lost = record.lost.as_ref().filter(of_order).map(|lost| &lost.failure);
            let distrusted = distrusted(record, view).filter(|_| ready);
            let other = refusal.map(|(_, why)| why).or(files).or(lost).cloned();
            distrusted.or_else(|| lacking_files(record)).or(other)
        }
    }
}

/// Reports that an older run than ordered waits for its files.
fn lacking_files(record: &TaskRecord) -> Option<Failure> {
    let anew = record.restoring.as_ref()?;
    let text = "its files are fetched and built again";
    let changed = || Failure::new(FailureCode::TREE_CHANGED, text);
    Some(anew.failure.clone().unwrap_or_else(changed))
}

/// Reports that the running version would not be started again.
fn distrusted(record: &TaskRecord, view: Option<&View>) -> Option<Failure> {
    let prepared = record.to_prepare().0;
    let active = record.active.as_ref().filter(|active| active.package == *prepared)?;
    let signatures = view?.prepared.as_ref()?.signatures;
    let text = format!(
        "{} {} no longer has enough signatures of trusted publishers: it keeps running, but will not be started again",
        active.package.name, active.package.version
    );
    (signatures == SignatureVerdict::Insufficient)
        .then(|| Failure::new(FailureCode::UNTRUSTED_PACKAGE, text))
}

fn task_report(
    task: &TaskName,
    record: &TaskRecord,
    view: Option<&View>,
    now_ms: u64,
) -> TaskReport {
    let (phase, failure) = record.order_phase();
    let lane = match phase {
        Phase::Fetching => Some(Lane::Prepare),
        Phase::Running => Some(Lane::Upload),
        _ => None,
    };
    let progress = lane.and_then(|lane| view?.progress.get(&lane).copied());
    // All bytes are there: the rest of the pull is unpacking.
    let unpacking = phase == Phase::Fetching
        && progress.is_some_and(|progress| progress.done >= progress.total);
    let active = record.active.as_ref();
    let for_order = active.filter(|active| active.is_for(&record.order));
    TaskReport {
        task: task.clone(),
        deployment: record.order.deployment.clone(),
        package: record.order.package.clone(),
        wanted: record.order.wanted,
        run: record.order.run,
        kind: for_order.map(|active| active.rules.kind).or(record.preparation.kind),
        phase: if unpacking { Phase::Unpacking } else { phase },
        phase_ms: now_ms.saturating_sub(record.phase_since_ms),
        progress: progress.filter(|_| !unpacking),
        missing_parts: view
            .and_then(|view| view.requested_parts.as_ref()?.borrow().missing.clone()),
        attempts: record.preparation.attempts,
        restarts: for_order.map_or(0, ActiveRun::restarts),
        failure: failure.cloned(),
        degraded: degraded(record, view),
        active: active.and_then(|active| {
            let process = active.process()?;
            let pid = match view.and_then(|view| view.process.as_ref()) {
                Some(ProcessState::Alive { pid }) => Some(*pid),
                _ => process.pid,
            };
            Some(ActiveVersion {
                deployment: active.deployment.clone(),
                version: active.package.version.clone(),
                manifest: Some(active.package.manifest.digest),
                pid: pid?,
            })
        }),
    }
}
