//! When the agent takes part in the ROS graph: from the first time that a task or a question needs
//! it, on a robot that has ROS 2, until the agent ends, or until somebody needs another domain and
//! nobody this one any more; anew, should it have been thrown out. A robot without ROS 2 never
//! opens a socket for it. It looks at nothing itself.

use std::sync::{Arc, Weak};
use std::time::Duration;

use futures_util::FutureExt as _;
use futures_util::future::BoxFuture;
use rand::RngExt as _;
use task_proto::MacAddress;
use task_proto::id::InvalidId;
use task_proto::report::{Failure, FailureCode, RosFacts};
use tokio::sync::{Mutex, watch};
use tokio::time::Instant;
use tokio_util::sync::{CancellationToken, DropGuard};

use crate::ros::graph::{Graph, GraphProgram, GraphSettings, Snapshot};
use crate::ros::node_logs;
use crate::system::layout::DataDir;

/// How long discovery may take until the graph shows who was there before: nodes announce
/// themselves every 3 s.
const DISCOVERY: Duration = Duration::from_millis(3500);
/// When to try again after the graph was lost, or could not be opened: at first, and at most.
const FIRST_RETRY: Duration = Duration::from_millis(500);
const LAST_RETRY: Duration = Duration::from_secs(30);
/// A graph that was open for so long was well.
const WELL: Duration = Duration::from_secs(60);

/// The way to the robot's graph; clones share it.
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
    /// How often the graph was lost, or could not be opened, since it was well.
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
        /// What nodes say is kept as long: nobody else may write it, and the graph is not held open
        /// for it.
        _keeping: DropGuard,
    },
    Failed {
        failure: Failure,
        retry_at: Instant,
    },
}

impl GraphAccess {
    /// Closed at first; `program` takes part. The node is named for the robot, because two agents
    /// on one host, or in one domain, need two names. What nodes say is kept in `data` while it is
    /// open.
    pub fn of_robot(mac: MacAddress, data: DataDir, program: GraphProgram) -> Self {
        let (log_bytes, state) = (watch::Sender::new(None), Mutex::default());
        Self { inner: Arc::new(Inner { mac, data, program, log_bytes, state }) }
    }

    /// Lets a file of what nodes say have no more than `log_bytes`, from the next time that the
    /// graph is opened.
    pub fn limit(&self, log_bytes: Option<u64>) {
        self.inner.log_bytes.send_replace(log_bytes);
    }

    /// The graph, opened now if it was not yet. `facts` say what the robot has, as it was seen
    /// last.
    pub async fn open(&self, facts: Option<&RosFacts>) -> Result<Graph, Failure> {
        self.inner.opened(facts).await.map(|(graph, _)| graph)
    }

    /// Likewise, but not before it can show who was there when it was opened.
    pub async fn settled(&self, facts: Option<&RosFacts>) -> Result<Graph, Failure> {
        let (graph, since) = self.inner.opened(facts).await?;
        tokio::time::sleep_until(since + DISCOVERY).await;
        Ok(graph)
    }
}

impl Inner {
    async fn opened(
        self: &Arc<Self>,
        facts: Option<&RosFacts>,
    ) -> Result<(Graph, Instant), Failure> {
        let mut state = self.state.lock().await;
        state.notice_loss();
        match &state.graph {
            // Whoever watches a task in the domain that was left goes on with the graph they have.
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
                let keep =
                    node_logs::keep(graph.clone(), self.data.clone(), *self.log_bytes.borrow());
                tokio::spawn(over.clone().run_until_cancelled_owned(keep));
                tokio::spawn(reopen_when_lost(
                    Arc::downgrade(self),
                    graph.changes(),
                    facts.cloned(),
                ));
                let (domain_id, _keeping) = (settings.domain_id, over.drop_guard());
                state.graph = GraphState::Open { graph: graph.clone(), since, domain_id, _keeping };
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
                "this robot has no ROS 2, whose graph could be watched",
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
    /// Takes in that the graph has closed by itself, if it has: because its program was killed, or
    /// its listening ended.
    fn notice_loss(&mut self) {
        let GraphState::Open { graph, since, .. } = &self.graph else { return };
        if graph.is_closed() {
            if since.elapsed() >= WELL {
                self.failures = 0;
            }
            self.fail("the ROS graph was lost; it is opened again".to_owned());
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

/// How long to wait before the next attempt, after as many that failed.
fn backoff(failures: u32) -> Duration {
    let most = FIRST_RETRY.saturating_mul(2_u32.saturating_pow(failures.min(16))).min(LAST_RETRY);
    rand::rng().random_range(most / 2..=most)
}

/// Opens the graph again once it is lost, whether anybody asks for it or not: what nodes say is to
/// be kept. It holds neither the graph nor the access to it.
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
                state.notice_loss();
                match &state.graph {
                    // Another is open by now, or nobody wants one.
                    GraphState::Open { .. } | GraphState::Closed => return,
                    GraphState::Failed { retry_at, .. } => *retry_at,
                }
            };
            tokio::time::sleep_until(retry_at).await;
            let Some(access) = access.upgrade() else { return };
            if access.opened(facts.as_ref()).await.is_ok() {
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
    fn retries_come_later_each_time_and_never_at_one_time() {
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
