//! Robots enroll with a token, and replace their own; the tokens that let them enroll.

use std::net::IpAddr;
use std::time::Instant;

use task_proto::api::{CreateEnrollmentToken, EnrollRequest, EnrollmentToken, EnrollmentTokenList};
use task_proto::trust::token::{Token, TokenKind};
use task_proto::{MacAddress, RobotId, RobotName, TokenId};

use super::{RobotActions, RobotError, check_labels, check_name, format_labels, known_robot};
use crate::domain::limits::keyed_rate_limit::{KeyedRateLimit, seconds};
use crate::domain::person::Person;
use crate::orders::actions::{OrderError, lifetime_ms};
use crate::orders::changes::Change;
use crate::store::{AuditAction, AuditEvent, EnrollmentTerms, KnownRobot, StoreError, Transaction};

/// Maximum number of robots waiting for approval.
const MAX_PENDING: u64 = 1_000;

/// A robot that has just registered.
#[derive(Debug)]
pub struct Enrolled {
    pub robot_id: RobotId,
    pub name: RobotName,
    /// Its token, shown this once.
    pub token: Token,
    /// Whether the robot waits for approval.
    pub awaits_approval: bool,
}

/// Rate limits of enrollments.
pub(in crate::orders::actions) struct EnrollmentLimits {
    by_token: KeyedRateLimit,
    all: KeyedRateLimit,
}

impl EnrollmentLimits {
    /// At most this many enrollments per minute; half of them by one token.
    pub(in crate::orders::actions) fn per_minute(most: u64) -> Self {
        let (by_token, all) =
            (KeyedRateLimit::per_minute(most / 2), KeyedRateLimit::per_minute(most));
        Self { by_token, all }
    }

    /// Counts an enrollment with this token, or refuses it.
    fn take(&self, token: &Token) -> Result<(), RobotError> {
        let now = Instant::now();
        let in_time = self.by_token.take(&token.id(), now).and_then(|()| self.all.take("", now));
        in_time.map_err(|wait| RobotError::TooManyEnrollments { seconds: seconds(wait) })
    }
}

impl RobotActions {
    /// Registers a robot that holds the enrollment token `token`. A robot with a known MAC may
    /// register again with a token made for that robot, and with the same token as before while the
    /// answer to the first request may have been lost: its credentials have not been used. The
    /// robot keeps its id, name and labels; its old token ends when the new one is first used.
    /// `address` is the source address of the request.
    pub async fn enroll(
        &self,
        token: &Token,
        request: &EnrollRequest,
        address: Option<IpAddr>,
    ) -> Result<Enrolled, RobotError> {
        check_labels(&request.labels)?;
        let now_ms = self.clock.now_ms();
        self.enrollment_limits.take(token)?;
        let mut write = self.store.begin().await?;
        let terms =
            write.enrollments().terms(token, now_ms).await?.ok_or(RobotError::TokenRefused)?;
        let known = write.robots().find_by_mac(&request.mac).await?;
        let is_retry = match &known {
            Some(known) => write.tokens().awaits_first_use(&known.id, Some(token)).await?,
            None => false,
        };
        if terms.uses_left == Some(0) && !is_retry {
            return Err(RobotError::TokenRefused);
        }
        let robot = match known {
            Some(known) if is_retry || terms.robot.as_ref() == Some(&known.id) => {
                // A lost or copied disk holds the old credential.
                write.robots().renew_broker_credential(&known.id).await?;
                write.robots().clear_revocation(&known.id).await?;
                known
            }
            Some(known) => return Err(RobotError::MacKnown { mac: known.mac, name: known.name }),
            None => {
                let awaits_approval = self.settings.enrollment_approval || terms.approval;
                let robot = register(&mut write, terms, request, now_ms).await?;
                if awaits_approval {
                    check_pending_limit(&mut write).await?;
                }
                write.enrollments().record(&robot.id, token, address, awaits_approval).await?;
                robot
            }
        };
        let awaits_approval = write.enrollments().is_pending(&robot.id).await?;
        if !is_retry {
            write.enrollments().use_token(token).await?;
        }
        let robot_token = Token::random(TokenKind::Robot);
        let key = request.client_key.as_ref();
        write.tokens().offer(&robot_token, &robot.id, Some(token), key, now_ms).await?;
        let event = AuditEvent::new(
            "enrolment".to_owned(),
            token.id().parse().ok(),
            address,
            AuditAction::RobotEnroll,
            &robot.id,
        );
        let event = event.with("name", &robot.name).with("mac", robot.mac);
        write
            .audit()
            .record(&event.with_some("awaits_approval", awaits_approval.then_some(true)), now_ms)
            .await?;
        write.commit().await?;
        self.changes.announce(Change::Robot(robot.id.clone()));
        Ok(Enrolled { robot_id: robot.id, name: robot.name, token: robot_token, awaits_approval })
    }

