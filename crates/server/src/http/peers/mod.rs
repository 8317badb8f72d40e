//! The other servers of the cluster as this one uses them: which of them has a robot's session or
//! an upload, their answers, and the newest figures of robots that are connected there. A server
//! alone has none. This module never decides about a caller's rights: both servers guard a request.

mod client;
mod proof;

use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use axum::extract::{FromRequest, Request};
use axum::response::Response;
use bytes::Bytes;
use futures_util::future::join_all;
use http::HeaderMap;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use task_proto::RobotId;
use task_proto::api::{MAX_PAGE_ENTRIES, NodeFigures, Subscription, Traffic};
use task_proto::ids::NodeName;
use task_proto::telemetry::vitals::Vitals;
use task_proto::trust::envelope::SigningKey;
use task_transport::Trust;
use tokio_util::sync::CancellationToken;

use self::client::{FORWARDED, PeerClient};
pub use self::client::{Patience, Peer, SilentPeer};
pub use self::proof::Proven;
use super::error::ApiError;
use super::extract::parse_json;
use crate::blobs::{UploadId, upload_mark};
use crate::fleet::live_nodes::LiveNodes;
use crate::store::{Node, Store, StoreError};

/// The path of a server's own figures.
pub const STATUS_PATH: &str = "/peer/status";
/// The path of the sessions of robots.
pub const SESSIONS_PATH: &str = "/peer/sessions";
/// The path of the figures of robots.
pub const FIGURES_PATH: &str = "/peer/figures";
/// Lifetime of figures of robots at other servers.
const FIGURES_LIFETIME: Duration = Duration::from_secs(5);
/// Maximum robots whose figures are remembered.
const MAX_REMEMBERED: usize = 20_000;

/// The other servers. Clones share them.
#[derive(Clone, Default)]
pub struct Peers(Option<Arc<Cluster>>);

struct Cluster {
    name: NodeName,
    nodes: LiveNodes,
    store: Store,
    client: PeerClient,
    stop: CancellationToken,
    remembered: Mutex<HashMap<RobotId, (Instant, RobotFigures)>>,
    /// Held by the one that asks for figures, so that others wait for the same answer.
    asking: tokio::sync::Mutex<()>,
}

/// A question about robots, at most [`MAX_PAGE_ENTRIES`].
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct RobotQuestion {
    pub robots: Vec<RobotId>,
}

/// The figures of a robot that only the server with its session knows.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct RobotFigures {
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub vitals: Option<Vitals>,
    /// For people: how the robot violates its limits.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub penalty: Option<String>,
}

/// The session of a robot.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct SessionFigures {
    #[serde(default)]
    pub subscriptions: Vec<Subscription>,
    #[serde(default)]
    pub traffic: Traffic,
    /// The server that has the session, as the one that asked it knows.
    #[serde(skip)]
    pub node: Option<NodeName>,
}

/// A server of the cluster, and its figures if it answered.
pub struct PeerStatus {
    pub node: Node,
    /// Time since its heartbeat moved; `None`: it is lost, or is this server.
    pub heartbeat_age: Option<Duration>,
    pub is_own: bool,
    pub is_live: bool,
    pub figures: Option<NodeFigures>,
}

impl Peers {
    /// The other servers of the cluster in which this server is called `name`.
    pub fn join(
        name: NodeName,
        nodes: LiveNodes,
        store: Store,
        key: &SigningKey,
        trust: Trust,
        stop: CancellationToken,
    ) -> Result<Self, reqwest::Error> {
        let client = PeerClient::new(key, trust)?;
        let (remembered, asking) = (Mutex::default(), tokio::sync::Mutex::default());
        Ok(Self(Some(Arc::new(Cluster { name, nodes, store, client, stop, remembered, asking }))))
    }

    /// This server's name; `None`: it is alone.
    pub fn own_name(&self) -> Option<&NodeName> {
        self.0.as_ref().map(|cluster| &cluster.name)
    }

    /// The proof of a request about its sender.
    pub fn proven(&self, request: &Request) -> Proven {
        let cluster = self.0.as_ref();
        cluster.map_or(Proven::Nothing, |cluster| cluster.client.proven(&cluster.name, request))
    }

    /// The other live server that has the robot's session; `None` also if this one is to answer
    /// because another has passed the request on.
    pub async fn with_session(
        &self,
        robot: &RobotId,
        headers: &HeaderMap,
    ) -> Result<Option<Peer>, StoreError> {
        let Some(cluster) = self.unless_forwarded(headers) else { return Ok(None) };
        let runs = cluster.nodes.runs();
        let node = cluster.store.robot_sessions().node_of(robot, &runs).await?;
        let peer = node.and_then(|node| peer(&node.name, node.url));
        Ok(peer.filter(|peer| peer.name != cluster.name))
    }

