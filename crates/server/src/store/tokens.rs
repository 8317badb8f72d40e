//! Tokens: stored as digests of their secrets, with what each may do.

use sqlx::Row as _;
use subtle::ConstantTimeEq as _;
use task_proto::RobotId;
use task_proto::id::Labels;
use task_proto::token::{Token, TokenKind};

use super::rows::{from_optional_json, id, json, number, stored};
use super::{Store, StoreError, Write};

/// Whom a valid token stands for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum TokenHolder {
    /// An operator.
    Operator,
    /// Someone who may enrol.
    Enrolment,
    /// This robot.
    Robot(RobotId),
}

/// What an enrolment token is good for.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct EnrolmentTerms {
    /// Only this robot may use it.
    pub robot: Option<RobotId>,
    /// Labels that whoever uses it gets.
    pub labels: Labels,
    /// Enrolments left; `None`: any number.
    pub uses_left: Option<u64>,
    /// When it ends.
    pub expires_at_ms: u64,
}

struct TokenRow {
    digest: String,
    robot: Option<RobotId>,
    labels: Labels,
    uses_left: Option<u64>,
    expires_at_ms: Option<u64>,
}

const VALID_TOKEN: &str = "SELECT digest, robot_id, labels, uses_left, expires_at_ms FROM tokens
     WHERE id = $1 AND kind = $2 AND revoked_at_ms IS NULL AND (expires_at_ms IS NULL OR expires_at_ms > $3)
       AND (uses_left IS NULL OR uses_left > 0)";

impl Store {
    /// Whom `token` stands for at `now_ms`; `None` if it is unknown, wrong, used up, expired or revoked.
    pub async fn token_holder(&self, token: &Token, now_ms: u64) -> Result<Option<TokenHolder>, StoreError> {
        let row = sqlx::query(VALID_TOKEN)
            .bind(token.id())
            .bind(kind_text(token.kind()))
            .bind(stored(now_ms))
            .fetch_optional(&self.reads)
            .await?;
        let Some(row) = row.map(token_row).transpose()?.filter(|row| row.has_secret_of(token)) else { return Ok(None) };
        Ok(match token.kind() {
            TokenKind::Operator => Some(TokenHolder::Operator),
            TokenKind::Enrolment => Some(TokenHolder::Enrolment),
            TokenKind::Robot => row.robot.map(TokenHolder::Robot),
        })
    }

    /// Stores an operator's token that does not expire.
    pub async fn create_operator_token(&self, token: &Token, now_ms: u64) -> Result<(), StoreError> {
        let mut write = self.begin().await?;
        write.insert_token(token, None, now_ms).await?;
        write.commit().await
    }
}

impl Write {
    /// What the enrolment token `token` is good for now; `None` if it is good for nothing.
    pub async fn enrolment_terms(&mut self, token: &Token, now_ms: u64) -> Result<Option<EnrolmentTerms>, StoreError> {
        if token.kind() != TokenKind::Enrolment {
            return Ok(None);
        }
        let row = sqlx::query(VALID_TOKEN)
            .bind(token.id())
            .bind(kind_text(token.kind()))
            .bind(stored(now_ms))
            .fetch_optional(self.connection())
            .await?;
        let row = row.map(token_row).transpose()?.filter(|row| row.has_secret_of(token));
        Ok(row.map(|row| EnrolmentTerms {
            robot: row.robot,
            labels: row.labels,
            uses_left: row.uses_left,
            expires_at_ms: row.expires_at_ms.unwrap_or(u64::MAX),
        }))
    }

    /// Counts one enrolment by `token`.
    pub async fn use_enrolment_token(&mut self, token: &Token) -> Result<(), StoreError> {
        sqlx::query("UPDATE tokens SET uses_left = uses_left - 1 WHERE id = $1 AND uses_left IS NOT NULL")
            .bind(token.id())
            .execute(self.connection())
            .await?;
        Ok(())
    }

