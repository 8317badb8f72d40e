//! The distribution API: the requirements of the specification.

use reqwest::{Method, Response, StatusCode};
use serde_json::{Value, json};
use task_proto::desired::BlobRef;
use task_proto::ids::digest::Algorithm;
use task_proto::packages::oci::{INDEX_TYPE, MANIFEST_TYPE};
use task_proto::{Digest, RepositoryName, RobotId};
use taskd::blobs::BlobSettings;
use taskd::config::BlobRead;
use taskd::http::auth::Caller;
use taskd::http::registry::Registry;
use taskd::store::{NewManifest, PutManifest, StoredManifest};

use crate::database::{TestDatabase, on_both_databases};
use crate::registry::{
    GRACE, NOW_MS, TestRegistry, header, image, on_both_stores, operator, refusal, refused,
};

on_both_databases!(referrers_come_in_pages);

on_both_stores! {
    registry_refuses_requests_without_a_token, robot_reads_only_blobs_of_its_packages,
    blob_reads_and_ranges_agree_for_mmap_and_pread, unsupported_digest_algorithms_are_not_found,
    sha512_push_is_stored_under_its_digest, path_that_is_not_utf8_is_an_invalid_name,
    chunks_out_of_order_are_refused, wrong_bytes_and_cancelled_uploads_leave_nothing,
    upload_limits_are_enforced, concurrent_pushes_of_one_blob_store_it_once,
    blob_mount_succeeds_or_starts_an_upload,
    manifest_is_stored_byte_for_byte_under_digest_and_tag,
    invalid_manifest_is_refused_with_a_reason, manifest_with_a_page_type_is_served_as_bytes,
    concurrent_pushes_to_one_tag_leave_one_manifest, tags_are_listed_in_pages,
    referrers_are_listed_by_subject_and_type, annotations_of_referrers_are_bounded,
}

async fn registry_refuses_requests_without_a_token() {
    let registry = TestRegistry::start_with(BlobSettings::default(), None).await;
    for path in ["/v2/", "/v2/a/tags/list", "/v2/a/manifests/x", "/v2/nonsense"] {
        let answer = registry.get(path).await;
        assert_eq!(
            header(&answer, "www-authenticate"),
            "Basic realm=\"taskd\", charset=\"UTF-8\"",
            "{path}"
        );
        assert_eq!(refusal(answer).await, refused(401, "UNAUTHORIZED"), "{path}");
    }
}

async fn robot_reads_only_blobs_of_its_packages() {
    let robot =
        TestRegistry::start_with(BlobSettings::default(), Some(Caller::Robot(RobotId::random())))
            .await;
    assert_eq!(robot.status(Method::GET, "/v2/").await, StatusCode::OK);
    let blob = format!("/v2/a/blobs/{}", Digest::of(b"x"));
    for (method, path) in [
        (Method::GET, blob.as_str()),
        (Method::HEAD, &blob),
        (Method::DELETE, &blob),
        (Method::GET, "/v2/a/tags/list"),
        (Method::GET, "/v2/a/manifests/latest"),
        (Method::PUT, "/v2/a/manifests/latest"),
        (Method::POST, "/v2/a/blobs/uploads/"),
    ] {
        assert_eq!(
            robot.status(method.clone(), path).await,
            StatusCode::FORBIDDEN,
            "{method} {path}"
        );
    }
}

