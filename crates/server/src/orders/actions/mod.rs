//! Orders of users and requests of robots. Each order is one write to the store; after its commit
//! the change is announced and the robots concerned are notified. No HTTP and no MQTT here, and no
//! SQL.

mod again;
mod approval;
mod bulk;
mod deployments;
mod desired;
mod fallen_behind;
pub mod people;
mod robots;
pub mod sign_in;
mod tasks;

use std::collections::HashSet;
use std::fmt;
use std::str::FromStr;
use std::sync::Arc;

use serde::Serialize;
use serde::de::DeserializeOwned;
use task_proto::api::MatchedRobot;
use task_proto::envelope::SigningKey;
use task_proto::selector::Selector;
use task_proto::{
    CaPin, DeploymentId, Digest, MacAddress, RobotId, RobotName, TaskName, TokenId, UserName,
    Version,
};

use crate::auth::passwords::Passwords;
use crate::auth::sign_ins::SignIns;
use crate::domain::person::Person;
use crate::limits::pace::Pace;
use crate::orders::changes::Changes;
use crate::orders::chooser::Chooser;
use crate::store::{KnownRobot, Matching, PastOrder, Store, StoreError, Write};
use crate::system::clock::Clock;

pub use crate::store::TaskOrder;
pub use again::Rollback;
pub use desired::Desired;
pub use robots::Enrolled;

/// The order service. Clones share their state.
#[derive(Clone)]
pub struct Actions {
    store: Store,
    clock: Clock,
    changes: Changes,
    key: Arc<SigningKey>,
    settings: ActionSettings,
    chooser: Chooser,
    envelopes: Arc<desired::Envelopes>,
    passwords: Passwords,
    sign_ins: Arc<SignIns>,
    enrolments: Arc<Enrolments>,
}

/// Rate limits of enrollments.
struct Enrolments {
    by_token: Pace,
    all: Pace,
}

/// Lifetimes the operator may set.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ActionSettings {
    /// Default time limit of an assignment.
    pub assignment_lifetime_ms: u64,
    /// How long a signed desired state is valid.
    pub desired_lifetime_ms: u64,
    /// Default lifetime of an enrollment token.
    pub enrolment_token_lifetime_ms: u64,
    /// Default number of uses of an enrollment token.
    pub enrolment_token_uses: u64,
    /// Maximum number of enrollments per minute; half of them by one token.
    pub enrolments_per_minute: u64,
    /// The certificate authority that robots pin, if they are to trust the server's own authority.
    pub ca_pin: Option<CaPin>,
    /// Whether every new robot waits to be approved.
    pub enrolment_approval: bool,
}

const DAY_MS: u64 = 24 * 60 * 60 * 1000;
/// The longest lifetime a request may set.
const MAX_LIFETIME_MS: u64 = 10 * 365 * DAY_MS;

impl Default for ActionSettings {
    fn default() -> Self {
        Self {
            assignment_lifetime_ms: 7 * DAY_MS,
            desired_lifetime_ms: 30 * DAY_MS,
            enrolment_token_lifetime_ms: DAY_MS,
            enrolment_token_uses: 100,
            enrolments_per_minute: 3_000,
            ca_pin: None,
            enrolment_approval: false,
        }
    }
}

impl Actions {
    /// Orders write to `store` and are announced to `changes`; desired states are signed with
    /// `key`, and `chooser` selects delivery mechanisms.
    pub fn new(
        store: Store,
        clock: Clock,
        changes: Changes,
        key: SigningKey,
        settings: ActionSettings,
        chooser: Chooser,
    ) -> Self {
        let (key, envelopes) = (Arc::new(key), Arc::default());
        let (passwords, sign_ins) = (Passwords::default(), Arc::default());
        let per_minute = settings.enrolments_per_minute;
        let (by_token, all) = (Pace::per_minute(per_minute / 2), Pace::per_minute(per_minute));
        let enrolments = Arc::new(Enrolments { by_token, all });
        Self {
            store,
            clock,
            changes,
            key,
            settings,
            chooser,
            envelopes,
            passwords,
            sign_ins,
            enrolments,
        }
    }

