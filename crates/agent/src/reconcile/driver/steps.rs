//! The steps under way: how they begin, how unneeded steps are interrupted, and how their outcomes
//! change the ledger. The plan decides which step is next.

use std::time::Duration;

use task_proto::TaskName;
use task_proto::messages::report::{Failure, FailureCode, Progress};
use tokio::sync::{Notify, watch};
use tokio::task::Id;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use super::{Driver, RunningStep};
use crate::task::effects::Effects;
use crate::task::plan::{self, Done, Lane, Outcome, Step, StepFailure};
use crate::transfer::parts::PartRequest;

/// How long an interrupted step may take to end by itself.
const INTERRUPT_GRACE: Duration = Duration::from_secs(5);

impl<E: Effects> Driver<E> {
    pub(super) fn begin(&mut self, task: TaskName, step: Step) {
        tracing::info!("{}", plan::describe(&task, &step));
        let cancel = CancellationToken::new();
        let (progress, transfer) = watch::channel(Progress { done: 0, total: 0 });
        let (part_requests, requested_parts) = watch::channel(PartRequest::default());
        let view = self.views.entry(task.clone()).or_default();
        if matches!(step, Step::PullContent { .. } | Step::UploadOutputs(_)) {
            view.transfers.insert(step.lane(), transfer);
        }
        view.requested_parts = matches!(step, Step::PullContent { is_pushed: true, .. })
            .then(|| requested_parts.clone());
        let running = self
            .ledger
            .tasks
            .get(&task)
            .and_then(|record| record.active.as_ref()?.process().cloned());
        let effects = self.effects.clone();
        let lane = step.lane();
        let news = self.part_requests.clone();
        let name = task.clone();
        let doing = step.clone();
        let stop = cancel.clone();
        let handle = self.steps.spawn(async move {
            let done = |()| Done::Complete;
            let work = async {
                match &doing {
                    Step::CheckSigners(package) => effects.check_signers(package, &stop).await.map(done),
                    Step::PullManifest(package) => effects.pull_manifest(package, &stop).await,
                    Step::ProbeRos(_) => {
                        effects.probe_ros().await;
                        Ok(Done::Complete)
                    }
                    Step::PullContent { package, is_pushed: false } => {
                        effects.pull_content(package, &progress, &stop).await
                    }
                    Step::PullContent { package, is_pushed: true } => {
                        let gathering = effects.gather_content(package, &progress, &part_requests, &stop);
                        // Cancel-safe: the dropped future only notices changes.
                        tokio::select! {
                            done = gathering => done,
                            () = forward_part_requests(requested_parts, &news) => unreachable!("the forwarder never returns"),
                        }
                    }
                    Step::Build { package, deployment } => effects.build(package, deployment, &stop).await.map(done),
                    Step::QueryGate(question) => effects.query_gate(&name, question).await.map(done),
                    Step::Start(run) => effects.start(&name, run).await.map(Done::Started),
                    Step::Stop(run) => effects.stop(&name, run).await.map(done),
                    Step::UploadOutputs(files) => effects.upload_outputs(&name, files, &progress, &stop).await.map(done),
                    Step::Prune { kept } => effects.prune(&name, kept, running.as_ref()).await.map(done),
                    Step::Remove => effects.remove(&name).await.map(done),
                }
            };
            let outcome = match doing.deadline() {
                Some(deadline) => tokio::time::timeout(deadline, work).await.unwrap_or_else(|_| Err(deadline_failure(deadline))),
                None => work.await,
            };
            (name, lane, outcome)
        });
        self.under_way.insert((task, lane), RunningStep { step, handle, cancel, drop_at: None });
    }

    /// Cancels steps that are no longer needed, and drops those that do not end.
    pub(super) fn interrupt_unwanted(&mut self) {
        let now = Instant::now();
        let unwanted: Vec<(TaskName, Lane)> = self
            .under_way
            .iter()
            .filter(|((task, _), under_way)| {
                !under_way
                    .step
                    .is_wanted(self.desired_task(task).as_ref(), self.ledger.tasks.get(task))
            })
            .map(|(key, _)| key.clone())
            .collect();
        for key in unwanted {
            if let Some(under_way) =
                self.under_way.get_mut(&key).filter(|under_way| under_way.drop_at.is_none())
            {
                under_way.cancel.cancel();
                under_way.drop_at = Some(now + INTERRUPT_GRACE);
            }
        }
        for ((task, _), under_way) in &mut self.under_way {
            if under_way.drop_at.is_some_and(|at| at <= now) {
                tracing::warn!(
                    "{} did not stop when cancelled and was dropped",
                    plan::describe(task, &under_way.step)
                );
                under_way.handle.abort();
                under_way.drop_at = Some(now + INTERRUPT_GRACE);
            }
        }
    }