async fn blob_reads_and_ranges_agree_for_mmap_and_pread() {
    let bytes: Vec<u8> = (0..1_000_000_u32).flat_map(u32::to_le_bytes).collect();
    for reading in [BlobRead::Mmap, BlobRead::Pread] {
        let settings = BlobSettings { reading, ..BlobSettings::default() };
        let registry = TestRegistry::start_with(settings, Some(operator())).await;
        let blob = registry.push_blob("a/b/c", &bytes).await;
        let path = format!("/v2/a/b/c/blobs/{}", blob.digest);

        let answer =
            registry.ask(Method::GET, &path).bearer_auth("x").send().await.expect("an answer");
        let etag = format!("\"{}\"", blob.digest);
        assert_eq!(header(&answer, "etag"), etag);
        assert_eq!(header(&answer, "docker-content-digest"), blob.digest.to_string());
        assert_eq!(header(&answer, "content-length"), bytes.len().to_string());
        assert!(header(&answer, "cache-control").contains("immutable"));
        assert!(answer.bytes().await.expect("a body") == bytes);

        let head = registry.ask(Method::HEAD, &path).send().await.expect("an answer");
        assert_eq!(
            (head.status(), header(&head, "content-length")),
            (StatusCode::OK, bytes.len().to_string())
        );

        let part = registry
            .ask(Method::GET, &path)
            .header("range", "bytes=300001-3000000")
            .send()
            .await
            .expect("it");
        assert_eq!(part.status(), StatusCode::PARTIAL_CONTENT);
        assert_eq!(header(&part, "content-range"), "bytes 300001-3000000/4000000");
        assert!(part.bytes().await.expect("a body") == bytes[300_001..=3_000_000]);

        for range in ["bytes=4000000-", "bytes=500-0"] {
            let beyond =
                registry.ask(Method::GET, &path).header("range", range).send().await.expect("it");
            assert_eq!(header(&beyond, "content-range"), "bytes */4000000", "{range}");
            assert_eq!(refusal(beyond).await, refused(416, "RANGE_INVALID"), "{range}");
        }

        let known = registry
            .ask(Method::GET, &path)
            .header("if-none-match", etag)
            .send()
            .await
            .expect("it");
        assert_eq!(known.status(), StatusCode::NOT_MODIFIED);

        let empty = registry.push_blob("a/b/c", b"").await;
        let answer = registry.get(&format!("/v2/a/b/c/blobs/{}", empty.digest)).await;
        assert_eq!(
            (answer.status(), header(&answer, "content-length")),
            (StatusCode::OK, "0".to_owned())
        );
    }
}

async fn unsupported_digest_algorithms_are_not_found() {
    let registry = TestRegistry::start().await;
    let blob = registry.push_blob("a", b"{}").await;
    let digest = format!("sha384:{}", "0".repeat(96));
    for (kind, code) in [("blobs", "BLOB_UNKNOWN"), ("manifests", "MANIFEST_UNKNOWN")] {
        let path = format!("/v2/a/{kind}/{digest}");
        assert_eq!(refusal(registry.get(&path).await).await, refused(404, code));
        assert_eq!(registry.status(Method::HEAD, &path).await, StatusCode::NOT_FOUND);
        let delete =
            async |path: &str| registry.ask(Method::DELETE, path).send().await.expect("an answer");
        assert_eq!(refusal(delete(&path).await).await, refused(404, code));
        let cut = format!("/v2/a/{kind}/sha512:00");
        assert_eq!(refusal(delete(&cut).await).await, refused(400, "DIGEST_INVALID"));
    }
    for push in [
        registry.ask(Method::POST, &format!("/v2/a/blobs/uploads/?digest={digest}")),
        registry.ask(Method::PUT, &format!("/v2/a/manifests/{digest}")).json(&image(blob, blob)),
    ] {
        let answer = push.send().await.expect("an answer");
        assert_eq!(answer.status(), StatusCode::BAD_REQUEST);
        let body: Value = answer.json().await.expect("JSON");
        let error =
            json!({ "code": "DIGEST_INVALID", "message": "only sha256 and sha512 are supported" });
        assert_eq!(body["errors"], json!([error]));
    }
}

