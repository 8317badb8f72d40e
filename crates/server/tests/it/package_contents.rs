//! The API's view of packages: versions, contents, differences, the robots that run them; and that
//! no package is deleted which a robot should have.

use std::path::Path;

use reqwest::{Method, StatusCode};
use serde_json::json;
use task_package::{Packed, pack};
use task_proto::api::{
    AccessToken, PackageDiff, PackageFile, PackageFileKind, PackageFiles, PackageList,
    PackageVersions,
};
use task_proto::desired::PackageRef;
use task_proto::packages::oci::MANIFEST_TYPE;

use crate::harness::{TestServer, answer, refusal};
use crate::people::PASSWORD;

/// A package's directory with these files beside its task.toml.
pub fn directory(version: &str, files: &[(&str, &str)]) -> tempfile::TempDir {
    let dir = tempfile::tempdir().expect("a directory");
    let task = format!(
        "name = \"mapper\"\nversion = \"{version}\"\n[run]\nexec = [\"sh\", \"main.sh\"]\n"
    );
    for (path, content) in [("task.toml", task.as_str())].iter().chain(files) {
        let path = dir.path().join(path);
        std::fs::create_dir_all(path.parent().expect("below")).expect("made");
        std::fs::write(path, content).expect("written");
    }
    dir
}

impl TestServer {
    /// Packs a directory and pushes it over the registry, as the command does.
    pub async fn push_directory(&self, dir: &Path) -> Packed {
        let packed = pack(dir).expect("a package");
        let content = std::fs::read(packed.content.path()).expect("read");
        let package = &packed.package;
        for (blob, bytes) in
            [(package.config, packed.config_bytes.clone()), (package.content, content)]
        {
            let path = format!("/v2/{}/blobs/uploads/?digest={}", package.name, blob.digest);
            let request = self
                .request(Method::POST, &path)
                .header("content-type", "application/octet-stream");
            assert_eq!(
                request.body(bytes).send().await.expect("an answer").status(),
                StatusCode::CREATED
            );
        }
        let request = self
            .request(Method::PUT, &format!("/v2/{}/manifests/{}", package.name, package.version));
        let request =
            request.header("content-type", MANIFEST_TYPE).body(packed.manifest_bytes.clone());
        assert_eq!(request.send().await.expect("an answer").status(), StatusCode::CREATED);
        packed
    }

    async fn two_versions(&self) -> [PackageRef; 2] {
        let old = directory("1.0.0", &[("main.sh", "true"), ("maps/a.pgm", "a"), ("gone", "")]);
        let new =
            directory("2.0.0", &[("main.sh", "false"), ("maps/a.pgm", "a"), ("maps/b.pgm", "b")]);
        [
            self.push_directory(old.path()).await.package,
            self.push_directory(new.path()).await.package,
        ]
    }
}

