//! Tokens: stored as digests of their secrets, with what each may do. A robot has at most two that
//! are valid: the one it uses, and one that was made for it and ends the other when it is first
//! used.

use std::collections::BTreeSet;

use sqlx::{AssertSqlSafe, Row as _};
use subtle::ConstantTimeEq as _;
use task_proto::api::TokenOrigin;
use task_proto::envelope::PublicKey;
use task_proto::id::Labels;
use task_proto::person::Roles;
use task_proto::selector::Selector;
use task_proto::token::{Token, TokenKind};
use task_proto::{RobotId, TokenId, UserName};

use crate::domain::person::{Person, Scope};
use crate::net::tls::ClientProof;
use crate::store::rows::{
    from_optional_json, from_word, groups, id, json, number, optional, stored, values,
};
use crate::store::{Store, StoreError, Write};

/// Whom a valid token stands for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum TokenHolder {
    /// A person.
    Person(Person),
    /// Someone who may enrol.
    Enrolment,
    /// A robot.
    Robot {
        /// Which.
        robot: RobotId,
        /// The number of its token: a later one has a higher number.
        token_number: u64,
        /// The key that it registered when it was given the token.
        key: Option<PublicKey>,
    },
    /// A robot that waits to be approved, which may nothing yet.
    Pending {
        /// Which.
        robot: RobotId,
        /// The key that it registered when it was given the token.
        key: Option<PublicKey>,
    },
}

impl TokenHolder {
    fn is_proven_by(&self, proof: &ClientProof) -> bool {
        match self {
            Self::Robot { key, .. } | Self::Pending { key, .. } => proof.suffices(key.as_ref()),
            Self::Person(_) | Self::Enrolment => true,
        }
    }
}

/// A token that was shown and is good.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Admitted {
    /// Whom it stands for.
    pub holder: TokenHolder,
    /// Whether a robot used it for the first time, which has just ended the robot's other tokens.
    pub is_first_use: bool,
}

/// What an enrolment token is good for.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct EnrolmentTerms {
    /// Only this robot may use it.
    pub robot: Option<RobotId>,
    /// Labels that whoever uses it gets.
    pub labels: Labels,
    /// Enrolments left; `None`: any number. With none left it is only good for an enrolment whose
    /// answer was lost.
    pub uses_left: Option<u64>,
    /// When it ends.
    pub expires_at_ms: u64,
    /// Whether a new robot that comes by it waits to be approved.
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
    /// Of a robot's token: whether the robot waits to be approved.
    is_pending: bool,
    number: u64,
    user: Option<UserPart>,
    key: Option<PublicKey>,
}

/// Of a user's token: the user as they are now, and what the token is limited to.
struct UserPart {
    name: UserName,
    /// Roles and scope; `None` if the user was removed.
    user: Option<(Roles, Option<Selector>)>,
    roles: Option<Roles>,
    scope: Option<Selector>,
    origin: TokenOrigin,
}

/// An enrolment token without a use left is still good while a token that it made was never used:
/// the answer with that one may have been lost.
const VALID_TOKEN: &str = "SELECT t.digest, t.robot_id, t.labels, t.uses_left, t.expires_at_ms, t.used_at_ms, t.number,
         t.client_key, t.user_name, t.roles, t.scope, t.origin, t.approval, u.roles AS user_roles, u.scope AS user_scope,
         r.awaits_approval
     FROM tokens t LEFT JOIN users u ON u.name = t.user_name LEFT JOIN robots r ON r.id = t.robot_id
     WHERE t.id = $1 AND t.kind = $2 AND t.revoked_at_ms IS NULL AND (t.expires_at_ms IS NULL OR t.expires_at_ms > $3)
       AND (t.uses_left IS NULL OR t.uses_left > 0 OR EXISTS (SELECT 1 FROM tokens made
            WHERE made.made_by = t.id AND made.used_at_ms IS NULL AND made.revoked_at_ms IS NULL))";

