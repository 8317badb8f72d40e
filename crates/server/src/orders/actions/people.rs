//! Users: creating, changing and removing them, signing them out, their tokens. After a change that
//! reduces a user's rights, no request is served with the old rights.

use std::net::IpAddr;

use task_proto::api::{
    AccessToken, AddUser, ChangePassword, CreateToken, EditUser, TokenList, TokenOrigin, TokenView,
    UserView,
};
use task_proto::person::Permission;
use task_proto::selector::Selector;
use task_proto::token::{Token, TokenKind};
use task_proto::{TokenId, UserName};

use super::robots::lifetime_ms;
use super::{ActionError, Actions, DAY_MS};
use crate::auth::passwords::PasswordError;
use crate::domain::person::{Person, first_name};
use crate::store::{Act, Deed, NewToken, User, Write};

const MOST_USERS: usize = 10_000;
/// Maximum number of access tokens of one user; a new sign-in replaces the oldest sign-in token.
pub(super) const MOST_TOKENS: usize = 100;
/// Default lifetime of a token.
const TOKEN_LIFETIME_MS: u64 = 90 * DAY_MS;
/// The longest title of a token, in characters.
const MOST_TITLE: usize = 200;
/// A selector as long as that is a list of robots that belongs into a label.
const MOST_SCOPE_BYTES: usize = 1_024;

/// Names with another meaning in the audit.
const RESERVED: [&str; 3] = ["operator.token", "enrolment", "server"];

impl Actions {
    pub async fn add_user(&self, by: &Person, order: &AddUser) -> Result<UserView, ActionError> {
        let name = &order.name;
        let password = match &order.password {
            Some(password) => Some(self.passwords.hash(name, password).await?),
            None => None,
        };
        let (scope, now_ms) = (limit(order.scope.as_ref())?, self.clock.now_ms());
        let roles = order.roles.clone();
        let user = User {
            name: name.clone(),
            roles,
            scope,
            password,
            subject: None,
            created_at_ms: now_ms,
        };
        let mut write = self.store.begin().await?;
        check_new(&mut write, name).await?;
        write.put_user(&user).await?;
        write.audit(&Deed::by(by, Act::UserAdd, name).described(&user), now_ms).await?;
        write.commit().await?;
        Ok(user.view())
    }

    /// Changes a user's role and scope.
    pub async fn edit_user(
        &self,
        by: &Person,
        name: &UserName,
        edit: &EditUser,
    ) -> Result<UserView, ActionError> {
        let mut write = self.store.begin().await?;
        let before = known_user(&mut write, name).await?;
        check_own(&before)?;
        let mut user = before.clone();
        if let Some(roles) = &edit.roles {
            user.roles = roles.clone();
        }
        if edit.scope.is_some() {
            user.scope = limit(edit.scope.as_ref())?;
        }
        if before.is_administrator() && !user.is_administrator() {
            check_not_last(&mut write, Some(name)).await?;
        }
        write
            .audit(&Deed::by(by, Act::UserEdit, name).described(&user), self.clock.now_ms())
            .await?;
        write.put_user(&user).await?;
        write.commit().await?;
        self.changes.announce_rights();
        Ok(user.view())
    }

    /// Removes a user: their tokens end now.
    pub async fn remove_user(&self, by: &Person, name: &UserName) -> Result<(), ActionError> {
        let mut write = self.store.begin().await?;
        if known_user(&mut write, name).await?.is_administrator() {
            check_not_last(&mut write, Some(name)).await?;
        }
        write.audit(&Deed::by(by, Act::UserRemove, name), self.clock.now_ms()).await?;
        write.remove_user(name).await?;
        write.commit().await?;
        self.changes.announce_rights();
        Ok(())
    }

    /// Sets a user's password. Sessions from the old password end; tokens that were created
    /// explicitly stay.
    pub async fn set_password(
        &self,
        by: &Person,
        name: &UserName,
        password: &str,
    ) -> Result<(), ActionError> {
        // Refused before the expensive hashing.
        check_own(
            &self.store.user(name).await?.ok_or_else(|| ActionError::UserNotFound(name.clone()))?,
        )?;
        let hash = self.passwords.hash(name, password).await?;
        let now_ms = self.clock.now_ms();
        let mut write = self.store.begin().await?;
        let user = known_user(&mut write, name).await?;
        check_own(&user)?;
        write.put_user(&User { password: Some(hash), ..user }).await?;
        for token in write.tokens_of_user(name).await? {
            let is_own = token.id == by.token;
            if matches!(token.origin, TokenOrigin::Login | TokenOrigin::Page) && !is_own {
                write.revoke_person_token(&token.id, now_ms).await?;
            }
        }
        write.audit(&Deed::by(by, Act::UserPassword, name), now_ms).await?;
        write.commit().await?;
        self.changes.announce_rights();
        Ok(())
    }

