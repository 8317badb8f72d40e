//! Packages in the registry: validation, read permissions, and garbage collection.

use std::time::Duration;

use futures_util::FutureExt as _;
use reqwest::{Method, StatusCode};
use serde_json::{Value, json};
use task_proto::ids::digest::Algorithm;
use task_proto::messages::report::Phase;
use task_proto::packages::oci::{EMPTY, ImageManifest, MANIFEST_TYPE};
use task_proto::packages::publisher::{PackageStatement, SIGNATURE_ARTIFACT};
use task_proto::people::roles::{Role, Roles};
use task_proto::trust::envelope::SigningKey;
use task_proto::{Digest, RepositoryName, RobotId};
use taskd::blobs::BlobSettings;
use taskd::blobs::collector::{self, Collected};
use taskd::domain::person::Person;
use taskd::http::auth::Caller;
use taskd::store::{NewManifest, PutManifest, StoredManifest};

use crate::database::{TestDatabase, on_both_databases};
use crate::fleet::{Fleet, order_of, random_key};
use crate::harness::{archive_facts, archive_with};
use crate::registry::{GRACE, NOW_MS, TestRegistry, image, operator, refusal, refused, serve};

const YEAR_MS: u64 = 365 * 24 * 3_600_000;

fn task(name: &str) -> Value {
    json!({
        "name": name, "version": "1.0.0", "run": { "exec": ["true"] },
        "content": archive_facts(),
    })
}

#[tokio::test]
async fn task_package_is_checked_and_listed() {
    let registry = TestRegistry::start().await;
    let content = registry.push_blob("talker", &archive_with(b"content")).await;
    let mut no_command = task("talker");
    no_command["run"] = json!({});
    for (config, reason) in
        [(no_command, "run: give either"), (json!({ "name": "talker" }), "missing field")]
    {
        let config = registry.push_blob("talker", config.to_string().as_bytes()).await;
        let package = ImageManifest::package(config, content);
        let answer =
            registry.put_manifest("/v2/talker/manifests/1.0.0", MANIFEST_TYPE, &package).await;
        let body: Value = answer.json().await.expect("an error body");
        assert_eq!(body["errors"][0]["code"], "MANIFEST_INVALID");
        assert!(
            body["errors"][0]["message"].as_str().expect("text").contains(reason),
            "{body} for {reason}"
        );
    }
    let config = registry.push_blob("talker", task("talker").to_string().as_bytes()).await;
    let package = ImageManifest::package(config, content);
    let name = Algorithm::Sha512.digest(&serde_json::to_vec(&package).expect("JSON"));
    let answer = registry
        .put_manifest(&format!("/v2/talker/manifests/{name}"), MANIFEST_TYPE, &package)
        .await;
    assert_eq!(
        refusal(answer).await,
        refused(400, "MANIFEST_INVALID"),
        "no robot knows it by that name"
    );
    assert_eq!(registry.registry.store.packages().list().await.expect("packages"), []);

    for _ in 0..2 {
        let answer =
            registry.put_manifest("/v2/talker/manifests/1.0.0", MANIFEST_TYPE, &package).await;
        assert_eq!(answer.status(), StatusCode::CREATED);
    }
    let packages = registry.registry.store.packages().list().await.expect("packages");
    let [view] = &packages[..] else { panic!("{packages:?}") };
    assert_eq!((view.package.config, view.package.content), (config, content));
    assert_eq!((view.pushed_at_ms, view.package.version.as_str()), (NOW_MS, "1.0.0"));
    let found = registry
        .registry
        .store
        .packages()
        .get(&view.package.name, &view.package.manifest.digest)
        .await;
    assert_eq!(found.expect("a package").as_ref(), Some(view));

    let manifest = format!("/v2/talker/manifests/{}", view.package.manifest.digest);
    assert_eq!(registry.status(Method::DELETE, &manifest).await, StatusCode::ACCEPTED);
    assert_eq!(registry.registry.store.packages().list().await.expect("packages"), []);
}

