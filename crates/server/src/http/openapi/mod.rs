//! The API's description, OpenAPI 3.1: generated from the table of routes, the input and output
//! types of each handler, and the handler's attribute. The document is the same for all callers and
//! holds no data.

mod draft;
mod handler;

use std::sync::LazyLock;

use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use http::{HeaderMap, StatusCode, header};
use task_macros::operation;
use task_proto::Digest;
use utoipa::openapi::security::{ApiKey, ApiKeyValue, Http, HttpAuthScheme, SecurityScheme};
use utoipa::openapi::tag::TagBuilder;
use utoipa::openapi::{ComponentsBuilder, InfoBuilder, License, OpenApi, OpenApiBuilder, Paths};

pub(super) use self::draft::{Draft, OrderKey, OrderRefusals};
pub(super) use self::handler::{Answer, Created, Describe};
use super::auth::{Access, COOKIE};
use super::{Route, routes};
use crate::http::server::web::has_current_tag;

/// The groups of operations.
const TAGS: [(&str, &str); 12] = [
    ("robots", "Robots: their state, tasks, logs and vitals."),
    ("deployments", "Deployments of packages to robots."),
    ("tasks", "Orders for tasks that robots already have."),
    ("packages", "Packages and their versions."),
    ("outputs", "Files that tasks brought back."),
    ("events", "The stream of changes."),
    ("people", "Users, their tokens and the audit log."),
    ("session", "Sign-in and sign-out."),
    ("enrollment", "Enrollment of new robots."),
    ("agent", "Requests and reports of robots' agents."),
    ("registry", "The OCI distribution API, as defined by its own specification."),
    ("server", "The server and its pages."),
];

const ABOUT: &str = "Distributes task packages to fleets of robots. Times are milliseconds since the Unix epoch by the \
     server's clock, sizes are bytes. Unknown fields are refused in requests; clients should ignore unknown fields in responses.";

/// The document's text and its tag, fixed while the server runs.
static DOCUMENT: LazyLock<(Bytes, String)> = LazyLock::new(|| {
    // Through a `Value`, which sorts its fields: the text is then the same at each start of the
    // server.
    let text = serde_json::to_value(document(&routes()))
        .map(|document| document.to_string())
        .unwrap_or_default();
    let tag = format!("\"{}\"", Digest::of(text.as_bytes()).hex());
    (Bytes::from(text), tag)
});

/// Returns this OpenAPI description.
#[operation(tag = "server",
    responses((status = 200, description = "An OpenAPI 3.1 document.", body = serde_json::Value),
        (status = 304, description = "The document is still the one that `If-None-Match` names.")))]
pub(super) async fn show(headers: HeaderMap) -> Response {
    let (text, tag) = &*DOCUMENT;
    let caching = [(header::ETAG, tag.clone()), (header::CACHE_CONTROL, "no-cache".to_owned())];
    if has_current_tag(&headers, tag) {
        return (StatusCode::NOT_MODIFIED, caching).into_response();
    }
    (caching, [(header::CONTENT_TYPE, "application/json")], text.clone()).into_response()
}

/// The document for these routes.
pub(super) fn document(routes: &[Route]) -> OpenApi {
    let mut components = ComponentsBuilder::new()
        .security_scheme(
            "token",
            SecurityScheme::Http(scheme(HttpAuthScheme::Bearer, "A person's, a robot's or an enrollment token.")),
        )
        .security_scheme(
            "password",
            SecurityScheme::Http(scheme(HttpAuthScheme::Basic, "Any user name, and the token as the password.")),
        )
        .security_scheme(
            "session",
            SecurityScheme::ApiKey(ApiKey::Cookie(ApiKeyValue::with_description(
                COOKIE,
                "The cookie of a signed-in page. Requests that change something must come from the same origin.",
            ))),
        )
        .build();
    let mut paths = Paths::new();
    for route in described(routes) {
        let drafted = Draft::of(route);
        for (name, schema) in drafted.schemas {
            components.schemas.insert(name, schema);
        }
        paths.add_path_operation(drafted.path, vec![drafted.method], drafted.operation);
    }
    OpenApiBuilder::new()
        .info(
            InfoBuilder::new()
                .title("taskd")
                .version(env!("CARGO_PKG_VERSION"))
                .description(Some(ABOUT))
                .license(Some(License::new(env!("CARGO_PKG_LICENSE"))))
                .build(),
        )
        .tags(Some(
            TAGS.map(|(name, text)| TagBuilder::new().name(name).description(Some(text)).build()),
        ))
        .paths(paths)
        .components(Some(components))
        .build()
}

/// The routes to describe, each once: a route with and without a trailing slash counts as one.
/// Those between the servers of a cluster are no part of the API.
fn described(routes: &[Route]) -> impl Iterator<Item = &Route> {
    let has_longer =
        |path: &str| routes.iter().any(|other| other.path.strip_suffix('/') == Some(path));
    let is_described = |route: &&Route| route.access != Access::Peer;
    routes.iter().filter(is_described).filter(move |route| !has_longer(route.path))
}

