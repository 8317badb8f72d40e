//! When the agent takes part in the ROS graph: from the first time that a task or a question needs it, on a robot that has
//! ROS 2, until the agent ends, or until somebody needs another domain and nobody this one any more; anew, should it have been
//! thrown out. A robot without ROS 2 never opens a socket for it. It looks at nothing itself.

use std::error::Error as _;
use std::sync::Arc;
use std::time::Duration;

use task_proto::MacAddress;
use task_proto::id::InvalidId;
use task_proto::report::{Failure, FailureCode, RosFacts};
use tokio::sync::{Mutex, watch};
use tokio::time::Instant;
use tokio_util::sync::{CancellationToken, DropGuard};

use crate::graph::{Graph, GraphSettings};
use crate::layout::DataDir;
use crate::logs::ros;

/// How long discovery may take until the graph shows who was there before: nodes announce themselves every 3 s.
const DISCOVERY: Duration = Duration::from_millis(3500);
/// When to try again after the graph could not be opened.
const RETRY: Duration = Duration::from_secs(10);

/// The way to the robot's graph; clones share it.
#[derive(Clone)]
pub struct GraphAccess {
    mac: MacAddress,
    data: DataDir,
    log_bytes: Arc<watch::Sender<Option<u64>>>,
    state: Arc<Mutex<State>>,
}

#[derive(Default)]
enum State {
    #[default]
    Closed,
    Open {
        graph: Graph,
        since: Instant,
        domain_id: u16,
        /// What nodes say is kept as long: nobody else may write it, and the graph is not held open for it.
        _keeping: DropGuard,
    },
    Failed {
        failure: Failure,
        at: Instant,
    },
}

impl GraphAccess {
    /// Closed at first. The node is named for the robot, because two agents on one host, or in one domain, need two names.
    /// What nodes say is kept in `data` while it is open.
    pub fn of_robot(mac: MacAddress, data: DataDir) -> Self {
        Self { mac, data, log_bytes: Arc::new(watch::Sender::new(None)), state: Arc::default() }
    }

    /// Lets a file of what nodes say have no more than `log_bytes`, from the next time that the graph is opened.
    pub fn limit(&self, log_bytes: Option<u64>) {
        self.log_bytes.send_replace(log_bytes);
    }

    /// The graph, opened now if it was not yet. `facts` say what the robot has, as it was seen last.
    pub async fn open(&self, facts: Option<&RosFacts>) -> Result<Graph, Failure> {
        self.opened(facts).await.map(|(graph, _)| graph)
    }

    /// Likewise, but not before it can show who was there when it was opened.
    pub async fn settled(&self, facts: Option<&RosFacts>) -> Result<Graph, Failure> {
        let (graph, since) = self.opened(facts).await?;
        tokio::time::sleep_until(since + DISCOVERY).await;
        Ok(graph)
    }

    async fn opened(&self, facts: Option<&RosFacts>) -> Result<(Graph, Instant), Failure> {
        let mut state = self.state.lock().await;
        match &*state {
            // Whoever watches a task in the domain that was left goes on with the graph they have.
            State::Open { graph, since, domain_id, .. }
                if !graph.is_closed() && facts.is_none_or(|facts| facts.domain_id == Some(*domain_id)) =>
            {
                return Ok((graph.clone(), *since));
            }
            State::Failed { failure, at } if at.elapsed() < RETRY => return Err(failure.clone()),
            // What has closed by itself, because its listening ended, is opened anew.
            State::Closed | State::Open { .. } | State::Failed { .. } => {}
        }
        let settings = self.settings(facts)?;
        match Graph::open(&settings).await {
            Ok(graph) => {
                tracing::info!(domain_id = settings.domain_id, localhost_only = settings.localhost_only, "graph open");
                let since = Instant::now();
                let over = CancellationToken::new();
                let keep = ros::keep(graph.clone(), self.data.clone(), *self.log_bytes.borrow());
                tokio::spawn(over.clone().run_until_cancelled_owned(keep));
                let (domain_id, _keeping) = (settings.domain_id, over.drop_guard());
                *state = State::Open { graph: graph.clone(), since, domain_id, _keeping };
                Ok((graph, since))
            }
            Err(error) => {
                let why = error.source().map_or_else(String::new, |source| format!(": {source}"));
                let failure = Failure::new(FailureCode::GRAPH_UNAVAILABLE, format!("{error}{why}"));
                tracing::error!(%failure, "the ROS graph can't be opened");
                *state = State::Failed { failure: failure.clone(), at: Instant::now() };
                Err(failure)
            }
        }
    }

    fn settings(&self, facts: Option<&RosFacts>) -> Result<GraphSettings, Failure> {
        let found = facts.and_then(|facts| Some((facts, facts.domain_id?)));
        let none =
            || Failure::new(FailureCode::GRAPH_UNAVAILABLE, "this robot has no ROS 2, whose graph could be watched");
        let (facts, domain_id) = found.ok_or_else(none)?;
        let name = format!("/task_agent_{}", self.mac.to_string().replace(':', ""));
        let unnamed = |error: InvalidId| Failure::new(FailureCode::GRAPH_UNAVAILABLE, error.to_string());
        Ok(GraphSettings {
            domain_id,
            localhost_only: facts.localhost_only,
            node_name: name.parse().map_err(unnamed)?,
            distro: Some(facts.distro.clone()),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn facts(domain_id: u16) -> RosFacts {
        RosFacts { distro: "jazzy".to_owned(), rmw: None, domain_id: Some(domain_id), localhost_only: true }
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn a_domain_that_was_left_is_left_by_whoever_keeps_what_nodes_say() {
        let temp = tempfile::tempdir().expect("temp dir");
        let data = DataDir::new(temp.path()).expect("data dir");
        let access = GraphAccess::of_robot("02:00:00:00:00:01".parse().expect("an address"), data);
        let before = access.open(Some(&facts(171))).await.expect("open");
        let mut changes = before.changes();
        let now = access.open(Some(&facts(172))).await.expect("open");
        assert!(!before.is_closed(), "who watches a task there still sees it");
        drop(before);
        let closed = async { while changes.changed().await.is_ok() {} };
        tokio::time::timeout(Duration::from_secs(60), closed).await.expect("the graph of the domain before is closed");
        assert!(!now.is_closed());
    }
}
