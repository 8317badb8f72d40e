//! Files that come back from robots: pushed by the robot into its own repository, listed and read
//! by operators.

use std::time::Duration;

use reqwest::{Body, Method, StatusCode};
use serde_json::{Value, json};
use task_proto::api::OutputList;
use task_proto::desired::BlobRef;
use task_proto::packages::oci::MANIFEST_TYPE;
use task_proto::packages::output::{OUTPUT_TYPE, OutputFile, OutputSet};
use task_proto::{Digest, RobotId};
use taskd::blobs::BlobSettings;
use taskd::blobs::collector;
use taskd::http::registry::Registry;

use crate::database::{TestDatabase, on_both_databases};
use crate::harness::{TestRobot, TestServer, refusal};
use crate::registry::{GRACE, NOW_MS, TestRegistry, image, operator};

/// A push in the robot's name, blob by blob.
pub struct Push {
    pub client: reqwest::Client,
    /// Where its repository is.
    pub url: String,
    pub token: String,
}

impl Push {
    pub fn new(server: &TestServer, robot: &TestRobot, repository: String) -> Self {
        let url = server.url(&format!("/v2/{repository}"));
        Self { client: server.client.clone(), url, token: robot.token.clone() }
    }

    fn ask(&self, method: Method, rest: &str) -> reqwest::RequestBuilder {
        self.client.request(method, format!("{}/{rest}", self.url)).bearer_auth(&self.token)
    }

    pub async fn blob(&self, bytes: &[u8]) -> BlobRef {
        let digest = Digest::of(bytes);
        let request =
            self.ask(Method::POST, &format!("blobs/uploads/?digest={digest}")).body(bytes.to_vec());
        assert_eq!(request.send().await.expect("an answer").status(), StatusCode::CREATED);
        BlobRef { digest, size: bytes.len() as u64 }
    }

    pub async fn output(&self, output: &OutputSet) -> StatusCode {
        let config = self.blob(&serde_json::to_vec(output).expect("json")).await;
        let manifest = serde_json::to_vec(&output.manifest(config)).expect("json");
        let tag = output.tag().expect("a tag");
        let put = self
            .ask(Method::PUT, &format!("manifests/{tag}"))
            .header("content-type", MANIFEST_TYPE);
        put.body(manifest).send().await.expect("an answer").status()
    }
}

pub fn output(robot: &RobotId, run: u64, files: Vec<OutputFile>) -> OutputSet {
    OutputSet {
        robot_id: robot.clone(),
        task: "mapping".parse().expect("valid"),
        version: "1.0.0".parse().expect("valid"),
        deployment: "d00000000000000b2".parse().expect("valid"),
        run,
        files,
    }
}

pub fn file(path: &str, blob: BlobRef) -> OutputFile {
    OutputFile { path: path.parse().expect("valid"), blob }
}

#[tokio::test]
async fn outputs_of_a_robot_are_readable_by_operators() {
    let server = TestServer::start().await;
    let robot = server.enroll("atlas").await;
    let push = Push::new(&server, &robot, format!("outputs/{}/mapping", robot.id));
    let map = push.blob(b"P5 1 1 255 x").await;
    for run in 1..=12 {
        let set = output(&robot.id, run, vec![file("maps/corridor.pgm", map)]);
        server.clock.advance_ms(1000);
        assert_eq!(push.output(&set).await, StatusCode::CREATED, "run {run}");
        assert_eq!(
            push.output(&set).await,
            StatusCode::CREATED,
            "run {run}, whose answer was lost"
        );
    }
    let corrected = output(&robot.id, 12, vec![file("maps/other.pgm", map)]);
    assert_eq!(push.output(&corrected).await, StatusCode::CREATED);

    let list: OutputList = server.get("/api/v1/outputs?robot=atlas&task=mapping").await;
    assert_eq!(list.outputs.len(), 10, "the newest runs are kept, each once: {list:?}");
    assert!(
        list.outputs
            .iter()
            .any(|view| view.output == corrected && view.robot_name.as_str() == "atlas")
    );
    assert!(list.outputs.iter().all(|view| view.output.run > 2), "the oldest went: {list:?}");
    let other: OutputList = server.get("/api/v1/outputs?task=other").await;
    assert!(other.outputs.is_empty());

    let bytes = server
        .request(Method::GET, &format!("/v2/outputs/{}/mapping/blobs/{}", robot.id, map.digest));
    assert_eq!(
        bytes.send().await.expect("an answer").bytes().await.expect("a body"),
        &b"P5 1 1 255 x"[..]
    );
}