#[tokio::test]
async fn package_in_another_repository_is_a_copy_with_its_referrers() {
    let registry = TestRegistry::start().await;
    let store = &registry.registry.store;
    let first = registry.push_package("early/talker", "talker").await;
    assert_eq!(store.packages().list().await.expect("packages"), [], "a copy alone is no package");
    let own = registry.push_package("talker", "talker").await;
    assert_eq!(own, first);
    for mirror in ["mirror/team/talker", "walker"] {
        let copy = registry.push_package(mirror, "talker").await;
        assert_eq!(copy, own, "a copy has the same digest");
        let pulled = registry.get(&format!("/v2/{mirror}/manifests/1.0.0")).await;
        assert_eq!(
            (pulled.status(), crate::registry::header(&pulled, "docker-content-digest")),
            (StatusCode::OK, own.to_string())
        );
        let signature = registry.push_signature(mirror, own).await;
        let referrers: Value = registry
            .get(&format!("/v2/{mirror}/referrers/{own}"))
            .await
            .json()
            .await
            .expect("a list");
        assert_eq!(referrers["manifests"][0]["digest"], signature.to_string(), "{referrers}");
    }
    // The package is ordered by its own name and listed once.
    let packages = store.packages().list().await.expect("packages");
    assert_eq!(
        packages.iter().map(|view| view.package.name.as_str()).collect::<Vec<_>>(),
        ["talker"]
    );
    // An invalid package is refused there as well, and some repositories are for other things.
    let content = registry.push_blob("mirror/x", b"no archive").await;
    let config = registry.push_blob("mirror/x", task("talker").to_string().as_bytes()).await;
    let damaged = ImageManifest::package(config, content);
    let answer =
        registry.put_manifest("/v2/mirror/x/manifests/1.0.0", MANIFEST_TYPE, &damaged).await;
    assert_eq!(refusal(answer).await, refused(400, "MANIFEST_INVALID"));
    let answer = registry.try_push_package("outputs/r00000000000000a1/talker", "talker").await;
    let body: Value = answer.json().await.expect("an error body");
    let message = body["errors"][0]["message"].as_str().expect("text");
    assert!(
        message.contains("talker can't be stored in outputs/r00000000000000a1/talker"),
        "{message}"
    );

    // Deleting a copy deletes nothing else, and a remaining copy is no package.
    let status = registry.status(Method::DELETE, &format!("/v2/walker/manifests/{own}")).await;
    assert_eq!(
        (status, store.packages().list().await.expect("packages").len()),
        (StatusCode::ACCEPTED, 1)
    );
    let status = registry.status(Method::DELETE, &format!("/v2/talker/manifests/{own}")).await;
    assert_eq!(
        (status, store.packages().list().await.expect("packages").len()),
        (StatusCode::ACCEPTED, 0)
    );
    let copy =
        registry.status(Method::GET, &format!("/v2/mirror/team/talker/manifests/{own}")).await;
    assert_eq!(copy, StatusCode::OK);
}

impl TestRegistry {
    /// Pushes version 1.0.0 of a package into a repository; the digest of its manifest.
    async fn push_package(&self, repository: &str, name: &str) -> Digest {
        let answer = self.try_push_package(repository, name).await;
        assert_eq!(answer.status(), StatusCode::CREATED);
        crate::registry::header(&answer, "docker-content-digest").parse().expect("a digest")
    }

    async fn try_push_package(&self, repository: &str, name: &str) -> reqwest::Response {
        let content = self.push_blob(repository, &archive_with(b"")).await;
        let config = self.push_blob(repository, task(name).to_string().as_bytes()).await;
        let package = ImageManifest::package(config, content);
        self.put_manifest(&format!("/v2/{repository}/manifests/1.0.0"), MANIFEST_TYPE, &package)
            .await
    }

    /// Pushes a signature of the package with this manifest beside its copy.
    async fn push_signature(&self, repository: &str, manifest: Digest) -> Digest {
        let package =
            self.registry.store.packages().get(&"talker".parse().expect("a name"), &manifest).await;
        let package = package.expect("read").expect("there").package;
        let envelope =
            PackageStatement { package: package.clone() }.seal(&SigningKey::from_bytes([7; 32]));
        let layer = self.push_blob(repository, &serde_json::to_vec(&envelope).expect("JSON")).await;
        self.push_blob(repository, EMPTY).await;
        let document =
            ImageManifest::signed_document(SIGNATURE_ARTIFACT, layer, Some(package.manifest));
        let digest = Digest::of(&serde_json::to_vec(&document).expect("JSON"));
        let answer = self
            .put_manifest(&format!("/v2/{repository}/manifests/{digest}"), MANIFEST_TYPE, &document)
            .await;
        assert_eq!(
            answer.status(),
            StatusCode::CREATED,
            "{}",
            answer.text().await.unwrap_or_default()
        );
        digest
    }
}

