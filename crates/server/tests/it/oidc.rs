//! Signing in by a provider: the resulting users, their rights, and the refused attempts.
#![expect(clippy::disallowed_methods, reason = "a test harness starts processes")]

use std::io::{BufRead as _, BufReader};
use std::process::{Child, Command, Stdio};

use reqwest::{Client, Method, Response, StatusCode, Url};
use serde_json::{Value, json};
use task_proto::api::{AuditPage, Me, SessionView};
use taskd::config::{Config, OidcSettings, RoleRule};
use taskd::serve::Server;
use taskd::system::clock::Clock;
use tempfile::TempDir;

use crate::harness::{TestServer, answer, refusal};
use crate::people::PASSWORD;
use crate::provider::{CLIENT_ID, Provider, SECRET};

/// Settings that connect a provider and a server. The provider must know the server's address
/// before the server listens, so the port is chosen first.
fn settings(issuer: &str, directory: &TempDir, port: u16) -> OidcSettings {
    let secret = directory.path().join("oidc.secret");
    std::fs::write(&secret, format!("{SECRET}\n")).expect("written");
    let rule = |value: &str, roles: &str, robots: Option<&str>| RoleRule {
        claim: "groups".to_owned(),
        value: value.to_owned(),
        roles: roles.parse().expect("roles"),
        robots: robots.map(|robots| robots.parse().expect("a selector")),
    };
    OidcSettings {
        issuer: issuer.to_owned(),
        client_id: CLIENT_ID.to_owned(),
        client_secret_file: Some(secret),
        public_url: format!("http://127.0.0.1:{port}"),
        title: "the lab".to_owned(),
        rules: vec![rule("admins", "admin", None), rule("robotics", "operator", Some("site=lab"))],
        ..OidcSettings::default()
    }
}

/// A port without a listener at this moment.
fn free_port() -> u16 {
    std::net::TcpListener::bind(("127.0.0.1", 0))
        .expect("binds")
        .local_addr()
        .expect("an address")
        .port()
}

async fn server_with_provider() -> (TestServer, Provider) {
    let (provider, directory, port) =
        (Provider::start().await, TempDir::new().expect("a directory"), free_port());
    let oidc = settings(&provider.issuer, &directory, port);
    let configure = |config: &mut Config| {
        config.http.set_port(port);
        config.oidc = oidc;
    };
    (TestServer::start_in(directory, configure).await, provider)
}

/// A browser without a page: keeps its cookies, and follows no redirect by itself.
struct Visitor<'a> {
    server: &'a TestServer,
    client: Client,
    cookies: Vec<(String, String)>,
}

impl<'a> Visitor<'a> {
    fn new(server: &'a TestServer) -> Self {
        let client = Client::builder()
            .redirect(reqwest::redirect::Policy::none())
            .build()
            .expect("a client");
        Self { server, client, cookies: Vec::new() }
    }

    fn cookie(&self) -> String {
        self.cookies
            .iter()
            .map(|(name, value)| format!("{name}={value}"))
            .collect::<Vec<_>>()
            .join("; ")
    }

    async fn get(&mut self, url: &str) -> Response {
        let response =
            self.client.get(url).header("cookie", self.cookie()).send().await.expect("an answer");
        for cookie in response.headers().get_all("set-cookie") {
            let (pair, attributes) =
                cookie.to_str().expect("text").split_once(';').expect("attributes");
            let (name, value) = pair.split_once('=').expect("a pair");
            self.cookies.retain(|(kept, _)| kept != name);
            if !attributes.contains("Max-Age=0") {
                self.cookies.push((name.to_owned(), value.to_owned()));
            }
        }
        response
    }

    /// Follows the redirect of a response.
    async fn follow(&mut self, response: Response) -> Response {
        assert_eq!(response.status(), StatusCode::SEE_OTHER);
        self.get(&location(&response)).await
    }

    /// Goes to the provider; returns the URL of the redirect back.
    async fn go_to_provider(&mut self) -> String {
        let sent = self.get(&self.server.url("/api/v1/oidc/sign-in")).await;
        location(&self.follow(sent).await)
    }

    /// The complete sign-in; returns the final location.
    async fn sign_in(&mut self) -> String {
        let back = self.go_to_provider().await;
        location(&self.get(&back).await)
    }

    fn asks(&self, method: Method, path: &str) -> reqwest::RequestBuilder {
        let url = self.server.url("");
        self.server.bare(method, path).header("cookie", self.cookie()).header("origin", url)
    }

