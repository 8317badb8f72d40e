//! The single task that listens to discovery. It owns the participants' messages about their nodes
//! and the matches of remote endpoints with ours. It publishes snapshots and wakes the tasks that
//! wait for a change.
//!
//! The DDS library's events are not enough. A killed process sends nothing, so its participant is
//! lost only when its lease ends (Fast DDS: 20 s), and events are dropped when too many come at
//! once. So the observer also examines everything every few seconds.

use std::collections::{BTreeMap, BTreeSet};
use std::pin::pin;
use std::sync::Arc;
use std::time::Duration;

use futures_util::StreamExt;
use ros2_client::dds::rustdds::discovery::{DiscoveredReaderData, DiscoveredWriterData};
use ros2_client::dds::rustdds::{
    DomainParticipant, DomainParticipantStatusEvent as Event, RTPSEntity, StatusEvented,
};
use tokio::sync::watch;
use tokio::time::{Instant, MissedTickBehavior, interval, sleep_until};
use tokio_util::sync::CancellationToken;

use super::endpoint::{Cdr, Reader, Sample};
use super::entities::ParticipantEntities;
use super::snapshot::{Discovered, Snapshot};
use crate::ros::graph::{EndpointId, ParticipantId};
use crate::system::clock;

/// Changes within this time become one snapshot.
const DEBOUNCE: Duration = Duration::from_millis(50);
/// Interval between full examinations without an event.
const AUDIT_INTERVAL: Duration = Duration::from_secs(3);
/// Time for which a participant without endpoints is remembered.
const NEW_PARTICIPANT_MEMORY: Duration = Duration::from_secs(60);
/// Maximum number of readers, and of writers, that are examined.
const MAX_DISCOVERED: usize = 20_000;
/// Maximum number of participants about which data is remembered.
const MAX_PARTICIPANTS: usize = 1024;
/// Maximum backward correction of the wall clock between two examinations: a larger one counts as a
/// step.
const MAX_CORRECTION_MS: u64 = 1000;
/// Maximum number of addresses of one endpoint.
const MAX_LOCATORS: usize = 16;

/// The remote endpoints that are matched with each of ours.
#[derive(Debug, Default)]
pub struct Matches {
    remotes: BTreeMap<EndpointId, BTreeSet<EndpointId>>,
}

/// Readings of the clocks, in milliseconds.
#[derive(Debug, Clone, Copy)]
struct Clocks {
    wall_ms: u64,
    boot_ms: u64,
}

/// The observer; see the module.
pub struct Observer {
    participant: DomainParticipant,
    own: ParticipantId,
    entities: BTreeMap<ParticipantId, ParticipantEntities>,
    first_seen: BTreeMap<ParticipantId, std::time::Instant>,
    snapshot: watch::Sender<Arc<Snapshot>>,
    matches: watch::Sender<Matches>,
}

impl Matches {
    /// The participants matched with both of our endpoints: they can receive the request, and we
    /// their answer.
    pub fn with_both(&self, writer: EndpointId, reader: EndpointId) -> BTreeSet<ParticipantId> {
        let participants = |own| -> BTreeSet<_> {
            self.remotes
                .get(&own)
                .into_iter()
                .flatten()
                .map(|remote| remote.participant())
                .collect()
        };
        &participants(writer) & &participants(reader)
    }

    /// Forgets one of our endpoints that is gone.
    pub fn forget(&mut self, own: EndpointId) {
        self.remotes.remove(&own);
    }
}

impl Clocks {
    fn read() -> Self {
        Self { wall_ms: clock::wall_ms(), boot_ms: clock::boot_ms() }
    }

    fn was_set_back_since(self, before: Self) -> bool {
        let passed_ms = self.boot_ms.saturating_sub(before.boot_ms);
        self.wall_ms + MAX_CORRECTION_MS < before.wall_ms + passed_ms
    }
}

impl Observer {
    /// An observer for this participant; it sees nothing before [`Self::run`].
    pub fn new(
        participant: DomainParticipant,
        snapshot: watch::Sender<Arc<Snapshot>>,
        matches: watch::Sender<Matches>,
    ) -> Self {
        let own = EndpointId::of(participant.guid()).participant();
        Self {
            participant,
            own,
            entities: BTreeMap::new(),
            first_seen: BTreeMap::new(),
            snapshot,
            matches,
        }
    }