    /// The stored answer if `key` came with this `request` before; an error if the key came with
    /// another request, or from another user. Robots that the person may no longer see are left
    /// out.
    async fn answered_before<T: Remembered>(
        &self,
        write: &mut Write,
        by: &Person,
        key: impl Into<Option<&IdempotencyKey>>,
        request: &str,
    ) -> Result<Option<T>, ActionError> {
        let Some(key) = key.into() else { return Ok(None) };
        let Some(past) = write.past_order(&key.0).await? else { return Ok(None) };
        if past.request != remembered(by, request) {
            return Err(ActionError::IdempotencyKeyReused(key.to_string()));
        }
        let answer = serde_json::from_str(&past.answer);
        let mut answer: T =
            answer.map_err(|_| StoreError::Unreadable { column: "orders.answer" })?;
        if !by.scope.is_everything() {
            let own: HashSet<RobotId> =
                write.robots_ever_in(&by.scope).await?.into_iter().collect();
            answer.keep_robots(&own);
        }
        Ok(Some(answer))
    }

    /// Stores the answer to `request`, so that a retry gets the same answer.
    async fn remember_answer<T: Remembered>(
        &self,
        write: &mut Write,
        by: &Person,
        key: impl Into<Option<&IdempotencyKey>>,
        request: &str,
        answer: &T,
        now_ms: u64,
    ) -> Result<(), ActionError> {
        let Some(key) = key.into() else { return Ok(()) };
        let answer = serde_json::to_string(answer).expect("an answer always has a JSON form");
        let order = PastOrder { request: remembered(by, request), answer };
        Ok(write.remember_order(&key.0, &order, now_ms).await?)
    }
}

/// An answer that is stored and returned when its order is repeated.
trait Remembered: Serialize + DeserializeOwned {
    /// Removes all robots except `own`.
    fn keep_robots(&mut self, own: &HashSet<RobotId>);
}

impl Remembered for Vec<MatchedRobot> {
    fn keep_robots(&mut self, own: &HashSet<RobotId>) {
        self.retain(|robot| own.contains(&robot.id));
    }
}

impl Remembered for DeploymentId {
    /// No robots to remove: the deployment's view is read separately.
    fn keep_robots(&mut self, _own: &HashSet<RobotId>) {}
}

/// The request text stored with its answer. Requests of the first token are stored in the form used
/// before users existed.
fn remembered(by: &Person, request: &str) -> String {
    let text = if by.is_first() { request.to_owned() } else { format!("{} {request}", by.name) };
    Digest::of(text.as_bytes()).to_string()
}

/// Refuses a whole order if one of its robots is outside the person's scope: a partial order would
/// be a surprise. `what` names the selection in the error.
fn check_scope(
    by: &Person,
    robots: &[KnownRobot],
    what: impl FnOnce() -> String,
) -> Result<(), ActionError> {
    let outside = robots
        .iter()
        .filter(|robot| !by.scope.covers(&robot.id, &robot.name, &robot.labels))
        .count();
    if outside == 0 {
        return Ok(());
    }
    let (meant, what, person, scope) =
        (robots.len(), what(), by.name.clone(), by.scope.to_string());
    Err(ActionError::OutOfScope { outside, meant, what, person, scope })
}

/// The robots that match. A name that no robot of the person's has is a mistake that would go
/// unnoticed.
fn all_known(matching: Matching) -> Result<Vec<KnownRobot>, ActionError> {
    if matching.unknown.is_empty() {
        Ok(matching.robots)
    } else {
        Err(ActionError::UnknownRobots(matching.unknown))
    }
}

/// The first names of a possibly long list.
fn listed(names: &[RobotName]) -> String {
    const MAX_NAMES: usize = 20;
    let listed: Vec<&str> = names.iter().take(MAX_NAMES).map(RobotName::as_str).collect();
    match names.len().saturating_sub(MAX_NAMES) {
        0 => listed.join(", "),
        more => format!("{} and {more} more", listed.join(", ")),
    }
}

fn out_of_scope(
    outside: usize,
    meant: usize,
    what: &str,
    person: &UserName,
    scope: &str,
) -> String {
    if meant == 1 {
        return format!("{what} is outside of {person}'s scope {scope:?}; nothing was done");
    }
    format!(
        "{outside} of the {meant} robots of {what} are outside of {person}'s scope {scope:?}; nothing was done"
    )
}

/// A selector in an error.
fn quoted(selector: &Selector) -> String {
    let text: String = selector.to_string().chars().take(80).collect();
    format!("{text:?}")
}