async fn sha512_push_is_stored_under_its_digest() {
    let registry = TestRegistry::start().await;
    let [config, layer] = [&b"{}"[..], &vec![7; 3_000_000]].map(|bytes| {
        (
            BlobRef { digest: Algorithm::Sha512.digest(bytes), size: bytes.len() as u64 },
            bytes.to_vec(),
        )
    });
    let push = async |begin: &str, (blob, bytes): (BlobRef, Vec<u8>)| {
        let answer = registry.ask(Method::POST, begin).send().await.expect("an answer");
        assert_eq!(answer.status(), StatusCode::ACCEPTED);
        let finish = format!("{}?digest={}", header(&answer, "location"), blob.digest);
        let answer =
            registry.ask(Method::PUT, &finish).body(bytes).send().await.expect("an answer");
        let is_created = answer.status() == StatusCode::CREATED;
        if is_created {
            assert_eq!(header(&answer, "docker-content-digest"), blob.digest.to_string());
        }
        is_created
    };
    let begin = "/v2/a/blobs/uploads/?digest-algorithm=sha512";
    assert!(!push(begin, (layer.0, b"other".to_vec())).await, "bytes that hash to something else");
    assert!(push(begin, layer.clone()).await);
    assert!(
        push("/v2/a/blobs/uploads/", config.clone()).await,
        "the algorithm may be said at the end alone"
    );
    let answer = registry.get(&format!("/v2/a/blobs/{}", layer.0.digest)).await;
    assert_eq!(header(&answer, "docker-content-digest"), layer.0.digest.to_string());
    assert!(answer.bytes().await.expect("a body") == layer.1);
    let by_other_name = format!("/v2/a/blobs/{}", Digest::of(&layer.1));
    assert_eq!(registry.status(Method::HEAD, &by_other_name).await, StatusCode::NOT_FOUND);

    let image = image(config.0, layer.0);
    let digest = Algorithm::Sha512.digest(&serde_json::to_vec(&image).expect("JSON"));
    let path = format!("/v2/a/manifests/{digest}");
    assert_eq!(
        registry.put_manifest(&path, MANIFEST_TYPE, &image).await.status(),
        StatusCode::CREATED
    );
    let answer = registry.get(&path).await;
    assert_eq!(header(&answer, "docker-content-digest"), digest.to_string());
    assert_eq!(Algorithm::Sha512.digest(&answer.bytes().await.expect("a body")), digest);

    let later_ms = NOW_MS + 2 * u64::try_from(GRACE.as_millis()).expect("a time");
    assert_eq!(registry.collect(later_ms).await.blobs, 0, "all of it is referred to");
    assert_eq!(registry.status(Method::DELETE, &path).await, StatusCode::ACCEPTED);
    for (blob, _) in [&config, &layer] {
        let path = format!("/v2/a/blobs/{}", blob.digest);
        assert_eq!(registry.status(Method::DELETE, &path).await, StatusCode::ACCEPTED);
    }
    assert_eq!(registry.collect(later_ms).await.blobs, 3);
    let directories = ["blobs/sha512", "common/sha512"].map(|name| registry.data.path().join(name));
    let directory = directories.into_iter().find(|path| path.exists()).expect("one was used");
    assert_eq!(std::fs::read_dir(directory).expect("a directory").count(), 0);
}

async fn path_that_is_not_utf8_is_an_invalid_name() {
    let registry = TestRegistry::start().await;
    for path in ["/v2/x/manifests/%FF", "/v2/%FF/tags/list"] {
        assert_eq!(refusal(registry.get(path).await).await, refused(400, "NAME_INVALID"), "{path}");
    }
}

async fn chunks_out_of_order_are_refused() {
    let registry = TestRegistry::start().await;
    let upload = registry.begin("a").await;
    let patch = async |range: &str, body: &'static str| {
        let request =
            registry.ask(Method::PATCH, &upload).header("content-range", range).body(body);
        request.send().await.expect("an answer")
    };
    assert_eq!(patch("2-3", "xx").await.status(), StatusCode::RANGE_NOT_SATISFIABLE);
    let first = patch("0-4", "hello").await;
    assert_eq!((first.status(), header(&first, "range")), (StatusCode::ACCEPTED, "0-4".to_owned()));
    assert_eq!(patch("0-4", "hello").await.status(), StatusCode::RANGE_NOT_SATISFIABLE);
    assert_eq!(refusal(patch("5-9", "abc").await).await, refused(400, "SIZE_INVALID"));
    assert_eq!(
        refusal(patch("bytes 5-9/10", "abcde").await).await,
        refused(400, "BLOB_UPLOAD_INVALID")
    );

    let status = registry.get(&upload).await;
    assert_eq!(
        (status.status(), header(&status, "range")),
        (StatusCode::NO_CONTENT, "0-4".to_owned())
    );
    let elsewhere = upload.replace("/v2/a/", "/v2/b/");
    assert_eq!(refusal(registry.get(&elsewhere).await).await, refused(404, "BLOB_UPLOAD_UNKNOWN"));

    let digest = Digest::of(b"hello world");
    let last = registry
        .ask(Method::PUT, &format!("{upload}?digest={digest}"))
        .header("content-range", "5-10");
    let answer = last.body(" world").send().await.expect("an answer");
    assert_eq!(
        (answer.status(), header(&answer, "docker-content-digest")),
        (StatusCode::CREATED, digest.to_string())
    );
    assert_eq!(
        registry.get(&header(&answer, "location")).await.text().await.expect("text"),
        "hello world"
    );
    assert_eq!(registry.status(Method::GET, &upload).await, StatusCode::NOT_FOUND);
}

