//! Decides when a run of a task counts as running. It compares the promises in `[ready]` and
//! `[parameters]` with the part of the robot's ROS graph that belongs to the run's own processes.
//! Pure: its inputs are observations and answers, its outputs are the next requests and the run's
//! health. It touches neither ROS nor clocks.

use std::collections::{BTreeMap, BTreeSet};

use serde_json::Value;
use task_proto::messages::report::{Failure, FailureCode};
use task_proto::packages::manifest::TaskManifest;
use task_proto::telemetry::ros::{GraphName, LifecycleState};

use crate::ros::graph::{Node, ParticipantId, Snapshot};
use crate::task::observed::{Health, Missing};

mod bring_up;
mod rate;
#[cfg(test)]
mod tests;

use bring_up::BringUp;
pub use bring_up::{Answer, NodeRequest, RequestKind};
use rate::Rate;

/// Grace period for an entity that goes missing from a graph that was complete: discovery has short
/// gaps.
const GRACE_MS: u64 = 2000;
/// Time for which a node of another owner must exist before it counts: determining the owner of a
/// new participant takes a moment.
const CONFLICT_MS: u64 = 1000;
/// Time without any answer after which a node that is up counts as inactive.
const SILENCE_MS: u64 = 10_000;
/// Maximum number of graph names that a text lists.
const MAX_LISTED: usize = 20;

/// A package's promises about the ROS graph.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Promise {
    /// All nodes that must exist, including those with lifecycle and parameters.
    pub nodes: BTreeSet<GraphName>,
    /// Lifecycle nodes that are brought to active.
    pub lifecycle: BTreeSet<GraphName>,
    /// Services that must answer.
    pub services: BTreeSet<GraphName>,
    /// Topics with a publisher, some with a minimum rate.
    pub topics: BTreeMap<GraphName, Option<f64>>,
    /// Parameters by node.
    pub parameters: BTreeMap<GraphName, BTreeMap<String, Value>>,
    /// Seconds for which all promises must hold.
    pub hold_s: u32,
}

/// The graph and the ownership of its participants. A participant that is in none of the three sets
/// does not count: discovery's data about it may be long outdated.
#[derive(Debug, Clone, Copy)]
pub struct Observation<'a> {
    /// The graph.
    pub snapshot: &'a Snapshot,
    /// The participants of the run's processes.
    pub ours: &'a BTreeSet<ParticipantId>,
    /// Living participants of other owners, each with a description.
    pub others: &'a BTreeMap<ParticipantId, String>,
    /// Participants of processes that are known to be gone.
    pub gone: &'a BTreeSet<ParticipantId>,
    /// Number of messages received on each topic with a minimum rate.
    pub counts: &'a BTreeMap<GraphName, u64>,
}

/// One thing that was promised.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
enum Item {
    Node(GraphName),
    Parameters(GraphName),
    Lifecycle(GraphName),
    Service(GraphName),
    Topic(GraphName),
    UniqueName(GraphName),
}

/// A promise that does not hold.
#[derive(Debug, Clone, PartialEq)]
struct Shortfall {
    item: Item,
    /// The failure code for a task that ran before.
    code: FailureCode,
    /// A description to which "within 30 s" can be appended.
    what: String,
    /// The state found instead, or empty.
    seen: String,
    /// The shortfall needs no confirmation by a second observation.
    certain: bool,
}

/// Duration of a shortfall.
#[derive(Debug, Clone)]
struct OngoingShortfall {
    since_ms: u64,
    /// The shortfall in its first wording, so that a text does not change with every figure.
    reported: Option<Shortfall>,
}

/// The health of one run on the graph.
#[derive(Debug, Clone)]
pub struct Readiness {
    promise: Promise,
    /// An earlier agent brought the run up.
    adopted: bool,
    /// All promises have held for `hold_s` once.
    was_ready: bool,
    nodes: BTreeMap<GraphName, BringUp>,
    rates: BTreeMap<GraphName, Rate>,
    lasting: BTreeMap<Item, OngoingShortfall>,
    health: Health,
}

