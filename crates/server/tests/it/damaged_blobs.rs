//! Blob files that lose their bytes while they are served, as by a failing disk: a truncated file's
//! mapped pages raise the same signal as a sector that cannot be read.

use std::fs;

use reqwest::{Method, StatusCode};
use task_proto::Digest;
use tempfile::TempDir;

use crate::corruption::eventually;
use crate::harness::TestServer;

/// More than the buffers of a connection hold.
const BLOB_BYTES: usize = 64 * 1024 * 1024;

async fn push(server: &TestServer, digest: &Digest, bytes: Vec<u8>) {
    let begun =
        server.request(Method::POST, "/v2/worn/blobs/uploads/").send().await.expect("an answer");
    assert_eq!(begun.status(), StatusCode::ACCEPTED);
    let upload = begun.headers()["location"].to_str().expect("text").to_owned();
    let put =
        server.request(Method::PUT, &upload).query(&[("digest", digest.to_string())]).body(bytes);
    assert_eq!(put.send().await.expect("an answer").status(), StatusCode::CREATED);
}

#[tokio::test(flavor = "multi_thread")]
async fn truncated_blob_ends_one_answer_and_can_be_pushed_again() {
    for encrypts in [false, true] {
        let directory = TempDir::new().expect("a directory");
        let server =
            TestServer::start_in(directory, |config| config.tls.private_ca = Some(encrypts)).await;
        let bytes = vec![b'x'; BLOB_BYTES];
        let digest = Digest::of(&bytes);
        push(&server, &digest, bytes.clone()).await;
        let path = format!("/v2/worn/blobs/{digest}");
        let file = server.data().join("blobs/sha256").join(digest.hex());

        let mut answer = server.request(Method::GET, &path).send().await.expect("an answer");
        assert_eq!(answer.status(), StatusCode::OK);
        let mut came = answer.chunk().await.expect("begun").expect("some").len();
        fs::File::options()
            .write(true)
            .open(&file)
            .expect("the blob's file")
            .set_len(0)
            .expect("truncated");
        let broken_off = loop {
            match answer.chunk().await {
                Ok(Some(chunk)) => came += chunk.len(),
                Ok(None) => break false,
                Err(_) => break true,
            }
        };
        assert!(broken_off && came < BLOB_BYTES, "{came} bytes came, encrypted: {encrypts}");

        // The server lives. The first request that reads the file again triggers a check; then the
        // blob counts as absent.
        eventually("the blob to be absent", async || {
            let answer = server.request(Method::GET, &path).send().await;
            answer.is_ok_and(|answer| answer.status() == StatusCode::NOT_FOUND)
        })
        .await;
        assert!(file.with_extension("damaged").exists() && !file.exists());
        push(&server, &digest, bytes.clone()).await;
        let answer = server.request(Method::GET, &path).send().await.expect("an answer");
        assert!(answer.bytes().await.expect("whole") == bytes);
    }
}