    async fn me(&self) -> Me {
        answer(self.asks(Method::GET, "/api/v1/me")).await
    }

    fn is_signed_in(&self) -> bool {
        self.cookies.iter().any(|(name, _)| name == "taskd_session")
    }
}

fn location(response: &Response) -> String {
    response.headers()["location"].to_str().expect("text").to_owned()
}

async fn acts(server: &TestServer) -> Vec<(String, String, String)> {
    let page: AuditPage = server.get("/api/v1/audit?after=0").await;
    let entries = page.records.iter().map(|record| record.read().expect("an entry"));
    entries.map(|entry| (entry.who, entry.act, entry.target)).collect()
}

fn act(who: &str, act: &str) -> (String, String, String) {
    (who.to_owned(), act.to_owned(), "alice".to_owned())
}

#[tokio::test(flavor = "multi_thread")]
async fn provider_sign_in_grants_the_rights_of_the_matching_rule() {
    let (server, provider) = server_with_provider().await;
    let view: SessionView = answer(server.bare(Method::GET, "/api/v1/session")).await;
    let way_in = view.provider.expect("there is one");
    assert_eq!(
        (way_in.title.as_str(), way_in.url),
        ("the lab", server.url("/api/v1/oidc/sign-in"))
    );
    let mut visitor = Visitor::new(&server);
    let sent = visitor.get(&server.url("/api/v1/oidc/sign-in")).await;
    let cookie = sent.headers()["set-cookie"].to_str().expect("text").to_owned();
    assert!(
        cookie.ends_with("; HttpOnly; SameSite=Lax; Path=/api/v1/oidc; Max-Age=600"),
        "{cookie}"
    );
    let url = Url::parse(&location(&sent)).expect("a URL");
    let kept = visitor.cookies[0].1.clone();
    assert!(!url.as_str().contains(&kept), "only the browser has it");
    let sent_back = visitor.get(url.as_str()).await;
    let ended = visitor.get(&location(&sent_back)).await;
    assert_eq!((ended.status(), location(&ended).as_str()), (StatusCode::SEE_OTHER, "/"));
    let cookies: Vec<&str> = ended
        .headers()
        .get_all("set-cookie")
        .iter()
        .map(|cookie| cookie.to_str().expect("text"))
        .collect();
    assert!(
        cookies[0].starts_with("taskd_sign_in=;") && cookies[0].ends_with("Max-Age=0"),
        "{cookies:?}"
    );
    assert!(
        cookies[1].contains("; HttpOnly; SameSite=Strict; Path=/; Max-Age=43200"),
        "{cookies:?}"
    );

    let me = visitor.me().await;
    assert_eq!((me.name.as_str(), me.roles.to_string().as_str()), ("alice", "operator"));
    assert_eq!(me.scope.iter().map(ToString::to_string).collect::<Vec<_>>(), ["site=lab"]);
    let users: Value = server.get("/api/v1/users").await;
    assert_eq!(users["users"][0]["has_password"], false);
    assert_eq!(users["users"][0]["subject"], format!("{} 248289761001", provider.issuer));
    assert_eq!(acts(&server).await, [act("server", "user.add"), act("alice", "sign_in")]);
    // The session ends like any other.
    let out = visitor.asks(Method::DELETE, "/api/v1/session").send().await.expect("an answer");
    assert_eq!(out.status(), StatusCode::NO_CONTENT);
    assert_eq!(refusal(visitor.asks(Method::GET, "/api/v1/me")).await.0, 401);
    assert_eq!(visitor.sign_in().await, "/");
    assert_eq!(acts(&server).await[2..], [act("alice", "sign_out"), act("alice", "sign_in")]);
    server.clock.advance_ms(12 * 60 * 60 * 1000);
    assert_eq!(refusal(visitor.asks(Method::GET, "/api/v1/me")).await.0, 401);
}

