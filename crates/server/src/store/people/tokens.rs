//! Tokens: stored as digests of their secrets, with their permissions. A robot has at most two
//! valid tokens: the one in use, and a new one that ends the other on its first use.

use std::collections::BTreeSet;

use sqlx::{AssertSqlSafe, Row as _};
use subtle::ConstantTimeEq as _;
use task_proto::api::TokenOrigin;
use task_proto::ids::Labels;
use task_proto::ids::selector::Selector;
use task_proto::people::roles::Roles;
use task_proto::trust::envelope::PublicKey;
use task_proto::trust::token::{Token, TokenKind};
use task_proto::{RobotId, TokenId, UserName};

use crate::domain::person::{Person, Scope};
use crate::net::tls::ClientProof;
use crate::store::repositories::{Enrollments, Tokens};
use crate::store::rows::{
    from_optional_json, from_word, groups, id, json, number, optional, stored, values,
};
use crate::store::{Store, StoreError, Transaction};

/// The holder of a valid token.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum TokenHolder {
    Person(Person),
    /// The holder of an enrollment token.
    Enrollment,
    Robot {
        robot: RobotId,
        /// The number of the token: a later one has a higher number.
        token_number: u64,
        /// The public key that the robot registered with the token.
        key: Option<PublicKey>,
    },
    /// A robot that waits for approval and has no permissions yet.
    Pending {
        robot: RobotId,
        /// The public key that the robot registered with the token.
        key: Option<PublicKey>,
    },
}

impl TokenHolder {
    fn is_proven_by(&self, proof: &ClientProof) -> bool {
        match self {
            Self::Robot { key, .. } | Self::Pending { key, .. } => proof.suffices(key.as_ref()),
            Self::Person(_) | Self::Enrollment => true,
        }
    }
}

/// A token that was presented and is valid.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Admitted {
    /// The holder of the token.
    pub holder: TokenHolder,
    /// Whether this is a robot's first use of the token, which has just ended the robot's other
    /// tokens.
    pub is_first_use: bool,
}

/// The terms of an enrollment token.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct EnrollmentTerms {
    /// Only this robot may use it.
    pub robot: Option<RobotId>,
    /// Labels given to each robot that enrolls with the token.
    pub labels: Labels,
    /// Enrollments left; `None`: any number. At zero the token is only valid for an enrollment
    /// whose answer was lost.
    pub uses_left: Option<u64>,
    /// The time at which the token expires.
    pub expires_at_ms: u64,
    /// Whether a new robot that enrolls with the token waits for approval.
    pub approval: bool,
}

struct TokenRow {
    digest: String,
    robot: Option<RobotId>,
    labels: Labels,
    uses_left: Option<u64>,
    expires_at_ms: Option<u64>,
    is_used: bool,
    approval: bool,
    /// For a robot's token: whether the robot waits for approval.
    is_pending: bool,
    number: u64,
    user: Option<UserPart>,
    key: Option<PublicKey>,
}

/// For a user's token: the user's present rights, and the limits of the token.
struct UserPart {
    name: UserName,
    /// Roles and scope; `None` if the user was removed.
    user: Option<(Roles, Option<Selector>)>,
    roles: Option<Roles>,
    scope: Option<Selector>,
    origin: TokenOrigin,
}

/// Selects a valid token. An enrollment token without a use left stays valid while a token
/// that came from it was never used, because the answer with that token may have been lost.
const VALID_TOKEN: &str = "SELECT t.digest, t.robot_id, t.labels, t.uses_left, t.expires_at_ms, t.used_at_ms, t.number,
         t.client_key, t.user_name, t.roles, t.scope, t.origin, t.approval, u.roles AS user_roles, u.scope AS user_scope,
         r.awaits_approval
     FROM tokens t LEFT JOIN users u ON u.name = t.user_name LEFT JOIN robots r ON r.id = t.robot_id
     WHERE t.id = $1 AND t.kind = $2 AND t.revoked_at_ms IS NULL AND (t.expires_at_ms IS NULL OR t.expires_at_ms > $3)
       AND (t.uses_left IS NULL OR t.uses_left > 0 OR EXISTS (SELECT 1 FROM tokens made
            WHERE made.made_by = t.id AND made.used_at_ms IS NULL AND made.revoked_at_ms IS NULL))";

