//! The Postgres servers that the setting `database` names: the primary is found, also after a
//! failover, TLS is verified, and a pooler that mixes sessions is refused.

use rcgen::{BasicConstraints, CertificateParams, DnType, IsCa, Issuer, KeyPair};
use reqwest::{Method, StatusCode};
use serde_json::json;
use task_proto::trust::token::{Token, TokenKind};
use taskd::store::{Fault, Store, StoreError};
use tempfile::TempDir;

use crate::harness::{NOW_MS, TestServer};
use crate::postgres::{database, eventually};
use crate::postgres_cluster::{PgBouncer, Postgres, free_port, url};

fn primary() -> Postgres {
    let primary = Postgres::create();
    primary.start();
    primary
}

/// The URL of a server as messages show it.
fn shown(port: u16) -> String {
    format!("postgres://127.0.0.1:{port}/postgres")
}

/// The error of a database that can't be opened, and its text with all causes.
async fn refused(database: &str) -> (StoreError, String) {
    let error = Store::open(database).await.expect_err("refused");
    let mut text = error.to_string();
    let mut source = std::error::Error::source(&error);
    while let Some(cause) = source {
        text += &format!(": {cause}");
        source = cause.source();
    }
    assert!(!text.contains("swordfish"), "{text}");
    (error, text)
}

async fn write(store: &Store) -> Result<(), StoreError> {
    store.begin().await?.commit().await
}

#[tokio::test(flavor = "multi_thread")]
async fn primary_is_found_among_several_urls() {
    let primary = primary();
    let standby = primary.start_standby();
    let absent = free_port();
    let list = [url(absent), standby.url(), primary.url()].join(", ");
    let store = Store::open(&list).await.expect("opens");
    write(&store).await.expect("written");
    store.close().await;

    let (error, text) = refused(&[url(absent), standby.url()].join(",")).await;
    assert_eq!(error.fault(), Some(Fault::Unreachable), "a primary may come: {text}");
    let reasons = format!(
        "{}: Connection refused (os error 111); {}: the server is a standby",
        shown(absent),
        shown(standby.port)
    );
    assert!(text.ends_with(&reasons), "{text}");
}

