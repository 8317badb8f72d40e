//! Robots enroll, are edited and removed; enrollment tokens.

use std::net::IpAddr;
use std::time::Instant;

use task_proto::api::{
    CreateEnrollmentToken, EditRobot, EnrollRequest, EnrollmentToken, EnrollmentTokenList,
    MatchedRobot,
};
use task_proto::envelope::Envelope;
use task_proto::id::Labels;
use task_proto::request::{ACTION_TYPE, Action};
use task_proto::selector::Selector;
use task_proto::settings::RobotSettings;
use task_proto::token::{Token, TokenKind};
use task_proto::{MacAddress, RobotId, RobotName, TokenId};

use super::{ActionError, Actions, MAX_LIFETIME_MS, all_known, check_scope, quoted};
use crate::domain::person::Person;
use crate::limits::pace::seconds;
use crate::orders::advance::advance;
use crate::orders::changes::{Change, Consequences};
use crate::store::{Act, Deed, EnrolmentTerms, KnownRobot, StoreError, Write};

/// Maximum number of labels of a robot.
const MAX_LABELS: usize = 64;
/// Maximum number of robots waiting for approval.
const MOST_PENDING: u64 = 1_000;

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

impl Actions {
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
    ) -> Result<Enrolled, ActionError> {
        check_labels(&request.labels)?;
        let (now_ms, now) = (self.clock.now_ms(), Instant::now());
        let in_time = self
            .enrolments
            .by_token
            .take(&token.id(), now)
            .and_then(|()| self.enrolments.all.take("", now));
        in_time.map_err(|wait| ActionError::TooManyEnrolments { seconds: seconds(wait) })?;
        let mut write = self.store.begin().await?;
        let terms = write.enrolment_terms(token, now_ms).await?.ok_or(ActionError::TokenRefused)?;
        let known = write.robot_by_mac(&request.mac).await?;
        let is_retry = match &known {
            Some(known) => write.awaits_first_use(&known.id, Some(token)).await?,
            None => false,
        };
        if terms.uses_left == Some(0) && !is_retry {
            return Err(ActionError::TokenRefused);
        }
        let robot = match known {
            Some(known) if is_retry || terms.robot.as_ref() == Some(&known.id) => {
                // A lost or copied disk holds the old credential.
                write.renew_broker_credential(&known.id).await?;
                write.readmit(&known.id).await?;
                known
            }
            Some(known) => return Err(ActionError::MacKnown { mac: known.mac, name: known.name }),
            None => {
                let awaits_approval = self.settings.enrolment_approval || terms.approval;
                let robot = register(&mut write, terms, request, now_ms).await?;
                if awaits_approval {
                    check_room(&mut write).await?;
                }
                write.note_enrolment(&robot.id, token, address, awaits_approval).await?;
                robot
            }
        };
        let awaits_approval = write.is_pending(&robot.id).await?;
        if !is_retry {
            write.use_enrolment_token(token).await?;
        }
        let robot_token = Token::random(TokenKind::Robot);
        let key = request.client_key.as_ref();
        write.offer_robot_token(&robot_token, &robot.id, Some(token), key, now_ms).await?;
        let deed = Deed::new(
            "enrolment".to_owned(),
            token.id().parse().ok(),
            address,
            Act::RobotEnroll,
            &robot.id,
        );
        let deed = deed.with("name", &robot.name).with("mac", robot.mac);
        write
            .audit(&deed.with_some("awaits_approval", awaits_approval.then_some(true)), now_ms)
            .await?;
        write.commit().await?;
        self.changes.announce(Change::Robot(robot.id.clone()));
        Ok(Enrolled { robot_id: robot.id, name: robot.name, token: robot_token, awaits_approval })
    }

    /// Makes the next token of `robot`. The current token, `token_number`, ends when the next one
    /// is first used.
    pub async fn next_robot_token(
        &self,
        robot: &RobotId,
        token_number: u64,
    ) -> Result<Token, ActionError> {
        let mut write = self.store.begin().await?;
        known_robot(&mut write, robot.as_str()).await?;
        write.check_token(robot, token_number).await?;
        if write.awaits_first_use(robot, None).await? {
            return Err(ActionError::EnrolledAnew(robot.clone()));
        }
        let token = Token::random(TokenKind::Robot);
        let key = write.client_key(robot).await?;
        write.offer_robot_token(&token, robot, None, key.as_ref(), self.clock.now_ms()).await?;
        write.commit().await?;
        Ok(token)
    }

    /// Makes an enrollment token.
    pub async fn create_enrollment_token(
        &self,
        by: &Person,
        order: &CreateEnrollmentToken,
    ) -> Result<EnrollmentToken, ActionError> {
        check_labels(&order.labels)?;
        if order.uses == Some(0) {
            return Err(ActionError::Invalid {
                key: "uses",
                reason: "a token needs at least one use".to_owned(),
            });
        }
        if order.unlimited && order.uses.is_some() {
            let reason =
                "a token for any number of enrolments (unlimited) has no number of uses".to_owned();
            return Err(ActionError::Invalid { key: "uses", reason });
        }
        let uses_left =
            (!order.unlimited).then_some(order.uses.unwrap_or(self.settings.enrolment_token_uses));
        let now_ms = self.clock.now_ms();
        let lifetime_ms = match order.ttl_s {
            Some(ttl_s) => lifetime_ms("ttl_s", ttl_s)?,
            None => self.settings.enrolment_token_lifetime_ms,
        };
        let mut write = self.store.begin().await?;
        let robot = match &order.robot {
            Some(robot) => Some(known_robot(&mut write, robot).await?.id),
            None => None,
        };
        let expires_at_ms = now_ms + lifetime_ms;
        let (labels, approval) = (order.labels.clone(), order.approval);
        let terms = EnrolmentTerms { robot, labels, uses_left, expires_at_ms, approval };
        let token = Token::random_enrolment(self.key.public_key(), self.settings.ca_pin);
        write.create_enrolment_token(&token, &terms, now_ms).await?;
        let deed = Deed::by(by, Act::EnrolmentCreate, token.id())
            .with_some("robot", terms.robot.as_ref())
            .with_some("uses", terms.uses_left)
            .with("labels", shown_labels(&terms.labels))
            .with_some("approval", terms.approval.then_some(true))
            .with("expires_at_ms", expires_at_ms);
        write.audit(&deed, now_ms).await?;
        write.commit().await?;
        Ok(EnrollmentToken { id: token.id(), token: token.reveal(), uses_left, expires_at_ms })
    }

    /// The enrollment tokens that can still be used.
    pub async fn enrollment_tokens(&self) -> Result<EnrollmentTokenList, ActionError> {
        Ok(EnrollmentTokenList { tokens: self.store.enrolment_tokens(self.clock.now_ms()).await? })
    }

    /// Ends an enrollment token now. Robots enrolled with the token stay.
    pub async fn revoke_enrollment_token(
        &self,
        by: &Person,
        id: &TokenId,
    ) -> Result<(), ActionError> {
        let now_ms = self.clock.now_ms();
        let mut write = self.store.begin().await?;
        if !write.revoke_enrolment_token(id, now_ms).await? {
            return Err(ActionError::EnrolmentNotFound(id.clone()));
        }
        write.audit(&Deed::by(by, Act::EnrolmentRevoke, id), now_ms).await?;
        Ok(write.commit().await?)
    }

    /// Changes a robot's name, labels or settings. The robot has to be in the person's scope before
    /// and after the change.
    pub async fn edit_robot(
        &self,
        by: &Person,
        robot: &RobotId,
        edit: &EditRobot,
    ) -> Result<(), ActionError> {
        let mut write = self.store.begin().await?;
        let mut known = known_robot(&mut write, robot.as_str()).await?;
        check_scope(by, std::slice::from_ref(&known), || known.name.to_string())?;
        let deed = Deed::by(by, Act::RobotEdit, &known.id).with("name", &known.name);
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
        write.update_robot(&known).await?;
        let now_ms = self.clock.now_ms();
        let is_set = match &edit.settings {
            Some(settings) => {
                set(&mut write, &known.id, settings.clone().unwrap_or_default(), now_ms).await?
            }
            None => false,
        };
        let renamed = edit.name.as_ref().map(|_| &known.name);
        let labels = edit.labels.as_ref().map(shown_labels);
        let settings = edit.settings.as_ref().map(|settings| shown_settings(settings.as_ref()));
        let deed = deed
            .with_some("new_name", renamed)
            .with_some("labels", labels)
            .with_some("settings", settings);
        write.audit(&deed, now_ms).await?;
        write.commit().await?;
        if is_set {
            self.changes.ring([known.id.clone()]);
        }
        self.changes.announce(Change::Robot(known.id));
        self.changes.announce(Change::Scopes);
        self.changes.announce_rights();
        Ok(())
    }

    /// Removes a robot: its tokens end now, its MAC and name are free, its id is never used again.
    pub async fn remove_robot(&self, by: &Person, robot: &RobotId) -> Result<(), ActionError> {
        let now_ms = self.clock.now_ms();
        let mut write = self.store.begin().await?;
        let known = known_robot(&mut write, robot.as_str()).await?;
        check_scope(by, std::slice::from_ref(&known), || known.name.to_string())?;
        let known = [known];
        let mut consequences = self.take_away(&mut write, &known, now_ms).await?;
        let [robot] = &known;
        write.audit(&removal(by, robot), now_ms).await?;
        let touched = consequences.deployments.clone();
        advance(&mut write, &self.chooser, touched, now_ms, &mut consequences).await?;
        write.commit().await?;
        self.announce_removed(&known, consequences);
        Ok(())
    }

    /// Ends all tokens of a robot and those made for the robot, now; its name, its history and its
    /// desired state stay. The same tokens never become valid again, because their holder is in
    /// doubt: the robot has to be registered anew. The call is idempotent.
    pub async fn revoke_robot(&self, by: &Person, robot: &RobotId) -> Result<(), ActionError> {
        let now_ms = self.clock.now_ms();
        let mut write = self.store.begin().await?;
        let known = known_robot(&mut write, robot.as_str()).await?;
        check_scope(by, std::slice::from_ref(&known), || known.name.to_string())?;
        if !write.revoke_robot(robot, now_ms).await? {
            return Ok(());
        }
        let deed =
            Deed::by(by, Act::RobotRevoke, robot).with("name", &known.name).with("mac", known.mac);
        write.audit(&deed, now_ms).await?;
        // No batch waits for this robot any more.
        let touched = write.begun_on(robot).await?;
        let mut consequences = Consequences::default();
        advance(&mut write, &self.chooser, touched, now_ms, &mut consequences).await?;
        write.commit().await?;
        self.changes.announce(Change::Robot(known.id));
        self.changes.publish(consequences);
        Ok(())
    }

    /// Records in the audit that a robot is about to be asked to change something, whether or not
    /// the robot then does so, and signs the action for the robot.
    pub async fn sign_action(&self, by: &Person, action: &Action) -> Result<Envelope, ActionError> {
        let mut write = self.store.begin_keeping_rights().await?;
        let ask = serde_json::to_string(&action.ask).expect("a question always has a JSON form");
        write
            .audit(
                &Deed::by(by, Act::RobotAsk, &action.robot_id).with("ask", ask),
                self.clock.now_ms(),
            )
            .await?;
        write.commit().await?;
        let payload = serde_json::to_vec(action).expect("an action always has a JSON form");
        Ok(Envelope::seal(ACTION_TYPE, &payload, &self.key))
    }

    /// The robots that match this selector now, sorted by name; an error if none match, or if one
    /// is outside the person's scope. `online` is left false.
    pub async fn matching_robots(
        &self,
        by: &Person,
        selector: &Selector,
    ) -> Result<Vec<MatchedRobot>, ActionError> {
        let robots = all_known(self.store.matching_robots(selector, &by.scope).await?)?;
        if robots.is_empty() {
            return Err(ActionError::NoRobotsMatch(quoted(selector)));
        }
        check_scope(by, &robots, || quoted(selector))?;
        Ok(robots.into_iter().map(matched).collect())
    }
}

