//! Enrolment tokens as an administrator looks after them, and robots that are put out.

use sqlx::Row as _;
use subtle::ConstantTimeEq as _;
use task_proto::api::EnrollmentTokenView;
use task_proto::token::{Token, TokenKind};
use task_proto::{RobotId, TokenId};

use super::rows::{from_optional_json, id, number, optional, stored};
use super::{Store, StoreError, Write};

/// The most that are listed.
const MOST_LISTED: i64 = 1_000;

impl Store {
    /// The enrolment tokens that are good for something at `now_ms`, the newest first.
    pub async fn enrolment_tokens(&self, now_ms: u64) -> Result<Vec<EnrollmentTokenView>, StoreError> {
        let rows = sqlx::query(
            "SELECT t.id, r.name AS robot, t.labels, t.uses_left, t.created_at_ms, t.expires_at_ms
             FROM tokens t LEFT JOIN robots r ON r.id = t.robot_id
             WHERE t.kind = 'enrolment' AND t.revoked_at_ms IS NULL AND t.expires_at_ms > $1
               AND (t.uses_left IS NULL OR t.uses_left > 0 OR EXISTS (SELECT 1 FROM tokens made
                    WHERE made.made_by = t.id AND made.used_at_ms IS NULL AND made.revoked_at_ms IS NULL))
             ORDER BY t.number DESC LIMIT $2",
        )
        .bind(stored(now_ms))
        .bind(MOST_LISTED)
        .fetch_all(&self.reads)
        .await?;
        rows.iter().map(enrolment_token).collect()
    }

    /// Whether `token` is one that a robot had when it was revoked: whoever shows it is told so.
    pub async fn is_of_revoked_robot(&self, token: &Token) -> Result<bool, StoreError> {
        if token.kind() != TokenKind::Robot {
            return Ok(false);
        }
        let digest: Option<String> = sqlx::query_scalar(
            "SELECT t.digest FROM tokens t JOIN robots r ON r.id = t.robot_id
             WHERE t.id = $1 AND t.kind = 'robot' AND r.revoked_at_ms IS NOT NULL AND r.removed_at_ms IS NULL",
        )
        .bind(token.id())
        .fetch_optional(&self.reads)
        .await?;
        Ok(digest.is_some_and(|digest| digest.as_bytes().ct_eq(token.secret_digest().to_string().as_bytes()).into()))
    }
}

impl Write {
    /// Ends an enrolment token; false if there is none.
    pub async fn revoke_enrolment_token(&mut self, token: &TokenId, now_ms: u64) -> Result<bool, StoreError> {
        let ended: Option<String> = sqlx::query_scalar(
            "UPDATE tokens SET revoked_at_ms = $2 WHERE id = $1 AND kind = 'enrolment' AND revoked_at_ms IS NULL
             RETURNING id",
        )
        .bind(token.as_str())
        .bind(stored(now_ms))
        .fetch_optional(self.connection())
        .await?;
        Ok(ended.is_some())
    }

    /// Ends whatever `robot` could come in by; what is ordered of it stays. False if that was done before.
    pub async fn revoke_robot(&mut self, robot: &RobotId, now_ms: u64) -> Result<bool, StoreError> {
        // Reports that came by its tokens and are not stored yet come too late.
        let last_token = stored(self.turn());
        let revoked: Option<String> = sqlx::query_scalar(
            "UPDATE robots SET revoked_at_ms = $2, token_number = $3, broker_credential = broker_credential + 1
             WHERE id = $1 AND revoked_at_ms IS NULL RETURNING id",
        )
        .bind(robot.as_str())
        .bind(stored(now_ms))
        .bind(last_token)
        .fetch_optional(self.connection())
        .await?;
        if revoked.is_some() {
            self.revoke_tokens(robot, now_ms).await?;
        }
        Ok(revoked.is_some())
    }

    /// Takes a robot back that was revoked and is registered anew. The tokens from before stay ended.
    pub async fn readmit(&mut self, robot: &RobotId) -> Result<(), StoreError> {
        sqlx::query("UPDATE robots SET revoked_at_ms = NULL WHERE id = $1")
            .bind(robot.as_str())
            .execute(self.connection())
            .await?;
        Ok(())
    }
}

fn enrolment_token(row: &sqlx::any::AnyRow) -> Result<EnrollmentTokenView, StoreError> {
    Ok(EnrollmentTokenView {
        id: id("tokens.id", row.try_get("id")?)?,
        robot: optional("robots.name", row.try_get("robot")?)?,
        labels: from_optional_json("tokens.labels", row.try_get("labels")?)?.unwrap_or_default(),
        uses_left: row.try_get::<Option<i64>, _>("uses_left")?.map(number),
        created_at_ms: number(row.try_get("created_at_ms")?),
        expires_at_ms: number(row.try_get("expires_at_ms")?),
    })
}
