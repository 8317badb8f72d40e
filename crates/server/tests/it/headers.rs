//! Headers of every answer to a browser: nothing of the server is ever framed, sniffed, kept or
//! run, except for the page's own files.

use reqwest::{Method, Response};
use serde_json::{Value, json};
use taskd::http::routes;

use crate::harness::{TestServer, archive_with};

const EVERYWHERE: [(&str, &str); 5] = [
    ("x-content-type-options", "nosniff"),
    ("x-frame-options", "DENY"),
    ("referrer-policy", "no-referrer"),
    ("cross-origin-opener-policy", "same-origin"),
    ("cross-origin-resource-policy", "same-origin"),
];
const ANSWER: &str =
    "default-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'; sandbox";
const PAGE: &str = "default-src 'none'; script-src 'self'; style-src 'self'; \
                    img-src 'self' data:; font-src 'self'; connect-src 'self'; \
                    worker-src 'self'; manifest-src 'self'; base-uri 'none'; \
                    form-action 'none'; frame-ancestors 'none'";

fn check(response: &Response, policy: &str, what: &str) {
    let text = |name: &str| {
        let values: Vec<_> = response
            .headers()
            .get_all(name)
            .iter()
            .map(|value| value.to_str().expect("text"))
            .collect();
        values.join(" | ")
    };
    for (name, value) in EVERYWHERE {
        assert_eq!(text(name), value, "{name} of {what}");
    }
    assert_eq!(text("content-security-policy"), policy, "{what}");
    let is_page = policy == PAGE;
    assert!(
        is_page || !text("content-type").contains("html"),
        "{what} is {}",
        text("content-type")
    );
    assert!(!text("cache-control").is_empty(), "{what}");
    assert_eq!(text("access-control-allow-origin"), "", "{what}");
}

#[tokio::test(flavor = "multi_thread")]
async fn every_api_answer_has_a_strict_content_policy() {
    let server = TestServer::start().await;
    let robot = server.enroll("atlas").await;
    let package = server.push("talker", "1.0.0").await;
    let deployment = server.deploy(&package, "*", "first").await;
    let mut looked_at = 0;
    // All kinds of callers: with rights, without, and a robot.
    let comers = [
        Some(server.operator.reveal()),
        None,
        Some("tsko_nonsense".to_owned()),
        Some(robot.token.clone()),
    ];
    let methods =
        [Method::GET, Method::HEAD, Method::OPTIONS, Method::POST, Method::PUT, Method::PATCH];
    for route in routes() {
        let path = route
            .path
            .replace("{robot}", robot.id.as_str())
            .replace("{deployment}", deployment.id.as_str());
        let path = path
            .replace("{task}", "talker")
            .replace("{user}", "alice")
            .replace("{token}", "0123456789ab");
        let path = path.replace("{*file}", "app.js").replace("{*path}", "talker/tags/list");
        let is_page = path == "/" || path == "/api/docs" || path.starts_with("/ui/");
        for comer in &comers {
            for method in &methods {
                let mut request = server.bare(method.clone(), &path).json(&json!({}));
                if let Some(token) = comer {
                    request = request.bearer_auth(token);
                }
                // The head is enough; some answers go on without end.
                let response = request.send().await.expect("an answer");
                let what = format!("{method} {path} ({})", response.status());
                let is_page = is_page && matches!(*method, Method::GET | Method::HEAD);
                check(&response, if is_page { PAGE } else { ANSWER }, &what);
                looked_at += 1;
            }
        }
    }
    assert_eq!(looked_at, routes().len() * comers.len() * methods.len());
}

#[tokio::test(flavor = "multi_thread")]
async fn stored_content_and_errors_are_never_served_as_pages() {
    let server = TestServer::start().await;
    let html = "<script>fetch('/api/v1/users')</script>";
    let package = server.push_content("talker", "1.0.0", archive_with(html.as_bytes())).await;
    let get = |path: &str| server.request(Method::GET, path);
    for path in [
        format!("/v2/talker/blobs/{}", package.content.digest),
        format!("/v2/talker/manifests/{}", package.manifest.digest),
        "/v2/_catalog".to_owned(),
        "/v2/<script>/tags/list".to_owned(),
        "/api/v1/robots/<script>".to_owned(),
        "/api/v1/robots?selector=<script>".to_owned(),
        "/<script>alert(1)</script>".to_owned(),
        "/ui/<script>".to_owned(),
        "/ui/../Cargo.toml".to_owned(),
    ] {
        let response = get(&path).send().await.expect("an answer");
        check(&response, ANSWER, &path);
    }
    // A type that would make it one is refused.
    let manifest = get(&format!("/v2/talker/manifests/{}", package.manifest.digest))
        .send()
        .await
        .expect("an answer");
    let mut manifest: Value = manifest.json().await.expect("JSON");
    // The manifest's own type would contradict.
    manifest.as_object_mut().expect("an object").remove("mediaType").expect("it has one");
    let put = server
        .request(Method::PUT, "/v2/talker/manifests/2.0.0")
        .header("content-type", "text/html");
    let refused = put.body(manifest.to_string()).send().await.expect("an answer");
    assert_eq!(refused.status(), 400);
    check(&refused, ANSWER, "a manifest that is said to be HTML");
    let answer: Value = refused.json().await.expect("JSON");
    assert_eq!(answer["errors"][0]["code"], "MANIFEST_INVALID");
    let message = answer["errors"][0]["message"].as_str().expect("text");
    assert!(message.contains("text/html"), "{message}");
    let too_large =
        server.request(Method::POST, "/api/v1/users").json(&json!({ "name": "x".repeat(100_000) }));
    check(&too_large.send().await.expect("an answer"), ANSWER, "a body that is too large");
    let page = server.bare(Method::GET, "/").send().await.expect("an answer");
    let tag = page.headers()["etag"].clone();
    let known =
        server.bare(Method::GET, "/").header("if-none-match", tag).send().await.expect("an answer");
    assert_eq!(known.status(), 304);
    check(&known, PAGE, "the page that has not changed");
}
