//! Packages that the server pushes as parts: through the agent's real session, from a peer and a
//! server that misbehave.

use std::fs;
use std::sync::Arc;
use std::time::Duration;

use task_agent::config::MqttTransport;
use task_agent::install::fetch::{FetchError, FetchSettings, PartTimeouts};
use task_agent::link::mqtt::{self, MqttAccess, Routes};
use task_agent::link::state::{LinkState, MqttChannels};
use task_agent::system::clock;
use task_agent::transfer::credential::Credential;
use task_agent::transfer::parts::PartRequest;
use task_proto::messages::part::{Part, PartLayout, PartRange};
use task_proto::messages::report::{Progress, Status};
use task_proto::messages::topic::{Topic, TopicPrefix};
use task_proto::{InstanceId, RobotId};
use task_transport::Trust;
use tokio::sync::{mpsc, watch};
use tokio_util::sync::CancellationToken;

use crate::archive::tar;
use crate::harness::{eventually, within};
use crate::peer::Peer;
use crate::site::{Answer, Site, settings};

const PART_BYTES: u32 = 64 * 1024;
const LONG: Duration = Duration::from_secs(600);

/// Nothing is asked for and nothing given up.
fn patient() -> FetchSettings {
    FetchSettings {
        parts: PartTimeouts { silence: LONG, no_subscription: LONG, no_progress: LONG },
        ..settings()
    }
}

fn with(parts: PartTimeouts) -> FetchSettings {
    FetchSettings { parts, ..settings() }
}

/// A package, its pusher, and an agent's session between them.
struct Rig {
    site: Arc<Site>,
    peer: Peer,
    link_state: LinkState,
    progress: watch::Sender<Progress>,
    part_requests: watch::Sender<PartRequest>,
    cut: PartLayout,
}

type Pull = tokio::task::JoinHandle<Result<(), FetchError>>;

impl Rig {
    async fn new(settings: FetchSettings) -> Self {
        Self::of(Site::with(&tar(), settings).await).await
    }

    async fn of(site: Site) -> Self {
        let (peer, link_state) = (Peer::start().await, LinkState::new(CancellationToken::new()));
        let tls = Trust::System.client_config(clock::for_certificates());
        let access = MqttAccess {
            host: "127.0.0.1".to_owned(),
            port: peer.port,
            prefix: TopicPrefix::default(),
            robot: RobotId::random(),
            token: Credential::from("token".to_owned()),
            status: Status {
                online: true,
                start: 1,
                instance: InstanceId::random(),
                connection: 0,
                place: None,
            },
            message_bytes: mqtt::MESSAGE_BYTES,
            routes: Routes::new(
                &"http://127.0.0.1".parse().unwrap(),
                Arc::new(tls),
                MqttTransport::Tcp,
            ),
        };
        let (server_messages, _) = mpsc::channel(1);
        let (requests, _) = mpsc::channel(1);
        let channels =
            MqttChannels { requests, messages: mpsc::channel(1).1, lines: mpsc::channel(1).1 };
        tokio::spawn(mqtt::run(access, link_state.clone(), server_messages, channels));
        let cut = PartLayout::new(site.content.len() as u64, PART_BYTES).unwrap();
        let progress = watch::Sender::new(Progress { done: 0, total: 0 });
        Self {
            site: Arc::new(site),
            peer,
            link_state,
            progress,
            part_requests: watch::Sender::default(),
            cut,
        }
    }

    fn start_pull(&self, cancel: &CancellationToken) -> Pull {
        let (site, link_state, cancel) =
            (self.site.clone(), self.link_state.clone(), cancel.clone());
        let (progress, part_requests) = (self.progress.clone(), self.part_requests.clone());
        tokio::spawn(async move {
            let (package, manifest) = (&site.package, &site.manifest);
            site.fetcher
                .pushed_content(
                    package,
                    manifest,
                    &link_state.part_subscriptions,
                    (&progress, &part_requests),
                    &cancel,
                )
                .await
        })
    }

    /// Gathers, and waits until it hears.
    async fn listen(&self) -> Pull {
        let pull = self.start_pull(&CancellationToken::new());
        self.peer.subscribed(&self.topic()).await;
        self.asked(&[]).await;
        pull
    }

