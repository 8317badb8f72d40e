//! Takes part in the ROS graph with a DDS participant of this process: publishes the graph's state
//! and performs calls. Only the program in [`super::serve`] runs this module.

use std::collections::BTreeSet;
use std::net::{IpAddr, Ipv4Addr};
use std::sync::Arc;
use std::time::{Duration, Instant};

use ros2_client::dds::rustdds::{DomainParticipant, DomainParticipantBuilder};
use task_proto::telemetry::ros::{GraphName, LifecycleState, Transition};
use tokio::runtime::Handle;
use tokio::sync::{broadcast, watch};
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use crate::ros::graph::calls::lifecycle;
use crate::ros::graph::calls::parameters::{self, ParameterValue, SetResult};
use crate::ros::graph::calls::services::Clients;
use crate::ros::graph::dds::endpoint::{Cdr, Delivery, Endpoints};
use crate::ros::graph::dds::entities::GidForm;
use crate::ros::graph::dds::names::{self, Role};
use crate::ros::graph::dds::observer::{Matches, Observer};
use crate::ros::graph::dds::own_node::OwnNode;
use crate::ros::graph::dds::snapshot::{ParticipantId, Snapshot};
use crate::ros::graph::feeds::{DiagnosticStatus, Feeds, RosoutLine};
use crate::ros::graph::rate::Counter;
use crate::ros::graph::{GraphError, GraphSettings};

/// Number of unread participant messages that are kept. Only the last list of nodes of each
/// participant counts.
const DISCOVERY_DEPTH: i32 = 200;
/// Size of the kernel's buffers for each socket of the participant.
const SOCKET_BUFFER_BYTES: usize = 1024 * 1024;

/// A handle on the graph. When the last handle is dropped, the node leaves.
#[derive(Clone)]
pub struct LocalGraph {
    shared: Arc<Shared>,
}

struct Shared {
    snapshot: watch::Receiver<Arc<Snapshot>>,
    clients: Clients,
    endpoints: Arc<Endpoints>,
    feeds: Feeds,
    tasks: Tasks,
}

/// The background tasks of the graph. They end when this value is dropped.
struct Tasks {
    closing: CancellationToken,
    tracker: TaskTracker,
    /// Taken on drop, because dropping the participant blocks until the library's threads have
    /// ended.
    participant: Option<DomainParticipant>,
}

impl LocalGraph {
    /// Takes part in the domain.
    pub async fn open(settings: &GraphSettings) -> Result<Self, GraphError> {
        settings.check()?;
        let settings = settings.clone();
        let opened = tokio::task::spawn_blocking(move || Self::join(&settings)).await;
        opened.unwrap_or(Err(GraphError::Closed))
    }

    /// Opens sockets and starts the library's threads. Call it inside the runtime, on a thread that
    /// may block.
    fn join(settings: &GraphSettings) -> Result<Self, GraphError> {
        let domain_id = settings.domain_id;
        let mut builder = DomainParticipantBuilder::new(domain_id)
            .socket_receive_buffer_size(SOCKET_BUFFER_BYTES)
            .socket_send_buffer_size(SOCKET_BUFFER_BYTES);
        if settings.localhost_only {
            builder = builder.with_only_networks([IpAddr::V4(Ipv4Addr::LOCALHOST)]);
        }
        let participant = builder
            .build()
            .map_err(|source| GraphError::Join { domain_id, reason: source.to_string() })?;
        let tasks = Tasks {
            closing: CancellationToken::new(),
            tracker: TaskTracker::new(),
            participant: Some(participant.clone()),
        };
        let endpoints = Arc::new(Endpoints::of(&participant)?);
        let lasting = |depth| Delivery::Lasting { depth };
        let announcer =
            endpoints.writer(names::DISCOVERY_TOPIC, names::DISCOVERY_TYPE, lasting(1))?;
        let discovery = endpoints.reader::<Cdr>(
            names::DISCOVERY_TOPIC,
            names::DISCOVERY_TYPE,
            lasting(DISCOVERY_DEPTH),
        )?;
        let form = GidForm::of_distro(settings.distro.as_deref());
        let own = Arc::new(OwnNode::new(settings.node_name.clone(), form, announcer));
        own.add(&[], &[]);
        let (snapshots, snapshot) = watch::channel(Arc::new(Snapshot::empty(Instant::now())));
        let (matches, _) = watch::channel(Matches::default());
        let observer = Observer::new(participant, snapshots, matches.clone());
        let closing = tasks.closing.clone();
        tasks.tracker.spawn(async move {
            // Without the observer no change or match would ever be noticed again.
            let _closed = closing.clone().drop_guard();
            observer.run(discovery, closing).await;
        });
        let clients = Clients::new(endpoints.clone(), own, matches);
        Ok(Self {
            shared: Arc::new(Shared {
                snapshot,
                clients,
                endpoints,
                feeds: Feeds::default(),
                tasks,
            }),
        })
    }

    /// Wakes when the graph changes; several changes may arrive as one. The channel ends when the
    /// graph is closed.
    pub fn changes(&self) -> watch::Receiver<Arc<Snapshot>> {
        self.shared.snapshot.clone()
    }

