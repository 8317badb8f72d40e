//! Sessions of the page, and wrong passwords: both are rows, so they outlive a server.

use std::net::IpAddr;
use std::time::Duration;

use reqwest::{Method, RequestBuilder, StatusCode};
use serde_json::{Value, json};
use task_proto::api::{Me, SessionView};
use task_proto::trust::token::{Token, TokenKind};
use task_proto::{Digest, UserName};
use taskd::auth::sign_ins::{NameDigest, WINDOW_MS, Window};
use taskd::orders::actions::PAGE_LIFETIME_MS;
use taskd::store::NewPageSession;
use tempfile::TempDir;

use crate::database::{TestDatabase, on_both_databases, rows};
use crate::fleet::{Fleet, key};
use crate::harness::{NOW_MS, TestServer, answer, refusal};
use crate::people::PASSWORD;
use crate::story::code;

on_both_databases! {
    page_session_survives_a_restart,
    signed_out_session_is_refused_after_a_restart,
    sign_in_limit_holds_over_a_restart,
    familiar_account_is_not_blocked_by_its_neighbours_after_a_restart,
    demoted_users_session_loses_its_rights_at_once,
    removed_users_session_ends_at_once,
    expired_session_is_refused,
    sessions_are_bounded_by_person_and_in_total,
    ended_sessions_and_old_failures_are_removed,
    simultaneous_wrong_passwords_all_count,
    names_at_a_sign_in_are_stored_as_digests,
    long_password_is_refused_without_a_write,
    new_password_ends_the_block_of_its_account,
}

/// Less than the interval at which a stream checks its rights by itself.
const SOON: Duration = Duration::from_secs(9);

/// A server with this database.
pub async fn server_on(database: &TestDatabase, directory: TempDir) -> TestServer {
    let url = Some(database.url.clone());
    TestServer::start_in(directory, |config| config.database = url).await
}

/// Stops the server and starts another with the same directory and database.
pub async fn restart(database: &TestDatabase, server: TestServer) -> TestServer {
    let directory = server.stop().await;
    server_on(database, directory).await
}

async fn new_server(database: &TestDatabase) -> TestServer {
    server_on(database, TempDir::new().expect("a directory")).await
}

async fn add_user(server: &TestServer, name: &str, role: &str) {
    let user = json!({ "name": name, "roles": [role], "password": PASSWORD });
    let _: Value = server.post("/api/v1/users", &user).await;
}

/// Signs in to the page; returns the cookie.
async fn sign_in(server: &TestServer, credentials: &Value) -> String {
    let request = server.bare(Method::POST, "/api/v1/session").json(credentials);
    let response = request.send().await.expect("an answer");
    assert_eq!(response.status(), StatusCode::OK);
    let cookie = response.headers()["set-cookie"].to_str().expect("text");
    cookie.split(';').next().expect("a pair").to_owned()
}

async fn sign_in_as(server: &TestServer, name: &str) -> String {
    sign_in(server, &json!({ "user": name, "password": PASSWORD })).await
}

/// A request of the page with this cookie.
fn from_page(server: &TestServer, cookie: &str, method: Method, path: &str) -> RequestBuilder {
    server.bare(method, path).header("cookie", cookie).header("origin", server.url(""))
}

async fn status(request: RequestBuilder) -> u16 {
    request.send().await.expect("an answer").status().as_u16()
}

async fn shown_session(server: &TestServer, cookie: &str) -> SessionView {
    answer(from_page(server, cookie, Method::GET, "/api/v1/session")).await
}

async fn page_session_survives_a_restart(database: TestDatabase) {
    let server = new_server(&database).await;
    add_user(&server, "alice", "operator").await;
    let cookie = sign_in_as(&server, "alice").await;
    let before = shown_session(&server, &cookie).await;
    assert_eq!(before.expires_at_ms, Some(NOW_MS + PAGE_LIFETIME_MS));
    let (_, id) = cookie.split_once('=').expect("a pair");
    let stored = rows(&database.url, "page_sessions").await;
    assert!(stored.len() == 1 && !stored[0].contains(id), "{stored:?}");

    let server = restart(&database, server).await;
    assert_eq!(shown_session(&server, &cookie).await, before);
    let me: Me = answer(from_page(&server, &cookie, Method::GET, "/api/v1/me")).await;
    assert_eq!(me.name.as_str(), "alice");
    let foreign = server.bare(Method::DELETE, "/api/v1/session").header("cookie", &cookie);
    assert_eq!(refusal(foreign).await.0, 403, "only its own page may change something");
    let out = from_page(&server, &cookie, Method::DELETE, "/api/v1/session");
    assert_eq!(status(out).await, 204);
    assert_eq!(refusal(from_page(&server, &cookie, Method::GET, "/api/v1/me")).await.0, 401);
}

