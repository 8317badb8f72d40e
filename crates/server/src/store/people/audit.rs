//! The audit log. Each entry is added by the write that it describes, and none is ever changed or
//! removed. To bound its size, we limit the number of acts per day that a person does on their own
//! account.

use std::collections::BTreeMap;
use std::net::IpAddr;
use std::time::{Duration, Instant};

use sqlx::{AssertSqlSafe, Row as _};
use task_proto::TokenId;
use task_proto::api::{AuditPage, AuditQuery};
use task_proto::people::audit::{AuditEntry, AuditRecord, ChainLink};
use task_proto::people::roles::Permission;

use crate::domain::limits::keyed_rate_limit::{KeyedRateLimit, seconds};
use crate::domain::person::Person;
use crate::store::repositories::Audit;
use crate::store::rows::{id, json, number, stored};
use crate::store::{KnownRobot, Store, StoreError, Transaction};

/// The most entries in one answer.
const MAX_RECORDS: u64 = 1_000;
/// The most bytes of entries in one answer.
const MAX_PAGE_BYTES: usize = 4 * 1024 * 1024;
/// The longest stored text of a target or a detail: a selector may be as long as 64 KiB.
const MAX_TEXT_CHARACTERS: usize = 1_000;

/// An action that the audit log records.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AuditAction {
    /// A robot enrolled, for the first time or again.
    RobotEnroll,
    /// A waiting robot was approved.
    RobotApprove,
    /// A waiting robot was rejected.
    RobotReject,
    /// A robot's name or labels were changed.
    RobotEdit,
    /// A robot was removed.
    RobotRemove,
    /// Labels of many robots were changed.
    BulkLabels,
    /// Many robots were removed.
    BulkRemove,
    /// A robot's tokens were ended.
    RobotRevoke,
    /// A robot was asked for an immediate change, like one of a parameter.
    RobotAsk,
    /// An enrollment token was made.
    EnrollmentCreate,
    /// An enrollment token was revoked.
    EnrollmentRevoke,
    /// A package was ordered.
    DeploymentCreate,
    /// An order was cancelled.
    DeploymentCancel,
    /// A paused order was resumed.
    DeploymentResume,
    /// An order that had ended without success was retried.
    DeploymentRetry,
    /// A task was ordered to start.
    TaskStart,
    /// A task was ordered to restart.
    TaskRestart,
    /// A task was ordered back to its previous package.
    TaskRollBack,
    /// A task was ordered to stop.
    TaskStop,
    /// A task was ordered to be removed.
    TaskRemove,
    /// A manifest was pushed.
    ManifestPush,
    /// A manifest was deleted.
    ManifestDelete,
    /// A tag was deleted.
    TagDelete,
    /// A blob was removed from a repository.
    BlobDelete,
    /// A user was added.
    UserAdd,
    /// A user's roles or scope were changed.
    UserEdit,
    /// A user was removed.
    UserRemove,
    /// A password was set.
    UserPassword,
    /// A user signed in with a password.
    SignIn,
    /// A user signed out.
    SignOut,
    /// Sign-ins are blocked for a while after too many failures.
    SignInBlocked,
    /// An access token was made.
    TokenCreate,
    /// An access token was revoked.
    TokenRevoke,
    /// A server of the cluster was told to send its robots to the others.
    NodeDrain,
}

impl AuditAction {
    /// The name of the action in the audit log.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::RobotEnroll => "robot.enroll",
            Self::RobotApprove => "robot.approve",
            Self::RobotReject => "robot.reject",
            Self::RobotEdit => "robot.edit",
            Self::RobotRemove => "robot.remove",
            Self::BulkLabels => "bulk.labels",
            Self::BulkRemove => "bulk.remove",
            Self::RobotRevoke => "robot.revoke",
            Self::RobotAsk => "robot.ask",
            Self::EnrollmentCreate => "enrolment_token.create",
            Self::EnrollmentRevoke => "enrolment_token.revoke",
            Self::DeploymentCreate => "deployment.create",
            Self::DeploymentCancel => "deployment.cancel",
            Self::DeploymentResume => "deployment.resume",
            Self::TaskStart => "task.start",
            Self::DeploymentRetry => "deployment.retry",
            Self::TaskRestart => "task.restart",
            Self::TaskRollBack => "task.rollback",
            Self::TaskStop => "task.stop",
            Self::TaskRemove => "task.remove",
            Self::ManifestPush => "manifest.push",
            Self::ManifestDelete => "manifest.delete",
            Self::TagDelete => "tag.delete",
            Self::BlobDelete => "blob.delete",
            Self::UserAdd => "user.add",
            Self::UserEdit => "user.edit",
            Self::UserRemove => "user.remove",
            Self::UserPassword => "user.password",
            Self::SignIn => "sign_in",
            Self::SignOut => "sign_out",
            Self::SignInBlocked => "sign_in.blocked",
            Self::TokenCreate => "token.create",
            Self::TokenRevoke => "token.revoke",
            Self::NodeDrain => "server.drain",
        }
    }
}