    /// Listens until `closing`, until the DDS library ends, or until the wall clock is set back.
    /// After such a step the library withholds data that it receives by best effort, such as
    /// announcements of new participants, until the clock shows the former time again. A new
    /// participant is not affected by that time.
    pub async fn run(mut self, discovery: Reader<Cdr>, closing: CancellationToken) {
        let listener = self.participant.status_listener();
        let mut events = pin!(listener.as_async_status_stream());
        let mut samples = pin!(discovery.samples());
        let mut audit = interval(AUDIT_INTERVAL);
        audit.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let (mut due, mut clocks): (Option<Instant>, _) = (None, Clocks::read());
        loop {
            // Each branch may be dropped while it waits: streams and timers keep their data.
            tokio::select! {
                () = closing.cancelled() => return,
                event = events.next() => {
                    let Some(event) = event else { return };
                    if self.handle_event(event) {
                        due.get_or_insert_with(|| Instant::now() + DEBOUNCE);
                    }
                }
                Some(sample) = samples.next() => {
                    self.handle_entities(&sample);
                    due.get_or_insert_with(|| Instant::now() + DEBOUNCE);
                }
                _ = audit.tick() => {
                    let before = std::mem::replace(&mut clocks, Clocks::read());
                    if clocks.was_set_back_since(before) {
                        tracing::warn!("the clock was set back; rejoining the ROS graph");
                        return;
                    }
                    due = Some(Instant::now());
                }
                () = sleep_until(due.unwrap_or_else(Instant::now)), if due.is_some() => {
                    due = None;
                    self.publish_snapshot();
                }
            }
        }
    }

    /// Processes an event of the DDS library; returns whether the graph may have changed.
    fn handle_event(&mut self, event: Event) -> bool {
        match event {
            Event::RemoteReaderMatched { local_writer: own, remote_reader: remote }
            | Event::RemoteWriterMatched { local_reader: own, remote_writer: remote } => {
                let own = EndpointId::of(own);
                let remote = EndpointId::of(remote);
                self.matches.send_if_modified(|matches| {
                    matches.remotes.entry(own).or_default().insert(remote)
                });
                false
            }
            Event::ReaderLost { guid, .. } | Event::WriterLost { guid, .. } => {
                let lost = EndpointId::of(guid);
                self.unmatch(|remote| *remote == lost);
                true
            }
            Event::ParticipantLost { id, .. } => {
                let lost = ParticipantId(prefix(id.as_ref()));
                self.unmatch(|remote| remote.participant() == lost);
                self.first_seen.remove(&lost);
                true
            }
            Event::ParticipantDiscovered { dpd } => {
                let seen = EndpointId::of(dpd.guid).participant();
                if self.first_seen.len() < MAX_PARTICIPANTS {
                    self.first_seen.entry(seen).or_insert_with(std::time::Instant::now);
                }
                true
            }
            Event::ReaderDetected { .. } | Event::WriterDetected { .. } => true,
            _ => false,
        }
    }

    fn unmatch(&self, lost: impl Fn(&EndpointId) -> bool) {
        self.matches.send_if_modified(|matches| {
            let before: usize = matches.remotes.values().map(BTreeSet::len).sum();
            matches.remotes.values_mut().for_each(|remotes| remotes.retain(|remote| !lost(remote)));
            let after: usize = matches.remotes.values().map(BTreeSet::len).sum();
            before != after
        });
    }

    /// Processes a participant's message about its nodes. No participant may speak for another.
    fn handle_entities(&mut self, sample: &Sample<Cdr>) {
        let from = sample.writer.participant();
        if from == self.own {
            return;
        }
        match ParticipantEntities::decode(&sample.message.body, sample.message.is_little_endian()) {
            Ok((entities, _form)) if entities.participant == from => {
                if self.entities.len() < MAX_PARTICIPANTS || self.entities.contains_key(&from) {
                    self.entities.insert(from, entities);
                }
            }
            Ok((entities, _form)) => {
                tracing::debug!(%from, of = %entities.participant, "ignored a message of a participant about another participant");
            }
            Err(error) => {
                tracing::debug!(%from, error = %error, "a participant's nodes cannot be read")
            }
        }
    }