#[tokio::test]
async fn outputs_are_bounded_across_all_tasks_of_a_robot() {
    const TASKS: u64 = 21;
    let server = TestServer::start().await;
    let (robot, other) = (server.enroll("atlas").await, server.enroll("husky").await);
    let push = Push::new(&server, &other, format!("outputs/{}/mapping", other.id));
    let map = push.blob(b"x").await;
    assert_eq!(push.output(&output(&other.id, 1, vec![file("a", map)])).await, StatusCode::CREATED);
    for number in 1..=TASKS {
        let task = format!("task{number}");
        let push = Push::new(&server, &robot, format!("outputs/{}/{task}", robot.id));
        push.blob(b"x").await;
        for run in 1..=10 {
            let set = OutputSet {
                task: task.parse().expect("valid"),
                ..output(&robot.id, run, vec![file("a", map)])
            };
            server.clock.advance_ms(1);
            assert_eq!(push.output(&set).await, StatusCode::CREATED, "{task} {run}");
        }
    }
    let list: OutputList = server.get("/api/v1/outputs?robot=atlas").await;
    assert_eq!(list.outputs.len(), 200);
    assert!(
        list.outputs.iter().all(|view| view.output.task.as_str() != "task1"),
        "the oldest went: {list:?}"
    );
    let others: OutputList = server.get("/api/v1/outputs?robot=husky").await;
    assert_eq!(others.outputs.len(), 1, "another robot's stay");
}

#[tokio::test]
async fn robot_pushes_only_its_own_outputs() {
    let server = TestServer::start().await;
    let (robot, other) = (server.enroll("atlas").await, server.enroll("husky").await);
    let secret = server.push("secret", "1.0.0").await;
    let own = Push::new(&server, &robot, format!("outputs/{}/mapping", robot.id));
    let foreign =
        [format!("outputs/{}/mapping", other.id), "secret".to_owned(), "outputs".to_owned()];
    for repository in foreign {
        let push = Push::new(&server, &robot, repository);
        for (method, rest) in [
            (Method::POST, "blobs/uploads/"),
            (Method::PUT, "manifests/latest"),
            (Method::HEAD, &*format!("blobs/{}", secret.content.digest)),
        ] {
            let status = push.ask(method.clone(), rest).send().await.expect("an answer").status();
            assert_eq!(status, StatusCode::FORBIDDEN, "{method} {rest} in {}", push.url);
        }
    }
    // Blobs of another repository are neither shown nor mounted.
    let mount = own
        .ask(Method::POST, &format!("blobs/uploads/?mount={}&from=secret", secret.content.digest));
    assert_eq!(
        mount.send().await.expect("an answer").status(),
        StatusCode::ACCEPTED,
        "an upload was begun instead"
    );
    let head = own.ask(Method::HEAD, &format!("blobs/{}", secret.content.digest));
    assert_eq!(head.send().await.expect("an answer").status(), StatusCode::NOT_FOUND);

    let map = own.blob(b"x").await;
    let package = task_proto::packages::oci::ImageManifest::package(map, map);
    let put = own
        .ask(Method::PUT, "manifests/latest")
        .header("content-type", MANIFEST_TYPE)
        .json(&package);
    assert_eq!(put.send().await.expect("an answer").status(), StatusCode::FORBIDDEN, "no package");
    let set = output(&robot.id, 1, vec![file("a", map)]);
    let config = own.blob(&serde_json::to_vec(&set).expect("json")).await;
    let put = own
        .ask(Method::PUT, "manifests/latest")
        .header("content-type", MANIFEST_TYPE)
        .json(&set.manifest(config));
    assert_eq!(
        put.send().await.expect("an answer").status(),
        StatusCode::FORBIDDEN,
        "another tag than the run's"
    );
    // A manifest without a type of its own has its config's type.
    let mut disguised = serde_json::to_value(set.manifest(config)).expect("json");
    disguised.as_object_mut().expect("an object").remove("artifactType");
    disguised["config"]["mediaType"] = json!(OUTPUT_TYPE);
    let put = own
        .ask(Method::PUT, "manifests/latest")
        .header("content-type", MANIFEST_TYPE)
        .json(&disguised);
    assert_eq!(
        put.send().await.expect("an answer").status(),
        StatusCode::FORBIDDEN,
        "a disguised manifest"
    );
    let lie =
        OutputSet { robot_id: other.id.clone(), ..output(&robot.id, 1, vec![file("a", map)]) };
    assert_eq!(own.output(&lie).await, StatusCode::BAD_REQUEST, "another robot's");
    let larger = BlobRef { size: 2, ..map };
    assert_eq!(
        own.output(&output(&robot.id, 1, vec![file("a", larger)])).await,
        StatusCode::BAD_REQUEST,
        "a wrong size"
    );
    let missing = BlobRef { digest: Digest::of(b"never pushed"), size: 1 };
    assert_ne!(
        own.output(&output(&robot.id, 1, vec![file("a", missing)])).await,
        StatusCode::CREATED,
        "a missing file"
    );
    let delete = own.ask(Method::DELETE, &format!("blobs/{}", map.digest));
    assert_eq!(delete.send().await.expect("an answer").status(), StatusCode::FORBIDDEN);

    let list: OutputList = server.get("/api/v1/outputs").await;
    assert!(list.outputs.is_empty(), "{list:?}");
    let unknown = refusal(server.request(Method::GET, "/api/v1/outputs?robot=nobody")).await;
    assert_eq!(unknown, (404, "not_found".to_owned()));
}

