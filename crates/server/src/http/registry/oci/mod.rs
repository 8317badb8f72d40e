//! The registry: the OCI distribution API v1.1, pull and push, under `/v2/`. People pull and push
//! as their roles allow. A robot reads the blobs of its packages and pushes outputs into its own
//! repositories. The store holds the repositories' contents, the blob store holds the bytes.

mod blobs;
mod error;
mod lists;
mod manifests;
pub mod parsed;
mod publish;
mod signed;
mod uploads;

use std::net::{IpAddr, Ipv4Addr, SocketAddr};

use axum::body::Body;
use axum::extract::rejection::PathRejection;
use axum::extract::{ConnectInfo, Path, Request, State};
use axum::response::{IntoResponse, Response};
use http::request::Parts;
use http::{HeaderMap, HeaderValue, Method, StatusCode, Uri};
use serde::de::DeserializeOwned;
use task_macros::operation;
use task_proto::ids::digest::Algorithm;
use task_proto::packages::output::{self, OUTPUT_TYPE};
use task_proto::packages::publisher::LIST_REPOSITORY;
use task_proto::people::roles::Permission;
use task_proto::{Digest, RepositoryName, RobotId};

pub use error::OciError;
pub use publish::publish;

use super::Registry;
use crate::domain::person::Person;
use crate::http::auth::Caller;
use crate::http::peers::Patience;
use crate::store::Reference;

/// Error message for digests by an unsupported algorithm.
const ALGORITHMS: &str = "only sha256 and sha512 are supported";

/// The result of every registry handler.
pub type Answer = Result<Response, OciError>;

/// The resource that a path below `/v2/` names.
#[derive(Debug, PartialEq, Eq)]
enum Endpoint<'a> {
    Blob(&'a str),
    Uploads,
    Upload(&'a str),
    Manifest(&'a str),
    Tags,
    Referrers(&'a str),
}

/// Splits a path into the repository's name, which may contain slashes, and the endpoint after it.
fn endpoint(path: &str) -> Option<(&str, Endpoint<'_>)> {
    let segments: Vec<&str> = path.split('/').collect();
    let (name_len, endpoint) = match segments[..] {
        [ref name @ .., "blobs", "uploads", ""] | [ref name @ .., "blobs", "uploads"] => {
            (name.len(), Endpoint::Uploads)
        }
        [ref name @ .., "blobs", "uploads", id] => (name.len(), Endpoint::Upload(id)),
        [ref name @ .., "blobs", digest] => (name.len(), Endpoint::Blob(digest)),
        [ref name @ .., "manifests", reference] => (name.len(), Endpoint::Manifest(reference)),
        [ref name @ .., "tags", "list"] => (name.len(), Endpoint::Tags),
        [ref name @ .., "referrers", digest] => (name.len(), Endpoint::Referrers(digest)),
        _ => return None,
    };
    let bytes: usize = segments[..name_len].iter().map(|segment| segment.len() + 1).sum();
    Some((path[..bytes].strip_suffix('/')?, endpoint))
}

/// Confirms that this is an OCI registry and that the caller's token is valid.
#[operation(tag = "registry",
    responses((status = 200, description = "The token is valid.", body = serde_json::Value, example = json!({}))))]
pub async fn version(request: Request) -> Answer {
    match request.extensions().get::<Caller>() {
        Some(Caller::Person(_) | Caller::Robot(_)) => {}
        _ => return Err(OciError::unauthorized()),
    }
    if !matches!(*request.method(), Method::GET | Method::HEAD) {
        return Err(OciError::method("GET, HEAD"));
    }
    let mut headers = HeaderMap::new();
    headers.insert("docker-distribution-api-version", HeaderValue::from_static("registry/2.0"));
    Ok((headers, axum::Json(serde_json::json!({}))).into_response())
}

/// The OCI distribution API, pull and push.
///
/// Manifests, blobs, uploads, tags and referrers of packages, lists of publishers and outputs, as
/// defined by the specification of that API. People pull and push as their roles allow; a robot
/// reads the blobs of its packages and pushes its own outputs.
// The caller is taken from the request's extensions, where the guard put it. Without a caller, the
// request is refused.
#[operation(tag = "registry",
    params(("path" = String, Path, description = "The repository's name and the resource in it, with slashes.")),
    responses((status = 200, description = "As defined by the OCI distribution specification.", body = String,
        content_type = "application/octet-stream")))]