impl AuditAction {
    /// Whether everybody may cause the action repeatedly: a person on their own account, whatever
    /// their role, or a stranger by wrong passwords. Signing out and revoking a token are excluded:
    /// each ends once something that such an act began. All other acts take a role that we trust
    /// with more than the length of the audit log, and an order must not wait.
    fn is_limited(self) -> bool {
        matches!(self, Self::SignIn | Self::SignInBlocked | Self::TokenCreate | Self::UserPassword)
    }
}

/// The rate limit of one person for such acts, and of the server for blocks of sign-ins: a burst
/// after a rest, and then 2,000 a day.
pub(in crate::store) fn new_audit_limit() -> KeyedRateLimit {
    KeyedRateLimit::new(Duration::from_secs(24 * 60 * 60) / 2_000, 200)
}

/// An entry for the audit log, described by its caller. A secret must never be part of it.
#[derive(Debug, Clone)]
pub struct AuditEvent {
    actor: String,
    token: Option<TokenId>,
    address: Option<IpAddr>,
    /// The person whose rights are used; `None`: the act uses no rights, like signing in.
    by: Option<Person>,
    action: AuditAction,
    target: String,
    detail: BTreeMap<String, String>,
}

impl AuditEvent {
    /// `person` does `action` to `target`.
    pub fn by(person: &Person, action: AuditAction, target: impl ToString) -> Self {
        let (actor, token) = (person.name.to_string(), Some(person.token.clone()));
        Self { by: Some(person.clone()), ..Self::new(actor, token, person.address, action, target) }
    }

    /// An act without a user, or before the user is known.
    pub fn new(
        actor: String,
        token: Option<TokenId>,
        address: Option<IpAddr>,
        action: AuditAction,
        target: impl ToString,
    ) -> Self {
        Self {
            actor,
            token,
            address,
            by: None,
            action,
            target: shortened(&target.to_string()),
            detail: BTreeMap::new(),
        }
    }

    pub fn with(mut self, key: &str, value: impl ToString) -> Self {
        self.detail.insert(key.to_owned(), shortened(&value.to_string()));
        self
    }

    /// Adds a detail, if there is a value.
    pub fn with_some(self, key: &str, value: Option<impl ToString>) -> Self {
        match value {
            Some(value) => self.with(key, value),
            None => self,
        }
    }
}

impl AuditEvent {
    /// Whether a robot is in the scope of the acting person.
    pub(in crate::store) fn covers(&self, robot: &KnownRobot) -> bool {
        self.by.as_ref().is_some_and(|by| by.scope.covers(&robot.id, &robot.name, &robot.labels))
    }
}

/// Shortens a text to the stored length and replaces control characters with spaces: neither a
/// terminal nor Postgres takes every one.
fn shortened(text: &str) -> String {
    let mut characters = text.chars().map(|c| if c.is_control() { ' ' } else { c });
    let mut kept: String = characters.by_ref().take(MAX_TEXT_CHARACTERS).collect();
    if characters.next().is_some() {
        kept.push('…');
    }
    kept
}

impl Audit<&mut Transaction> {
    /// Records the act of this write. The entry exists if and only if the write is committed. The
    /// write fails if the person's rights have ended meanwhile: a request's body can come long
    /// after its head. A write that changes the rights of its own caller therefore has to call this
    /// first.
    pub async fn record(&mut self, event: &AuditEvent, now_ms: u64) -> Result<(), StoreError> {
        if let Some(by) = &event.by {
            self.0.tokens().check_rights(by, now_ms).await?;
        }
        if event.action.is_limited()
            && !event.by.as_ref().is_some_and(|by| by.may(Permission::Administer))
        {
            let taken = self.0.audit_limit.take(&event.actor, Instant::now());
            taken.map_err(|wait| StoreError::TooManyActs {
                user: event.actor.clone(),
                seconds: seconds(wait),
            })?;
        }
        let last = sqlx::query("SELECT number, digest FROM audit ORDER BY number DESC LIMIT 1")
            .fetch_optional(self.0.connection())
            .await?;
        let last = match last {
            Some(row) => {
                let digest = id("audit.digest", row.try_get("digest")?)?;
                ChainLink { number: number(row.try_get("number")?), digest }
            }
            None => ChainLink::START,
        };
        let entry = json(&AuditEntry {
            number: last.number + 1,
            at_ms: now_ms,
            who: event.actor.clone(),
            token: event.token.clone(),
            address: event.address,
            act: event.action.as_str().to_owned(),
            target: event.target.clone(),
            detail: event.detail.clone(),
        });
        let link = last.next(&entry);
        sqlx::query("INSERT INTO audit (number, who, act, target, entry, digest) VALUES ($1, $2, $3, $4, $5, $6)")
            .bind(stored(link.number))
            .bind(event.actor.as_str())
            .bind(event.action.as_str())
            .bind(event.target.as_str())
            .bind(entry)
            .bind(link.digest.to_string())
            .execute(self.0.connection())
            .await?;
        Ok(())
    }
}

