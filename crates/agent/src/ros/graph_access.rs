//! Decides when the agent takes part in the ROS graph. On a robot with ROS 2 the agent joins when a
//! task or a question first needs the graph, and stays until the agent ends, or until another
//! domain is needed and the current one is not in use. It joins again if the connection is lost. On
//! a robot without ROS 2 the agent never opens a socket for the graph. This module does not inspect
//! the graph itself.

use std::sync::{Arc, Weak};
use std::time::Duration;

use futures_util::FutureExt as _;
use futures_util::future::BoxFuture;
use rand::RngExt as _;
use task_proto::MacAddress;
use task_proto::ids::InvalidId;
use task_proto::messages::report::{Failure, FailureCode, RosFacts};
use tokio::sync::{Mutex, watch};
use tokio::time::Instant;
use tokio_util::sync::{CancellationToken, DropGuard};

use crate::ros::graph::{Graph, GraphProgram, GraphSettings, Snapshot};
use crate::ros::node_logs;
use crate::system::layout::DataDir;

/// Time that discovery may take until the graph shows the nodes that existed before: nodes announce
/// themselves every 3 s.
const DISCOVERY: Duration = Duration::from_millis(3500);
/// Pause before the next attempt after the graph was lost, or could not be opened: the first pause,
/// and the maximum.
const FIRST_RETRY: Duration = Duration::from_millis(500);
const LAST_RETRY: Duration = Duration::from_secs(30);
/// A graph that was open for this long resets the failure count.
const STABLE: Duration = Duration::from_secs(60);

/// Access to the robot's graph; clones share it.
#[derive(Clone)]
pub struct GraphAccess {
    inner: Arc<Inner>,
}

struct Inner {
    mac: MacAddress,
    data: DataDir,
    program: GraphProgram,
    log_bytes: watch::Sender<Option<u64>>,
    state: Mutex<State>,
}

#[derive(Default)]
struct State {
    graph: GraphState,
    /// Number of times that the graph was lost, or could not be opened, since it last stayed open.
    failures: u32,
}

#[derive(Default)]
enum GraphState {
    #[default]
    Closed,
    Open {
        graph: Graph,
        since: Instant,
        domain_id: u16,
        /// Messages of nodes are recorded while the graph is open. Only this recorder may write the
        /// files, and it does not hold the graph open.
        _recording: DropGuard,
    },
    Failed {
        failure: Failure,
        retry_at: Instant,
    },
}

impl GraphAccess {
    /// The graph is closed at first; `program` takes part in it. The node's name comes from the
    /// robot, because two agents on one host, or in one domain, need two names. Messages of nodes
    /// are recorded in `data` while the graph is open.
    pub fn of_robot(mac: MacAddress, data: DataDir, program: GraphProgram) -> Self {
        let log_bytes = watch::Sender::new(None);
        let state = Mutex::default();
        Self { inner: Arc::new(Inner { mac, data, program, log_bytes, state }) }
    }

    /// Limits a file of node messages to `log_bytes`, from the next time that the graph is opened.
    pub fn limit(&self, log_bytes: Option<u64>) {
        self.inner.log_bytes.send_replace(log_bytes);
    }

    /// The graph, opened now if it was not open yet. `facts` describe the robot as last seen.
    pub async fn open(&self, facts: Option<&RosFacts>) -> Result<Graph, Failure> {
        self.inner.open_shared(facts).await.map(|(graph, _)| graph)
    }

    /// Like `open`, but waits until the graph can show the nodes that existed when it was opened.
    pub async fn open_after_discovery(&self, facts: Option<&RosFacts>) -> Result<Graph, Failure> {
        let (graph, since) = self.inner.open_shared(facts).await?;
        tokio::time::sleep_until(since + DISCOVERY).await;
        Ok(graph)
    }
}

