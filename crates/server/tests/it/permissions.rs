//! Determines permissions by trying: every client kind calls every HTTP route, and publishes and
//! subscribes on every MQTT topic of a robot. The results are docs/permissions.md. After an
//! intended change: `UPDATE_GOLDEN=1 cargo test -p taskd --test it permissions`. A new route of the
//! table is tried without further work; give it a body in `body` and values for its parameters in
//! `Fixture::path`, if needed.

use std::fmt::Write as _;
use std::path::Path;
use std::time::Duration;

use reqwest::Method;
use serde_json::{Value, json};
use task_proto::api::{DeploymentView, EnrollmentToken, ServerInfo, TokenOrigin};
use task_proto::desired::PackageRef;
use task_proto::messages::topic::RobotTopic;
use task_proto::people::roles::{Permission, Role, Roles};
use task_proto::trust::token::{Token, TokenKind};
use task_proto::{Digest, UserName};
use taskd::config::{Config, OidcSettings};
use taskd::http::{Route, routes};
use taskd::store::{NewToken, Store, User, sqlite_url};

use crate::harness::{NOW_MS, TestRobot, TestServer, answer};
use crate::mqtt_harness::{Connect, PATIENCE, Raw, publish, subscribe, topic};

const DOCUMENT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/permissions.md");

/// All kinds of clients.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum TestCaller {
    Nobody,
    Enrollment,
    Itself,
    OtherRobot,
    Person(Role),
    /// A user with this role, limited to another robot.
    Elsewhere(Role),
}

impl TestCaller {
    const ALL: [Self; 10] = [
        Self::Nobody,
        Self::Enrollment,
        Self::Itself,
        Self::OtherRobot,
        Self::Person(Role::Viewer),
        Self::Person(Role::Operator),
        Self::Person(Role::Publisher),
        Self::Person(Role::Admin),
        Self::Elsewhere(Role::Operator),
        Self::Elsewhere(Role::Admin),
    ];

    fn title(self) -> String {
        match self {
            Self::Nobody => "nobody".to_owned(),
            Self::Enrollment => "enrollment token".to_owned(),
            Self::Itself => "the robot".to_owned(),
            Self::OtherRobot => "another robot".to_owned(),
            Self::Person(role) => role.to_string(),
            Self::Elsewhere(role) => format!("{role} elsewhere"),
        }
    }
}

/// A call to try.
struct Probe {
    title: String,
    method: Method,
    path: String,
    body: Option<Value>,
}

/// A server with one client of each kind.
struct Fixture {
    server: TestServer,
    /// The server's database, where users and tokens are created without hashing and signing in.
    store: Store,
    robot: TestRobot,
    other_robot: TestRobot,
    enrollment: String,
    package: PackageRef,
    deployment: DeploymentView,
}

impl Fixture {
    async fn new() -> Self {
        // The provider does not answer: only permission to go there counts.
        let issuer = "http://127.0.0.1:9".to_owned();
        let oidc = OidcSettings {
            issuer,
            public_url: "http://127.0.0.1".to_owned(),
            ..OidcSettings::default()
        };
        let directory = tempfile::TempDir::new().expect("a directory");
        let configure = |config: &mut Config| {
            config.oidc = oidc;
            // The same robot repeats forbidden actions without a back-off.
            config.robots.backoff = Duration::ZERO;
        };
        let server = TestServer::start_in(directory, configure).await;
        let store =
            Store::open(&sqlite_url(&server.data().join("taskd.sqlite"))).await.expect("opens");
        let (robot, other_robot) = (server.enroll("atlas").await, server.enroll("boreas").await);
        let (talker, package) =
            (server.push("talker", "1.0.0").await, server.push("walker", "1.0.0").await);
        let deployment = server.deploy(&talker, "atlas", "talker").await;
        server.deploy(&package, "atlas", "walker").await;
        let enrollment: EnrollmentToken =
            server.post("/api/v1/enrollment-tokens", &json!({})).await;
        Self {
            server,
            store,
            robot,
            other_robot,
            enrollment: enrollment.token,
            package,
            deployment,
        }
    }