async fn wrong_bytes_and_cancelled_uploads_leave_nothing() {
    let registry = TestRegistry::start().await;
    let digest = Digest::of(b"announced");
    let path = format!("/v2/a/blobs/uploads/?digest={digest}");
    let answer = registry.ask(Method::POST, &path).body("sent").send().await.expect("an answer");
    assert_eq!(refusal(answer).await, refused(400, "DIGEST_INVALID"));
    assert_eq!(
        registry.status(Method::HEAD, &format!("/v2/a/blobs/{digest}")).await,
        StatusCode::NOT_FOUND
    );

    let upload = registry.begin("a").await;
    for bad in
        [upload.clone(), format!("{upload}?digest=sha512:00"), format!("{upload}?digest=sha256:00")]
    {
        let answer = registry.ask(Method::PUT, &bad).body("x").send().await.expect("an answer");
        assert_eq!(refusal(answer).await, refused(400, "DIGEST_INVALID"), "{bad}");
    }
    assert_eq!(registry.status(Method::DELETE, &upload).await, StatusCode::NO_CONTENT);
    let answer = registry.ask(Method::PATCH, &upload).body("x").send().await.expect("an answer");
    assert_eq!(refusal(answer).await, refused(404, "BLOB_UPLOAD_UNKNOWN"));
    let uploads = std::fs::read_dir(registry.data.path().join("uploads")).expect("a directory");
    assert_eq!(uploads.count(), 0);
}

async fn upload_limits_are_enforced() {
    let settings = BlobSettings { max_blob_bytes: 1000, max_uploads: 1, ..BlobSettings::default() };
    let registry = TestRegistry::start_with(settings, Some(operator())).await;
    let left = registry.begin("a").await;
    let upload = registry.begin("a").await;
    assert_eq!(
        refusal(registry.get(&left).await).await,
        refused(404, "BLOB_UPLOAD_UNKNOWN"),
        "it gave way"
    );
    let (sender, chunks) = tokio::sync::mpsc::channel::<Result<Vec<u8>, std::io::Error>>(1);
    let body = reqwest::Body::wrap_stream(tokio_stream::wrappers::ReceiverStream::new(chunks));
    let writing = tokio::spawn(registry.ask(Method::PATCH, &upload).body(body).send());
    sender.send(Ok(b"some".to_vec())).await.expect("read");
    while registry.status(Method::GET, &upload).await != StatusCode::CONFLICT {
        tokio::task::yield_now().await;
    }
    let second =
        registry.ask(Method::POST, "/v2/a/blobs/uploads/").send().await.expect("an answer");
    assert_eq!(
        refusal(second).await,
        refused(429, "TOOMANYREQUESTS"),
        "the only one is written to"
    );
    drop(sender);
    assert_eq!(writing.await.expect("no panic").expect("an answer").status(), StatusCode::ACCEPTED);

    let announced =
        registry.ask(Method::PATCH, &upload).body(vec![0; 1001]).send().await.expect("an answer");
    assert_eq!(refusal(announced).await, refused(413, "SIZE_INVALID"));
    let pieces =
        futures_util::stream::iter((0..11).map(|_| Ok::<_, std::io::Error>(vec![0_u8; 100])));
    let streamed = registry.ask(Method::PATCH, &upload).body(reqwest::Body::wrap_stream(pieces));
    assert_eq!(
        refusal(streamed.send().await.expect("an answer")).await,
        refused(413, "SIZE_INVALID")
    );
    assert_eq!(
        registry.status(Method::GET, &upload).await,
        StatusCode::NOT_FOUND,
        "nothing of it is kept"
    );

    let large =
        registry.ask(Method::PUT, "/v2/a/manifests/x").body(vec![b' '; 4 * 1024 * 1024 + 1]);
    assert_eq!(refusal(large.send().await.expect("an answer")).await, refused(413, "SIZE_INVALID"));
}