async fn signed_out_session_is_refused_after_a_restart(database: TestDatabase) {
    let server = new_server(&database).await;
    // The token stays valid, so the session's own end decides.
    let token = json!({ "token": server.operator.reveal() });
    let (ended, kept) = (sign_in(&server, &token).await, sign_in(&server, &token).await);
    let out = from_page(&server, &ended, Method::DELETE, "/api/v1/session");
    assert_eq!(status(out).await, 204);
    let server = restart(&database, server).await;
    assert_eq!(refusal(from_page(&server, &ended, Method::GET, "/api/v1/me")).await.0, 401);
    assert_eq!(shown_session(&server, &ended).await.expires_at_ms, None);
    assert_eq!(status(from_page(&server, &kept, Method::GET, "/api/v1/me")).await, 200);
}

async fn sign_in_limit_holds_over_a_restart(database: TestDatabase) {
    let server = new_server(&database).await;
    for name in ["alice", "bob"] {
        add_user(&server, name, "viewer").await;
    }
    let log_in = |server: &TestServer, name: &str, password: &str| {
        let request = server.bare(Method::POST, "/api/v1/login");
        request.json(&json!({ "user": name, "password": password }))
    };
    for name in ["alice", "ghost"].repeat(10) {
        assert_eq!(refusal(log_in(&server, name, "wrong")).await.0, 401);
    }
    let server = restart(&database, server).await;
    assert_eq!(refusal(log_in(&server, "alice", PASSWORD)).await.0, 429);
    assert_eq!(refusal(log_in(&server, "ghost", PASSWORD)).await.0, 429, "it has no account");
    assert_eq!(status(log_in(&server, "bob", PASSWORD)).await, 201);
    server.clock.advance_ms(WINDOW_MS);
    assert_eq!(status(log_in(&server, "alice", PASSWORD)).await, 201);
}

async fn familiar_account_is_not_blocked_by_its_neighbours_after_a_restart(database: TestDatabase) {
    let server = new_server(&database).await;
    for name in ["alice", "bob"] {
        add_user(&server, name, "viewer").await;
    }
    sign_in_as(&server, "alice").await;
    let server = restart(&database, server).await;
    let log_in = |name: &str, password: &str| {
        let request = server.bare(Method::POST, "/api/v1/login");
        request.json(&json!({ "user": name, "password": password }))
    };
    for n in 0..50 {
        assert_eq!(refusal(log_in(&format!("nobody{n}"), "wrong")).await.0, 401);
    }
    assert_eq!(refusal(log_in("bob", PASSWORD)).await.0, 429, "he was never here");
    assert_eq!(refusal(log_in("alice", "wrong")).await.0, 429, "no answer tells that she was");
    assert_eq!(status(log_in("alice", PASSWORD)).await, 201);
}

async fn demoted_users_session_loses_its_rights_at_once(database: TestDatabase) {
    let server = new_server(&database).await;
    add_user(&server, "alice", "admin").await;
    let cookie = sign_in_as(&server, "alice").await;
    let users = || from_page(&server, &cookie, Method::GET, "/api/v1/users");
    assert_eq!(status(users()).await, 200);
    let events = from_page(&server, &cookie, Method::GET, "/api/v1/events").send();
    let events = events.await.expect("an answer");
    let edit = server.request(Method::PATCH, "/api/v1/users/alice");
    assert_eq!(status(edit.json(&json!({ "roles": ["viewer"] }))).await, 200);
    assert_eq!(refusal(users()).await.0, 403);
    tokio::time::timeout(SOON, events.text()).await.expect("the stream ends").expect("properly");
    assert_eq!(status(from_page(&server, &cookie, Method::GET, "/api/v1/robots")).await, 200);
}