    /// A fresh token of a user with the original role and scope.
    async fn sign_in(&self, user: &str, role: Role, scope: Option<&str>) -> Token {
        let name: UserName = user.parse().expect("a name");
        let scope = scope.map(|scope| scope.parse().expect("a selector"));
        let user = User {
            name: name.clone(),
            roles: Roles::one(role),
            scope,
            password: None,
            subject: None,
            created_at_ms: NOW_MS,
        };
        let token = Token::random(TokenKind::Operator);
        let mut write = self.store.begin().await.expect("begins");
        write.users().put(&user).await.expect("stored");
        let new = NewToken {
            token: &token,
            user: &name,
            origin: TokenOrigin::Login,
            title: "",
            roles: None,
            scope: None,
            expires_at_ms: NOW_MS + 3_600_000,
        };
        write.tokens().create(&new, NOW_MS).await.expect("stored");
        write.commit().await.expect("stored");
        token
    }

    async fn token(&self, caller: TestCaller) -> Option<String> {
        Some(match caller {
            TestCaller::Nobody => return None,
            TestCaller::Enrollment => self.enrollment.clone(),
            TestCaller::Itself => self.robot.token.clone(),
            TestCaller::OtherRobot => self.other_robot.token.clone(),
            TestCaller::Person(role) => self.sign_in(role.as_str(), role, None).await.reveal(),
            TestCaller::Elsewhere(role) => {
                self.sign_in(&format!("{role}2"), role, Some("boreas")).await.reveal()
            }
        })
    }

    /// The path with values for its parameters: existing objects that may be deleted.
    async fn path(&self, probe: &Probe) -> String {
        let mut path = probe.path.replace("{deployment}", self.deployment.id.as_str());
        if path.contains("{robot}") {
            let robot = match probe.method == Method::DELETE || path.ends_with("/revoke") {
                true => self.server.enroll(&format!("gone-{:08x}", rand::random::<u32>())).await.id,
                false => self.robot.id.clone(),
            };
            path = path.replace("{robot}", robot.as_str());
        }
        if path.contains("{enrollment}") {
            let token: EnrollmentToken =
                self.server.post("/api/v1/enrollment-tokens", &json!({})).await;
            path = path.replace("{enrollment}", &token.id);
        }
        if path.contains("{user}") || path.contains("{token}") {
            let token = self.sign_in("bob", Role::Viewer, None).await;
            path = path.replace("{user}", "bob").replace("{token}", &token.id());
        }
        path = path
            .replace("{task}", "walker")
            .replace("{node}", "rack-1")
            .replace("{*file}", "app.js")
            .replace("{itself}", self.robot.id.as_str());
        path = path.replace("{package}", "walker").replace("{version}", "1.0.0");
        path = path.replace("{blob}", &self.package.content.digest.to_string());
        assert!(
            !path.contains('{'),
            "{path}: this test has to be told of a value for the parameter"
        );
        path
    }

    /// The result of the call: `✓`, or the status of the refusal.
    async fn outcome(&self, probe: &Probe, caller: TestCaller) -> String {
        let mut request = self.server.bare(probe.method.clone(), &self.path(probe).await);
        if let Some(token) = self.token(caller).await {
            request = request.bearer_auth(token);
        }
        if let Some(body) = &probe.body {
            request = request
                .header("idempotency-key", format!("{:08x}", rand::random::<u32>()))
                .json(body);
        }
        let response = request.send().await.expect("an answer");
        let status = response.status();
        assert!(
            !status.is_server_error() || status.as_u16() == 504,
            "{} by {caller:?}: {status}",
            probe.title
        );
        let is_registry = probe.path.starts_with("/v2");
        match status.as_u16() {
            refused @ (401 | 403) => refused.to_string(),
            // The registry hides nothing: there, 404 means absent.
            404 if !is_registry => "404".to_owned(),
            _ => "✓".to_owned(),
        }
    }

    /// A session with the comer's credentials; `None` if the session is refused.
    async fn connect(&self, caller: TestCaller) -> Option<Raw> {
        let (client_id, user_name) = match caller {
            TestCaller::Itself => (self.robot.id.to_string(), self.robot.id.to_string()),
            TestCaller::OtherRobot => {
                (self.other_robot.id.to_string(), self.other_robot.id.to_string())
            }
            _ => (String::new(), "anyone".to_owned()),
        };
        let password = self.token(caller).await;
        let connect = Connect {
            client_id,
            user_name: password.is_some().then_some(user_name),
            password,
            clean: true,
            keep_alive_s: 0,
            will: None,
        };
        let stream = tokio::net::TcpStream::connect(&self.server.server.addresses().mqtt)
            .await
            .expect("listens");
        let mut raw = Raw { stream };
        raw.send(&connect.packet()).await;
        (raw.read(4).await? == [0x20, 2, 0, 0]).then_some(raw)
    }