    /// Stores an enrolment token.
    pub async fn create_enrolment_token(
        &mut self,
        token: &Token,
        terms: &EnrolmentTerms,
        now_ms: u64,
    ) -> Result<(), StoreError> {
        self.insert_token(token, terms.robot.as_ref(), now_ms).await?;
        sqlx::query("UPDATE tokens SET labels = $2, uses_left = $3, expires_at_ms = $4 WHERE id = $1")
            .bind(token.id())
            .bind(json(&terms.labels))
            .bind(terms.uses_left.map(stored))
            .bind(stored(terms.expires_at_ms))
            .execute(self.connection())
            .await?;
        Ok(())
    }

    /// Makes `token` the only one of `robot`.
    pub async fn replace_robot_token(&mut self, token: &Token, robot: &RobotId, now_ms: u64) -> Result<(), StoreError> {
        self.revoke_tokens(robot, Some(TokenKind::Robot), now_ms).await?;
        self.insert_token(token, Some(robot), now_ms).await
    }

    /// Ends the tokens made for `robot`, of one kind or of all.
    pub async fn revoke_tokens(
        &mut self,
        robot: &RobotId,
        kind: Option<TokenKind>,
        now_ms: u64,
    ) -> Result<(), StoreError> {
        sqlx::query(
            "UPDATE tokens SET revoked_at_ms = $2
             WHERE robot_id = $1 AND revoked_at_ms IS NULL AND (kind = $3 OR $3 = '')",
        )
        .bind(robot.as_str())
        .bind(stored(now_ms))
        .bind(kind.map_or("", kind_text))
        .execute(self.connection())
        .await?;
        Ok(())
    }

    /// Forgets enrolment and robot tokens that are good for nothing any more. A revoked operator token stays: the one in the
    /// data directory must not come back to life at the next start.
    pub async fn forget_ended_tokens(&mut self, now_ms: u64) -> Result<(), StoreError> {
        sqlx::query(
            "DELETE FROM tokens
             WHERE kind <> 'operator' AND (revoked_at_ms IS NOT NULL OR expires_at_ms <= $1 OR uses_left = 0)",
        )
        .bind(stored(now_ms))
        .execute(self.connection())
        .await?;
        Ok(())
    }

    async fn insert_token(&mut self, token: &Token, robot: Option<&RobotId>, now_ms: u64) -> Result<(), StoreError> {
        sqlx::query("INSERT INTO tokens (id, kind, digest, robot_id, created_at_ms) VALUES ($1, $2, $3, $4, $5)")
            .bind(token.id())
            .bind(kind_text(token.kind()))
            .bind(token.secret_digest().to_string())
            .bind(robot.map(|robot| robot.as_str().to_owned()))
            .bind(stored(now_ms))
            .execute(self.connection())
            .await?;
        Ok(())
    }
}

impl TokenRow {
    fn has_secret_of(&self, token: &Token) -> bool {
        self.digest.as_bytes().ct_eq(token.secret_digest().to_string().as_bytes()).into()
    }
}

fn token_row(row: sqlx::any::AnyRow) -> Result<TokenRow, StoreError> {
    let robot: Option<String> = row.try_get("robot_id")?;
    Ok(TokenRow {
        digest: row.try_get("digest")?,
        robot: robot.map(|robot| id("tokens.robot_id", &robot)).transpose()?,
        labels: from_optional_json("tokens.labels", row.try_get("labels")?)?.unwrap_or_default(),
        uses_left: row.try_get::<Option<i64>, _>("uses_left")?.map(number),
        expires_at_ms: row.try_get::<Option<i64>, _>("expires_at_ms")?.map(number),
    })
}

fn kind_text(kind: TokenKind) -> &'static str {
    match kind {
        TokenKind::Operator => "operator",
        TokenKind::Enrolment => "enrolment",
        TokenKind::Robot => "robot",
    }
}