impl Store {
    /// Whom `token` stands for at `now_ms`; `None` if it is unknown, wrong, used up, expired or
    /// revoked. Changes nothing.
    pub async fn token_holder(
        &self,
        token: &Token,
        now_ms: u64,
    ) -> Result<Option<TokenHolder>, StoreError> {
        let row = self.valid_token(token, now_ms).await?;
        Ok(row.and_then(|row| row.holder(token)))
    }

    /// The same for whoever shows the token to come in. A robot's first use of a token ends its
    /// other ones. Who has registered a key has to have proven that it holds it, if it was asked
    /// to: else the token is as if unknown.
    pub async fn admit(
        &self,
        token: &Token,
        proof: &ClientProof,
        now_ms: u64,
    ) -> Result<Option<Admitted>, StoreError> {
        if let Some(holder) = self.access.holder(token, now_ms) {
            let is_proven = holder.is_proven_by(proof);
            return Ok(is_proven.then_some(Admitted { holder, is_first_use: false }));
        }
        let asked = self.access.ask();
        let Some(row) = self.valid_token(token, now_ms).await? else { return Ok(None) };
        let is_unused = token.kind() == TokenKind::Robot && !row.is_used;
        let expires_at_ms = row.expires_at_ms;
        let holder = row.holder(token).filter(|holder| holder.is_proven_by(proof));
        let Some(holder) = holder else { return Ok(None) };
        if is_unused && !self.use_first(token, now_ms).await? {
            // Somebody was faster: either with this token or with a later one.
            let holder =
                self.token_holder(token, now_ms).await?.filter(|holder| holder.is_proven_by(proof));
            return Ok(holder.map(|holder| Admitted { holder, is_first_use: false }));
        }
        // How often an enrolment token may be used is counted by those who use it.
        if !is_unused && holder != TokenHolder::Enrolment {
            self.access.remember_holder(asked, token, &holder, expires_at_ms);
        }
        Ok(Some(Admitted { holder, is_first_use: is_unused }))
    }

    async fn valid_token(
        &self,
        token: &Token,
        now_ms: u64,
    ) -> Result<Option<TokenRow>, StoreError> {
        let row = sqlx::query(VALID_TOKEN)
            .bind(token.id())
            .bind(kind_text(token.kind()))
            .bind(stored(now_ms))
            .fetch_optional(&self.reads)
            .await?;
        Ok(row.map(token_row).transpose()?.filter(|row| row.has_secret_of(token)))
    }

    /// Stores the first token, which does not expire.
    pub async fn create_operator_token(
        &self,
        token: &Token,
        now_ms: u64,
    ) -> Result<(), StoreError> {
        let mut write = self.begin().await?;
        write.insert_token(token, None, None, now_ms).await?;
        write.commit().await
    }
}