impl Tokens<&Store> {
    /// The holder of `token` at `now_ms`; `None` if the token is unknown, wrong, used up, expired
    /// or revoked. Changes nothing.
    pub async fn holder(
        self,
        token: &Token,
        now_ms: u64,
    ) -> Result<Option<TokenHolder>, StoreError> {
        let row = self.find_valid(token, now_ms).await?;
        Ok(row.and_then(|row| row.holder(token)))
    }

    /// Finds the holder of `token` as [`Self::holder`] does, and admits the client. A robot's
    /// first use of a token ends its other tokens. A robot that has registered a key must have
    /// proven its possession, if the server asked for the proof. Otherwise the token counts as
    /// unknown.
    pub async fn admit(
        self,
        token: &Token,
        proof: &ClientProof,
        now_ms: u64,
    ) -> Result<Option<Admitted>, StoreError> {
        if let Some(holder) = self.0.auth_cache.holder(token, now_ms) {
            let is_proven = holder.is_proven_by(proof);
            return Ok(is_proven.then_some(Admitted { holder, is_first_use: false }));
        }
        let epoch = self.0.auth_cache.epoch();
        let Some(row) = self.find_valid(token, now_ms).await? else { return Ok(None) };
        let is_unused = token.kind() == TokenKind::Robot && !row.is_used;
        let expires_at_ms = row.expires_at_ms;
        let holder = row.holder(token).filter(|holder| holder.is_proven_by(proof));
        let Some(holder) = holder else { return Ok(None) };
        if is_unused && !self.use_first(token, now_ms).await? {
            // A concurrent request was first, either with this token or with a later one.
            let holder =
                self.holder(token, now_ms).await?.filter(|holder| holder.is_proven_by(proof));
            return Ok(holder.map(|holder| Admitted { holder, is_first_use: false }));
        }
        // The uses of an enrollment token are counted by the code that enrolls.
        if !is_unused && holder != TokenHolder::Enrollment {
            self.0.auth_cache.cache_holder(epoch, token, &holder, expires_at_ms);
        }
        Ok(Some(Admitted { holder, is_first_use: is_unused }))
    }

    async fn find_valid(self, token: &Token, now_ms: u64) -> Result<Option<TokenRow>, StoreError> {
        let row = sqlx::query(VALID_TOKEN)
            .bind(token.id())
            .bind(kind_text(token.kind()))
            .bind(stored(now_ms))
            .fetch_optional(&self.0.reads)
            .await?;
        Ok(row.map(token_row).transpose()?.filter(|row| row.has_secret_of(token)))
    }

    /// The person of the token with this id and this digest of its secret, and the token's expiry
    /// time; `None` if the token is not valid.
    pub(in crate::store) async fn person(
        self,
        token: &TokenId,
        digest: &str,
        now_ms: u64,
    ) -> Result<Option<(Person, Option<u64>)>, StoreError> {
        let row = sqlx::query(VALID_TOKEN)
            .bind(token.as_str())
            .bind(kind_text(TokenKind::Operator))
            .bind(stored(now_ms))
            .fetch_optional(&self.0.reads)
            .await?;
        let row = row.map(token_row).transpose()?.filter(|row| row.digest == digest);
        Ok(row.and_then(|row| {
            let expires_at_ms = row.expires_at_ms;
            Some((row.person(token)?, expires_at_ms))
        }))
    }

