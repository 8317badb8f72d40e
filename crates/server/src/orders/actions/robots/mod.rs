//! Orders on registered robots: edit, remove, revoke, and the signature of actions at once.
//! Enrollment, approval and orders on many robots have files of their own.

mod approval;
mod bulk;
mod enrollment;

use std::sync::Arc;

use task_proto::api::EditRobot;
use task_proto::desired::settings::RobotSettings;
use task_proto::ids::Labels;
use task_proto::messages::request::{ACTION_TYPE, Action};
use task_proto::trust::envelope::{Envelope, SigningKey};
use task_proto::{MacAddress, RobotId, RobotName, TokenId};

use super::selection::check_scope;
use super::{ActionSettings, OrderError};
use crate::domain::person::Person;
use crate::orders::changes::{Change, Changes, PendingNotifications};
use crate::orders::delivery_planner::DeliveryPlanner;
use crate::orders::rollout;
use crate::store::{AuditAction, AuditEvent, KnownRobot, Store, StoreError, Transaction};
use crate::system::clock::Clock;

pub(super) use approval::expire_pending;
pub use enrollment::Enrolled;
pub(super) use enrollment::EnrollmentLimits;

/// Maximum number of labels of a robot.
const MAX_LABELS: usize = 64;

/// Orders on robots, and the requests of robots that enroll. Clones share their state.
#[derive(Clone)]
pub struct RobotActions {
    pub(super) store: Store,
    pub(super) clock: Clock,
    pub(super) changes: Changes,
    pub(super) planner: DeliveryPlanner,
    pub(super) key: Arc<SigningKey>,
    pub(super) settings: ActionSettings,
    pub(super) enrollment_limits: Arc<EnrollmentLimits>,
}

/// Why an order on robots, or an enrollment, was refused.
#[derive(Debug, thiserror::Error)]
pub enum RobotError {
    /// The robot does not exist.
    #[error("there is no robot {0:?}")]
    NotFound(String),
    /// Another robot has this name.
    #[error("a robot named {0} exists")]
    NameTaken(RobotName),
    /// The robot was approved before, or never needed approval.
    #[error("robot {0} is not waiting for approval; remove it with taskd robot rm")]
    NotPending(RobotName),
    /// The number of robots waiting for approval is at its limit.
    #[error("{0} robots are waiting for approval; approve or reject some of them first")]
    TooManyPending(u64),
    /// A robot with this MAC is registered.
    #[error(
        "a robot with MAC {mac} is registered as {name}; to register it again, make a token for that robot"
    )]
    MacKnown {
        mac: MacAddress,
        /// Name of the registered robot.
        name: RobotName,
    },
    /// A token made for one robot was used by another robot.
    #[error("this token is only valid for robot {name} with MAC {mac}")]
    TokenForOther {
        /// The robot that the token was made for.
        name: RobotName,
        /// The MAC of that robot.
        mac: MacAddress,
    },
    /// Too many concurrent enrollments: this one has to wait.
    #[error("too many robots are enrolling; try again in {seconds} s (enrolment.per_minute)")]
    TooManyEnrollments {
        /// Seconds until the next enrollment is allowed.
        seconds: u64,
    },
    /// No such enrollment token, or the token has ended.
    #[error("there is no enrollment token {0}")]
    EnrollmentTokenNotFound(TokenId),
    /// The enrollment token is unknown, used up, expired or revoked.
    #[error("the enrollment token is unknown, used up, expired or revoked")]
    TokenRefused,
    /// The robot was registered again and its new token waits for its first use: the old agent gets
    /// no further token.
    #[error("robot {0} was registered again and has not used its new token yet")]
    EnrolledAgain(RobotId),
    #[error(transparent)]
    Order(#[from] OrderError),
}

impl From<StoreError> for RobotError {
    fn from(error: StoreError) -> Self {
        Self::Order(error.into())
    }
}

