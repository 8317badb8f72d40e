//! Watches runs on the ROS graph: looks, asks and measures what [`crate::ros::readiness`] wants to
//! know, and tells what came of it. Each watched run has one task, which ends with its receiver.
//! What running means is not decided here.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use task_proto::report::{Failure, FailureCode, RosFacts};
use task_proto::ros::{GraphName, LifecycleState, Transition};
use tokio::sync::watch;
use tokio::task::JoinSet;
use tokio::time::{Instant, timeout};
use tokio_util::sync::CancellationToken;

use crate::process::supervisor::Supervisor;
use crate::ros::graph::{Graph, GraphError, ParameterValue, RateMeter, Snapshot};
use crate::ros::graph_access::GraphAccess;
use crate::ros::readiness::{Answer, Ask, Look, Promise, Question, Readiness};
use crate::system::clock;
use crate::task::observed::{Health, Missing};

mod whose;

use whose::Whose;

/// How often a run is looked at that is not ready, were the graph silent.
const LOOK_STARTING: Duration = Duration::from_millis(250);
/// And one that is: to see that a process has gone without a word.
const LOOK_RUNNING: Duration = Duration::from_secs(1);
/// How long a node may take to answer a question that costs it nothing.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(2);
/// How long it may take to set parameters or make a transition before it is asked how far it came.
const WORK_TIMEOUT: Duration = Duration::from_secs(15);
/// How long the names of what was just stopped may take to leave the graph.
const LEAVE_TIMEOUT: Duration = Duration::from_secs(2);
/// When to ask again for a graph that could not be opened. How often it is tried is not decided
/// here.
const RETRY: Duration = Duration::from_secs(2);
/// A parameter that every node has.
const EVERYWHERE: &str = "use_sim_time";

/// A run to be watched.
#[derive(Debug, Clone, Default)]
pub struct Watched {
    /// Its run directory.
    pub dir: PathBuf,
    /// When its process was started, in milliseconds since boot.
    pub started_ms: u64,
    /// Whether it was ready once.
    pub was_ready: bool,
}

/// Watches the runs of this robot.
pub struct Watcher {
    access: GraphAccess,
    supervisor: Supervisor,
    /// What ends the watch of each run directory.
    watches: Arc<Mutex<HashMap<PathBuf, Arc<CancellationToken>>>>,
}

impl Watcher {
    /// Sees through `access`, and tells by `supervisor` whose a process is.
    pub fn new(access: GraphAccess, supervisor: Supervisor) -> Self {
        Self { access, supervisor, watches: Arc::default() }
    }

    /// Makes sure, before anything of a run is started, that its graph can be watched and that none
    /// of its names is taken.
    pub async fn before_start(
        &self,
        promise: &Promise,
        facts: Option<&RosFacts>,
    ) -> Result<(), Failure> {
        if promise.is_empty() {
            return Ok(());
        }
        let graph = self.access.settled(facts).await?;
        for node in promise.lifecycle.iter().chain(promise.parameters.keys()) {
            // A node that finds the agent's clients answers the sooner; that is all that is lost.
            if let Err(error) = graph.prepare(node).await {
                tracing::warn!(%node, %error, "the calls to a node can't be prepared");
            }
        }
        let mut changes = graph.changes();
        let deadline = Instant::now() + LEAVE_TIMEOUT;
        loop {
            let snapshot = changes.borrow_and_update().clone();
            let whose = Whose::look(snapshot.clone(), Vec::new(), &BTreeSet::new(), None).await;
            let Some(failure) = promise.taken(&snapshot, &whose.others) else { return Ok(()) };
            // What was stopped a moment ago may still be on its way out.
            let changed = tokio::time::timeout_at(deadline, changes.changed()).await;
            if !matches!(changed, Ok(Ok(()))) {
                let named = whose.naming_takers(promise, &snapshot).await;
                return Err(promise.taken(&snapshot, &named.others).unwrap_or(failure));
            }
        }
    }

