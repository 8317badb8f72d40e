//! The watchers of live processes. Each process has two: one for its end and one for its health on
//! the ROS graph. Watchers only report to the driver; the plan decides.

use std::sync::Arc;
use std::time::Duration;

use task_proto::TaskName;
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;

use super::{Driver, Observation, ProcessWatch, WatcherEvent};
use crate::task::effects::Effects;
use crate::task::observed::{Health, ProcessState};
use crate::task::run::ActiveRun;

/// Delay before health is watched again after a watch has ended by itself.
const WATCH_AGAIN: Duration = Duration::from_secs(5);

impl<E: Effects> Driver<E> {
    /// Ensures that each live process is watched.
    pub(super) fn watch_processes(&mut self) {
        for (task, record) in &self.ledger.tasks {
            let Some(view) = self.views.get_mut(task) else { continue };
            let Some(active) = &record.active else { continue };
            let Some(process) = active.process() else { continue };
            let lives = matches!(view.process, Some(ProcessState::Alive { .. }));
            // A start that is under way still changes the record that its watcher is given.
            let starts = self.under_way.contains_key(&(task.clone(), crate::task::plan::Lane::Run));
            if !lives
                || starts
                || view
                    .process_watch
                    .as_ref()
                    .is_some_and(|process_watch| process_watch.dir == process.dir)
            {
                continue;
            }
            let until_dropped = CancellationToken::new();
            let watcher = Watcher {
                effects: self.effects.clone(),
                task: task.clone(),
                run: active.clone(),
                dir: process.dir.clone(),
                observation_sender: self.observation_sender.clone(),
            };
            view.process_watch = Some(ProcessWatch {
                dir: process.dir.clone(),
                _until_dropped: until_dropped.clone().drop_guard(),
            });
            tokio::spawn(async move {
                // Cancel-safe: an observation that was not sent is of no further use.
                tokio::select! {
                    () = watcher.watch_end() => {}
                    () = watcher.watch_health() => {}
                    () = until_dropped.cancelled() => return,
                }
                watcher.send(Observation::Over).await;
            });
        }
    }

    /// Takes a watcher's observation, unless the observed process has been replaced.
    pub(super) fn handle_observation(&mut self, event: WatcherEvent) {
        let Some(view) = self.views.get_mut(&event.task) else { return };
        if view.process_watch.as_ref().is_none_or(|process_watch| process_watch.dir != event.dir) {
            return;
        }
        match event.observation {
            Observation::Over => (view.process, view.process_watch) = (None, None),
            Observation::Health(health) => view.health = health,
        }
    }
}

/// The watchers of one process.
struct Watcher<E> {
    effects: Arc<E>,
    task: TaskName,
    run: ActiveRun,
    dir: String,
    observation_sender: mpsc::Sender<WatcherEvent>,
}

impl<E: Effects> Watcher<E> {
    async fn watch_end(&self) {
        if let Some(process) = self.run.process() {
            self.effects.process_ended(&self.task, process).await;
        }
    }

    /// Forwards health changes until the watch ends.
    async fn watch_health(&self) {
        let mut health = self.effects.watch(&self.task, &self.run);
        loop {
            let now = health.borrow_and_update().clone();
            self.send(Observation::Health(now)).await;
            if health.changed().await.is_err() {
                break;
            }
        }
        tracing::warn!(task = %self.task, "the ROS watch ended; it restarts soon");
        self.send(Observation::Health(Health::Unknown)).await;
        tokio::time::sleep(WATCH_AGAIN).await;
    }

    /// Sends an observation to the driver. The driver stops listening when the agent ends.
    async fn send(&self, observation: Observation) {
        let _ = self
            .observation_sender
            .send(WatcherEvent { task: self.task.clone(), dir: self.dir.clone(), observation })
            .await;
    }
}
