//! Sessions of the web page. A session has the rights that its token has now, and ends with the
//! token. Its key is the digest of its cookie: the cookie itself is never stored.

use sqlx::Row as _;
use task_proto::trust::token::Token;
use task_proto::{Digest, TokenId, UserName};

use crate::domain::person::Person;
use crate::store::repositories::PageSessions;
use crate::store::rows::{id, number, stored};
use crate::store::{Store, StoreError, Transaction};

/// The most sessions at a time; one more ends the oldest.
const MAX_SESSIONS: i64 = 1_024;
/// The most sessions of one person at a time; one more ends the person's oldest. One person
/// therefore can't sign the others out.
const MAX_PER_PERSON: i64 = 32;

/// A session to be stored.
#[derive(Debug)]
pub struct NewPageSession<'a> {
    /// The SHA-256 of the cookie's value.
    pub digest: Digest,
    /// The token that begins the session.
    pub token: &'a Token,
    /// The person that the token belongs to.
    pub user: &'a UserName,
    /// Expiry time, in milliseconds.
    pub expires_at_ms: u64,
}

/// A session that is valid.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PageSession {
    /// The person, with the rights that the session's token has now.
    pub person: Person,
    /// The earlier of the session's and the token's expiry times, in milliseconds.
    pub expires_at_ms: u64,
}

impl PageSessions<&Store> {
    /// The session with this digest; `None` if the session or its token is unknown, expired or
    /// ended.
    pub async fn get(
        self,
        digest: &Digest,
        now_ms: u64,
    ) -> Result<Option<PageSession>, StoreError> {
        let row = sqlx::query(
            "SELECT token_id, token_digest, expires_at_ms FROM page_sessions
             WHERE digest = $1 AND expires_at_ms > $2",
        )
        .bind(digest.to_string())
        .bind(stored(now_ms))
        .fetch_optional(&self.0.reads)
        .await?;
        let Some(row) = row else { return Ok(None) };
        let token: TokenId = id("page_sessions.token_id", row.try_get("token_id")?)?;
        let of_token = self.0.tokens().person(&token, row.try_get("token_digest")?, now_ms).await?;
        let expires_at_ms = number(row.try_get("expires_at_ms")?);
        Ok(of_token.map(|(person, token_expires_at_ms)| PageSession {
            person,
            expires_at_ms: token_expires_at_ms.unwrap_or(u64::MAX).min(expires_at_ms),
        }))
    }

    /// The person of the session that [`Self::get`] finds. The answer may come from the cache.
    pub async fn admit(self, digest: &Digest, now_ms: u64) -> Result<Option<Person>, StoreError> {
        if let Some(person) = self.0.auth_cache.page_session(digest, now_ms) {
            return Ok(Some(person));
        }
        let epoch = self.0.auth_cache.epoch();
        let session = self.get(digest, now_ms).await?;
        if let Some(session) = &session {
            self.0.auth_cache.cache_page_session(epoch, digest, session);
        }
        Ok(session.map(|session| session.person))
    }

    /// Stores a session, in place of the one with the digest `replaced`. Returns whether sessions
    /// ended for it.
    pub async fn begin(
        self,
        new: &NewPageSession<'_>,
        replaced: Option<&Digest>,
    ) -> Result<bool, StoreError> {
        let mut write = self.0.begin_without_auth_invalidation().await?;
        let was_replaced = match replaced {
            Some(replaced) => write.page_sessions().delete(replaced).await?,
            None => false,
        };
        let has_ended_oldest = write.page_sessions().insert(new).await?;
        write.commit().await?;
        Ok(was_replaced || has_ended_oldest)
    }
}

impl PageSessions<&mut Transaction> {
    /// Stores a session. Beyond the most sessions of a person or of all, the oldest end. Returns
    /// whether some did.
    pub async fn insert(&mut self, new: &NewPageSession<'_>) -> Result<bool, StoreError> {
        let &NewPageSession { digest, token, user, expires_at_ms } = new;
        let surplus_of_user = sqlx::query(
            "DELETE FROM page_sessions WHERE digest IN (SELECT digest FROM page_sessions
                 WHERE user_name = $1 ORDER BY expires_at_ms DESC, digest LIMIT $2 OFFSET $3)",
        )
        .bind(user.as_str())
        .bind(MAX_SESSIONS)
        .bind(MAX_PER_PERSON - 1)
        .execute(self.0.connection())
        .await?;
        let surplus = sqlx::query(
            "DELETE FROM page_sessions WHERE digest IN (SELECT digest FROM page_sessions
                 ORDER BY expires_at_ms DESC, digest LIMIT $1 OFFSET $2)",
        )
        .bind(MAX_SESSIONS)
        .bind(MAX_SESSIONS - 1)
        .execute(self.0.connection())
        .await?;
        sqlx::query(
            "INSERT INTO page_sessions (digest, token_id, token_digest, user_name, expires_at_ms)
             VALUES ($1, $2, $3, $4, $5)",
        )
        .bind(digest.to_string())
        .bind(token.id())
        .bind(token.secret_digest().to_string())
        .bind(user.as_str())
        .bind(stored(expires_at_ms))
        .execute(self.0.connection())
        .await?;
        let has_ended = surplus_of_user.rows_affected() + surplus.rows_affected() > 0;
        if has_ended {
            self.0.mark_auth_change();
        }
        Ok(has_ended)
    }

    /// Ends a session. Returns whether there was one.
    pub async fn delete(&mut self, digest: &Digest) -> Result<bool, StoreError> {
        let deleted = sqlx::query("DELETE FROM page_sessions WHERE digest = $1")
            .bind(digest.to_string())
            .execute(self.0.connection())
            .await?;
        let was_there = deleted.rows_affected() > 0;
        if was_there {
            self.0.mark_auth_change();
        }
        Ok(was_there)
    }

    /// Deletes the sessions that have expired or whose token was removed.
    pub async fn delete_ended(&mut self, now_ms: u64) -> Result<(), StoreError> {
        sqlx::query(
            "DELETE FROM page_sessions WHERE expires_at_ms <= $1
             OR NOT EXISTS (SELECT 1 FROM tokens t WHERE t.id = page_sessions.token_id)",
        )
        .bind(stored(now_ms))
        .execute(self.0.connection())
        .await?;
        Ok(())
    }
}