    /// Creates the client endpoints that [`Self::lifecycle_state`], [`Self::change_state`] and the
    /// parameter calls need for this node. A node that starts later finds them there and answers
    /// sooner.
    pub async fn prepare(&self, node: &GraphName) -> Result<(), GraphError> {
        lifecycle::prepare(&self.shared.clients, node).await?;
        parameters::prepare(&self.shared.clients, node).await
    }

    /// Waits until a server of this service would receive a request and its answer would be
    /// received. Returns the participants that have such a server. Without `kind` the service's
    /// type is taken from the graph.
    pub async fn service_answers(
        &self,
        service: &GraphName,
        kind: Option<&str>,
        within: Duration,
    ) -> Result<BTreeSet<ParticipantId>, GraphError> {
        let deadline = tokio::time::Instant::now() + within;
        let kind = match kind {
            Some(kind) => kind.to_owned(),
            None => self.kind_of(service, deadline, within).await?,
        };
        let left = deadline.saturating_duration_since(tokio::time::Instant::now());
        let answered = self.while_open(self.shared.clients.servers(service, &kind, left)).await;
        answered.map_err(|error| match error {
            GraphError::NoServer { service, .. } => GraphError::NoServer { service, within },
            other => other,
        })
    }

    async fn kind_of(
        &self,
        service: &GraphName,
        deadline: tokio::time::Instant,
        within: Duration,
    ) -> Result<String, GraphError> {
        let kind = |snapshot: &Snapshot| -> Option<String> {
            let node = snapshot.servers_of(service).next()?;
            node.services
                .iter()
                .find(|offered| offered.name == *service)
                .map(|offered| offered.kind.clone())
        };
        let mut changes = self.changes();
        let found = tokio::time::timeout_at(
            deadline,
            changes.wait_for(|snapshot| kind(snapshot).is_some()),
        );
        match found.await {
            Ok(Ok(snapshot)) => kind(&snapshot).ok_or(GraphError::Closed),
            Ok(Err(_closed)) => Err(GraphError::Closed),
            Err(_) => Err(GraphError::NoServer { service: service.clone(), within }),
        }
    }

    /// The state of this lifecycle node.
    pub async fn lifecycle_state(
        &self,
        node: &GraphName,
        within: Duration,
    ) -> Result<LifecycleState, GraphError> {
        self.while_open(lifecycle::state(&self.shared.clients, node, within)).await
    }

    /// Requests a transition of this lifecycle node, once; returns whether the node made the
    /// transition. After [`GraphError::NoAnswer`] the node may have made the transition: ask for
    /// its state.
    pub async fn change_state(
        &self,
        node: &GraphName,
        transition: Transition,
        within: Duration,
    ) -> Result<bool, GraphError> {
        self.while_open(lifecycle::change(&self.shared.clients, node, transition, within)).await
    }

    /// All parameters of this node. `within` applies to each of the calls that this takes.
    pub async fn parameters(
        &self,
        node: &GraphName,
        within: Duration,
    ) -> Result<Vec<(String, ParameterValue)>, GraphError> {
        let names = self.while_open(parameters::list(&self.shared.clients, node, within)).await?;
        let values =
            self.while_open(parameters::get(&self.shared.clients, node, &names, within)).await?;
        Ok(names.into_iter().zip(values).collect())
    }

    /// One parameter of this node; [`ParameterValue::NotSet`] where the node has none of that name.
    pub async fn parameter(
        &self,
        node: &GraphName,
        name: &str,
        within: Duration,
    ) -> Result<ParameterValue, GraphError> {
        let values = self
            .while_open(parameters::get(&self.shared.clients, node, &[name.to_owned()], within))
            .await?;
        Ok(values.into_iter().next().unwrap_or(ParameterValue::NotSet))
    }

    /// Sets these parameters, each independently; returns the result of each, in their order.
    pub async fn set_parameters(
        &self,
        node: &GraphName,
        parameters: Vec<(String, ParameterValue)>,
        within: Duration,
    ) -> Result<Vec<SetResult>, GraphError> {
        self.while_open(parameters::set(&self.shared.clients, node, parameters, within)).await
    }

    /// Log lines of nodes, from now on. The first subscriber also gets the last lines from before,
    /// because nodes keep them. A receiver that is too slow is told how many lines it missed.
    pub fn rosout(&self) -> Result<broadcast::Receiver<Arc<RosoutLine>>, GraphError> {
        let Shared { feeds, endpoints, snapshot, tasks, .. } = &*self.shared;
        let (receiver, running) = feeds.rosout(endpoints, snapshot.clone(), &tasks.closing)?;
        running.map(|running| tasks.tracker.spawn(running));
        Ok(receiver)
    }

    /// Diagnostics that nodes publish about the robot's parts, from now on.
    pub fn diagnostics(&self) -> Result<broadcast::Receiver<Arc<DiagnosticStatus>>, GraphError> {
        let Shared { feeds, endpoints, tasks, .. } = &*self.shared;
        let (receiver, running) = feeds.diagnostics(endpoints, &tasks.closing)?;
        running.map(|running| tasks.tracker.spawn(running));
        Ok(receiver)
    }

