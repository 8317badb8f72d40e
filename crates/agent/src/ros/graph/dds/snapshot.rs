//! The state of the graph at one moment: participants and nodes with their endpoints. It combines
//! the participants' messages about their nodes with discovery's data about readers and writers.
//! This module has values only and makes no queries.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::net::SocketAddr;
use std::time::Instant;

use ros2_client::dds::rustdds::GUID;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use task_proto::telemetry::ros::{Endpoint, GraphName};

use super::entities::ParticipantEntities;
use super::names::{self, Role};

/// Maximum number of nodes in a snapshot; further nodes are counted.
pub const MAX_NODES: usize = 2048;

/// Id of a DDS participant: a process has one, or a few.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ParticipantId(pub [u8; 12]);

/// Id of a reader or writer of a participant.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct EndpointId(pub [u8; 16]);

/// The graph at one moment.
#[derive(Debug, Clone)]
pub struct Snapshot {
    /// Time at which this state was known to be current.
    pub at: Instant,
    /// The nodes, sorted by name. Names are not unique: two nodes may have the same name. The
    /// agent's own node is not included.
    pub nodes: Vec<Node>,
    /// The participants, including those without nodes, without the agent's own.
    pub participants: BTreeMap<ParticipantId, Participant>,
    /// Number of nodes that were left out: beyond the limit, or with a name that ROS does not
    /// allow.
    pub omitted: usize,
}

/// A node of the graph.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Node {
    /// The node's full name.
    pub name: GraphName,
    /// The participant of the node.
    pub participant: ParticipantId,
    /// The topics that the node publishes.
    #[serde(default)]
    pub publishers: Vec<Endpoint>,
    /// The topics that the node subscribes to.
    #[serde(default)]
    pub subscriptions: Vec<Endpoint>,
    /// The services that the node offers.
    #[serde(default)]
    pub services: Vec<Endpoint>,
    /// The services that the node calls.
    #[serde(default)]
    pub clients: Vec<Endpoint>,
}

/// A participant of the graph.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Participant {
    /// The UDP addresses that the participant announces and listens at.
    pub locators: BTreeSet<SocketAddr>,
    /// Time at which the agent first saw the participant: one that was seen before a process was
    /// started does not belong to that process.
    pub first_seen: Instant,
}

/// A reader or writer in discovery's data.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Discovered {
    pub id: EndpointId,
    /// The endpoint's DDS topic.
    pub topic: String,
    /// The endpoint's DDS type.
    pub kind: String,
    /// The addresses that the endpoint listens at.
    pub locators: Vec<SocketAddr>,
}

/// The direction of an endpoint's data.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Direction {
    Reads,
    Writes,
}

impl Snapshot {
    pub fn empty(at: Instant) -> Self {
        Self { at, nodes: Vec::new(), participants: BTreeMap::new(), omitted: 0 }
    }

    /// Combines the participants' messages with discovery's data. The snapshot leaves out
    /// participants that discovery has lost, and nodes that no participant announces.
    pub fn of(
        at: Instant,
        entities: &BTreeMap<ParticipantId, ParticipantEntities>,
        first_seen: &BTreeMap<ParticipantId, Instant>,
        readers: &[Discovered],
        writers: &[Discovered],
    ) -> Self {
        let mut snapshot = Self::empty(at);
        for endpoint in readers.iter().chain(writers) {
            let id = endpoint.id.participant();
            let first_seen = first_seen.get(&id).copied().unwrap_or(at);
            let participant = snapshot
                .participants
                .entry(id)
                .or_insert(Participant { locators: BTreeSet::new(), first_seen });
            participant.locators.extend(&endpoint.locators);
        }
        let endpoints =
            by_id(readers, Direction::Reads).chain(by_id(writers, Direction::Writes)).collect();
        for (id, listed) in entities.iter().filter(|(id, _)| snapshot.participants.contains_key(id))
        {
            snapshot.omitted += listed.misnamed;
            for node in &listed.nodes {
                if snapshot.nodes.len() == MAX_NODES {
                    snapshot.omitted += 1;
                } else {
                    let ids = node.readers.iter().chain(&node.writers);
                    snapshot.nodes.push(Node::of(node.name.clone(), *id, ids, &endpoints));
                }
            }
        }
        snapshot.nodes.sort();
        snapshot
    }

    /// Whether the snapshot shows the same graph as `other`, regardless of the time.
    pub fn has_same_content(&self, other: &Self) -> bool {
        self.nodes == other.nodes
            && self.participants == other.participants
            && self.omitted == other.omitted
    }

