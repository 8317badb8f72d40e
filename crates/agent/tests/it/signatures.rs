//! Signature checks of packages, against a real HTTP server with or without the publishers'
//! signatures.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use axum::Router;
use axum::extract::{Path, State};
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use task_agent::config::Config;
use task_agent::config::trust::{PackageUse, Trust, TrustSettings};
use task_agent::install::fetch::{FetchSettings, Fetcher};
use task_agent::install::signature_policy::{SignatureError, SignaturePolicy};
use task_agent::reconcile::robot::Robot as Body;
use task_agent::system::layout::DataDir;
use task_agent::task::effects::Effects as _;
use task_agent::task::observed::SignatureVerdict;
use task_agent::task::run::{ActiveRun, ProcessRecord, RunRules};
use task_agent::telemetry::outputs::Registry;
use task_agent::transfer::credential::Credential;
use task_agent::transfer::parts::PartSubscriptions;
use task_proto::desired::{
    BlobRef, DesiredState, DesiredTask, Evidence, PackageRef, SignatureRef, TargetState,
};
use task_proto::messages::report::{FailureCode, Progress};
use task_proto::packages::manifest::TaskManifest;
use task_proto::packages::publisher::{MAX_SIGNATURE_BYTES, PackageStatement, PublisherList, Role};
use task_proto::trust::envelope::{DESIRED_STATE_TYPE, Envelope, SigningKey};
use task_proto::{DeploymentId, Digest, Generation, RobotId};
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

use crate::harness::{eventually, within};
use crate::site::BLOB_UNKNOWN;

/// The server's objects, by digest, and the requests for them.
#[derive(Default)]
struct Shelf {
    blobs: HashMap<String, Vec<u8>>,
    asked: Vec<String>,
    is_away: bool,
}

/// A robot that asks for two of the publishers 1, 2 and 3; the keeper is 7.
struct Robot {
    shelf: Arc<Mutex<Shelf>>,
    signature_policy: Arc<SignaturePolicy>,
    server: reqwest::Url,
    dir: tempfile::TempDir,
}

fn key(seed: u8) -> SigningKey {
    SigningKey::from_bytes([seed; 32])
}

fn role(seeds: &[u8], threshold: u32) -> Role {
    Role::new(seeds.iter().map(|seed| key(*seed).public_key()).collect(), threshold).unwrap()
}

fn package(name: &str) -> PackageRef {
    let blob = |part: &str| BlobRef::of(format!("{name} {part}").as_bytes());
    PackageRef {
        name: name.parse().unwrap(),
        version: "1.0".parse().unwrap(),
        manifest: blob("manifest"),
        config: blob("config"),
        content: blob("content"),
    }
}

fn signature(seed: u8, package: &PackageRef) -> Envelope {
    PackageStatement { package: package.clone() }.seal(&key(seed))
}

fn list(version: u64, publishers: &[u8]) -> Envelope {
    let list = PublisherList {
        version,
        issued_at_ms: 1,
        expires_at_ms: u64::MAX,
        publishers: role(publishers, 1),
        keepers: role(&[7], 1),
        withdrawn: Vec::new(),
    };
    list.seal(&key(7))
}

fn order(package: &PackageRef) -> DesiredTask {
    DesiredTask {
        task: package.name.clone(),
        deployment: DeploymentId::random(),
        package: package.clone(),
        wanted: TargetState::Running,
        run: 1,
        delivery: Default::default(),
        priority: 0,
    }
}

fn rules() -> RunRules {
    let manifest = serde_json::json!({
        "name": "talker", "version": "1.0", "run": { "exec": ["true"] },
        "content": { "tar_digest": Digest::of(b""), "tar_size": 0, "entries": 0 },
    });
    RunRules::from(&serde_json::from_value::<TaskManifest>(manifest).unwrap())
}

/// The first run of a package, before its start.
fn first_run(package: &PackageRef) -> ActiveRun {
    let process = ProcessRecord {
        dir: "d.1.1.1".to_owned(),
        boot_id: "boot".to_owned(),
        started_ms: 1,
        pid: None,
    };
    ActiveRun::of(&order(package), rules(), 0).begin(process)
}

