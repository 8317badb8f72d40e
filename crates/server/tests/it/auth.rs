//! Access to routes: every route of the table is called by every kind of caller.

use std::time::Duration;

use reqwest::{Method, RequestBuilder, StatusCode};
use serde_json::{Value, json};
use task_proto::api::{EnrollmentToken, SessionView};
use task_proto::trust::token::{Token, TokenKind};
use taskd::http::auth::Access;
use taskd::http::{Route, routes};

use crate::harness::{TestServer, refusal};

/// All kinds of callers of a route.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum TestCaller {
    Nobody,
    Nonsense,
    Stranger,
    Operator,
    OperatorByPassword,
    Enrollment,
    ExpiredEnrollment,
    Robot,
    OtherRobot,
    RemovedRobot,
}

impl TestCaller {
    const ALL: [Self; 10] = [
        Self::Nobody,
        Self::Nonsense,
        Self::Stranger,
        Self::Operator,
        Self::OperatorByPassword,
        Self::Enrollment,
        Self::ExpiredEnrollment,
        Self::Robot,
        Self::OtherRobot,
        Self::RemovedRobot,
    ];

    /// The refusal to expect; `None` if the guard lets them in.
    fn refused(self, access: Access) -> Option<StatusCode> {
        use TestCaller::{
            Enrollment, ExpiredEnrollment, Nobody, Nonsense, Operator, OperatorByPassword,
        };
        use TestCaller::{OtherRobot, RemovedRobot, Robot, Stranger};
        let is_let_in = match access {
            Access::Anyone => true,
            Access::Person(_) => matches!(self, Operator | OperatorByPassword),
            Access::OwnRobot => self == Robot,
            Access::Enrollment => self == Enrollment,
            Access::PersonOrRobot => {
                matches!(self, Operator | OperatorByPassword | Robot | OtherRobot)
            }
            Access::Peer => false,
        };
        match self {
            _ if is_let_in => None,
            Nobody | Nonsense | Stranger | ExpiredEnrollment | RemovedRobot => {
                Some(StatusCode::UNAUTHORIZED)
            }
            Operator | OperatorByPassword | Enrollment | Robot | OtherRobot => {
                Some(StatusCode::FORBIDDEN)
            }
        }
    }
}

/// A server with one of each.
struct Fixture {
    server: TestServer,
    robot_id: String,
    robot: String,
    other_robot: String,
    removed_robot: String,
    enrollment: String,
    expired_enrollment: String,
}

impl Fixture {
    async fn new() -> Self {
        let server = TestServer::start().await;
        let (robot, other, removed) = (
            server.enroll("atlas").await,
            server.enroll("boreas").await,
            server.enroll("ceto").await,
        );
        let path = format!("/api/v1/robots/{}", removed.id);
        server.request(Method::DELETE, &path).send().await.expect("an answer");
        let expired: EnrollmentToken =
            server.post("/api/v1/enrollment-tokens", &json!({ "ttl_s": 1 })).await;
        let enrollment: EnrollmentToken =
            server.post("/api/v1/enrollment-tokens", &json!({})).await;
        server.clock.advance_ms(2_000);
        Self {
            server,
            robot_id: robot.id.to_string(),
            robot: robot.token,
            other_robot: other.token,
            removed_robot: removed.token,
            enrollment: enrollment.token,
            expired_enrollment: expired.token,
        }
    }

    fn authenticate(&self, request: RequestBuilder, caller: TestCaller) -> RequestBuilder {
        match caller {
            TestCaller::Nobody => request,
            TestCaller::Nonsense => request.header("authorization", "Bearer tsko_nonsense"),
            TestCaller::Stranger => {
                request.bearer_auth(Token::random(TokenKind::Operator).reveal())
            }
            TestCaller::Operator => request.bearer_auth(self.server.operator.reveal()),
            TestCaller::OperatorByPassword => {
                request.basic_auth("anyone", Some(self.server.operator.reveal()))
            }
            TestCaller::Enrollment => request.bearer_auth(&self.enrollment),
            TestCaller::ExpiredEnrollment => request.bearer_auth(&self.expired_enrollment),
            TestCaller::Robot => request.bearer_auth(&self.robot),
            TestCaller::OtherRobot => request.bearer_auth(&self.other_robot),
            TestCaller::RemovedRobot => request.bearer_auth(&self.removed_robot),
        }
    }

