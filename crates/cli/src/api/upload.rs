//! Uploads a package's blobs and manifest to the server's OCI store. Blobs that the server has are
//! not sent again, and a blob streams from its file.

use std::path::Path;

use futures_util::TryStreamExt as _;
use reqwest::header::{CONTENT_LENGTH, CONTENT_TYPE, LOCATION};
use reqwest::{Body, Method, Response, StatusCode};
use task_package::Packed;
use task_proto::desired::{BlobRef, PackageRef};
use task_proto::packages::oci::{EMPTY, ImageManifest, MANIFEST_TYPE};
use task_proto::size::format_bytes;
use task_proto::trust::envelope::Envelope;
use task_proto::{Digest, RepositoryName};
use tokio_util::io::ReaderStream;

use super::client::{Client, ClientError};
use crate::CommandError;
use crate::display::output::say;
use crate::display::progress;

/// How often a blob's upload is tried.
const MAX_UPLOAD_TRIES: u32 = 4;
/// Time limit for the answer to a manifest: the server reads a package's whole archive first.
const MANIFEST_TIMEOUT: std::time::Duration = std::time::Duration::from_secs(11 * 60);
/// An upload slower than this is given up.
const MIN_BYTES_PER_SECOND: u64 = 16 * 1024;
/// Bytes read from the file at a time.
const CHUNK_BYTES: usize = 256 * 1024;

/// A blob's bytes, in memory or in a file.
enum Source<'a> {
    Bytes(&'a [u8]),
    File(&'a Path),
}

/// The parts of a package to upload.
pub(crate) struct Upload<'a> {
    pub(crate) package: &'a PackageRef,
    pub(crate) config: &'a [u8],
    pub(crate) manifest: &'a [u8],
    /// Absent: the server has the content.
    pub(crate) content: Option<&'a Path>,
    /// Whether the version becomes a tag of this package; otherwise the package is known only by
    /// its digest.
    pub(crate) tagged: bool,
    /// Whether the upload may take the version from a package with other content.
    pub(crate) force: bool,
}

impl<'a> Upload<'a> {
    /// A directory's package, under its version or by its digest alone.
    pub(crate) fn of(packed: &'a Packed, tagged: bool) -> Self {
        let (config, manifest) = (&packed.config_bytes, &packed.manifest_bytes);
        Self {
            package: &packed.package,
            config,
            manifest,
            content: Some(packed.content.path()),
            tagged,
            force: false,
        }
    }
}

/// Uploads the missing parts, and reports the number of bytes sent.
pub(crate) async fn upload(client: &Client, upload: &Upload<'_>) -> Result<(), CommandError> {
    let package = upload.package;
    let name = package.name.as_str();
    check_version(client, upload).await?;
    let mut sent = 0;
    let content = upload.content.map(|path| (package.content, Source::File(path)));
    for (blob, source) in
        [Some((package.config, Source::Bytes(upload.config))), content].into_iter().flatten()
    {
        if !exists(client, &format!("/v2/{name}/blobs/{}", blob.digest)).await? {
            upload_blob(client, name, blob, &source).await?;
            sent += 1;
        }
    }
    put_manifest(client, upload).await?;
    match sent {
        0 => say(&format!(
            "{} {}: already on the server, nothing to upload",
            package.name, package.version
        )),
        _ => say(&format!(
            "{} {}: {sent} blobs uploaded ({})",
            package.name,
            package.version,
            format_bytes(package.content.size)
        )),
    }
    Ok(())
}

/// Uploads a signed document, about `subject` or on its own. The upload is idempotent.
pub(crate) async fn upload_signed(
    client: &Client,
    repository: &RepositoryName,
    artifact_type: &str,
    envelope: &Envelope,
    (subject, tag): (Option<BlobRef>, Option<String>),
) -> Result<(), CommandError> {
    let bytes = serde_json::to_vec(envelope).expect("an envelope always has a JSON form");
    let blob = BlobRef::of(&bytes);
    for (blob, bytes) in [(BlobRef::of(EMPTY), EMPTY), (blob, &bytes)] {
        if !exists(client, &format!("/v2/{repository}/blobs/{}", blob.digest)).await? {
            upload_blob(client, repository.as_str(), blob, &Source::Bytes(bytes)).await?;
        }
    }
    let manifest = ImageManifest::signed_document(artifact_type, blob, subject);
    let manifest = serde_json::to_vec(&manifest).expect("a manifest always has a JSON form");
    let reference = tag.unwrap_or_else(|| Digest::of(&manifest).to_string());
    let path = format!("/v2/{repository}/manifests/{reference}");
    client
        .send(|| {
            let request = client.request(Method::PUT, &path).timeout(MANIFEST_TIMEOUT);
            request.header(CONTENT_TYPE, MANIFEST_TYPE).body(manifest.clone())
        })
        .await?;
    Ok(())
}