    /// Stores the first token, which does not expire.
    pub async fn create_first(self, token: &Token, now_ms: u64) -> Result<(), StoreError> {
        let mut write = self.0.begin().await?;
        write.tokens().insert(token, None, None, now_ms).await?;
        write.commit().await
    }
}

impl Enrollments<&mut Transaction> {
    /// The present terms of the enrollment token `token`; `None` if the token is not valid.
    pub async fn terms(
        &mut self,
        token: &Token,
        now_ms: u64,
    ) -> Result<Option<EnrollmentTerms>, StoreError> {
        if token.kind() != TokenKind::Enrollment {
            return Ok(None);
        }
        let row = sqlx::query(VALID_TOKEN)
            .bind(token.id())
            .bind(kind_text(token.kind()))
            .bind(stored(now_ms))
            .fetch_optional(self.0.connection())
            .await?;
        let row = row.map(token_row).transpose()?.filter(|row| row.has_secret_of(token));
        Ok(row.map(|row| EnrollmentTerms {
            robot: row.robot,
            labels: row.labels,
            uses_left: row.uses_left,
            expires_at_ms: row.expires_at_ms.unwrap_or(u64::MAX),
            approval: row.approval,
        }))
    }

    /// Counts one enrollment by `token`.
    pub async fn use_token(&mut self, token: &Token) -> Result<(), StoreError> {
        sqlx::query(
            "UPDATE tokens SET uses_left = uses_left - 1 WHERE id = $1 AND uses_left IS NOT NULL",
        )
        .bind(token.id())
        .execute(self.0.connection())
        .await?;
        Ok(())
    }

    /// Stores an enrollment token.
    pub async fn create_token(
        &mut self,
        token: &Token,
        terms: &EnrollmentTerms,
        now_ms: u64,
    ) -> Result<(), StoreError> {
        self.0.tokens().insert(token, terms.robot.as_ref(), None, now_ms).await?;
        sqlx::query("UPDATE tokens SET labels = $2, uses_left = $3, expires_at_ms = $4, approval = $5 WHERE id = $1")
            .bind(token.id())
            .bind(json(&terms.labels))
            .bind(terms.uses_left.map(stored))
            .bind(stored(terms.expires_at_ms))
            .bind(i64::from(terms.approval))
            .execute(self.0.connection())
            .await?;
        Ok(())
    }
}

impl Tokens<&mut Transaction> {
    /// Fails unless `by` still has the rights that they had at admission. Changes by this write
    /// itself do not count.
    pub(in crate::store) async fn check_rights(
        &mut self,
        by: &Person,
        now_ms: u64,
    ) -> Result<(), StoreError> {
        if self.0.verified_person.as_ref() == Some(by) {
            return Ok(());
        }
        let row = sqlx::query(VALID_TOKEN)
            .bind(by.token.as_str())
            .bind(kind_text(TokenKind::Operator))
            .bind(stored(now_ms))
            .fetch_optional(self.0.connection())
            .await?;
        let person = row.map(token_row).transpose()?.and_then(|row| row.person(&by.token));
        if !person.is_some_and(|person| person.has_the_rights_of(by)) {
            return Err(StoreError::RightsEnded);
        }
        self.0.verified_person = Some(by.clone());
        Ok(())
    }

    /// Makes `token` the robot's next token, in place of an earlier offer that was never used.
    /// `made_by` is the enrollment token of the request; `None`: the robot itself asked for the
    /// token. With `key`, the robot has to prove that key when it uses the token.
    pub async fn offer(
        &mut self,
        token: &Token,
        robot: &RobotId,
        made_by: Option<&Token>,
        key: Option<&PublicKey>,
        now_ms: u64,
    ) -> Result<(), StoreError> {
        sqlx::query(
            "DELETE FROM tokens WHERE robot_id = $1 AND kind = 'robot' AND used_at_ms IS NULL",
        )
        .bind(robot.as_str())
        .execute(self.0.connection())
        .await?;
        self.insert(token, Some(robot), made_by, now_ms).await?;
        sqlx::query("UPDATE tokens SET client_key = $2 WHERE id = $1")
            .bind(token.id())
            .bind(key.map(json))
            .execute(self.0.connection())
            .await?;
        Ok(())
    }

