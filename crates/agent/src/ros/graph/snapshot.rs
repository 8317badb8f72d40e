//! What the graph shows at one moment: participants and nodes with their endpoints, put together
//! from what participants say about their nodes and what discovery says about readers and writers.
//! Values only; it asks nobody.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::net::SocketAddr;
use std::time::Instant;

use ros2_client::dds::rustdds::GUID;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use task_proto::ros::{Endpoint, GraphName};

use super::entities::ParticipantEntities;
use super::names::{self, Role};

/// The most nodes in a snapshot; the rest are counted.
pub const MAX_NODES: usize = 2048;

/// A DDS participant: a process has one, or a few.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ParticipantId(pub [u8; 12]);

/// A reader or writer of a participant.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct EndpointId(pub [u8; 16]);

/// The graph at one moment.
#[derive(Debug, Clone)]
pub struct Snapshot {
    /// When it was known to be so.
    pub at: Instant,
    /// The nodes, sorted by name. Names are not unique: two nodes may have the same. The agent's
    /// own node is not among them.
    pub nodes: Vec<Node>,
    /// The participants, also those without nodes, without the agent's own.
    pub participants: BTreeMap<ParticipantId, Participant>,
    /// Nodes that were left out: beyond the limit, or with a name that ROS does not allow.
    pub omitted: usize,
}

/// A node of the graph.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Node {
    /// Its full name.
    pub name: GraphName,
    /// The participant it is in.
    pub participant: ParticipantId,
    /// The topics it publishes.
    #[serde(default)]
    pub publishers: Vec<Endpoint>,
    /// The topics it subscribes to.
    #[serde(default)]
    pub subscriptions: Vec<Endpoint>,
    /// The services it offers.
    #[serde(default)]
    pub services: Vec<Endpoint>,
    /// The services it calls.
    #[serde(default)]
    pub clients: Vec<Endpoint>,
}

/// A participant of the graph.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Participant {
    /// Where it listens: the UDP addresses it announces.
    pub locators: BTreeSet<SocketAddr>,
    /// When the agent first saw it: what was there before a process was started is none of that
    /// process's.
    pub first_seen: Instant,
}

/// A reader or writer as discovery has it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Discovered {
    /// Its id.
    pub id: EndpointId,
    /// Its DDS topic.
    pub topic: String,
    /// Its DDS type.
    pub kind: String,
    /// Where it listens.
    pub locators: Vec<SocketAddr>,
}

/// Which way an endpoint's data goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Direction {
    Reads,
    Writes,
}

impl Snapshot {
    /// An empty one.
    pub fn empty(at: Instant) -> Self {
        Self { at, nodes: Vec::new(), participants: BTreeMap::new(), omitted: 0 }
    }

    /// Put together from what participants said, and what discovery has. A participant that
    /// discovery has lost, and nodes of which nobody speaks, are not in it.
    pub fn of(
        at: Instant,
        said: &BTreeMap<ParticipantId, ParticipantEntities>,
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
        for (id, entities) in said.iter().filter(|(id, _)| snapshot.participants.contains_key(id)) {
            snapshot.omitted += entities.misnamed;
            for node in &entities.nodes {
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

    /// Whether it shows the same as `other`, at whatever time.
    pub fn shows_the_same_as(&self, other: &Self) -> bool {
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
            // Of a service's two ways the requests' shows who is who.
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

    /// Whether it can be asked for its lifecycle state. A node that has just appeared may not have
    /// said so yet.
    pub fn has_lifecycle(&self) -> bool {
        let wanted = format!("{}/get_state", self.name);
        self.services.iter().any(|service| {
            service.name.as_str() == wanted && service.kind == "lifecycle_msgs/srv/GetState"
        })
    }
}

impl ParticipantId {
    /// Its id as an endpoint's, as in gids.
    pub fn of_participant(self) -> EndpointId {
        let mut id = [0; 16];
        id[..12].copy_from_slice(&self.0);
        id[12..].copy_from_slice(&[0, 0, 1, 0xc1]);
        EndpointId(id)
    }

    /// Whether its DDS is Eclipse Cyclone, which frames services in its own way.
    pub fn is_cyclone(self) -> bool {
        self.0.starts_with(&[0x01, 0x10])
    }
}

impl EndpointId {
    /// The participant it belongs to.
    pub fn participant(self) -> ParticipantId {
        let mut id = [0; 12];
        id.copy_from_slice(&self.0[..12]);
        ParticipantId(id)
    }

    pub(super) fn of(guid: GUID) -> Self {
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
