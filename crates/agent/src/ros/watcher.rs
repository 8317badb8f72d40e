//! Watches runs on the ROS graph: observes, asks and measures everything that
//! [`crate::ros::readiness`] needs, and reports the results. Each watched run has one tokio task,
//! which ends with its receiver. This module does not decide when a run counts as running.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use task_proto::messages::report::{Failure, FailureCode, RosFacts};
use task_proto::telemetry::ros::{GraphName, LifecycleState, Transition};
use tokio::sync::watch;
use tokio::task::JoinSet;
use tokio::time::{Instant, timeout};
use tokio_util::sync::CancellationToken;

use crate::process::supervisor::Supervisor;
use crate::ros::graph::{Graph, GraphError, ParameterValue, RateMeter, Snapshot};
use crate::ros::graph_access::GraphAccess;
use crate::ros::readiness::{Answer, NodeRequest, Observation, Promise, Readiness, RequestKind};
use crate::system::clock;
use crate::task::observed::{Health, Missing};

mod ownership;

use ownership::Ownership;

/// Interval between looks at a run that is not ready, when the graph reports no change.
const POLL_STARTING: Duration = Duration::from_millis(250);
/// Interval between looks at a run that is ready: this detects a process that ended without notice.
const POLL_RUNNING: Duration = Duration::from_secs(1);
/// Maximum time for a node to answer a cheap question.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(2);
/// Maximum time for a node to set parameters or make a transition, before its state is queried.
const WORK_TIMEOUT: Duration = Duration::from_secs(15);
/// Maximum time for the names of a stopped run to leave the graph.
const LEAVE_TIMEOUT: Duration = Duration::from_secs(2);
/// Pause before the next request for a graph that could not be opened. [`GraphAccess`] decides how
/// often opening is attempted.
const RETRY: Duration = Duration::from_secs(2);
/// A parameter that every node has.
const COMMON_PARAMETER: &str = "use_sim_time";

/// A run to be watched.
#[derive(Debug, Clone, Default)]
pub struct WatchedRun {
    pub dir: PathBuf,
    /// Start time of the run's process, in milliseconds since boot.
    pub started_ms: u64,
    /// Whether the run was ready once.
    pub was_ready: bool,
}

/// Watches the runs of this robot.
pub struct Watcher {
    access: GraphAccess,
    supervisor: Supervisor,
    /// The cancellation token for the watch of each run directory.
    watches: Arc<Mutex<HashMap<PathBuf, Arc<CancellationToken>>>>,
}

impl Watcher {
    /// Observes the graph through `access` and finds the owner of a process through `supervisor`.
    pub fn new(access: GraphAccess, supervisor: Supervisor) -> Self {
        Self { access, supervisor, watches: Arc::default() }
    }

    /// Checks, before any process of a run is started, that the graph can be watched and that none
    /// of the run's names is taken.
    pub async fn before_start(
        &self,
        promise: &Promise,
        facts: Option<&RosFacts>,
    ) -> Result<(), Failure> {
        if promise.is_empty() {
            return Ok(());
        }
        let graph = self.access.open_after_discovery(facts).await?;
        for node in promise.lifecycle.iter().chain(promise.parameters.keys()) {
            // A node that finds the agent's clients answers sooner; a failure costs only that.
            if let Err(error) = graph.prepare(node).await {
                tracing::warn!(%node, %error, "the calls to a node can't be prepared");
            }
        }
        let mut changes = graph.changes();
        let deadline = Instant::now() + LEAVE_TIMEOUT;
        loop {
            let snapshot = changes.borrow_and_update().clone();
            let ownership =
                Ownership::determine(snapshot.clone(), Vec::new(), &BTreeSet::new(), None).await;
            let Some(failure) = promise.name_conflict(&snapshot, &ownership.others) else {
                return Ok(());
            };
            // Nodes of a run that was just stopped may still be leaving.
            let changed = tokio::time::timeout_at(deadline, changes.changed()).await;
            if !matches!(changed, Ok(Ok(()))) {
                let named = ownership.with_process_names(promise, &snapshot).await;
                return Err(promise.name_conflict(&snapshot, &named.others).unwrap_or(failure));
            }
        }
    }

