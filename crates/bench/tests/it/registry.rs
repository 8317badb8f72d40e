//! Independent OCI clients: the `oci-client` crate and `crane` push to the package store and pull
//! from the store.
#![expect(clippy::disallowed_methods, reason = "a test starts processes")]

use std::path::Path;

use oci_client::client::{ClientConfig, ClientProtocol, Config, ImageLayer};
use oci_client::manifest::OciImageManifest;
use oci_client::secrets::RegistryAuth;
use oci_client::{Client, Reference};

use crate::harness::{Server, required, write_package};

#[tokio::test(flavor = "multi_thread")]
async fn oci_client_crate_pushes_and_pulls() {
    let dir = tempfile::tempdir().expect("temp dir");
    let server = Server::start(&dir.path().join("server")).await;
    let client =
        Client::new(ClientConfig { protocol: ClientProtocol::Http, ..ClientConfig::default() });
    let auth = RegistryAuth::Basic("anyone".to_owned(), server.operator_token());
    let image: Reference =
        format!("{}/foreign/artifact:1", server.http).parse().expect("reference");
    let bytes: Vec<u8> = (0..3_000_000).map(|_| rand::random()).collect();
    let layer = ImageLayer::new(bytes.clone(), "application/octet-stream".to_owned(), None);
    let config =
        Config::new(b"{}".to_vec(), "application/vnd.example.config.v1+json".to_owned(), None);
    let manifest = OciImageManifest::build(std::slice::from_ref(&layer), &config, None);
    client.push(&image, &[layer], config, &auth, Some(manifest)).await.expect("pushed");

    let pulled =
        client.pull(&image, &auth, vec!["application/octet-stream"]).await.expect("pulled");
    assert_eq!(pulled.layers[0].data, bytes);
    let stranger = RegistryAuth::Basic("anyone".to_owned(), "wrong".to_owned());
    let fresh =
        Client::new(ClientConfig { protocol: ClientProtocol::Http, ..ClientConfig::default() });
    assert!(fresh.pull(&image, &stranger, vec!["application/octet-stream"]).await.is_err());
}

async fn crane(home: &Path, args: &[&str]) -> String {
    let output = tokio::process::Command::new(required("TASKD_TEST_CRANE"))
        .args(args)
        .env("HOME", home)
        .output();
    let output = output.await.expect("crane runs");
    assert!(output.status.success(), "crane {args:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).expect("utf-8")
}

#[tokio::test(flavor = "multi_thread")]
async fn crane_logs_in_pushes_and_pulls() {
    let dir = tempfile::tempdir().expect("temp dir");
    let server = Server::start(&dir.path().join("server")).await;
    let home = dir.path();
    let host = server.http.to_string();
    crane(home, &["auth", "login", &host, "-u", "anyone", "-p", &server.operator_token()]).await;

    let content = dir.path().join("content.tar");
    let mut archive = tar::Builder::new(std::fs::File::create(&content).expect("file"));
    archive
        .append_path_with_name(file!().rsplit('/').next().map(source).expect("name"), "registry.rs")
        .expect("appended");
    archive.finish().expect("archive");
    let image = format!("{host}/some/thing:v1");
    crane(home, &["append", "--insecure", "-f", content.to_str().expect("utf-8"), "-t", &image])
        .await;
    assert_eq!(
        crane(home, &["ls", "--insecure", &format!("{host}/some/thing")]).await.trim(),
        "v1"
    );
    let digest = crane(home, &["digest", "--insecure", &image]).await;
    let copy = format!("{host}/other/thing:v1");
    crane(home, &["copy", "--insecure", &image, &copy]).await;
    assert_eq!(crane(home, &["digest", "--insecure", &copy]).await, digest);
    let exported = dir.path().join("exported.tar");
    crane(home, &["export", "--insecure", &copy, exported.to_str().expect("utf-8")]).await;
    let mut archive = tar::Archive::new(std::fs::File::open(&exported).expect("exported"));
    let names: Vec<_> = archive
        .entries()
        .expect("entries")
        .map(|e| e.expect("entry").path().expect("path").into_owned())
        .collect();
    assert_eq!(names, [Path::new("registry.rs")]);

    // taskd's own packages are ordinary artifacts to crane.
    let plain = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/plain");
    server.operate(["push", plain.to_str().expect("utf-8")]).await;
    let manifest = crane(home, &["manifest", "--insecure", &format!("{host}/plain:1.0.0")]).await;
    assert!(manifest.contains("application/vnd.taskd.package.v1"), "{manifest}");
}

fn source(name: &str) -> std::path::PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/it").join(name)
}

#[tokio::test(flavor = "multi_thread")]
async fn crane_copies_a_package_under_another_name() {
    let dir = tempfile::tempdir().expect("temp dir");
    let server = Server::start(&dir.path().join("server")).await;
    let package = dir.path().join("talker");
    write_package(&package, "talker", "1.0.0", "service", "exec sleep 1000\n");
    server.operate(["push", package.to_str().expect("UTF-8")]).await;
    let host = server.http.to_string();
    let token = server.operator_token();
    crane(dir.path(), &["auth", "login", &host, "-u", "anyone", "-p", &token]).await;
    let own = format!("{host}/talker:1.0.0");
    let mirror = format!("{host}/mirror/team/talker:1.0.0");
    crane(dir.path(), &["copy", "--insecure", &own, &mirror]).await;
    let digest = crane(dir.path(), &["digest", "--insecure", &own]).await;
    assert_eq!(crane(dir.path(), &["digest", "--insecure", &mirror]).await, digest);
    let packages = server.get("/api/v1/packages").await.expect("a list");
    let packages = packages["packages"].as_array().expect("packages");
    assert_eq!(packages.len(), 1, "{packages:?}");
    // And back, after its own was deleted.
    server.operate(["package", "rm", "talker:1.0.0", "--yes"]).await;
    crane(dir.path(), &["copy", "--insecure", &mirror, &own]).await;
    assert_eq!(crane(dir.path(), &["digest", "--insecure", &own]).await, digest);
}
