//! Scenarios of runs on a simulated graph, and properties that hold in every scenario.

use std::time::Instant;

use proptest::prelude::*;
use serde_json::json;
use task_proto::telemetry::ros::{Endpoint, Transition};

use super::*;

const OURS: ParticipantId = ParticipantId([1; 12]);
const OTHER: ParticipantId = ParticipantId([2; 12]);
const AGAIN: ParticipantId = ParticipantId([3; 12]);

fn name(text: &str) -> GraphName {
    text.parse().expect("a ROS name")
}

fn names(texts: &[&str]) -> BTreeSet<GraphName> {
    texts.iter().map(|text| name(text)).collect()
}

/// A simulated graph on which time passes.
struct Scenario {
    snapshot: Snapshot,
    ours: BTreeSet<ParticipantId>,
    others: BTreeMap<ParticipantId, String>,
    gone: BTreeSet<ParticipantId>,
    counts: BTreeMap<GraphName, u64>,
    readiness: Readiness,
    now_ms: u64,
}

impl Scenario {
    fn new(promise: Promise, was_ready: bool) -> Self {
        Self {
            snapshot: Snapshot::empty(Instant::now()),
            ours: BTreeSet::from([OURS, AGAIN]),
            others: BTreeMap::from([(OTHER, "a neighbour".to_owned())]),
            gone: BTreeSet::new(),
            counts: BTreeMap::new(),
            readiness: Readiness::new(promise, was_ready),
            now_ms: 1000,
        }
    }

    /// A scenario with a lifecycle node that has told its state.
    fn managed(state: LifecycleState) -> Self {
        let mut scenario = Self::new(lifecycle(&[]), false);
        scenario.add(OURS, "/mapper", &[], &[]);
        scenario.after(0);
        scenario.answer(&RequestKind::State, Answer::State(state));
        scenario
    }

    fn add(&mut self, participant: ParticipantId, node: &str, services: &[&str], topics: &[&str]) {
        let endpoints = |names: &[&str]| {
            let endpoint =
                |text: &&str| Endpoint { name: name(text), kind: "test_msgs/msg/Empty".to_owned() };
            names.iter().map(endpoint).collect::<Vec<_>>()
        };
        self.snapshot.nodes.push(Node {
            name: name(node),
            participant,
            publishers: endpoints(topics),
            subscriptions: Vec::new(),
            services: endpoints(services),
            clients: Vec::new(),
        });
    }

    fn remove(&mut self, participant: ParticipantId) {
        self.snapshot.nodes.retain(|node| node.participant != participant);
    }

    /// Observes once, after `ms`.
    fn after(&mut self, ms: u64) -> Health {
        self.now_ms += ms;
        let observation = Observation {
            snapshot: &self.snapshot,
            ours: &self.ours,
            others: &self.others,
            gone: &self.gone,
            counts: &self.counts,
        };
        self.readiness.observe(&observation, self.now_ms);
        self.readiness.health().clone()
    }

    fn requests(&mut self) -> Vec<NodeRequest> {
        self.readiness.requests(self.now_ms)
    }

    /// Checks that exactly this request is pending, and answers it.
    fn answer(&mut self, kind: &RequestKind, answer: Answer) {
        let requests = self.requests();
        assert_eq!(requests.iter().map(|request| &request.kind).collect::<Vec<_>>(), [kind]);
        self.readiness.record_answer(&requests[0], answer, self.now_ms);
    }
}

fn missing(health: &Health) -> &Missing {
    match health {
        Health::Missing(missing) => missing,
        other => panic!("{other:?}"),
    }
}

fn refused(health: &Health) -> String {
    match health {
        Health::Refused(failure) => failure.to_string(),
        other => panic!("{other:?}"),
    }
}

fn nodes(texts: &[&str]) -> Promise {
    Promise { nodes: names(texts), hold_s: 1, ..Promise::default() }
}

fn lifecycle(parameters: &[(&str, serde_json::Value)]) -> Promise {
    let values =
        parameters.iter().map(|(name, value)| ((*name).to_owned(), value.clone())).collect();
    Promise {
        lifecycle: names(&["/mapper"]),
        parameters: BTreeMap::from([(name("/mapper"), values)]),
        ..nodes(&["/mapper"])
    }
}