async fn concurrent_pushes_of_one_blob_store_it_once() {
    let registry = TestRegistry::start().await;
    let bytes = vec![7; 300_000];
    let pushes = (0..8).map(|_| registry.push_blob("a", &bytes));
    let blobs = futures_util::future::join_all(pushes).await;
    let answer = registry.get(&format!("/v2/a/blobs/{}", blobs[0].digest)).await;
    assert!(answer.bytes().await.expect("a body") == bytes);
}

async fn blob_mount_succeeds_or_starts_an_upload() {
    let registry = TestRegistry::start().await;
    let digest = registry.push_blob("from", b"x").await.digest;
    let mount = async |query: &str| {
        registry.status(Method::POST, &format!("/v2/to/blobs/uploads/?{query}")).await
    };
    assert_eq!(mount(&format!("mount={digest}&from=other")).await, StatusCode::ACCEPTED);
    assert_eq!(
        registry.status(Method::HEAD, &format!("/v2/to/blobs/{digest}")).await,
        StatusCode::NOT_FOUND
    );
    assert_eq!(mount(&format!("mount={digest}&from=from")).await, StatusCode::CREATED);
    assert_eq!(
        registry.status(Method::HEAD, &format!("/v2/to/blobs/{digest}")).await,
        StatusCode::OK
    );

    let delete = async |repository: &str| {
        registry.status(Method::DELETE, &format!("/v2/{repository}/blobs/{digest}")).await
    };
    assert_eq!(
        (delete("to").await, delete("to").await),
        (StatusCode::ACCEPTED, StatusCode::NOT_FOUND)
    );
    assert_eq!(
        registry.status(Method::GET, &format!("/v2/from/blobs/{digest}")).await,
        StatusCode::OK
    );
}

async fn manifest_is_stored_byte_for_byte_under_digest_and_tag() {
    let registry = TestRegistry::start().await;
    let digest = registry.push_image("a/b", "v1").await;
    for reference in ["v1".to_owned(), digest.to_string()] {
        let answer = registry.get(&format!("/v2/a/b/manifests/{reference}")).await;
        assert_eq!(header(&answer, "content-type"), MANIFEST_TYPE);
        assert_eq!(header(&answer, "docker-content-digest"), digest.to_string());
        assert_eq!(Digest::of(&answer.bytes().await.expect("a body")), digest);
    }
    // The tag goes alone, the manifest with all its tags.
    assert_eq!(registry.status(Method::DELETE, "/v2/a/b/manifests/v1").await, StatusCode::ACCEPTED);
    assert_eq!(registry.status(Method::GET, "/v2/a/b/manifests/v1").await, StatusCode::NOT_FOUND);
    assert_eq!(registry.push_image("a/b", "v1").await, digest);
    let by_digest = format!("/v2/a/b/manifests/{digest}");
    assert_eq!(registry.status(Method::DELETE, &by_digest).await, StatusCode::ACCEPTED);
    for path in [by_digest.as_str(), "/v2/a/b/manifests/v1", "/v2/a/b/manifests/.not-a-tag"] {
        assert_eq!(
            refusal(registry.get(path).await).await,
            refused(404, "MANIFEST_UNKNOWN"),
            "{path}"
        );
    }
}