pub async fn dispatch(
    State(registry): State<Registry>,
    path: Result<Path<String>, PathRejection>,
    request: Request,
) -> Answer {
    let (parts, body) = request.into_parts();
    let caller = parts.extensions.get::<Caller>().cloned();
    if !matches!(caller, Some(Caller::Person(_) | Caller::Robot(_))) {
        return Err(OciError::unauthorized());
    }
    let Path(path) = path.map_err(|_| OciError::path_invalid())?;
    let (name, endpoint) = endpoint(&path).ok_or_else(OciError::no_endpoint)?;
    let repository: RepositoryName =
        name.parse().map_err(|error| OciError::name_invalid(&error))?;
    let method = parts.method.clone();
    let (robot, person) =
        (caller.as_ref().and_then(Caller::robot), caller.as_ref().and_then(Caller::person));
    if let Some(person) = person {
        check_person(&registry, person, &repository, &method, &endpoint).await?;
    }
    if let Some(robot) = robot
        && !may_push(robot, &repository, &method, &endpoint)
    {
        return match (&method, endpoint) {
            (&Method::GET | &Method::HEAD, Endpoint::Blob(digest)) => {
                blobs::get_for_robot(&registry, robot, digest_of_blob(digest)?, &parts).await
            }
            _ => Err(OciError::denied(
                "a robot may only read its packages' blobs and push its own outputs",
            )),
        };
    }
    match endpoint {
        Endpoint::Blob(digest) => {
            let digest = digest_of_blob(digest)?;
            match method {
                Method::HEAD if may_start_upload(person, &repository) => {
                    blobs::head_before_push(&registry, &repository, digest, &parts).await
                }
                Method::GET | Method::HEAD => {
                    blobs::get(&registry, &repository, digest, &parts).await
                }
                Method::DELETE => {
                    blobs::delete(&registry, require_person(person)?, &repository, digest).await
                }
                _ => Err(OciError::method("GET, HEAD, DELETE")),
            }
        }
        Endpoint::Uploads if method == Method::POST => {
            // A mount may name any repository as its source, including one outside the caller's
            // scope.
            let may_mount = person.is_some_and(|person| person.scope.is_everything());
            uploads::begin(&registry, &repository, &parts, body, may_mount).await
        }
        Endpoint::Uploads => Err(OciError::method("POST")),
        Endpoint::Upload(id) => {
            let id = id.parse().map_err(|_| OciError::upload_unknown())?;
            if let Some(peer) = registry.peers.with_upload(&id, &parts.headers).await? {
                let address = address(&parts, person);
                let request = Request::from_parts(parts, body);
                let forwarded = registry.peers.forward(&peer, Patience::UPLOAD, address, request);
                // The client begins anew.
                return forwarded.await.map_err(|_| OciError::upload_unknown());
            }
            let upload = uploads::Upload { registry: &registry, repository: &repository, id };
            match method {
                Method::GET => upload.status().await,
                Method::PATCH => upload.append(&parts, body).await,
                Method::PUT => upload.finish(&parts, body).await,
                Method::DELETE => upload.cancel().await,
                _ => Err(OciError::method("GET, PATCH, PUT, DELETE")),
            }
        }
        Endpoint::Manifest(text) => {
            manifest(&registry, &repository, text, caller.as_ref(), &parts, body).await
        }
        Endpoint::Tags | Endpoint::Referrers(_) if method != Method::GET => {
            Err(OciError::method("GET"))
        }
        Endpoint::Tags => lists::tags(&registry, &repository, &parts).await,
        Endpoint::Referrers(subject) => {
            lists::referrers(&registry, &repository, subject, &parts).await
        }
    }
}

