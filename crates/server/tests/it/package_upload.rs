//! A directory uploaded by the page: packed as the command packs it, and any other content refused
//! without a trace.

use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::time::Duration;

use reqwest::{Method, StatusCode};
use task_package::pack;
use task_proto::api::{AuditPage, PackageFiles, PackageList, PackageView};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::time::timeout;

use crate::harness::{TestServer, refusal};
use crate::package_contents::directory;

/// How long an answer may take on a busy machine.
const PATIENCE: Duration = Duration::from_secs(120);
/// More than the system's buffers between two sockets hold.
const REFUSED_BYTES: usize = 64 << 20;

/// The directory as `tar` writes it, below `prefix`.
fn archive(dir: &Path, prefix: &str) -> Vec<u8> {
    let mut archive = tar::Builder::new(Vec::new());
    archive.follow_symlinks(false);
    archive.append_dir_all(prefix, dir).expect("archived");
    archive.into_inner().expect("archived")
}

/// An archive of one file.
fn lone(path: &str, mode: u32, content: &[u8]) -> Vec<u8> {
    let mut header = tar::Header::new_gnu();
    header.set_size(content.len() as u64);
    header.set_mode(mode);
    // Not by the builder, which would refuse the path that this test needs.
    header.as_gnu_mut().expect("GNU").name[..path.len()].copy_from_slice(path.as_bytes());
    header.set_cksum();
    let mut archive = tar::Builder::new(Vec::new());
    archive.append(&header, content).expect("archived");
    archive.into_inner().expect("archived")
}

impl TestServer {
    fn upload(&self, content_type: &str, body: Vec<u8>) -> reqwest::RequestBuilder {
        self.request(Method::POST, "/api/v1/packages")
            .header("content-type", content_type)
            .body(body)
    }