    /// Watches a run until the receiver is dropped, or until [`Self::shut_down_nodes`].
    pub fn watch(
        &self,
        run: WatchedRun,
        promise: Promise,
        facts: Option<RosFacts>,
    ) -> watch::Receiver<Health> {
        if promise.is_empty() {
            let (health, seen) = watch::channel(Health::Holds { since_ms: run.started_ms });
            tokio::spawn(async move { health.closed().await });
            return seen;
        }
        let (health, seen) = watch::channel(Health::Unknown);
        let over = Arc::new(CancellationToken::new());
        let watches = self.watches.clone();
        lock(&watches).insert(run.dir.clone(), over.clone());
        let access = self.access.clone();
        let supervisor = self.supervisor.clone();
        tokio::spawn(async move {
            let watching = watch_run(run, promise, facts, &access, supervisor, &health);
            tokio::select! {
                () = watching => {}
                // Cancel-safe: both can be awaited again, and the watch makes no change that would
                // need to be undone.
                () = health.closed() => {}
                () = over.cancelled() => health.closed().await,
            }
            // The same run may have a new watch by now.
            lock(&watches).retain(|_, known| !Arc::ptr_eq(known, &over));
        });
        seen
    }

    /// Ends the watch of a run and, within `time`, shuts its lifecycle nodes down cleanly. Failures
    /// are logged: the signals that follow end the nodes anyway.
    pub async fn shut_down_nodes(
        &self,
        dir: &Path,
        promise: &Promise,
        facts: Option<&RosFacts>,
        time: Duration,
    ) {
        if let Some(over) = lock(&self.watches).remove(dir) {
            over.cancel();
        }
        if promise.lifecycle.is_empty() {
            return;
        }
        let winding_down = async {
            let graph = self
                .access
                .open_after_discovery(facts)
                .await
                .map_err(|failure| failure.to_string())?;
            let pids = self.supervisor.pids(dir).await.map_err(|error| error.to_string())?;
            let snapshot = graph.snapshot();
            let ownership =
                Ownership::determine(snapshot.clone(), pids, &BTreeSet::new(), None).await;
            let mut nodes = JoinSet::new();
            for name in &promise.lifecycle {
                if snapshot.named(name).any(|node| ownership.ours.contains(&node.participant)) {
                    let graph = graph.clone();
                    let name = name.clone();
                    nodes.spawn(async move { shut_down_node(&graph, &name, time).await });
                }
            }
            nodes.join_all().await;
            Ok::<_, String>(())
        };
        match timeout(time, winding_down).await {
            Ok(Ok(())) => {}
            Ok(Err(reason)) => {
                tracing::warn!(%reason, "lifecycle nodes are stopped without being shut down")
            }
            Err(_) => {
                tracing::warn!(?time, "lifecycle nodes are stopped before they were shut down")
            }
        }
    }
}

fn lock<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    // A map of tokens stays valid after a panic.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Deactivates one node and shuts it down.
async fn shut_down_node(graph: &Graph, node: &GraphName, time: Duration) {
    let state = graph.lifecycle_state(node, ANSWER_TIMEOUT.min(time)).await;
    let active = matches!(state, Ok(LifecycleState::Active));
    let steps = [active.then_some(Transition::Deactivate), Some(Transition::Shutdown)];
    for transition in steps.into_iter().flatten() {
        match graph.change_state(node, transition, WORK_TIMEOUT.min(time)).await {
            Ok(true) => {}
            Ok(false) => {
                tracing::warn!(%node, transition = transition.as_str(), "a node refused a transition")
            }
            Err(error) => {
                tracing::warn!(%node, transition = transition.as_str(), %error, "a lifecycle transition failed")
            }
        }
    }
}

