//! A fleet without a network: orders and reports go straight to the store, and robots are values.

use std::collections::BTreeMap;
use std::sync::Arc;

use task_proto::api::{
    AddUser, CreateDeployment, CreateEnrollmentToken, CreateToken, DeploymentView, EnrollRequest,
    PackageView, RobotView,
};
use task_proto::desired::{BlobRef, DesiredState, DesiredTask, PackageRef};
use task_proto::envelope::{DESIRED_STATE_TYPE, SigningKey};
use task_proto::manifest::{TaskKind, TaskManifest};
use task_proto::person::{Role, Roles};
use task_proto::report::{HostFacts, LinkFacts, Phase, Report, TaskReport};
use task_proto::token::{Token, TokenKind};
use task_proto::{DeploymentId, Digest, Generation, InstanceId, MacAddress, RobotId, UserName};
use taskd::config::DeliverySettings;
use taskd::domain::person::Person;
use taskd::fleet::presence::Presence;
use taskd::orders::actions::{ActionError, ActionSettings, Actions, Enrolled, IdempotencyKey};
use taskd::orders::changes::Changes;
use taskd::orders::chooser::{Chooser, ServerLoad};
use taskd::orders::report_writer::ReportWriter;
use taskd::store::TokenHolder;
use taskd::system::clock::Clock;

use crate::database::TestDatabase;

const SEED: [u8; 32] = [7; 32];
/// The number of every robot's MQTT session.
const CONNECTION: u64 = 1;

/// A server's inner half with a clock that stands still.
pub struct Fleet {
    pub database: TestDatabase,
    pub actions: Actions,
    pub operator: Person,
    pub writer: ReportWriter,
    pub clock: Clock,
    pub changes: Changes,
    pub presence: Arc<Presence>,
    pub load: Arc<ServerLoad>,
    pub chooser: Chooser,
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

    pub async fn with_delivery(database: TestDatabase, settings: &DeliverySettings) -> Self {
        let load = Arc::new(ServerLoad::default());
        let (clock, changes) = (Clock::fixed(1_000_000), Changes::new());
        let presence = Arc::new(Presence::new(90_000, clock.now_ms()));
        let chooser = Chooser::new(settings, presence.clone(), load.clone());
        let (writer, _) = ReportWriter::start(
            database.store.clone(),
            clock.clone(),
            changes.clone(),
            chooser.clone(),
        );
        let key = SigningKey::from_bytes(SEED);
        let actions = Actions::new(
            database.store.clone(),
            clock.clone(),
            changes.clone(),
            key,
            ActionSettings { enrolments_per_minute: 1_000_000, ..ActionSettings::default() },
            chooser.clone(),
        );
        let token = Token::random(TokenKind::Operator);
        database.store.create_operator_token(&token, clock.now_ms()).await.expect("stored");
        let operator = Person::first(token.id().parse().expect("an id"));
        Self { database, actions, operator, writer, clock, changes, presence, load, chooser }
    }

    /// An administrator of the robots that `scope` means.
    pub async fn limited(&self, name: &str, scope: &str) -> Person {
        let user: UserName = name.parse().expect("a name");
        let scope = Some(scope.parse().expect("a selector"));
        let order =
            AddUser { name: user.clone(), roles: Roles::one(Role::Admin), scope, password: None };
        self.actions.add_user(&self.operator, &order).await.expect("added");
        let order = CreateToken { user: Some(user), ..CreateToken::default() };
        let made = self.actions.create_token(&self.operator, &order).await.expect("made");
        let token = made.token.parse().expect("a token");
        match self.database.store.token_holder(&token, self.clock.now_ms()).await.expect("reads") {
            Some(TokenHolder::Person(person)) => person,
            other => panic!("{other:?}"),
        }
    }

    pub async fn enrolment_token(&self, order: CreateEnrollmentToken) -> task_proto::token::Token {
        let made =
            self.actions.create_enrollment_token(&self.operator, &order).await.expect("a token");
        made.token.parse().expect("a token")
    }

    pub async fn try_enroll(
        &self,
        token: &task_proto::token::Token,
        mac: MacAddress,
        name: Option<&str>,
    ) -> Result<Enrolled, ActionError> {
        let name = name.map(|name| name.parse().expect("a name"));
        self.actions
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
            .enrolment_token(CreateEnrollmentToken { unlimited: true, ..Default::default() })
            .await;
        let mut robots = Vec::new();
        for number in 0..count {
            let enrolled = self
                .try_enroll(&token, mac(number), Some(&format!("r{number}")))
                .await
                .expect("enrols");
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
        self.actions
            .create_deployment(&self.operator, &random_key(), &request, &package)
            .await
            .expect("ordered")
    }

    pub async fn deployment(&self, id: &DeploymentId) -> DeploymentView {
        self.database.store.deployment(id, true).await.expect("reads").expect("there")
    }

    /// The newest ones.
    pub async fn deployments(&self) -> Vec<DeploymentView> {
        let page = self.database.store.deployments(None, None, 1_000).await.expect("reads");
        page.expect("no other was named").deployments
    }

    pub async fn view(&self, robot: &Robot) -> RobotView {
        self.database.store.robot(&robot.id).await.expect("reads").expect("there")
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

    pub async fn desired(&self, robot: &Robot) -> Result<DesiredState, ActionError> {
        let desired = self.actions.desired(&robot.id).await?;
        let key = SigningKey::from_bytes(SEED).public_key();
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