async fn answer(State(shelf): State<Arc<Mutex<Shelf>>>, Path(path): Path<String>) -> Response {
    let mut shelf = shelf.lock().unwrap();
    shelf.asked.push(path.clone());
    if shelf.is_away {
        return (StatusCode::SERVICE_UNAVAILABLE, [(header::RETRY_AFTER, "0")]).into_response();
    }
    let digest = path.rsplit('/').next().unwrap().to_owned();
    match shelf.blobs.get(&digest) {
        Some(bytes) => ([("docker-content-digest", digest)], bytes.clone()).into_response(),
        None => (StatusCode::NOT_FOUND, BLOB_UNKNOWN).into_response(),
    }
}

impl Robot {
    async fn new() -> Self {
        let shelf: Arc<Mutex<Shelf>> = Arc::default();
        let router = Router::new().route("/v2/{*path}", get(answer)).with_state(shelf.clone());
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let server: reqwest::Url =
            format!("http://{}/", listener.local_addr().unwrap()).parse().unwrap();
        tokio::spawn(async move { axum::serve(listener, router).await });
        let dir = tempfile::tempdir().unwrap();
        let signature_policy = Self::signature_policy(&server, &dir);
        Self { shelf, signature_policy, server, dir }
    }

    fn signature_policy(server: &reqwest::Url, dir: &tempfile::TempDir) -> Arc<SignaturePolicy> {
        let data = DataDir::new(dir.path()).unwrap();
        let _ = rustls::crypto::ring::default_provider().install_default();
        let client = reqwest::Client::builder().no_proxy().build().unwrap();
        let settings =
            FetchSettings { stall_timeout: Duration::from_secs(20), ..FetchSettings::default() };
        let fetcher =
            Fetcher::new(client, server.clone(), "token".to_owned(), data.clone(), settings);
        let trusted = TrustSettings {
            publishers: role(&[1, 2, 3], 2),
            keepers: role(&[7], 1),
            requires_list: false,
        };
        let trust = Trust::open(trusted, data.publishers());
        Arc::new(SignaturePolicy::new(trust, Arc::new(fetcher), data))
    }

    fn config(&self) -> Config {
        let keys =
            [("TASK_AGENT_TRUSTED_PUBLISHERS_KEYS".into(), key(1).public_key().to_string().into())];
        Config::load(self.dir.path(), keys.into_iter()).unwrap()
    }

    /// All of a robot, which trusts publisher 1.
    fn body(&self) -> Body {
        let data = DataDir::new(self.dir.path()).unwrap();
        let client = reqwest::Client::builder().no_proxy().build().unwrap();
        let (token, settings) = (Credential::from("token".to_owned()), FetchSettings::default());
        let fetcher = Fetcher::new(
            client.clone(),
            self.server.clone(),
            token.clone(),
            data.clone(),
            settings,
        );
        let registry = Registry::new(client, self.server.clone(), token);
        let mac = "02:00:00:00:00:01".parse().unwrap();
        let parts = (fetcher, PartSubscriptions::default());
        Body::new(data, parts, registry, &self.config(), &RobotId::random(), mac)
    }

    fn restart(&mut self) {
        self.signature_policy = Self::signature_policy(&self.server, &self.dir);
    }

    /// Puts a document on the server's shelf.
    fn shelve(&self, envelope: &Envelope) -> BlobRef {
        let bytes = serde_json::to_vec(envelope).unwrap();
        let blob = BlobRef::of(&bytes);
        self.shelf.lock().unwrap().blobs.insert(blob.digest.to_string(), bytes);
        blob
    }

    /// The server names these.
    fn told(&self, package: &PackageRef, lists: &[&Envelope], signatures: &[&Envelope]) {
        let manifest = package.manifest.digest;
        self.told_of(
            package,
            Evidence {
                lists: lists.iter().map(|list| self.shelve(list)).collect(),
                signatures: signatures
                    .iter()
                    .map(|signature| SignatureRef { manifest, envelope: self.shelve(signature) })
                    .collect(),
            },
        );
    }