    /// Changes the user's own password, after a check of the old one.
    pub async fn change_password(
        &self,
        by: &Person,
        order: &ChangePassword,
    ) -> Result<(), ActionError> {
        if by.is_first() {
            return Err(ActionError::NotPermitted("the first token has no password".to_owned()));
        }
        let address = by.address.unwrap_or(IpAddr::from([0; 4]));
        self.check_password(&by.name, &order.old, address).await.map_err(|error| match error {
            ActionError::SignInRefused => {
                ActionError::Invalid { key: "old", reason: "it is wrong".to_owned() }
            }
            error => error,
        })?;
        self.set_password(by, &by.name, &order.new).await
    }

    /// Ends the token of a sign-in; a token of any other origin stays.
    pub async fn sign_out(&self, by: &Person) -> Result<(), ActionError> {
        if !matches!(by.origin, TokenOrigin::Login | TokenOrigin::Page) {
            return Ok(());
        }
        let now_ms = self.clock.now_ms();
        let mut write = self.store.begin().await?;
        write.audit(&Deed::by(by, Act::SignOut, &by.name), now_ms).await?;
        write.revoke_person_token(&by.token, now_ms).await?;
        write.commit().await?;
        self.changes.announce_rights();
        Ok(())
    }

    /// The user's own tokens, or all users' tokens.
    pub async fn tokens(&self, by: &Person, all: bool) -> Result<TokenList, ActionError> {
        let of = (!all).then_some(&by.name).filter(|_| !by.is_first());
        Ok(TokenList { tokens: self.store.person_tokens(of, self.clock.now_ms()).await? })
    }

    /// Creates a token: for the caller, or by an administrator for any user.
    pub async fn create_token(
        &self,
        by: &Person,
        order: &CreateToken,
    ) -> Result<AccessToken, ActionError> {
        let invalid =
            |key, reason: &str| Err(ActionError::Invalid { key, reason: reason.to_owned() });
        let user = match &order.user {
            Some(user) if *user != by.name && !by.may(Permission::Administer) => {
                return Err(ActionError::NotPermitted(format!(
                    "{} may make tokens for {} only",
                    by.name, by.name
                )));
            }
            Some(user) => user,
            None if by.is_first() => {
                return invalid("user", "the first token is nobody's: say whose the new one is");
            }
            None => &by.name,
        };
        // Otherwise a leaked token could renew itself forever.
        if by.origin == TokenOrigin::Token && !by.may(Permission::Administer) {
            let reason =
                "a token can't be made with a token: sign in with the password (taskd login)";
            return Err(ActionError::NotPermitted(reason.to_owned()));
        }
        if order.title.chars().count() > MOST_TITLE || order.title.contains(char::is_control) {
            return invalid("title", "expected at most 200 printable characters");
        }
        let (scope, now_ms) = (limit(order.scope.as_ref())?, self.clock.now_ms());
        let expires_at_ms = now_ms
            + match order.ttl_s {
                Some(seconds) => lifetime_ms("ttl_s", seconds)?,
                None => TOKEN_LIFETIME_MS,
            };
        let mut write = self.store.begin().await?;
        let owner = known_user(&mut write, user).await?;
        // The token would outlast the provider's statement about its user, which is refreshed only
        // at sign-in.
        if owner.subject.is_some() && !by.may(Permission::Administer) {
            let reason = format!(
                "{user} signs in by the provider: an administrator makes tokens for {user}"
            );
            return Err(ActionError::NotPermitted(reason));
        }
        if order
            .roles
            .as_ref()
            .is_some_and(|roles| roles.within(&owner.roles).as_ref() != Some(roles))
        {
            return Err(ActionError::Invalid {
                key: "roles",
                reason: format!("{user} has only {}", owner.roles),
            });
        }
        if write.tokens_of_user(user).await?.len() >= 2 * MOST_TOKENS {
            return invalid("user", "this user has too many tokens: revoke some");
        }
        let token = Token::random(TokenKind::Operator);
        let new = NewToken {
            token: &token,
            user,
            origin: TokenOrigin::Token,
            title: &order.title,
            roles: order.roles.as_ref(),
            scope: scope.as_ref(),
            expires_at_ms,
        };
        write.create_token(&new, now_ms).await?;
        let deed = Deed::by(by, Act::TokenCreate, token.id())
            .with("user", user)
            .with("title", &order.title)
            .with_some("roles", order.roles.as_ref())
            .with_some("scope", scope.as_ref())
            .with("expires_at_ms", expires_at_ms);
        write.audit(&deed, now_ms).await?;
        write.commit().await?;
        let id = token.id().parse().expect("a token's id has its form");
        Ok(AccessToken { id, token: token.reveal(), user: user.clone(), expires_at_ms })
    }

