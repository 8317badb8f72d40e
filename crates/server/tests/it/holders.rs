//! One user or one robot that takes as much of HTTP as possible, by ordinary tokens: others still
//! get their turn.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use reqwest::{Client, Method, StatusCode};
use serde_json::{Value, json};
use task_proto::api::{AccessToken, IDEMPOTENCY_KEY};
use task_transport::Trust;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpSocket;
use tokio::sync::Notify;
use tokio::task::JoinSet;
use tokio::time::timeout;

use crate::harness::{TestRobot, TestServer, answer, archive_of, client, refusal};
use crate::mqtt_harness::PATIENCE;
use crate::people::PASSWORD;

/// The connections of the server under attack.
const CONNECTIONS: usize = 48;
/// Sooner than the server gives up on a client that neither sends nor reads.
const SOON: Duration = Duration::from_secs(15);

impl TestServer {
    /// A new user with this role, signed in.
    pub async fn sign_in_as(&self, name: &str, role: &str) -> String {
        let user = json!({ "name": name, "roles": [role], "password": PASSWORD });
        let _: Value = self.post("/api/v1/users", &user).await;
        let request = self
            .bare(Method::POST, "/api/v1/login")
            .json(&json!({ "user": name, "password": PASSWORD }));
        answer::<AccessToken>(request).await.token
    }

    /// A client without connections.
    fn fresh_client(&self) -> Client {
        client(Trust::by(self.server.addresses().ca_pin))
    }
}

/// Behaviour of a client of the flood once its answer has begun.
#[derive(Clone, Copy, PartialEq)]
enum Afterwards {
    /// Reads nothing more.
    ReadsNothing,
    /// Sends nothing more, and reconnects when disconnected.
    SendsNothing,
}

/// Connections that each send one request, or the beginning of one, and then nothing.
struct Flood {
    answered: Arc<AtomicUsize>,
    progress: Arc<Notify>,
    _tasks: JoinSet<()>,
}

impl Flood {
    fn start(server: &TestServer, request: &str, afterwards: Afterwards) -> Self {
        let (answered, progress) = (Arc::<AtomicUsize>::default(), Arc::<Notify>::default());
        let mut tasks = JoinSet::new();
        for _ in 0..CONNECTIONS + 10 {
            let (address, request) =
                (server.server.addresses().http.parse().expect("an address"), request.to_owned());
            let (answered, progress) = (answered.clone(), progress.clone());
            tasks.spawn(async move {
                loop {
                    let socket = TcpSocket::new_v4().expect("a socket");
                    // A small buffer, so that unread data soon blocks the server.
                    socket.set_recv_buffer_size(4096).expect("set");
                    let Ok(mut stream) = socket.connect(address).await else { continue };
                    if stream.write_all(request.as_bytes()).await.is_err()
                        || stream.read_u8().await.is_err()
                    {
                        continue;
                    }
                    answered.fetch_add(1, Ordering::SeqCst);
                    progress.notify_one();
                    match afterwards {
                        Afterwards::ReadsNothing => std::future::pending().await,
                        Afterwards::SendsNothing => while stream.read_u8().await.is_ok() {},
                    }
                }
            });
        }
        Self { answered, progress, _tasks: tasks }
    }

    /// Waits until this number of connections have received the beginning of an answer.
    async fn reached(&self, answered: usize) {
        let reached = async {
            while self.answered.load(Ordering::SeqCst) < answered {
                self.progress.notified().await;
            }
        };
        timeout(PATIENCE, reached).await.expect("the flood comes in");
    }
}

async fn crowded_server() -> (TestServer, TestRobot, String) {
    let directory = tempfile::tempdir().expect("a directory");
    let server =
        TestServer::start_in(directory, |config| config.max_http_connections = CONNECTIONS).await;
    let robot = server.enroll("atlas").await;
    // More than the buffers between server and client hold.
    let package = server.push_content("talker", "1.0.0", archive_of(32 << 20, 7)).await;
    server.deploy(&package, "atlas", "first").await;
    let blob = format!("/v2/talker/blobs/{}", package.content.digest);
    (server, robot, blob)
}

