//! Pulls against a real HTTP server that misbehaves in every way a network or a server can.

use std::fs;
use std::sync::atomic::Ordering;
use std::time::Duration;

use axum::body::Bytes;
use task_agent::install::fetch::{FetchError, FetchSettings, Fetcher};
use task_agent::transfer::link_meter::LinkMeter;
use task_proto::Digest;
use task_proto::messages::report::{FailureCode, Progress};
use task_proto::packages::manifest::ContentFacts;
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

use crate::archive::{Tar, compress, noise, tar};
use crate::flips::Fault;
use crate::site::{Answer, Site, TOKEN, client, settings};

#[tokio::test]
async fn package_is_placed_once() {
    let site = Site::new(&tar()).await;
    let manifest = site.fetcher.manifest(&site.package, &CancellationToken::new()).await.unwrap();
    assert_eq!(manifest, site.manifest);
    let progress = watch::Sender::new(Progress { done: 0, total: 0 });
    site.fetcher
        .content(&site.package, &manifest, &progress, &CancellationToken::new())
        .await
        .unwrap();
    site.assert_in_place();
    let size = site.content.len() as u64;
    assert_eq!(*progress.borrow(), Progress { done: size, total: size });
    assert_eq!(site.asked().len(), 2);

    site.fetcher.manifest(&site.package, &CancellationToken::new()).await.unwrap();
    site.pull().await.unwrap();
    assert_eq!(site.asked(), [0; 0], "present blobs are not pulled again");
    fs::write(site.version().manifest(), "{}").unwrap();
    assert_eq!(
        site.fetcher.manifest(&site.package, &CancellationToken::new()).await.unwrap(),
        manifest
    );
}

#[tokio::test]
async fn package_in_several_frames_gets_its_place() {
    let tar = tar();
    let (head, tail) = tar.bytes.split_at(tar.bytes.len() / 2 + 1);
    let skippable = [&0x184D_2A50_u32.to_le_bytes()[..], &3_u32.to_le_bytes(), b"any"].concat();
    let content = [compress(head), skippable, compress(tail)].concat();
    let site = Site::with_content(content, tar.facts(), settings()).await;
    site.pull().await.unwrap();
    site.assert_in_place();
}

#[tokio::test]
async fn archive_with_another_tar_digest_is_refused_and_leaves_nothing() {
    let tar = tar();
    let facts = ContentFacts { tar_digest: Digest::of(b"another archive"), ..tar.facts() };
    let site = Site::with_content(tar.compressed(), facts, settings()).await;
    let Err(FetchError::ArchiveRefused(refusal)) = site.pull().await else {
        panic!("it is in place")
    };
    assert!(refusal.to_string().contains("content.tar_digest"), "{refusal}");
    site.assert_nothing_staged();
    assert!(!site.version().src().exists() && !site.part().exists());
}

#[tokio::test]
async fn interrupted_download_continues_within_the_pull() {
    let site = Site::new(&tar()).await;
    site.answers([Answer::Cut(1 << 20), Answer::Cut(1 << 20)]);
    site.pull().await.unwrap();
    site.assert_in_place();
    let asked = site.asked();
    assert_eq!((asked.len(), asked[0]), (3, 0));
    assert!(asked[1] > 0 && asked[2] > asked[1], "{asked:?}");
}

#[tokio::test]
async fn repeated_cuts_do_not_end_a_progressing_pull() {
    let often = 2 * 5;
    // The same over and over would compress to nothing.
    let noise = noise();
    let parts = (0..6u8)
        .flat_map(|part| noise.iter().map(move |byte| byte.rotate_left(part.into()) ^ part));
    let site = Site::new(&Tar::default().file("data", &parts.collect::<Vec<_>>()).end()).await;
    site.answers((0..often).map(|_| Answer::Cut(3 << 19)));
    site.pull().await.unwrap();
    assert_eq!(site.asked().len(), often + 1);
}