    fn told_of(&self, package: &PackageRef, evidence: Evidence) {
        self.signature_policy.follow_evidence(&DesiredState {
            robot_id: RobotId::random(),
            generation: Generation(1),
            issued_at_ms: 0,
            expires_at_ms: u64::MAX,
            tasks: vec![order(package)],
            evidence,
            settings: Default::default(),
            robot: Default::default(),
        });
    }

    async fn ensure_trusted(&self, package: &PackageRef) -> Result<(), SignatureError> {
        within(
            "a judgement",
            self.signature_policy.ensure_trusted(
                package,
                PackageUse::New,
                &CancellationToken::new(),
            ),
        )
        .await
    }

    fn asked(&self) -> usize {
        std::mem::take(&mut self.shelf.lock().unwrap().asked).len()
    }

    fn is_away(&self, is_away: bool) {
        self.shelf.lock().unwrap().is_away = is_away;
    }
}

#[tokio::test]
async fn signatures_are_pulled_and_count_without_the_server_from_then_on() {
    let (mut robot, talker) = (Robot::new().await, package("talker"));
    let [ada, bob, eve] = [1, 2, 9].map(|seed| signature(seed, &talker));
    robot.told(&talker, &[], &[&eve, &ada]);
    let error = robot.ensure_trusted(&talker).await.unwrap_err().to_string();
    assert!(error.starts_with("signed by 1 of the 2 required trusted publishers"), "{error}");
    assert_eq!(robot.signature_policy.verdict(&talker), SignatureVerdict::Insufficient);
    robot.told(&talker, &[], &[&eve, &ada, &bob]);
    robot.ensure_trusted(&talker).await.unwrap();
    assert_eq!(robot.signature_policy.verdict(&talker), SignatureVerdict::Sufficient);
    robot.asked();
    robot.is_away(true);
    robot.restart();
    robot.ensure_trusted(&talker).await.unwrap();
    assert_eq!(
        (robot.signature_policy.verdict(&talker), robot.asked()),
        (SignatureVerdict::Sufficient, 0)
    );
}

#[tokio::test]
async fn signature_fetch_retries_an_unreachable_server_only() {
    let (robot, talker) = (Robot::new().await, package("talker"));
    let [ada, bob] = [1, 2].map(|seed| signature(seed, &talker));
    robot.is_away(true);
    robot.told(&talker, &[], &[&ada, &bob]);
    let error = robot.ensure_trusted(&talker).await.unwrap_err();
    assert!(matches!(&error, SignatureError::Fetch(error) if error.is_retryable()), "{error:?}");
    robot.is_away(false);
    robot.shelf.lock().unwrap().blobs.clear();
    let error = robot.ensure_trusted(&talker).await.unwrap_err();
    assert!(matches!(error, SignatureError::Distrusted(_)), "{error:?}");
}

#[tokio::test]
async fn oversized_signature_is_not_requested() {
    let (robot, talker) = (Robot::new().await, package("talker"));
    let endless = BlobRef { digest: Digest::of(b"endless"), size: MAX_SIGNATURE_BYTES + 1 };
    let signatures = vec![SignatureRef { manifest: talker.manifest.digest, envelope: endless }];
    robot.told_of(&talker, Evidence { lists: Vec::new(), signatures });
    assert!(robot.ensure_trusted(&talker).await.is_err());
    // No more bytes are read than were announced, even if more arrive.
    let ada = signature(1, &talker);
    let short = BlobRef { size: 10, ..robot.shelve(&ada) };
    let signatures = vec![SignatureRef { manifest: talker.manifest.digest, envelope: short }];
    assert_eq!(robot.asked(), 0);
    robot.told_of(&talker, Evidence { lists: Vec::new(), signatures });
    assert!(robot.ensure_trusted(&talker).await.is_err());
    assert_eq!(robot.asked(), 3, "as often as for a flipped byte");
}