async fn invalid_manifest_is_refused_with_a_reason() {
    let registry = TestRegistry::start().await;
    let config = registry.push_blob("a", b"{}").await;
    let missing = BlobRef { digest: Digest::of(b"missing"), size: 7 };
    let good = image(config, config);
    let put = async |reference: &str, media_type: &str, manifest: &Value| {
        refusal(
            registry
                .put_manifest(&format!("/v2/a/manifests/{reference}"), media_type, manifest)
                .await,
        )
        .await
    };
    let invalid = refused(400, "MANIFEST_INVALID");
    assert_eq!(
        put("v1", MANIFEST_TYPE, &image(config, missing)).await,
        refused(400, "MANIFEST_BLOB_UNKNOWN")
    );
    assert_eq!(
        put(&missing.digest.to_string(), MANIFEST_TYPE, &good).await,
        refused(400, "DIGEST_INVALID")
    );
    assert_eq!(put("-x", MANIFEST_TYPE, &good).await, refused(400, "TAG_INVALID"));
    assert_eq!(put("v1", INDEX_TYPE, &good).await, invalid);
    assert_eq!(put("v1", MANIFEST_TYPE, &json!({ "schemaVersion": 2 })).await, invalid);
    assert_eq!(put("v1", MANIFEST_TYPE, &json!([])).await, invalid);
    for (key, value) in [
        ("artifactType", json!("application/x-\0")),
        ("subject", json!({ "mediaType": MANIFEST_TYPE, "digest": "sha256:\0" })),
    ] {
        let mut manifest = good.clone();
        manifest[key] = value;
        assert_eq!(put("v1", MANIFEST_TYPE, &manifest).await, invalid, "{key}");
    }
    assert_eq!(put("v1", "", &json!({ "mediaType": "application/x-\n" })).await, invalid);
    let entry = json!({ "mediaType": MANIFEST_TYPE, "digest": missing.digest });
    let index = json!({ "schemaVersion": 2, "manifests": [entry] });
    assert_eq!(put("v1", INDEX_TYPE, &index).await, refused(400, "MANIFEST_BLOB_UNKNOWN"));
    let name = registry.put_manifest("/v2/A/manifests/v1", MANIFEST_TYPE, &good).await;
    assert_eq!(refusal(name).await, refused(400, "NAME_INVALID"));
    // Unknown content is kept all the same.
    let foreign = registry
        .put_manifest("/v2/a/manifests/v1", "application/x-foreign+json", &json!({ "x": 1 }))
        .await;
    assert_eq!(foreign.status(), StatusCode::CREATED);
}

async fn manifest_with_a_page_type_is_served_as_bytes() {
    let registry = TestRegistry::start().await;
    let Registry { store, blobs, .. } = &registry.registry;
    let page = "<script>fetch('/api/v1/users')</script>";
    let digest = blobs.put(Algorithm::Sha256, page.into(), 0).await.expect("stored");
    let new = NewManifest {
        manifest: StoredManifest {
            digest,
            size: page.len() as u64,
            media_type: "text/html".to_owned(),
        },
        artifact_type: None,
        annotations: Default::default(),
        subject: None,
        parts: Vec::new(),
        tags: vec!["old".parse().expect("a tag")],
        takes_version: false,
        package: None,
        output: None,
        document: None,
    };
    let put = store.manifests().put(&"a".parse().expect("a name"), &new, None, NOW_MS).await;
    assert_eq!(put.expect("writes"), PutManifest::Stored);
    let answer = registry.get("/v2/a/manifests/old").await;
    assert_eq!(header(&answer, "content-type"), "application/octet-stream");
    assert_eq!(answer.text().await.expect("text"), page);
}

async fn concurrent_pushes_to_one_tag_leave_one_manifest() {
    let registry = TestRegistry::start().await;
    let images = [registry.push_image("a", "one").await, registry.push_image("a", "two").await];
    let bodies =
        [registry.get("/v2/a/manifests/one").await, registry.get("/v2/a/manifests/two").await];
    let bodies = futures_util::future::join_all(bodies.map(Response::bytes)).await;
    let pushes = (0..20).map(|at| {
        let body = bodies[at % 2].as_ref().expect("a body").clone();
        registry
            .ask(Method::PUT, "/v2/a/manifests/latest")
            .header("content-type", MANIFEST_TYPE)
            .body(body)
            .send()
    });
    for answer in futures_util::future::join_all(pushes).await {
        assert_eq!(answer.expect("an answer").status(), StatusCode::CREATED);
    }
    let latest = registry.get("/v2/a/manifests/latest").await;
    let digest: Digest = header(&latest, "docker-content-digest").parse().expect("a digest");
    assert!(images.contains(&digest));
    assert_eq!(Digest::of(&latest.bytes().await.expect("a body")), digest);
}