    async fn messages_refused(&self) -> u64 {
        self.server.get::<ServerInfo>("/api/v1/server").await.traffic.messages_refused
    }

    async fn publishes(&self, caller: TestCaller, topic: &str, payload: &[u8]) -> String {
        let Some(mut raw) = self.connect(caller).await else { return "–".to_owned() };
        let before = self.messages_refused().await;
        raw.send(&publish(topic, 1, 7, payload)).await;
        let is_acknowledged = raw.read(4).await.is_some_and(|answer| answer == [0x40, 2, 0, 7]);
        let is_refused = self.messages_refused().await > before;
        assert_ne!(is_acknowledged, is_refused, "{topic} by {caller:?}");
        if is_acknowledged { "✓" } else { "no" }.to_owned()
    }

    async fn subscribes(&self, caller: TestCaller, filter: &str) -> String {
        let Some(mut raw) = self.connect(caller).await else { return "–".to_owned() };
        raw.send(&subscribe(7, &[(filter, 1)])).await;
        let answer = raw.read(5).await.expect("a SUBACK");
        assert_eq!(answer[..4], [0x90, 3, 0, 7], "{filter} by {caller:?}");
        if answer[4] == 0x80 { "no" } else { "✓" }.to_owned()
    }
}

impl Raw {
    /// Reads exactly `count` bytes; `None` if the other side closes earlier.
    pub async fn read(&mut self, count: usize) -> Option<Vec<u8>> {
        use tokio::io::AsyncReadExt as _;
        let mut bytes = vec![0; count];
        let read = tokio::time::timeout(PATIENCE, self.stream.read_exact(&mut bytes));
        read.await.expect("an answer or an end").ok().map(|_| bytes)
    }
}

/// A request body that the route accepts as far as this test needs.
fn body(method: &Method, path: &str) -> Option<Value> {
    Some(match (method.as_str(), path) {
        ("POST", "/api/v1/deployments") => {
            let digest = Digest::of(b"x");
            json!({ "package": "walker", "manifest": digest, "selector": "atlas", "dry_run": true })
        }
        ("POST", "/api/v1/deployments/{deployment}/retry") => json!({ "dry_run": true }),
        ("POST", "/api/v1/bulk/labels") => {
            json!({ "selector": "atlas", "set": { "site": "lab" }, "dry_run": true })
        }
        ("POST", "/api/v1/bulk/remove") => json!({ "selector": "atlas", "dry_run": true }),
        ("POST", path) if path.starts_with("/api/v1/tasks/") => {
            json!({ "selector": "atlas", "dry_run": true })
        }
        ("POST", "/api/v1/robots/{robot}/ask") => json!({ "type": "nodes" }),
        ("POST", "/api/v1/users") => {
            json!({ "name": format!("new-{:08x}", rand::random::<u32>()), "roles": ["viewer"] })
        }
        ("PUT", "/api/v1/users/{user}/password") => json!({ "password": "correct horse battery" }),
        ("PUT", "/api/v1/password") => {
            json!({ "old": "correct horse battery", "new": "another long password" })
        }
        ("POST" | "PUT" | "PATCH", _) => json!({}),
        _ => return None,
    })
}

fn probes(route: &Route) -> Vec<Probe> {
    let probe = |title: &str, method: &Method, path: &str, body: Option<Value>| Probe {
        title: format!("`{method} {title}`"),
        method: method.clone(),
        path: path.to_owned(),
        body,
    };
    let Some(method) = &route.method else { return registry_probes(route.path) };
    let mut probes = vec![probe(route.path, method, route.path, body(method, route.path))];
    match (method.as_str(), route.path) {
        ("POST", "/api/v1/robots/{robot}/ask") => {
            let change =
                json!({ "type": "lifecycle", "node": "/talker", "transition": "activate" });
            let mut changing = probe(route.path, method, route.path, Some(change));
            changing.title += " that changes something";
            probes.push(changing);
        }
        ("GET", "/api/v1/tokens") => {
            probes.push(probe("/api/v1/tokens?all=true", method, "/api/v1/tokens?all=true", None));
        }
        _ => {}
    }
    probes
}