impl Promise {
    /// The promises of this manifest; its names were checked when the manifest was made.
    pub fn of(manifest: &TaskManifest) -> Self {
        let ready = &manifest.ready;
        let names = |texts: &[String]| {
            texts.iter().filter_map(|text| text.parse().ok()).collect::<BTreeSet<GraphName>>()
        };
        let parameters = manifest.parameters.iter();
        let parameters: BTreeMap<GraphName, _> = parameters
            .filter_map(|(node, values)| Some((node.parse().ok()?, values.clone())))
            .collect();
        let lifecycle = names(&ready.lifecycle);
        let topics = ready.topics.iter();
        Self {
            nodes: names(&ready.nodes)
                .into_iter()
                .chain(lifecycle.clone())
                .chain(parameters.keys().cloned())
                .collect(),
            lifecycle,
            services: names(&ready.services),
            topics: topics
                .filter_map(|(name, topic)| Some((name.parse().ok()?, topic.min_hz)))
                .collect(),
            parameters,
            hold_s: ready.hold_s,
        }
    }

    /// Whether nothing is promised, so that a living process is enough to count as running.
    pub fn is_empty(&self) -> bool {
        self.nodes.is_empty() && self.services.is_empty() && self.topics.is_empty()
    }

    /// The reason why the run can't be started: a living process already has one of its names.
    pub fn name_conflict(
        &self,
        snapshot: &Snapshot,
        others: &BTreeMap<ParticipantId, String>,
    ) -> Option<Failure> {
        let texts: Vec<String> = self
            .name_conflicts(snapshot, others)
            .map(|(name, owner)| describe_conflict(name, &owner))
            .collect();
        (!texts.is_empty()).then(|| Failure::new(FailureCode::NODE_NAME_TAKEN, texts.join("; ")))
    }

    /// The participants of other owners that have a promised name.
    pub fn conflicting_participants(
        &self,
        snapshot: &Snapshot,
        others: &BTreeMap<ParticipantId, String>,
    ) -> BTreeSet<ParticipantId> {
        let named = self.nodes.iter().flat_map(|name| snapshot.named(name));
        let offering = self.services.iter().flat_map(|name| snapshot.servers_of(name));
        named
            .chain(offering)
            .map(|node| node.participant)
            .filter(|id| others.contains_key(id))
            .collect()
    }

    /// Promised names that other owners have, with those owners.
    fn name_conflicts<'a>(
        &'a self,
        snapshot: &'a Snapshot,
        others: &'a BTreeMap<ParticipantId, String>,
    ) -> impl Iterator<Item = (&'a GraphName, String)> {
        let nodes = self.nodes.iter().filter_map(|name| {
            let owner = snapshot.named(name).find_map(|node| others.get(&node.participant))?;
            Some((name, format!("{owner} has a node of that name")))
        });
        let services = self.services.iter().filter_map(|name| {
            let offered = |node: &Node| Some((node.name.clone(), others.get(&node.participant)?));
            let (node, owner) = snapshot.servers_of(name).find_map(offered)?;
            Some((name, format!("`{node}` of {owner} offers that service")))
        });
        nodes.chain(services)
    }
}

impl Readiness {
    /// A run that has just been started, or one that an earlier agent saw ready.
    pub fn new(promise: Promise, was_ready: bool) -> Self {
        let rates = promise
            .topics
            .iter()
            .filter_map(|(topic, min_hz)| Some((topic.clone(), Rate::of((*min_hz)?))));
        Self {
            rates: rates.collect(),
            promise,
            adopted: was_ready,
            was_ready,
            nodes: BTreeMap::new(),
            lasting: BTreeMap::new(),
            health: Health::default(),
        }
    }

    /// The promises that the run is compared with.
    pub fn promise(&self) -> &Promise {
        &self.promise
    }

    /// The run's health, as of the last observation.
    pub fn health(&self) -> &Health {
        &self.health
    }

    /// The requests to send now; each is sent once, until its answer has come.
    pub fn requests(&mut self, now_ms: u64) -> Vec<NodeRequest> {
        self.nodes.values_mut().filter_map(|node| node.next_request(now_ms)).collect()
    }