async fn exists(client: &Client, path: &str) -> Result<bool, ClientError> {
    match client.send(|| client.request(Method::HEAD, path)).await {
        Ok(_) => Ok(true),
        Err(error) if status_of(&error) == Some(StatusCode::NOT_FOUND) => Ok(false),
        Err(error) => Err(error),
    }
}

/// The status of an answer without a readable body, as a HEAD has.
fn status_of(error: &ClientError) -> Option<StatusCode> {
    match error {
        ClientError::Refused { status, .. } | ClientError::NotTaskd { status, .. } => Some(*status),
        _ => None,
    }
}

async fn upload_blob(
    client: &Client,
    name: &str,
    blob: BlobRef,
    source: &Source<'_>,
) -> Result<(), CommandError> {
    let mut tried = 0;
    loop {
        tried += 1;
        // Each try is a separate upload: the server collects the remains of a broken one, and
        // forgets all uploads when it restarts.
        let session = client
            .send(|| client.request(Method::POST, &format!("/v2/{name}/blobs/uploads/")))
            .await?;
        let target = target(client, &session, blob)?;
        let request = client
            .request(Method::PUT, &target)
            .timeout(std::time::Duration::from_secs(60 + blob.size / MIN_BYTES_PER_SECOND))
            .header(CONTENT_TYPE, "application/octet-stream")
            .header(CONTENT_LENGTH, blob.size)
            .body(body(source, blob.size).await?);
        let error = match request.send().await {
            Ok(response) if response.status().is_success() => return Ok(()),
            Ok(response) => {
                let status = response.status();
                let error = client.refusal(response).await;
                if is_final(status) {
                    return Err(error.into());
                }
                error
            }
            Err(source) => client.unreachable(source),
        };
        // Perhaps only the answer was lost.
        if exists(client, &format!("/v2/{name}/blobs/{}", blob.digest)).await? {
            return Ok(());
        }
        if tried >= MAX_UPLOAD_TRIES {
            return Err(error.into());
        }
    }
}

/// Whether another upload of the same bytes would be refused as well.
fn is_final(status: StatusCode) -> bool {
    matches!(
        status,
        StatusCode::UNAUTHORIZED
            | StatusCode::FORBIDDEN
            | StatusCode::PAYLOAD_TOO_LARGE
            | StatusCode::INSUFFICIENT_STORAGE
    )
}

/// The URL for the upload's bytes: the server's `Location`, relative or absolute, with the digest
/// added.
fn target(client: &Client, session: &Response, blob: BlobRef) -> Result<String, ClientError> {
    let location = session.headers().get(LOCATION).and_then(|value| value.to_str().ok());
    let location = location
        .and_then(|location| session.url().join(location).ok())
        // The token is sent to its own server only.
        .filter(|url| url.origin() == session.url().origin());
    let mut url = location.ok_or_else(|| client.not_taskd(session.status()))?;
    url.query_pairs_mut().append_pair("digest", &blob.digest.to_string());
    Ok(url.into())
}

async fn body(source: &Source<'_>, size: u64) -> Result<Body, CommandError> {
    match source {
        Source::Bytes(bytes) => Ok(Body::from(bytes.to_vec())),
        Source::File(path) => {
            let file = tokio::fs::File::open(path).await.map_err(|source| CommandError::Io {
                what: "can't read the packed content".to_owned(),
                source,
            })?;
            let bar = progress::upload_bar(size);
            let chunks = ReaderStream::with_capacity(file, CHUNK_BYTES);
            Ok(Body::wrap_stream(chunks.inspect_ok(move |chunk| bar.inc(chunk.len() as u64))))
        }
    }
}