/// An operator stops the task, and the robot is told, by connections that have to be made now.
async fn is_stopped_soon(server: &TestServer, robot: &TestRobot) {
    let (operator, agent) = (server.fresh_client(), server.fresh_client());
    let stop = operator
        .post(server.url("/api/v1/tasks/talker/stop"))
        .bearer_auth(server.operator.reveal());
    let stop = stop.header(IDEMPOTENCY_KEY, "stop").json(&json!({ "selector": "atlas" }));
    let stopped = timeout(SOON, stop.send())
        .await
        .expect("the operator gets a connection")
        .expect("an answer");
    assert_eq!(stopped.status(), StatusCode::OK, "{}", stopped.text().await.unwrap_or_default());
    let ask = agent
        .get(server.url(&format!("/api/v1/robots/{}/desired", robot.id)))
        .bearer_auth(&robot.token);
    let told =
        timeout(SOON, ask.send()).await.expect("the robot gets a connection").expect("an answer");
    assert_eq!(told.status(), StatusCode::OK);
}

#[tokio::test(flavor = "multi_thread")]
async fn viewer_with_every_connection_does_not_block_a_stop() {
    let (server, robot, blob) = crowded_server().await;
    let viewer = server.sign_in_as("mallory", "viewer").await;
    let request =
        format!("GET {blob} HTTP/1.1\r\nhost: x\r\nauthorization: Bearer {viewer}\r\n\r\n");
    let flood = Flood::start(&server, &request, Afterwards::ReadsNothing);
    flood.reached(CONNECTIONS).await;
    is_stopped_soon(&server, &robot).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn robot_with_every_connection_does_not_block_a_stop() {
    let (server, robot, _) = crowded_server().await;
    let rogue = server.enroll("rogue").await;
    // The answer that begins says that the body may come.
    let request = format!(
        "POST /api/v1/robots/{}/report HTTP/1.1\r\nhost: x\r\nauthorization: Bearer {}\r\n\
         content-type: application/json\r\ncontent-length: 9999\r\nexpect: 100-continue\r\n\r\n",
        rogue.id, rogue.token
    );
    let flood = Flood::start(&server, &request, Afterwards::SendsNothing);
    flood.reached(CONNECTIONS).await;
    is_stopped_soon(&server, &robot).await;
}

/// Answers by status, as they come on all connections of a pipelining client.
#[derive(Debug, Default)]
struct Answers {
    served: AtomicUsize,
    refused: AtomicUsize,
}

/// Sends the request `times` on one connection and counts the answers until the server ends the
/// connection.
async fn pipeline(server: &TestServer, request: &str, times: usize, answers: &Answers) {
    let stream = tokio::net::TcpStream::connect(&server.server.addresses().http)
        .await
        .expect("a connection");
    let (mut read, mut write) = stream.into_split();
    let last = request.replace("\r\n\r\n", "\r\nconnection: close\r\n\r\n");
    let requests = [request.repeat(times - 1), last].concat();
    let send = async { write.write_all(requests.as_bytes()).await.expect("sent") };
    let receive = async {
        let (mut buffer, mut seen) = (vec![0; 64 * 1024], Vec::new());
        loop {
            let length = read.read(&mut buffer).await.expect("read");
            seen.extend_from_slice(&buffer[..length]);
            for (status, count) in
                [(b"HTTP/1.1 200 ", &answers.served), (b"HTTP/1.1 429 ", &answers.refused)]
            {
                let found = seen.windows(status.len()).filter(|window| window == status).count();
                count.fetch_add(found, Ordering::SeqCst);
            }
            if length == 0 {
                return;
            }
            // A status that is cut in two is found when its rest has come.
            let rest = seen.len().saturating_sub(b"HTTP/1.1 200 ".len() - 1);
            seen.drain(..rest);
        }
    };
    tokio::join!(send, receive);
}

#[tokio::test(flavor = "multi_thread")]
async fn eight_thousand_lists_of_one_viewer_do_not_delay_a_robot() {
    let directory = tempfile::tempdir().expect("a directory");
    let server = TestServer::start_in(directory, |config| config.people.requests_per_s = 20).await;
    let robot = server.enroll("atlas").await;
    for n in 0..10 {
        server.enroll(&format!("robot{n}")).await;
    }
    let viewer = server.sign_in_as("mallory", "viewer").await;
    let request =
        format!("GET /api/v1/robots HTTP/1.1\r\nhost: x\r\nauthorization: Bearer {viewer}\r\n\r\n");
    let answers = Answers::default();
    let flood = async {
        let connections = (0..200).map(|_| pipeline(&server, &request, 40, &answers));
        futures_util::future::join_all(connections).await;
    };
    let watch = async {
        while answers.served.load(Ordering::SeqCst) == 0 {
            tokio::task::yield_now().await;
        }
        let mut overtaken = Vec::new();
        for _ in 0..20 {
            let before = answers.served.load(Ordering::SeqCst);
            assert_eq!(server.ask_desired(&robot).await.status(), StatusCode::OK);
            overtaken.push(answers.served.load(Ordering::SeqCst) - before);
        }
        overtaken.sort_unstable();
        let [median, most] = [overtaken[10], overtaken[19]];
        assert!(
            median < 40 && most < 120,
            "lists that were served while the robot waited: {overtaken:?}"
        );
    };
    // The last connections of the flood are slowed, not refused, so it takes long to end.
    let most_refused = async {
        while answers.refused.load(Ordering::SeqCst) <= 4_000 {
            tokio::task::yield_now().await;
        }
    };
    let watched = async { tokio::join!(watch, most_refused) };
    tokio::select! {
        () = flood => panic!("the flood ended: {answers:?}"),
        ended = timeout(4 * PATIENCE, watched) => drop(ended.expect("most are refused")),
    }
    let (served, refused) = (answers.served.into_inner(), answers.refused.into_inner());
    assert!(served < refused, "{served} were served, {refused} refused");
}

#[tokio::test(flavor = "multi_thread")]
async fn person_over_the_rate_gets_retry_after_and_may_still_order() {
    let directory = tempfile::tempdir().expect("a directory");
    let server = TestServer::start_in(directory, |config| config.people.requests_per_s = 2).await;
    server.enroll("atlas").await;
    let package = server.push("talker", "1.0.0").await;
    let refused = async || loop {
        let asked = (0..30).map(|_| server.request(Method::GET, "/api/v1/me").send());
        let answers = futures_util::future::join_all(asked)
            .await
            .into_iter()
            .map(|answer| answer.expect("an answer"));
        if let Some(refused) =
            answers.into_iter().find(|answer| answer.status() == StatusCode::TOO_MANY_REQUESTS)
        {
            return refused;
        }
    };
    let refused = timeout(PATIENCE, refused()).await.expect("refused");
    let seconds: u64 =
        refused.headers()["retry-after"].to_str().expect("text").parse().expect("seconds");
    assert!((1..=11).contains(&seconds), "{seconds}");
    assert!(refused.text().await.expect("a body").contains("too many requests"));
    server.deploy(&package, "atlas", "order").await;
}

#[tokio::test(flavor = "multi_thread")]
async fn person_has_one_upload_at_a_time() {
    let server = TestServer::start().await;
    let publisher = server.sign_in_as("alice", "publisher").await;
    let upload = |token: &str, body: reqwest::Body| {
        let request = server.bare(Method::POST, "/api/v1/packages").bearer_auth(token);
        request.header("content-type", "application/x-tar").body(body)
    };
    let endless = || {
        reqwest::Body::wrap_stream(
            futures_util::stream::pending::<Result<Vec<u8>, std::io::Error>>(),
        )
    };
    // The other upload may have the place for a moment.
    let first = async { while refusal(upload(&publisher, endless())).await.0 == 429 {} };
    let second = async { while refusal(upload(&publisher, "hello".into())).await.0 != 429 {} };
    tokio::select! {
        () = first => panic!("an upload without an end had one"),
        refused = timeout(PATIENCE, second) => refused.expect("no second one"),
    }
    let operator = server.operator.reveal();
    assert_eq!(
        refusal(upload(&operator, "hello".into())).await.0,
        422,
        "another person has a place"
    );
}