    /// The nodes of this name.
    pub fn named(&self, name: &GraphName) -> impl Iterator<Item = &Node> {
        self.nodes.iter().filter(move |node| node.name == *name)
    }

    /// The nodes that offer this service.
    pub fn servers_of(&self, service: &GraphName) -> impl Iterator<Item = &Node> {
        self.nodes
            .iter()
            .filter(move |node| node.services.iter().any(|offered| offered.name == *service))
    }

    /// The nodes that publish this topic.
    pub fn publishers_of(&self, topic: &GraphName) -> impl Iterator<Item = &Node> {
        self.nodes
            .iter()
            .filter(move |node| node.publishers.iter().any(|published| published.name == *topic))
    }
}

type Endpoints<'a> = BTreeMap<EndpointId, (Direction, &'a Discovered)>;

fn by_id(
    endpoints: &[Discovered],
    direction: Direction,
) -> impl Iterator<Item = (EndpointId, (Direction, &Discovered))> {
    endpoints.iter().map(move |endpoint| (endpoint.id, (direction, endpoint)))
}

impl Node {
    fn of<'a>(
        name: GraphName,
        participant: ParticipantId,
        ids: impl Iterator<Item = &'a EndpointId>,
        endpoints: &Endpoints<'_>,
    ) -> Self {
        let (publishers, subscriptions, services, clients) = Default::default();
        let mut node = Self { name, participant, publishers, subscriptions, services, clients };
        for (direction, endpoint) in ids.filter_map(|id| endpoints.get(id)) {
            let Some((role, name)) = names::from_dds(&endpoint.topic) else { continue };
            let Some(kind) = names::type_from_dds(role, &endpoint.kind) else { continue };
            // Of a service's two topics, the request topic tells client and server apart.
            let list = match (role, direction) {
                (Role::Topic, Direction::Writes) => &mut node.publishers,
                (Role::Topic, Direction::Reads) => &mut node.subscriptions,
                (Role::Request, Direction::Reads) => &mut node.services,
                (Role::Request, Direction::Writes) => &mut node.clients,
                (Role::Reply, _) => continue,
            };
            list.push(Endpoint { name, kind });
        }
        for list in
            [&mut node.publishers, &mut node.subscriptions, &mut node.services, &mut node.clients]
        {
            list.sort();
            list.dedup();
        }
        node
    }

    /// Whether the node offers the service for its lifecycle state. A node that has just appeared
    /// may not have announced the service yet.
    pub fn has_lifecycle(&self) -> bool {
        let service_name = format!("{}/get_state", self.name);
        self.services.iter().any(|service| {
            service.name.as_str() == service_name && service.kind == "lifecycle_msgs/srv/GetState"
        })
    }
}

impl ParticipantId {
    /// The participant's id in the form of an endpoint id, as in gids.
    pub fn of_participant(self) -> EndpointId {
        let mut id = [0; 16];
        id[..12].copy_from_slice(&self.0);
        id[12..].copy_from_slice(&[0, 0, 1, 0xc1]);
        EndpointId(id)
    }

    /// Whether the participant's DDS is Eclipse Cyclone, which frames services in its own way.
    pub fn is_cyclone(self) -> bool {
        self.0.starts_with(&[0x01, 0x10])
    }
}

impl EndpointId {
    /// The participant of the endpoint.
    pub fn participant(self) -> ParticipantId {
        let mut id = [0; 12];
        id.copy_from_slice(&self.0[..12]);
        ParticipantId(id)
    }

    pub(in crate::ros::graph) fn of(guid: GUID) -> Self {
        Self(guid.to_bytes())
    }
}

impl fmt::Display for ParticipantId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl fmt::Debug for ParticipantId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

impl Serialize for ParticipantId {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for ParticipantId {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)?;
        let digits = text.as_bytes();
        let invalid = || serde::de::Error::custom("a participant's id has 24 hexadecimal digits");
        let mut id = [0; 12];
        if digits.len() != 2 * id.len() || !digits.iter().all(u8::is_ascii_hexdigit) {
            return Err(invalid());
        }
        for (byte, digits) in id.iter_mut().zip(digits.chunks(2)) {
            let digits = std::str::from_utf8(digits).map_err(|_| invalid())?;
            *byte = u8::from_str_radix(digits, 16).map_err(|_| invalid())?;
        }
        Ok(Self(id))
    }
}

impl fmt::Debug for EndpointId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}