/// Below `/v2` a handler looks at the method itself.
fn registry_probes(path: &str) -> Vec<Probe> {
    let cases: &[(&str, &str, &str)] = match path {
        "/v2/{*path}" => &[
            ("GET", "/v2/walker/tags/list", "/v2/NAME/tags/list"),
            ("GET", "/v2/walker/manifests/1.0.0", "/v2/NAME/manifests/TAG"),
            ("GET", "/v2/walker/referrers/{blob}", "/v2/NAME/referrers/DIGEST"),
            ("GET", "/v2/walker/blobs/{blob}", "/v2/NAME/blobs/DIGEST"),
            ("POST", "/v2/walker/blobs/uploads/", "/v2/NAME/blobs/uploads/"),
            ("PUT", "/v2/walker/manifests/2.0.0", "/v2/NAME/manifests/TAG"),
            ("DELETE", "/v2/walker/manifests/none", "/v2/NAME/manifests/TAG"),
            ("DELETE", "/v2/other/blobs/{blob}", "/v2/NAME/blobs/DIGEST"),
            ("PUT", "/v2/taskd/publishers/manifests/1", "/v2/taskd/publishers/manifests/TAG"),
            ("DELETE", "/v2/taskd/publishers/manifests/none", "/v2/taskd/publishers/manifests/TAG"),
            ("GET", "/v2/outputs/{itself}/mapping/tags/list", "/v2/outputs/ROBOT/TASK/tags/list"),
            (
                "GET",
                "/v2/outputs/{itself}/mapping/blobs/{blob}",
                "/v2/outputs/ROBOT/TASK/blobs/DIGEST",
            ),
            (
                "POST",
                "/v2/outputs/{itself}/mapping/blobs/uploads/",
                "/v2/outputs/ROBOT/TASK/blobs/uploads/",
            ),
            (
                "PUT",
                "/v2/outputs/{itself}/mapping/manifests/x",
                "/v2/outputs/ROBOT/TASK/manifests/TAG",
            ),
            (
                "DELETE",
                "/v2/outputs/{itself}/mapping/manifests/x",
                "/v2/outputs/ROBOT/TASK/manifests/TAG",
            ),
        ],
        "/v2" => &[("GET", "/v2", "/v2")],
        "/v2/" => &[("GET", "/v2/", "/v2/")],
        other => panic!("{other}: this test needs the effect of its handler"),
    };
    let probe = |&(method, path, title): &(&str, &str, &str)| Probe {
        title: format!("`{method} {title}`"),
        method: method.parse().expect("a method"),
        path: path.to_owned(),
        body: None,
    };
    cases.iter().map(probe).collect()
}

fn table(header: &[String], rows: &[Vec<String>]) -> String {
    let mut text = format!("| {} |\n|{}\n", header.join(" | "), "---|".repeat(header.len()));
    for row in rows {
        writeln!(text, "| {} |", row.join(" | ")).expect("written");
    }
    text
}

/// The first callers of `TestCaller::ALL`: those without a user.
const MACHINES: usize = 4;
/// The answers of most routes to them.
const CLOSED: [&str; MACHINES] = ["401", "403", "403", "403"];

/// Two tables, because one with all callers would be wider than the page.
async fn http_tables(fixture: &Fixture) -> String {
    let (machines, users) = TestCaller::ALL.split_at(MACHINES);
    let header = |callers: &[TestCaller]| {
        let mut header = vec!["route".to_owned()];
        header.extend(callers.iter().copied().map(TestCaller::title));
        header
    };
    let (mut machine_rows, mut user_rows) = (Vec::new(), Vec::new());
    for route in routes() {
        for probe in probes(&route) {
            let mut row = vec![probe.title.clone()];
            for caller in machines {
                row.push(fixture.outcome(&probe, *caller).await);
            }
            if row[1..] != CLOSED {
                machine_rows.push(row);
            }
            let mut row = vec![probe.title.clone()];
            for caller in users {
                row.push(fixture.outcome(&probe, *caller).await);
            }
            user_rows.push(row);
        }
    }
    let machines = table(&header(machines), &machine_rows);
    let users = table(&header(users), &user_rows);
    format!("{HTTP_MACHINES}{machines}{HTTP_USERS}{users}")
}