async fn removed_users_session_ends_at_once(database: TestDatabase) {
    let server = new_server(&database).await;
    add_user(&server, "alice", "viewer").await;
    let cookie = sign_in_as(&server, "alice").await;
    let robots = || from_page(&server, &cookie, Method::GET, "/api/v1/robots");
    assert_eq!(status(robots()).await, 200);
    let events = from_page(&server, &cookie, Method::GET, "/api/v1/events").send();
    let events = events.await.expect("an answer");
    assert_eq!(status(server.request(Method::DELETE, "/api/v1/users/alice")).await, 204);
    assert_eq!(refusal(robots()).await.0, 401);
    tokio::time::timeout(SOON, events.text()).await.expect("the stream ends").expect("properly");
    assert!(rows(&database.url, "page_sessions").await.is_empty());
    // A new user of that name is another one.
    add_user(&server, "alice", "admin").await;
    assert_eq!(refusal(robots()).await.0, 401);
}

async fn expired_session_is_refused(database: TestDatabase) {
    let server = new_server(&database).await;
    let cookie = sign_in(&server, &json!({ "token": server.operator.reveal() })).await;
    let robots = || from_page(&server, &cookie, Method::GET, "/api/v1/robots");
    server.clock.advance_ms(PAGE_LIFETIME_MS - 1);
    assert_eq!(status(robots()).await, 200);
    server.clock.advance_ms(1);
    assert_eq!(refusal(robots()).await.0, 401);
    assert_eq!(shown_session(&server, &cookie).await.expires_at_ms, None);
}

/// A session of `user` that expires `number` milliseconds after the others' common minimum.
fn numbered<'a>(token: &'a Token, user: &'a UserName, number: u64) -> NewPageSession<'a> {
    let digest = Digest::of(format!("{user} {number}").as_bytes());
    NewPageSession { digest, token, user, expires_at_ms: 10_000_000 + number }
}

async fn sessions_are_bounded_by_person_and_in_total(database: TestDatabase) {
    const OF_ONE: u64 = 32;
    const OF_ALL: u64 = 1_024;
    let store = &database.store;
    let token = Token::random(TokenKind::Operator);
    store.tokens().create_first(&token, 0).await.expect("stored");
    let user = |name: &str| -> UserName { name.parse().expect("a name") };
    let (alice, bob, other) = (user("alice"), user("bob"), user("other"));
    let lives = async |user: &UserName, number: u64| {
        let digest = numbered(&token, user, number).digest;
        store.page_sessions().admit(&digest, 0).await.expect("reads").is_some()
    };
    let begin = async |user: &UserName, number: u64| {
        let new = numbered(&token, user, number);
        store.page_sessions().begin(&new, None).await.expect("stored")
    };
    assert!(!begin(&bob, 0).await);
    for number in 1..=OF_ONE {
        assert!(!begin(&alice, number).await);
    }
    assert!(lives(&alice, 1).await);
    assert!(begin(&alice, OF_ONE + 1).await, "her oldest ends");
    assert!(!lives(&alice, 1).await && lives(&alice, 2).await, "also in the cache");
    assert!(lives(&bob, 0).await, "one person does not sign others out");

    let mut write = store.begin().await.expect("begins");
    for number in OF_ONE + 1..OF_ALL {
        let user = user(&format!("user{number}"));
        let has_ended = write.page_sessions().insert(&numbered(&token, &user, number)).await;
        assert!(!has_ended.expect("stored"), "{number}");
    }
    write.commit().await.expect("stored");
    assert!(lives(&bob, 0).await);
    assert!(begin(&other, OF_ALL).await, "the oldest of all ends");
    assert!(!lives(&bob, 0).await && lives(&alice, 2).await && lives(&other, OF_ALL).await);
    assert_eq!(rows(&database.url, "page_sessions").await.len() as u64, OF_ALL);

    let replaced = numbered(&token, &alice, 2).digest;
    let new = numbered(&token, &alice, OF_ALL + 1);
    assert!(store.page_sessions().begin(&new, Some(&replaced)).await.expect("stored"));
    assert!(!lives(&alice, 2).await && lives(&alice, 3).await, "in place of one that ends");
}