#[tokio::test]
async fn newer_publisher_list_is_followed_without_an_order() {
    let (mut robot, talker) = (Robot::new().await, package("talker"));
    let [ada, eve] = [1, 9].map(|seed| signature(seed, &talker));
    let (first, second) = (list(1, &[1]), list(2, &[9]));
    robot.told(&talker, &[&first], &[&ada]);
    robot.ensure_trusted(&talker).await.unwrap();
    assert_eq!(robot.signature_policy.version(), 1);
    assert_eq!(
        robot.signature_policy.facts().refused_list,
        None,
        "the following and the waiting robot have both received it"
    );
    let epoch = robot.signature_policy.facts().epoch;
    robot.told(&talker, &[&first, &second], &[&ada]);
    eventually("the second list to be followed", || {
        (robot.signature_policy.version() == 2).then_some(())
    })
    .await;
    assert_ne!(robot.signature_policy.facts().epoch, epoch, "what was judged is judged anew");
    assert_eq!(
        robot.signature_policy.verdict(&talker),
        SignatureVerdict::Insufficient,
        "its publisher is revoked"
    );
    // A server that was taken over, or put back from a copy, names the first again.
    robot.restart();
    robot.told(&talker, &[&first], &[&ada]);
    let refused =
        eventually("the first to be refused", || robot.signature_policy.facts().refused_list).await;
    assert!(refused.contains("its version 1 is not newer than the known version 2"), "{refused}");
    assert!(robot.ensure_trusted(&talker).await.is_err());
    robot.told(&talker, &[&first, &second], &[&eve]);
    robot.ensure_trusted(&talker).await.unwrap();
}

#[tokio::test]
async fn unavailable_publisher_list_is_reported_and_retried() {
    let (robot, talker) = (Robot::new().await, package("talker"));
    let [ada, bob] = [1, 2].map(|seed| signature(seed, &talker));
    robot.told(&talker, &[&list(1, &[1])], &[&ada]);
    robot.ensure_trusted(&talker).await.unwrap();
    // A machine in between answers in the server's place.
    let revoking = list(2, &[2]);
    let lists = vec![robot.shelve(&list(1, &[1])), robot.shelve(&revoking)];
    robot.shelf.lock().unwrap().blobs.clear();
    robot.told_of(&talker, Evidence { lists, signatures: Vec::new() });
    let said = eventually("it to be told", || robot.signature_policy.facts().refused_list).await;
    assert!(said.contains("cannot fetch the list of publishers"), "{said}");
    robot.shelve(&revoking);
    eventually("the second list to be followed", || {
        (robot.signature_policy.version() == 2).then_some(())
    })
    .await;
    assert_eq!(
        (robot.signature_policy.facts().refused_list, robot.signature_policy.verdict(&talker)),
        (None, SignatureVerdict::Insufficient)
    );
    robot.told(&talker, &[&revoking], &[&bob]);
    robot.ensure_trusted(&talker).await.unwrap();
}

#[tokio::test]
async fn installed_package_gets_new_signatures_without_an_order() {
    let (robot, talker) = (Robot::new().await, package("talker"));
    let [ada, eve] = [1, 9].map(|seed| signature(seed, &talker));
    robot.told(&talker, &[&list(1, &[1])], &[&ada]);
    robot.ensure_trusted(&talker).await.unwrap();
    let src = DataDir::new(robot.dir.path())
        .unwrap()
        .task(&talker.name)
        .version(&talker.manifest.digest)
        .src();
    std::fs::create_dir_all(src).unwrap();
    robot.told(&talker, &[&list(1, &[1]), &list(2, &[9])], &[&ada, &eve]);
    let signatures = || {
        (robot.signature_policy.version() == 2
            && robot.signature_policy.verdict(&talker) == SignatureVerdict::Sufficient)
            .then_some(())
    };
    eventually("the new signature to be there", signatures).await;
}