async fn mqtt_table(fixture: &mut Fixture) -> String {
    let callers = [
        TestCaller::Nobody,
        TestCaller::Enrollment,
        TestCaller::Itself,
        TestCaller::OtherRobot,
        TestCaller::Person(Role::Viewer),
        TestCaller::Person(Role::Admin),
        TestCaller::Elsewhere(Role::Admin),
    ];
    let mut header = vec!["topic".to_owned()];
    header.extend(callers.map(TestCaller::title));
    let state = fixture.server.desired(&fixture.robot).await;
    let report = fixture.robot.next_report(&state, task_proto::messages::report::Phase::Fetching);
    let report = serde_json::to_vec(&report).expect("json");
    let topics = [
        RobotTopic::Desired,
        RobotTopic::Report,
        RobotTopic::Status,
        RobotTopic::Telemetry,
        RobotTopic::Log,
        RobotTopic::Request,
        RobotTopic::Reply,
    ];
    let parts = format!("taskd/v1/p/{}", fixture.package.content.digest);
    let mut rows = Vec::new();
    for last in topics {
        let topic = topic(&fixture.robot.id, last);
        let shown = topic.replace(fixture.robot.id.as_str(), "ROBOT");
        let payload: &[u8] = if last == RobotTopic::Report { &report } else { b"{}" };
        let mut row = vec![format!("publish `{shown}`")];
        for caller in callers {
            row.push(fixture.publishes(caller, &topic, payload).await);
        }
        rows.push(row);
        let mut row = vec![format!("subscribe `{shown}`")];
        for caller in callers {
            row.push(fixture.subscribes(caller, &topic).await);
        }
        rows.push(row);
    }
    let wide = format!("taskd/v1/r/{}/+", fixture.robot.id);
    let filters = [
        ("taskd/v1/p/DIGEST", parts.as_str()),
        ("taskd/v1/r/ROBOT/+", wide.as_str()),
        ("taskd/v1/r/+/desired", "taskd/v1/r/+/desired"),
        ("taskd/v1/#", "taskd/v1/#"),
        ("#", "#"),
        ("$SYS/#", "$SYS/#"),
    ];
    for (shown, filter) in filters {
        let mut row = vec![format!("subscribe `{shown}`")];
        for caller in callers {
            row.push(fixture.subscribes(caller, filter).await);
        }
        rows.push(row);
    }
    let mut row = vec!["publish `taskd/v1/p/DIGEST`".to_owned()];
    for caller in callers {
        row.push(fixture.publishes(caller, &parts, b"x").await);
    }
    rows.push(row);
    table(&header, &rows)
}

fn roles_table() -> String {
    let mut header = vec!["role".to_owned()];
    header.extend(Permission::ALL.map(|permission| permission.to_string()));
    let row = |role: Role| {
        let is_allowed =
            |permission| if role.permissions().contains(&permission) { "✓" } else { "" };
        let mut row = vec![role.to_string()];
        row.extend(Permission::ALL.map(|permission| is_allowed(permission).to_owned()));
        row
    };
    table(&header, &Role::ALL.map(row))
}

const HEAD: &str = "\
# Permissions

The test `permissions` makes this page. It calls every route and uses every topic with every kind of
account, and fails when the page differs from the result.
`UPDATE_GOLDEN=1 cargo test -p taskd --test it permissions` writes the page again.

A user has one role or several and may do what any of them allows. An account whose scope is limited
to some robots has `administer` for nothing that concerns all of them; see [people.md](people.md).

";

const HTTP_MACHINES: &str = "
## HTTP

`✓`: admitted, whatever the answer is. A number: refused with that status.

### Without a user

A route that is absent from this table answers 401 without a token, and 403 to an enrollment token
and to robots.

";

const HTTP_USERS: &str = "
### Users

Elsewhere: the scope has other robots, not the one in question. Lists leave that robot out.

";

const MQTT: &str = "
## MQTT

`ROBOT` is the robot's id. `–`: can't connect.

";

#[tokio::test(flavor = "multi_thread")]
async fn permissions_match_the_documented_tables() {
    let mut fixture = Fixture::new().await;
    let mut found = format!("{HEAD}{}", roles_table());
    found += &http_tables(&fixture).await;
    found += MQTT;
    found += &mqtt_table(&mut fixture).await;
    // None of these calls opened a way for a client that was refused.
    let me: Value = answer(fixture.server.request(Method::GET, "/api/v1/me")).await;
    assert_eq!(me["name"], "operator.token");
    if std::env::var_os("UPDATE_GOLDEN").is_some() {
        std::fs::write(DOCUMENT, &found).expect("written");
    }
    let written = std::fs::read_to_string(Path::new(DOCUMENT)).unwrap_or_default();
    for (line, (is, was)) in found.lines().zip(written.lines()).enumerate() {
        assert_eq!(is, was, "docs/permissions.md, line {}", line + 1);
    }
    assert_eq!(
        found.lines().count(),
        written.lines().count(),
        "docs/permissions.md has another length"
    );
}