    /// Records an answer; the next look takes it into account.
    pub fn record_answer(&mut self, request: &NodeRequest, answer: Answer, now_ms: u64) {
        if let Some(node) = self.nodes.get_mut(&request.node) {
            node.record_answer(request, answer, now_ms);
        }
    }

    /// Records an observation of the graph.
    pub fn observe(&mut self, observation: &Observation<'_>, now_ms: u64) {
        // Until this look all that was promised has held.
        self.was_ready |= self.has_held(now_ms);
        self.track_nodes(observation);
        for (topic, rate) in &mut self.rates {
            if let Some(count) = observation.counts.get(topic) {
                rate.record(*count, now_ms);
            }
        }
        let shortfalls = self.shortfalls(observation, now_ms);
        self.update_health(shortfalls, now_ms);
    }

    /// Notices nodes that are new, or that have returned in another process.
    fn track_nodes(&mut self, observation: &Observation<'_>) {
        let offer = self
            .promise
            .services
            .iter()
            .flat_map(|service| observation.snapshot.servers_of(service));
        let offering: BTreeSet<&GraphName> = offer
            .filter(|node| observation.ours.contains(&node.participant))
            .map(|node| &node.name)
            .collect();
        for name in self.promise.nodes.iter().chain(offering.iter().copied()) {
            let here = || {
                observation
                    .snapshot
                    .named(name)
                    .filter(|node| observation.ours.contains(&node.participant))
            };
            let known = self.nodes.get(name).map(BringUp::instance);
            let Some(first) = here().next() else { continue };
            if !here().any(|node| Some(node.participant) == known) {
                let lifecycle = self.promise.lifecycle.contains(name);
                let is_up = self.adopted && known.is_none();
                let parameters = self.promise.parameters.get(name);
                let node =
                    BringUp::new(name.clone(), first.participant, lifecycle, parameters, is_up);
                self.nodes.insert(name.clone(), node);
            }
            let answer_service = format!("{name}/get_parameters");
            let can_answer = here().any(|node| {
                node.services.iter().any(|service| service.name.as_str() == answer_service)
            });
            if let Some(node) =
                self.nodes.get_mut(name).filter(|_| offering.contains(name) && can_answer)
            {
                node.require_answer();
            }
        }
    }

    fn shortfalls(&self, observation: &Observation<'_>, now_ms: u64) -> Vec<Shortfall> {
        let conflicts = self.promise.name_conflicts(observation.snapshot, observation.others).map(
            |(name, seen)| Shortfall {
                item: Item::UniqueName(name.clone()),
                code: FailureCode::NODE_NAME_TAKEN,
                what: format!("`{name}` was not free"),
                seen,
                certain: false,
            },
        );
        let mut shortfalls: Vec<Shortfall> = conflicts.collect();
        for name in &self.promise.nodes {
            let here = observation
                .snapshot
                .named(name)
                .any(|node| observation.ours.contains(&node.participant));
            shortfalls.extend(if here {
                self.unprepared(name, now_ms)
            } else {
                Some(self.absent(name, observation))
            });
        }
        shortfalls.extend(
            self.promise.services.iter().filter_map(|name| self.unanswered(name, observation)),
        );
        shortfalls.extend(
            self.promise.topics.keys().filter_map(|name| self.unpublished(name, observation)),
        );
        shortfalls
    }

    fn absent(&self, name: &GraphName, observation: &Observation<'_>) -> Shortfall {
        let gone =
            self.nodes.get(name).is_some_and(|node| observation.gone.contains(&node.instance()));
        let (what, seen) = match self.was_ready {
            true => (
                format!("`{name}` left the graph"),
                if gone { "its process is gone" } else { "" }.to_owned(),
            ),
            false => (format!("`{name}` did not appear"), list_graph(observation.snapshot)),
        };
        Shortfall {
            item: Item::Node(name.clone()),
            code: FailureCode::NODE_VANISHED,
            what,
            seen,
            certain: gone,
        }
    }