    fn topic(&self) -> String {
        TopicPrefix::default().format(&Topic::Package(self.site.package.content.digest))
    }

    fn message(&self, index: u32) -> Vec<u8> {
        let range = self.cut.range(index);
        let bytes = &self.site.content[range.start as usize..range.end as usize];
        Part { index, count: self.cut.count(), part_bytes: PART_BYTES, bytes }.encode()
    }

    fn push(&self, parts: impl IntoIterator<Item = u32>) {
        parts
            .into_iter()
            .for_each(|index| self.peer.publish(&self.topic(), 1, &self.message(index)));
    }

    /// Waits until this number of bytes has arrived.
    async fn has(&self, bytes: u64) {
        let mut progress = self.progress.subscribe();
        within("the parts", progress.wait_for(|progress| progress.done == bytes)).await.unwrap();
    }

    /// Waits until the agent asks for these parts.
    async fn asked(&self, ranges: &[(u32, u32)]) {
        let ranges: Vec<PartRange> =
            ranges.iter().map(|&(from, to)| PartRange { from, to }).collect();
        let mut part_requests = self.part_requests.subscribe();
        within(
            "the missing parts",
            part_requests.wait_for(|part_requests| part_requests.missing.as_ref() == Some(&ranges)),
        )
        .await
        .unwrap();
    }

    async fn ends_well(&self, pull: Pull) {
        within("the package", pull).await.unwrap().unwrap();
        self.site.assert_in_place();
        for path in [
            self.site.data.blob_parts(&self.digest()),
            self.site.data.blob_parts_note(&self.digest()),
        ] {
            assert!(!path.exists(), "{} is left", path.display());
        }
        assert_eq!(self.part_requests.borrow().missing, None);
        let topic = self.topic();
        self.peer.until("the end of the subscription", |seen| !seen.topics.contains(&topic)).await;
    }

    fn digest(&self) -> task_proto::Digest {
        self.site.package.content.digest
    }
}

impl Drop for Rig {
    fn drop(&mut self) {
        self.link_state.shutdown.cancel();
    }
}

#[tokio::test]
async fn pushed_content_is_installed_without_a_pull_at_every_qos() {
    for qos in [0, 1, 2] {
        let rig = Rig::new(patient()).await;
        let pull = rig.listen().await;
        let before = rig.peer.seen.borrow().acknowledged;
        // In any order.
        for index in (0..rig.cut.count()).rev() {
            rig.peer.publish(&rig.topic(), qos, &rig.message(index));
        }
        rig.ends_well(pull).await;
        assert_eq!(rig.site.asked(), [0; 0]);
        let size = rig.site.content.len() as u64;
        assert_eq!(*rig.progress.borrow(), Progress { done: size, total: size });
        if qos > 0 {
            let all = before + rig.cut.count();
            rig.peer.until("every acknowledgement", |seen| seen.acknowledged == all).await;
        }
    }
}

#[tokio::test]
async fn missing_parts_are_requested() {
    let timeouts = PartTimeouts {
        silence: Duration::from_millis(300),
        no_subscription: LONG,
        no_progress: LONG,
    };
    let rig = Rig::new(with(timeouts)).await;
    let pull = rig.listen().await;
    // The number of parts is still unknown.
    rig.asked(&[(0, u32::MAX)]).await;
    // The agent joined late: parts sent earlier are requested at once, a gap only after a quiet
    // period.
    rig.push([10]);
    rig.asked(&[(0, 9)]).await;
    rig.push((11..rig.cut.count()).filter(|&index| index != 20));
    rig.asked(&[(0, 9), (20, 20)]).await;
    let times = rig.part_requests.borrow().times;
    let mut part_requests = rig.part_requests.subscribe();
    within("it asks again", part_requests.wait_for(|part_requests| part_requests.times > times))
        .await
        .unwrap();
    assert_eq!(rig.part_requests.borrow().missing.as_ref().unwrap().len(), 2);
    rig.push(0..5);
    rig.asked(&[(5, 9), (20, 20)]).await;
    rig.push((5..10).chain([20]));
    rig.ends_well(pull).await;
    assert_eq!(rig.site.asked(), [0; 0]);
}