impl Inner {
    async fn open_shared(
        self: &Arc<Self>,
        facts: Option<&RosFacts>,
    ) -> Result<(Graph, Instant), Failure> {
        let mut state = self.state.lock().await;
        state.detect_loss();
        match &state.graph {
            // Watches of tasks in the domain that was left go on with the graph that they have.
            GraphState::Open { graph, since, domain_id, .. }
                if facts.is_none_or(|facts| facts.domain_id == Some(*domain_id)) =>
            {
                return Ok((graph.clone(), *since));
            }
            GraphState::Failed { failure, retry_at } if Instant::now() < *retry_at => {
                return Err(failure.clone());
            }
            GraphState::Closed | GraphState::Open { .. } | GraphState::Failed { .. } => {}
        }
        let settings = self.settings(facts)?;
        match Graph::open(&settings, &self.program).await {
            Ok(graph) => {
                tracing::info!(
                    domain_id = settings.domain_id,
                    localhost_only = settings.localhost_only,
                    "graph open"
                );
                let since = Instant::now();
                let over = CancellationToken::new();
                let recording = node_logs::record_messages(
                    graph.clone(),
                    self.data.clone(),
                    *self.log_bytes.borrow(),
                );
                tokio::spawn(over.clone().run_until_cancelled_owned(recording));
                tokio::spawn(reopen_when_lost(
                    Arc::downgrade(self),
                    graph.changes(),
                    facts.cloned(),
                ));
                let domain_id = settings.domain_id;
                let _recording = over.drop_guard();
                state.graph =
                    GraphState::Open { graph: graph.clone(), since, domain_id, _recording };
                Ok((graph, since))
            }
            Err(error) => {
                tracing::error!(%error, "the ROS graph can't be opened");
                Err(state.fail(error.to_string()))
            }
        }
    }

    fn settings(&self, facts: Option<&RosFacts>) -> Result<GraphSettings, Failure> {
        let found = facts.and_then(|facts| Some((facts, facts.domain_id?)));
        let none = || {
            Failure::new(
                FailureCode::GRAPH_UNAVAILABLE,
                "this robot has no ROS 2 installation, so it has no ROS graph to watch",
            )
        };
        let (facts, domain_id) = found.ok_or_else(none)?;
        let name = format!("/task_agent_{}", self.mac.to_string().replace(':', ""));
        let unnamed =
            |error: InvalidId| Failure::new(FailureCode::GRAPH_UNAVAILABLE, error.to_string());
        Ok(GraphSettings {
            domain_id,
            localhost_only: facts.localhost_only,
            node_name: name.parse().map_err(unnamed)?,
            distro: Some(facts.distro.clone()),
        })
    }
}

impl State {
    /// Notices that the graph has closed by itself, because its program was killed or its listening
    /// ended.
    fn detect_loss(&mut self) {
        let GraphState::Open { graph, since, .. } = &self.graph else { return };
        if graph.is_closed() {
            if since.elapsed() >= STABLE {
                self.failures = 0;
            }
            self.fail("the ROS graph was lost; opening it again".to_owned());
        }
    }

    fn fail(&mut self, why: String) -> Failure {
        let failure = Failure::new(FailureCode::GRAPH_UNAVAILABLE, why);
        let retry_at = Instant::now() + backoff(self.failures);
        self.failures = self.failures.saturating_add(1);
        self.graph = GraphState::Failed { failure: failure.clone(), retry_at };
        failure
    }
}

/// The pause before the next attempt, after this number of failed attempts.
fn backoff(failures: u32) -> Duration {
    let most = FIRST_RETRY.saturating_mul(2_u32.saturating_pow(failures.min(16))).min(LAST_RETRY);
    rand::rng().random_range(most / 2..=most)
}

/// Opens the graph again once it is lost, whether a caller needs it or not: messages of nodes are
/// to be recorded. This task holds neither the graph nor the access to it.
fn reopen_when_lost(
    access: Weak<Inner>,
    mut changes: watch::Receiver<Arc<Snapshot>>,
    facts: Option<RosFacts>,
) -> BoxFuture<'static, ()> {
    async move {
        while changes.changed().await.is_ok() {}
        loop {
            let retry_at = {
                let Some(access) = access.upgrade() else { return };
                let mut state = access.state.lock().await;
                state.detect_loss();
                match &state.graph {
                    // Another graph is open by now, or the graph is no longer needed.
                    GraphState::Open { .. } | GraphState::Closed => return,
                    GraphState::Failed { retry_at, .. } => *retry_at,
                }
            };
            tokio::time::sleep_until(retry_at).await;
            let Some(access) = access.upgrade() else { return };
            if access.open_shared(facts.as_ref()).await.is_ok() {
                return;
            }
        }
    }
    .boxed()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn retry_pause_grows_and_is_jittered() {
        for (failures, most_ms) in [(0, 500), (1, 1000), (4, 8000), (6, 30_000), (u32::MAX, 30_000)]
        {
            let most = Duration::from_millis(most_ms);
            let waits: Vec<_> = (0..50).map(|_| backoff(failures)).collect();
            assert!(
                waits.iter().all(|wait| (most / 2..=most).contains(wait)),
                "{failures}: {waits:?}"
            );
            assert!(waits.windows(2).any(|pair| pair[0] != pair[1]), "{failures}: no jitter");
        }
    }
}