    /// Examines all data of discovery, forgets lost entities and publishes the resulting snapshot.
    fn publish_snapshot(&mut self) {
        let readers = self.participant.discovered_readers();
        let writers = self.participant.discovered_writers();
        let readers = self.ros_endpoints(readers.iter().map(discovered_reader));
        let writers = self.ros_endpoints(writers.iter().map(discovered_writer));
        let now = std::time::Instant::now();
        let present: BTreeSet<_> =
            readers.iter().chain(&writers).map(|endpoint| endpoint.id.participant()).collect();
        self.entities.retain(|id, _| present.contains(id));
        // A participant is seen before its endpoints are.
        self.first_seen.retain(|id, seen| {
            present.contains(id) || now.duration_since(*seen) < NEW_PARTICIPANT_MEMORY
        });
        for id in present.iter().take(MAX_PARTICIPANTS) {
            self.first_seen.entry(*id).or_insert(now);
        }
        self.unmatch(|remote| {
            !present.contains(&remote.participant()) && remote.participant() != self.own
        });
        let seen = Snapshot::of(now, &self.entities, &self.first_seen, &readers, &writers);
        self.snapshot.send_if_modified(|current| {
            let changed = !seen.has_same_content(current);
            *current = Arc::new(seen);
            changed
        });
    }

    /// The endpoints of other ROS participants: the agent's own and DDS's built-in endpoints are
    /// ignored.
    fn ros_endpoints(&self, discovered: impl Iterator<Item = Discovered>) -> Vec<Discovered> {
        let is_ros = |endpoint: &Discovered| {
            endpoint.id.participant() != self.own
                && (endpoint.topic == super::names::DISCOVERY_TOPIC
                    || ["rt/", "rq/", "rr/"]
                        .iter()
                        .any(|prefix| endpoint.topic.starts_with(prefix)))
        };
        discovered.filter(is_ros).take(MAX_DISCOVERED).collect()
    }
}

fn discovered_reader(data: &DiscoveredReaderData) -> Discovered {
    let udp = data.reader_proxy.unicast_locator_list.iter().filter(|locator| locator.is_udp());
    Discovered {
        id: EndpointId::of(data.reader_proxy.remote_reader_guid),
        topic: data.subscription_topic_data.topic_name().clone(),
        kind: data.subscription_topic_data.type_name().clone(),
        locators: udp.take(MAX_LOCATORS).map(|locator| (*locator).into()).collect(),
    }
}

fn discovered_writer(data: &DiscoveredWriterData) -> Discovered {
    let udp = data.writer_proxy.unicast_locator_list.iter().filter(|locator| locator.is_udp());
    Discovered {
        id: EndpointId::of(data.writer_proxy.remote_writer_guid),
        topic: data.publication_topic_data.topic_name.clone(),
        kind: data.publication_topic_data.type_name.clone(),
        locators: udp.take(MAX_LOCATORS).map(|locator| (*locator).into()).collect(),
    }
}

fn prefix(bytes: &[u8]) -> [u8; 12] {
    let mut prefix = [0; 12];
    let length = bytes.len().min(12);
    prefix[..length].copy_from_slice(&bytes[..length]);
    prefix
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clock_step_back_is_noticed_but_a_small_correction_is_not() {
        let before = Clocks { wall_ms: 1_000_000, boot_ms: 50_000 };
        let fell_back =
            |wall_ms: u64, boot_ms: u64| Clocks { wall_ms, boot_ms }.was_set_back_since(before);
        assert!(!fell_back(1_003_000, 53_000));
        assert!(!fell_back(1_002_100, 53_000), "slewed");
        assert!(!fell_back(9_000_000, 53_000), "set forward");
        assert!(fell_back(1_001_000, 53_000));
        assert!(fell_back(0, 53_000));
        // The machine was suspended in between: both clocks went on.
        assert!(!fell_back(8_203_000, 7_253_000));
    }
}