#[tokio::test]
async fn hostile_part_messages_are_ignored() {
    let rig = Rig::new(patient()).await;
    let pull = rig.listen().await;
    let good = rig.message(3);
    let altered = |at: usize, bytes: &[u8]| {
        let mut message = good.clone();
        message[at..at + bytes.len()].copy_from_slice(bytes);
        message
    };
    let other_cut = {
        let cut = PartLayout::new(rig.site.content.len() as u64, 4096).unwrap();
        Part { index: 0, count: cut.count(), part_bytes: 4096, bytes: &[7; 4096] }.encode()
    };
    rig.push([0]);
    for hostile in [
        Vec::new(),
        good[..13].to_vec(),
        good[..14].to_vec(),
        good[..good.len() - 1].to_vec(),
        [&good[..], b"x"].concat(),
        altered(0, &[2]),
        altered(2, &rig.cut.count().to_be_bytes()),
        altered(2, &u32::MAX.to_be_bytes()),
        altered(6, &0u32.to_be_bytes()),
        altered(6, &u32::MAX.to_be_bytes()),
        altered(10, &0u32.to_be_bytes()),
        altered(10, &1u32.to_be_bytes()),
        altered(10, &u32::MAX.to_be_bytes()),
        other_cut,
        vec![1; 1_000_000],
    ] {
        rig.peer.publish(&rig.topic(), 1, &hostile);
    }
    // A part of another package, and a part that is present already, with other bytes.
    rig.peer.publish("taskd/v1/p/sha256:00", 1, &good);
    rig.peer.publish("taskd/v1/r/r00000000000000a1/desired", 1, b"{");
    let double = Part {
        index: 0,
        count: rig.cut.count(),
        part_bytes: PART_BYTES,
        bytes: &[7; PART_BYTES as usize],
    };
    rig.peer.publish(&rig.topic(), 1, &double.encode());
    rig.push(0..rig.cut.count());
    rig.ends_well(pull).await;
    assert_eq!(rig.site.asked(), [0; 0]);
    assert_eq!(rig.peer.seen.borrow().sessions, 1);
}

#[tokio::test]
async fn wrong_bytes_are_found_by_the_digest_and_pulled() {
    let rig = Rig::new(patient()).await;
    let pull = rig.listen().await;
    let wrong = Part {
        index: 5,
        count: rig.cut.count(),
        part_bytes: PART_BYTES,
        bytes: &[7; PART_BYTES as usize],
    };
    rig.peer.publish(&rig.topic(), 1, &wrong.encode());
    rig.push(0..rig.cut.count());
    rig.ends_well(pull).await;
    assert_eq!(rig.site.asked(), [0]);
}

#[tokio::test]
async fn undelivered_parts_are_pulled_from_the_first_gap() {
    let no_progress = PartTimeouts { no_progress: Duration::from_millis(500), ..patient().parts };
    let rig = Rig::new(with(no_progress)).await;
    let pull = rig.listen().await;
    rig.push((0..7).chain(9..20));
    rig.ends_well(pull).await;
    assert_eq!(rig.site.asked(), [7 * u64::from(PART_BYTES)]);
    assert_eq!(rig.link_state.meter.facts(tokio::time::Instant::now()).unwrap().reconnects, 0);
}

#[tokio::test]
async fn refused_subscription_is_retried_for_a_limited_time() {
    let no_subscription =
        PartTimeouts { no_subscription: Duration::from_secs(4), ..patient().parts };
    let rig = Rig::new(with(no_subscription)).await;
    rig.peer.allows_parts.send_replace(false);
    let pull = rig.start_pull(&CancellationToken::new());
    rig.peer.until("a refusal", |seen| seen.refused > 0).await;
    rig.peer.allows_parts.send_replace(true);
    rig.peer.subscribed(&rig.topic()).await;
    rig.push(0..rig.cut.count());
    rig.ends_well(pull).await;
    assert_eq!(rig.site.asked(), [0; 0]);

    let no_subscription =
        PartTimeouts { no_subscription: Duration::from_millis(100), ..patient().parts };
    let rig = Rig::new(with(no_subscription)).await;
    rig.peer.allows_parts.send_replace(false);
    within("the pull", rig.start_pull(&CancellationToken::new())).await.unwrap().unwrap();
    rig.site.assert_in_place();
    assert_eq!(rig.site.asked(), [0]);
}