    /// Counts the messages of this topic with the type `kind`, whatever the QoS settings of its
    /// publishers.
    pub fn rate(&self, topic: &GraphName, kind: &str) -> Result<Counter, GraphError> {
        let dds_kind = names::type_to_dds(Role::Topic, kind)
            .ok_or_else(|| GraphError::Kind(kind.to_owned()))?;
        let topic = names::to_dds(Role::Topic, topic);
        let reader = self.shared.endpoints.reader(&topic, &dds_kind, Delivery::BestEffort)?;
        let (counter, counting) = Counter::new(reader, &self.shared.tasks.closing);
        self.shared.tasks.tracker.spawn(counting);
        Ok(counter)
    }

    /// The result of `call`, or an error as soon as the graph is closed.
    async fn while_open<T>(
        &self,
        call: impl Future<Output = Result<T, GraphError>>,
    ) -> Result<T, GraphError> {
        self.shared.tasks.closing.run_until_cancelled(call).await.unwrap_or(Err(GraphError::Closed))
    }

    /// Leaves the graph. Other handles receive no more changes.
    pub async fn close(self) {
        self.shared.tasks.closing.cancel();
        self.shared.tasks.tracker.close();
        self.shared.tasks.tracker.wait().await;
        // If this was the last handle, the graph is dropped here, where blocking is allowed.
        let _ = tokio::task::spawn_blocking(move || drop(self)).await;
    }
}

impl Drop for Tasks {
    fn drop(&mut self) {
        self.closing.cancel();
        let participant = self.participant.take();
        if let Ok(runtime) = Handle::try_current() {
            runtime.spawn_blocking(move || drop(participant));
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use ros2_client::dds::rustdds::RTPSEntity;

    use super::*;
    use crate::ros::graph::EndpointId;
    use crate::ros::graph::dds::endpoint::{MAX_MESSAGE_BYTES, Writer};
    use crate::ros::graph::dds::entities::{NodeEntities, ParticipantEntities};

    const DOMAIN: u16 = 96;

    fn participant() -> DomainParticipant {
        let builder = DomainParticipantBuilder::new(DOMAIN);
        builder.with_only_networks([IpAddr::V4(Ipv4Addr::LOCALHOST)]).build().expect("participant")
    }

    async fn open(node_name: &str) -> LocalGraph {
        let node_name = node_name.parse().expect("name");
        let settings =
            GraphSettings { domain_id: DOMAIN, localhost_only: true, node_name, distro: None };
        LocalGraph::open(&settings).await.expect("graph")
    }

    async fn shows(graph: &LocalGraph, node: &str) -> Arc<Snapshot> {
        let node: GraphName = node.parse().expect("name");
        let mut changes = graph.changes();
        let found = changes.wait_for(|snapshot| snapshot.named(&node).next().is_some());
        let found = tokio::time::timeout(Duration::from_secs(60), found).await;
        found.unwrap_or_else(|_| panic!("not within a minute: {node}")).expect("open").clone()
    }

    fn says(writer: &Writer, participant: ParticipantId, node: &str, form: GidForm) {
        let name = node.parse().expect("name");
        let readers = Vec::new();
        let writers = Vec::new();
        let nodes = vec![NodeEntities { name, readers, writers }];
        let entities = ParticipantEntities { participant, nodes, misnamed: 0 };
        writer.put(Cdr::little_endian(entities.encode(form)));
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn both_forms_are_read_and_garbage_and_foreign_claims_are_ignored() {
        let graph = open("/hearer").await;
        let victim = open("/victim").await;
        let stolen = shows(&graph, "/victim").await.nodes[0].participant;
        let forger = participant();
        let own = EndpointId::of(forger.guid()).participant();
        let endpoints = Endpoints::of(&forger).expect("endpoints");
        let lasting = Delivery::Lasting { depth: 500 };
        let writer = endpoints
            .writer(names::DISCOVERY_TOPIC, names::DISCOVERY_TYPE, lasting)
            .expect("writer");
        for length in (0..2000).step_by(7) {
            let byte = |at: usize| u8::try_from((length * 31 + at * 17) % 256).expect("a byte");
            writer.put(Cdr::little_endian((0..length).map(byte).collect()));
        }
        writer.put(Cdr::little_endian(vec![0xff; 2 * MAX_MESSAGE_BYTES]));
        says(&writer, stolen, "/stolen", GidForm::Bytes16);
        // Messages of one writer keep their order: once this message shows, the earlier ones have
        // been processed.
        for (node, form) in
            [("/old", GidForm::Bytes24), ("/new", GidForm::Bytes16), ("/older", GidForm::Bytes24)]
        {
            says(&writer, own, node, form);
            let snapshot = shows(&graph, node).await;
            let names: Vec<_> = snapshot.nodes.iter().map(|node| node.name.as_str()).collect();
            assert_eq!(names, if node < "/victim" { [node, "/victim"] } else { ["/victim", node] });
        }
        victim.close().await;
    }
}