fn scheme(kind: HttpAuthScheme, text: &str) -> Http {
    Http::builder().scheme(kind).description(Some(text)).build()
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use serde_json::Value;

    use super::*;

    fn as_json() -> Value {
        serde_json::to_value(document(&routes())).expect("json")
    }

    /// Every operation, with its method and its path.
    fn operations(document: &Value) -> Vec<(String, &Value)> {
        let paths = document["paths"].as_object().expect("paths");
        let items = paths.iter().flat_map(|(path, item)| {
            let methods = item.as_object().expect("methods").iter();
            methods.map(move |(method, operation)| (format!("{method} {path}"), operation))
        });
        items.collect()
    }

    /// All references in a value.
    fn references(value: &Value, found: &mut BTreeSet<String>) {
        match value {
            Value::Object(fields) => {
                found.extend(fields.get("$ref").and_then(Value::as_str).map(str::to_owned));
                fields.values().for_each(|field| references(field, found));
            }
            Value::Array(items) => items.iter().for_each(|item| references(item, found)),
            _ => {}
        }
    }

    #[test]
    fn every_route_is_described() {
        let document = as_json();
        let described = operations(&document);
        assert_eq!(
            described.len(),
            super::described(&routes()).count(),
            "each route has an operation of its own"
        );
        let ids: BTreeSet<&str> =
            described.iter().filter_map(|(_, it)| it["operationId"].as_str()).collect();
        assert_eq!(ids.len(), described.len(), "no two operations have one name");
        let tags: BTreeSet<&str> = TAGS.iter().map(|(name, _)| *name).collect();
        for (name, operation) in described {
            let text = |field: &str| operation[field].as_str().unwrap_or_default();
            assert!(text("summary").len() > 10, "{name} says what it does: {:?}", text("summary"));
            assert!(
                text("description").contains(|c: char| c.is_alphabetic()),
                "{name} says who may call it"
            );
            let tag = operation["tags"].as_array().and_then(|tags| tags.first()?.as_str());
            assert!(
                tag.is_some_and(|tag| tags.contains(tag)),
                "{name} belongs to a group that is known: {tag:?}"
            );
            let answers = operation["responses"].as_object().expect("answers");
            assert!(
                answers.keys().any(|status| status.starts_with(['1', '2', '3'])),
                "{name} can succeed"
            );
            for (status, answer) in answers {
                assert!(
                    !answer["description"].as_str().unwrap_or_default().is_empty(),
                    "{name}: {status} is explained"
                );
                let has_body = !matches!(status.as_str(), "101" | "204" | "303" | "304");
                let schemas = answer["content"].as_object().map_or(0, |content| {
                    content.values().filter(|media| media["schema"].is_object()).count()
                });
                assert_eq!(schemas > 0, has_body, "{name}: {status} says what its body is");
            }
            let parameters: Vec<&str> =
                operation["parameters"].as_array().map_or(Vec::new(), |parameters| {
                    parameters
                        .iter()
                        .inspect(|it| {
                            assert!(
                                it["description"].is_string(),
                                "{name}: {} is explained",
                                it["name"]
                            )
                        })
                        .filter_map(|it| it["name"].as_str())
                        .collect()
                });
            let in_path =
                name.split(['/', ' ']).filter_map(|part| part.strip_prefix('{')?.strip_suffix('}'));
            in_path.for_each(|wanted| {
                assert!(parameters.contains(&wanted), "{name}: {wanted} is described")
            });
        }
    }

    #[test]
    fn guard_refusals_are_described_for_every_route() {
        let document = as_json();
        for (name, operation) in operations(&document) {
            let is_for_anyone = operation["x-caller"] == "anyone";
            assert_eq!(
                operation["security"].as_array().is_some_and(Vec::is_empty),
                is_for_anyone,
                "{name}"
            );
            for status in ["401", "403", "429", "500"] {
                let answer = &operation["responses"][status];
                assert!(is_for_anyone || answer.is_object(), "{name} may answer {status}");
            }
            if operation["requestBody"].is_object() {
                for status in ["400", "413", "415"] {
                    assert!(
                        operation["responses"][status].is_object(),
                        "{name} may answer {status}"
                    );
                }
            }
        }
    }

    #[test]
    fn every_reference_in_the_document_resolves() {
        let document = as_json();
        let mut found = BTreeSet::new();
        references(&document, &mut found);
        assert!(found.len() > 50, "{}", found.len());
        for reference in found {
            let pointer = reference.strip_prefix('#').expect("it refers to itself");
            assert!(document.pointer(pointer).is_some(), "{reference} leads nowhere");
        }
    }
}