impl RobotActions {
    /// Changes a robot's name, labels or settings. The robot has to be in the person's scope before
    /// and after the change.
    pub async fn edit(
        &self,
        by: &Person,
        robot: &RobotId,
        edit: &EditRobot,
    ) -> Result<(), RobotError> {
        let mut write = self.store.begin().await?;
        let mut known = known_robot(&mut write, robot.as_str()).await?;
        check_scope(by, std::slice::from_ref(&known), || known.name.to_string())?;
        let before = known.clone();
        let event = AuditEvent::by(by, AuditAction::RobotEdit, &known.id).with("name", &known.name);
        if let Some(labels) = &edit.labels {
            check_labels(labels)?;
            known.labels = labels.clone();
        }
        if let Some(name) = edit.name.as_ref().filter(|name| **name != known.name) {
            check_name(&mut write, name).await?;
            known.name = name.clone();
        }
        check_scope(by, std::slice::from_ref(&known), || {
            format!("{} with the new name and labels", known.name)
        })?;
        let is_described_anew = known != before;
        if is_described_anew {
            write.robots().update(&known).await?;
        }
        let now_ms = self.clock.now_ms();
        let is_set = match &edit.settings {
            Some(settings) => {
                set_settings(&mut write, &known.id, settings.clone().unwrap_or_default(), now_ms)
                    .await?
            }
            None => false,
        };
        let renamed = edit.name.as_ref().map(|_| &known.name);
        let labels = edit.labels.as_ref().map(format_labels);
        let settings = edit.settings.as_ref().map(|settings| format_settings(settings.as_ref()));
        let event = event
            .with_some("new_name", renamed)
            .with_some("labels", labels)
            .with_some("settings", settings);
        write.audit().record(&event, now_ms).await?;
        write.commit().await?;
        if is_set || is_described_anew {
            self.changes.notify_robots([known.id.clone()]);
        }
        self.changes.announce(Change::Robot(known.id));
        self.changes.announce(Change::Scopes);
        self.changes.announce_rights();
        Ok(())
    }

    /// Removes a robot: its tokens end now, its MAC and name are free, its id is never used again.
    pub async fn remove(&self, by: &Person, robot: &RobotId) -> Result<(), RobotError> {
        let now_ms = self.clock.now_ms();
        let mut write = self.store.begin().await?;
        let known = known_robot(&mut write, robot.as_str()).await?;
        check_scope(by, std::slice::from_ref(&known), || known.name.to_string())?;
        let known = [known];
        let mut notifications = delete_records(&mut write, &known, now_ms).await?;
        let [robot] = &known;
        write.audit().record(&removal_event(by, robot), now_ms).await?;
        let touched = notifications.deployments.clone();
        rollout::apply(&mut write, &self.planner, touched, now_ms, &mut notifications).await?;
        write.commit().await?;
        self.announce_removed(&known, notifications);
        Ok(())
    }

    /// Ends all tokens of a robot and those made for the robot, now; its name, its history and its
    /// desired state stay. The same tokens never become valid again, because their holder is in
    /// doubt: the robot has to be registered anew. The caller closes its sessions. The call is
    /// idempotent.
    pub async fn revoke(&self, by: &Person, robot: &RobotId) -> Result<(), RobotError> {
        let now_ms = self.clock.now_ms();
        let mut write = self.store.begin().await?;
        let known = known_robot(&mut write, robot.as_str()).await?;
        check_scope(by, std::slice::from_ref(&known), || known.name.to_string())?;
        if !write.robots().revoke(robot, now_ms).await? {
            return Ok(());
        }
        let event = AuditEvent::by(by, AuditAction::RobotRevoke, robot)
            .with("name", &known.name)
            .with("mac", known.mac);
        write.audit().record(&event, now_ms).await?;
        // No batch waits for this robot any more.
        let touched = write.deployments().begun_on(robot).await?;
        let mut notifications = PendingNotifications::default();
        rollout::apply(&mut write, &self.planner, touched, now_ms, &mut notifications).await?;
        write.commit().await?;
        self.changes.announce(Change::Robot(known.id));
        self.changes.publish(notifications);
        Ok(())
    }