    /// Refuses a request of `robot` if its token has ended since.
    pub async fn check(&mut self, robot: &RobotId, token_number: u64) -> Result<(), StoreError> {
        let found: Option<String> = sqlx::query_scalar(
            "SELECT id FROM tokens
             WHERE robot_id = $1 AND number = $2 AND kind = 'robot' AND used_at_ms IS NOT NULL AND revoked_at_ms IS NULL",
        )
        .bind(robot.as_str())
        .bind(stored(token_number))
        .fetch_optional(self.0.connection())
        .await?;
        found.map(drop).ok_or(StoreError::RightsEnded)
    }

    /// The public key that `robot` registered with the token in use.
    pub async fn client_key(&mut self, robot: &RobotId) -> Result<Option<PublicKey>, StoreError> {
        let row = sqlx::query(
            "SELECT client_key FROM tokens
             WHERE robot_id = $1 AND kind = 'robot' AND used_at_ms IS NOT NULL AND revoked_at_ms IS NULL",
        )
        .bind(robot.as_str())
        .fetch_optional(self.0.connection())
        .await?;
        row.map(|row| client_key(&row)).transpose().map(Option::flatten)
    }

    /// Whether an enrollment has given `robot` a token that was never used. `made_by` limits the
    /// check to one enrollment token.
    pub async fn awaits_first_use(
        &mut self,
        robot: &RobotId,
        made_by: Option<&Token>,
    ) -> Result<bool, StoreError> {
        let found: Option<String> = sqlx::query_scalar(
            "SELECT id FROM tokens WHERE robot_id = $1 AND kind = 'robot' AND used_at_ms IS NULL
                 AND revoked_at_ms IS NULL AND made_by IS NOT NULL AND (made_by = $2 OR $2 = '')",
        )
        .bind(robot.as_str())
        .bind(made_by.map(Token::id).unwrap_or_default())
        .fetch_optional(self.0.connection())
        .await?;
        Ok(found.is_some())
    }

    /// Revokes all tokens of `robots`.
    pub async fn revoke_all_of(
        &mut self,
        robots: &[RobotId],
        now_ms: u64,
    ) -> Result<(), StoreError> {
        for group in groups(robots) {
            let sql = format!(
                "UPDATE tokens SET revoked_at_ms = $1 WHERE revoked_at_ms IS NULL AND robot_id IN ({})",
                values(2, group.len(), &["TEXT"])
            );
            let mut query = sqlx::query(AssertSqlSafe(sql)).bind(stored(now_ms));
            for robot in group {
                query = query.bind(robot.as_str());
            }
            query.execute(self.0.connection()).await?;
        }
        Ok(())
    }

    /// Deletes tokens that are no longer valid, and returns the holders of those that belonged to
    /// users. The first token stays when it was revoked: its secret is in the data directory, and
    /// must not become valid again at the next start. The tokens of a revoked robot stay as well,
    /// so that the robot can be told.
    pub async fn forget_ended(&mut self, now_ms: u64) -> Result<BTreeSet<UserName>, StoreError> {
        let users: Vec<Option<String>> = sqlx::query_scalar(
            "DELETE FROM tokens
             WHERE (kind <> 'operator' OR user_name IS NOT NULL) AND (revoked_at_ms IS NOT NULL OR expires_at_ms <= $1
                 OR uses_left = 0 AND NOT EXISTS (SELECT 1 FROM tokens made
                     WHERE made.made_by = tokens.id AND made.used_at_ms IS NULL AND made.revoked_at_ms IS NULL))
               AND NOT (kind = 'robot' AND EXISTS (SELECT 1 FROM robots r WHERE r.id = tokens.robot_id
                   AND r.revoked_at_ms IS NOT NULL AND r.removed_at_ms IS NULL))
             RETURNING user_name",
        )
        .bind(stored(now_ms))
        .fetch_all(self.0.connection())
        .await?;
        users.iter().flatten().map(|user| id("tokens.user_name", user)).collect()
    }

