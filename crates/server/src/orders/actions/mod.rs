//! Orders of users and requests of robots, by noun. Each order is one write to the store; after its
//! commit the change is announced and the robots concerned are notified. No HTTP and no MQTT here,
//! and no SQL.

mod deployments;
mod error;
mod expiry;
mod idempotency;
mod nodes;
mod people;
mod robots;
mod selection;

use std::sync::Arc;

use task_proto::CaPin;
use task_proto::trust::envelope::SigningKey;

use self::deployments::CHUNK_ROBOTS;
use self::robots::EnrollmentLimits;
use crate::auth::passwords::Passwords;
use crate::orders::changes::Changes;
use crate::orders::delivery_planner::DeliveryPlanner;
use crate::store::Store;
use crate::system::clock::Clock;

pub use crate::store::{SelectedRobot, TaskOrder};
pub use deployments::{DeploymentActions, DeploymentError, Rollback};
pub use error::OrderError;
pub use idempotency::{IdempotencyKey, InvalidIdempotencyKey, MAX_BYTES_OF_PERSON};
pub use nodes::NodeActions;
pub use people::{PAGE_LIFETIME_MS, PersonActions, PersonError, ProviderUser, SignedIn};
pub use robots::{Enrolled, RobotActions, RobotError};

/// The order service: the actions of each noun, and those that concern several. Clones share their
/// state.
#[derive(Clone)]
pub struct Actions {
    pub robots: RobotActions,
    pub deployments: DeploymentActions,
    pub people: PersonActions,
    pub nodes: NodeActions,
}

/// Lifetimes the operator may set.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ActionSettings {
    /// Default time limit of an assignment.
    pub assignment_lifetime_ms: u64,
    /// Default lifetime of an enrollment token.
    pub enrollment_token_lifetime_ms: u64,
    /// Default number of uses of an enrollment token.
    pub enrollment_token_uses: u64,
    /// Maximum number of enrollments per minute; half of them by one token.
    pub enrollments_per_minute: u64,
    /// The certificate authority that robots pin, if they are to trust the server's own authority.
    pub ca_pin: Option<CaPin>,
    /// Whether every new robot waits to be approved.
    pub enrollment_approval: bool,
    /// The most robots that one write places an order for, at least 1.
    pub chunk_robots: usize,
}

const DAY_MS: u64 = 24 * 60 * 60 * 1000;
/// The longest lifetime a request may set.
const MAX_LIFETIME_MS: u64 = 10 * 365 * DAY_MS;

impl Default for ActionSettings {
    fn default() -> Self {
        Self {
            assignment_lifetime_ms: 7 * DAY_MS,
            enrollment_token_lifetime_ms: DAY_MS,
            enrollment_token_uses: 100,
            enrollments_per_minute: 3_000,
            ca_pin: None,
            enrollment_approval: false,
            chunk_robots: CHUNK_ROBOTS,
        }
    }
}

impl Actions {
    /// Orders write to `store` and are announced to `changes`; requests that change a robot are
    /// signed with `key`, and `planner` selects delivery mechanisms.
    pub fn new(
        store: Store,
        clock: Clock,
        changes: Changes,
        key: Arc<SigningKey>,
        settings: ActionSettings,
        planner: DeliveryPlanner,
    ) -> Self {
        Self {
            robots: RobotActions {
                store: store.clone(),
                clock: clock.clone(),
                changes: changes.clone(),
                planner: planner.clone(),
                key: key.clone(),
                enrollment_limits: Arc::new(EnrollmentLimits::per_minute(
                    settings.enrollments_per_minute,
                )),
                settings,
            },
            nodes: NodeActions { store: store.clone(), clock: clock.clone() },
            people: PersonActions {
                store: store.clone(),
                clock: clock.clone(),
                changes: changes.clone(),
                key,
                passwords: Passwords::default(),
                sign_ins: Arc::default(),
            },
            deployments: DeploymentActions {
                store,
                clock,
                changes,
                planner,
                assignment_lifetime_ms: settings.assignment_lifetime_ms,
                chunk_robots: settings.chunk_robots,
                to_continue: Arc::default(),
            },
        }
    }
}

/// A lifetime from a request, in seconds under `key`.
fn lifetime_ms(key: &'static str, seconds: u64) -> Result<u64, OrderError> {
    match seconds.checked_mul(1000) {
        Some(ms @ 1..=MAX_LIFETIME_MS) => Ok(ms),
        _ => Err(OrderError::invalid(key, "expected 1 second to 10 years")),
    }
}
