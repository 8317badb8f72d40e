//! The steps under way: how they begin, how unneeded steps are interrupted, and how their outcomes
//! change the ledger. The plan decides which step is next.

use std::time::Duration;

use task_proto::TaskName;
use task_proto::report::{Failure, FailureCode, Progress};
use tokio::sync::{Notify, watch};
use tokio::task::Id;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use super::{Driver, Outcome, UnderWay};
use crate::task::effects::Effects;
use crate::task::plan::{self, Done, Lane, Step, StepFailure};
use crate::transfer::parts::Asks;

/// How long an interrupted step may take to end by itself.
const INTERRUPT_GRACE: Duration = Duration::from_secs(5);

impl<E: Effects> Driver<E> {
    pub(super) fn begin(&mut self, task: TaskName, step: Step) {
        tracing::info!("{}", plan::describe(&task, &step));
        let cancel = CancellationToken::new();
        let (progress, transfer) = watch::channel(Progress { done: 0, total: 0 });
        let (asks, asked) = watch::channel(Asks::default());
        let view = self.views.entry(task.clone()).or_default();
        if matches!(step, Step::PullContent { .. } | Step::Collect(_)) {
            view.transfers.insert(step.lane(), transfer);
        }
        view.asked =
            matches!(step, Step::PullContent { is_pushed: true, .. }).then(|| asked.clone());
        let running =
            self.ledger.tasks.get(&task).and_then(|record| record.active.as_ref()?.process.clone());
        let (effects, lane, news) = (self.effects.clone(), step.lane(), self.asks.clone());
        let (name, doing, stop) = (task.clone(), step.clone(), cancel.clone());
        let handle = self.steps.spawn(async move {
            let done = |()| Done::Well;
            let work = async {
                match &doing {
                    Step::CheckSigners(package) => effects.check_signers(package, &stop).await.map(done),
                    Step::PullManifest(package) => effects.pull_manifest(package, &stop).await,
                    Step::LookForRos(_) => {
                        effects.look_for_ros().await;
                        Ok(Done::Well)
                    }
                    Step::PullContent { package, is_pushed: false } => {
                        effects.pull_content(package, &progress, &stop).await
                    }
                    Step::PullContent { package, is_pushed: true } => {
                        let gathering = effects.gather_content(package, &progress, &asks, &stop);
                        // Cancel-safe: the dropped future only notices changes.
                        tokio::select! {
                            done = gathering => done,
                            () = notify(asked, &news) => unreachable!("it lasts as long as who asks"),
                        }
                    }
                    Step::Build(package) => effects.build(package, &stop).await.map(done),
                    Step::Ask(question) => effects.ask_gate(&name, question).await.map(done),
                    Step::Start(run) => effects.start(&name, run).await.map(Done::Started),
                    Step::Stop(run) => effects.stop(&name, run).await.map(done),
                    Step::Collect(files) => effects.collect(&name, files, &progress, &stop).await.map(done),
                    Step::Prune { kept } => effects.prune(&name, kept, running.as_ref()).await.map(done),
                    Step::Remove => effects.remove(&name).await.map(done),
                }
            };
            let outcome = match doing.deadline() {
                Some(deadline) => tokio::time::timeout(deadline, work).await.unwrap_or_else(|_| Err(late(deadline))),
                None => work.await,
            };
            (name, lane, outcome)
        });
        self.under_way.insert((task, lane), UnderWay { step, handle, cancel, drop_at: None });
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
                    "{} does not end and is dropped",
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
            view.asked = None;
        }
        let transfer = view.transfers.remove(&lane).map(|transfer| *transfer.borrow());
        match transfer.filter(|_| matches!(outcome, Ok(Done::ToldToWait { .. }))) {
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
            view.undone = failed;
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
        if matches!(step, Step::LookForRos(_)) {
            self.robot.installations =
                Some(self.effects.robot_facts().installations.unwrap_or_default());
        }
        let Some(view) = self.views.get(task) else { return };
        let Some(situation) = self.situation(task, view, None, &[]) else { return };
        let record = plan::finished(&situation, step, outcome);
        if let (Step::Prune { kept }, Some(prepared)) =
            (step, &mut self.views.entry(task.clone()).or_default().prepared)
        {
            // If the deletion failed, we do not retry before the next inspection of the disk.
            prepared.versions.retain(|version| kept.contains(version));
        } else if step.lane() == Lane::Prepare || matches!(step, Step::Start(_)) {
            // A start deletes files that were changed on the disk.
            self.views.entry(task.clone()).or_default().prepared = None;
        }
        if matches!(step, Step::Start(_) | Step::Stop(_)) {
            self.views.entry(task.clone()).or_default().process = None;
        }
        self.put(task, record);
    }
}

/// Notifies `news` each time the gathering step asks for missing parts.
async fn notify(mut asked: watch::Receiver<Asks>, news: &Notify) {
    let mut times = asked.borrow().times;
    while let Ok(asks) = asked.wait_for(|asks| asks.times != times).await {
        times = asks.times;
        news.notify_one();
    }
    std::future::pending().await
}

/// The failure of a step that did not end in time. The step is retried, because its progress is
/// unknown.
fn late(deadline: Duration) -> StepFailure {
    let text = format!("the step did not end within {} s", deadline.as_secs());
    StepFailure {
        failure: Failure::new(FailureCode::DEADLINE_EXCEEDED, text),
        retry_after_ms: Some(0),
    }
}
