//! People and their access tokens. A token without a user is the first one, which lies in the data
//! directory.

use sqlx::Row as _;
use sqlx::any::AnyRow;
use task_proto::api::{TokenOrigin, TokenView, UserView};
use task_proto::person::{Permission, Roles};
use task_proto::selector::Selector;
use task_proto::token::Token;
use task_proto::{TokenId, UserName};

use crate::auth::passwords::PasswordHash;
use crate::domain::person::first_name;
use crate::store::rows::{from_word, id, number, optional, stored, word};
use crate::store::{Store, StoreError, Write};

/// The most tokens that are listed.
const MOST_LISTED: i64 = 10_000;

/// A user, as stored.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct User {
    /// What they sign in with.
    pub name: UserName,
    /// What they may do.
    pub roles: Roles,
    /// To which robots they are limited; `None`: to none.
    pub scope: Option<Selector>,
    /// What is kept of their password.
    pub password: Option<PasswordHash>,
    /// Who they are at the provider by which they sign in, behind its issuer; `None`: they don't.
    pub subject: Option<String>,
    /// When they were added.
    pub created_at_ms: u64,
}

impl User {
    /// Whether they may do what concerns everybody.
    pub fn is_administrator(&self) -> bool {
        self.roles.allow(Permission::Administer) && self.scope.is_none()
    }

    /// As others see them.
    pub fn view(self) -> UserView {
        let Self { name, roles, scope, password, subject, created_at_ms } = self;
        UserView { name, roles, scope, has_password: password.is_some(), subject, created_at_ms }
    }
}

/// A user's token to be stored.
#[derive(Debug)]
pub struct NewToken<'a> {
    /// The token.
    pub token: &'a Token,
    /// Whose it is.
    pub user: &'a UserName,
    /// Where it comes from.
    pub origin: TokenOrigin,
    /// What it is for.
    pub title: &'a str,
    /// The roles it is limited to.
    pub roles: Option<&'a Roles>,
    /// The robots it is limited to.
    pub scope: Option<&'a Selector>,
    /// When it ends.
    pub expires_at_ms: u64,
}

const USERS: &str = "SELECT name, roles, scope, password, subject, created_at_ms FROM users";

const TOKENS: &str =
    "SELECT id, user_name, origin, title, roles, scope, created_at_ms, expires_at_ms, revoked_at_ms
     FROM tokens WHERE kind = 'operator'";

impl Store {
    /// Everybody, sorted by name.
    pub async fn users(&self) -> Result<Vec<User>, StoreError> {
        let rows = sqlx::query(USERS).fetch_all(&self.reads).await?;
        let mut users = rows.iter().map(user).collect::<Result<Vec<_>, _>>()?;
        users.sort_by(|one, other| one.name.cmp(&other.name));
        Ok(users)
    }

    /// One user.
    pub async fn user(&self, name: &UserName) -> Result<Option<User>, StoreError> {
        let row = sqlx::query(sqlx::AssertSqlSafe(format!("{USERS} WHERE name = $1")))
            .bind(name.as_str());
        row.fetch_optional(&self.reads).await?.as_ref().map(user).transpose()
    }

    /// Everybody's tokens or one user's, the newest first; of those that have ended only the first
    /// token.
    pub async fn person_tokens(
        &self,
        of: Option<&UserName>,
        now_ms: u64,
    ) -> Result<Vec<TokenView>, StoreError> {
        let listed = "AND (user_name = $1 OR $1 = '')
             AND (user_name IS NULL OR revoked_at_ms IS NULL AND (expires_at_ms IS NULL OR expires_at_ms > $2))
             ORDER BY number DESC LIMIT $3";
        let rows = sqlx::query(sqlx::AssertSqlSafe(format!("{TOKENS} {listed}")))
            .bind(of.map_or("", UserName::as_str))
            .bind(stored(now_ms))
            .bind(MOST_LISTED)
            .fetch_all(&self.reads)
            .await?;
        rows.iter().map(token_view).collect()
    }
}

impl Write {
    /// One user.
    pub async fn user(&mut self, name: &UserName) -> Result<Option<User>, StoreError> {
        let row = sqlx::query(sqlx::AssertSqlSafe(format!("{USERS} WHERE name = $1")))
            .bind(name.as_str());
        row.fetch_optional(self.connection()).await?.as_ref().map(user).transpose()
    }

    /// The user who signs in by the provider as `subject`.
    pub async fn user_by_subject(&mut self, subject: &str) -> Result<Option<User>, StoreError> {
        let row =
            sqlx::query(sqlx::AssertSqlSafe(format!("{USERS} WHERE subject = $1"))).bind(subject);
        row.fetch_optional(self.connection()).await?.as_ref().map(user).transpose()
    }

    /// Everybody.
    pub async fn users(&mut self) -> Result<Vec<User>, StoreError> {
        sqlx::query(USERS).fetch_all(self.connection()).await?.iter().map(user).collect()
    }

