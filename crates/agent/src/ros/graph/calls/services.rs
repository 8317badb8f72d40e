//! Calls to services. A request is lost without notice if client and server have not discovered
//! each other yet, so a call first waits for discovery. Every call has a time limit. Only calls
//! that may be repeated are sent again.

use std::collections::{BTreeMap, BTreeSet};
use std::pin::pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};
use std::time::Duration;

use futures_util::StreamExt;
use ros2_client::dds::rustdds::SequenceNumber;
use ros2_client::dds::rustdds::rpc::SampleIdentity;
use serde::Serialize;
use serde::de::DeserializeOwned;
use task_proto::telemetry::ros::GraphName;
use tokio::sync::{Mutex, watch};
use tokio::time::{Instant, timeout_at};

use crate::ros::graph::dds::endpoint::{Cdr, Delivery, Endpoints, Reader, Writer};
use crate::ros::graph::dds::names::{self, Role};
use crate::ros::graph::dds::observer::Matches;
use crate::ros::graph::dds::own_node::OwnNode;
use crate::ros::graph::{EndpointId, GraphError, ParticipantId};

/// Maximum number of services with a ready client; beyond that, the least recently used client is
/// removed.
pub const MAX_CLIENTS: usize = 256;
/// Answer timeout of one attempt of a repeatable call.
const ATTEMPT_TIMEOUT: Duration = Duration::from_secs(2);
/// QoS of services: ROS's default profile for them.
const DELIVERY: Delivery = Delivery::Reliable { depth: 10 };
/// Length of Cyclone's header before requests and answers: half the client's id and a number.
const CYCLONE_HEADER: usize = 16;

/// Whether a call may reach the service twice.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Repeat {
    /// Repeatable: the call changes nothing, or sets absolute values. The request is sent again
    /// while there is time.
    UntilDeadline,
    /// The request is sent once.
    Never,
}

/// The clients of all services that were called.
pub struct Clients {
    endpoints: Arc<Endpoints>,
    own: Arc<OwnNode>,
    matches: watch::Sender<Matches>,
    cache: Mutex<CachedClients>,
}

#[derive(Default)]
struct CachedClients {
    clients: BTreeMap<(GraphName, String), (u64, Arc<Client>)>,
    uses: u64,
}

struct Client {
    requests: Writer,
    replies: Mutex<Reader<Cdr>>,
    /// Ids of the request writer and the answer reader.
    ids: (EndpointId, EndpointId),
    /// Counter for Cyclone's request numbers.
    number: AtomicI64,
}

impl Clients {
    /// An empty set of clients.
    pub fn new(
        endpoints: Arc<Endpoints>,
        own: Arc<OwnNode>,
        matches: watch::Sender<Matches>,
    ) -> Self {
        Self { endpoints, own, matches, cache: Mutex::default() }
    }

    /// Creates the client of this service, so that a server that appears later finds the client.
    pub async fn prepare(&self, service: &GraphName, kind: &str) -> Result<(), GraphError> {
        self.client(service, kind).await.map(drop)
    }

    /// The participants with a server of this service that receives our requests and reaches us
    /// with its answers; waits until there is one.
    pub async fn servers(
        &self,
        service: &GraphName,
        kind: &str,
        within: Duration,
    ) -> Result<BTreeSet<ParticipantId>, GraphError> {
        let client = self.client(service, kind).await?;
        self.matched(&client, service, Instant::now() + within, within).await
    }

    /// Calls the service and waits for its answer.
    pub async fn call<Q: Serialize, A: DeserializeOwned>(
        &self,
        service: &GraphName,
        kind: &str,
        request: &Q,
        within: Duration,
        repeat: Repeat,
    ) -> Result<A, GraphError> {
        let deadline = Instant::now() + within;
        let client = self.client(service, kind).await?;
        let no_answer = || GraphError::NoAnswer { service: service.clone(), within };
        // One call at a time: the reader of the answers receives the answers to all calls.
        let replies = timeout_at(deadline, client.replies.lock()).await.map_err(|_| no_answer())?;
        loop {
            let servers = self.matched(&client, service, deadline, within).await?;
            let until = match repeat {
                Repeat::UntilDeadline => deadline.min(Instant::now() + ATTEMPT_TIMEOUT),
                Repeat::Never => deadline,
            };
            let framed = servers.iter().all(|server| server.is_cyclone());
            match timeout_at(until, client.request(&replies, request, framed)).await {
                Ok(answer) => {
                    let skipped = if framed { CYCLONE_HEADER } else { 0 };
                    let malformed = || GraphError::Malformed { service: service.clone() };
                    return answer?.value(skipped).ok_or_else(malformed);
                }
                Err(_) if until < deadline => {}
                Err(_) => return Err(no_answer()),
            }
        }
    }