async fn outputs_of_one_robot_are_bounded_in_bytes(database: TestDatabase) {
    const KB: u64 = 1024;
    let data = tempfile::tempdir().expect("a directory");
    let settings = BlobSettings { max_robot_bytes: 512 * KB, ..BlobSettings::default() };
    let registry =
        TestRegistry::start_on(database.store.clone(), data, settings, Some(operator())).await;
    let [first, second, other] =
        ["a1/mapping", "a1/survey", "a2/mapping"].map(|of| format!("outputs/r00000000000000{of}"));
    let push = async |repository: &str, byte: u8, bytes: u64| {
        let bytes = vec![byte; usize::try_from(bytes).expect("small")];
        let path = format!("/v2/{repository}/blobs/uploads/?digest={}", Digest::of(&bytes));
        let pieces = bytes
            .chunks(1000)
            .map(|piece| Ok::<_, std::io::Error>(piece.to_vec()))
            .collect::<Vec<_>>();
        let [announced, streamed] =
            [bytes.into(), Body::wrap_stream(futures_util::stream::iter(pieces))];
        let mut statuses = Vec::new();
        // An unannounced excess is detected during the transfer.
        for body in [streamed, announced] {
            let answer =
                registry.ask(Method::POST, &path).body(body).send().await.expect("an answer");
            statuses.push(answer.status());
            if answer.status() == StatusCode::CREATED {
                break;
            }
            let waits = answer.headers().contains_key("retry-after");
            assert_eq!(
                waits,
                answer.status() == StatusCode::TOO_MANY_REQUESTS,
                "robots wait only for temporary failures"
            );
        }
        statuses.dedup();
        let [status] = statuses[..] else { panic!("{statuses:?}") };
        status
    };
    let full = StatusCode::TOO_MANY_REQUESTS;
    assert_eq!(
        push(&first, 1, 513 * KB).await,
        StatusCode::PAYLOAD_TOO_LARGE,
        "it could never be kept"
    );
    assert_eq!(push(&first, 1, 500 * KB).await, StatusCode::CREATED);
    assert_eq!(push(&first, 1, 500 * KB).await, StatusCode::CREATED);
    assert_eq!(
        push(&second, 2, 400 * KB).await,
        StatusCode::CREATED,
        "a repeated upload counts once"
    );
    assert_eq!(push(&first, 3, 125 * KB).await, full, "all its tasks count together");
    assert_eq!(push(&other, 3, 500 * KB).await, StatusCode::CREATED, "another robot's has room");
    assert_eq!(push("talker", 4, 2000 * KB).await, StatusCode::CREATED, "and so has a package");

    // Bytes under way count as well, and bytes without room are not kept.
    let upload = registry.begin(&first).await;
    let sent = registry
        .ask(Method::PATCH, &upload)
        .body(vec![5; 100 * 1024])
        .send()
        .await
        .expect("an answer");
    assert_eq!(sent.status(), StatusCode::ACCEPTED);
    assert_eq!(push(&second, 6, 64 * KB).await, full);
    assert_eq!(registry.status(Method::DELETE, &upload).await, StatusCode::NO_CONTENT);
    for byte in [7, 8] {
        assert_eq!(push(&second, byte, 1).await, StatusCode::CREATED);
    }
    assert_eq!(push(&second, 9, 1).await, full, "a small file counts 64 KB");

    // Only deletion from the disk makes room.
    let robot = "r00000000000000a1".parse().expect("valid");
    let kept = registry.registry.store.robot_blobs().disk_usage(&robot).await.expect("a sum");
    assert_eq!(kept, (500 + 400 + 2 * 64) * KB);
    let grace_ms = u64::try_from(GRACE.as_millis()).expect("small");
    registry.collect(NOW_MS + 2 * grace_ms).await;
    assert_eq!(push(&first, 3, 125 * KB).await, StatusCode::CREATED);
}