/// A robot in the form used by answers to orders.
pub(super) fn matched(robot: KnownRobot) -> MatchedRobot {
    MatchedRobot { id: robot.id, name: robot.name, online: false }
}

/// Labels as the audit shows them.
pub(super) fn shown_labels(labels: &Labels) -> String {
    let pairs: Vec<String> = labels.iter().map(|(key, value)| format!("{key}={value}")).collect();
    pairs.join(",")
}

/// A lifetime from a request, in seconds under `key`.
pub(super) fn lifetime_ms(key: &'static str, seconds: u64) -> Result<u64, ActionError> {
    match seconds.checked_mul(1000) {
        Some(ms @ 1..=MAX_LIFETIME_MS) => Ok(ms),
        _ => Err(ActionError::Invalid { key, reason: "expected 1 second to 10 years".to_owned() }),
    }
}

/// Registers an unknown robot.
async fn register(
    write: &mut Write,
    terms: EnrolmentTerms,
    request: &EnrollRequest,
    now_ms: u64,
) -> Result<KnownRobot, ActionError> {
    if let Some(other) = &terms.robot {
        let other = known_robot(write, other.as_str()).await.map_err(|error| match error {
            // The token's robot was removed, so the token is useless.
            ActionError::RobotNotFound(_) => ActionError::TokenRefused,
            error => error,
        })?;
        return Err(ActionError::TokenForOther { name: other.name, mac: other.mac });
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
    write.insert_robot(&robot, now_ms).await?;
    Ok(robot)
}

async fn default_name(
    write: &mut Write,
    mac: &MacAddress,
    id: &RobotId,
) -> Result<RobotName, StoreError> {
    let name = |text: String| text.parse::<RobotName>().expect("made of letters and digits");
    let by_mac = name(format!("robot-{}", mac.to_string().replace(':', "")));
    let is_free = write.known_robot(by_mac.as_str()).await?.is_none();
    Ok(if is_free { by_mac } else { name(format!("robot-{id}")) })
}

/// A name must be free, and must not look like an id: otherwise a selector could match two robots.
async fn check_name(write: &mut Write, name: &RobotName) -> Result<(), ActionError> {
    if name.as_str().parse::<RobotId>().is_ok() {
        let reason = format!("{name:?} has the form of a robot id", name = name.as_str());
        return Err(ActionError::Invalid { key: "name", reason });
    }
    match write.known_robot(name.as_str()).await? {
        Some(_) => Err(ActionError::NameTaken(name.clone())),
        None => Ok(()),
    }
}

pub(super) fn check_labels(labels: &Labels) -> Result<(), ActionError> {
    if labels.len() <= MAX_LABELS {
        return Ok(());
    }
    Err(ActionError::Invalid {
        key: "labels",
        reason: format!("at most {MAX_LABELS}, not {}", labels.len()),
    })
}

/// The robot with this id or name; an error if there is none.
pub(super) async fn known_robot(
    write: &mut Write,
    id_or_name: &str,
) -> Result<KnownRobot, ActionError> {
    // An id has the form of a name. Any other text is not passed to the database, which might
    // reject the text.
    let robot = match id_or_name.parse::<RobotName>() {
        Ok(name) => write.known_robot(name.as_str()).await?,
        Err(_) => None,
    };
    robot.ok_or_else(|| ActionError::RobotNotFound(id_or_name.chars().take(80).collect()))
}

/// Sets a robot's settings; whether they are others than before.
async fn set(
    write: &mut Write,
    robot: &RobotId,
    settings: RobotSettings,
    now_ms: u64,
) -> Result<bool, ActionError> {
    settings
        .check()
        .map_err(|error| ActionError::Invalid { key: "settings", reason: error.to_string() })?;
    write.adopt_diverged(std::slice::from_ref(robot), now_ms).await?;
    Ok(write.update_settings(robot, &settings).await?)
}

fn shown_settings(settings: Option<&RobotSettings>) -> String {
    settings.map_or("none".to_owned(), |settings| {
        serde_json::to_string(settings).expect("a wire type always has a JSON form")
    })
}

/// An error if the number of robots waiting for approval is at its limit.
async fn check_room(write: &mut Write) -> Result<(), ActionError> {
    if write.count_pending().await? < MOST_PENDING {
        Ok(())
    } else {
        Err(ActionError::TooManyPending(MOST_PENDING))
    }
}

/// The audit event of a robot's removal: the only record left of the robot.
pub(super) fn removal(by: &Person, robot: &KnownRobot) -> Deed {
    Deed::by(by, Act::RobotRemove, &robot.id).with("name", &robot.name).with("mac", robot.mac)
}
