//! Publishers' signatures on their way through the server: refusals, notifications and read
//! permissions.

use reqwest::{Method, Response, StatusCode};
use task_proto::api::DeploymentView;
use task_proto::desired::{BlobRef, PackageRef, SignatureRef};
use task_proto::messages::report::Phase;
use task_proto::packages::oci::{EMPTY, ImageManifest, MANIFEST_TYPE};
use task_proto::packages::publisher::{
    LIST_ARTIFACT, LIST_REPOSITORY, LIST_TYPE, MAX_SIGNATURES, PackageStatement, PublisherList,
    Role, SIGNATURE_ARTIFACT,
};
use task_proto::trust::envelope::{Envelope, SigningKey};
use tempfile::TempDir;

use crate::database::{TestDatabase, on_both_databases};
use crate::harness::{TestRobot, TestServer};

pub fn key(seed: u8) -> SigningKey {
    SigningKey::from_bytes([seed; 32])
}

fn role(seeds: &[u8]) -> Role {
    Role::new(seeds.iter().map(|seed| key(*seed).public_key()).collect(), 1).expect("a role")
}

fn list(version: u64, keeper: u8) -> PublisherList {
    let (issued_at_ms, expires_at_ms) = (version, version + 1000);
    PublisherList {
        version,
        issued_at_ms,
        expires_at_ms,
        publishers: role(&[9]),
        keepers: role(&[keeper]),
        withdrawn: vec![],
    }
}

fn sealed(list: &PublisherList, seeds: &[u8]) -> Envelope {
    let mut envelope = list.seal(&key(seeds[0]));
    seeds.iter().for_each(|seed| envelope.add_signature(LIST_TYPE, &key(*seed)).expect("signed"));
    envelope
}

fn blob(envelope: &Envelope) -> BlobRef {
    BlobRef::of(&serde_json::to_vec(envelope).expect("json"))
}

async fn server(database: &TestDatabase) -> TestServer {
    let url = database.url.clone();
    TestServer::start_in(TempDir::new().expect("a directory"), |config| config.database = Some(url))
        .await
}

/// Pushes a signed document as `taskd` does; `reference` is a tag, or the manifest's digest.
async fn push(
    server: &TestServer,
    repository: &str,
    (artifact_type, subject): (&str, Option<BlobRef>),
    envelope: &[u8],
    tag: Option<&str>,
) -> Response {
    for bytes in [EMPTY, envelope] {
        let path = format!("/v2/{repository}/blobs/uploads/?digest={}", BlobRef::of(bytes).digest);
        let request = server.request(Method::POST, &path).body(bytes.to_vec());
        assert_eq!(request.send().await.expect("an answer").status(), StatusCode::CREATED);
    }
    let manifest = ImageManifest::signed_document(artifact_type, BlobRef::of(envelope), subject);
    let manifest = serde_json::to_vec(&manifest).expect("json");
    let reference = tag.map_or_else(|| BlobRef::of(&manifest).digest.to_string(), str::to_owned);
    let request = server.request(Method::PUT, &format!("/v2/{repository}/manifests/{reference}"));
    request.header("content-type", MANIFEST_TYPE).body(manifest).send().await.expect("an answer")
}

pub async fn push_signature(
    server: &TestServer,
    package: &PackageRef,
    envelope: &Envelope,
) -> Response {
    let bytes = serde_json::to_vec(envelope).expect("json");
    push(server, package.name.as_str(), (SIGNATURE_ARTIFACT, Some(package.manifest)), &bytes, None)
        .await
}

async fn push_list(server: &TestServer, envelope: &Envelope, tag: &str) -> Response {
    let bytes = serde_json::to_vec(envelope).expect("json");
    push(server, LIST_REPOSITORY, (LIST_ARTIFACT, None), &bytes, Some(tag)).await
}

#[track_caller]
fn assert_stored(answer: &Response) {
    assert_eq!(answer.status(), StatusCode::CREATED);
}

async fn assert_refused(answer: Response, reason: &str) {
    assert_eq!(answer.status(), StatusCode::BAD_REQUEST, "{reason}");
    let text = answer.text().await.expect("a body");
    assert!(text.contains(reason), "{text} for {reason}");
}

async fn may_read(server: &TestServer, robot: &TestRobot, blob: BlobRef) -> bool {
    let request = server
        .bare(Method::GET, &format!("/v2/any/blobs/{}", blob.digest))
        .bearer_auth(&robot.token);
    request.send().await.expect("an answer").status() == StatusCode::OK
}