/// Where a list goes on.
fn following(answer: &Response) -> Option<String> {
    let link = answer.headers().get("link")?.to_str().expect("text");
    let (path, _) = link.trim_start_matches('<').split_once(">; rel=\"next\"").expect("a link");
    Some(path.to_owned())
}

async fn tags_are_listed_in_pages() {
    let registry = TestRegistry::start().await;
    assert_eq!(refusal(registry.get("/v2/a/tags/list").await).await, refused(404, "NAME_UNKNOWN"));
    for tag in ["b", "B", "a", "c_1", "C"] {
        registry.push_image("a", tag).await;
    }
    let mut seen = Vec::new();
    let mut next = "/v2/a/tags/list?n=2".to_owned();
    loop {
        let answer = registry.get(&next).await;
        let following = following(&answer);
        let body: Value = answer.json().await.expect("JSON");
        assert_eq!(body["name"], "a");
        let tags = body["tags"].as_array().expect("a list").clone();
        assert!(tags.len() <= 2);
        seen.extend(tags);
        let Some(following) = following else { break };
        next = following;
    }
    assert_eq!(seen, ["B", "C", "a", "b", "c_1"]);
    let none: Value = registry.get("/v2/a/tags/list?n=0").await.json().await.expect("JSON");
    assert_eq!(none["tags"], json!([]));
    assert_eq!(
        refusal(registry.get("/v2/a/tags/list?n=-1").await).await,
        refused(400, "UNSUPPORTED")
    );
}

async fn referrers_are_listed_by_subject_and_type() {
    let registry = TestRegistry::start().await;
    let blob = registry.push_blob("a", b"{}").await;
    let subject =
        json!({ "mediaType": MANIFEST_TYPE, "digest": Digest::of(b"not here"), "size": 8 });
    for kind in ["application/x-one", "application/x-two"] {
        let mut manifest = image(blob, blob);
        manifest["subject"] = subject.clone();
        manifest["artifactType"] = json!(kind);
        manifest["annotations"] = json!({ "kind": kind });
        let answer = registry
            .put_manifest(&format!("/v2/a/manifests/{}", &kind[14..]), MANIFEST_TYPE, &manifest)
            .await;
        assert_eq!(header(&answer, "oci-subject"), subject["digest"].as_str().expect("text"));
    }
    let path = format!("/v2/a/referrers/{}", subject["digest"].as_str().expect("text"));
    let all: Value = registry.get(&path).await.json().await.expect("JSON");
    assert_eq!(all["manifests"].as_array().expect("a list").len(), 2);
    let filtered = registry.get(&format!("{path}?artifactType=application/x-one")).await;
    assert_eq!(header(&filtered, "oci-filters-applied"), "artifactType");
    assert_eq!(header(&filtered, "content-type"), INDEX_TYPE);
    let filtered: Value = filtered.json().await.expect("JSON");
    let one = &filtered["manifests"].as_array().expect("a list")[..];
    assert_eq!((one.len(), &one[0]["annotations"]["kind"]), (1, &json!("application/x-one")));
    let nothing: Value =
        registry.get(&format!("/v2/b/referrers/{}", blob.digest)).await.json().await.expect("JSON");
    assert_eq!(nothing["manifests"], json!([]));
    assert_eq!(
        refusal(registry.get("/v2/a/referrers/x").await).await,
        refused(400, "DIGEST_INVALID")
    );
}