fn paths(files: &[PackageFile]) -> Vec<&str> {
    files.iter().map(|file| file.path.as_str()).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn package_shows_its_versions_files_and_differences() {
    let server = TestServer::start().await;
    let [old, new] = server.two_versions().await;
    server.enroll("atlas").await;
    server.enroll("boreas").await;
    server.deploy(&old, "*", "one").await;
    server.deploy(&new, "atlas", "two").await;
    let package: PackageVersions = server.get("/api/v1/packages/mapper").await;
    assert_eq!(package.versions.len(), 2);
    let mut running: Vec<_> =
        package.running.iter().map(|used| (used.manifest, used.robots)).collect();
    running.sort();
    let mut expected = vec![(old.manifest.digest, 1), (new.manifest.digest, 1)];
    expected.sort();
    assert_eq!(running, expected);

    let files: PackageFiles = server.get("/api/v1/packages/mapper/1.0.0/files").await;
    assert_eq!(paths(&files.files), ["gone", "main.sh", "maps", "maps/a.pgm", "task.toml"]);
    let main = &files.files[1];
    assert_eq!(
        (main.kind, main.size, main.digest),
        (PackageFileKind::File, 4, Some(task_proto::Digest::of(b"true")))
    );
    let same: PackageFiles =
        server.get(&format!("/api/v1/packages/mapper/{}/files", old.manifest.digest)).await;
    assert_eq!(same, files);

    let diff: PackageDiff = server.get("/api/v1/packages/mapper/diff?from=1.0.0&to=2.0.0").await;
    assert_eq!((paths(&diff.added), paths(&diff.removed)), (vec!["maps/b.pgm"], vec!["gone"]));
    let changed: Vec<_> = diff.changed.iter().map(|changed| changed.path.as_str()).collect();
    assert_eq!((changed, diff.manifest_changed), (vec!["main.sh", "task.toml"], false));
    let back = format!(
        "/api/v1/packages/mapper/diff?from={}&to={}",
        new.manifest.digest, old.manifest.digest
    );
    let back: PackageDiff = server.get(&back).await;
    assert_eq!((back.added, back.removed), (diff.removed, diff.added));
    let none: PackageDiff = server.get("/api/v1/packages/mapper/diff?from=1.0.0&to=1.0.0").await;
    assert_eq!(none, PackageDiff::default());

    for (path, expected) in [
        ("walker", (404, "not_found")),
        ("walker/1.0.0/files", (404, "package_not_found")),
        ("mapper/3.0.0/files", (404, "package_not_found")),
        ("mapper/no%20version/files", (404, "not_found")),
        ("mapper/diff?from=1.0.0", (400, "invalid_request")),
        ("mapper/diff?from=1.0.0&to=a:b", (400, "invalid_request")),
        ("mapper/diff?from=1.0.0&to=3.0.0", (404, "package_not_found")),
    ] {
        let (status, code) =
            refusal(server.request(Method::GET, &format!("/api/v1/packages/{path}"))).await;
        assert_eq!((status, code.as_str()), expected, "{path}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn package_in_use_is_not_deleted() {
    let server = TestServer::start().await;
    let [old, new] = server.two_versions().await;
    for name in ["atlas", "boreas"] {
        server.enroll(name).await;
    }
    let one = server.deploy(&old, "*", "one").await;
    let delete = |version: &str| {
        server.request(Method::DELETE, &format!("/api/v1/packages/mapper/{version}"))
    };
    let refused = delete("1.0.0").send().await.expect("an answer");
    assert_eq!(refused.status(), StatusCode::CONFLICT);
    let body: serde_json::Value = refused.json().await.expect("json");
    assert_eq!(body["error"]["code"], "package_in_use");
    let said = body["error"]["message"].as_str().expect("text");
    assert!(
        said.starts_with(
            "mapper 1.0.0 is in use by 2 robots: atlas, boreas, through 1 deployments: d"
        ),
        "{said}"
    );

    // A user limited to some robots is told of those robots, and of packages for them.
    let other = server.deploy(&old, "atlas", "other").await;
    let user =
        json!({ "name": "pia", "roles": ["publisher"], "scope": "boreas", "password": PASSWORD });
    let _: serde_json::Value = server.post("/api/v1/users", &user).await;
    let login = server
        .bare(Method::POST, "/api/v1/login")
        .json(&json!({ "user": "pia", "password": PASSWORD }));
    let pia: AccessToken = answer(login).await;
    let hers = server.bare(Method::DELETE, "/api/v1/packages/mapper/1.0.0").bearer_auth(&pia.token);
    let said = hers.send().await.expect("an answer").text().await.expect("text");
    assert!(said.contains("2 robots: boreas, …,") && !said.contains("atlas"), "{said}");
    assert!(
        said.contains(&format!("through 2 deployments: {}, …;", one.id))
            && !said.contains(other.id.as_str()),
        "{said}"
    );
    let package = server.bare(Method::GET, "/api/v1/packages/mapper").bearer_auth(&pia.token);
    let package: PackageVersions = answer(package).await;
    assert_eq!(package.running[0].robots, 1);

    server.deploy(&new, "*", "two").await;
    assert_eq!(delete("1.0.0").send().await.expect("an answer").status(), StatusCode::NO_CONTENT);
    assert_eq!(refusal(delete("1.0.0")).await, (404, "package_not_found".to_owned()));
    let by_digest = delete(&new.manifest.digest.to_string());
    assert_eq!(refusal(by_digest).await, (409, "package_in_use".to_owned()));
    let left: PackageList = server.get("/api/v1/packages").await;
    assert_eq!(
        left.packages.iter().map(|view| view.package.version.as_str()).collect::<Vec<_>>(),
        ["2.0.0"]
    );
}