/// Why an order was refused. No part of a refused order is carried out.
#[derive(Debug, thiserror::Error)]
pub enum ActionError {
    /// The selector matches no robot, or no robot that has the task.
    #[error("no robots match {0}")]
    NoRobotsMatch(String),
    /// The selector names robots that do not exist or are outside the person's scope.
    #[error("selector: no robot that takes orders has the name or id {}; nothing was done", listed(.0))]
    UnknownRobots(Vec<RobotName>),
    /// The key came with another order before.
    #[error("the idempotency key {0:?} was used for another order")]
    IdempotencyKeyReused(String),
    /// Text that is no idempotency key.
    #[error("an idempotency key has 1 to 128 visible ASCII characters")]
    InvalidIdempotencyKey,
    /// Some of the selected robots are outside the person's scope.
    #[error("{}", out_of_scope(*outside, *meant, what, person, scope))]
    OutOfScope {
        /// Number of robots outside the scope.
        outside: usize,
        /// Number of selected robots.
        meant: usize,
        /// The part of the request that selects the robots.
        what: String,
        /// The user with the limited scope.
        person: UserName,
        scope: String,
    },
    /// The person lacks the named permission.
    #[error("{0}")]
    NotPermitted(String),
    /// The password does not match, or the user does not exist.
    #[error("the user name or the password is wrong")]
    SignInRefused,
    /// Too many were wrong.
    #[error("too many wrong passwords; try again in {seconds} s")]
    SignInBlocked {
        /// Seconds until the next attempt is allowed.
        seconds: u64,
    },
    /// More at once than can be checked.
    #[error("too many sign-ins at once; try again")]
    TooManySignIns,
    /// No OIDC rule gives the user a role.
    #[error("nothing that the provider says of you gives you a role here; ask an administrator")]
    NoRole {
        /// The existing user who was removed for this reason.
        removed: Option<UserName>,
    },
    /// The provider sends no name that is usable here.
    #[error("the provider has no name for you that is a user name here; ask an administrator")]
    NoName,
    /// The provider and the OIDC rules decide this.
    #[error(
        "{0} signs in by the provider: what {0} may is for oidc.rules in the configuration to say"
    )]
    OfProvider(UserName),
    /// The password could not be hashed.
    #[error("the password could not be hashed")]
    PasswordFailed,
    /// The name is taken.
    #[error("there is a user {0} already, or the name stands for something else")]
    UserExists(UserName),
    #[error("there is no user {0}")]
    UserNotFound(UserName),
    /// No such token, or the token belongs to another user.
    #[error("there is no token {0} of yours")]
    TokenNotFound(TokenId),
    /// Without this user the server would have no administrator.
    #[error("{0} is the last administrator with a way in; give another one a password first")]
    LastAdministrator(UserName),
    /// A request that makes no sense.
    #[error("{key}: {reason}")]
    Invalid {
        key: &'static str,
        /// Why the value is invalid.
        reason: String,
    },
    /// The inline package exceeds the size limit of an announcement.
    #[error("delivery: {package} has {size}, inline carries at most {most}")]
    TooLargeForInline {
        package: String,
        size: String,
        /// The largest size possible.
        most: String,
    },
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
    #[error("this token is for the robot {name} with MAC {mac}")]
    TokenForOther {
        /// The robot that the token was made for.
        name: RobotName,
        /// The MAC of that robot.
        mac: MacAddress,
    },
    /// Another robot has this name.
    #[error("a robot named {0} exists")]
    NameTaken(RobotName),
    /// The robot was approved before, or never needed approval.
    #[error("robot {0} does not wait to be approved; taskd robot rm removes it")]
    NotPending(RobotName),
    /// The number of robots waiting for approval is at its limit.
    #[error("{0} robots wait to be approved: approve or reject some of them first")]
    TooManyPending(u64),
    /// Too many concurrent enrollments: this one has to wait.
    #[error("too many robots enrol at once; try again in {seconds} s (enrolment.per_minute)")]
    TooManyEnrolments {
        /// Seconds until the next enrollment is allowed.
        seconds: u64,
    },
    /// No such enrollment token, or the token has ended.
    #[error("there is no enrolment token {0}")]
    EnrolmentNotFound(TokenId),
    /// The enrollment token is unknown, used up, expired or revoked.
    #[error("the enrolment token is unknown, used up, expired or revoked")]
    TokenRefused,
    /// The robot was registered again and its new token waits for its first use: the old agent gets
    /// no further token.
    #[error("robot {0} was registered again and its new token was not used yet")]
    EnrolledAnew(RobotId),
    /// The robot does not exist.
    #[error("there is no robot {0:?}")]
    RobotNotFound(String),
    /// The deployment does not exist.
    #[error("there is no deployment {0}")]
    DeploymentNotFound(DeploymentId),
    /// The deployment ended well everywhere, or a later order replaced it.
    #[error(
        "there is no such robot for which deployment {0} has ended badly and of which nothing else was ordered since"
    )]
    NothingToRetry(DeploymentId),
    /// No robot ran another package of the task before.
    #[error(
        "none of these robots had another package of {0} before that has run there and is still on the server"
    )]
    NothingToRollBack(TaskName),
    /// The package was deleted.
    #[error("{0} {1} is no longer on the server: push it again")]
    PackageNotFound(TaskName, Version),
    /// The deployment was cancelled before.
    #[error("deployment {0} was cancelled")]
    DeploymentCancelled(DeploymentId),
    /// The deployment is over, and no part of it can be reverted.
    #[error(
        "deployment {0} is over: nothing of it is under way or has failed, so it is left as it is; stop, remove or roll back the task instead"
    )]
    NothingToCancel(DeploymentId),
    /// The deployment does not wait for the operator.
    #[error("deployment {id} is not paused: {why}")]
    NotPaused {
        id: DeploymentId,
        /// The condition the deployment waits for.
        why: String,
    },
    /// The robot's generation is higher than ours: the database was restored. The robot is left
    /// alone until its next order.
    #[error(
        "robot {0} reports a later state than the server knows; it is left alone until its next order"
    )]
    Diverged(RobotId),
    #[error("the database failed")]
    Store(#[from] StoreError),
}

