//! Lists a repository's contents: its tags, and the manifests that refer to another.

use axum::Json;
use axum::response::IntoResponse as _;
use http::HeaderValue;
use http::header::{CONTENT_TYPE, LINK};
use http::request::Parts;
use serde::Deserialize;
use serde_json::json;
use task_proto::RepositoryName;
use task_proto::packages::oci::INDEX_TYPE;

use super::{Answer, OciError, Registry, parse_digest, query};

/// The most tags in one answer.
const MAX_TAGS: usize = 1000;

#[derive(Deserialize)]
struct TagsQuery {
    n: Option<usize>,
    last: Option<String>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct ReferrersQuery {
    artifact_type: Option<String>,
    last: Option<String>,
}

pub(super) async fn tags(
    registry: &Registry,
    repository: &RepositoryName,
    request: &Parts,
) -> Answer {
    let query: TagsQuery = query(&request.uri)?;
    let mut tags =
        registry.store.tags().list(repository).await?.ok_or_else(OciError::name_unknown)?;
    if let Some(last) = &query.last {
        tags.retain(|tag| tag.as_str() > last.as_str());
    }
    let limit = query.n.unwrap_or(MAX_TAGS).min(MAX_TAGS);
    let has_more = tags.len() > limit;
    tags.truncate(limit);
    let mut response = Json(json!({ "name": repository, "tags": tags })).into_response();
    if let Some(last) = tags.last().filter(|_| has_more) {
        let link = format!("</v2/{repository}/tags/list?n={limit}&last={last}>; rel=\"next\"");
        let link = HeaderValue::try_from(link).map_err(|_| OciError::name_unknown())?;
        response.headers_mut().insert(LINK, link);
    }
    Ok(response)
}

/// `GET /v2/<name>/referrers/<digest>`: an image index, empty without referrers.
pub(super) async fn referrers(
    registry: &Registry,
    repository: &RepositoryName,
    subject: &str,
    request: &Parts,
) -> Answer {
    if !is_digest(subject) {
        return Err(OciError::digest_invalid(format!("{subject:?} is not a digest")));
    }
    let query: ReferrersQuery = query(&request.uri)?;
    let kind = query.artifact_type.as_deref().filter(|kind| !kind.is_empty());
    if kind.is_some_and(|kind| kind.contains(char::is_control)) {
        return Err(OciError::query_invalid("artifactType: contains a control character"));
    }
    let after = query.last.as_deref().map(parse_digest).transpose()?;
    let page =
        registry.store.manifests().referrers(repository, subject, kind, after.as_ref()).await?;
    let index = json!({ "schemaVersion": 2, "mediaType": INDEX_TYPE, "manifests": page.manifests });
    let mut response = index.to_string().into_response();
    let headers = response.headers_mut();
    headers.insert(CONTENT_TYPE, HeaderValue::from_static(INDEX_TYPE));
    if kind.is_some() {
        headers.insert("oci-filters-applied", HeaderValue::from_static("artifactType"));
    }
    if let Some(last) = page.next {
        // The link to the next page: the same query, continued after the last entry.
        let original_query = request.uri.query().unwrap_or_default();
        let other_pairs =
            original_query.split('&').filter(|pair| !pair.is_empty() && !pair.starts_with("last="));
        let other_pairs: String = other_pairs.map(|pair| format!("{pair}&")).collect();
        let link = format!(
            "</v2/{repository}/referrers/{subject}?{other_pairs}last={last}>; rel=\"next\""
        );
        let link = HeaderValue::try_from(link).map_err(|_| {
            OciError::query_invalid("the query has characters that are invalid in a header")
        })?;
        headers.insert(LINK, link);
    }
    Ok(response)
}

/// True for any digest, of a known algorithm or not: a subject need not be in this registry.
pub(super) fn is_digest(text: &str) -> bool {
    text.split_once(':').is_some_and(|(algorithm, encoded)| {
        let is_word = |b: u8| {
            b.is_ascii_lowercase() || b.is_ascii_digit() || matches!(b, b'+' | b'.' | b'_' | b'-')
        };
        let is_encoded = |b: u8| b.is_ascii_alphanumeric() || matches!(b, b'=' | b'_' | b'-');
        !algorithm.is_empty()
            && algorithm.bytes().all(is_word)
            && encoded.len() >= 32
            && encoded.bytes().all(is_encoded)
    })
}