    pub(super) fn step_ended(
        &mut self,
        ended: Result<(Id, (TaskName, Lane, Outcome)), tokio::task::JoinError>,
    ) {
        let (id, outcome) = match ended {
            Ok((id, (_, _, outcome))) => (id, outcome),
            Err(error) => {
                let failure = Failure::new(
                    FailureCode::IO_ERROR,
                    format!("the step ended without a result: {error}"),
                );
                (error.id(), Err(StepFailure { failure, retry_after_ms: Some(1000) }))
            }
        };
        let found = self
            .under_way
            .iter()
            .find(|(_, under_way)| under_way.handle.id() == id)
            .map(|(key, _)| key.clone());
        let Some((task, lane)) = found else { return };
        let Some(under_way) = self.under_way.remove(&(task.clone(), lane)) else { return };
        let view = self.views.entry(task.clone()).or_default();
        if lane == Lane::Prepare {
            view.requested_parts = None;
        }
        let transfer = view.transfers.remove(&lane).map(|transfer| *transfer.borrow());
        match transfer.filter(|_| matches!(outcome, Ok(Done::RetryLater { .. }))) {
            // The gathered bytes stay, and their progress is shown while the robot waits for its
            // turn.
            Some(progress) if progress.total > 0 => view.progress.insert(lane, progress),
            _ => view.progress.remove(&lane),
        };
        if under_way.cancel.is_cancelled() {
            view.prepared = None;
            // The step may have gathered more after its order was withdrawn.
            self.kept_parts = None;
            return;
        }
        let failed = outcome
            .as_ref()
            .err()
            .map(|error| format!("{}: {}", plan::describe(&task, &under_way.step), error.failure));
        if let Some(text) = &failed {
            tracing::warn!("failed to {text}");
        }
        if matches!(under_way.step, Step::Stop(_) | Step::Prune { .. } | Step::Remove) {
            view.failed_step = failed;
        }
        self.finish(&task, &under_way.step, outcome);
    }

    fn finish(&mut self, task: &TaskName, step: &Step, outcome: Outcome) {
        if *step == Step::Remove && outcome.is_ok() {
            self.ledger.tasks.remove(task);
            self.views.remove(task);
            self.dirty = true;
            return;
        }
        if matches!(step, Step::ProbeRos(_)) {
            self.robot.installations =
                Some(self.effects.robot_facts().installations.unwrap_or_default());
        }
        let Some(record) = self.ledger.tasks.get(task) else { return };
        let kind = self.views.get(task).and_then(|view| view.prepared.as_ref()?.kind());
        let record = plan::finish_step(record, step, outcome, kind, &self.moment());
        let view = self.views.entry(task.clone()).or_default();
        match (step, &mut view.prepared) {
            // If the deletion failed, we do not retry before the next inspection of the disk.
            (Step::Prune { kept }, Some(prepared)) => {
                prepared.versions.retain(|version| kept.contains(version));
            }
            // A start deletes files that were changed on the disk.
            (Step::Start(_), _) => (view.prepared, view.process) = (None, None),
            (Step::Stop(_), _) => view.process = None,
            (step, _) if step.lane() == Lane::Prepare => view.prepared = None,
            _ => {}
        }
        self.store_record(task, record);
    }
}

/// Notifies `news` each time the gathering step asks for missing parts.
async fn forward_part_requests(mut requested_parts: watch::Receiver<PartRequest>, news: &Notify) {
    let mut times = requested_parts.borrow().times;
    while let Ok(part_requests) =
        requested_parts.wait_for(|part_requests| part_requests.times != times).await
    {
        times = part_requests.times;
        news.notify_one();
    }
    std::future::pending().await
}

/// The failure of a step that did not end in time. The step is retried, because its progress is
/// unknown.
fn deadline_failure(deadline: Duration) -> StepFailure {
    let text = format!("the step did not end within {} s", deadline.as_secs());
    StepFailure {
        failure: Failure::new(FailureCode::DEADLINE_EXCEEDED, text),
        retry_after_ms: Some(0),
    }
}