impl Write {
    /// What the enrolment token `token` is good for now; `None` if it is good for nothing.
    pub async fn enrolment_terms(
        &mut self,
        token: &Token,
        now_ms: u64,
    ) -> Result<Option<EnrolmentTerms>, StoreError> {
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
            approval: row.approval,
        }))
    }

    /// An error unless `by` may now what they might when they were let in. What this write changes
    /// itself does not count.
    pub(in crate::store) async fn check_rights(
        &mut self,
        by: &Person,
        now_ms: u64,
    ) -> Result<(), StoreError> {
        if self.vouched_for.as_ref() == Some(by) {
            return Ok(());
        }
        let row = sqlx::query(VALID_TOKEN)
            .bind(by.token.as_str())
            .bind(kind_text(TokenKind::Operator))
            .bind(stored(now_ms))
            .fetch_optional(self.connection())
            .await?;
        let person = row.map(token_row).transpose()?.and_then(|row| row.person(&by.token));
        if !person.is_some_and(|person| person.has_the_rights_of(by)) {
            return Err(StoreError::RightsEnded);
        }
        self.vouched_for = Some(by.clone());
        Ok(())
    }

    /// Counts one enrolment by `token`.
    pub async fn use_enrolment_token(&mut self, token: &Token) -> Result<(), StoreError> {
        sqlx::query(
            "UPDATE tokens SET uses_left = uses_left - 1 WHERE id = $1 AND uses_left IS NOT NULL",
        )
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
        self.insert_token(token, terms.robot.as_ref(), None, now_ms).await?;
        sqlx::query("UPDATE tokens SET labels = $2, uses_left = $3, expires_at_ms = $4, approval = $5 WHERE id = $1")
            .bind(token.id())
            .bind(json(&terms.labels))
            .bind(terms.uses_left.map(stored))
            .bind(stored(terms.expires_at_ms))
            .bind(i64::from(terms.approval))
            .execute(self.connection())
            .await?;
        Ok(())
    }

    /// Makes `token` the one that `robot` may go over to, in the place of another that it never
    /// used. `made_by` is the enrolment token it came by; `None`: the robot itself asked for it.
    /// Who has to show a key with it has `key`.
    pub async fn offer_robot_token(
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
        .execute(self.connection())
        .await?;
        self.insert_token(token, Some(robot), made_by, now_ms).await?;
        sqlx::query("UPDATE tokens SET client_key = $2 WHERE id = $1")
            .bind(token.id())
            .bind(key.map(json))
            .execute(self.connection())
            .await?;
        Ok(())
    }

    /// Refuses what `robot` asked by a token that has ended since.
    pub async fn check_token(
        &mut self,
        robot: &RobotId,
        token_number: u64,
    ) -> Result<(), StoreError> {
        let found: Option<String> = sqlx::query_scalar(
            "SELECT id FROM tokens
             WHERE robot_id = $1 AND number = $2 AND kind = 'robot' AND used_at_ms IS NOT NULL AND revoked_at_ms IS NULL",
        )
        .bind(robot.as_str())
        .bind(stored(token_number))
        .fetch_optional(self.connection())
        .await?;
        found.map(drop).ok_or(StoreError::RightsEnded)
    }

    /// The key that `robot` registered when it was given the token it uses.
    pub async fn client_key(&mut self, robot: &RobotId) -> Result<Option<PublicKey>, StoreError> {
        let row = sqlx::query(
            "SELECT client_key FROM tokens
             WHERE robot_id = $1 AND kind = 'robot' AND used_at_ms IS NOT NULL AND revoked_at_ms IS NULL",
        )
        .bind(robot.as_str())
        .fetch_optional(self.connection())
        .await?;
        row.map(|row| client_key(&row)).transpose().map(Option::flatten)
    }

    /// Whether `robot` was given a token by an enrolment, by `made_by` or by any, that nobody has
    /// used yet.
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
        .fetch_optional(self.connection())
        .await?;
        Ok(found.is_some())
    }

    /// Ends all tokens made for `robots`.
    pub async fn revoke_tokens(
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
            query.execute(self.connection()).await?;
        }
        Ok(())
    }

    /// Forgets tokens that are good for nothing any more, and says whose they were if they were
    /// users'. The first token stays when it was revoked: it is in the data directory, and must not
    /// come back to life at the next start. Those of a revoked robot stay as well, so that it can
    /// be told.
    pub async fn forget_ended_tokens(
        &mut self,
        now_ms: u64,
    ) -> Result<BTreeSet<UserName>, StoreError> {
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
        .fetch_all(self.connection())
        .await?;
        users.iter().flatten().map(|user| id("tokens.user_name", user)).collect()
    }

    pub(in crate::store) async fn insert_token(
        &mut self,
        token: &Token,
        robot: Option<&RobotId>,
        made_by: Option<&Token>,
        now_ms: u64,
    ) -> Result<(), StoreError> {
        let number = stored(self.turn());
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
        .execute(self.connection())
        .await?;
        Ok(())
    }
}

impl TokenRow {
    fn holder(self, token: &Token) -> Option<TokenHolder> {
        match token.kind() {
            TokenKind::Operator => self.person(&token.id().parse().ok()?).map(TokenHolder::Person),
            TokenKind::Enrolment => Some(TokenHolder::Enrolment),
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

    /// What the token allows is what both it and its user are allowed now; `None` if that is
    /// nothing.
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
        TokenKind::Enrolment => "enrolment",
        TokenKind::Robot => "robot",
    }
}
