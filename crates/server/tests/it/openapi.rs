//! The OpenAPI description: whether it is valid, and whether the server answers accordingly.
#![expect(clippy::disallowed_methods, reason = "a test harness starts processes")]

use std::process::Stdio;
use std::time::Duration;

use reqwest::Method;
use serde_json::json;
use task_proto::people::roles::Role;
use tokio::process::Command;

use crate::harness::TestServer;

/// Time limit for work that takes a quarter of a minute on an idle machine.
const PATIENCE: Duration = Duration::from_secs(240);

/// A program in the environment with the tools.
fn tool(name: &str) -> Command {
    let Ok(environment) = std::env::var("TASKD_TEST_SCHEMATHESIS") else {
        panic!(
            "TASKD_TEST_SCHEMATHESIS is not set: run ./scripts/test, \
             or set it to the directory that scripts/need schemathesis prints"
        );
    };
    let mut command = Command::new(format!("{environment}/bin/{name}"));
    command.stdin(Stdio::null()).kill_on_drop(true);
    command
}

/// Runs the command to its end, which must be a success.
async fn run(mut command: Command) {
    let output = tokio::time::timeout(PATIENCE, command.output())
        .await
        .expect("it ends")
        .expect("it starts");
    let said =
        [output.stdout, output.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned());
    assert!(output.status.success(), "{}", said.join("\n"));
}

#[tokio::test(flavor = "multi_thread")]
async fn openapi_document_is_valid() {
    let server = TestServer::start().await;
    let answer = server.bare(Method::GET, "/api/openapi.json").send().await.expect("an answer");
    let tag = answer.headers()["etag"].clone();
    let document = server.directory.path().join("openapi.json");
    std::fs::write(&document, answer.bytes().await.expect("a body")).expect("written");
    let mut validator = tool("openapi-spec-validator");
    validator.arg("--schema").arg("3.1").arg(&document);
    run(validator).await;
    let known =
        server.bare(Method::GET, "/api/openapi.json").header("if-none-match", tag).send().await;
    assert_eq!(known.expect("an answer").status(), 304);
}

#[tokio::test(flavor = "multi_thread")]
async fn answers_match_the_openapi_document() {
    let server = TestServer::start().await;
    // The names are the description's examples, which are asked for most.
    server.enroll("atlas-1").await;
    let package = server.push("corridor_mapping", "1.0.0").await;
    server.deploy(&package, "*", "first").await;
    let alice = json!({ "name": "alice", "roles": [Role::Viewer] });
    server.request(Method::POST, "/api/v1/users").json(&alice).send().await.expect("an answer");
    let mut schemathesis = tool("schemathesis");
    // Its records of a run stay with the server's files.
    schemathesis.current_dir(server.directory.path());
    schemathesis.args([
        "run",
        &server.url("/api/openapi.json"),
        "--seed",
        "1",
        "--max-examples",
        "10",
    ]);
    schemathesis.arg("--header").arg(format!("Authorization: Bearer {}", server.operator.reveal()));
    schemathesis.args([
        "--phases",
        "examples,coverage,fuzzing",
        "--checks",
        "not_a_server_error,status_code_conformance,content_type_conformance,\
         response_schema_conformance",
        "--request-timeout",
        "30",
        "--continue-on-failure",
        "--no-shrink",
        "--warnings",
        "off",
        // The registry follows the OCI specification, whose conformance other tests check; the
        // second is no HTTP beyond its handshake; the third, and followed logs, stream without end.
        "--exclude-path-regex",
        "^/v2|^/mqtt$|^/api/v1/events$|/logs$",
        // The call would end the token that all other calls are made with.
        "--exclude-operation-id",
        "session_sign_out",
        // Its body is an archive, which no schema tells how to make.
        "--exclude-operation-id",
        "upload_package",
        // Robots' own routes refuse every other caller before the request is read.
        "--exclude-tag",
        "agent",
    ]);
    run(schemathesis).await;
}