    fn request(&self, route: &Route) -> RequestBuilder {
        let path =
            route.path.replace("{robot}", &self.robot_id).replace("{*path}", "talker/tags/list");
        let path = path.replace("{deployment}", "d0000000000000000").replace("{task}", "talker");
        self.server.bare(route.method.clone().unwrap_or(Method::GET), &path)
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn every_route_admits_only_its_callers() {
    let fixture = Fixture::new().await;
    for route in routes() {
        for caller in TestCaller::ALL {
            // Revoking the robot would change the identity of the later callers.
            let puts_out = route.method == Some(Method::DELETE) && route.path.ends_with("{robot}");
            let is_last_word = puts_out || route.path.ends_with("/revoke");
            if is_last_word && caller.refused(route.access).is_none() {
                continue;
            }
            let response = fixture
                .authenticate(fixture.request(&route), caller)
                .send()
                .await
                .expect("an answer");
            let (status, shown) =
                (response.status(), format!("{:?} {} by {caller:?}", route.method, route.path));
            match caller.refused(route.access) {
                Some(expected) => {
                    assert_eq!(status, expected, "{shown}");
                    let is_oci = route.path.starts_with("/v2");
                    assert_eq!(
                        response
                            .headers()
                            .get("www-authenticate")
                            .map(|value| value.as_bytes().starts_with(b"Basic")),
                        (status == StatusCode::UNAUTHORIZED).then_some(is_oci),
                        "{shown}"
                    );
                    let body: Value = response.json().await.expect("json");
                    assert!(
                        body[if is_oci { "errors" } else { "error" }].is_array() == is_oci,
                        "{shown}: {body}"
                    );
                }
                // Within the registry a robot sees blobs only.
                None if route.path == "/v2/{*path}" && caller == TestCaller::Robot => {}
                None if route.path == "/v2/{*path}" && caller == TestCaller::OtherRobot => {}
                None if route.path == "/api/v1/session" => {}
                None => {
                    assert!(
                        !matches!(status, StatusCode::UNAUTHORIZED | StatusCode::FORBIDDEN),
                        "{shown}: {status}"
                    );
                }
            }
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn basic_auth_from_a_foreign_page_changes_nothing() {
    let server = TestServer::start().await;
    let by_password = |method, path: &str| {
        server.bare(method, path).basic_auth("any", Some(server.operator.reveal()))
    };
    let create = || by_password(Method::POST, "/api/v1/enrollment-tokens").json(&json!({}));
    let begin_push = || by_password(Method::POST, "/v2/talker/blobs/uploads/");
    for (header, foreign) in [
        ("origin", "http://evil.example"),
        ("origin", "null"),
        ("sec-fetch-site", "cross-site"),
        ("sec-fetch-site", "none"),
    ] {
        assert_eq!(refusal(create().header(header, foreign)).await.0, 403, "{header}: {foreign}");
        let pushed = begin_push().header(header, foreign).send().await.expect("an answer");
        assert_eq!(pushed.status(), StatusCode::FORBIDDEN, "{header}: {foreign}");
        let read = by_password(Method::GET, "/api/v1/me")
            .header(header, foreign)
            .send()
            .await
            .expect("an answer");
        assert_eq!(read.status(), StatusCode::OK, "no other page can read it");
    }
    // Registry clients send no origin; the API's own documentation page sends the server's.
    assert_eq!(create().send().await.expect("an answer").status(), StatusCode::CREATED);
    assert_eq!(begin_push().send().await.expect("an answer").status(), StatusCode::ACCEPTED);
    let own = create().header("origin", server.url("")).header("sec-fetch-site", "same-origin");
    assert_eq!(own.send().await.expect("an answer").status(), StatusCode::CREATED);
}

#[tokio::test(flavor = "multi_thread")]
async fn session_has_the_rights_of_its_token_on_its_own_page_only() {
    let server = TestServer::start().await;
    let origin = server.url("");
    let sign_in = |origin: &str, token: String| {
        let request = server.bare(Method::POST, "/api/v1/session").header("origin", origin);
        request.json(&json!({ "token": token }))
    };
    let wrong = sign_in(&origin, Token::random(TokenKind::Operator).reveal());
    assert_eq!(refusal(wrong).await, (401, "unauthorized".to_owned()));
    let foreign = sign_in("http://evil.example", server.operator.reveal());
    assert_eq!(refusal(foreign).await, (403, "forbidden".to_owned()));
    let token = json!({ "token": server.operator.reveal() });
    let marked =
        server.bare(Method::POST, "/api/v1/session").header("sec-fetch-site", "cross-site");
    assert_eq!(refusal(marked.json(&token)).await, (403, "forbidden".to_owned()));
    let robot = server.enroll("atlas").await;
    assert_eq!(refusal(sign_in(&origin, robot.token)).await, (401, "unauthorized".to_owned()));

    let response = sign_in(&origin, server.operator.reveal()).send().await.expect("an answer");
    let cookie = response.headers()["set-cookie"].to_str().expect("text").to_owned();
    assert!(
        cookie.contains("; HttpOnly; SameSite=Strict; Path=/;") && !cookie.contains("Secure"),
        "{cookie}"
    );
    let cookie = cookie.split(';').next().expect("a pair").to_owned();
    let signed_in = |method, path: &str| server.bare(method, path).header("cookie", &cookie);
    let robots = signed_in(Method::GET, "/api/v1/robots").send().await.expect("an answer");
    assert_eq!(robots.status(), StatusCode::OK);
    let view: SessionView = signed_in(Method::GET, "/api/v1/session")
        .send()
        .await
        .expect("an answer")
        .json()
        .await
        .expect("json");
    assert!(view.expires_at_ms.is_some());

    let create = || signed_in(Method::POST, "/api/v1/enrollment-tokens").json(&json!({}));
    assert_eq!(refusal(create()).await, (403, "forbidden".to_owned()));
    assert_eq!(refusal(create().header("origin", "http://evil.example")).await.0, 403);
    assert_eq!(
        create().header("origin", &origin).send().await.expect("an answer").status(),
        StatusCode::CREATED
    );

    let events = signed_in(Method::GET, "/api/v1/events").send().await.expect("an answer");
    assert_eq!(events.status(), StatusCode::OK);
    let out = signed_in(Method::DELETE, "/api/v1/session")
        .header("origin", &origin)
        .send()
        .await
        .expect("an answer");
    assert_eq!(out.status(), StatusCode::NO_CONTENT);
    assert_eq!(refusal(signed_in(Method::GET, "/api/v1/robots")).await.0, 401);
    let heard =
        tokio::time::timeout(Duration::from_secs(9), events.text()).await.expect("the stream ends");
    assert!(heard.expect("a proper end").contains("hello"));
}

/// Signs the operator in, from a browser with this cookie; returns the new cookie.
async fn sign_in_with(server: &TestServer, cookie: &str) -> String {
    let request = server.bare(Method::POST, "/api/v1/session").header("cookie", cookie);
    let request = request.json(&json!({ "token": server.operator.reveal() }));
    let response = request.send().await.expect("an answer");
    assert_eq!(response.status(), StatusCode::OK);
    let cookie = response.headers()["set-cookie"].to_str().expect("text");
    cookie.split(';').next().expect("a pair").to_owned()
}

#[tokio::test(flavor = "multi_thread")]
async fn sign_in_ends_the_browsers_previous_session() {
    let server = TestServer::start().await;
    let robots = |cookie: &str| server.bare(Method::GET, "/api/v1/robots").header("cookie", cookie);
    let (first, other) =
        (sign_in_with(&server, "theme=dark").await, sign_in_with(&server, "theme=dark").await);
    let wrong = json!({ "token": Token::random(TokenKind::Operator).reveal() });
    let wrong = server.bare(Method::POST, "/api/v1/session").header("cookie", &first).json(&wrong);
    assert_eq!(refusal(wrong).await.0, 401);
    assert_eq!(
        robots(&first).send().await.expect("an answer").status(),
        StatusCode::OK,
        "only if that succeeds"
    );
    let events = server.bare(Method::GET, "/api/v1/events").header("cookie", &first).send();
    let events = events.await.expect("an answer");
    let second = sign_in_with(&server, &first).await;
    assert_eq!(refusal(robots(&first)).await.0, 401);
    let ended = tokio::time::timeout(Duration::from_secs(9), events.text()).await;
    ended.expect("its stream ends").expect("a proper end");
    for lives in [&second, &other] {
        assert_eq!(robots(lives).send().await.expect("an answer").status(), StatusCode::OK);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn answers_to_a_session_are_revalidated_before_use() {
    let server = TestServer::start().await;
    let package = server.push("talker", "1.0.0").await;
    let cookie = sign_in_with(&server, "theme=dark").await;
    let (blob, manifest) = (package.content.digest, package.manifest.digest);
    for path in [format!("/v2/talker/blobs/{blob}"), format!("/v2/talker/manifests/{manifest}")] {
        let by_token = server.request(Method::GET, &path).send().await.expect("an answer");
        assert_eq!(
            by_token.headers()["cache-control"],
            "private, max-age=31536000, immutable",
            "{path}"
        );
        let by_cookie = || server.bare(Method::GET, &path).header("cookie", &cookie);
        let whole = by_cookie().send().await.expect("an answer");
        assert_eq!(whole.status(), StatusCode::OK, "{path}");
        assert_eq!(whole.headers()["cache-control"], "private, no-cache", "{path}");
        let known = by_cookie()
            .header("if-none-match", &whole.headers()["etag"])
            .send()
            .await
            .expect("an answer");
        assert_eq!(known.status(), StatusCode::NOT_MODIFIED, "{path}");
        assert_eq!(known.headers()["cache-control"], "private, no-cache", "{path}");
    }
    let out = server.bare(Method::DELETE, "/api/v1/session").header("cookie", &cookie);
    let out = out.header("origin", server.url("")).send().await.expect("an answer");
    assert_eq!(out.status(), StatusCode::NO_CONTENT);
    assert_eq!(out.headers()["clear-site-data"], "\"cache\"");
}

#[tokio::test(flavor = "multi_thread")]
async fn cookie_of_an_encrypted_server_is_secure() {
    let directory = tempfile::TempDir::new().expect("a directory");
    let server = TestServer::start_in(directory, |config| config.tls.private_ca = Some(true)).await;
    let sign_in = server
        .bare(Method::POST, "/api/v1/session")
        .json(&json!({ "token": server.operator.reveal() }));
    let response = sign_in.send().await.expect("an answer");
    let cookie = response.headers()["set-cookie"].to_str().expect("text");
    assert!(
        cookie.contains("; HttpOnly; SameSite=Strict; Path=/;") && cookie.ends_with("; Secure"),
        "{cookie}"
    );
}