impl ActionError {
    /// The stable code of the error on the wire.
    pub fn code(&self) -> &'static str {
        match self {
            Self::NoRobotsMatch(_) => "no_robots_match",
            Self::UnknownRobots(_) => "unknown_robots",
            Self::OutOfScope { .. } => "out_of_scope",
            Self::NotPermitted(_) => "forbidden",
            Self::SignInBlocked { .. }
            | Self::TooManySignIns
            | Self::TooManyPending(_)
            | Self::TooManyEnrolments { .. } => "too_many_requests",
            Self::NotPending(_) => "not_pending",
            Self::NoRole { .. } => "no_role",
            Self::NoName => "no_name",
            Self::OfProvider(_) => "of_provider",
            Self::UserExists(_) => "user_exists",
            Self::LastAdministrator(_) => "last_administrator",
            Self::IdempotencyKeyReused(_) => "idempotency_key_reused",
            Self::InvalidIdempotencyKey | Self::Invalid { .. } => "invalid_request",
            Self::TooLargeForInline { .. } => "package_too_large",
            Self::MacKnown { .. } => "mac_known",
            Self::TokenForOther { .. } => "token_for_other_robot",
            Self::NameTaken(_) => "name_taken",
            Self::TokenRefused | Self::SignInRefused => "unauthorized",
            Self::EnrolledAnew(_) => "enrolled_anew",
            Self::RobotNotFound(_)
            | Self::DeploymentNotFound(_)
            | Self::UserNotFound(_)
            | Self::TokenNotFound(_)
            | Self::EnrolmentNotFound(_) => "not_found",
            Self::DeploymentCancelled(_) => "deployment_cancelled",
            Self::NotPaused { .. } => "not_paused",
            Self::NothingToCancel(_) => "nothing_to_cancel",
            Self::NothingToRetry(_) => "nothing_to_retry",
            Self::NothingToRollBack(_) => "nothing_to_roll_back",
            Self::PackageNotFound(..) => "package_not_found",
            Self::Diverged(_) => "diverged",
            Self::Store(_) | Self::PasswordFailed => "internal",
        }
    }
}

/// Makes an order safe to repeat: 1 to 128 visible ASCII characters.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct IdempotencyKey(String);

impl FromStr for IdempotencyKey {
    type Err = ActionError;
    fn from_str(text: &str) -> Result<Self, ActionError> {
        let valid =
            (1..=128).contains(&text.len()) && text.bytes().all(|byte| byte.is_ascii_graphic());
        if valid { Ok(Self(text.to_owned())) } else { Err(ActionError::InvalidIdempotencyKey) }
    }
}

impl fmt::Display for IdempotencyKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}