#[test]
fn absent_node_is_reported_with_the_nodes_present() {
    let mut scenario = Scenario::new(nodes(&["/mapper"]), false);
    scenario.add(OURS, "/lidar", &[], &[]);
    scenario.add(OTHER, "/odom", &[], &[]);
    let health = scenario.after(0);
    assert_eq!(
        missing(&health).timeout_failure(30).text,
        "`/mapper` did not appear within 30 s; on the graph: `/lidar`, `/odom`"
    );
    scenario.add(OURS, "/mapper", &[], &[]);
    assert_eq!(scenario.after(500), Health::Holds { since_ms: 1500 });
    assert_eq!(scenario.after(500), Health::Holds { since_ms: 1500 });
}

#[test]
fn large_graph_is_listed_in_part() {
    let mut scenario = Scenario::new(nodes(&["/mapper"]), false);
    for number in 0..500 {
        scenario.add(OTHER, &format!("/robot_{number}"), &[], &[]);
    }
    let health = scenario.after(0);
    assert!(missing(&health).seen.ends_with(" and 480 more"), "{health:?}");
    assert!(missing(&health).seen.len() < 1000);
}

#[test]
fn name_of_a_living_foreign_node_is_a_conflict() {
    let mut promise = nodes(&["/mapper"]);
    promise.services = names(&["/map"]);
    let mut scenario = Scenario::new(promise.clone(), false);
    scenario.add(OTHER, "/mapper", &["/map"], &[]);
    let failure = promise.name_conflict(&scenario.snapshot, &scenario.others).expect("taken");
    assert_eq!(failure.code, FailureCode::NODE_NAME_TAKEN);
    assert!(failure.text.contains("a neighbour has a node of that name"), "{failure}");
    assert!(failure.text.contains("`/mapper` of a neighbour offers that service"), "{failure}");
    // The remains of a process that is gone take no name.
    assert_eq!(promise.name_conflict(&scenario.snapshot, &BTreeMap::new()), None);

    scenario.add(OURS, "/mapper", &["/map"], &[]);
    assert_eq!(
        missing(&scenario.after(0)).timeout_failure(8).text,
        "`/mapper` was not free, `/map` was not free within 8 s; a neighbour has a node of that name; \
         `/mapper` of a neighbour offers that service"
    );
    missing(&scenario.after(CONFLICT_MS - 1));
    assert!(refused(&scenario.after(1)).starts_with("node_name_taken"));
    // The run stays refused, even after the other node has left.
    scenario.remove(OTHER);
    refused(&scenario.after(5000));
}

#[test]
fn conflict_after_readiness_is_not_the_fault_of_the_run() {
    let mut scenario = Scenario::new(nodes(&["/mapper"]), true);
    scenario.add(OURS, "/mapper", &[], &[]);
    scenario.after(0);
    scenario.add(OTHER, "/mapper", &[], &[]);
    assert!(matches!(scenario.after(0), Health::Holds { .. }));
    let health = scenario.after(CONFLICT_MS);
    assert_eq!(
        (missing(&health).code.as_str(), missing(&health).is_own_fault),
        ("node_name_taken", false)
    );
    scenario.remove(OURS);
    scenario.after(0);
    let health = scenario.after(GRACE_MS);
    assert_eq!(
        (missing(&health).code.as_str(), missing(&health).is_own_fault),
        ("node_name_taken", true)
    );
}

#[test]
fn run_counts_as_ready_once_promises_held_long_enough() {
    let mut scenario = Scenario::new(nodes(&["/mapper"]), false);
    scenario.add(OURS, "/mapper", &[], &[]);
    assert!(matches!(scenario.after(0), Health::Holds { .. }));
    // The promise breaks after its time and before the next look.
    scenario.add(OTHER, "/mapper", &[], &[]);
    scenario.after(1500);
    assert!(!missing(&scenario.after(CONFLICT_MS)).is_own_fault);
}

#[test]
fn parameters_go_in_before_configure_and_late_ones_after() {
    let mut scenario =
        Scenario::new(lifecycle(&[("late", json!(7)), ("resolution", json!(0.1))]), false);
    scenario.add(OURS, "/mapper", &[], &[]);
    let late = "`late` was not declared".to_owned();
    assert_eq!(missing(&scenario.after(0)).what, "`/mapper` did not become active");
    scenario.answer(&RequestKind::State, Answer::State(LifecycleState::Unconfigured));
    let both = vec![("late".to_owned(), json!(7)), ("resolution".to_owned(), json!(0.1))];
    scenario.answer(&RequestKind::Set(both), Answer::Set(vec![Err(late), Ok(())]));
    scenario.answer(&RequestKind::Transition(Transition::Configure), Answer::Transition(true));
    assert_eq!(missing(&scenario.after(10)).seen, "it is inactive");
    scenario
        .answer(&RequestKind::Set(vec![("late".to_owned(), json!(7))]), Answer::Set(vec![Ok(())]));
    scenario.answer(&RequestKind::Transition(Transition::Activate), Answer::Transition(true));
    assert!(matches!(scenario.after(10), Health::Holds { .. }));
    // From now on the node is only observed.
    assert_eq!(scenario.requests(), []);
    scenario.after(3000);
    scenario.answer(&RequestKind::State, Answer::State(LifecycleState::Active));
}