    /// The other live server at which the upload began.
    pub async fn with_upload(
        &self,
        upload: &UploadId,
        headers: &HeaderMap,
    ) -> Result<Option<Peer>, StoreError> {
        let Some(cluster) = self.unless_forwarded(headers) else { return Ok(None) };
        if upload.mark() == upload_mark(cluster.name.as_str()) {
            return Ok(None);
        }
        let peers = cluster.peers().await?;
        Ok(peers.into_iter().find(|peer| upload_mark(peer.name.as_str()) == upload.mark()))
    }

    /// The other live server with this name.
    pub async fn named(
        &self,
        name: &NodeName,
        headers: &HeaderMap,
    ) -> Result<Option<Peer>, StoreError> {
        let Some(cluster) = self.unless_forwarded(headers) else { return Ok(None) };
        Ok(cluster.peers().await?.into_iter().find(|peer| peer.name == *name))
    }

    fn unless_forwarded(&self, headers: &HeaderMap) -> Option<&Cluster> {
        self.0.as_deref().filter(|_| !headers.contains_key(FORWARDED))
    }

    /// Passes a client's request on to another server.
    pub async fn forward(
        &self,
        to: &Peer,
        patience: Patience,
        client: IpAddr,
        request: Request,
    ) -> Result<Response, SilentPeer> {
        let cluster = self.0.as_ref().ok_or(SilentPeer)?;
        cluster.client.forward(to, patience, client, request, cluster.stop.clone()).await
    }

    /// All servers of the cluster, and the figures of those that answer in time. `own` are this
    /// server's.
    pub async fn statuses(&self, own: NodeFigures) -> Result<Vec<PeerStatus>, StoreError> {
        let Some(cluster) = &self.0 else { return Ok(Vec::new()) };
        let now = Instant::now();
        let status = async |node: Node| {
            let is_own = node.name == cluster.name.as_str();
            let is_live = cluster.nodes.is_live(&node.run);
            let figures = match peer(&node.name, node.url.clone()) {
                _ if is_own => Some(own),
                Some(peer) if is_live => cluster.client.ask(&peer, STATUS_PATH, &()).await,
                _ => None,
            };
            let heartbeat_age = cluster.nodes.rest(&node.run, now);
            PeerStatus { node, heartbeat_age, is_own, is_live, figures }
        };
        let nodes = cluster.store.nodes().list().await?;
        Ok(join_all(nodes.into_iter().map(status)).await)
    }

    /// The sessions of these robots at other servers that answer in time.
    pub async fn sessions(
        &self,
        robots: Vec<RobotId>,
    ) -> Result<HashMap<RobotId, SessionFigures>, StoreError> {
        match &self.0 {
            Some(cluster) if !robots.is_empty() => {
                let answers: Vec<(NodeName, HashMap<RobotId, SessionFigures>)> =
                    cluster.ask_all(SESSIONS_PATH, robots).await?;
                let of_node = |(node, sessions): (NodeName, HashMap<_, SessionFigures>)| {
                    let node = Some(node);
                    sessions.into_iter().map(move |(robot, session)| {
                        (robot, SessionFigures { node: node.clone(), ..session })
                    })
                };
                Ok(answers.into_iter().flat_map(of_node).collect())
            }
            _ => Ok(HashMap::new()),
        }
    }