    /// Makes the next token of `robot`. The current token, `token_number`, ends when the next one
    /// is first used.
    pub async fn next_token(
        &self,
        robot: &RobotId,
        token_number: u64,
    ) -> Result<Token, RobotError> {
        let mut write = self.store.begin().await?;
        known_robot(&mut write, robot.as_str()).await?;
        write.tokens().check(robot, token_number).await?;
        if write.tokens().awaits_first_use(robot, None).await? {
            return Err(RobotError::EnrolledAgain(robot.clone()));
        }
        let token = Token::random(TokenKind::Robot);
        let key = write.tokens().client_key(robot).await?;
        write.tokens().offer(&token, robot, None, key.as_ref(), self.clock.now_ms()).await?;
        write.commit().await?;
        Ok(token)
    }

    /// Makes an enrollment token.
    pub async fn create_enrollment_token(
        &self,
        by: &Person,
        order: &CreateEnrollmentToken,
    ) -> Result<EnrollmentToken, RobotError> {
        check_labels(&order.labels)?;
        if order.uses == Some(0) {
            return Err(OrderError::invalid("uses", "a token needs at least one use").into());
        }
        if order.unlimited && order.uses.is_some() {
            let reason = "uses and unlimited exclude each other";
            return Err(OrderError::invalid("uses", reason).into());
        }
        let uses_left =
            (!order.unlimited).then_some(order.uses.unwrap_or(self.settings.enrollment_token_uses));
        let now_ms = self.clock.now_ms();
        let lifetime_ms = match order.ttl_s {
            Some(ttl_s) => lifetime_ms("ttl_s", ttl_s)?,
            None => self.settings.enrollment_token_lifetime_ms,
        };
        let mut write = self.store.begin().await?;
        let robot = match &order.robot {
            Some(robot) => Some(known_robot(&mut write, robot).await?.id),
            None => None,
        };
        let expires_at_ms = now_ms + lifetime_ms;
        let (labels, approval) = (order.labels.clone(), order.approval);
        let terms = EnrollmentTerms { robot, labels, uses_left, expires_at_ms, approval };
        let token = Token::random_enrollment(self.key.public_key(), self.settings.ca_pin);
        write.enrollments().create_token(&token, &terms, now_ms).await?;
        let event = AuditEvent::by(by, AuditAction::EnrollmentCreate, token.id())
            .with_some("robot", terms.robot.as_ref())
            .with_some("uses", terms.uses_left)
            .with("labels", format_labels(&terms.labels))
            .with_some("approval", terms.approval.then_some(true))
            .with("expires_at_ms", expires_at_ms);
        write.audit().record(&event, now_ms).await?;
        write.commit().await?;
        Ok(EnrollmentToken { id: token.id(), token: token.reveal(), uses_left, expires_at_ms })
    }

    /// The enrollment tokens that can still be used.
    pub async fn enrollment_tokens(&self) -> Result<EnrollmentTokenList, RobotError> {
        Ok(EnrollmentTokenList {
            tokens: self.store.enrollments().tokens(self.clock.now_ms()).await?,
        })
    }

    /// Ends an enrollment token now. Robots enrolled with the token stay.
    pub async fn revoke_enrollment_token(
        &self,
        by: &Person,
        id: &TokenId,
    ) -> Result<(), RobotError> {
        let now_ms = self.clock.now_ms();
        let mut write = self.store.begin().await?;
        if !write.enrollments().revoke_token(id, now_ms).await? {
            return Err(RobotError::EnrollmentTokenNotFound(id.clone()));
        }
        write
            .audit()
            .record(&AuditEvent::by(by, AuditAction::EnrollmentRevoke, id), now_ms)
            .await?;
        Ok(write.commit().await?)
    }
}

/// Registers an unknown robot.
async fn register(
    write: &mut Transaction,
    terms: EnrollmentTerms,
    request: &EnrollRequest,
    now_ms: u64,
) -> Result<KnownRobot, RobotError> {
    if let Some(other) = &terms.robot {
        let other = known_robot(write, other.as_str()).await.map_err(|error| match error {
            // The token's robot was removed, so the token is useless.
            RobotError::NotFound(_) => RobotError::TokenRefused,
            error => error,
        })?;
        return Err(RobotError::TokenForOther { name: other.name, mac: other.mac });
    }
    let id = RobotId::random();
    let name = match &request.name {
        Some(name) => {
            check_name(write, name).await?;
            name.clone()
        }
        None => default_name(write, &request.mac, &id).await?,
    };
    // Labels that the operator put on the token win over labels that the robot reports.
    let mut labels = request.labels.clone();
    labels.extend(terms.labels);
    check_labels(&labels)?;
    let robot = KnownRobot { id, name, mac: request.mac, labels };
    write.robots().insert(&robot, now_ms).await?;
    Ok(robot)
}

async fn default_name(
    write: &mut Transaction,
    mac: &MacAddress,
    id: &RobotId,
) -> Result<RobotName, StoreError> {
    let name = |text: String| text.parse::<RobotName>().expect("made of letters and digits");
    let by_mac = name(format!("robot-{}", mac.to_string().replace(':', "")));
    let is_free = write.robots().find(by_mac.as_str()).await?.is_none();
    Ok(if is_free { by_mac } else { name(format!("robot-{id}")) })
}

/// An error if the number of robots waiting for approval is at its limit.
async fn check_pending_limit(write: &mut Transaction) -> Result<(), RobotError> {
    if write.enrollments().count_pending().await? < MAX_PENDING {
        Ok(())
    } else {
        Err(RobotError::TooManyPending(MAX_PENDING))
    }
}