    /// The shortfall of a node that exists.
    fn unprepared(&self, name: &GraphName, now_ms: u64) -> Option<Shortfall> {
        let node = self.nodes.get(name)?;
        let silent_ms = node.silent_since_ms().map(|since_ms| now_ms.saturating_sub(since_ms));
        // A node that returned in a new process counts as gone until it is up.
        let certain = !node.is_up();
        let shortfall = |item, code, what, seen: &str| {
            Some(Shortfall { item, code, what, seen: seen.to_owned(), certain })
        };
        if self.promise.lifecycle.contains(name) {
            let too_silent = silent_ms.is_some_and(|ms| ms >= SILENCE_MS);
            let active = node.state() == Some(LifecycleState::Active) && !too_silent;
            // Right after a restart of the agent nothing is known yet; that is no reason to doubt
            // the node.
            let unknown = self.was_ready && node.is_up() && node.state().is_none() && !too_silent;
            if !active && !unknown {
                let seen = match (node.state(), silent_ms) {
                    (_, Some(_)) => "it does not answer as a lifecycle node".to_owned(),
                    (Some(state), None) => format!("it is {}", state.as_str()),
                    (None, None) => "its state is not known yet".to_owned(),
                };
                let what = match self.was_ready {
                    true => format!("`{name}` is not active any more"),
                    false => format!("`{name}` did not become active"),
                };
                return shortfall(
                    Item::Lifecycle(name.clone()),
                    FailureCode::NODE_INACTIVE,
                    what,
                    &seen,
                );
            }
        }
        if node.has_all_parameters() {
            return None;
        }
        let seen = if silent_ms.is_some() { "its parameter services do not answer" } else { "" };
        let what = format!("`{name}` did not accept its parameters");
        shortfall(Item::Parameters(name.clone()), FailureCode::PARAMETER_REJECTED, what, seen)
    }

    fn unanswered(&self, name: &GraphName, observation: &Observation<'_>) -> Option<Shortfall> {
        let offering = || {
            observation
                .snapshot
                .servers_of(name)
                .filter(|node| observation.ours.contains(&node.participant))
        };
        let answers = |node: &Node| self.nodes.get(&node.name).is_none_or(BringUp::has_answered);
        let (what, seen) = match offering().next() {
            None if self.was_ready => {
                (format!("the service `{name}` is not offered any more"), String::new())
            }
            None => (format!("the service `{name}` was not offered"), String::new()),
            Some(_) if self.was_ready || offering().any(answers) => return None,
            Some(node) => (
                format!("the service `{name}` did not answer"),
                format!("`{}` does not answer", node.name),
            ),
        };
        let item = Item::Service(name.clone());
        let code = FailureCode::SERVICE_LOST;
        Some(Shortfall { item, code, what, seen, certain: false })
    }

    fn unpublished(&self, name: &GraphName, observation: &Observation<'_>) -> Option<Shortfall> {
        let published = observation
            .snapshot
            .publishers_of(name)
            .any(|node| observation.ours.contains(&node.participant));
        let (what, seen) = match (published, self.rates.get(name)) {
            (false, _) if self.was_ready => (format!("`{name}` lost its publisher"), String::new()),
            (false, _) => (format!("`{name}` had no publisher"), String::new()),
            (true, None) => return None,
            (true, Some(rate)) => match rate.suffices() {
                Some(true) => return None,
                // Right after a restart of the agent nothing was counted yet; that is no reason to
                // doubt the topic.
                None if self.was_ready => return None,
                None => (format!("`{name}` was not measured for long enough"), String::new()),
                Some(false) => {
                    let what = match self.was_ready {
                        true => format!("`{name}` is no longer published at {} Hz", rate.min_hz()),
                        false => format!("`{name}` was not published at {} Hz", rate.min_hz()),
                    };
                    (
                        what,
                        rate.hz().map_or_else(String::new, |hz| {
                            format!("it was published at {hz:.1} Hz")
                        }),
                    )
                }
            },
        };
        let item = Item::Topic(name.clone());
        let code = FailureCode::TOPIC_SILENT;
        Some(Shortfall { item, code, what, seen, certain: false })
    }

