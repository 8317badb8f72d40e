//! The lock that admits one server to a Postgres, and the fence against a server that has lost it.

#![expect(clippy::disallowed_methods, reason = "the test acts for other servers in SQL")]

use std::sync::Arc;
use std::time::Duration;

use sqlx::Connection as _;
use task_proto::RobotId;
use task_proto::trust::token::{Token, TokenKind};
use taskd::fleet::presence::Presence;
use taskd::serve::database::{Database, FirstOperator};
use taskd::store::{LockAttempt, ServerIdentity, Sharing, Store, StoreError, lock_holder};
use taskd::system::clock::Clock;

use crate::database::{self, TestDatabase};

const PATIENCE: Duration = Duration::from_secs(30);

fn identity(run: &str) -> ServerIdentity {
    ServerIdentity {
        run: run.to_owned(),
        key_id: "key".to_owned(),
        topic_prefix: "taskd/v1".to_owned(),
        sharing: Sharing::Alone,
    }
}

fn server(database: &TestDatabase, run: &str) -> Store {
    Store::guarded(&database.url, identity(run))
}

async fn started(database: &TestDatabase, run: &str) -> Store {
    let store = server(database, run);
    store.prepare().await.expect("the lock is free");
    store
}

async fn execute(database: &TestDatabase, sql: &'static str) {
    let mut connection = sqlx::AnyConnection::connect(&database.url).await.expect("connects");
    sqlx::query(sql).execute(&mut connection).await.expect("executed");
}

async fn turn(database: &TestDatabase) -> i64 {
    let mut connection = sqlx::AnyConnection::connect(&database.url).await.expect("connects");
    let turn = sqlx::query_scalar("SELECT turn FROM write_lock");
    turn.fetch_one(&mut connection).await.expect("there")
}

const TAKE_OVER: &str = "UPDATE write_lock SET holder = 'b', held_since_ms = 0";
const END_LOCK_SESSION: &str = "SELECT pg_terminate_backend(pid) FROM pg_locks
    WHERE locktype = 'advisory' AND granted
    AND database = (SELECT oid FROM pg_database WHERE datname = current_database())";

#[tokio::test]
async fn write_after_a_takeover_is_refused() {
    let database = database::postgres().await;
    let store = started(&database, "a").await;
    store.begin().await.expect("begins").commit().await.expect("commits");
    let turns = turn(&database).await;
    execute(&database, TAKE_OVER).await;
    for refused in [store.begin().await, store.begin_without_auth_invalidation().await] {
        let error = refused.err().expect("refused");
        assert!(matches!(error, StoreError::TakenOver { .. }), "{error}");
        assert!(error.to_string().starts_with("server b (since 1970-01-01T"), "{error}");
    }
    assert_eq!(turn(&database).await, turns);
    let successor = tokio::time::timeout(PATIENCE, store.state().taken_over()).await;
    assert!(successor.expect("known").starts_with("server b "));
    store.close().await;
}

#[tokio::test]
async fn takeover_while_the_lock_was_lost_is_noticed_without_a_write() {
    let database = database::postgres().await;
    let store = started(&database, "a").await;
    execute(&database, TAKE_OVER).await;
    execute(&database, END_LOCK_SESSION).await;
    let successor = tokio::time::timeout(PATIENCE, store.state().taken_over()).await;
    assert!(successor.expect("noticed").starts_with("server b "));
    store.close().await;
}

#[tokio::test]
async fn standby_takes_the_lock_when_it_is_free_and_has_the_holders_settings() {
    let database = database::postgres().await;
    assert_eq!(lock_holder(&database.url).await.expect("known"), None);
    let active = started(&database, "a").await;
    let holder = lock_holder(&database.url).await.expect("known").expect("held");
    assert!(holder.to_string().starts_with("server a (since 2"), "{holder}");

    let standby = server(&database, "b");
    assert_eq!(standby.try_succeed().await.expect("tried"), LockAttempt::Held(holder.clone()));
    let other_key = ServerIdentity { key_id: "other".to_owned(), ..identity("c") };
    let error = Store::guarded(&database.url, other_key).try_succeed().await.err();
    assert!(matches!(error, Some(StoreError::ForeignKey { .. })), "{error:?}");
    let other_prefix = ServerIdentity { topic_prefix: "other".to_owned(), ..identity("c") };
    let other_prefix = Store::guarded(&database.url, other_prefix);
    let error = other_prefix.try_succeed().await.err();
    assert!(matches!(error, Some(StoreError::ForeignPrefix { .. })), "{error:?}");

    active.close().await;
    let taken = async {
        while standby.try_succeed().await.expect("tried") != LockAttempt::Taken {}
        standby.prepare().await.expect("prepared");
    };
    tokio::time::timeout(PATIENCE, taken).await.expect("the lock is free");
    standby.begin().await.expect("begins").commit().await.expect("commits");
    assert!(matches!(other_prefix.try_succeed().await, Err(StoreError::ForeignPrefix { .. })));
    standby.close().await;
    // Without another server, the setting may change.
    other_prefix.prepare().await.expect("prepared");
    other_prefix.close().await;
}

#[tokio::test]
async fn write_of_a_stopped_server_ends_after_some_seconds() {
    let database = database::postgres().await;
    let (stopped, next) =
        (database.store.clone(), Store::open(&database.url).await.expect("opens"));
    let stuck = stopped.begin().await.expect("begins");
    // Postgres would otherwise refuse it after 30 s of waiting for the lock.
    let begun = tokio::time::timeout(Duration::from_secs(15), next.begin()).await;
    begun.expect("in time").expect("begins").commit().await.expect("commits");
    assert!(stuck.commit().await.is_err(), "its session has ended");
}

#[tokio::test]
async fn robots_are_not_offline_since_before_a_standby_took_over() {
    let database = database::postgres().await;
    let presence = Arc::new(Presence::new(1, 0));
    let operator = FirstOperator { token: Token::random(TokenKind::Operator), path: "".into() };
    let (standby, clock) = (server(&database, "b"), Clock::system());
    let taken_ms = clock.now_ms();
    let opened = Database::open(standby, Some(operator), presence.clone(), clock.clone()).await;
    let opened = opened.expect("the lock is free");
    let robot = RobotId::random();
    let offline_ms = presence.offline_ms([&robot], clock.now_ms())[0].expect("not seen");
    assert!(offline_ms <= clock.now_ms() - taken_ms, "{offline_ms}");
    opened.store().close().await;
}