#[test]
fn every_rejected_parameter_is_listed_and_nothing_is_configured() {
    let mut scenario =
        Scenario::new(lifecycle(&[("a", json!(1)), ("b", json!("x")), ("c", json!(2))]), false);
    scenario.add(OURS, "/mapper", &[], &[]);
    scenario.after(0);
    scenario.answer(&RequestKind::State, Answer::State(LifecycleState::Unconfigured));
    let all =
        vec![("a".to_owned(), json!(1)), ("b".to_owned(), json!("x")), ("c".to_owned(), json!(2))];
    let results = vec![
        Err("must be positive".to_owned()),
        Err("('Invalid access to undeclared parameter(s)', ['b'])".to_owned()),
        Ok(()),
    ];
    scenario.answer(&RequestKind::Set(all), Answer::Set(results));
    let text = refused(&scenario.after(0));
    assert!(
        text.starts_with(
            "parameter_rejected: `/mapper` a = 1: must be positive; `/mapper` b = \"x\": "
        ),
        "{text}"
    );
    assert!(!text.contains(" c = "), "{text}");
    assert_eq!(scenario.requests(), []);
}

#[test]
fn undeclared_parameter_is_rejected_after_a_timeout() {
    let mut promise = lifecycle(&[("unheard_of", json!(1))]);
    promise.lifecycle.clear();
    let mut scenario = Scenario::new(promise, false);
    scenario.add(OURS, "/mapper", &[], &[]);
    for _ in 0..6 {
        missing(&scenario.after(RETRY_INTERVAL_MS));
        let set = RequestKind::Set(vec![("unheard_of".to_owned(), json!(1))]);
        scenario.answer(&set, Answer::Set(vec![Err("undeclared".to_owned())]));
    }
    missing(&scenario.after(RETRY_INTERVAL_MS));
    scenario.answer(
        &RequestKind::Set(vec![("unheard_of".to_owned(), json!(1))]),
        Answer::Set(vec![Err("undeclared".to_owned())]),
    );
    assert!(refused(&scenario.after(0)).starts_with("parameter_rejected"));
}

const RETRY_INTERVAL_MS: u64 = 500;

#[test]
fn failed_transition_is_named_with_the_state_it_led_to() {
    let mut scenario = Scenario::managed(LifecycleState::Inactive);
    scenario.answer(&RequestKind::Transition(Transition::Activate), Answer::Transition(false));
    scenario.answer(&RequestKind::State, Answer::State(LifecycleState::Unconfigured));
    assert_eq!(
        refused(&scenario.after(0)),
        "lifecycle_failed: `/mapper` failed to activate and is unconfigured"
    );
}

#[test]
fn transition_already_made_by_another_client_counts_as_made() {
    let mut scenario = Scenario::managed(LifecycleState::Unconfigured);
    scenario.answer(&RequestKind::Transition(Transition::Configure), Answer::Transition(false));
    scenario.answer(&RequestKind::State, Answer::State(LifecycleState::Changing));
    missing(&scenario.after(RETRY_INTERVAL_MS));
    scenario.answer(&RequestKind::State, Answer::State(LifecycleState::Inactive));
    missing(&scenario.after(0));
    scenario.answer(&RequestKind::Transition(Transition::Activate), Answer::Transition(false));
    scenario.answer(&RequestKind::State, Answer::State(LifecycleState::Active));
    assert!(matches!(scenario.after(0), Health::Holds { .. }));
}

#[test]
fn lost_transition_answer_leads_to_a_state_query() {
    let mut scenario = Scenario::managed(LifecycleState::Unconfigured);
    scenario.answer(&RequestKind::Transition(Transition::Configure), Answer::None);
    assert_eq!(scenario.requests(), []);
    assert_eq!(
        missing(&scenario.after(RETRY_INTERVAL_MS)).seen,
        "it does not answer as a lifecycle node"
    );
    scenario.answer(&RequestKind::State, Answer::State(LifecycleState::Changing));
    scenario.after(RETRY_INTERVAL_MS);
    scenario.answer(&RequestKind::State, Answer::State(LifecycleState::Inactive));
    scenario.answer(&RequestKind::Transition(Transition::Activate), Answer::Transition(true));
    assert!(matches!(scenario.after(0), Health::Holds { .. }));
}