async fn signature_is_sent_to_the_robots_of_its_package(database: TestDatabase) {
    let server = server(&database).await;
    let (robot, other) = (server.enroll("atlas").await, server.enroll("bolt").await);
    let package = server.push("talker", "1.0.0").await;
    let _: DeploymentView = server.deploy(&package, "atlas", "k").await;
    let before = server.desired(&robot).await;
    assert!(before.evidence.is_empty());
    let tag = |answer: &Response| answer.headers()["etag"].clone();
    let tag_before = tag(&server.ask_desired(&robot).await);

    let [ada, bob] =
        [1, 2].map(|seed| PackageStatement { package: package.clone() }.seal(&key(seed)));
    for _ in 0..2 {
        assert_stored(&push_signature(&server, &package, &ada).await);
    }
    assert_stored(&push_signature(&server, &package, &bob).await);
    let after = server.desired(&robot).await;
    let named = [&ada, &bob].map(|envelope| SignatureRef {
        manifest: package.manifest.digest,
        envelope: blob(envelope),
    });
    let mut found = after.evidence.signatures.clone();
    found.sort_by_key(|signature| *signature != named[0]);
    assert_eq!(found, named, "each once");
    assert_eq!(
        (after.generation, &after.tasks),
        (before.generation, &before.tasks),
        "nothing else was ordered"
    );
    assert_ne!(
        tag(&server.ask_desired(&robot).await),
        tag_before,
        "a repeated request gets the new state"
    );
    assert!(server.desired(&other).await.evidence.is_empty());
    assert!(
        may_read(&server, &robot, blob(&ada)).await && !may_read(&server, &other, blob(&ada)).await
    );
}

async fn signature_that_contradicts_its_manifest_is_refused(database: TestDatabase) {
    let server = server(&database).await;
    let (talker, other) =
        (server.push("talker", "1.0.0").await, server.push("other", "1.0.0").await);
    let of_other = PackageStatement { package: other.clone() }.seal(&key(1));
    assert_refused(
        push_signature(&server, &talker, &of_other).await,
        "other 1.0.0 was signed, not the subject",
    )
    .await;
    let swapped = PackageRef { content: other.content, ..talker.clone() };
    let mixed = PackageStatement { package: swapped }.seal(&key(1));
    assert_refused(push_signature(&server, &talker, &mixed).await, "talker 1.0.0 was signed").await;
    let absent = PackageRef { manifest: other.manifest, ..talker.clone() };
    let of_absent = PackageStatement { package: absent.clone() }.seal(&key(1));
    assert_refused(push_signature(&server, &absent, &of_absent).await, "there is no such package")
        .await;
    assert_refused(push_signature(&server, &talker, &list(1, 2).seal(&key(2))).await, "payload is")
        .await;
    let about = (SIGNATURE_ARTIFACT, Some(talker.manifest));
    assert_refused(push(&server, "talker", about, b"nonsense", None).await, "not a DSSE envelope")
        .await;
    assert_refused(
        push(&server, "talker", about, &[b' '; 20_000], None).await,
        "at most 16384 are allowed",
    )
    .await;
    assert_refused(
        push(&server, "talker", (SIGNATURE_ARTIFACT, None), b"{}", None).await,
        "subject",
    )
    .await;
}

async fn surplus_signatures_do_not_displace_the_first(database: TestDatabase) {
    let server = server(&database).await;
    let robot = server.enroll("atlas").await;
    let package = server.push("talker", "1.0.0").await;
    server.deploy(&package, "atlas", "k").await;
    let first = PackageStatement { package: package.clone() }.seal(&key(1));
    assert_stored(&push_signature(&server, &package, &first).await);
    server.clock.advance_ms(1);
    for seed in 0..MAX_SIGNATURES as u8 {
        let flood = PackageStatement { package: package.clone() }.seal(&key(100 + seed));
        assert_stored(&push_signature(&server, &package, &flood).await);
    }
    let named = server.desired(&robot).await.evidence.signatures;
    assert_eq!((named.len(), named[0].envelope), (MAX_SIGNATURES, blob(&first)));
}