async fn watch_run(
    run: WatchedRun,
    promise: Promise,
    facts: Option<RosFacts>,
    access: &GraphAccess,
    supervisor: Supervisor,
    health: &watch::Sender<Health>,
) {
    let graph = loop {
        let failure = match access.open_after_discovery(facts.as_ref()).await {
            Ok(graph) => break graph,
            Err(failure) => failure,
        };
        health.send_replace(Health::Missing(graph_unavailable(failure)));
        tokio::time::sleep(RETRY).await;
    };
    let readiness = Readiness::new(promise.clone(), run.was_ready);
    let age = Duration::from_millis(clock::boot_ms().saturating_sub(run.started_ms));
    let observer = RunObserver {
        graph,
        supervisor,
        dir: run.dir,
        started: std::time::Instant::now().checked_sub(age),
        pids: Vec::new(),
        pids_at: None,
        ownership: Ownership::default(),
        topics: promise.topics,
        meters: BTreeMap::new(),
    };
    observer.watch(readiness, health).await;
}

/// The consequence for a run when the graph can't be observed.
fn graph_unavailable(failure: Failure) -> Missing {
    let what = "the ROS graph could not be watched".to_owned();
    let since_ms = clock::boot_ms();
    let code = FailureCode::GRAPH_UNAVAILABLE;
    Missing { since_ms, code, what, seen: failure.text, is_own_fault: false }
}

/// The data for observing one run.
struct RunObserver {
    graph: Graph,
    supervisor: Supervisor,
    dir: PathBuf,
    /// Start time of the run's process; `None`: before this machine's clock began.
    started: Option<std::time::Instant>,
    pids: Vec<u32>,
    pids_at: Option<Instant>,
    ownership: Ownership,
    topics: BTreeMap<GraphName, Option<f64>>,
    meters: BTreeMap<GraphName, RateMeter>,
}

/// Maximum age of the list of a run's processes.
const PIDS_AGE: Duration = Duration::from_secs(10);

impl RunObserver {
    async fn watch(mut self, mut readiness: Readiness, health: &watch::Sender<Health>) {
        let mut changes = self.graph.changes();
        let mut pending = JoinSet::new();
        loop {
            let snapshot = changes.borrow_and_update().clone();
            self.observe(&snapshot, &mut readiness).await;
            let seen = readiness.health().clone();
            health.send_if_modified(|known| {
                let news = *known != seen;
                known.clone_from(&seen);
                news
            });
            for request in readiness.requests(clock::boot_ms()) {
                let graph = self.graph.clone();
                pending.spawn(async move {
                    let answer = send_request(&graph, &request).await;
                    (request, answer)
                });
            }
            let holds = matches!(seen, Health::Holds { .. });
            let poll_interval = if holds { POLL_RUNNING } else { POLL_STARTING };
            tokio::select! {
                // Cancel-safe: an answer stays in the set until it is taken.
                Some(answered) = pending.join_next() => {
                    if let Ok((request, answer)) = answered {
                        readiness.record_answer(&request, answer, clock::boot_ms());
                    }
                }
                // Cancel-safe: a change is only marked as seen when the snapshot is taken.
                changed = changes.changed() => {
                    if changed.is_err() {
                        let failure = Failure::new(FailureCode::GRAPH_UNAVAILABLE, GraphError::Closed.to_string());
                        health.send_replace(Health::Missing(graph_unavailable(failure)));
                        return;
                    }
                }
                // Cancel-safe: a timer that is made anew each time.
                () = tokio::time::sleep(poll_interval) => {}
            }
        }
    }