#[tokio::test]
async fn publisher_list_of_other_signers_is_refused_and_reported() {
    let (robot, talker) = (Robot::new().await, package("talker"));
    let forged = PublisherList {
        version: 5,
        issued_at_ms: 1,
        expires_at_ms: u64::MAX,
        publishers: role(&[9], 1),
        keepers: role(&[9], 1),
        withdrawn: Vec::new(),
    };
    let eve = signature(9, &talker);
    robot.told(&talker, &[&forged.seal(&key(9))], &[&eve]);
    assert!(robot.ensure_trusted(&talker).await.is_err());
    let refused = robot.signature_policy.facts().refused_list.unwrap();
    assert!(refused.contains("signed by 0 of the 1 required keepers"), "{refused}");
    assert_eq!(robot.signature_policy.version(), 0);
    // Nor does an envelope that was signed as another type.
    let other = Envelope::seal(DESIRED_STATE_TYPE, &serde_json::to_vec(&forged).unwrap(), &key(7));
    robot.told(&talker, &[&other], &[&eve]);
    assert!(robot.ensure_trusted(&talker).await.is_err());
    assert_eq!(robot.signature_policy.version(), 0);
}

#[tokio::test]
async fn steps_recheck_trust_and_do_nothing_if_revoked() {
    let (site, talker) = (Robot::new().await, package("talker"));
    let robot = site.body();
    let (cancel, progress) =
        (CancellationToken::new(), watch::Sender::new(Progress { done: 0, total: 0 }));
    let part_requests = watch::Sender::default();
    let run = first_run(&talker);
    let outcomes = [
        robot.check_signers(&talker, &cancel).await,
        robot.pull_manifest(&talker, &cancel).await.map(drop),
        robot.pull_content(&talker, &progress, &cancel).await.map(drop),
        robot.gather_content(&talker, &progress, &part_requests, &cancel).await.map(drop),
        robot.build(&talker, &DeploymentId::random(), &cancel).await,
        robot.start(&talker.name, &run).await.map(drop),
    ];
    for (at, outcome) in outcomes.into_iter().enumerate() {
        let refused = outcome.unwrap_err();
        assert_eq!(
            refused.failure.code,
            FailureCode::UNTRUSTED_PACKAGE,
            "{at}: {}",
            refused.failure
        );
        // A package planned on another judgement is judged again; the deciding judgement is final.
        assert_eq!(refused.retry_after_ms.is_none(), matches!(at, 0 | 5), "{at}");
    }
    assert_eq!(site.asked(), 0, "nothing was fetched");
    assert_eq!(robot.prepared(&talker).await.signatures, SignatureVerdict::Insufficient);
}

#[tokio::test]
async fn expired_publisher_list_blocks_first_starts_but_not_restarts() {
    let (site, talker) = (Robot::new().await, package("talker"));
    let data = DataDir::new(site.dir.path()).unwrap();
    let over = PublisherList {
        version: 1,
        issued_at_ms: 1,
        expires_at_ms: 2,
        publishers: role(&[1], 1),
        keepers: role(&[1], 1),
        withdrawn: Vec::new(),
    };
    let over = over.seal(&key(1));
    let trust = Trust::open(site.config().trust.unwrap(), data.publishers());
    trust.accept_list(&over, Digest::of(b"list")).unwrap();
    let signatures = data.task(&talker.name).signatures(&talker.manifest.digest);
    task_agent::config::trust::write_signatures(&signatures, &[&signature(1, &talker)]).unwrap();
    let (robot, first) = (site.body(), first_run(&talker));
    assert_eq!(robot.prepared(&talker).await.signatures, SignatureVerdict::Stale);
    assert!(robot.trust_facts().list_expired, "which is looked at again and again");
    let start =
        async |run: &ActiveRun| robot.start(&talker.name, run).await.unwrap_err().failure.code;
    assert_eq!(start(&first).await, FailureCode::PUBLISHERS_EXPIRED);
    // A restart gets as far as the manifest, which is absent here.
    let again = first.known_started();
    assert_eq!(start(&again).await, FailureCode::PACKAGE_UNAVAILABLE);
}