    /// Records in the audit that a robot is about to be asked to change something, whether or not
    /// the robot then does so, and signs the action for the robot.
    pub async fn sign_action(&self, by: &Person, action: &Action) -> Result<Envelope, RobotError> {
        let mut write = self.store.begin_without_auth_invalidation().await?;
        let ask = serde_json::to_string(&action.ask).expect("a question always has a JSON form");
        write
            .audit()
            .record(
                &AuditEvent::by(by, AuditAction::RobotAsk, &action.robot_id).with("ask", ask),
                self.clock.now_ms(),
            )
            .await?;
        write.commit().await?;
        let payload = serde_json::to_vec(action).expect("an action always has a JSON form");
        Ok(Envelope::seal(ACTION_TYPE, &payload, &self.key))
    }

    /// To be called after the commit.
    fn announce_removed(&self, robots: &[KnownRobot], notifications: PendingNotifications) {
        for robot in robots {
            self.changes.announce(Change::RobotRemoved(Box::new(robot.clone())));
        }
        self.changes.publish(notifications);
    }
}

/// Ends all that is ordered of `robots`, their tokens and themselves.
async fn delete_records(
    write: &mut Transaction,
    robots: &[KnownRobot],
    now_ms: u64,
) -> Result<PendingNotifications, StoreError> {
    let ids: Vec<_> = robots.iter().map(|robot| robot.id.clone()).collect();
    let deployments = write.assignments().end_all_of(&ids, now_ms).await?;
    write.tokens().revoke_all_of(&ids, now_ms).await?;
    write.robots().remove(&ids, now_ms).await?;
    Ok(PendingNotifications { deployments, ..PendingNotifications::default() })
}

/// Labels as the audit shows them.
fn format_labels(labels: &Labels) -> String {
    let pairs: Vec<String> = labels.iter().map(|(key, value)| format!("{key}={value}")).collect();
    pairs.join(",")
}

/// A name must be free, and must not look like an id: otherwise a selector could match two robots.
async fn check_name(write: &mut Transaction, name: &RobotName) -> Result<(), RobotError> {
    if name.as_str().parse::<RobotId>().is_ok() {
        let reason = format!("{name:?} has the form of a robot id", name = name.as_str());
        return Err(OrderError::invalid("name", reason).into());
    }
    match write.robots().find(name.as_str()).await? {
        Some(_) => Err(RobotError::NameTaken(name.clone())),
        None => Ok(()),
    }
}

fn check_labels(labels: &Labels) -> Result<(), OrderError> {
    if labels.len() <= MAX_LABELS {
        return Ok(());
    }
    Err(OrderError::invalid("labels", format!("at most {MAX_LABELS}, not {}", labels.len())))
}

/// The robot with this id or name; an error if there is none.
async fn known_robot(write: &mut Transaction, id_or_name: &str) -> Result<KnownRobot, RobotError> {
    // An id has the form of a name. Any other text is not passed to the database, which might
    // reject the text.
    let robot = match id_or_name.parse::<RobotName>() {
        Ok(name) => write.robots().find(name.as_str()).await?,
        Err(_) => None,
    };
    robot.ok_or_else(|| RobotError::NotFound(id_or_name.chars().take(80).collect()))
}

/// Sets a robot's settings; whether they are others than before.
async fn set_settings(
    write: &mut Transaction,
    robot: &RobotId,
    settings: RobotSettings,
    now_ms: u64,
) -> Result<bool, OrderError> {
    settings.check().map_err(|error| OrderError::invalid("settings", error.to_string()))?;
    write.robots().adopt_diverged(std::slice::from_ref(robot), now_ms).await?;
    Ok(write.robots().update_settings(robot, &settings).await?)
}

fn format_settings(settings: Option<&RobotSettings>) -> String {
    settings.map_or("none".to_owned(), |settings| {
        serde_json::to_string(settings).expect("a wire type always has a JSON form")
    })
}

/// The audit event of a robot's removal: the only record left of the robot.
fn removal_event(by: &Person, robot: &KnownRobot) -> AuditEvent {
    AuditEvent::by(by, AuditAction::RobotRemove, &robot.id)
        .with("name", &robot.name)
        .with("mac", robot.mac)
}