async fn version_moves_to_other_content_only_by_force(database: TestDatabase) {
    let data = tempfile::tempdir().expect("a directory");
    let store = database.store.clone();
    let registry =
        TestRegistry::start_on(store, data, BlobSettings::default(), Some(operator())).await;
    let config = registry.push_blob("talker", task("talker").to_string().as_bytes()).await;
    let mut packages = Vec::new();
    for content in [archive_with(b"first"), archive_with(b"other")] {
        packages.push(ImageManifest::package(config, registry.push_blob("talker", &content).await));
    }
    let put = async |path: &str, package: &ImageManifest| {
        registry.put_manifest(&format!("/v2/talker/manifests/{path}"), MANIFEST_TYPE, package).await
    };
    let digest = |package: &ImageManifest| Digest::of(&serde_json::to_vec(package).expect("JSON"));
    let [first, second] = &packages[..] else { panic!("{packages:?}") };
    for tag in ["1.0.0", "1.0.0", "stable"] {
        assert_eq!(
            put(tag, first).await.status(),
            StatusCode::CREATED,
            "the same is the same under each name"
        );
    }
    let fleet = Fleet::new(database).await;
    let mut robots = fleet.enroll(1).await;
    let ordered = registry.registry.store.packages().list().await.expect("packages").remove(0);
    let order = order_of(&ordered);
    let id = fleet
        .deployments
        .create(&fleet.operator, &random_key(), &order, &ordered)
        .await
        .expect("ordered");
    fleet.follow(&mut robots[0], Phase::Running).await;
    let is_outdated = async || {
        (fleet.view(&robots[0]).await.tasks[0].outdated, fleet.deployment(&id).await.outdated)
    };

    for tag in ["1.0.0", "stable", "latest"] {
        let refused = put(tag, second).await;
        assert_eq!(refused.status(), StatusCode::CONFLICT, "{tag}");
        let body: Value = refused.json().await.expect("an error body");
        assert_eq!(body["errors"][0]["code"], "DENIED");
        let said = body["errors"][0]["message"].as_str().expect("text");
        assert!(said.contains(&digest(first).to_string()) && said.contains("--force"), "{said}");
    }
    assert_eq!(is_outdated().await, (false, false));
    // A manifest pushed by its digest alone takes no version.
    assert_eq!(put(&digest(second).to_string(), second).await.status(), StatusCode::CREATED);
    assert_eq!(is_outdated().await, (false, false));
    assert_eq!(put("1.0.0?force=true", second).await.status(), StatusCode::CREATED);
    assert_eq!(is_outdated().await, (true, true));
    assert_eq!(put("1.0.0?force=true", first).await.status(), StatusCode::CREATED, "and back");
    assert_eq!(is_outdated().await, (false, false));
    // A tag that was taken away is free.
    assert_eq!(
        registry.status(Method::DELETE, "/v2/talker/manifests/1.0.0").await,
        StatusCode::ACCEPTED
    );
    assert_eq!(put("1.0.0", second).await.status(), StatusCode::CREATED);
    // A version that names something other than a package, and a manifest that is no package, move
    // as ever.
    for layer in [&b"one"[..], b"two"] {
        let image = image(config, registry.push_blob("talker", layer).await);
        let answer =
            registry.put_manifest("/v2/talker/manifests/2.0.0", MANIFEST_TYPE, &image).await;
        assert_eq!(answer.status(), StatusCode::CREATED);
    }
}

