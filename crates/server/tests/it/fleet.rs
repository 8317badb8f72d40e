//! A fleet without a network: orders and reports go straight to the store, and robots are values.

use std::collections::BTreeMap;
use std::ops::Deref;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use task_proto::api::{
    AddUser, CreateDeployment, CreateEnrollmentToken, CreateToken, DeploymentView, EnrollRequest,
    PackageView, RobotView,
};
use task_proto::desired::{BlobRef, DesiredState, DesiredTask, PackageRef};
use task_proto::messages::report::{HostFacts, LinkFacts, Phase, Report, TaskReport};
use task_proto::packages::manifest::{TaskKind, TaskManifest};
use task_proto::people::roles::{Role, Roles};
use task_proto::trust::envelope::{DESIRED_STATE_TYPE, SigningKey};
use task_proto::trust::token::{Token, TokenKind};
use task_proto::{DeploymentId, Digest, Generation, InstanceId, MacAddress, RobotId, UserName};
use taskd::config::DeliverySettings;
use taskd::domain::limits::robot_limiter::{RobotLimiter, RobotLimits};
use taskd::domain::person::Person;
use taskd::fleet::presence::Presence;
use taskd::fleet::robot_vitals::RobotVitals;
use taskd::http::peers::Peers;
use taskd::http::views::Views;
use taskd::orders::actions::{
    ActionSettings, Actions, DeploymentActions, Enrolled, IdempotencyKey, PersonActions,
    RobotActions, RobotError,
};
use taskd::orders::changes::Changes;
use taskd::orders::delivery_planner::{DeliveryPlanner, ServerLoad};
use taskd::orders::desired_states::{DesiredStateError, DesiredStates};
use taskd::orders::report_writer::ReportWriter;
use taskd::store::TokenHolder;
use taskd::system::clock::Clock;

use crate::database::TestDatabase;

/// The server's signing key.
pub fn key() -> SigningKey {
    SigningKey::from_bytes([7; 32])
}
/// The lifetime of signed desired states.
pub const STATE_LIFETIME_MS: u64 = 30 * 24 * 60 * 60 * 1000;
/// The number of every robot's MQTT session.
const CONNECTION: u64 = 1;

/// The same part of each server. Every use is of the next server's.
pub struct InTurns<T> {
    parts: Vec<T>,
    next: AtomicUsize,
}

impl<T> InTurns<T> {
    /// A part of each of the servers' actions.
    fn of_each(actions: &[Actions], part: impl Fn(&Actions) -> T) -> Self {
        actions.iter().map(part).collect::<Vec<_>>().into()
    }

    /// The part of one of the servers, counted from 0.
    pub fn of(&self, server: usize) -> &T {
        &self.parts[server]
    }
}

impl<T> From<Vec<T>> for InTurns<T> {
    fn from(parts: Vec<T>) -> Self {
        Self { parts, next: AtomicUsize::new(0) }
    }
}

impl<T> Deref for InTurns<T> {
    type Target = T;
    fn deref(&self) -> &T {
        &self.parts[self.next.fetch_add(1, Ordering::Relaxed) % self.parts.len()]
    }
}

/// A server's inner half with a clock that stands still, or two with one database.
pub struct Fleet {
    pub database: TestDatabase,
    pub actions: InTurns<Actions>,
    pub robots: InTurns<RobotActions>,
    pub deployments: InTurns<DeploymentActions>,
    pub people: InTurns<PersonActions>,
    pub desired_states: DesiredStates,
    pub operator: Person,
    pub writer: InTurns<ReportWriter>,
    pub clock: Clock,
    pub changes: Changes,
    pub presence: Arc<Presence>,
    pub views: Views,
    pub load: Arc<ServerLoad>,
    pub planner: DeliveryPlanner,
}

/// A robot's own view: its accepted state and its reports.
pub struct Robot {
    pub id: RobotId,
    pub start: u64,
    seq: u64,
    pub observed: Generation,
    pub tasks: BTreeMap<String, TaskReport>,
    pub link: Option<LinkFacts>,
    pub battery_percent: Option<u8>,
}

impl Fleet {
    pub async fn new(database: TestDatabase) -> Self {
        Self::with_delivery(database, &DeliverySettings::default()).await
    }

    /// A fleet whose orders are placed for at most `robots` robots in one write.
    pub async fn with_chunks(database: TestDatabase, robots: usize) -> Self {
        Self::with_settings(database, &DeliverySettings::default(), robots).await
    }

    pub async fn with_delivery(database: TestDatabase, settings: &DeliverySettings) -> Self {
        Self::with_settings(database, settings, ActionSettings::default().chunk_robots).await
    }