    async fn observe(&mut self, snapshot: &Arc<Snapshot>, readiness: &mut Readiness) {
        let has_unknown = snapshot.participants.keys().any(|id| !self.ownership.knows(id));
        if has_unknown || self.pids_at.is_none_or(|at| at.elapsed() >= PIDS_AGE) {
            match self.supervisor.pids(&self.dir).await {
                Ok(pids) => (self.pids, self.pids_at) = (pids, Some(Instant::now())),
                Err(error) => tracing::warn!(%error, "cannot list the processes of a run"),
            }
        }
        let ours = std::mem::take(&mut self.ownership).ever_ours;
        let ownership =
            Ownership::determine(snapshot.clone(), self.pids.clone(), &ours, self.started).await;
        self.ownership = ownership.with_process_names(readiness.promise(), snapshot).await;
        self.count_messages(snapshot);
        let counts = self
            .meters
            .iter()
            .map(|(topic, meter)| (topic.clone(), meter.rate().samples))
            .collect();
        let Ownership { ours, others, gone, .. } = &self.ownership;
        readiness.observe(
            &Observation { snapshot, ours, others, gone, counts: &counts },
            clock::boot_ms(),
        );
    }

    /// Counts the messages of topics with a minimum rate, once their type is known.
    fn count_messages(&mut self, snapshot: &Snapshot) {
        for (topic, _) in self.topics.iter().filter(|(_, min_hz)| min_hz.is_some()) {
            if self.meters.contains_key(topic) {
                continue;
            }
            let mut publishers = snapshot.publishers_of(topic);
            let Some(node) =
                publishers.find(|node| self.ownership.ours.contains(&node.participant))
            else {
                continue;
            };
            let Some(published) = node.publishers.iter().find(|published| published.name == *topic)
            else {
                continue;
            };
            match self.graph.rate(topic, &published.kind) {
                Ok(meter) => drop(self.meters.insert(topic.clone(), meter)),
                Err(error) => {
                    tracing::warn!(%topic, %error, "the messages of a topic can't be counted")
                }
            }
        }
    }
}

async fn send_request(graph: &Graph, request: &NodeRequest) -> Answer {
    let node = &request.node;
    let answer = match &request.kind {
        RequestKind::Ping => {
            graph.parameter(node, COMMON_PARAMETER, ANSWER_TIMEOUT).await.map(|_| Answer::Pong)
        }
        RequestKind::State => graph.lifecycle_state(node, ANSWER_TIMEOUT).await.map(Answer::State),
        RequestKind::Transition(transition) => {
            tracing::info!(%node, transition = transition.as_str(), "requesting a lifecycle transition");
            graph.change_state(node, *transition, WORK_TIMEOUT).await.map(Answer::Transition)
        }
        RequestKind::Set(parameters) => set(graph, node, parameters).await.map(Answer::Set),
    };
    answer.unwrap_or_else(|error| {
        tracing::debug!(%node, %error, "no answer");
        Answer::None
    })
}

/// Sets parameters, each in the type that the node has declared.
async fn set(
    graph: &Graph,
    node: &GraphName,
    parameters: &[(String, serde_json::Value)],
) -> Result<Vec<Result<(), String>>, GraphError> {
    let current: BTreeMap<_, _> =
        graph.parameters(node, ANSWER_TIMEOUT).await?.into_iter().collect();
    let mut results: Vec<Result<(), String>> = Vec::new();
    let mut asked = Vec::new();
    for (name, value) in parameters {
        match (ParameterValue::from_json(value), current.get(name)) {
            (Some(value), Some(current)) => asked.push((name.clone(), value.fitting(current))),
            (Some(value), None) => asked.push((name.clone(), value)),
            (None, _) => {}
        }
    }
    let mut answers = graph.set_parameters(node, asked, WORK_TIMEOUT).await?.into_iter().peekable();
    for (name, _) in parameters {
        results.push(match answers.next_if(|answer| answer.name == *name) {
            Some(answer) if answer.successful => Ok(()),
            Some(answer) => Err(answer.reason),
            None => Err("not a value of a ROS parameter".to_owned()),
        });
    }
    Ok(results)
}
