//! Users and their access tokens. The token without a user is the first one, which lies in the data
//! directory.

use sqlx::Row as _;
use sqlx::any::AnyRow;
use task_proto::api::{TokenOrigin, TokenView, UserView};
use task_proto::ids::selector::Selector;
use task_proto::people::roles::{Permission, Roles};
use task_proto::trust::token::Token;
use task_proto::{TokenId, UserName};

use crate::auth::passwords::PasswordHash;
use crate::domain::person::first_name;
use crate::store::repositories::{Tokens, Users};
use crate::store::rows::{from_word, id, number, optional, stored, word};
use crate::store::{Store, StoreError, Transaction};

/// The most tokens in a list.
const MAX_LISTED: i64 = 10_000;

/// A user, as stored.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct User {
    /// The name for signing in.
    pub name: UserName,
    pub roles: Roles,
    /// The robots that the user is limited to; `None`: no limit.
    pub scope: Option<Selector>,
    /// The hash of the user's password.
    pub password: Option<PasswordHash>,
    /// The user's subject at the OpenID provider, after its issuer; `None`: the user does not sign
    /// in by a provider.
    pub subject: Option<String>,
    /// The time at which the user was added.
    pub created_at_ms: u64,
}

impl User {
    /// Whether the user may change things that concern all users.
    pub fn is_administrator(&self) -> bool {
        self.roles.allow(Permission::Administer) && self.scope.is_none()
    }

    /// The view shown to others, without the password.
    pub fn view(self) -> UserView {
        let Self { name, roles, scope, password, subject, created_at_ms } = self;
        UserView { name, roles, scope, has_password: password.is_some(), subject, created_at_ms }
    }
}

/// A user's token to be stored.
#[derive(Debug)]
pub struct NewToken<'a> {
    pub token: &'a Token,
    /// The user that the token belongs to.
    pub user: &'a UserName,
    /// The origin of the token.
    pub origin: TokenOrigin,
    /// The title that describes the token's purpose.
    pub title: &'a str,
    /// The roles that the token is limited to.
    pub roles: Option<&'a Roles>,
    /// The robots that the token is limited to.
    pub scope: Option<&'a Selector>,
    /// The time at which the token expires.
    pub expires_at_ms: u64,
}

const USERS: &str = "SELECT name, roles, scope, password, subject, created_at_ms FROM users";

const TOKENS: &str =
    "SELECT id, user_name, origin, title, roles, scope, created_at_ms, expires_at_ms, revoked_at_ms
     FROM tokens WHERE kind = 'operator'";

impl Users<&Store> {
    /// All users, sorted by name.
    pub async fn list(self) -> Result<Vec<User>, StoreError> {
        let rows = sqlx::query(USERS).fetch_all(&self.0.reads).await?;
        let mut users = rows.iter().map(user).collect::<Result<Vec<_>, _>>()?;
        users.sort_by(|one, other| one.name.cmp(&other.name));
        Ok(users)
    }

    /// The user with this name.
    pub async fn get(self, name: &UserName) -> Result<Option<User>, StoreError> {
        let row = sqlx::query(sqlx::AssertSqlSafe(format!("{USERS} WHERE name = $1")))
            .bind(name.as_str());
        row.fetch_optional(&self.0.reads).await?.as_ref().map(user).transpose()
    }
}

impl Tokens<&Store> {
    /// The tokens of all users or of one, the newest first. Of the ended tokens only the first
    /// token is included.
    pub async fn list(
        self,
        of: Option<&UserName>,
        now_ms: u64,
    ) -> Result<Vec<TokenView>, StoreError> {
        let listed = "AND (user_name = $1 OR $1 = '')
             AND (user_name IS NULL OR revoked_at_ms IS NULL AND (expires_at_ms IS NULL OR expires_at_ms > $2))
             ORDER BY number DESC LIMIT $3";
        let rows = sqlx::query(sqlx::AssertSqlSafe(format!("{TOKENS} {listed}")))
            .bind(of.map_or("", UserName::as_str))
            .bind(stored(now_ms))
            .bind(MAX_LISTED)
            .fetch_all(&self.0.reads)
            .await?;
        rows.iter().map(token_view).collect()
    }
}