    async fn with_settings(
        database: TestDatabase,
        settings: &DeliverySettings,
        chunk_robots: usize,
    ) -> Self {
        let load = Arc::new(ServerLoad::default());
        let (clock, changes) = (Clock::fixed(1_000_000), Changes::new());
        let presence = Arc::new(Presence::new(90_000, clock.now_ms()));
        let planner = DeliveryPlanner::new(settings, presence.clone(), load.clone());
        let stores: Vec<_> = [&database.store].into_iter().chain(&database.second).collect();
        let writer = stores.iter().map(|&store| {
            let (clock, changes) = (clock.clone(), changes.clone());
            ReportWriter::start(store.clone(), clock, changes, planner.clone()).0
        });
        let key = Arc::new(key());
        let desired_states = DesiredStates::new(
            database.store.clone(),
            clock.clone(),
            key.clone(),
            STATE_LIFETIME_MS,
        );
        let actions = stores.iter().map(|&store| {
            Actions::new(
                store.clone(),
                clock.clone(),
                changes.clone(),
                key.clone(),
                ActionSettings {
                    enrollments_per_minute: 1_000_000,
                    chunk_robots,
                    ..ActionSettings::default()
                },
                planner.clone(),
            )
        });
        let writer = writer.collect::<Vec<_>>().into();
        let actions: Vec<Actions> = actions.collect();
        let token = Token::random(TokenKind::Operator);
        database.store.tokens().create_first(&token, clock.now_ms()).await.expect("stored");
        let operator = Person::first(token.id().parse().expect("an id"));
        let views = Views {
            store: database.store.clone(),
            presence: presence.clone(),
            robot_limiter: RobotLimiter::new(RobotLimits::default()),
            vitals: RobotVitals::default(),
            peers: Peers::default(),
            clock: clock.clone(),
        };
        Self {
            database,
            robots: InTurns::of_each(&actions, |actions| actions.robots.clone()),
            deployments: InTurns::of_each(&actions, |actions| actions.deployments.clone()),
            people: InTurns::of_each(&actions, |actions| actions.people.clone()),
            actions: actions.into(),
            desired_states,
            operator,
            writer,
            clock,
            changes,
            presence,
            views,
            load,
            planner,
        }
    }

    /// An administrator of the robots that `scope` means.
    pub async fn limited(&self, name: &str, scope: &str) -> Person {
        let user: UserName = name.parse().expect("a name");
        let scope = Some(scope.parse().expect("a selector"));
        let order =
            AddUser { name: user.clone(), roles: Roles::one(Role::Admin), scope, password: None };
        self.people.add_user(&self.operator, &order).await.expect("added");
        let order = CreateToken { user: Some(user), ..CreateToken::default() };
        let made = self.people.create_token(&self.operator, &order).await.expect("made");
        let token = made.token.parse().expect("a token");
        match self.database.store.tokens().holder(&token, self.clock.now_ms()).await.expect("reads")
        {
            Some(TokenHolder::Person(person)) => person,
            other => panic!("{other:?}"),
        }
    }

    pub async fn enrollment_token(
        &self,
        order: CreateEnrollmentToken,
    ) -> task_proto::trust::token::Token {
        let made =
            self.robots.create_enrollment_token(&self.operator, &order).await.expect("a token");
        made.token.parse().expect("a token")
    }

    pub async fn try_enroll(
        &self,
        token: &task_proto::trust::token::Token,
        mac: MacAddress,
        name: Option<&str>,
    ) -> Result<Enrolled, RobotError> {
        let name = name.map(|name| name.parse().expect("a name"));
        self.robots
            .enroll(
                token,
                &EnrollRequest { mac, name, labels: BTreeMap::new(), client_key: None },
                None,
            )
            .await
    }

    /// The robot's MQTT session begins.
    pub fn come_online(&self, robot: &RobotId) {
        self.presence.connected(robot, None, CONNECTION, self.clock.now_ms());
    }

    /// The robot's MQTT session ends.
    pub fn go_offline(&self, robot: &RobotId) {
        self.presence.disconnected(robot, CONNECTION, self.clock.now_ms());
    }

    /// Registers `count` robots named `r0`, `r1`, … that are online.
    pub async fn enroll(&self, count: u32) -> Vec<Robot> {
        let token = self
            .enrollment_token(CreateEnrollmentToken { unlimited: true, ..Default::default() })
            .await;
        let mut robots = Vec::new();
        for number in 0..count {
            let enrolled = self
                .try_enroll(&token, mac(number), Some(&format!("r{number}")))
                .await
                .expect("enrolls");
            self.come_online(&enrolled.robot_id);
            robots.push(Robot::new(enrolled.robot_id));
        }
        robots
    }

