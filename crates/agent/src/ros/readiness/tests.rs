//! Scenarios of runs on a simulated graph, and properties that hold in every scenario.

use std::time::Instant;

use proptest::prelude::*;
use serde_json::json;
use task_proto::ros::{Endpoint, Transition};

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
struct Stage {
    snapshot: Snapshot,
    ours: BTreeSet<ParticipantId>,
    others: BTreeMap<ParticipantId, String>,
    gone: BTreeSet<ParticipantId>,
    counts: BTreeMap<GraphName, u64>,
    readiness: Readiness,
    now_ms: u64,
}

impl Stage {
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

    /// A stage with a lifecycle node that has told its state.
    fn managed(state: LifecycleState) -> Self {
        let mut stage = Self::new(lifecycle(&[]), false);
        stage.add(OURS, "/mapper", &[], &[]);
        stage.after(0);
        stage.answers(&Ask::State, Answer::State(state));
        stage
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

    /// Looks once, after `ms`.
    fn after(&mut self, ms: u64) -> Health {
        self.now_ms += ms;
        let look = Look {
            snapshot: &self.snapshot,
            ours: &self.ours,
            others: &self.others,
            gone: &self.gone,
            counts: &self.counts,
        };
        self.readiness.see(&look, self.now_ms);
        self.readiness.health().clone()
    }

    fn asked(&mut self) -> Vec<Question> {
        self.readiness.questions(self.now_ms)
    }

    /// Checks that exactly this question is pending, and answers it.
    fn answers(&mut self, ask: &Ask, answer: Answer) {
        let questions = self.asked();
        assert_eq!(questions.iter().map(|question| &question.ask).collect::<Vec<_>>(), [ask]);
        self.readiness.answered(&questions[0], answer, self.now_ms);
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
fn what_did_not_appear_is_named_with_what_is_there() {
    let mut stage = Stage::new(nodes(&["/mapper"]), false);
    stage.add(OURS, "/lidar", &[], &[]);
    stage.add(OTHER, "/odom", &[], &[]);
    let health = stage.after(0);
    assert_eq!(
        missing(&health).not_within(30).text,
        "`/mapper` did not appear within 30 s; on the graph: `/lidar`, `/odom`"
    );
    stage.add(OURS, "/mapper", &[], &[]);
    assert_eq!(stage.after(500), Health::Holds { since_ms: 1500 });
    assert_eq!(stage.after(500), Health::Holds { since_ms: 1500 });
}

#[test]
fn a_crowded_graph_is_not_listed_whole() {
    let mut stage = Stage::new(nodes(&["/mapper"]), false);
    for number in 0..500 {
        stage.add(OTHER, &format!("/robot_{number}"), &[], &[]);
    }
    let health = stage.after(0);
    assert!(missing(&health).seen.ends_with(" and 480 more"), "{health:?}");
    assert!(missing(&health).seen.len() < 1000);
}

#[test]
fn a_name_that_a_living_stranger_has_is_taken() {
    let mut promise = nodes(&["/mapper"]);
    promise.services = names(&["/map"]);
    let mut stage = Stage::new(promise.clone(), false);
    stage.add(OTHER, "/mapper", &["/map"], &[]);
    let failure = promise.taken(&stage.snapshot, &stage.others).expect("taken");
    assert_eq!(failure.code, FailureCode::NODE_NAME_TAKEN);
    assert!(failure.text.contains("a neighbour has a node of that name"), "{failure}");
    assert!(failure.text.contains("`/mapper` of a neighbour offers that service"), "{failure}");
    // The remains of a process that is gone take no name.
    assert_eq!(promise.taken(&stage.snapshot, &BTreeMap::new()), None);

    stage.add(OURS, "/mapper", &["/map"], &[]);
    assert_eq!(
        missing(&stage.after(0)).not_within(8).text,
        "`/mapper` was not free, `/map` was not free within 8 s; a neighbour has a node of that name; \
         `/mapper` of a neighbour offers that service"
    );
    missing(&stage.after(FOREIGN_MS - 1));
    assert!(refused(&stage.after(1)).starts_with("node_name_taken"));
    // The run stays refused, even after the other node has left.
    stage.remove(OTHER);
    refused(&stage.after(5000));
}

#[test]
fn what_a_stranger_does_is_no_fault_of_the_run() {
    let mut stage = Stage::new(nodes(&["/mapper"]), true);
    stage.add(OURS, "/mapper", &[], &[]);
    stage.after(0);
    stage.add(OTHER, "/mapper", &[], &[]);
    assert!(matches!(stage.after(0), Health::Holds { .. }));
    let health = stage.after(FOREIGN_MS);
    assert_eq!(
        (missing(&health).code.as_str(), missing(&health).is_its_own),
        ("node_name_taken", false)
    );
    stage.remove(OURS);
    stage.after(0);
    let health = stage.after(GRACE_MS);
    assert_eq!(
        (missing(&health).code.as_str(), missing(&health).is_its_own),
        ("node_name_taken", true)
    );
}

#[test]
fn what_has_held_for_its_time_was_ready_whenever_that_is_seen() {
    let mut stage = Stage::new(nodes(&["/mapper"]), false);
    stage.add(OURS, "/mapper", &[], &[]);
    assert!(matches!(stage.after(0), Health::Holds { .. }));
    // The promise breaks after its time and before the next look.
    stage.add(OTHER, "/mapper", &[], &[]);
    stage.after(1500);
    assert!(!missing(&stage.after(FOREIGN_MS)).is_its_own);
}

#[test]
fn parameters_go_in_before_configure_and_late_ones_after() {
    let mut stage = Stage::new(lifecycle(&[("late", json!(7)), ("resolution", json!(0.1))]), false);
    stage.add(OURS, "/mapper", &[], &[]);
    let late = "`late` was not declared".to_owned();
    assert_eq!(missing(&stage.after(0)).what, "`/mapper` did not become active");
    stage.answers(&Ask::State, Answer::State(LifecycleState::Unconfigured));
    let both = vec![("late".to_owned(), json!(7)), ("resolution".to_owned(), json!(0.1))];
    stage.answers(&Ask::Set(both), Answer::Set(vec![Err(late), Ok(())]));
    stage.answers(&Ask::Transition(Transition::Configure), Answer::Transition(true));
    assert_eq!(missing(&stage.after(10)).seen, "it is inactive");
    stage.answers(&Ask::Set(vec![("late".to_owned(), json!(7))]), Answer::Set(vec![Ok(())]));
    stage.answers(&Ask::Transition(Transition::Activate), Answer::Transition(true));
    assert!(matches!(stage.after(10), Health::Holds { .. }));
    // From now on the node is only observed.
    assert_eq!(stage.asked(), []);
    stage.after(3000);
    stage.answers(&Ask::State, Answer::State(LifecycleState::Active));
}

#[test]
fn every_rejected_parameter_is_listed_and_nothing_is_configured() {
    let mut stage =
        Stage::new(lifecycle(&[("a", json!(1)), ("b", json!("x")), ("c", json!(2))]), false);
    stage.add(OURS, "/mapper", &[], &[]);
    stage.after(0);
    stage.answers(&Ask::State, Answer::State(LifecycleState::Unconfigured));
    let all =
        vec![("a".to_owned(), json!(1)), ("b".to_owned(), json!("x")), ("c".to_owned(), json!(2))];
    let results = vec![
        Err("must be positive".to_owned()),
        Err("('Invalid access to undeclared parameter(s)', ['b'])".to_owned()),
        Ok(()),
    ];
    stage.answers(&Ask::Set(all), Answer::Set(results));
    let text = refused(&stage.after(0));
    assert!(
        text.starts_with(
            "parameter_rejected: `/mapper` a = 1: must be positive; `/mapper` b = \"x\": "
        ),
        "{text}"
    );
    assert!(!text.contains(" c = "), "{text}");
    assert_eq!(stage.asked(), []);
}

#[test]
fn a_parameter_that_nobody_declares_is_rejected_in_the_end() {
    let mut promise = lifecycle(&[("unheard_of", json!(1))]);
    promise.lifecycle.clear();
    let mut stage = Stage::new(promise, false);
    stage.add(OURS, "/mapper", &[], &[]);
    for _ in 0..6 {
        missing(&stage.after(ASK_AGAIN_MS));
        let set = Ask::Set(vec![("unheard_of".to_owned(), json!(1))]);
        stage.answers(&set, Answer::Set(vec![Err("undeclared".to_owned())]));
    }
    missing(&stage.after(ASK_AGAIN_MS));
    stage.answers(
        &Ask::Set(vec![("unheard_of".to_owned(), json!(1))]),
        Answer::Set(vec![Err("undeclared".to_owned())]),
    );
    assert!(refused(&stage.after(0)).starts_with("parameter_rejected"));
}

const ASK_AGAIN_MS: u64 = 500;

#[test]
fn a_failed_transition_is_named_with_the_state_it_led_to() {
    let mut stage = Stage::managed(LifecycleState::Inactive);
    stage.answers(&Ask::Transition(Transition::Activate), Answer::Transition(false));
    stage.answers(&Ask::State, Answer::State(LifecycleState::Unconfigured));
    assert_eq!(
        refused(&stage.after(0)),
        "lifecycle_failed: `/mapper` failed to activate and is unconfigured"
    );
}

#[test]
fn a_transition_that_somebody_else_made_a_moment_earlier_has_not_failed() {
    let mut stage = Stage::managed(LifecycleState::Unconfigured);
    stage.answers(&Ask::Transition(Transition::Configure), Answer::Transition(false));
    stage.answers(&Ask::State, Answer::State(LifecycleState::Changing));
    missing(&stage.after(ASK_AGAIN_MS));
    stage.answers(&Ask::State, Answer::State(LifecycleState::Inactive));
    missing(&stage.after(0));
    stage.answers(&Ask::Transition(Transition::Activate), Answer::Transition(false));
    stage.answers(&Ask::State, Answer::State(LifecycleState::Active));
    assert!(matches!(stage.after(0), Health::Holds { .. }));
}

#[test]
fn a_lost_answer_is_asked_for_by_the_state_not_by_another_transition() {
    let mut stage = Stage::managed(LifecycleState::Unconfigured);
    stage.answers(&Ask::Transition(Transition::Configure), Answer::None);
    assert_eq!(stage.asked(), []);
    assert_eq!(missing(&stage.after(ASK_AGAIN_MS)).seen, "it does not answer as a lifecycle node");
    stage.answers(&Ask::State, Answer::State(LifecycleState::Changing));
    stage.after(ASK_AGAIN_MS);
    stage.answers(&Ask::State, Answer::State(LifecycleState::Inactive));
    stage.answers(&Ask::Transition(Transition::Activate), Answer::Transition(true));
    assert!(matches!(stage.after(0), Health::Holds { .. }));
}

#[test]
fn a_service_counts_once_its_node_answers() {
    let promise = Promise { services: names(&["/say"]), ..Promise::default() };
    let mut stage = Stage::new(promise, false);
    assert_eq!(missing(&stage.after(0)).what, "the service `/say` was not offered");
    stage.add(OURS, "/talker", &["/say", "/talker/get_parameters"], &[]);
    assert_eq!(missing(&stage.after(10)).what, "the service `/say` did not answer");
    stage.answers(&Ask::Anything, Answer::Something);
    assert!(matches!(stage.after(10), Health::Holds { .. }));
    stage.remove(OURS);
    stage.after(0);
    assert_eq!(
        missing(&stage.after(GRACE_MS)).failure().to_string(),
        "service_lost: the service `/say` is not offered any more"
    );
}

#[test]
fn a_topic_counts_when_it_comes_often_enough() {
    let topics = BTreeMap::from([(name("/scan"), Some(5.0))]);
    let mut stage = Stage::new(Promise { topics, ..Promise::default() }, false);
    assert_eq!(missing(&stage.after(0)).what, "nobody published `/scan`");
    stage.add(OURS, "/lidar", &[], &["/scan"]);
    for count in 0..=20 {
        stage.counts.insert(name("/scan"), count);
        missing(&stage.after(90));
    }
    for count in 21..=25 {
        stage.counts.insert(name("/scan"), count);
        stage.after(100);
    }
    assert!(matches!(stage.after(0), Health::Holds { .. }));
    for _ in 0..20 {
        stage.after(250);
    }
    let health = stage.after(0);
    assert_eq!(missing(&health).code, FailureCode::TOPIC_SILENT);
    assert_eq!(missing(&health).what, "`/scan` does not come at 5 Hz any more");
    // The figure in the text stays: otherwise each look would cause a report.
    assert_eq!(stage.after(1000), health);
}

#[test]
fn a_hiccup_of_discovery_is_no_loss_but_a_dead_process_is_at_once() {
    let mut stage = Stage::new(nodes(&["/mapper"]), false);
    stage.add(OURS, "/mapper", &[], &[]);
    stage.after(0);
    stage.after(2000);
    stage.remove(OURS);
    assert!(matches!(stage.after(100), Health::Holds { .. }));
    stage.add(OURS, "/mapper", &[], &[]);
    assert_eq!(stage.after(1900), Health::Holds { since_ms: 1000 });
    stage.ours.remove(&OURS);
    stage.gone.insert(OURS);
    let health = stage.after(10);
    assert_eq!(
        missing(&health).failure().to_string(),
        "node_vanished: `/mapper` left the graph; its process is gone"
    );
}

#[test]
fn a_node_that_comes_back_is_brought_up_again_and_one_that_left_active_is_not() {
    let mut stage = Stage::new(lifecycle(&[("resolution", json!(0.1))]), true);
    stage.add(OURS, "/mapper", &[], &[]);
    assert!(matches!(stage.after(0), Health::Holds { .. }));
    // The node was brought up before this agent: no parameter is set, nothing is configured.
    stage.answers(&Ask::State, Answer::State(LifecycleState::Active));
    stage.after(2000);
    stage.answers(&Ask::State, Answer::State(LifecycleState::Inactive));
    stage.after(0);
    assert_eq!(stage.asked(), []);
    let health = stage.after(GRACE_MS);
    assert_eq!(
        missing(&health).failure().to_string(),
        "node_inactive: `/mapper` is not active any more; it is inactive"
    );

    let mut stage = Stage::new(lifecycle(&[("resolution", json!(0.1))]), true);
    stage.add(OURS, "/mapper", &[], &[]);
    stage.after(0);
    stage.answers(&Ask::State, Answer::State(LifecycleState::Active));
    stage.remove(OURS);
    stage.add(AGAIN, "/mapper", &[], &[]);
    // The node came back before its absence was noticed, but it is not active.
    assert_eq!(missing(&stage.after(10)).code, FailureCode::NODE_INACTIVE);
    stage.answers(&Ask::State, Answer::State(LifecycleState::Unconfigured));
    stage
        .answers(&Ask::Set(vec![("resolution".to_owned(), json!(0.1))]), Answer::Set(vec![Ok(())]));
    stage.answers(&Ask::Transition(Transition::Configure), Answer::Transition(true));
    stage.answers(&Ask::Transition(Transition::Activate), Answer::Transition(true));
    assert!(matches!(stage.after(10), Health::Holds { .. }));
}

#[test]
fn what_a_node_refuses_when_it_comes_back_degrades_the_task() {
    let mut stage = Stage::new(lifecycle(&[]), true);
    stage.add(AGAIN, "/mapper", &[], &[]);
    stage.after(0);
    stage.answers(&Ask::State, Answer::State(LifecycleState::Active));
    stage.remove(AGAIN);
    stage.add(OURS, "/mapper", &[], &[]);
    stage.after(10);
    stage.answers(&Ask::State, Answer::State(LifecycleState::Unconfigured));
    stage.answers(&Ask::Transition(Transition::Configure), Answer::Transition(false));
    stage.answers(&Ask::State, Answer::State(LifecycleState::Unconfigured));
    let health = stage.after(10);
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
    fn in_every_story_only_an_active_node_of_ours_holds(story in prop::collection::vec(events(), 1..60)) {
        let mut stage = Stage::new(lifecycle(&[("resolution", json!(0.1))]), false);
        let mut open: Vec<Question> = Vec::new();
        let mut was_refused = false;
        for event in story {
            match event {
                Event::Appear(participant) => {
                    stage.remove(participant);
                    stage.add(participant, "/mapper", &[], &[]);
                }
                Event::Vanish(participant) => stage.remove(participant),
                Event::Die(participant) if participant != OTHER => {
                    stage.ours.remove(&participant);
                    stage.gone.insert(participant);
                }
                Event::Die(_) => {}
                Event::Answer(answer) => {
                    if let Some(question) = open.pop() {
                        let fits = matches!(
                            (&question.ask, &answer),
                            (Ask::State, Answer::State(_)) | (Ask::Transition(_), Answer::Transition(_)) | (Ask::Set(_), Answer::Set(_))
                        );
                        stage.readiness.answered(&question, if fits { answer } else { Answer::None }, stage.now_ms);
                    }
                }
                Event::Wait(ms) => stage.now_ms += ms,
            }
            let health = stage.after(1);
            open.extend(stage.asked());
            // At most one pending question for each process's node.
            for participant in [OURS, AGAIN] {
                prop_assert!(open.iter().filter(|question| question.instance == participant).count() <= 2);
            }
            prop_assert!(open.iter().all(|question| question.instance != OTHER));
            let here = stage.snapshot.nodes.iter().any(|node| stage.ours.contains(&node.participant));
            if let Health::Holds { since_ms } = health {
                prop_assert!(since_ms <= stage.now_ms);
                prop_assert!(here || stage.readiness.was_ready, "held without a node of ours");
            }
            prop_assert!(!was_refused || matches!(health, Health::Refused(_)));
            was_refused = matches!(health, Health::Refused(_));
        }
    }
}