#[test]
fn service_counts_once_its_node_answers() {
    let promise = Promise { services: names(&["/say"]), ..Promise::default() };
    let mut scenario = Scenario::new(promise, false);
    assert_eq!(missing(&scenario.after(0)).what, "the service `/say` was not offered");
    scenario.add(OURS, "/talker", &["/say", "/talker/get_parameters"], &[]);
    assert_eq!(missing(&scenario.after(10)).what, "the service `/say` did not answer");
    scenario.answer(&RequestKind::Ping, Answer::Pong);
    assert!(matches!(scenario.after(10), Health::Holds { .. }));
    scenario.remove(OURS);
    scenario.after(0);
    assert_eq!(
        missing(&scenario.after(GRACE_MS)).failure().to_string(),
        "service_lost: the service `/say` is not offered any more"
    );
}

#[test]
fn topic_counts_at_its_minimum_rate() {
    let topics = BTreeMap::from([(name("/scan"), Some(5.0))]);
    let mut scenario = Scenario::new(Promise { topics, ..Promise::default() }, false);
    assert_eq!(missing(&scenario.after(0)).what, "`/scan` had no publisher");
    scenario.add(OURS, "/lidar", &[], &["/scan"]);
    for count in 0..=20 {
        scenario.counts.insert(name("/scan"), count);
        missing(&scenario.after(90));
    }
    for count in 21..=25 {
        scenario.counts.insert(name("/scan"), count);
        scenario.after(100);
    }
    assert!(matches!(scenario.after(0), Health::Holds { .. }));
    for _ in 0..20 {
        scenario.after(250);
    }
    let health = scenario.after(0);
    assert_eq!(missing(&health).code, FailureCode::TOPIC_SILENT);
    assert_eq!(missing(&health).what, "`/scan` is no longer published at 5 Hz");
    // The figure in the text stays: otherwise each look would cause a report.
    assert_eq!(scenario.after(1000), health);
}

#[test]
fn discovery_gap_is_tolerated_but_a_dead_process_is_lost_at_once() {
    let mut scenario = Scenario::new(nodes(&["/mapper"]), false);
    scenario.add(OURS, "/mapper", &[], &[]);
    scenario.after(0);
    scenario.after(2000);
    scenario.remove(OURS);
    assert!(matches!(scenario.after(100), Health::Holds { .. }));
    scenario.add(OURS, "/mapper", &[], &[]);
    assert_eq!(scenario.after(1900), Health::Holds { since_ms: 1000 });
    scenario.ours.remove(&OURS);
    scenario.gone.insert(OURS);
    let health = scenario.after(10);
    assert_eq!(
        missing(&health).failure().to_string(),
        "node_vanished: `/mapper` left the graph; its process is gone"
    );
}

#[test]
fn returning_node_is_brought_up_again_but_a_deactivated_one_is_not() {
    let mut scenario = Scenario::new(lifecycle(&[("resolution", json!(0.1))]), true);
    scenario.add(OURS, "/mapper", &[], &[]);
    assert!(matches!(scenario.after(0), Health::Holds { .. }));
    // The node was brought up before this agent: no parameter is set, nothing is configured.
    scenario.answer(&RequestKind::State, Answer::State(LifecycleState::Active));
    scenario.after(2000);
    scenario.answer(&RequestKind::State, Answer::State(LifecycleState::Inactive));
    scenario.after(0);
    assert_eq!(scenario.requests(), []);
    let health = scenario.after(GRACE_MS);
    assert_eq!(
        missing(&health).failure().to_string(),
        "node_inactive: `/mapper` is not active any more; it is inactive"
    );

    let mut scenario = Scenario::new(lifecycle(&[("resolution", json!(0.1))]), true);
    scenario.add(OURS, "/mapper", &[], &[]);
    scenario.after(0);
    scenario.answer(&RequestKind::State, Answer::State(LifecycleState::Active));
    scenario.remove(OURS);
    scenario.add(AGAIN, "/mapper", &[], &[]);
    // The node came back before its absence was noticed, but it is not active.
    assert_eq!(missing(&scenario.after(10)).code, FailureCode::NODE_INACTIVE);
    scenario.answer(&RequestKind::State, Answer::State(LifecycleState::Unconfigured));
    scenario.answer(
        &RequestKind::Set(vec![("resolution".to_owned(), json!(0.1))]),
        Answer::Set(vec![Ok(())]),
    );
    scenario.answer(&RequestKind::Transition(Transition::Configure), Answer::Transition(true));
    scenario.answer(&RequestKind::Transition(Transition::Activate), Answer::Transition(true));
    assert!(matches!(scenario.after(10), Health::Holds { .. }));
}