    fn is_clean(&self) -> bool {
        std::fs::read_dir(self.data().join("incoming")).expect("listed").next().is_none()
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn package_uploads_leave_the_disk_reserve_free() {
    let directory_of_server = tempfile::TempDir::new().expect("a directory");
    let server =
        TestServer::start_in(directory_of_server, |config| config.disk_reserve = Some(1 << 50))
            .await;
    let dir = directory("1.0.0", &[("main.sh", "true")]);
    let upload = server.upload("application/x-tar", archive(dir.path(), ""));
    assert_eq!(refusal(upload).await, (507, "disk_full".to_owned()));
    assert!(server.is_clean());
    let digest = task_proto::Digest::of(b"blob");
    let push = server
        .request(Method::POST, &format!("/v2/mapper/blobs/uploads/?digest={digest}"))
        .body("blob");
    let refused = push.send().await.expect("an answer");
    assert_eq!(refused.status(), StatusCode::INSUFFICIENT_STORAGE);
    let said = refused.text().await.expect("text");
    assert!(said.contains("reserved for the database") && said.contains("disk_reserve"), "{said}");
}

#[tokio::test(flavor = "multi_thread")]
async fn uploaded_directory_equals_the_pushed_package() {
    let server = TestServer::start().await;
    let dir = directory(
        "1.0.0",
        &[("main.sh", "true"), ("data/a", "a"), ("data/b.bag", "b"), (".taskdignore", "*.bag")],
    );
    std::fs::set_permissions(dir.path().join("main.sh"), PermissionsExt::from_mode(0o755))
        .expect("set");
    std::os::unix::fs::symlink("data/a", dir.path().join("link")).expect("linked");
    std::fs::hard_link(dir.path().join("data/a"), dir.path().join("second")).expect("linked");
    let packed = pack(dir.path()).expect("a package");
    let (bare, named) = (archive(dir.path(), ""), archive(dir.path(), "mapper"));
    let compressed = zstd::encode_all(&named[..], 3).expect("compressed");
    for (content_type, body) in [
        ("application/x-tar", bare),
        ("application/x-tar", named),
        ("application/zstd", compressed),
    ] {
        let response = server.upload(content_type, body).send().await.expect("an answer");
        let status = response.status();
        let text = response.text().await.expect("text");
        assert_eq!(status, StatusCode::CREATED, "{text}");
        let view: PackageView = serde_json::from_str(&text).expect("a package");
        assert_eq!((&view.package, &view.manifest), (&packed.package, &packed.manifest));
        assert!(server.is_clean());
    }
    let list: PackageList = server.get("/api/v1/packages").await;
    assert_eq!(list.packages.len(), 1);
    let files: PackageFiles = server.get("/api/v1/packages/mapper/1.0.0/files").await;
    let paths: Vec<&str> = files.files.iter().map(|file| file.path.as_str()).collect();
    assert_eq!(paths, ["data", "data/a", "link", "main.sh", "second", "task.toml"]);
    assert_eq!(files.files[3].mode, 0o755);
    // The package can be deployed, and the audit log names its uploader.
    server.enroll("atlas").await;
    server.deploy(&packed.package, "atlas", "one").await;
    let page: AuditPage = server.get("/api/v1/audit?act=manifest.push").await;
    assert_eq!(page.records.len(), 3);
    assert_eq!(page.records[0].read().expect("an entry").target, "mapper");
}

#[tokio::test(flavor = "multi_thread")]
async fn invalid_package_is_refused_and_leaves_nothing() {
    let server = TestServer::start_in(tempfile::TempDir::new().expect("a directory"), |config| {
        config.max_upload_bytes = 1 << 20;
    })
    .await;
    let no_command = directory("1.0.0", &[]);
    std::fs::write(no_command.path().join("task.toml"), "name = \"x\"\n").expect("written");
    let escaping = directory("1.0.0", &[("main.sh", "true")]);
    std::os::unix::fs::symlink("../../etc/passwd", escaping.path().join("link")).expect("linked");
    let whole = archive(directory("1.0.0", &[("main.sh", "true")]).path(), "");
    let mut followed = whole.clone();
    followed.extend(b"more");
    let zeros = vec![0; 4 << 20];
    let cases = [
        ("application/json", b"{}".to_vec(), 415, "unsupported_media_type"),
        ("application/x-tar", Vec::new(), 422, "archive_refused"),
        ("application/x-tar", b"hello".to_vec(), 422, "archive_refused"),
        ("application/zstd", whole.clone(), 422, "archive_refused"),
        ("application/x-tar", whole[..700].to_vec(), 422, "archive_refused"),
        ("application/x-tar", followed, 422, "archive_refused"),
        ("application/x-tar", lone("../outside", 0o644, b"x"), 422, "archive_refused"),
        ("application/x-tar", lone("/outside", 0o644, b"x"), 422, "archive_refused"),
        ("application/x-tar", lone("main.sh", 0o4755, b"x"), 422, "archive_refused"),
        ("application/x-tar", archive(escaping.path(), ""), 422, "archive_refused"),
        ("application/x-tar", archive(no_command.path(), ""), 422, "package_invalid"),
        ("application/x-tar", lone("zeros", 0o644, &zeros), 413, "too_large"),
        (
            "application/zstd",
            zstd::encode_all(&lone("zeros", 0o644, &zeros)[..], 3).expect("compressed"),
            413,
            "too_large",
        ),
    ];
    for (number, (content_type, body, status, code)) in cases.into_iter().enumerate() {
        let refused = refusal(server.upload(content_type, body)).await;
        assert_eq!(refused, (status, code.to_owned()), "case {number}");
        assert!(server.is_clean(), "case {number}");
    }
    let said: serde_json::Value = server
        .upload("application/x-tar", archive(no_command.path(), ""))
        .send()
        .await
        .expect("an answer")
        .json()
        .await
        .expect("json");
    let said = said["error"]["message"].as_str().expect("text");
    assert!(
        said.contains("task.toml: version: is missing") && !said.contains("incoming"),
        "{said}"
    );
    let list: PackageList = server.get("/api/v1/packages").await;
    assert!(list.packages.is_empty());
    assert!(!server.data().join("outside").exists() && !Path::new("/outside").exists());
}

/// Sends a request without a token, with `rest` after its head, and reads all that is answered.
async fn refused_bytes(server: &TestServer, header: &str, rest: &[u8]) -> String {
    let mut stream =
        TcpStream::connect(&server.server.addresses().http).await.expect("a connection");
    let head = format!(
        "POST /api/v1/packages HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\
         content-type: application/x-tar\r\ncontent-length: {REFUSED_BYTES}\r\n{header}\r\n"
    );
    stream.write_all(head.as_bytes()).await.expect("sent");
    stream.write_all(rest).await.expect("sent");
    let mut answer = String::new();
    let read = timeout(PATIENCE, stream.read_to_string(&mut answer)).await;
    read.expect("an answer in time").expect("an answer");
    answer
}

#[tokio::test(flavor = "multi_thread")]
async fn uploads_are_limited_and_disconnect_frees_the_slot() {
    let server = TestServer::start().await;
    let publishers = [
        server.sign_in_as("alice", "publisher").await,
        server.sign_in_as("bob", "publisher").await,
    ];
    let upload_by = |token: &str, body: reqwest::Body| {
        let request = server.bare(Method::POST, "/api/v1/packages").bearer_auth(token);
        request.header("content-type", "application/x-tar").body(body)
    };
    let upload = |body| upload_by(&server.operator.reveal(), body);
    let body = || {
        reqwest::Body::wrap_stream(
            futures_util::stream::pending::<Result<Vec<u8>, std::io::Error>>(),
        )
    };
    // A caller that finds the place taken by the request below asks again.
    let endless = async |token: &str| while refusal(upload_by(token, body())).await.0 == 429 {};
    let until = async |status: u16| while refusal(upload("hello".into())).await.0 != status {};
    let both = async { tokio::join!(endless(&publishers[0]), endless(&publishers[1])) };
    tokio::select! {
        _ = both => panic!("an upload without an end had one"),
        refused = timeout(PATIENCE, until(429)) => refused.expect("no third place"),
    }
    timeout(PATIENCE, until(422)).await.expect("places again");
}

#[tokio::test(flavor = "multi_thread")]
async fn archive_bomb_is_refused_before_it_is_unpacked() {
    let server = TestServer::start().await;
    let bomb =
        zstd::encode_all(&lone("zeros", 0o644, &vec![0; 65 << 20])[..], 3).expect("compressed");
    assert_eq!(
        refusal(server.upload("application/zstd", bomb)).await,
        (413, "too_large".to_owned())
    );
    assert!(server.is_clean());
}

#[tokio::test(flavor = "multi_thread")]
async fn refusal_reaches_a_client_that_sends_before_reading() {
    let server = TestServer::start().await;
    let answer = refused_bytes(&server, "", &vec![0; REFUSED_BYTES]).await;
    assert!(answer.starts_with("HTTP/1.1 401 "), "{answer}");
    // A client that asks first whether to send the body is told not to.
    let answer = refused_bytes(&server, "expect: 100-continue\r\n", &[]).await;
    assert!(answer.starts_with("HTTP/1.1 401 "), "{answer}");
}

#[tokio::test(flavor = "multi_thread")]
async fn upload_leftovers_are_removed_at_restart() {
    let server = TestServer::start().await;
    let left = server.data().join("incoming/left/package");
    std::fs::create_dir_all(&left).expect("made");
    let server = server.restart().await;
    assert!(!left.exists() && server.is_clean());
}