    /// Asks the other servers for figures of these robots, those known for some seconds excepted.
    /// Afterwards [`Self::figures`] has the answers.
    pub async fn ask_for_figures<'a>(&self, robots: impl Iterator<Item = &'a RobotId>) {
        let Some(cluster) = &self.0 else { return };
        let wanted: Vec<RobotId> = robots.take(MAX_PAGE_ENTRIES as usize).cloned().collect();
        let _asking = cluster.asking.lock().await;
        let now = Instant::now();
        let is_old = |robot: &RobotId| {
            let known = cluster.remembered();
            known.get(robot).is_none_or(|(at, _)| now.duration_since(*at) >= FIGURES_LIFETIME)
        };
        let wanted: Vec<RobotId> = wanted.into_iter().filter(is_old).collect();
        if wanted.is_empty() {
            return;
        }
        let answers: Vec<(NodeName, HashMap<RobotId, RobotFigures>)> =
            match cluster.ask_all(FIGURES_PATH, wanted.clone()).await {
                Ok(answers) => answers,
                Err(error) => return error.log("the other servers are not known"),
            };
        let mut known = cluster.remembered();
        if known.len() + wanted.len() > MAX_REMEMBERED {
            known.retain(|_, (at, _)| now.duration_since(*at) < FIGURES_LIFETIME);
        }
        if known.len() + wanted.len() > MAX_REMEMBERED {
            known.clear();
        }
        let mut newest: HashMap<_, _> =
            wanted.into_iter().map(|robot| (robot, RobotFigures::default())).collect();
        for (robot, answer) in answers.into_iter().flat_map(|(_, answer)| answer) {
            if let Some(figures) = newest.get_mut(&robot) {
                figures.merge(answer);
            }
        }
        known.extend(newest.into_iter().map(|(robot, figures)| (robot, (now, figures))));
    }

    /// The figures of a robot, as another server knew them some seconds ago.
    pub fn figures(&self, robot: &RobotId) -> Option<RobotFigures> {
        let cluster = self.0.as_ref()?;
        let known = cluster.remembered();
        let (at, figures) = known.get(robot)?;
        (at.elapsed() < FIGURES_LIFETIME * 2).then(|| figures.clone())
    }
}

impl Cluster {
    /// The other live servers that have a URL.
    async fn peers(&self) -> Result<Vec<Peer>, StoreError> {
        let nodes = self.store.nodes().list().await?.into_iter();
        let live = nodes.filter(|node| self.nodes.is_live(&node.run));
        let peers = live.filter_map(|node| peer(&node.name, node.url));
        Ok(peers.filter(|peer| peer.name != self.name).collect())
    }

    /// The answers of the other servers to a question about robots.
    async fn ask_all<A: DeserializeOwned>(
        &self,
        path: &'static str,
        robots: Vec<RobotId>,
    ) -> Result<Vec<(NodeName, A)>, StoreError> {
        let question = RobotQuestion { robots };
        let peers = self.peers().await?;
        let ask = async |peer: &Peer| {
            let answer = self.client.ask(peer, path, &question).await?;
            Some((peer.name.clone(), answer))
        };
        Ok(join_all(peers.iter().map(ask)).await.into_iter().flatten().collect())
    }

    fn remembered(&self) -> MutexGuard<'_, HashMap<RobotId, (Instant, RobotFigures)>> {
        // Every change under this lock is complete in itself, so a panic elsewhere leaves nothing
        // half-done.
        self.remembered.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl RobotFigures {
    /// Takes the newer vitals of both. Servers that a robot has left remember old ones.
    pub fn merge(&mut self, other: Self) {
        let at_ms = |vitals: Option<Vitals>| vitals.map(|vitals| vitals.at_ms);
        if at_ms(other.vitals) > at_ms(self.vitals) {
            self.vitals = other.vitals;
        }
        self.penalty = self.penalty.take().or(other.penalty);
    }
}

/// A server that other servers can reach.
fn peer(name: &str, url: Option<String>) -> Option<Peer> {
    Some(Peer { name: name.parse().ok()?, url: url? })
}

/// The body of another server's request, whose digest the guard has found proven.
pub struct PeerJson<T>(pub T);

impl<S: Send + Sync, T: DeserializeOwned> FromRequest<S> for PeerJson<T> {
    type Rejection = ApiError;

    async fn from_request(request: Request, state: &S) -> Result<Self, ApiError> {
        let headers = request.headers().clone();
        let body = Bytes::from_request(request, state)
            .await
            .map_err(|_| ApiError::invalid("the body is too large, or incomplete"))?;
        if !proof::is_body(&headers, &body) {
            return Err(ApiError::unauthorized("the proof is for another body"));
        }
        parse_json(&body).map(Self)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn newer_vitals_of_two_servers_count() {
        let figures = |at_ms: Option<u64>, penalty: Option<&str>| RobotFigures {
            vitals: at_ms.map(|at_ms| Vitals { at_ms, ..Vitals::default() }),
            penalty: penalty.map(str::to_owned),
        };
        let mut known = figures(Some(5), None);
        known.merge(figures(Some(4), None));
        known.merge(figures(None, Some("slowed")));
        assert_eq!(known.vitals.map(|vitals| vitals.at_ms), Some(5));
        assert_eq!(known.penalty.as_deref(), Some("slowed"));
        known.merge(figures(Some(6), None));
        assert_eq!(known.vitals.map(|vitals| vitals.at_ms), Some(6));
        assert_eq!(known.penalty.as_deref(), Some("slowed"));
    }
}