async fn oldest_output_is_deleted_beyond_the_quota(database: TestDatabase) {
    const HOUR_MS: u64 = 3_600_000;
    let data = tempfile::tempdir().expect("a directory");
    // A run takes twice 400 KB and twice 64 KB.
    let settings = BlobSettings { max_robot_bytes: 2048 * 1024, ..BlobSettings::default() };
    let registry =
        TestRegistry::start_on(database.store.clone(), data, settings, Some(operator())).await;
    let robot = RobotId::random();
    let repository = format!("/v2/outputs/{robot}/mapping");
    let push = Push {
        client: registry.client.clone(),
        url: format!("{}{repository}", registry.base),
        token: String::new(),
    };
    let mut statuses = Vec::new();
    let mut maps = Vec::new();
    for run in 1..=3 {
        registry.registry.clock.advance_ms(1000);
        let map = push.blob(&vec![run; 400 * 1024]).await;
        let picture = push.blob(&vec![10 * run; 400 * 1024]).await;
        let files = vec![file("map.pgm", map), file("map.png", picture)];
        statuses.push(push.output(&output(&robot, run.into(), files)).await.as_u16());
        maps.extend([map, picture]);
    }
    assert_eq!(statuses, [201; 3]);
    let tags: Value =
        registry.get(&format!("{repository}/tags/list")).await.json().await.expect("JSON");
    assert_eq!(
        tags["tags"],
        json!(["d00000000000000b2-2", "d00000000000000b2-3"]),
        "three are too many"
    );

    // Far earlier than the collection of blobs that a client may be about to list.
    registry.push_blob("talker", &vec![10; 400 * 1024]).await;
    let collect = async |now_ms: u64| {
        let Registry { store, blobs, .. } = &registry.registry;
        collector::collect(store, blobs, now_ms, Duration::from_hours(24))
            .await
            .expect("collected")
            .blobs
    };
    let now_ms = registry.registry.clock.now_ms();
    assert_eq!(collect(now_ms + HOUR_MS / 2).await, 0);
    assert_eq!(collect(now_ms + HOUR_MS + 1).await, 3, "the map, the config and the manifest");
    let mut there = Vec::new();
    for map in &maps {
        there.push(
            registry
                .status(Method::HEAD, &format!("{repository}/blobs/{}", map.digest))
                .await
                .as_u16(),
        );
    }
    assert_eq!(
        there,
        [404, 200, 200, 200, 200, 200],
        "the first picture is part of a package that is being pushed"
    );

    assert_eq!(collect(now_ms + 25 * HOUR_MS).await, 1, "but nobody listed it");
    let mut files = Vec::new();
    for (byte, path) in [(4, "a"), (5, "b"), (6, "c")] {
        files.push(file(path, push.blob(&vec![byte; 660 * 1024]).await));
    }
    assert_eq!(
        push.output(&output(&robot, 4, files)).await,
        StatusCode::PAYLOAD_TOO_LARGE,
        "not even alone"
    );
}