#[tokio::test]
async fn missing_session_pulls_at_once_but_a_short_loss_waits() {
    let site = Site::with(&tar(), patient()).await;
    let part_subscriptions = task_agent::transfer::parts::PartSubscriptions::default();
    part_subscriptions.set_session_up(false);
    let (progress, part_requests) =
        (watch::Sender::new(Progress { done: 0, total: 0 }), watch::Sender::default());
    let cancel = CancellationToken::new();
    let senders = (&progress, &part_requests);
    let pull = site.fetcher.pushed_content(
        &site.package,
        &site.manifest,
        &part_subscriptions,
        senders,
        &cancel,
    );
    within("the pull", pull).await.unwrap();
    site.assert_in_place();

    let rig = Rig::new(patient()).await;
    let pull = rig.listen().await;
    rig.push(0..5);
    rig.has(5 * u64::from(PART_BYTES)).await;
    rig.peer.cut();
    rig.peer.until("another session", |seen| seen.sessions == 2).await;
    rig.peer.subscribed(&rig.topic()).await;
    rig.push(5..rig.cut.count());
    rig.ends_well(pull).await;
    assert_eq!(rig.site.asked(), [0; 0]);
    assert_eq!(rig.link_state.meter.facts(tokio::time::Instant::now()).unwrap().reconnects, 1);
}

/// Half of the parts are present when the agent ends; returns the state from which the next agent
/// continues.
async fn ended_half_way() -> Rig {
    let mut rig = Rig::new(patient()).await;
    let cancel = CancellationToken::new();
    let pull = rig.start_pull(&cancel);
    rig.peer.subscribed(&rig.topic()).await;
    rig.push((0..20).filter(|&index| index != 4));
    rig.has(19 * u64::from(PART_BYTES)).await;
    cancel.cancel();
    let ended = within("the end", pull).await.unwrap();
    assert!(matches!(ended, Err(FetchError::Cancelled)), "{ended:?}");
    let topic = rig.topic();
    rig.peer.until("the end of the subscription", |seen| !seen.topics.contains(&topic)).await;
    let alone = || Arc::get_mut(&mut rig.site).map(|site| site.restart(patient()));
    eventually("nobody else has the site", alone).await;
    rig.progress.send_replace(Progress { done: 0, total: 0 });
    rig
}

#[tokio::test]
async fn restarted_agent_continues_with_stored_parts() {
    let rig = ended_half_way().await;
    let pull = rig.listen().await;
    rig.has(19 * u64::from(PART_BYTES)).await;
    rig.push([20]);
    rig.asked(&[(4, 4)]).await;
    rig.push((21..rig.cut.count()).chain([4]));
    rig.ends_well(pull).await;
    assert_eq!(rig.site.asked(), [0; 0]);
}

#[tokio::test]
async fn parts_torn_by_a_power_cut_are_pulled() {
    let rig = ended_half_way().await;
    let path = rig.site.data.blob_parts(&rig.digest());
    let mut bytes = fs::read(&path).unwrap();
    bytes[100_000..104_096].fill(0);
    fs::write(&path, bytes).unwrap();
    let pull = rig.listen().await;
    rig.push((20..rig.cut.count()).chain([4]));
    rig.ends_well(pull).await;
    assert_eq!(rig.site.asked(), [0]);
}

#[tokio::test]
async fn restarted_agent_with_all_parts_needs_no_transfer() {
    let rig = ended_half_way().await;
    fs::write(rig.site.data.blob_parts(&rig.digest()), &rig.site.content).unwrap();
    let bits = vec![0xff; 8 * rig.cut.count().div_ceil(64) as usize];
    let note = [b"pt1\n", &PART_BYTES.to_be_bytes()[..], &bits].concat();
    fs::write(rig.site.data.blob_parts_note(&rig.digest()), note).unwrap();
    rig.peer.allows_parts.send_replace(false);
    rig.ends_well(rig.start_pull(&CancellationToken::new())).await;
    assert_eq!(rig.site.asked(), [0; 0]);
}