/// Refuses a version that exists with other content before any upload; the server's own check
/// decides in the end.
async fn check_version(client: &Client, upload: &Upload<'_>) -> Result<(), CommandError> {
    let package = upload.package;
    if !upload.tagged {
        return Ok(());
    }
    let path = format!("/v2/{}/manifests/{}", package.name, package.version);
    let known = match client.send(|| client.request(Method::HEAD, &path)).await {
        Ok(response) => digest_of(&response),
        Err(error) if status_of(&error) == Some(StatusCode::NOT_FOUND) => None,
        Err(error) => return Err(error.into()),
    };
    match known.filter(|known| *known != package.manifest.digest.to_string()) {
        None => Ok(()),
        Some(other) if upload.force => {
            say(&format!("{} {} replaces {other}", package.name, package.version));
            Ok(())
        }
        Some(other) => Err(CommandError::Usage(format!(
            "{name} {version} already exists on the server with other content ({other}, not {new}); raise the version in \
             task.toml or package.xml, or replace it with --force: robots that have it are then marked as outdated",
            name = package.name,
            version = package.version,
            new = package.manifest.digest
        ))),
    }
}

fn digest_of(response: &Response) -> Option<String> {
    response
        .headers()
        .get("docker-content-digest")
        .and_then(|value| value.to_str().ok())
        .map(ToOwned::to_owned)
}

/// Puts the manifest, unless the server has it: under its version as the tag, or under its digest.
async fn put_manifest(client: &Client, upload: &Upload<'_>) -> Result<(), CommandError> {
    let Upload { package, manifest, tagged, force, .. } = upload;
    let reference =
        if *tagged { package.version.to_string() } else { package.manifest.digest.to_string() };
    let path = format!("/v2/{}/manifests/{reference}", package.name);
    match client.send(|| client.request(Method::HEAD, &path)).await {
        Ok(response) if digest_of(&response) == Some(package.manifest.digest.to_string()) => {
            return Ok(());
        }
        Ok(_) => {}
        Err(error) if status_of(&error) == Some(StatusCode::NOT_FOUND) => {}
        Err(error) => return Err(error.into()),
    }
    let path = if *force { format!("{path}?force=true") } else { path };
    let put = || {
        client
            .request(Method::PUT, &path)
            .header(CONTENT_TYPE, MANIFEST_TYPE)
            .body(manifest.to_vec())
    };
    client.send(put).await?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicU32, Ordering};

    use axum::Router;
    use axum::routing::{head, post, put};
    use task_proto::trust::token::{Token, TokenKind};

    use super::*;
    use crate::Connection;
    use crate::display::output::Format;

    /// A server that forgets the first upload, as after a restart, and refuses all uploads of the
    /// package `refused`.
    async fn forgetful_server(puts: Arc<AtomicU32>) -> std::net::SocketAddr {
        let begin = |axum::extract::Path(name): axum::extract::Path<String>| async move {
            (StatusCode::ACCEPTED, [(LOCATION, format!("/upload/{name}"))])
        };
        let finish = move |axum::extract::Path(name): axum::extract::Path<String>| async move {
            match (puts.fetch_add(1, Ordering::SeqCst), name.as_str()) {
                (_, "refused") => StatusCode::INSUFFICIENT_STORAGE,
                (0, _) => StatusCode::NOT_FOUND,
                _ => StatusCode::CREATED,
            }
        };
        let router = Router::new()
            .route("/v2/{name}/blobs/uploads/", post(begin))
            .route("/v2/{name}/blobs/{digest}", head(|| async { StatusCode::NOT_FOUND }))
            .route("/upload/{name}", put(finish));
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        tokio::spawn(async move { axum::serve(listener, router).await });
        address
    }

    #[tokio::test]
    async fn forgotten_upload_is_retried_and_a_refused_one_is_not() {
        let puts = Arc::new(AtomicU32::new(0));
        let address = forgetful_server(puts.clone()).await;
        let connection = Connection {
            server: Some(format!("http://{address}")),
            token: Some(Token::random(TokenKind::Operator).reveal()),
            pin: None,
            token_file: None,
            data: None,
            output: Format::Json,
        };
        let client = Client::connect(&connection).unwrap();
        let blob = BlobRef { digest: Digest::of(b"content"), size: 7 };
        let source = Source::Bytes(b"content");
        upload_blob(&client, "talker", blob, &source).await.unwrap();
        assert_eq!(puts.load(Ordering::SeqCst), 2);
        assert!(upload_blob(&client, "refused", blob, &source).await.is_err());
        assert_eq!(puts.load(Ordering::SeqCst), 3);
    }
}