async fn package_in_use_outlives_its_manifest(database: TestDatabase) {
    let data = tempfile::tempdir().expect("a directory");
    let store = database.store.clone();
    let registry =
        TestRegistry::start_on(store, data, BlobSettings::default(), Some(operator())).await;
    let config = registry.push_blob("talker", task("talker").to_string().as_bytes()).await;
    let content = registry.push_blob("talker", &archive_with(b"content")).await;
    let package = ImageManifest::package(config, content);
    let answer = registry.put_manifest("/v2/talker/manifests/1.0.0", MANIFEST_TYPE, &package).await;
    assert_eq!(answer.status(), StatusCode::CREATED);
    let tags: Value = registry.get("/v2/talker/tags/list").await.json().await.expect("JSON");
    assert_eq!(tags["tags"], json!(["1.0.0"]));

    let fleet = Fleet::new(database).await;
    let robots = fleet.enroll(1).await;
    let ordered = registry.registry.store.packages().list().await.expect("packages").remove(0);
    fleet
        .deployments
        .create(&fleet.operator, &random_key(), &order_of(&ordered), &ordered)
        .await
        .expect("ordered");
    let robot = serve(registry.registry.clone(), Some(Caller::Robot(robots[0].id.clone()))).await;
    let stranger = serve(registry.registry.clone(), Some(Caller::Robot(RobotId::random()))).await;

    let manifest = ordered.package.manifest.digest;
    let path = format!("/v2/talker/manifests/{manifest}");
    assert_eq!(registry.status(Method::DELETE, &path).await, StatusCode::CONFLICT);
    assert_eq!(registry.status(Method::GET, &path).await, StatusCode::OK);
    fleet.database.drop_package("talker", &manifest).await;
    assert_eq!(registry.status(Method::GET, &path).await, StatusCode::NOT_FOUND);
    let loose = registry.push_blob("talker", b"loose").await.digest;
    assert_eq!(registry.collect(NOW_MS + YEAR_MS).await.blobs, 1);
    for (digest, expected) in [
        (manifest, StatusCode::OK),
        (config.digest, StatusCode::OK),
        (content.digest, StatusCode::OK),
        (loose, StatusCode::FORBIDDEN),
    ] {
        let path = format!("/v2/talker/blobs/{digest}");
        assert_eq!(
            registry.status(Method::GET, &format!("{robot}{path}")).await,
            expected,
            "{digest}"
        );
        assert_eq!(
            registry.status(Method::GET, &format!("{stranger}{path}")).await,
            StatusCode::FORBIDDEN
        );
    }
}

async fn collecting_needed_blobs_neither_blocks_pushes_nor_writes(database: TestDatabase) {
    let data = tempfile::tempdir().expect("a directory");
    let store = database.store.clone();
    let registry =
        TestRegistry::start_on(store, data, BlobSettings::default(), Some(operator())).await;
    registry.push_image("a", "v1").await;
    // A write that is not committed leaves the number as it was.
    let sequence =
        async || database.store.begin_without_auth_invalidation().await.expect("begins").sequence();
    let before = sequence().await;
    let _push = registry.registry.blobs.hold_collection().await;
    let collected =
        tokio::time::timeout(Duration::from_secs(30), registry.collect(NOW_MS + YEAR_MS)).await;
    assert_eq!(collected.expect("it waits for no push"), Collected::default());
    assert_eq!(sequence().await, before);
}

async fn blob_needed_since_the_lookup_is_kept(database: TestDatabase) {
    let data = tempfile::tempdir().expect("a directory");
    let store = database.store.clone();
    let registry =
        TestRegistry::start_on(store, data, BlobSettings::default(), Some(operator())).await;
    let (part, loose) =
        (registry.push_blob("a", b"part").await, registry.push_blob("a", b"loose").await);
    let (store, blobs) = (database.store.clone(), registry.registry.blobs.clone());
    let push = blobs.hold_collection().await;
    let collecting = tokio::spawn({
        let (store, blobs) = (store.clone(), blobs.clone());
        async move {
            collector::collect(&store, &blobs, NOW_MS + YEAR_MS, GRACE).await.expect("collected")
        }
    });
    // Once the collector waits for this push, the next one waits for the collector.
    while !collecting.is_finished() && blobs.hold_collection().now_or_never().is_some() {
        tokio::task::yield_now().await;
    }
    let new = NewManifest {
        manifest: StoredManifest {
            digest: Digest::of(b"manifest"),
            size: 8,
            media_type: MANIFEST_TYPE.to_owned(),
        },
        artifact_type: None,
        annotations: Default::default(),
        subject: None,
        parts: vec![part.digest],
        tags: Vec::new(),
        takes_version: false,
        package: None,
        output: None,
        document: None,
    };
    let repository: RepositoryName = "a".parse().expect("a name");
    let put = store.manifests().put(&repository, &new, None, NOW_MS).await;
    assert_eq!(put.expect("writes"), PutManifest::Stored);
    drop(push);
    assert_eq!(collecting.await.expect("it ends").blobs, 1);
    for (digest, expected) in [(part.digest, StatusCode::OK), (loose.digest, StatusCode::NOT_FOUND)]
    {
        assert_eq!(registry.status(Method::GET, &format!("/v2/a/blobs/{digest}")).await, expected);
    }
}