#[tokio::test]
async fn dropped_pull_resumes_at_its_offset() {
    let site = Site::new(&tar()).await;
    site.answers([Answer::Stall(2 << 20)]);
    let progress = watch::Sender::new(Progress { done: 0, total: 0 });
    let cancel = CancellationToken::new();
    let mut arrived = progress.subscribe();
    let content = site.fetcher.content(&site.package, &site.manifest, &progress, &cancel);
    tokio::select! {
        result = content => panic!("{result:?}"),
        _ = arrived.wait_for(|progress| progress.done == 2 << 20) => {}
    }
    site.pull().await.unwrap();
    site.assert_in_place();
    assert_eq!(site.asked(), [0, 2 << 20]);
}

#[tokio::test]
async fn cancelled_pull_leaves_only_the_part_file() {
    let site = Site::new(&tar()).await;
    site.answers([Answer::Stall(1 << 20)]);
    let progress = watch::Sender::new(Progress { done: 0, total: 0 });
    let cancel = CancellationToken::new();
    let mut arrived = progress.subscribe();
    let (result, _) = tokio::join!(
        site.fetcher.content(&site.package, &site.manifest, &progress, &cancel),
        async {
            arrived.wait_for(|progress| progress.done == 1 << 20).await.unwrap();
            cancel.cancel();
        }
    );
    assert!(matches!(result, Err(FetchError::Cancelled)), "{result:?}");
    assert_eq!(fs::read(site.part()).unwrap(), site.content[..1 << 20]);
    site.assert_nothing_staged();
    assert!(!site.version().src().exists());
}

#[tokio::test]
async fn partial_file_is_replayed_with_any_range_support() {
    for (answers, asked) in [
        (vec![], vec![1 << 20]),
        (vec![Answer::IgnoreRange], vec![1 << 20]),
        (vec![Answer::Status(416, vec![])], vec![1 << 20, 0]),
        (vec![Answer::OtherRange], vec![1 << 20, 0]),
    ] {
        let site = Site::new(&tar()).await;
        site.put_part(&site.content[..1 << 20]);
        site.answers(answers);
        site.pull().await.unwrap();
        site.assert_in_place();
        assert_eq!(site.asked(), asked);
    }
}

#[tokio::test]
async fn complete_partial_file_needs_no_server() {
    let site = Site::new(&tar()).await;
    site.put_part(&site.content);
    site.pull().await.unwrap();
    site.assert_in_place();
    assert_eq!(site.asked(), [0; 0]);
}

#[tokio::test]
async fn corrupt_partial_file_is_discarded() {
    let zeros = vec![0; 1 << 20];
    for spoiled in [zeros.clone(), [noise(), noise()].concat(), vec![0; tar().compressed().len()]] {
        let site = Site::new(&tar()).await;
        site.put_part(&spoiled);
        site.pull().await.unwrap();
        site.assert_in_place();
        assert_eq!(site.asked().last(), Some(&0));
    }
}

#[tokio::test]
async fn wrong_bytes_are_discarded() {
    let size = tar().compressed().len() as u64;
    for answer in
        [Answer::OtherBytes, Answer::Endless, Answer::Length(size - 1), Answer::Length(size + 1)]
    {
        let site = Site::new(&tar()).await;
        site.answers(vec![answer.clone(); 200]);
        let error = site.pull().await.unwrap_err();
        assert!(matches!(error, FetchError::DigestMismatch { .. }), "{answer:?}: {error:?}");
        assert_eq!(
            (error.code(), error.is_retryable()),
            (Some(FailureCode::DIGEST_MISMATCH), true)
        );
        assert_eq!(error.retry_after(), Some(Duration::from_secs(60)));
        assert!(error.to_string().ends_with("the server's copy is damaged"), "{error}");
        assert!(!site.part().exists() && !site.version().src().exists());
        site.assert_nothing_staged();
    }
}

#[tokio::test]
async fn content_heals_whose_first_transfer_has_a_flipped_byte() {
    let mut site = Site::new(&tar()).await;
    let flipped = site.behind_flips(|connection| (connection == 0).then_some(1 << 20)).await;
    site.pull().await.unwrap();
    site.assert_in_place();
    assert_eq!((flipped.load(Ordering::Relaxed), site.asked()), (1, vec![0, 0]));
}