/// The address of the caller, as far as it is known.
fn address(parts: &Parts, person: Option<&Person>) -> IpAddr {
    let connection = || parts.extensions.get::<ConnectInfo<SocketAddr>>();
    person
        .and_then(|person| person.address)
        .or_else(|| connection().map(|ConnectInfo(peer)| peer.ip()))
        .unwrap_or(IpAddr::V4(Ipv4Addr::UNSPECIFIED))
}

/// Answers a request about the manifest that `text`, a tag or a digest, refers to.
async fn manifest(
    registry: &Registry,
    repository: &RepositoryName,
    text: &str,
    caller: Option<&Caller>,
    parts: &Parts,
    body: Body,
) -> Answer {
    let person = caller.and_then(Caller::person);
    let reference = parse_reference(text);
    match parts.method {
        Method::GET | Method::HEAD => manifests::get(registry, repository, reference, parts).await,
        Method::PUT => {
            let required_type = caller.and_then(Caller::robot).map(|_| OUTPUT_TYPE);
            let push = manifests::Push::of(parts, repository, reference?, person, required_type)?;
            manifests::put(registry, push, parts, body).await
        }
        Method::DELETE if has_unsupported_algorithm(text) => Err(OciError::manifest_unknown()),
        Method::DELETE => {
            manifests::delete(registry, require_person(person)?, repository, reference?).await
        }
        _ => Err(OciError::method("GET, HEAD, PUT, DELETE")),
    }
}

/// Refuses requests without the needed permission, and access to outputs of robots outside the
/// person's scope.
async fn check_person(
    registry: &Registry,
    person: &Person,
    repository: &RepositoryName,
    method: &Method,
    endpoint: &Endpoint<'_>,
) -> Result<(), OciError> {
    let permission = required_permission(repository, method, endpoint);
    if !person.may(permission) {
        let (name, roles) = (&person.name, &person.roles);
        return Err(OciError::denied(format!(
            "{name} has no permission to {permission} here (roles: {roles})"
        )));
    }
    if person.scope.is_everything() {
        return Ok(());
    }
    let Some((robot, _)) = output::owner(repository) else { return Ok(()) };
    let robot = registry.store.robots().find(robot.as_str()).await?;
    if robot.is_some_and(|robot| person.scope.covers(&robot.id, &robot.name, &robot.labels)) {
        return Ok(());
    }
    let (name, scope) = (&person.name, person.scope.to_string());
    Err(OciError::denied(format!("{repository} is outside of {name}'s scope {scope:?}")))
}

/// The permission that a person needs for this request. Outputs belong to robots: deleting an
/// output takes the same permission as stopping the task it came from, and pushing in a robot's
/// name takes full rights. The list of publishers concerns all robots.
fn required_permission(
    repository: &RepositoryName,
    method: &Method,
    endpoint: &Endpoint<'_>,
) -> Permission {
    let is_output = is_output_repository(repository);
    match (method, endpoint) {
        (&Method::GET | &Method::HEAD, endpoint)
            if !matches!(endpoint, Endpoint::Uploads | Endpoint::Upload(_)) =>
        {
            Permission::Read
        }
        (&Method::DELETE, Endpoint::Manifest(_)) if is_output => Permission::Operate,
        _ if is_reserved(repository) => Permission::Administer,
        _ => Permission::Publish,
    }
}

/// The person that deletes; robots delete nothing.
fn require_person(person: Option<&Person>) -> Result<&Person, OciError> {
    person.ok_or_else(|| OciError::denied("robots can't delete anything"))
}

/// True for repositories reserved for outputs or for lists of publishers.
fn is_reserved(repository: &RepositoryName) -> bool {
    is_output_repository(repository) || repository.as_str() == LIST_REPOSITORY
}

fn is_output_repository(repository: &RepositoryName) -> bool {
    repository.as_str().starts_with("outputs/")
}