async fn ended_sessions_and_old_failures_are_removed(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    let (store, now_ms) = (&fleet.database.store, fleet.clock.now_ms());
    let [kept, gone] = [(); 2].map(|()| Token::random(TokenKind::Operator));
    store.tokens().create_first(&kept, now_ms).await.expect("stored");
    let alice: UserName = "alice".parse().expect("a name");
    for new in [
        numbered(&kept, &alice, 0),
        numbered(&kept, &alice, WINDOW_MS),
        numbered(&gone, &alice, WINDOW_MS + 1),
    ] {
        store.page_sessions().begin(&new, None).await.expect("stored");
    }
    let digest_of = |name: &str| NameDigest::of(&name.parse().expect("a name"), &key());
    let failures = async |began_ms: u64, name: &str| {
        let mut write = store.begin().await.expect("begins");
        let window = Window { began_ms, count: 3 };
        write.sign_in_failures().put(&digest_of(name), window).await.expect("stored");
        write.commit().await.expect("stored");
    };
    // The first session's last millisecond, and the last of the first window.
    let later_ms = numbered(&kept, &alice, 0).expires_at_ms;
    failures(later_ms - WINDOW_MS, "alice").await;
    failures(later_ms - WINDOW_MS + 1, "bob").await;
    failures(later_ms + WINDOW_MS, "carol").await;
    fleet.clock.advance_ms(later_ms - now_ms);
    fleet.actions.expire().await.expect("expires");
    let [sessions, failures] = ["page_sessions", "sign_in_failures"]
        .map(async |table| rows(&fleet.database.url, table).await);
    let (sessions, failures) = (sessions.await, failures.await);
    let digest = numbered(&kept, &alice, WINDOW_MS).digest.to_string();
    assert!(sessions.len() == 1 && sessions[0].contains(&digest), "{sessions:?}");
    let bob = digest_of("bob");
    assert!(failures.len() == 1 && failures[0].contains(bob.as_str()), "{failures:?}");
}

async fn simultaneous_wrong_passwords_all_count(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    fleet.add("alice", "operator", None).await;
    let guess = |n: u8| fleet.sign_in("alice", "wrong", IpAddr::from([203, 0, 113, n]));
    let answers = futures_util::future::join_all((0..20).map(guess)).await;
    let (checked, blocked): (Vec<_>, Vec<_>) =
        answers.into_iter().map(code).partition(|code| *code == "unauthorized");
    assert_eq!((checked.len(), blocked), (10, vec!["too_many_requests"; 10]));
}

/// Such a name may be a password in the wrong field.
async fn names_at_a_sign_in_are_stored_as_digests(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    fleet.add("alice", "operator", None).await;
    let here = IpAddr::from([192, 0, 2, 1]);
    for name in ["hunter2-my-cat", "alice"] {
        assert_eq!(code(fleet.sign_in(name, "wrong", here).await), "unauthorized");
        let stored = rows(&fleet.database.url, "sign_in_failures").await.concat();
        let digest = NameDigest::of(&name.parse().expect("a name"), &key());
        assert!(stored.contains(digest.as_str()) && !stored.contains(name), "{stored}");
    }
}

async fn long_password_is_refused_without_a_write(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    fleet.add("alice", "operator", None).await;
    for n in 0..60 {
        let (from, long) = (IpAddr::from([192, 0, 2, 1]), "x".repeat(1_025 + n));
        assert_eq!(code(fleet.sign_in("alice", &long, from).await), "unauthorized");
    }
    assert!(rows(&fleet.database.url, "sign_in_failures").await.is_empty());
}

async fn new_password_ends_the_block_of_its_account(database: TestDatabase) {
    let fleet = Fleet::new(database).await;
    fleet.add("alice", "operator", None).await;
    let sign_in = async |n: u8, password: &str| {
        code(fleet.sign_in("alice", password, IpAddr::from([192, 0, 2, n])).await)
    };
    for n in 0..10 {
        assert_eq!(sign_in(n, "wrong").await, "unauthorized");
    }
    assert_eq!(sign_in(10, PASSWORD).await, "too_many_requests");
    let (alice, new) = ("alice".parse().expect("a name"), "another horse battery");
    fleet.actions.people.set_password(&fleet.operator, &alice, new).await.expect("set");
    assert!(fleet.sign_in("alice", new, IpAddr::from([192, 0, 2, 11])).await.is_ok());
}