#[tokio::test(flavor = "multi_thread")]
async fn provider_sign_in_ends_the_browsers_previous_session() {
    let (server, _provider) = server_with_provider().await;
    let mut visitor = Visitor::new(&server);
    assert_eq!(visitor.sign_in().await, "/");
    let former = visitor.cookie();
    assert_eq!(visitor.sign_in().await, "/");
    assert_eq!(visitor.me().await.name.as_str(), "alice");
    assert_eq!(
        refusal(server.bare(Method::GET, "/api/v1/me").header("cookie", former)).await.0,
        401
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn provider_sign_in_without_a_provider_is_not_found() {
    let server = TestServer::start().await;
    let view: SessionView = answer(server.bare(Method::GET, "/api/v1/session")).await;
    assert_eq!(view.provider, None);
    for path in ["/api/v1/oidc/sign-in", "/api/v1/oidc/callback?code=x&state=y"] {
        assert_eq!(refusal(server.bare(Method::GET, path)).await, (404, "not_found".to_owned()));
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn authorization_response_is_valid_once_and_in_one_browser() {
    let (server, provider) = server_with_provider().await;
    let (mut mine, mut theirs, mut nobody) =
        (Visitor::new(&server), Visitor::new(&server), Visitor::new(&server));
    let back = mine.go_to_provider().await;
    theirs.go_to_provider().await;
    // A user who is sent my answer is not signed in as me, with or without a sign-in of their own
    // under way.
    assert_eq!(location(&theirs.get(&back).await), "/#problem=expired");
    assert_eq!(location(&nobody.get(&back).await), "/#problem=expired");
    let kept = mine.cookies.clone();
    assert_eq!(location(&mine.get(&back).await), "/");
    assert_eq!(location(&mine.get(&back).await), "/#problem=expired");
    nobody.cookies = kept;
    assert_eq!(
        location(&nobody.get(&back).await),
        "/#problem=failed",
        "the provider takes a code once"
    );
    assert!(!theirs.is_signed_in() && !nobody.is_signed_in());

    // The code without its verifier, as an eavesdropper has it.
    let (stolen, own) = (mine.go_to_provider().await, theirs.go_to_provider().await);
    let part = |url: &str, name: &str| {
        let url = Url::parse(url).expect("a URL");
        url.query_pairs().find(|(key, _)| key == name).expect("there").1.into_owned()
    };
    let own_state = part(&own, "state");
    let mixed = stolen.replace(&part(&stolen, "state"), &own_state);
    assert_eq!(location(&theirs.get(&mixed).await), "/#problem=failed");
    // An answer that names another provider as its issuer.
    let back = mine.go_to_provider().await;
    assert_eq!(location(&mine.get(&back.replace("&iss=", "&iss=x")).await), "/#problem=failed");
    provider.lets_in(false);
    assert_eq!(theirs.sign_in().await, "/#problem=refused");
    assert!(!theirs.is_signed_in());
    assert_eq!(acts(&server).await.len(), 2, "one has signed in");
}

#[tokio::test(flavor = "multi_thread")]
async fn invalid_id_token_is_refused() {
    let (server, provider) = server_with_provider().await;
    let s = crate::harness::NOW_MS / 1000;
    for (header, claims) in [
        (json!({ "alg": "none" }), json!({})),
        (json!({ "alg": "HS256" }), json!({})),
        (json!({ "kid": "other" }), json!({})),
        (json!({}), json!({ "iss": "https://other.example" })),
        (json!({}), json!({ "aud": "other" })),
        (json!({}), json!({ "nonce": "other" })),
        (json!({}), json!({ "nonce": null })),
        (json!({}), json!({ "exp": s - 61 })),
        (json!({}), json!({ "iat": s + 61 })),
        (json!({}), json!({ "sub": null })),
    ] {
        provider.lies(header.clone(), claims.clone());
        let mut visitor = Visitor::new(&server);
        assert_eq!(visitor.sign_in().await, "/#problem=failed", "{header} {claims}");
        assert!(!visitor.is_signed_in(), "{header} {claims}");
    }
    assert_eq!(acts(&server).await, []);
    provider.lies(json!({}), json!({}));
    assert_eq!(Visitor::new(&server).sign_in().await, "/");
}

#[tokio::test(flavor = "multi_thread")]
async fn user_without_a_matching_rule_is_refused_and_signed_out() {
    let (server, provider) = server_with_provider().await;
    provider.says(json!({ "groups": ["staff"] }));
    assert_eq!(Visitor::new(&server).sign_in().await, "/#problem=no_role");
    provider.says(json!({ "groups": null }));
    assert_eq!(Visitor::new(&server).sign_in().await, "/#problem=no_role");
    assert_eq!(acts(&server).await, []);

    provider.says(json!({ "groups": ["robotics"] }));
    let (mut visitor, mut again) = (Visitor::new(&server), Visitor::new(&server));
    assert_eq!(visitor.sign_in().await, "/");
    provider.says(json!({ "groups": ["robotics", "admins"] }));
    assert_eq!(again.sign_in().await, "/");
    assert_eq!(visitor.me().await.roles.to_string(), "admin", "everywhere");
    assert_eq!(visitor.me().await.scope, []);
    provider.says(json!({ "groups": ["staff"] }));
    assert_eq!(again.sign_in().await, "/#problem=no_role");
    assert_eq!(
        refusal(visitor.asks(Method::GET, "/api/v1/me")).await.0,
        401,
        "their sessions have ended"
    );
    let expected = [
        act("server", "user.add"),
        act("alice", "sign_in"),
        act("server", "user.edit"),
        act("alice", "sign_in"),
        act("server", "user.remove"),
    ];
    assert_eq!(acts(&server).await, expected);
}

#[tokio::test(flavor = "multi_thread")]
async fn provider_user_is_known_by_subject_and_not_by_name() {
    let (server, provider) = server_with_provider().await;
    let user = json!({ "name": "alice", "roles": ["admin"], "password": PASSWORD });
    let _: Value = server.post("/api/v1/users", &user).await;
    assert_eq!(Visitor::new(&server).sign_in().await, "/#problem=name_taken");
    let server_name = json!({ "preferred_username": "operator.token" });
    provider.says(server_name);
    assert_eq!(Visitor::new(&server).sign_in().await, "/#problem=name_taken");
    for bad in [json!("Alice Smith"), json!("a\nb"), json!(7), json!("x".repeat(100)), json!(null)]
    {
        provider.says(json!({ "preferred_username": bad }));
        assert_eq!(Visitor::new(&server).sign_in().await, "/#problem=no_name", "{bad}");
    }
    provider.says(json!({ "preferred_username": "bob" }));
    let mut bob = Visitor::new(&server);
    assert_eq!(bob.sign_in().await, "/");
    // The next holder of his name at the provider is another user, and he keeps his account under
    // another name.
    provider.says(json!({ "sub": "other" }));
    assert_eq!(Visitor::new(&server).sign_in().await, "/#problem=name_taken");
    provider.says(json!({ "sub": "248289761001", "preferred_username": "robert" }));
    assert_eq!(bob.sign_in().await, "/");
    assert_eq!(bob.me().await.name.as_str(), "bob");
}

#[tokio::test(flavor = "multi_thread")]
async fn provider_users_rights_and_password_are_not_editable() {
    let (server, _provider) = server_with_provider().await;
    let mut alice = Visitor::new(&server);
    assert_eq!(alice.sign_in().await, "/");
    let of_provider = (409, "of_provider".to_owned());
    let edit =
        server.request(Method::PATCH, "/api/v1/users/alice").json(&json!({ "roles": ["admin"] }));
    assert_eq!(refusal(edit).await, of_provider);
    let password = server
        .request(Method::PUT, "/api/v1/users/alice/password")
        .json(&json!({ "password": PASSWORD }));
    assert_eq!(refusal(password).await, of_provider);
    let log_in = server
        .bare(Method::POST, "/api/v1/login")
        .json(&json!({ "user": "alice", "password": PASSWORD }));
    assert_eq!(refusal(log_in).await.0, 401);
    // A self-made token would outlast the provider's decisions about the user; an administrator may
    // make one.
    let token = alice.asks(Method::POST, "/api/v1/tokens").json(&json!({}));
    assert_eq!(refusal(token).await, (403, "forbidden".to_owned()));
    let made: Value = server.post("/api/v1/tokens", &json!({ "user": "alice" })).await;
    let me = server
        .bare(Method::GET, "/api/v1/me")
        .bearer_auth(made["token"].as_str().expect("a token"));
    assert_eq!(answer::<Me>(me).await.name.as_str(), "alice");
}

#[tokio::test(flavor = "multi_thread")]
async fn new_provider_key_is_fetched_and_failures_are_backed_off() {
    let (server, provider) = server_with_provider().await;
    let sign_in = || async { Visitor::new(&server).sign_in().await };
    assert_eq!(sign_in().await, "/");
    provider.changes_key("second");
    for _ in 0..3 {
        assert_eq!(sign_in().await, "/#problem=failed");
    }
    server.clock.advance_ms(10_000);
    assert_eq!(sign_in().await, "/");
    provider.lies(json!({ "kid": "invented" }), json!({}));
    for _ in 0..3 {
        assert_eq!(sign_in().await, "/#problem=failed");
    }
    assert_eq!(
        (provider.asked("discovery"), provider.asked("keys")),
        (1, 2),
        "asked once each time"
    );

    server.clock.advance_ms(60 * 60 * 1000);
    provider.lies(
        json!({}),
        json!({ "iat": server.clock.now_ms() / 1000, "exp": server.clock.now_ms() / 1000 + 60 }),
    );
    provider.breaks(true);
    let begin = || async {
        location(&Visitor::new(&server).get(&server.url("/api/v1/oidc/sign-in")).await)
    };
    for _ in 0..3 {
        assert_eq!(begin().await, "/#problem=failed");
    }
    assert_eq!(provider.asked("discovery"), 2);
    provider.breaks(false);
    assert_eq!(begin().await, "/#problem=failed", "not yet");
    server.clock.advance_ms(10_000);
    assert_eq!(sign_in().await, "/");
}

#[tokio::test(flavor = "multi_thread")]
async fn failed_provider_sign_ins_are_limited_by_address() {
    let (server, provider) = server_with_provider().await;
    // Requests that a foreign page could trigger in its visitors' browsers do not count.
    let foreign = server.url("/api/v1/oidc/callback?code=guess&state=guess");
    for _ in 0..60 {
        assert_eq!(location(&Visitor::new(&server).get(&foreign).await), "/#problem=expired");
    }
    for _ in 0..50 {
        let mut visitor = Visitor::new(&server);
        let back = visitor.go_to_provider().await;
        assert_eq!(
            location(&visitor.get(&back.replace("code=", "code=x")).await),
            "/#problem=failed"
        );
    }
    assert_eq!(Visitor::new(&server).sign_in().await, "/#problem=blocked");
    assert_eq!(Visitor::new(&server).sign_in().await, "/#problem=blocked");
    let blocked = ("server".to_owned(), "sign_in.blocked".to_owned(), "nobody".to_owned());
    assert_eq!(acts(&server).await, [blocked], "once");
    server.clock.advance_ms(15 * 60 * 1000);
    // Successful sign-ins do not count.
    for _ in 0..60 {
        provider.lies(json!({}), json!({ "exp": server.clock.now_ms() / 1000 + 60 }));
        assert_eq!(Visitor::new(&server).sign_in().await, "/");
    }
}

/// A third-party provider, as a process.
struct Foreign {
    child: Child,
    issuer: String,
}

impl Foreign {
    fn start() -> Self {
        let Ok(environment) = std::env::var("TASKD_TEST_OIDC") else {
            panic!(
                "TASKD_TEST_OIDC is not set: run ./scripts/test, \
                 or set it to the directory that scripts/need oidc prints"
            );
        };
        let alice = json!({ "sub": "1", "preferred_username": "alice", "groups": ["robotics"] })
            .to_string();
        let mut command = Command::new(format!("{environment}/bin/python"));
        command.args([
            "-m",
            "oidc_provider_mock",
            "--port",
            "0",
            "--require-nonce",
            "true",
            "--user-claims",
            &alice,
        ]);
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped());
        let mut child = command.spawn().expect("the provider starts");
        let mut lines =
            BufReader::new(child.stderr.take().expect("piped")).lines().map_while(Result::ok);
        let issuer = lines
            .find_map(|line| Some(line.split_once("running on ")?.1.split_once(' ')?.0.to_owned()));
        // The rest is discarded, because a full pipe would stop the process.
        std::thread::spawn(move || lines.for_each(drop));
        Self { child, issuer: issuer.expect("the provider says where it is") }
    }
}

impl Drop for Foreign {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn sign_in_works_with_a_third_party_provider() {
    let (directory, port) = (TempDir::new().expect("a directory"), free_port());
    let provider = tokio::task::spawn_blocking(Foreign::start).await.expect("started");
    let mut config = Config::with_data(directory.path().join("data"));
    config.http.set_port(port);
    config.mqtt.set_port(0);
    config.oidc = settings(&provider.issuer, &directory, port);
    // Its tokens are from now.
    let clock = Clock::system();
    let server = Server::start(config, clock.clone()).await.expect("the server starts");
    let operator = server.data().operator_token().expect("read").expect("a token");
    let server = TestServer { directory, server, clock, operator, client: Client::new() };
    let mut visitor = Visitor::new(&server);
    let sent = visitor.get(&server.url("/api/v1/oidc/sign-in")).await;
    // The form that a user would fill in.
    let chosen =
        visitor.client.post(location(&sent)).form(&[("sub", "1")]).send().await.expect("an answer");
    let ended = visitor.get(&location(&chosen)).await;
    assert_eq!(location(&ended), "/");
    let me = visitor.me().await;
    assert_eq!((me.name.as_str(), me.roles.to_string().as_str()), ("alice", "operator"));
    server.stop().await;
}