on_both_databases! {
    version_moves_to_other_content_only_by_force,
    package_in_use_outlives_its_manifest,
    collecting_needed_blobs_neither_blocks_pushes_nor_writes,
    blob_needed_since_the_lookup_is_kept,
}

#[tokio::test]
async fn unreferenced_blob_is_collected_after_its_grace() {
    let registry = TestRegistry::start().await;
    let grace_ms = u64::try_from(GRACE.as_millis()).expect("small");
    let manifest = registry.push_image("a", "kept").await;
    let loose = registry.push_blob("a", b"loose").await.digest;
    let blob = format!("/v2/a/blobs/{loose}");
    assert_eq!(registry.collect(NOW_MS + grace_ms).await, Collected { uploads: 0, blobs: 0 });

    // A client about to push asks for the blob: its grace period begins anew.
    registry.registry.clock.advance_ms(grace_ms);
    assert_eq!(registry.status(Method::HEAD, &blob).await, StatusCode::OK);
    assert_eq!(registry.collect(NOW_MS + grace_ms + 1).await.blobs, 0);
    assert_eq!(registry.collect(NOW_MS + 2 * grace_ms + 1).await.blobs, 1);
    assert_eq!(registry.status(Method::GET, &blob).await, StatusCode::NOT_FOUND);
    assert_eq!(registry.status(Method::GET, "/v2/a/manifests/kept").await, StatusCode::OK);

    // A deleted manifest, its config and its layer go after a grace of their own.
    let path = format!("/v2/a/manifests/{manifest}");
    assert_eq!(registry.status(Method::DELETE, &path).await, StatusCode::ACCEPTED);
    assert_eq!(registry.collect(NOW_MS + 2 * grace_ms).await.blobs, 0);
    assert_eq!(registry.collect(NOW_MS + 2 * grace_ms + 1).await.blobs, 3);
}

#[tokio::test]
async fn head_request_keeps_a_blob_only_with_push_permission() {
    let registry = TestRegistry::start().await;
    let grace_ms = u64::try_from(GRACE.as_millis()).expect("small");
    let robot = RobotId::random();
    let viewer = Person {
        roles: Roles::one(Role::Viewer),
        ..Person::first("0123456789ab".parse().expect("an id"))
    };
    let to_viewer = serve(registry.registry.clone(), Some(Caller::Person(viewer))).await;
    let to_robot = serve(registry.registry.clone(), Some(Caller::Robot(robot.clone()))).await;
    let outputs: &str = &format!("outputs/{robot}/mapping");
    let read = registry.push_blob("a", b"read").await.digest;
    let deleted = registry.push_blob("a", b"deleted").await.digest;
    let pushed = registry.push_blob("a", b"pushed again").await.digest;
    let brought = registry.push_blob(outputs, b"brought back").await.digest;
    assert_eq!(
        registry.status(Method::DELETE, &format!("/v2/a/blobs/{deleted}")).await,
        StatusCode::ACCEPTED
    );

    registry.registry.clock.advance_ms(grace_ms);
    for (server, repository, digest, expected) in [
        (&to_viewer, "a", read, StatusCode::OK),
        (&registry.base, "a", deleted, StatusCode::NOT_FOUND),
        (&registry.base, "a", pushed, StatusCode::OK),
        (&to_robot, outputs, brought, StatusCode::OK),
    ] {
        let path = format!("{server}/v2/{repository}/blobs/{digest}");
        assert_eq!(registry.status(Method::HEAD, &path).await, expected, "{path}");
    }
    assert_eq!(
        registry.collect(NOW_MS + grace_ms + 1).await.blobs,
        2,
        "the blob that was only read, and the deleted one"
    );
    for (repository, digest, expected) in [
        ("a", read, StatusCode::NOT_FOUND),
        ("a", pushed, StatusCode::OK),
        (outputs, brought, StatusCode::OK),
    ] {
        let path = format!("/v2/{repository}/blobs/{digest}");
        assert_eq!(registry.status(Method::GET, &path).await, expected, "{path}");
    }
}

#[tokio::test]
async fn abandoned_uploads_are_collected() {
    let registry = TestRegistry::start().await;
    let upload = registry.begin("a").await;
    // The file's time is the machine's, which is before the test's.
    assert_eq!(registry.collect(NOW_MS).await, Collected { uploads: 1, blobs: 0 });
    assert_eq!(registry.status(Method::GET, &upload).await, StatusCode::NOT_FOUND);
}