/// True if an admitted caller may push to this repository. A robot gets this far only for its own
/// outputs.
fn may_start_upload(person: Option<&Person>, repository: &RepositoryName) -> bool {
    person.is_none_or(|person| {
        person.may(required_permission(repository, &Method::POST, &Endpoint::Uploads))
    })
}

/// True if the request is part of pushing one of the robot's own outputs. Such a request deletes
/// nothing and reads nothing back.
fn may_push(
    robot: &RobotId,
    repository: &RepositoryName,
    method: &Method,
    endpoint: &Endpoint<'_>,
) -> bool {
    let is_own = output::owner(repository).is_some_and(|(owner, _)| owner == *robot);
    is_own
        && match endpoint {
            Endpoint::Blob(_) => *method == Method::HEAD,
            Endpoint::Uploads | Endpoint::Upload(_) => true,
            Endpoint::Manifest(_) => matches!(*method, Method::PUT | Method::HEAD),
            Endpoint::Tags | Endpoint::Referrers(_) => false,
        }
}

fn parse_digest(text: &str) -> Result<Digest, OciError> {
    text.parse().map_err(|error: task_proto::ids::digest::InvalidDigest| {
        match has_unsupported_algorithm(text) {
            true => OciError::digest_invalid(ALGORITHMS),
            false => OciError::digest_invalid(error.to_string()),
        }
    })
}

/// The digest of a blob to look up. No blob exists under an unsupported algorithm.
fn digest_of_blob(text: &str) -> Result<Digest, OciError> {
    if has_unsupported_algorithm(text) { Err(OciError::blob_unknown()) } else { parse_digest(text) }
}

/// True for a well-formed digest by an unsupported algorithm.
fn has_unsupported_algorithm(text: &str) -> bool {
    let is_supported =
        |algorithm: &str| Algorithm::ALL.iter().any(|known| known.as_str() == algorithm);
    lists::is_digest(text)
        && text.split_once(':').is_some_and(|(algorithm, _)| !is_supported(algorithm))
}

fn parse_reference(text: &str) -> Result<Reference, OciError> {
    if text.contains(':') {
        return parse_digest(text).map(Reference::Digest);
    }
    text.parse().map(Reference::Tag).map_err(|error| OciError::tag_invalid(&error))
}

/// Parses the request's query and ignores unknown parameters.
fn query<T: DeserializeOwned>(uri: &Uri) -> Result<T, OciError> {
    axum::extract::Query::try_from_uri(uri)
        .map(|axum::extract::Query(query)| query)
        .map_err(|_| OciError::query_invalid("the query is not valid"))
}

/// An answer without a body.
fn empty<const N: usize>(status: StatusCode, headers: [(&'static str, String); N]) -> Answer {
    let mut response = status.into_response();
    for (name, value) in headers {
        // All values consist of digests, ids, numbers and names, which are valid in headers.
        let value = HeaderValue::try_from(value).map_err(|_| {
            OciError::query_invalid("a name has characters that are invalid in a header")
        })?;
        response.headers_mut().insert(name, value);
    }
    Ok(response)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn repository_name_precedes_the_endpoint() {
        let cases = [
            ("a/blobs/sha256:0", Some(("a", Endpoint::Blob("sha256:0")))),
            ("a/b/c/manifests/latest", Some(("a/b/c", Endpoint::Manifest("latest")))),
            ("a/blobs/uploads/", Some(("a", Endpoint::Uploads))),
            ("a/blobs/uploads", Some(("a", Endpoint::Uploads))),
            ("a/blobs/uploads/7", Some(("a", Endpoint::Upload("7")))),
            ("blobs/blobs/blobs/x", Some(("blobs/blobs", Endpoint::Blob("x")))),
            ("a/tags/list", Some(("a", Endpoint::Tags))),
            ("a/referrers/sha256:0", Some(("a", Endpoint::Referrers("sha256:0")))),
            ("tags/list", None),
            ("_catalog", None),
            ("a", None),
        ];
        for (path, expected) in cases {
            assert_eq!(endpoint(path), expected, "{path}");
        }
    }
}