#[tokio::test]
async fn content_heals_where_every_long_transfer_has_a_flipped_byte() {
    // Once at another place each time, once always at the same.
    for fault in [|connection| Some(600_000 + 1013 * connection), |_| Some(600_000)] as [Fault; 2] {
        let mut site = Site::new(&tar()).await;
        let flipped = site.behind_flips(fault).await;
        site.pull().await.unwrap();
        site.assert_in_place();
        assert_eq!(
            flipped.load(Ordering::Relaxed),
            3,
            "each transfer of the whole, and none of a range"
        );
    }
}

#[tokio::test]
async fn content_heals_where_ranges_have_flipped_bytes_as_well() {
    let mut site = Site::new(&tar()).await;
    let flipped = site.behind_flips(|_| Some(100_000)).await;
    site.pull().await.unwrap();
    site.assert_in_place();
    assert!(flipped.load(Ordering::Relaxed) > 20);
}

#[tokio::test]
async fn content_whose_pushed_bytes_are_wrong_is_pulled() {
    let site = Site::new(&tar()).await;
    let mut parts = site.content.clone();
    parts[100] ^= 1;
    site.put_part(&parts);
    site.pull().await.unwrap();
    site.assert_in_place();
    assert_eq!(site.asked(), [0]);
}

#[tokio::test]
async fn manifest_heals_whose_first_transfers_have_a_flipped_byte() {
    let cancel = CancellationToken::new();
    let first_two: Fault = |connection| (connection < 2).then_some(10);
    let mut site = Site::new(&tar()).await;
    let flipped = site.behind_flips(first_two).await;
    let manifest = site.fetcher.manifest(&site.package, &cancel).await.unwrap();
    assert_eq!(manifest, site.manifest);
    assert!(flipped.load(Ordering::Relaxed) > 0);

    let site = Site::new(&tar()).await;
    site.answers(vec![Answer::OtherBytes; 100]);
    let error = site.fetcher.manifest(&site.package, &cancel).await.unwrap_err();
    assert_eq!(
        (error.code(), error.is_retryable()),
        (Some(FailureCode::DIGEST_MISMATCH), true),
        "{error}"
    );
    assert!(!site.version().manifest().exists());
}

#[tokio::test]
async fn blob_reported_missing_once_is_requested_again() {
    let site = Site::new(&tar()).await;
    site.answers([Answer::Refused(404)]);
    site.pull().await.unwrap();
    assert_eq!(site.asked(), [0, 0]);
}

#[tokio::test]
async fn answer_of_another_server_counts_as_unreachable() {
    let login = vec![("location", "/login")];
    let mut answers = vec![
        Answer::Html(200),
        Answer::Html(404),
        Answer::Html(302),
        Answer::Anonymous,
        Answer::Status(204, login),
    ];
    // A proxy during a restart of its server.
    answers.extend(
        [403, 404, 410, 451]
            .map(|status| Answer::Status(status, vec![("content-type", "text/plain")])),
    );
    for answer in answers {
        let site = Site::new(&tar()).await;
        site.put_part(&site.content[..1000]);
        site.answers([answer.clone()]);
        let error = site.pull().await.unwrap_err();
        assert!(matches!(error, FetchError::NotTheServer(_)), "{answer:?}: {error:?}");
        assert_eq!(
            (error.code(), error.is_retryable()),
            (Some(FailureCode::SERVER_UNREACHABLE), true)
        );
        assert_eq!(fs::metadata(site.part()).unwrap().len(), 1000);
    }
}