    pub async fn deploy(
        &self,
        version: &str,
        order: impl FnOnce(&mut CreateDeployment),
    ) -> DeploymentId {
        let package = package(version, TaskKind::Service);
        let mut request = order_of(&package);
        order(&mut request);
        self.deployments
            .create(&self.operator, &random_key(), &request, &package)
            .await
            .expect("ordered")
    }

    pub async fn deployment(&self, id: &DeploymentId) -> DeploymentView {
        self.views.deployment(&self.operator, id, true).await.expect("there")
    }

    /// The newest ones.
    pub async fn deployments(&self) -> Vec<DeploymentView> {
        let page = self.database.store.deployments().page(None, None, 1_000).await.expect("reads");
        let rows = page.expect("no other was named").deployments;
        rows.into_iter().map(|row| row.into_view(None)).collect()
    }

    pub async fn view(&self, robot: &Robot) -> RobotView {
        self.views.robot(&robot.id, None).await.expect("there")
    }

    /// The phases of a deployment's assignments, by robot name.
    pub async fn phases(&self, id: &DeploymentId) -> Vec<Phase> {
        let view = self.deployment(id).await;
        view.assignments
            .expect("asked for")
            .into_iter()
            .map(|assignment| assignment.phase)
            .collect()
    }

    pub async fn desired(&self, robot: &Robot) -> Result<DesiredState, DesiredStateError> {
        let desired = self.desired_states.get(&robot.id).await?;
        let key = key().public_key();
        let payload =
            desired.envelope.open(DESIRED_STATE_TYPE, &key).expect("signed by the server");
        Ok(serde_json::from_slice(&payload).expect("a desired state"))
    }

    /// The robot fetches its desired state, brings every task into `phase`, drops undesired tasks,
    /// and reports.
    pub async fn follow(&self, robot: &mut Robot, phase: Phase) {
        let desired = self.desired(robot).await.expect("not withheld");
        robot.accept(&desired, phase);
        self.report(robot).await;
    }

    pub async fn report(&self, robot: &mut Robot) -> Generation {
        self.writer.submit(robot.next_report(), 0).await.expect("stored").generation
    }
}

impl Robot {
    pub fn new(id: RobotId) -> Self {
        Self {
            id,
            start: 1,
            seq: 0,
            observed: Generation(0),
            tasks: BTreeMap::new(),
            link: None,
            battery_percent: None,
        }
    }

    pub fn accept(&mut self, desired: &DesiredState, phase: Phase) {
        self.observed = desired.generation;
        let entry = |task: &DesiredTask| (task.task.to_string(), TaskReport::of(task, phase));
        self.tasks = desired.tasks.iter().map(entry).collect();
    }

    pub fn next_report(&mut self) -> Report {
        self.seq += 1;
        Report {
            robot_id: self.id.clone(),
            start: self.start,
            instance: InstanceId::random(),
            place: None,
            boot_id: "boot".to_owned(),
            seq: self.seq,
            observed_generation: self.observed,
            uptime_ms: 1,
            host: HostFacts { battery_percent: self.battery_percent, ..HostFacts::default() },
            conditions: Vec::new(),
            link: self.link,
            tasks: self.tasks.values().cloned().collect(),
        }
    }
}

pub fn mac(number: u32) -> MacAddress {
    let [a, b, c, d] = number.to_be_bytes();
    MacAddress::from_octets([2, 0, a, b, c, d.wrapping_add(1)]).expect("a MAC")
}

pub fn random_key() -> IdempotencyKey {
    format!("{:032x}", rand::random::<u128>()).parse().expect("a key")
}

pub fn package(version: &str, kind: TaskKind) -> PackageView {
    let blob = |what: &str| BlobRef {
        digest: Digest::of(format!("{what} {version}").as_bytes()),
        size: 1,
    };
    let manifest: TaskManifest = serde_json::from_value(serde_json::json!({
        "name": "talker", "version": version, "run": { "exec": ["true"], "kind": kind },
        "content": { "tar_digest": blob("tar").digest, "tar_size": 1, "entries": 1 },
    }))
    .expect("a manifest");
    PackageView {
        package: PackageRef {
            name: "talker".parse().expect("a name"),
            version: version.parse().expect("a version"),
            manifest: blob("manifest"),
            config: blob("config"),
            content: blob("content"),
        },
        pushed_at_ms: 0,
        manifest,
    }
}

pub fn order_of(package: &PackageView) -> CreateDeployment {
    let package = &package.package;
    CreateDeployment::new(
        package.name.clone(),
        package.manifest.digest,
        "*".parse().expect("a selector"),
    )
}