    async fn matched(
        &self,
        client: &Client,
        service: &GraphName,
        deadline: Instant,
        within: Duration,
    ) -> Result<BTreeSet<ParticipantId>, GraphError> {
        let (writer, reader) = client.ids;
        let mut matches = self.matches.subscribe();
        let found = timeout_at(
            deadline,
            matches.wait_for(|matches| !matches.with_both(writer, reader).is_empty()),
        );
        match found.await {
            Ok(Ok(matches)) => Ok(matches.with_both(writer, reader)),
            Ok(Err(_closed)) => Err(GraphError::Closed),
            Err(_) => Err(GraphError::NoServer { service: service.clone(), within }),
        }
    }

    async fn client(&self, service: &GraphName, kind: &str) -> Result<Arc<Client>, GraphError> {
        let mut cache = self.cache.lock().await;
        cache.uses += 1;
        let now = cache.uses;
        let key = (service.clone(), kind.to_owned());
        if let Some((used, client)) = cache.clients.get_mut(&key) {
            *used = now;
            return Ok(client.clone());
        }
        if cache.clients.len() >= MAX_CLIENTS {
            self.evict_idle(&mut cache);
        }
        let client = Arc::new(Client::new(&self.endpoints, service, kind)?);
        let (writer, reader) = client.ids;
        self.own.add(&[reader], &[writer]);
        cache.clients.insert(key, (now, client.clone()));
        Ok(client)
    }

    fn evict_idle(&self, cache: &mut CachedClients) {
        let idle = cache.clients.iter().filter(|(_, (_, client))| Arc::strong_count(client) == 1);
        let Some(key) = idle.min_by_key(|(_, (used, _))| *used).map(|(key, _)| key.clone()) else {
            return;
        };
        if let Some((_, client)) = cache.clients.remove(&key) {
            let (writer, reader) = client.ids;
            self.own.remove(&[reader], &[writer]);
            drop(client);
            self.matches.send_if_modified(|matches| {
                matches.forget(writer);
                matches.forget(reader);
                false
            });
        }
    }
}

impl Client {
    fn new(endpoints: &Endpoints, service: &GraphName, kind: &str) -> Result<Self, GraphError> {
        let dds = |role| {
            let dds_kind =
                names::type_to_dds(role, kind).ok_or_else(|| GraphError::Kind(kind.to_owned()))?;
            Ok::<_, GraphError>((names::to_dds(role, service), dds_kind))
        };
        let (request_topic, request_kind) = dds(Role::Request)?;
        let (reply_topic, reply_kind) = dds(Role::Reply)?;
        // The reader is created first: a server that finds the writer can then answer.
        let replies = endpoints.reader(&reply_topic, &reply_kind, DELIVERY)?;
        let requests = endpoints.writer(&request_topic, &request_kind, DELIVERY)?;
        let ids = (requests.id(), replies.id());
        Ok(Self { requests, replies: Mutex::new(replies), ids, number: AtomicI64::new(0) })
    }

    /// Sends the request and waits for its answer, skipping answers to others.
    async fn request(
        &self,
        replies: &Reader<Cdr>,
        request: &impl Serialize,
        framed: bool,
    ) -> Result<Cdr, GraphError> {
        let mut answers = pin!(replies.samples());
        if framed {
            let header = self.cyclone_header();
            let number = SampleIdentity {
                writer_guid: self.requests.guid(),
                sequence_number: SequenceNumber::from(self.number.load(Ordering::Relaxed)),
            };
            self.requests.write(Cdr::of(&header, request)?, Some(number)).await?;
            while let Some(answer) = answers.next().await {
                if answer.message.body.starts_with(&header) {
                    return Ok(answer.message);
                }
            }
        } else {
            let identity = self.requests.write(Cdr::of(&[], request)?, None).await?;
            while let Some(answer) = answers.next().await {
                if answer.answers == Some(identity) {
                    return Ok(answer.message);
                }
            }
        }
        Err(GraphError::Closed)
    }

    /// The header that a Cyclone server returns unchanged.
    fn cyclone_header(&self) -> Vec<u8> {
        let number = self.number.fetch_add(1, Ordering::Relaxed) + 1;
        [&self.requests.id().0[8..], &number.to_le_bytes()].concat()
    }
}
