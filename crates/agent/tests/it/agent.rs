//! The agent's HTTP half against a server that misbehaves: which answers count as a refusal, which
//! as a stranger's, and which the agent obeys.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use axum::Router;
use axum::extract::State;
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use task_agent::link::rotation::Rotation;
use task_agent::link::state::{self, LinkState, MqttState, PollIntervals, ServerMessage};
use task_agent::reconcile::admission::{self, AdmissionError};
use task_agent::system::identity::Identity;
use task_agent::transfer::credential::Credential;
use task_agent::transfer::server::{self, Server, ServerError};
use task_proto::desired::DesiredState;
use task_proto::messages::report::{HostFacts, Report};
use task_proto::trust::envelope::{DESIRED_STATE_TYPE, Envelope, SigningKey};
use task_proto::{Generation, InstanceId, RobotId};
use task_transport::Trust;
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;

/// Time limit for events that should come at once.
const PATIENCE: Duration = Duration::from_secs(20);
const REFUSAL: &str = r#"{"error":{"code":"unauthorized","message":"no such token"}}"#;

/// A tag in the server's format: more than the generation, and opaque to clients.
const TAG: &str = "\"1-0123456789abcdef\"";

/// One answer: status, content type, body.
type Canned = (u16, &'static str, String);

struct Fake {
    answer: Mutex<Canned>,
    asked_with: Mutex<Vec<Option<String>>>,
}

impl Fake {
    async fn start(answer: Canned) -> (Arc<Self>, reqwest::Url) {
        let fake = Arc::new(Self { answer: Mutex::new(answer), asked_with: Mutex::default() });
        let routes = Router::new()
            .route("/api/v1/robots/{id}/desired", get(answer_canned))
            .route("/api/v1/robots/{id}/report", post(answer_canned))
            .route("/api/v1/robots/{id}/token", post(answer_canned))
            .with_state(fake.clone());
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        tokio::spawn(async move { axum::serve(listener, routes).await.unwrap() });
        (fake, format!("http://{address}/").parse().unwrap())
    }

    fn set(&self, answer: Canned) {
        *self.answer.lock().unwrap() = answer;
    }
}

async fn answer_canned(State(fake): State<Arc<Fake>>, headers: HeaderMap) -> Response {
    let known = headers.get(header::IF_NONE_MATCH).map(|value| value.to_str().unwrap().to_owned());
    fake.asked_with.lock().unwrap().push(known);
    let (status, kind, body) = fake.answer.lock().unwrap().clone();
    let headers = [(header::CONTENT_TYPE, kind), (header::RETRY_AFTER, "7"), (header::ETAG, TAG)];
    (StatusCode::from_u16(status).unwrap(), headers, body).into_response()
}

/// A client that never meets a certificate.
fn plain_client() -> reqwest::Client {
    server::client(Trust::System.client_config(task_agent::system::clock::for_certificates()))
        .unwrap()
}

fn server(url: &reqwest::Url, robot: &RobotId) -> Server {
    Server::new(plain_client(), url.clone(), robot.clone(), "tskr_secret".to_owned())
}

fn state(robot: &RobotId, generation: u64) -> DesiredState {
    DesiredState {
        robot_id: robot.clone(),
        generation: Generation(generation),
        issued_at_ms: 1,
        expires_at_ms: u64::MAX,
        tasks: Vec::new(),
        evidence: Default::default(),
        settings: Default::default(),
        robot: Default::default(),
    }
}

fn sealed(state: &DesiredState, key: &SigningKey) -> Canned {
    let envelope = Envelope::seal(DESIRED_STATE_TYPE, &serde_json::to_vec(state).unwrap(), key);
    (200, "application/json", serde_json::to_string(&envelope).unwrap())
}

#[tokio::test]
async fn only_the_servers_error_body_is_a_refusal() {
    let (fake, url) = Fake::start((401, "application/json", REFUSAL.to_owned())).await;
    let server = server(&url, &RobotId::random());
    assert!(matches!(server.desired(None).await, Err(ServerError::TokenRefused(_))));
    for status in [200, 302, 401, 403, 404] {
        fake.set((
            status,
            "text/html",
            "<html>Please sign in to the hotel's network</html>".to_owned(),
        ));
        let error = server.desired(None).await.unwrap_err();
        assert!(matches!(error, ServerError::NotTheServer(_)), "{status}: {error:?}");
    }
    fake.set((503, "text/html", "<html>".to_owned()));
    let busy = server.desired(None).await.unwrap_err();
    assert!(matches!(
        busy,
        ServerError::Busy { status: 503, retry_after: Some(wait) } if wait.as_secs() == 7
    ));
    fake.set((409, "application/json", REFUSAL.replace("unauthorized", "diverged")));
    assert!(matches!(
        server.desired(None).await,
        Err(ServerError::Refused { code, .. }) if code == "diverged"
    ));
    fake.set((304, "application/json", String::new()));
    assert!(server.desired(None).await.unwrap().is_none());
}

#[tokio::test]
async fn new_token_is_stored_before_use_and_the_old_one_kept_until_it_works() {
    let robot = RobotId::random();
    let (fake, url) = Fake::start((201, "application/json", r#"{"token":"new"}"#.to_owned())).await;
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("identity.json");
    let identity = Identity {
        robot_id: robot.clone(),
        token: "old".to_owned(),
        next_token: None,
        token_since_ms: 1_000,
        server: url.to_string(),
        server_key: SigningKey::random().public_key(),
        ca_pin: None,
        client_key: None,
        mqtt: task_proto::api::MqttEndpoint {
            host: None,
            port: 1,
            prefix: Default::default(),
            tls: false,
            external: None,
            alternatives: Vec::new(),
        },
        mac: "02:00:00:00:00:01".parse().unwrap(),
        awaits_approval: false,
    };
    identity.write(&path).unwrap();
    let credential = Credential::from("old".to_owned());
    let server = Server::new(plain_client(), url.clone(), robot, credential.clone());
    let lifetime = Duration::from_secs(3600);
    let mut rotation =
        Rotation { server, credential: credential.clone(), identity, path: path.clone(), lifetime };
    let tokens = || {
        let Identity { token, next_token, .. } = Identity::read(&path).unwrap();
        (token, next_token, credential.current())
    };
    let is = |token: &str, next: Option<&str>| {
        (token.to_owned(), next.map(str::to_owned), token.to_owned())
    };

    rotation.step(1_000 + 3_599_999).await;
    assert_eq!(tokens(), is("old", None), "too young");
    rotation.step(1_000 + 3_600_000).await;
    assert_eq!(tokens(), is("old", Some("new")));
    // No answer: the server may have accepted the report or not, so both are kept.
    fake.set((503, "text/plain", String::new()));
    rotation.step(4_000_000).await;
    assert_eq!(tokens(), is("old", Some("new")));
    fake.set((401, "application/json", REFUSAL.to_owned()));
    rotation.step(4_000_000).await;
    assert_eq!(tokens(), is("old", None), "it is good for nothing");
    fake.set((201, "application/json", r#"{"token":"newer"}"#.to_owned()));
    rotation.step(8_000_000).await;
    fake.set((409, "application/json", REFUSAL.replace("unauthorized", "diverged")));
    rotation.step(8_000_000).await;
    assert_eq!(tokens(), is("newer", None), "the refused robot was recognised");
    // The robot was registered anew beside the running agent.
    let anew = Identity { token: "anew".to_owned(), ..Identity::read(&path).unwrap() };
    anew.write(&path).unwrap();
    fake.set((201, "application/json", r#"{"token":"lost"}"#.to_owned()));
    rotation.step(80_000_000).await;
    assert_eq!(Identity::read(&path).unwrap().token, "anew");
}

#[tokio::test]
async fn altered_foreign_and_old_states_are_refused() {
    let (key, robot) = (SigningKey::random(), RobotId::random());
    let (fake, url) = Fake::start(sealed(&state(&robot, 3), &key)).await;
    let server = server(&url, &robot);
    let admit = |envelope: &Envelope, accepted: Option<&DesiredState>| {
        admission::admit(envelope, &key.public_key(), &robot, accepted, 2)
    };
    let accepted = admit(&server.desired(None).await.unwrap().unwrap().envelope, None).unwrap();
    assert_eq!(accepted.generation, Generation(3));

    let (status, kind, body) = sealed(&state(&robot, 4), &key);
    let at = body.find("payload\":\"").unwrap() + 20;
    let other = if &body[at..=at] == "A" { "B" } else { "A" };
    fake.set((status, kind, format!("{}{other}{}", &body[..at], &body[at + 1..])));
    let altered = admit(&server.desired(None).await.unwrap().unwrap().envelope, Some(&accepted));
    assert!(matches!(altered, Err(AdmissionError::Signature(_))), "{altered:?}");

    fake.set(sealed(&state(&RobotId::random(), 4), &key));
    let foreign = admit(&server.desired(None).await.unwrap().unwrap().envelope, Some(&accepted));
    assert!(matches!(foreign, Err(AdmissionError::OtherRobot(_))));

    fake.set(sealed(&state(&robot, 2), &key));
    let old = admit(&server.desired(None).await.unwrap().unwrap().envelope, Some(&accepted));
    assert!(matches!(old, Err(AdmissionError::Stale { .. })));
}

#[tokio::test]
async fn report_is_sent_again_until_it_is_stored() {
    let robot = RobotId::random();
    let (fake, url) = Fake::start((503, "text/plain", String::new())).await;
    let link_state = LinkState::new(CancellationToken::new());
    let report = Report {
        robot_id: robot.clone(),
        start: 1,
        instance: InstanceId::random(),
        place: None,
        boot_id: "boot".to_owned(),
        seq: 1,
        observed_generation: Generation(0),
        uptime_ms: 0,
        host: HostFacts::default(),
        conditions: Vec::new(),
        link: None,
        tasks: Vec::new(),
    };
    link_state.reports.send_replace(Some(Arc::new(report)));
    let (server_messages, mut messages) = mpsc::channel(4);
    let posting =
        tokio::spawn(state::post(server(&url, &robot), link_state.clone(), server_messages));
    let asked = async {
        while fake.asked_with.lock().unwrap().is_empty() {
            tokio::task::yield_now().await;
        }
    };
    tokio::time::timeout(PATIENCE, asked).await.unwrap();
    fake.set((
        200,
        "application/json",
        r#"{"generation":0,"name":"atlas","labels":{}}"#.to_owned(),
    ));
    let confirmed = tokio::time::timeout(PATIENCE, messages.recv()).await.unwrap().unwrap();
    assert!(matches!(
        confirmed,
        ServerMessage::Confirmed { seq: 1, reply: Some(reply) } if reply.name.as_str() == "atlas"
    ));
    link_state.shutdown.cancel();
    posting.await.unwrap();
}

#[tokio::test]
async fn polling_continues_after_every_kind_of_answer() {
    let (key, robot) = (SigningKey::random(), RobotId::random());
    let (fake, url) = Fake::start((401, "application/json", REFUSAL.to_owned())).await;
    let link_state = LinkState::new(CancellationToken::new());
    let (server_messages, mut messages) = mpsc::channel(1);
    let intervals =
        PollIntervals { slow: Duration::from_millis(20), fast: Duration::from_millis(10) };
    let polling = tokio::spawn(state::poll(
        server(&url, &robot),
        link_state.clone(),
        intervals,
        server_messages,
    ));
    let answers = [(200, "text/html", "<html>".to_owned()), sealed(&state(&robot, 1), &key)];
    let mut next = async || tokio::time::timeout(PATIENCE, messages.recv()).await.unwrap().unwrap();
    assert!(matches!(next().await, ServerMessage::TokenRefused(_)));
    for (answer, is_state) in answers.into_iter().zip([false, true]) {
        fake.set(answer);
        loop {
            match next().await {
                ServerMessage::StateUnavailable { code, .. } if !is_state => {
                    break assert_eq!(code, "server_unreachable");
                }
                ServerMessage::Desired { .. } if is_state => break,
                _ => {}
            }
        }
    }
    link_state.shutdown.cancel();
    drop(messages);
    polling.await.unwrap();
}

#[tokio::test]
async fn unannounced_order_is_found_by_polling_while_mqtt_is_up() {
    let (key, robot) = (SigningKey::random(), RobotId::random());
    let (fake, url) = Fake::start(sealed(&state(&robot, 1), &key)).await;
    let link_state = LinkState::new(CancellationToken::new());
    link_state.mqtt.send_replace(MqttState::UpAtExternalBroker);
    link_state.settled.send_replace(true);
    let (server_messages, mut messages) = mpsc::channel(1);
    let intervals =
        PollIntervals { slow: Duration::from_millis(50), fast: Duration::from_secs(3600) };
    let polling = tokio::spawn(state::poll(
        server(&url, &robot),
        link_state.clone(),
        intervals,
        server_messages,
    ));
    let mut next = async || tokio::time::timeout(PATIENCE, messages.recv()).await.unwrap().unwrap();
    assert!(matches!(next().await, ServerMessage::Desired { .. }));
    fake.set((304, "application/json", String::new()));
    while !matches!(next().await, ServerMessage::Unchanged) {}
    fake.set(sealed(&state(&robot, 2), &key));
    let is_found = |server_messages| match server_messages {
        ServerMessage::Desired { envelope, .. } => {
            admission::open(&envelope, &key.public_key(), &robot).unwrap().generation
                == Generation(2)
        }
        _ => false,
    };
    while !is_found(next().await) {}
    // A session measures the distance to the server better; without a session the answers' times
    // are used.
    let facts = || link_state.meter.facts(tokio::time::Instant::now());
    assert_eq!(facts(), None);
    link_state.mqtt.send_replace(MqttState::Down);
    link_state.poll.notify_one();
    let measured = async {
        while facts().is_none() {
            next().await;
        }
    };
    tokio::time::timeout(PATIENCE, measured).await.unwrap();
    assert!(facts().unwrap().rtt_ms.is_some());
    link_state.shutdown.cancel();
    drop(messages);
    polling.await.unwrap();
}

#[tokio::test]
async fn unchanged_state_is_sent_again_only_to_an_unsettled_robot() {
    let (key, robot) = (SigningKey::random(), RobotId::random());
    let (fake, url) = Fake::start(sealed(&state(&robot, 1), &key)).await;
    let link_state = LinkState::new(CancellationToken::new());
    let (server_messages, mut messages) = mpsc::channel(1);
    let never = Duration::from_secs(3600);
    let polling = tokio::spawn(state::poll(
        server(&url, &robot),
        link_state.clone(),
        PollIntervals { slow: never, fast: never },
        server_messages,
    ));
    let mut next = async || tokio::time::timeout(PATIENCE, messages.recv()).await.unwrap().unwrap();
    assert!(matches!(next().await, ServerMessage::Desired { .. }));

    link_state.settled.send_replace(true);
    fake.set((304, "application/json", String::new()));
    link_state.poll.notify_one();
    assert!(matches!(next().await, ServerMessage::Unchanged));

    // As when half of its lifetime is over.
    link_state.settled.send_replace(false);
    fake.set(sealed(&state(&robot, 1), &key));
    link_state.poll.notify_one();
    assert!(matches!(next().await, ServerMessage::Desired { .. }));
    assert_eq!(*fake.asked_with.lock().unwrap(), [None, Some(TAG.to_owned()), None]);
    link_state.shutdown.cancel();
    polling.await.unwrap();
}