/// Stores a manifest that refers to `subject` as it was possible before there was a limit.
async fn put_referrer(
    registry: &TestRegistry,
    number: usize,
    kind: &str,
    subject: Digest,
    annotation: String,
) {
    let digest = Digest::of(format!("referrer {number}").as_bytes());
    let new = NewManifest {
        manifest: StoredManifest { digest, size: 1, media_type: MANIFEST_TYPE.to_owned() },
        artifact_type: Some(kind.to_owned()),
        annotations: [("note".to_owned(), annotation)].into(),
        subject: Some(subject.to_string()),
        parts: Vec::new(),
        tags: Vec::new(),
        takes_version: false,
        package: None,
        output: None,
        document: None,
    };
    let repository: RepositoryName = "a".parse().expect("a name");
    let put = registry.registry.store.manifests().put(&repository, &new, None, NOW_MS).await;
    assert_eq!(put.expect("writes"), PutManifest::Stored);
}

async fn referrers_come_in_pages(database: TestDatabase) {
    let data = tempfile::tempdir().expect("a directory");
    let store = database.store.clone();
    let registry =
        TestRegistry::start_on(store, data, BlobSettings::default(), Some(operator())).await;
    let (many, large) = (Digest::of(b"many"), Digest::of(b"large"));
    for number in 0..90 {
        let kind = if number < 80 { "application/x-one+json" } else { "application/x-two" };
        put_referrer(&registry, number, kind, many, "x".repeat(60_000)).await;
    }
    for number in 90..92 {
        put_referrer(&registry, number, "application/x-one+json", large, "x".repeat(5_000_000))
            .await;
    }
    for (subject, filter, pages) in [
        (many, "", vec![69, 21]),
        (many, "?artifactType=application%2Fx-one%2Bjson", vec![69, 11]),
        (many, "?artifactType=application/x-two", vec![10]),
        (large, "", vec![1, 1]),
    ] {
        let (mut seen, mut counts) = (Vec::new(), Vec::new());
        let mut next = Some(format!("/v2/a/referrers/{subject}{filter}"));
        while let Some(path) = next {
            let answer = registry.get(&path).await;
            next = following(&answer);
            assert_eq!(
                answer.headers().contains_key("oci-filters-applied"),
                !filter.is_empty(),
                "{path}"
            );
            let body = answer.text().await.expect("text");
            assert!(body.len() < 6 << 20, "{path}: {} bytes", body.len());
            let index: Value = serde_json::from_str(&body).expect("JSON");
            let manifests = index["manifests"].as_array().expect("a list");
            counts.push(manifests.len());
            let digest = |manifest: &Value| manifest["digest"].as_str().expect("text").to_owned();
            seen.extend(manifests.iter().map(digest));
        }
        assert_eq!(counts, pages, "{filter}");
        assert!(seen.is_sorted_by(|one, next| one < next), "each once");
    }
    for nonsense in ["last=x", "artifactType=%00"] {
        let path = format!("/v2/a/referrers/{many}?{nonsense}");
        let status = registry.status(Method::GET, &path).await;
        assert_eq!(status, StatusCode::BAD_REQUEST, "{nonsense}");
    }
}

async fn annotations_of_referrers_are_bounded() {
    let registry = TestRegistry::start().await;
    let blob = registry.push_blob("a", b"{}").await;
    let mut manifest = image(blob, blob);
    manifest["annotations"] = json!({ "note": "x".repeat(64 * 1024 - 3) });
    let alone = registry.put_manifest("/v2/a/manifests/alone", MANIFEST_TYPE, &manifest).await;
    assert_eq!(alone.status(), StatusCode::CREATED, "nothing repeats them");
    manifest["subject"] =
        json!({ "mediaType": MANIFEST_TYPE, "digest": blob.digest, "size": blob.size });
    let answer = registry.put_manifest("/v2/a/manifests/long", MANIFEST_TYPE, &manifest).await;
    assert_eq!(answer.status(), StatusCode::BAD_REQUEST);
    let body: Value = answer.json().await.expect("an error body");
    assert_eq!(body["errors"][0]["code"], "MANIFEST_INVALID");
    let message = body["errors"][0]["message"].as_str().expect("text");
    assert!(message.starts_with("annotations: 65537 bytes"), "{message}");
    manifest["annotations"] = json!({ "note": "x".repeat(64 * 1024 - 4) });
    let fits = registry.put_manifest("/v2/a/manifests/long", MANIFEST_TYPE, &manifest).await;
    assert_eq!(fits.status(), StatusCode::CREATED);
}