async fn robots_get_the_chain_of_publisher_lists(database: TestDatabase) {
    let server = server(&database).await;
    let robot = server.enroll("atlas").await;
    let first = sealed(&list(1, 2), &[2]);
    assert_stored(&push_list(&server, &first, "1").await);
    // Renewed twice, then handed on to another keeper, and renewed by that one.
    let lists = [
        sealed(&list(2, 2), &[2]),
        sealed(&list(3, 2), &[2]),
        sealed(&list(4, 3), &[2, 3]),
        sealed(&list(5, 3), &[3]),
        sealed(&list(6, 3), &[3]),
    ];
    for (version, list) in (2..).zip(&lists) {
        assert_stored(&push_list(&server, list, &version.to_string()).await);
    }
    let told = server.desired(&robot).await.evidence.lists;
    assert_eq!(told, [&first, &lists[2], &lists[4]].map(blob));
    for list in told {
        assert!(may_read(&server, &robot, list).await);
    }
    assert_stored(&push_list(&server, &lists[0], "2").await);

    for (envelope, tag, reason) in [
        (
            sealed(&list(7, 9), &[9]),
            "7",
            "signed by 0 of the 1 required keepers (of the previous list",
        ),
        (
            sealed(&list(7, 2), &[2]),
            "7",
            "signed by 0 of the 1 required keepers (of the previous list",
        ),
        (
            sealed(&list(7, 9), &[3]),
            "7",
            "signed by 0 of the 1 required keepers that it names itself",
        ),
        (sealed(&list(6, 3), &[3, 2]), "6", "its version 6 is not newer than the known version 6"),
        (sealed(&list(3, 3), &[3]), "3", "its version 3 is not newer than the known version 6"),
        (sealed(&list(7, 3), &[3]), "8", "the tag of a list of publishers must be its version"),
    ] {
        assert_refused(push_list(&server, &envelope, tag).await, reason).await;
    }
    let elsewhere = serde_json::to_vec(&lists[4]).expect("json");
    let answer = push(&server, "talker", (LIST_ARTIFACT, None), &elsewhere, Some("6")).await;
    assert_refused(answer, "belongs in the repository taskd/publishers").await;
    assert_eq!(server.desired(&robot).await.evidence.lists.len(), 3);
}

async fn deleted_signature_is_not_sent_to_robots(database: TestDatabase) {
    let server = server(&database).await;
    let robot = server.enroll("atlas").await;
    let package = server.push("talker", "1.0.0").await;
    server.deploy(&package, "atlas", "k").await;
    let signature = PackageStatement { package: package.clone() }.seal(&key(1));
    let answer = push_signature(&server, &package, &signature).await;
    let manifest = answer.headers()["docker-content-digest"].to_str().expect("text").to_owned();
    assert_stored(&push_list(&server, &sealed(&list(1, 2), &[2]), "1").await);
    assert!(may_read(&server, &robot, blob(&signature)).await);
    let tags: serde_json::Value = server.get(&format!("/v2/{LIST_REPOSITORY}/tags/list")).await;
    assert_eq!(tags["tags"], serde_json::json!(["1"]));
    let path = format!("/v2/{LIST_REPOSITORY}/manifests/1");
    let head = server.request(Method::HEAD, &path).send().await.expect("an answer");
    let list_manifest = head.headers()["docker-content-digest"].to_str().expect("text").to_owned();
    for path in [
        format!("/v2/talker/manifests/{manifest}"),
        format!("/v2/{LIST_REPOSITORY}/manifests/{list_manifest}"),
    ] {
        let answer = server.request(Method::DELETE, &path).send().await.expect("an answer");
        assert_eq!(answer.status(), StatusCode::ACCEPTED);
    }
    assert!(server.desired(&robot).await.evidence.is_empty());
    assert!(!may_read(&server, &robot, blob(&signature)).await);
}

async fn reverted_robot_gets_the_signatures_of_the_earlier_package(database: TestDatabase) {
    let server = server(&database).await;
    let mut robot = server.enroll("atlas").await;
    let order = async |robot: &mut TestRobot, version: &str, phase| {
        let package = server.push("talker", version).await;
        server.deploy(&package, "atlas", version).await;
        let state = server.desired(robot).await;
        assert_eq!(server.report(robot, &state, phase).await.status(), StatusCode::OK);
        package
    };
    let old = order(&mut robot, "1.0.0", Phase::Running).await;
    let signature = PackageStatement { package: old.clone() }.seal(&key(1));
    assert_stored(&push_signature(&server, &old, &signature).await);
    let new = order(&mut robot, "2.0.0", Phase::RolledBack).await;
    let state = server.desired(&robot).await;
    assert_eq!(state.tasks[0].package, new);
    let named = SignatureRef { manifest: old.manifest.digest, envelope: blob(&signature) };
    assert_eq!(state.evidence.signatures, [named]);
    assert!(may_read(&server, &robot, blob(&signature)).await);
    order(&mut robot, "3.0.0", Phase::Running).await;
    assert!(server.desired(&robot).await.evidence.is_empty());
    assert!(!may_read(&server, &robot, blob(&signature)).await);
}

on_both_databases!(
    reverted_robot_gets_the_signatures_of_the_earlier_package,
    signature_is_sent_to_the_robots_of_its_package,
    signature_that_contradicts_its_manifest_is_refused,
    surplus_signatures_do_not_displace_the_first,
    robots_get_the_chain_of_publisher_lists,
    deleted_signature_is_not_sent_to_robots,
);