#[tokio::test]
async fn http_status_decides_whether_to_retry() {
    let seconds = |seconds| Some(Duration::from_secs(seconds));
    for (status, retry_after, code, retryable, wait) in [
        (503, Some("7"), FailureCode::SERVER_UNREACHABLE, true, seconds(7)),
        (429, Some("999999"), FailureCode::SERVER_UNREACHABLE, true, seconds(3600)),
        (500, Some("Fri, 31 Dec 1999 23:59:59 GMT"), FailureCode::SERVER_UNREACHABLE, true, None),
        (502, None, FailureCode::SERVER_UNREACHABLE, true, None),
        (401, None, FailureCode::UNAUTHORIZED, true, None),
    ] {
        let site = Site::new(&tar()).await;
        site.answers([Answer::Status(
            status,
            retry_after.map(|value| ("retry-after", value)).into_iter().collect(),
        )]);
        let error = site.pull().await.unwrap_err();
        assert_eq!(
            (error.code(), error.is_retryable(), error.retry_after()),
            (Some(code), retryable, wait),
            "{status}"
        );
    }
    for status in [403, 404, 410] {
        let site = Site::new(&tar()).await;
        site.answers(vec![Answer::Refused(status); 2]);
        let error = site.pull().await.unwrap_err();
        assert_eq!(
            (error.code(), error.is_retryable()),
            (Some(FailureCode::PACKAGE_UNAVAILABLE), false),
            "{status}"
        );
    }
}

#[tokio::test]
async fn busy_server_delays_the_pull_and_keeps_its_bytes() {
    for (answer, told) in [
        (Answer::Status(429, vec![("retry-after", "7")]), Some(7)),
        (Answer::Status(503, vec![("retry-after", "9")]), Some(9)),
        (Answer::Status(503, vec![]), None),
        (Answer::Status(500, vec![("retry-after", "9")]), None),
    ] {
        let site = Site::new(&tar()).await;
        site.answers([Answer::Cut(1 << 20), answer.clone()]);
        let progress = watch::Sender::new(Progress { done: 0, total: 0 });
        let cancel = CancellationToken::new();
        let pull = site.fetcher.content(&site.package, &site.manifest, &progress, &cancel);
        let error = pull.await.unwrap_err();
        assert_eq!(error.retry_later(), told.map(Duration::from_secs), "{answer:?}");
        let there = fs::metadata(site.part()).unwrap().len();
        assert!(there > 0);
        assert_eq!(*progress.borrow(), Progress { done: there, total: site.content.len() as u64 });
        site.pull().await.unwrap();
        site.assert_in_place();
    }
}

#[tokio::test]
async fn inline_blob_is_not_pulled() {
    let site = Site::new(&tar()).await;
    let config = serde_json::to_vec(&site.manifest).unwrap();
    let (package, cancel) = (&site.package, CancellationToken::new());
    let blobs = |config: &[u8], content: &[u8]| {
        [
            (package.config, Bytes::copy_from_slice(config)),
            (package.content, Bytes::copy_from_slice(content)),
        ]
    };
    // Others than the state names are as good as none.
    site.fetcher.add_inline_blobs(blobs(&config[1..], &site.content[1..]));
    site.answers([Answer::Status(404, vec![])]);
    assert!(site.fetcher.manifest(package, &cancel).await.is_err());
    assert_eq!(site.asked(), [0]);
    site.fetcher.add_inline_blobs(blobs(&config, &site.content));
    site.put_part(&site.content[..100]);
    assert_eq!(site.fetcher.manifest(package, &cancel).await.unwrap(), site.manifest);
    site.pull().await.unwrap();
    site.assert_in_place();
    assert_eq!(site.asked(), [0; 0]);
}

#[tokio::test]
async fn transfers_measure_the_link() {
    let mut site = Site::new(&tar()).await;
    let meter = LinkMeter::default();
    let fetcher = Fetcher::new(
        client(),
        site.server.clone(),
        TOKEN.to_owned(),
        site.data.clone(),
        settings(),
    );
    site.fetcher = fetcher.with_meter(meter.clone());
    site.answers([Answer::Cut(1 << 20)]);
    site.pull().await.unwrap();
    let facts = meter.facts(tokio::time::Instant::now()).unwrap();
    assert_eq!((facts.losses, facts.reconnects, facts.rtt_ms), (1, 0, None));
    assert!(facts.throughput_bytes_per_s > Some(0));
}