    /// Watches a run until the receiver is dropped, or until [`Self::wind_down`].
    pub fn watch(
        &self,
        run: Watched,
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
        let (access, supervisor) = (self.access.clone(), self.supervisor.clone());
        tokio::spawn(async move {
            let watching = watch_run(run, promise, facts, &access, supervisor, &health);
            tokio::select! {
                () = watching => {}
                // Cancel-safe: both can be awaited again, and the watch changes nothing that it
                // would have to undo.
                () = health.closed() => {}
                () = over.cancelled() => health.closed().await,
            }
            // The same run may be watched anew by now.
            lock(&watches).retain(|_, known| !Arc::ptr_eq(known, &over));
        });
        seen
    }

    /// Ends the watch of a run and, within `time`, takes its lifecycle nodes down in good order.
    /// What fails is logged: the signals that follow end it anyway.
    pub async fn wind_down(
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
            let graph = self.access.settled(facts).await.map_err(|failure| failure.to_string())?;
            let pids = self.supervisor.pids(dir).await.map_err(|error| error.to_string())?;
            let snapshot = graph.snapshot();
            let whose = Whose::look(snapshot.clone(), pids, &BTreeSet::new(), None).await;
            let mut nodes = JoinSet::new();
            for name in &promise.lifecycle {
                if snapshot.named(name).any(|node| whose.ours.contains(&node.participant)) {
                    let (graph, name) = (graph.clone(), name.clone());
                    nodes.spawn(async move { take_down(&graph, &name, time).await });
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
    // A map of tokens is sound whatever a panic left.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Deactivates one node and shuts it down.
async fn take_down(graph: &Graph, node: &GraphName, time: Duration) {
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
                tracing::warn!(%node, transition = transition.as_str(), %error, "a node made no transition")
            }
        }
    }
}

async fn watch_run(
    run: Watched,
    promise: Promise,
    facts: Option<RosFacts>,
    access: &GraphAccess,
    supervisor: Supervisor,
    health: &watch::Sender<Health>,
) {
    let graph = loop {
        let failure = match access.settled(facts.as_ref()).await {
            Ok(graph) => break graph,
            Err(failure) => failure,
        };
        health.send_replace(Health::Missing(blind(failure)));
        tokio::time::sleep(RETRY).await;
    };
    let readiness = Readiness::new(promise.clone(), run.was_ready);
    let age = Duration::from_millis(clock::boot_ms().saturating_sub(run.started_ms));
    let eyes = Eyes {
        graph,
        supervisor,
        dir: run.dir,
        started: std::time::Instant::now().checked_sub(age),
        pids: Vec::new(),
        pids_at: None,
        whose: Whose::default(),
        topics: promise.topics,
        meters: BTreeMap::new(),
    };
    eyes.watch(readiness, health).await;
}

/// What it means for a run that the graph can't be seen.
fn blind(failure: Failure) -> Missing {
    let what = "the ROS graph could not be watched".to_owned();
    let (since_ms, code) = (clock::boot_ms(), FailureCode::GRAPH_UNAVAILABLE);
    Missing { since_ms, code, what, seen: failure.text, is_its_own: false }
}

/// What one run is seen with.
struct Eyes {
    graph: Graph,
    supervisor: Supervisor,
    dir: PathBuf,
    /// When its process was started; `None`: before this machine's clock began.
    started: Option<std::time::Instant>,
    pids: Vec<u32>,
    pids_at: Option<Instant>,
    whose: Whose,
    topics: BTreeMap<GraphName, Option<f64>>,
    meters: BTreeMap<GraphName, RateMeter>,
}

/// How old the list of a run's processes may be.
const PIDS_AGE: Duration = Duration::from_secs(10);

impl Eyes {
    async fn watch(mut self, mut readiness: Readiness, health: &watch::Sender<Health>) {
        let mut changes = self.graph.changes();
        let mut asking = JoinSet::new();
        loop {
            let snapshot = changes.borrow_and_update().clone();
            self.see(&snapshot, &mut readiness).await;
            let seen = readiness.health().clone();
            health.send_if_modified(|known| {
                let news = *known != seen;
                known.clone_from(&seen);
                news
            });
            for question in readiness.questions(clock::boot_ms()) {
                let graph = self.graph.clone();
                asking.spawn(async move {
                    let answer = ask(&graph, &question).await;
                    (question, answer)
                });
            }
            let holds = matches!(seen, Health::Holds { .. });
            let look_again = if holds { LOOK_RUNNING } else { LOOK_STARTING };
            tokio::select! {
                // Cancel-safe: what has been answered stays in the set until it is taken.
                Some(answered) = asking.join_next() => {
                    if let Ok((question, answer)) = answered {
                        readiness.answered(&question, answer, clock::boot_ms());
                    }
                }
                // Cancel-safe: a change is only marked as seen when the snapshot is taken.
                changed = changes.changed() => {
                    if changed.is_err() {
                        let failure = Failure::new(FailureCode::GRAPH_UNAVAILABLE, GraphError::Closed.to_string());
                        health.send_replace(Health::Missing(blind(failure)));
                        return;
                    }
                }
                // Cancel-safe: a timer that is made anew each time.
                () = tokio::time::sleep(look_again) => {}
            }
        }
    }