impl Transaction {
    /// Records the act, if there is one, and commits the write.
    pub(in crate::store) async fn commit_with_audit(
        mut self,
        event: Option<&AuditEvent>,
        now_ms: u64,
    ) -> Result<(), StoreError> {
        if let Some(event) = event {
            self.audit().record(event, now_ms).await?;
        }
        self.commit().await
    }
}

impl Audit<&Store> {
    /// Reads entries of the audit log: those after a number, oldest first, or else newest first.
    pub async fn page(self, query: &AuditQuery) -> Result<AuditPage, StoreError> {
        let last: Option<i64> =
            sqlx::query_scalar("SELECT MAX(number) FROM audit").fetch_one(&self.0.reads).await?;
        let order = if query.after.is_some() { "ASC" } else { "DESC" };
        let limit = query.limit.unwrap_or(MAX_RECORDS).min(MAX_RECORDS);
        let rows = sqlx::query(AssertSqlSafe(format!(
            "SELECT entry, digest FROM audit
             WHERE number > $1 AND number < $2 AND (who = $3 OR $3 = '') AND ($4 = '' OR target = $4 OR target IN (SELECT id FROM robots WHERE name = $4))
               AND substr(act, 1, CAST($6 AS INTEGER)) = $5
             ORDER BY number {order} LIMIT $7"
        )))
        .bind(stored(query.after.unwrap_or(0)))
        .bind(stored(query.before.unwrap_or(u64::MAX)))
        .bind(query.who.as_deref().unwrap_or_default())
        .bind(query.target.as_deref().unwrap_or_default())
        .bind(query.act.as_deref().unwrap_or_default())
        .bind(stored(query.act.as_deref().map_or(0, |act| act.chars().count() as u64)))
        .bind(stored(limit))
        .fetch_all(&self.0.reads)
        .await?;
        let (mut records, mut bytes) = (Vec::with_capacity(rows.len()), 0);
        for row in rows {
            let entry: String = row.try_get("entry")?;
            bytes += entry.len();
            if bytes > MAX_PAGE_BYTES && !records.is_empty() {
                break;
            }
            let entry = serde_json::value::RawValue::from_string(entry)
                .map_err(|_| StoreError::Unreadable { column: "audit.entry" })?;
            records
                .push(AuditRecord { digest: id("audit.digest", row.try_get("digest")?)?, entry });
        }
        Ok(AuditPage { records, last: last.map_or(0, number) })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn audit_entries_are_never_updated_or_deleted() {
        let mut directories =
            vec![std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("src/store")];
        let mut looked_at = 0;
        while let Some(directory) = directories.pop() {
            for file in std::fs::read_dir(directory).expect("a directory") {
                let path = file.expect("a file").path();
                if path.is_dir() {
                    directories.push(path);
                    continue;
                }
                let text = std::fs::read_to_string(path).expect("text");
                let statements =
                    text.split_whitespace().collect::<Vec<_>>().join(" ").to_lowercase();
                for verb in ["update", "delete from", "drop table", "alter table", "truncate"] {
                    assert!(!statements.contains(&format!("{verb} audit ")), "{verb}");
                }
                looked_at += usize::from(statements.contains("into audit ("));
            }
        }
        assert_eq!(looked_at, 1, "entries are added in one place");
    }

    #[test]
    fn stored_text_is_truncated_and_has_no_control_characters() {
        assert_eq!(shortened("site=lab"), "site=lab");
        assert_eq!(shortened("a\u{1b}[2J\0b\n"), "a [2J b ");
        let long = shortened(&"é".repeat(5_000));
        assert_eq!((long.chars().count(), long.ends_with('…')), (MAX_TEXT_CHARACTERS + 1, true));
        assert_eq!(shortened(&"é".repeat(MAX_TEXT_CHARACTERS)), "é".repeat(MAX_TEXT_CHARACTERS));
    }
}