#[tokio::test(flavor = "multi_thread")]
async fn connections_move_to_the_promoted_standby() {
    let primary = primary();
    let standby = primary.start_standby();
    let list = [primary.url(), standby.url()].join(",");
    let directory = TempDir::new().expect("a directory");
    let server = TestServer::start_in(directory, |config| config.database = Some(list)).await;
    let robot = server.enroll("atlas").await;

    primary.kill();
    eventually("/readyz has the reason of each server", async || {
        let (status, database) = database(&server).await;
        assert!(!database.contains("swordfish"), "{database}");
        status == StatusCode::SERVICE_UNAVAILABLE
            && database.contains(&format!("{}: Connection refused", shown(primary.port)))
            && database.contains(&format!("{}: the server is a standby", shown(standby.port)))
    })
    .await;
    standby.promote();
    let order = || server.request(Method::POST, "/api/v1/enrollment-tokens").json(&json!({}));
    eventually("it writes again", async || {
        order().send().await.is_ok_and(|response| response.status().is_success())
    })
    .await;
    server.enroll("bolt").await;
    let known = server.robot(&robot).await.name;
    assert_eq!(known.as_str(), "atlas", "the write before the failover is there");
    eventually("/readyz says so", async || database(&server).await.0 == StatusCode::OK).await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn read_only_server_is_left_by_writes_and_reads() {
    let former = primary();
    let standby = former.start_standby();
    let store = Store::open(&[former.url(), standby.url()].join(",")).await.expect("opens");
    former.query("ALTER SYSTEM SET default_transaction_read_only = on");
    former.query("SELECT pg_reload_conf()");
    eventually("it is read-only", async || store.begin().await.is_err()).await;
    standby.promote();
    eventually("it writes again", async || write(&store).await.is_ok()).await;
    // The former primary still answers reads. None may go there.
    let token = Token::random(TokenKind::Operator);
    store.tokens().create_first(&token, NOW_MS).await.expect("written");
    assert!(store.tokens().holder(&token, NOW_MS).await.expect("reads").is_some());
    store.close().await;
}

/// An authority of the test's own, with its certificate in PEM.
struct Authority {
    issuer: Issuer<'static, KeyPair>,
    certificate: String,
}

impl Authority {
    fn new(name: &str) -> Self {
        let mut params = CertificateParams::new(Vec::new()).expect("no names");
        params.distinguished_name.push(DnType::CommonName, name);
        params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
        let key = KeyPair::generate().expect("a key");
        let certificate = params.self_signed(&key).expect("signed").pem();
        Self { issuer: Issuer::new(params, key), certificate }
    }

    /// Certificate and key, in PEM, for this name.
    fn issue(&self, name: &str) -> (String, String) {
        let params = CertificateParams::new(vec![name.to_owned()]).expect("a name");
        let key = KeyPair::generate().expect("a key");
        (params.signed_by(&key, &self.issuer).expect("signed").pem(), key.serialize_pem())
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn tls_to_postgres_is_verified() {
    let (authority, stranger, namesake) =
        (Authority::new("lab"), Authority::new("elsewhere"), Authority::new("lab"));
    let (certificate, key) = authority.issue("127.0.0.1");
    let postgres = Postgres::create_with_tls(&certificate, &key);
    postgres.start();
    let right = postgres.write("right.crt", &authority.certificate);
    let wrong = postgres.write("wrong.crt", &stranger.certificate);
    let same_name = postgres.write("same_name.crt", &namesake.certificate);
    let verified =
        |root: &str| format!("{}?sslmode=verify-full&sslrootcert={root}", postgres.url());
    for url in [verified(&right), format!("{}?sslmode=require", postgres.url()), postgres.url()] {
        let store = Store::open(&url).await.expect("opens");
        write(&store).await.expect("written");
        store.close().await;
    }
    let unknown = "certificate is not accepted: it is signed by no known authority";
    for (url, reason) in [
        (format!("{}?sslmode=disable", postgres.url()), "no encryption"),
        (verified(&wrong), unknown),
        (verified(&same_name), unknown),
        (format!("{}?sslmode=verify-full", postgres.url()), unknown),
        (verified(&right).replace("127.0.0.1", "localhost"), "not valid for name \"localhost\""),
        (verified("/nonexistent.crt"), "sslrootcert /nonexistent.crt can't be read"),
    ] {
        let (error, text) = refused(&url).await;
        assert!(text.contains(reason), "{url}: {text}");
        assert_eq!(error.fault(), None, "waiting does not mend it: {text}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn pooler_in_transaction_mode_is_refused() {
    let postgres = primary();
    let ignore = "ignore_startup_parameters = extra_float_digits";
    for size in [1, 20] {
        let settings = format!("pool_mode = transaction\ndefault_pool_size = {size}\n{ignore}");
        let pooler = PgBouncer::start(&postgres, &settings);
        let (error, text) = refused(&pooler.url()).await;
        assert_eq!(error.fault(), None, "waiting does not mend it: {text}");
        for part in ["pg_backend_pid", "the setting `database`", "PgBouncer"] {
            assert!(text.contains(part), "{part}: {text}");
        }
    }
    let tables = "SELECT count(*) FROM pg_tables WHERE schemaname = 'public'";
    assert_eq!(postgres.query(tables), "0", "nothing is written");

    let pooler = PgBouncer::start(&postgres, "pool_mode = session");
    let (error, text) = refused(&pooler.url()).await;
    assert!(text.contains("unsupported startup parameter"), "{text}");
    assert_eq!(error.fault(), None, "waiting does not mend it: {text}");

    let pooler = PgBouncer::start(&postgres, &format!("pool_mode = session\n{ignore}"));
    let store = Store::open(&pooler.url()).await.expect("a session of its own suffices");
    write(&store).await.expect("written");
    store.close().await;
}