    /// Whether the first token is good.
    pub async fn has_first_token(&mut self) -> Result<bool, StoreError> {
        let good = "SELECT id FROM tokens WHERE kind = 'operator' AND user_name IS NULL AND revoked_at_ms IS NULL";
        Ok(sqlx::query(good).fetch_optional(self.connection()).await?.is_some())
    }

    /// Stores a user in the place of one of that name, if there is one.
    pub async fn put_user(&mut self, user: &User) -> Result<(), StoreError> {
        sqlx::query(
            "INSERT INTO users (name, roles, scope, password, subject, created_at_ms) VALUES ($1, $2, $3, $4, $5, $6)
             ON CONFLICT (name) DO UPDATE
             SET roles = excluded.roles, scope = excluded.scope, password = excluded.password",
        )
        .bind(user.name.as_str())
        .bind(user.roles.to_string())
        .bind(user.scope.as_ref().map(Selector::to_string))
        .bind(user.password.as_ref().map(|password| password.as_str().to_owned()))
        .bind(user.subject.as_deref())
        .bind(stored(user.created_at_ms))
        .execute(self.connection())
        .await?;
        Ok(())
    }

    /// Removes a user with all their tokens.
    pub async fn remove_user(&mut self, name: &UserName) -> Result<(), StoreError> {
        for sql in ["DELETE FROM tokens WHERE user_name = $1", "DELETE FROM users WHERE name = $1"]
        {
            sqlx::query(sql).bind(name.as_str()).execute(self.connection()).await?;
        }
        Ok(())
    }

    /// Stores a user's token.
    pub async fn create_token(
        &mut self,
        new: &NewToken<'_>,
        now_ms: u64,
    ) -> Result<(), StoreError> {
        self.insert_token(new.token, None, None, now_ms).await?;
        sqlx::query(
            "UPDATE tokens SET user_name = $2, origin = $3, title = $4, roles = $5, scope = $6, expires_at_ms = $7
             WHERE id = $1",
        )
        .bind(new.token.id())
        .bind(new.user.as_str())
        .bind(word(&new.origin))
        .bind(new.title)
        .bind(new.roles.map(Roles::to_string))
        .bind(new.scope.map(Selector::to_string))
        .bind(stored(new.expires_at_ms))
        .execute(self.connection())
        .await?;
        Ok(())
    }

    /// One person's token, whether it is good or not.
    pub async fn person_token(&mut self, token: &TokenId) -> Result<Option<TokenView>, StoreError> {
        let row =
            sqlx::query(sqlx::AssertSqlSafe(format!("{TOKENS} AND id = $1"))).bind(token.as_str());
        row.fetch_optional(self.connection()).await?.as_ref().map(token_view).transpose()
    }

    /// The tokens of one user, the newest first.
    pub async fn tokens_of_user(&mut self, name: &UserName) -> Result<Vec<TokenView>, StoreError> {
        let sql =
            format!("{TOKENS} AND user_name = $1 AND revoked_at_ms IS NULL ORDER BY number DESC");
        let rows = sqlx::query(sqlx::AssertSqlSafe(sql))
            .bind(name.as_str())
            .fetch_all(self.connection())
            .await?;
        rows.iter().map(token_view).collect()
    }

    /// Ends a person's token.
    pub async fn revoke_person_token(
        &mut self,
        token: &TokenId,
        now_ms: u64,
    ) -> Result<(), StoreError> {
        sqlx::query(
            "UPDATE tokens SET revoked_at_ms = $2 WHERE id = $1 AND kind = 'operator' AND revoked_at_ms IS NULL",
        )
        .bind(token.as_str())
        .bind(stored(now_ms))
        .execute(self.connection())
        .await?;
        Ok(())
    }
}

fn user(row: &AnyRow) -> Result<User, StoreError> {
    let password: Option<String> = row.try_get("password")?;
    Ok(User {
        name: id("users.name", row.try_get("name")?)?,
        roles: id("users.roles", row.try_get("roles")?)?,
        scope: optional("users.scope", row.try_get("scope")?)?,
        password: password.map(PasswordHash::stored),
        subject: row.try_get("subject")?,
        created_at_ms: number(row.try_get("created_at_ms")?),
    })
}

fn token_view(row: &AnyRow) -> Result<TokenView, StoreError> {
    let origin: Option<String> = row.try_get("origin")?;
    Ok(TokenView {
        id: id("tokens.id", row.try_get("id")?)?,
        user: optional("tokens.user_name", row.try_get("user_name")?)?.unwrap_or_else(first_name),
        origin: origin
            .map_or(Ok(TokenOrigin::First), |origin| from_word("tokens.origin", &origin))?,
        title: row.try_get::<Option<String>, _>("title")?.unwrap_or_default(),
        roles: optional("tokens.roles", row.try_get("roles")?)?,
        scope: optional("tokens.scope", row.try_get("scope")?)?,
        created_at_ms: number(row.try_get("created_at_ms")?),
        expires_at_ms: row.try_get::<Option<i64>, _>("expires_at_ms")?.map(number),
        revoked_at_ms: row.try_get::<Option<i64>, _>("revoked_at_ms")?.map(number),
    })
}