    /// Ends a token: one of the caller's own, or by an administrator any user's. The call is
    /// idempotent. Returns the token's user. A token that was not made by a sign-in may end only
    /// itself: it may have leaked.
    pub async fn revoke_token(&self, by: &Person, id: &TokenId) -> Result<UserName, ActionError> {
        let now_ms = self.clock.now_ms();
        let mut write = self.store.begin().await?;
        let token: Option<TokenView> = write.person_token(id).await?;
        let is_own = |token: &TokenView| {
            token.user == by.name && (by.origin != TokenOrigin::Token || *id == by.token)
        };
        let token = token.filter(|token| is_own(token) || by.may(Permission::Administer));
        let token = token.ok_or_else(|| ActionError::TokenNotFound(id.clone()))?;
        if token.revoked_at_ms.is_some() {
            return Ok(token.user);
        }
        if token.origin == TokenOrigin::First {
            check_not_last(&mut write, None).await?;
        }
        write.audit(&Deed::by(by, Act::TokenRevoke, id).with("user", &token.user), now_ms).await?;
        write.revoke_person_token(id, now_ms).await?;
        write.commit().await?;
        self.changes.announce_rights();
        Ok(token.user)
    }
}

impl From<PasswordError> for ActionError {
    fn from(error: PasswordError) -> Self {
        match error {
            PasswordError::Unfit(reason) => Self::Invalid { key: "password", reason },
            PasswordError::Busy => Self::TooManySignIns,
            PasswordError::Failed => Self::PasswordFailed,
        }
    }
}

impl Deed {
    /// Adds the user's roles and scope.
    pub(super) fn described(self, user: &User) -> Self {
        let scope = user.scope.as_ref().map_or_else(|| "*".to_owned(), Selector::to_string);
        self.with("roles", &user.roles).with("scope", scope)
    }
}

/// A scope as stored: a selector for all robots means no limit.
fn limit(scope: Option<&Selector>) -> Result<Option<Selector>, ActionError> {
    let Some(scope) = scope else { return Ok(None) };
    let text = scope.to_string();
    if text.len() > MOST_SCOPE_BYTES {
        let reason = format!("expected at most {MOST_SCOPE_BYTES} bytes; give the robots a label");
        return Err(ActionError::Invalid { key: "scope", reason });
    }
    Ok((text != "*").then(|| scope.clone()))
}

/// Refuses a name that is taken.
pub(super) async fn check_new(write: &mut Write, name: &UserName) -> Result<(), ActionError> {
    let users = write.users().await?;
    if RESERVED.contains(&name.as_str()) || users.iter().any(|user| user.name == *name) {
        return Err(ActionError::UserExists(name.clone()));
    }
    if users.len() >= MOST_USERS {
        return Err(ActionError::Invalid {
            key: "name",
            reason: format!("there are {MOST_USERS} users already"),
        });
    }
    Ok(())
}

/// Refuses manual changes of fields that the provider and the OIDC rules decide.
fn check_own(user: &User) -> Result<(), ActionError> {
    match user.subject {
        Some(_) => Err(ActionError::OfProvider(user.name.clone())),
        None => Ok(()),
    }
}

async fn known_user(write: &mut Write, name: &UserName) -> Result<User, ActionError> {
    write.user(name).await?.ok_or_else(|| ActionError::UserNotFound(name.clone()))
}

/// Refuses to remove the last administrator: another administrator with a password, or the first
/// token, has to remain. `except` is being removed, or else the first token.
async fn check_not_last(write: &mut Write, except: Option<&UserName>) -> Result<(), ActionError> {
    if except.is_some() && write.has_first_token().await? {
        return Ok(());
    }
    let is_other = |user: &User| {
        user.is_administrator() && user.password.is_some() && Some(&user.name) != except
    };
    match write.users().await?.iter().any(is_other) {
        true => Ok(()),
        false => Err(ActionError::LastAdministrator(except.cloned().unwrap_or_else(first_name))),
    }
}