impl Users<&mut Transaction> {
    /// The user with this name.
    pub async fn get(&mut self, name: &UserName) -> Result<Option<User>, StoreError> {
        let row = sqlx::query(sqlx::AssertSqlSafe(format!("{USERS} WHERE name = $1")))
            .bind(name.as_str());
        row.fetch_optional(self.0.connection()).await?.as_ref().map(user).transpose()
    }

    /// The user with `subject` at the provider.
    pub async fn find_by_subject(&mut self, subject: &str) -> Result<Option<User>, StoreError> {
        let row =
            sqlx::query(sqlx::AssertSqlSafe(format!("{USERS} WHERE subject = $1"))).bind(subject);
        row.fetch_optional(self.0.connection()).await?.as_ref().map(user).transpose()
    }

    pub async fn list(&mut self) -> Result<Vec<User>, StoreError> {
        sqlx::query(USERS).fetch_all(self.0.connection()).await?.iter().map(user).collect()
    }

    /// Stores a user, and replaces a user of the same name.
    pub async fn put(&mut self, user: &User) -> Result<(), StoreError> {
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
        .execute(self.0.connection())
        .await?;
        Ok(())
    }

    /// Removes a user with all their tokens, page sessions and familiar networks.
    pub async fn remove(&mut self, name: &UserName) -> Result<(), StoreError> {
        for sql in [
            "DELETE FROM tokens WHERE user_name = $1",
            "DELETE FROM page_sessions WHERE user_name = $1",
            "DELETE FROM familiar_networks WHERE user_name = $1",
            "DELETE FROM users WHERE name = $1",
        ] {
            sqlx::query(sql).bind(name.as_str()).execute(self.0.connection()).await?;
        }
        Ok(())
    }
}

impl Tokens<&mut Transaction> {
    /// Whether the first token is valid.
    pub async fn has_first(&mut self) -> Result<bool, StoreError> {
        let good = "SELECT id FROM tokens WHERE kind = 'operator' AND user_name IS NULL AND revoked_at_ms IS NULL";
        Ok(sqlx::query(good).fetch_optional(self.0.connection()).await?.is_some())
    }

    /// Stores a user's token.
    pub async fn create(&mut self, new: &NewToken<'_>, now_ms: u64) -> Result<(), StoreError> {
        self.insert(new.token, None, None, now_ms).await?;
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
        .execute(self.0.connection())
        .await?;
        Ok(())
    }

    /// One user's token, valid or not.
    pub async fn get(&mut self, token: &TokenId) -> Result<Option<TokenView>, StoreError> {
        let row =
            sqlx::query(sqlx::AssertSqlSafe(format!("{TOKENS} AND id = $1"))).bind(token.as_str());
        row.fetch_optional(self.0.connection()).await?.as_ref().map(token_view).transpose()
    }

    /// The tokens of one user, the newest first.
    pub async fn of_user(&mut self, name: &UserName) -> Result<Vec<TokenView>, StoreError> {
        let sql =
            format!("{TOKENS} AND user_name = $1 AND revoked_at_ms IS NULL ORDER BY number DESC");
        let rows = sqlx::query(sqlx::AssertSqlSafe(sql))
            .bind(name.as_str())
            .fetch_all(self.0.connection())
            .await?;
        rows.iter().map(token_view).collect()
    }

    /// Revokes a user's token.
    pub async fn revoke(&mut self, token: &TokenId, now_ms: u64) -> Result<(), StoreError> {
        sqlx::query(
            "UPDATE tokens SET revoked_at_ms = $2 WHERE id = $1 AND kind = 'operator' AND revoked_at_ms IS NULL",
        )
        .bind(token.as_str())
        .bind(stored(now_ms))
        .execute(self.0.connection())
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