on_both_databases!(
    outputs_of_one_robot_are_bounded_in_bytes,
    oldest_output_is_deleted_beyond_the_quota,
);

/// They are on the disk as well.
#[tokio::test]
async fn manifests_and_links_count_as_disk_usage() {
    let settings = BlobSettings { max_robot_bytes: 320 * 1024, ..BlobSettings::default() };
    let registry = TestRegistry::start_with(settings, Some(operator())).await;
    let robot: RobotId = "r00000000000000a1".parse().expect("valid");
    let kept = async || {
        registry.registry.store.robot_blobs().disk_usage(&robot).await.expect("a sum") / 1024
    };
    let repository = format!("outputs/{robot}/mapping");
    let blob = registry.push_blob(&repository, b"{}").await;
    assert_eq!(kept().await, 64);
    let mut statuses = Vec::new();
    for number in 0..4 {
        let mut manifest = image(blob, blob);
        manifest["annotations"] = json!({ "number": number.to_string() });
        let path = format!("/v2/{repository}/manifests/same");
        statuses
            .push(registry.put_manifest(&path, MANIFEST_TYPE, &manifest).await.status().as_u16());
    }
    assert_eq!((statuses, kept().await), (vec![201; 4], 5 * 64));
    // One blob in many repositories is one on the disk, and many rows.
    let mut statuses = Vec::new();
    for number in 0..7 {
        let path =
            format!("/v2/outputs/{robot}/task{number}/blobs/uploads/?digest={}", blob.digest);
        let answer = registry.ask(Method::POST, &path).body("{}").send().await.expect("an answer");
        statuses.push(answer.status().as_u16());
    }
    assert_eq!((statuses, kept().await), (vec![201, 201, 201, 201, 201, 429, 429], 10 * 64));
}

/// Many requests of a robot count no more than one request with the same bytes.
#[tokio::test]
async fn concurrent_output_uploads_count_together() {
    const MB: usize = 1024 * 1024;
    let settings = BlobSettings { max_robot_bytes: 6 * MB as u64, ..BlobSettings::default() };
    let registry = TestRegistry::start_with(settings, Some(operator())).await;
    let repository = "outputs/r00000000000000a1/mapping";
    registry.push_blob(repository, &vec![0; MB]).await;
    let (slow, quick) = (vec![1; 6 * MB], vec![2; 6 * MB]);
    let path = format!("/v2/{repository}/blobs/uploads/?digest={}", Digest::of(&slow));
    let (pieces, sent) = tokio::sync::mpsc::channel::<Vec<u8>>(1);
    let body = futures_util::stream::unfold(sent, async |mut sent| {
        let piece = sent.recv().await?;
        Some((Ok::<_, std::io::Error>(piece), sent))
    });
    let answer = registry.ask(Method::POST, &path).body(Body::wrap_stream(body)).send();
    let meanwhile = async {
        let uploads = registry.data.path().join("uploads");
        while std::fs::read_dir(&uploads).expect("a directory").count() == 0 {
            tokio::task::yield_now().await;
        }
        registry.push_blob(repository, &quick).await;
        pieces.send(slow).await.expect("it is read");
        drop(pieces);
    };
    let (answer, ()) = futures_util::future::join(answer, meanwhile).await;
    assert_eq!(answer.expect("an answer").status(), StatusCode::TOO_MANY_REQUESTS);
    let uploads = std::fs::read_dir(registry.data.path().join("uploads")).expect("a directory");
    assert_eq!(uploads.count(), 0, "nothing of it is left");
}
