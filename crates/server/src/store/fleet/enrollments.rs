//! Enrollment tokens for administrators, robots that wait for approval, and revoked robots.

use sqlx::Row as _;
use std::net::IpAddr;
use subtle::ConstantTimeEq as _;
use task_proto::api::{EnrollmentTokenView, PendingRobot};
use task_proto::trust::token::{Token, TokenKind};

use task_proto::{RobotId, TokenId};

use super::robots::known_robot;
use crate::store::repositories::{Enrollments, Robots, Tokens};
use crate::store::rows::{from_json, from_optional_json, id, number, optional, stored};
use crate::store::{KnownRobot, Store, StoreError, Transaction};

/// The most entries in a list.
const MAX_LISTED: i64 = 1_000;

impl Enrollments<&Store> {
    /// The enrollment tokens that are valid at `now_ms`, the newest first.
    pub async fn tokens(self, now_ms: u64) -> Result<Vec<EnrollmentTokenView>, StoreError> {
        let rows = sqlx::query(
            "SELECT t.id, r.name AS robot, t.labels, t.uses_left, t.approval, t.created_at_ms, t.expires_at_ms
             FROM tokens t LEFT JOIN robots r ON r.id = t.robot_id
             WHERE t.kind = 'enrolment' AND t.revoked_at_ms IS NULL AND t.expires_at_ms > $1
               AND (t.uses_left IS NULL OR t.uses_left > 0 OR EXISTS (SELECT 1 FROM tokens made
                    WHERE made.made_by = t.id AND made.used_at_ms IS NULL AND made.revoked_at_ms IS NULL))
             ORDER BY t.number DESC LIMIT $2",
        )
        .bind(stored(now_ms))
        .bind(MAX_LISTED)
        .fetch_all(&self.0.reads)
        .await?;
        rows.iter().map(enrollment_token).collect()
    }

    /// The robots that wait for approval, the longest wait first.
    pub async fn pending(self) -> Result<Vec<PendingRobot>, StoreError> {
        let rows = sqlx::query(
            "SELECT id, name, mac, labels, enrolled_at_ms, enrolled_by, enrolled_from FROM robots
             WHERE awaits_approval = 1 AND removed_at_ms IS NULL ORDER BY enrolled_at_ms, id LIMIT $1",
        )
        .bind(MAX_LISTED)
        .fetch_all(&self.0.reads)
        .await?;
        rows.iter().map(pending_robot).collect()
    }
}

impl Tokens<&Store> {
    /// Whether `token` belonged to a robot when the robot was revoked: a client that presents the
    /// token is told so.
    pub async fn belongs_to_revoked_robot(self, token: &Token) -> Result<bool, StoreError> {
        if token.kind() != TokenKind::Robot {
            return Ok(false);
        }
        let digest: Option<String> = sqlx::query_scalar(
            "SELECT t.digest FROM tokens t JOIN robots r ON r.id = t.robot_id
             WHERE t.id = $1 AND t.kind = 'robot' AND r.revoked_at_ms IS NOT NULL AND r.removed_at_ms IS NULL",
        )
        .bind(token.id())
        .fetch_optional(&self.0.reads)
        .await?;
        Ok(digest.is_some_and(|digest| {
            digest.as_bytes().ct_eq(token.secret_digest().to_string().as_bytes()).into()
        }))
    }
}

impl Enrollments<&mut Transaction> {
    /// Revokes an enrollment token; false if there is none.
    pub async fn revoke_token(&mut self, token: &TokenId, now_ms: u64) -> Result<bool, StoreError> {
        let ended: Option<String> = sqlx::query_scalar(
            "UPDATE tokens SET revoked_at_ms = $2 WHERE id = $1 AND kind = 'enrolment' AND revoked_at_ms IS NULL
             RETURNING id",
        )
        .bind(token.as_str())
        .bind(stored(now_ms))
        .fetch_optional(self.0.connection())
        .await?;
        Ok(ended.is_some())
    }

    /// The number of robots that wait for approval.
    pub async fn count_pending(&mut self) -> Result<u64, StoreError> {
        let sql = "SELECT COUNT(*) FROM robots WHERE awaits_approval = 1 AND removed_at_ms IS NULL";
        let count: i64 = sqlx::query_scalar(sql).fetch_one(self.0.connection()).await?;
        Ok(number(count))
    }

