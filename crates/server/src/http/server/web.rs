//! The page: the files of `ui/`, embedded in the binary at build time. The handlers never read the
//! disk, so no path can lead outside these files. Authorization happens in the API.

use axum::response::{IntoResponse, Response};
use http::{HeaderMap, StatusCode, header};
use rust_embed::{Embed, EmbeddedFile};
use task_macros::operation;
use task_proto::Digest;

use crate::http::error::ApiError;
use crate::http::extract::PathParam;

#[derive(Embed)]
#[folder = "ui/"]
struct Files;

/// The browser revalidates on each use and gets 304 for unchanged files, so a new server brings a
/// new page at once.
const REVALIDATED: &str = "no-cache";
/// Paths below `vendor/` contain the version, so their content never changes.
const IMMUTABLE: &str = "public, max-age=31536000, immutable";

/// The page loads nothing from other origins and runs no code but these files.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; font-src 'self'; \
     connect-src 'self'; worker-src 'self'; manifest-src 'self'; base-uri 'none'; form-action 'none'; \
     frame-ancestors 'none'";

/// Returns the page. The page holds no data; data needs a session.
#[operation(tag = "server",
    responses((status = 200, description = "The page.", body = String, content_type = "text/html"),
        (status = 304, description = "Not modified: `If-None-Match` names the current version.")))]
pub async fn index(headers: HeaderMap) -> Result<Response, ApiError> {
    serve("index.html", &headers)
}

/// Returns the interactive API documentation.
#[operation(tag = "server",
    responses((status = 200, description = "The page.", body = String, content_type = "text/html"),
        (status = 304, description = "Not modified: `If-None-Match` names the current version.")))]
pub async fn docs(headers: HeaderMap) -> Result<Response, ApiError> {
    serve("docs/docs.html", &headers)
}

/// Returns a file of the page.
#[operation(tag = "server",
    params(("file" = String, Path, description = "The file's path, which may contain slashes.")),
    responses((status = 200, description = "The file.", body = String, content_type = "text/plain"),
        (status = 304, description = "Not modified: `If-None-Match` names the current version.")))]
pub async fn file(
    PathParam(path): PathParam<String>,
    headers: HeaderMap,
) -> Result<Response, ApiError> {
    serve(&path, &headers)
}

fn serve(path: &str, headers: &HeaderMap) -> Result<Response, ApiError> {
    let file = Files::get(path).ok_or_else(|| ApiError::not_found("the page has no such file"))?;
    let tag = tag(&file);
    let caching = if path.starts_with("vendor/") { IMMUTABLE } else { REVALIDATED };
    let caching = [(header::ETAG, tag.clone()), (header::CACHE_CONTROL, caching.to_owned())];
    let policy = [(header::CONTENT_SECURITY_POLICY, POLICY)];
    if has_current_tag(headers, &tag) {
        return Ok((StatusCode::NOT_MODIFIED, caching, policy).into_response());
    }
    Ok((caching, policy, [(header::CONTENT_TYPE, content_type(path))], file.data.into_owned())
        .into_response())
}

fn tag(file: &EmbeddedFile) -> String {
    format!("\"{}\"", Digest::from_sha256(file.metadata.sha256_hash()).hex())
}

/// True if the caller has the file already: one of its tags matches, compared weakly as RFC 9110
/// requires.
pub fn has_current_tag(headers: &HeaderMap, tag: &str) -> bool {
    let given =
        headers.get_all(header::IF_NONE_MATCH).iter().filter_map(|value| value.to_str().ok());
    given
        .flat_map(|tags| tags.split(','))
        .map(str::trim)
        .any(|one| one == "*" || one.trim_start_matches("W/") == tag)
}

fn content_type(path: &str) -> &'static str {
    match path.rsplit_once('.').map(|(_, extension)| extension) {
        Some("html") => "text/html; charset=utf-8",
        Some("js") => "text/javascript; charset=utf-8",
        Some("css") => "text/css; charset=utf-8",
        Some("svg") => "image/svg+xml",
        _ => "text/plain; charset=utf-8",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn text(response: &Response, name: header::HeaderName) -> &str {
        response.headers()[name].to_str().expect("text")
    }

    #[test]
    fn files_are_served_with_their_type_and_revalidated() {
        let page = serve("index.html", &HeaderMap::new()).expect("there");
        assert_eq!(text(&page, header::CONTENT_TYPE), "text/html; charset=utf-8");
        assert_eq!(text(&page, header::CACHE_CONTROL), "no-cache");
        let tag = text(&page, header::ETAG);
        for known in [tag.to_owned(), format!("\"other\", W/{tag}"), "*".to_owned()] {
            let headers =
                HeaderMap::from_iter([(header::IF_NONE_MATCH, known.parse().expect("a header"))]);
            assert_eq!(
                serve("index.html", &headers).expect("there").status(),
                StatusCode::NOT_MODIFIED,
                "{known}"
            );
        }
        let headers =
            HeaderMap::from_iter([(header::IF_NONE_MATCH, "\"other\"".parse().expect("a header"))]);
        assert_eq!(serve("index.html", &headers).expect("there").status(), StatusCode::OK);
    }

    #[test]
    fn vendored_files_never_change() {
        let vendored = Files::iter().find(|path| path.ends_with("/lit-html.js")).expect("vendored");
        let script = serve(&vendored, &HeaderMap::new()).expect("there");
        assert_eq!(text(&script, header::CACHE_CONTROL), IMMUTABLE);
        assert_eq!(text(&script, header::CONTENT_TYPE), "text/javascript; charset=utf-8");
    }

    #[test]
    fn paths_outside_the_page_are_not_found() {
        for path in [
            "",
            "/",
            ".",
            "..",
            "../Cargo.toml",
            "vendor/../index.html",
            "/etc/passwd",
            "index.html/",
            "vendor",
        ] {
            let refused = serve(path, &HeaderMap::new()).expect_err(path);
            assert_eq!(refused.status, StatusCode::NOT_FOUND, "{path}");
        }
    }

    #[test]
    fn page_uses_no_other_host_and_no_inline_code() {
        for path in Files::iter().filter(|path| !path.starts_with("vendor/")) {
            let file = Files::get(&path).expect("there");
            let text = std::str::from_utf8(&file.data)
                .expect("text")
                .replace("http://www.w3.org/2000/svg", "");
            for bad in
                ["https://", "http://", "style=\"", "onclick=", "unsafeHTML", "innerHTML", "eval("]
            {
                assert!(!text.contains(bad), "{path} contains {bad}");
            }
        }
    }
}