#[tokio::test]
async fn stalled_server_ends_the_pull() {
    let site = Site::with(
        &tar(),
        FetchSettings { stall_timeout: Duration::from_millis(50), ..settings() },
    )
    .await;
    site.answers(vec![Answer::Stall(0); 6]);
    let error = site.pull().await.unwrap_err();
    assert!(matches!(error, FetchError::Stalled(_)) && error.is_retryable(), "{error:?}");
}

#[tokio::test]
async fn transfer_below_the_minimum_rate_is_cut() {
    let site = Site::with(
        &tar(),
        FetchSettings { stall_timeout: Duration::from_millis(300), ..settings() },
    )
    .await;
    site.answers(vec![Answer::Drip; 6]);
    let error = site.pull().await.unwrap_err();
    assert!(matches!(error, FetchError::Stalled(_)), "{error:?}");
    assert!(site.asked().len() > 1, "it was cut and asked for anew");
}

#[tokio::test]
async fn archive_is_refused_only_if_its_bytes_match_the_digest() {
    let hostile = Tar::default().file("../escape", b"x").file("data", &noise()).end();
    let site = Site::new(&hostile).await;
    let error = site.pull().await.unwrap_err();
    assert_eq!((error.code(), error.is_retryable()), (Some(FailureCode::ARCHIVE_REFUSED), false));
    assert!(error.to_string().contains("the path has '..'"), "{error}");
    assert!(!site.part().exists() && !site.version().src().exists());
    site.assert_nothing_staged();
}

#[tokio::test]
async fn insufficient_disk_space_is_reported_before_the_transfer() {
    let site = Site::with(&tar(), FetchSettings { reserve_bytes: u64::MAX, ..settings() }).await;
    let error = site.pull().await.unwrap_err();
    assert_eq!((error.code(), error.is_retryable()), (Some(FailureCode::DISK_FULL), true));
    assert_eq!(error.retry_after(), Some(task_agent::system::disk::FULL_PAUSE));
    assert!(error.to_string().contains("in reserve"), "{error}");
    assert_eq!(site.asked(), [0; 0]);

    // Parts gathered by an earlier try only take up more of the missing room.
    site.put_part(&site.content[..100]);
    assert_eq!(site.pull().await.unwrap_err().code(), Some(FailureCode::DISK_FULL));
    assert!(!site.part().exists());
}

#[tokio::test]
async fn two_pulls_of_one_content_take_turns() {
    let site = Site::new(&tar()).await;
    let (first, second) = tokio::join!(site.pull(), site.pull());
    assert!(first.is_ok() && second.is_ok(), "{first:?} {second:?}");
    assert_eq!(site.asked(), [0]);
    site.assert_in_place();
}

#[tokio::test]
async fn manifest_of_another_package_is_refused() {
    let mut site = Site::new(&tar()).await;
    let cancel = CancellationToken::new();
    site.package.version = "2.0.0".parse().unwrap();
    let error = site.fetcher.manifest(&site.package, &cancel).await.unwrap_err();
    assert_eq!(error.code(), Some(FailureCode::MANIFEST_INVALID));
    site.package.config.size = 2 << 20;
    let error = site.fetcher.manifest(&site.package, &cancel).await.unwrap_err();
    assert!(error.to_string().contains("at most 1048576 are allowed"), "{error}");
    assert!(!site.version().manifest().exists());
}

#[tokio::test]
async fn unreachable_server_is_retried_later() {
    let site = Site::new(&tar()).await;
    let nowhere = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap().local_addr().unwrap();
    let server = format!("http://{nowhere}").parse().unwrap();
    let fetcher = Fetcher::new(client(), server, TOKEN.to_owned(), site.data.clone(), settings());
    let error = fetcher.manifest(&site.package, &CancellationToken::new()).await.unwrap_err();
    assert_eq!((error.code(), error.is_retryable()), (Some(FailureCode::SERVER_UNREACHABLE), true));
}