#[test]
fn refusal_by_a_returning_node_degrades_the_task() {
    let mut scenario = Scenario::new(lifecycle(&[]), true);
    scenario.add(AGAIN, "/mapper", &[], &[]);
    scenario.after(0);
    scenario.answer(&RequestKind::State, Answer::State(LifecycleState::Active));
    scenario.remove(AGAIN);
    scenario.add(OURS, "/mapper", &[], &[]);
    scenario.after(10);
    scenario.answer(&RequestKind::State, Answer::State(LifecycleState::Unconfigured));
    scenario.answer(&RequestKind::Transition(Transition::Configure), Answer::Transition(false));
    scenario.answer(&RequestKind::State, Answer::State(LifecycleState::Unconfigured));
    let health = scenario.after(10);
    assert_eq!(missing(&health).code, FailureCode::LIFECYCLE_FAILED);
}

/// Events that may happen between two looks.
#[derive(Debug, Clone)]
enum Event {
    Appear(ParticipantId),
    Vanish(ParticipantId),
    Die(ParticipantId),
    Answer(Answer),
    Wait(u64),
}

fn events() -> impl Strategy<Value = Event> {
    let participant = prop_oneof![Just(OURS), Just(OTHER), Just(AGAIN)];
    let state = prop_oneof![
        Just(LifecycleState::Unconfigured),
        Just(LifecycleState::Inactive),
        Just(LifecycleState::Active),
        Just(LifecycleState::Finalized),
        Just(LifecycleState::Changing),
    ];
    let answer = prop_oneof![
        state.prop_map(Answer::State),
        any::<bool>().prop_map(Answer::Transition),
        Just(Answer::Set(vec![Ok(())])),
        Just(Answer::Set(vec![Err("undeclared".to_owned())])),
        Just(Answer::None),
    ];
    prop_oneof![
        participant.clone().prop_map(Event::Appear),
        participant.clone().prop_map(Event::Vanish),
        participant.prop_map(Event::Die),
        answer.prop_map(Event::Answer),
        (0..5000_u64).prop_map(Event::Wait),
    ]
}

proptest! {
    #[test]
    fn only_an_own_active_node_holds_in_every_event_sequence(events_seen in prop::collection::vec(events(), 1..60)) {
        let mut scenario = Scenario::new(lifecycle(&[("resolution", json!(0.1))]), false);
        let mut open: Vec<NodeRequest> = Vec::new();
        let mut was_refused = false;
        for event in events_seen {
            match event {
                Event::Appear(participant) => {
                    scenario.remove(participant);
                    scenario.add(participant, "/mapper", &[], &[]);
                }
                Event::Vanish(participant) => scenario.remove(participant),
                Event::Die(participant) if participant != OTHER => {
                    scenario.ours.remove(&participant);
                    scenario.gone.insert(participant);
                }
                Event::Die(_) => {}
                Event::Answer(answer) => {
                    if let Some(request) = open.pop() {
                        let fits = matches!(
                            (&request.kind, &answer),
                            (RequestKind::State, Answer::State(_)) | (RequestKind::Transition(_), Answer::Transition(_)) | (RequestKind::Set(_), Answer::Set(_))
                        );
                        scenario.readiness.record_answer(&request, if fits { answer } else { Answer::None }, scenario.now_ms);
                    }
                }
                Event::Wait(ms) => scenario.now_ms += ms,
            }
            let health = scenario.after(1);
            open.extend(scenario.requests());
            // At most one pending request for each process's node.
            for participant in [OURS, AGAIN] {
                prop_assert!(open.iter().filter(|request| request.instance == participant).count() <= 2);
            }
            prop_assert!(open.iter().all(|request| request.instance != OTHER));
            let here = scenario.snapshot.nodes.iter().any(|node| scenario.ours.contains(&node.participant));
            if let Health::Holds { since_ms } = health {
                prop_assert!(since_ms <= scenario.now_ms);
                prop_assert!(here || scenario.readiness.was_ready, "held without a node of ours");
            }
            prop_assert!(!was_refused || matches!(health, Health::Refused(_)));
            was_refused = matches!(health, Health::Refused(_));
        }
    }
}