    /// Whether the robot waits for approval.
    pub async fn is_pending(&mut self, robot: &RobotId) -> Result<bool, StoreError> {
        let sql =
            "SELECT id FROM robots WHERE id = $1 AND awaits_approval = 1 AND removed_at_ms IS NULL";
        let found: Option<String> = sqlx::query_scalar(sql)
            .bind(robot.as_str())
            .fetch_optional(self.0.connection())
            .await?;
        Ok(found.is_some())
    }

    /// The robots that have waited for approval since before `before_ms`.
    pub async fn pending_since(&mut self, before_ms: u64) -> Result<Vec<KnownRobot>, StoreError> {
        let rows = sqlx::query(
            "SELECT id, name, mac, labels FROM robots
             WHERE awaits_approval = 1 AND removed_at_ms IS NULL AND enrolled_at_ms < $1",
        )
        .bind(stored(before_ms))
        .fetch_all(self.0.connection())
        .await?;
        rows.iter().map(known_robot).collect()
    }

    /// Records the token and the address of a robot's enrollment, just after its registration. The
    /// robot may have to wait for approval.
    pub async fn record(
        &mut self,
        robot: &RobotId,
        token: &Token,
        address: Option<IpAddr>,
        awaits_approval: bool,
    ) -> Result<(), StoreError> {
        sqlx::query("UPDATE robots SET enrolled_by = $2, enrolled_from = $3, awaits_approval = $4 WHERE id = $1")
            .bind(robot.as_str())
            .bind(token.id())
            .bind(address.map(|address| address.to_string()))
            .bind(i64::from(awaits_approval))
            .execute(self.0.connection())
            .await?;
        Ok(())
    }

    /// Approves the robot: from now on it is a robot like any other.
    pub async fn approve(&mut self, robot: &RobotId) -> Result<(), StoreError> {
        sqlx::query("UPDATE robots SET awaits_approval = 0 WHERE id = $1")
            .bind(robot.as_str())
            .execute(self.0.connection())
            .await?;
        Ok(())
    }
}

impl Robots<&mut Transaction> {
    /// Revokes all tokens of `robot`; its orders stay. False if the robot was revoked before.
    pub async fn revoke(&mut self, robot: &RobotId, now_ms: u64) -> Result<bool, StoreError> {
        // Reports under the revoked tokens that are not stored yet come too late.
        let last_token = stored(self.0.sequence());
        let revoked: Option<String> = sqlx::query_scalar(
            "UPDATE robots SET revoked_at_ms = $2, token_number = $3, broker_credential = broker_credential + 1
             WHERE id = $1 AND revoked_at_ms IS NULL RETURNING id",
        )
        .bind(robot.as_str())
        .bind(stored(now_ms))
        .bind(last_token)
        .fetch_optional(self.0.connection())
        .await?;
        if revoked.is_some() {
            self.0.tokens().revoke_all_of(std::slice::from_ref(robot), now_ms).await?;
        }
        Ok(revoked.is_some())
    }

    /// Readmits a revoked robot that is registered anew. The earlier tokens stay revoked.
    pub async fn clear_revocation(&mut self, robot: &RobotId) -> Result<(), StoreError> {
        sqlx::query("UPDATE robots SET revoked_at_ms = NULL WHERE id = $1")
            .bind(robot.as_str())
            .execute(self.0.connection())
            .await?;
        Ok(())
    }
}

fn enrollment_token(row: &sqlx::any::AnyRow) -> Result<EnrollmentTokenView, StoreError> {
    Ok(EnrollmentTokenView {
        id: id("tokens.id", row.try_get("id")?)?,
        robot: optional("robots.name", row.try_get("robot")?)?,
        labels: from_optional_json("tokens.labels", row.try_get("labels")?)?.unwrap_or_default(),
        uses_left: row.try_get::<Option<i64>, _>("uses_left")?.map(number),
        approval: row.try_get::<i64, _>("approval")? != 0,
        created_at_ms: number(row.try_get("created_at_ms")?),
        expires_at_ms: number(row.try_get("expires_at_ms")?),
    })
}

fn pending_robot(row: &sqlx::any::AnyRow) -> Result<PendingRobot, StoreError> {
    Ok(PendingRobot {
        id: id("robots.id", row.try_get("id")?)?,
        name: id("robots.name", row.try_get("name")?)?,
        mac: id("robots.mac", row.try_get("mac")?)?,
        labels: from_json("robots.labels", row.try_get("labels")?)?,
        since_ms: number(row.try_get("enrolled_at_ms")?),
        token: optional("robots.enrolled_by", row.try_get("enrolled_by")?)?,
        address: row.try_get("enrolled_from")?,
    })
}