    async fn see(&mut self, snapshot: &Arc<Snapshot>, readiness: &mut Readiness) {
        let strangers = snapshot.participants.keys().any(|id| !self.whose.knows(id));
        if strangers || self.pids_at.is_none_or(|at| at.elapsed() >= PIDS_AGE) {
            match self.supervisor.pids(&self.dir).await {
                Ok(pids) => (self.pids, self.pids_at) = (pids, Some(Instant::now())),
                Err(error) => tracing::warn!(%error, "cannot tell which processes a run has"),
            }
        }
        let ours = std::mem::take(&mut self.whose).ever_ours;
        let whose = Whose::look(snapshot.clone(), self.pids.clone(), &ours, self.started).await;
        self.whose = whose.naming_takers(readiness.promise(), snapshot).await;
        self.meter(snapshot);
        let counts = self
            .meters
            .iter()
            .map(|(topic, meter)| (topic.clone(), meter.rate().samples))
            .collect();
        let Whose { ours, others, gone, .. } = &self.whose;
        readiness.see(&Look { snapshot, ours, others, gone, counts: &counts }, clock::boot_ms());
    }

    /// Counts the messages of topics with a least rate, once their type is known.
    fn meter(&mut self, snapshot: &Snapshot) {
        for (topic, _) in self.topics.iter().filter(|(_, min_hz)| min_hz.is_some()) {
            if self.meters.contains_key(topic) {
                continue;
            }
            let mut publishers = snapshot.publishers_of(topic);
            let Some(node) = publishers.find(|node| self.whose.ours.contains(&node.participant))
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

async fn ask(graph: &Graph, question: &Question) -> Answer {
    let node = &question.node;
    let answer = match &question.ask {
        Ask::Anything => {
            graph.parameter(node, EVERYWHERE, ANSWER_TIMEOUT).await.map(|_| Answer::Something)
        }
        Ask::State => graph.lifecycle_state(node, ANSWER_TIMEOUT).await.map(Answer::State),
        Ask::Transition(transition) => {
            tracing::info!(%node, transition = transition.as_str(), "asks for a lifecycle transition");
            graph.change_state(node, *transition, WORK_TIMEOUT).await.map(Answer::Transition)
        }
        Ask::Set(parameters) => set(graph, node, parameters).await.map(Answer::Set),
    };
    answer.unwrap_or_else(|error| {
        tracing::debug!(%node, %error, "no answer");
        Answer::None
    })
}

/// Sets parameters, each in the type that the node has given it.
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
            None => Err("no ROS parameter can have this value".to_owned()),
        });
    }
    Ok(results)
}