    pub(in crate::store) async fn insert(
        &mut self,
        token: &Token,
        robot: Option<&RobotId>,
        made_by: Option<&Token>,
        now_ms: u64,
    ) -> Result<(), StoreError> {
        let number = stored(self.0.sequence());
        sqlx::query(
            "INSERT INTO tokens (id, kind, digest, robot_id, made_by, number, created_at_ms)
             VALUES ($1, $2, $3, $4, $5, $6, $7)",
        )
        .bind(token.id())
        .bind(kind_text(token.kind()))
        .bind(token.secret_digest().to_string())
        .bind(robot.map(|robot| robot.as_str().to_owned()))
        .bind(made_by.map(Token::id))
        .bind(number)
        .bind(stored(now_ms))
        .execute(self.0.connection())
        .await?;
        Ok(())
    }
}

impl TokenRow {
    fn holder(self, token: &Token) -> Option<TokenHolder> {
        match token.kind() {
            TokenKind::Operator => self.person(&token.id().parse().ok()?).map(TokenHolder::Person),
            TokenKind::Enrollment => Some(TokenHolder::Enrollment),
            TokenKind::Robot if self.is_pending => {
                self.robot.map(|robot| TokenHolder::Pending { robot, key: self.key })
            }
            TokenKind::Robot => self.robot.map(|robot| TokenHolder::Robot {
                robot,
                token_number: self.number,
                key: self.key,
            }),
        }
    }

    /// The rights of the token: the intersection of its limits and its user's present rights;
    /// `None` if that is empty.
    fn person(self, token: &TokenId) -> Option<Person> {
        let token = token.clone();
        let Some(UserPart { name, user, roles, scope, origin }) = self.user else {
            return Some(Person::first(token));
        };
        let (user_roles, user_scope) = user?;
        let roles = match roles {
            Some(roles) => roles.within(&user_roles)?,
            None => user_roles,
        };
        let scope = Scope::of(user_scope.into_iter().chain(scope));
        Some(Person { name, roles, scope, token, origin, address: None })
    }

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
        is_used: row.try_get::<Option<i64>, _>("used_at_ms")?.is_some(),
        approval: row.try_get::<i64, _>("approval")? != 0,
        is_pending: row
            .try_get::<Option<i64>, _>("awaits_approval")?
            .is_some_and(|awaits| awaits != 0),
        number: number(row.try_get("number")?),
        key: client_key(&row)?,
        user: user_part(&row)?,
    })
}

fn client_key(row: &sqlx::any::AnyRow) -> Result<Option<PublicKey>, StoreError> {
    from_optional_json("tokens.client_key", row.try_get("client_key")?)
}

fn user_part(row: &sqlx::any::AnyRow) -> Result<Option<UserPart>, StoreError> {
    let Some(name) = row.try_get::<Option<String>, _>("user_name")? else { return Ok(None) };
    let user_roles: Option<Roles> = optional("users.roles", row.try_get("user_roles")?)?;
    let user_scope = optional("users.scope", row.try_get("user_scope")?)?;
    Ok(Some(UserPart {
        name: id("tokens.user_name", &name)?,
        user: user_roles.map(|roles| (roles, user_scope)),
        roles: optional("tokens.roles", row.try_get("roles")?)?,
        scope: optional("tokens.scope", row.try_get("scope")?)?,
        origin: from_word("tokens.origin", row.try_get("origin")?)?,
    }))
}

fn kind_text(kind: TokenKind) -> &'static str {
    match kind {
        TokenKind::Operator => "operator",
        TokenKind::Enrollment => "enrolment",
        TokenKind::Robot => "robot",
    }
}