#[tokio::test]
async fn invalid_part_note_is_ignored() {
    for spoil in [b"pt1\n".to_vec(), vec![0xff; 300], vec![0; 1 << 20]] {
        let rig = ended_half_way().await;
        fs::write(rig.site.data.blob_parts_note(&rig.digest()), spoil).unwrap();
        let pull = rig.listen().await;
        assert_eq!(rig.progress.borrow().done, 0);
        rig.push(0..rig.cut.count());
        rig.ends_well(pull).await;
        assert_eq!(rig.site.asked(), [0; 0]);
    }
}

#[tokio::test]
async fn pull_continues_from_stored_parts() {
    let rig = ended_half_way().await;
    let (progress, cancel) =
        (watch::Sender::new(Progress { done: 0, total: 0 }), CancellationToken::new());
    // As when the server has told the robot to pull.
    rig.site.answers([Answer::Well]);
    rig.site
        .fetcher
        .content(&rig.site.package, &rig.site.manifest, &progress, &cancel)
        .await
        .unwrap();
    rig.site.assert_in_place();
    assert_eq!(rig.site.asked(), [4 * u64::from(PART_BYTES)]);
    assert!(!rig.site.data.blob_parts(&rig.digest()).exists());
}

#[tokio::test]
async fn insufficient_disk_space_is_reported_before_a_push() {
    let rig = Rig::new(FetchSettings { reserve_bytes: u64::MAX, ..patient() }).await;
    let error = within("the refusal", rig.start_pull(&CancellationToken::new()))
        .await
        .unwrap()
        .unwrap_err();
    assert!(matches!(error, FetchError::DiskFull(_)), "{error:?}");
    assert!(!rig.site.data.blob_parts(&rig.digest()).exists());
    assert_eq!((rig.site.asked(), rig.part_requests.borrow().times), (Vec::new(), 0));
}

#[tokio::test]
async fn slow_writer_stops_part_delivery() {
    let rig = Rig::new(patient()).await;
    let mut part_receiver =
        rig.link_state.part_subscriptions.subscribe(rig.digest(), rig.site.content.len() as u64);
    rig.peer.subscribed(&rig.topic()).await;
    let before = rig.peer.seen.borrow().acknowledged;
    rig.push(0..rig.cut.count());
    let first = within("a part", part_receiver.parts.recv()).await.unwrap();
    eventually("the queue is full", || {
        (part_receiver.parts.len() == part_receiver.parts.max_capacity()).then_some(())
    })
    .await;
    assert_eq!(rig.peer.seen.borrow().acknowledged, before, "nothing was written");
    drop(first);
    for _ in 1..rig.cut.count() {
        drop(within("a part", part_receiver.parts.recv()).await.unwrap());
    }
    let all = before + rig.cut.count();
    rig.peer.until("every acknowledgement", |seen| seen.acknowledged == all).await;
}

#[tokio::test]
async fn package_in_one_message_is_accepted() {
    let rig = Rig::new(patient()).await;
    let pull = rig.listen().await;
    let size = u32::try_from(rig.site.content.len()).unwrap();
    assert!(rig.site.content.len() > mqtt::MESSAGE_BYTES);
    let whole = Part { index: 0, count: 1, part_bytes: size, bytes: &rig.site.content }.encode();
    // The session can't read the part; the next one can, because this package is wanted.
    rig.peer.publish(&rig.topic(), 1, &whole);
    rig.peer.until("another session", |seen| seen.sessions == 2).await;
    rig.peer.subscribed(&rig.topic()).await;
    rig.peer.publish(&rig.topic(), 1, &whole);
    rig.ends_well(pull).await;
    assert_eq!(rig.site.asked(), [0; 0]);
}

#[tokio::test]
async fn oversized_unwanted_message_ends_the_session() {
    let rig = Rig::new(patient()).await;
    rig.peer.until("a session", |seen| seen.topics.len() == 2).await;
    rig.peer.publish(&rig.topic(), 1, &vec![0; 2 * mqtt::MESSAGE_BYTES]);
    rig.peer.until("another session", |seen| seen.sessions == 2 && seen.topics.len() == 2).await;
    assert_eq!(rig.link_state.meter.facts(tokio::time::Instant::now()).unwrap().reconnects, 1);
}