    fn update_health(&mut self, shortfalls: Vec<Shortfall>, now_ms: u64) {
        let before = std::mem::take(&mut self.lasting);
        let mut counted = Vec::new();
        for shortfall in shortfalls {
            let item = shortfall.item.clone();
            let mut lasting = before
                .get(&item)
                .cloned()
                .unwrap_or(OngoingShortfall { since_ms: now_ms, reported: None });
            let needed_ms = match item {
                // Nothing becomes ready while anything is in doubt.
                _ if !self.was_ready || shortfall.certain => 0,
                Item::UniqueName(_) => CONFLICT_MS,
                _ => GRACE_MS,
            };
            if now_ms.saturating_sub(lasting.since_ms) >= needed_ms {
                let reported =
                    lasting.reported.take().filter(|_| self.was_ready).unwrap_or(shortfall);
                counted.push(reported.clone());
                lasting.reported = Some(reported);
            }
            self.lasting.insert(item, lasting);
        }
        let node_refusal = self.nodes.values().find_map(|node| node.refused().cloned());
        let refused = self.lasting_name_conflict(now_ms).or(node_refusal);
        if matches!(self.health, Health::Refused(_)) {
            return;
        }
        let problem = match refused {
            Some(refused) if !self.was_ready => {
                self.health = Health::Refused(refused);
                return;
            }
            // A refusal by one node that returned is no reason to take down the others.
            Some(refused) => Some((refused.code, refused.text, String::new())),
            None => summarize(&counted),
        };
        let only_conflicts = !counted.is_empty()
            && counted.iter().all(|shortfall| matches!(shortfall.item, Item::UniqueName(_)));
        self.health = match (problem, &self.health) {
            (None, Health::Holds { since_ms }) => Health::Holds { since_ms: *since_ms },
            (None, _) => Health::Holds { since_ms: now_ms },
            (Some((code, what, seen)), before) => {
                let since_ms =
                    if let Health::Missing(missing) = before { missing.since_ms } else { now_ms };
                Health::Missing(Missing {
                    since_ms,
                    code,
                    what,
                    seen,
                    is_own_fault: !only_conflicts,
                })
            }
        };
        self.was_ready |= self.has_held(now_ms);
    }

    /// Whether all promises hold, and for long enough.
    fn has_held(&self, now_ms: u64) -> bool {
        let enough_ms = u64::from(self.promise.hold_s) * 1000;
        matches!(self.health, Health::Holds { since_ms } if now_ms.saturating_sub(since_ms) >= enough_ms)
    }

    /// A name that another owner has had for long enough.
    fn lasting_name_conflict(&self, now_ms: u64) -> Option<Failure> {
        self.lasting.iter().find_map(|(item, lasting)| match (item, &lasting.reported) {
            (Item::UniqueName(name), Some(reported))
                if now_ms.saturating_sub(lasting.since_ms) >= CONFLICT_MS =>
            {
                Some(Failure::new(reported.code.clone(), describe_conflict(name, &reported.seen)))
            }
            _ => None,
        })
    }
}

/// The shortfalls in words, with the code of the first and the state found instead; each text once.
fn summarize(counted: &[Shortfall]) -> Option<(FailureCode, String, String)> {
    let code = counted.first()?.code.clone();
    let what =
        counted.iter().map(|shortfall| shortfall.what.as_str()).collect::<Vec<_>>().join(", ");
    let mut seen: Vec<&str> = Vec::new();
    for shortfall in counted.iter().filter(|shortfall| !shortfall.seen.is_empty()) {
        if !seen.contains(&shortfall.seen.as_str()) {
            seen.push(&shortfall.seen);
        }
    }
    Some((code, what, seen.join("; ")))
}

/// States that another owner has a name, in words that stand alone.
fn describe_conflict(name: &GraphName, owner: &str) -> String {
    format!("`{name}` is already on the graph: {owner}")
}

/// The names on the graph.
fn list_graph(snapshot: &Snapshot) -> String {
    let names: BTreeSet<&str> = snapshot.nodes.iter().map(|node| node.name.as_str()).collect();
    if names.is_empty() {
        return "the graph is empty".to_owned();
    }
    let listed = names
        .iter()
        .take(MAX_LISTED)
        .map(|name| format!("`{name}`"))
        .collect::<Vec<_>>()
        .join(", ");
    match names.len().saturating_sub(MAX_LISTED) {
        0 => format!("on the graph: {listed}"),
        more => format!("on the graph: {listed} and {more} more"),
    }
}
