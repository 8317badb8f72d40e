//! Users: creating, changing and removing them, their passwords, signing them out. Their sign-in and
//! their tokens have files of their own. After a change that reduces a user's rights, no request is
//! served with the old rights.

mod sign_in;
mod tokens;

use std::net::IpAddr;
use std::sync::Arc;

use task_proto::api::{AddUser, ChangePassword, EditUser, TokenOrigin, UserView};
use task_proto::ids::selector::Selector;
use task_proto::trust::envelope::SigningKey;
use task_proto::{Digest, TokenId, UserName};

use super::OrderError;
use crate::auth::passwords::{PasswordError, Passwords};
use crate::auth::sign_ins::{NameDigest, SignInLimiter};
use crate::domain::person::{Person, first_name};
use crate::orders::changes::Changes;
use crate::store::{AuditAction, AuditEvent, Store, StoreError, Transaction, User};
use crate::system::clock::Clock;

pub use sign_in::{PAGE_LIFETIME_MS, ProviderUser, SignedIn};

const MAX_USERS: usize = 10_000;
/// Maximum number of access tokens of one user; a new sign-in replaces the oldest sign-in token.
const MAX_TOKENS: usize = 100;
/// A selector as long as that is a list of robots that belongs into a label.
const MAX_SCOPE_BYTES: usize = 1_024;

/// Names with another meaning in the audit.
const RESERVED: [&str; 3] = ["operator.token", "enrolment", "server"];

/// Users, their tokens, and their sign-in. Clones share their state.
#[derive(Clone)]
pub struct PersonActions {
    pub(super) store: Store,
    pub(super) clock: Clock,
    pub(super) changes: Changes,
    pub(super) key: Arc<SigningKey>,
    pub(super) passwords: Passwords,
    pub(super) sign_ins: Arc<SignInLimiter>,
}

/// Why a sign-in, or a change of users and tokens, was refused.
#[derive(Debug, thiserror::Error)]
pub enum PersonError {
    /// The person lacks the named permission.
    #[error("{0}")]
    NotPermitted(String),
    /// The password does not match, or the user does not exist.
    #[error("the user name or the password is wrong")]
    SignInRefused,
    /// Too many were wrong.
    #[error("too many wrong passwords; try again in {seconds} s")]
    SignInBlocked {
        /// Seconds until the next attempt is allowed.
        seconds: u64,
    },
    /// More at once than can be checked.
    #[error("too many sign-ins at once; try again")]
    TooManySignIns,
    /// No OIDC rule gives the user a role.
    #[error("no rule in oidc.rules gives you a role; ask an administrator")]
    NoRole {
        /// The existing user who was removed for this reason.
        removed: Option<UserName>,
    },
    /// The provider sends no name that is usable here.
    #[error("the provider sends no valid user name for you; ask an administrator")]
    NoName,
    /// The provider and the OIDC rules decide this.
    #[error("{0} signs in through the OpenID provider: their rights are set in oidc.rules")]
    ManagedByProvider(UserName),
    /// The password could not be hashed.
    #[error("the password could not be hashed")]
    PasswordFailed,
    /// The name is taken.
    #[error("the user name {0} is taken or reserved")]
    UserExists(UserName),
    #[error("there is no user {0}")]
    UserNotFound(UserName),
    /// No such token, or the token belongs to another user.
    #[error("you have no token {0}")]
    TokenNotFound(TokenId),
    /// Without this user the server would have no administrator.
    #[error(
        "{0} is the last administrator who can sign in; give another administrator a password first"
    )]
    LastAdministrator(UserName),
    #[error(transparent)]
    Order(#[from] OrderError),
}

impl From<StoreError> for PersonError {
    fn from(error: StoreError) -> Self {
        Self::Order(error.into())
    }
}

impl PersonActions {
    pub async fn add_user(&self, by: &Person, order: &AddUser) -> Result<UserView, PersonError> {
        let name = &order.name;
        let password = match &order.password {
            Some(password) => Some(self.passwords.hash(name, password).await?),
            None => None,
        };
        let (scope, now_ms) = (stored_scope(order.scope.as_ref())?, self.clock.now_ms());
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
        check_name_free(&mut write, name).await?;
        write.users().put(&user).await?;
        write
            .audit()
            .record(&AuditEvent::by(by, AuditAction::UserAdd, name).with_rights(&user), now_ms)
            .await?;
        write.commit().await?;
        Ok(user.view())
    }

    /// Changes a user's role and scope.
    pub async fn edit_user(
        &self,
        by: &Person,
        name: &UserName,
        edit: &EditUser,
    ) -> Result<UserView, PersonError> {
        let mut write = self.store.begin().await?;
        let before = known_user(&mut write, name).await?;
        check_not_managed_by_provider(&before)?;
        let mut user = before.clone();
        if let Some(roles) = &edit.roles {
            user.roles = roles.clone();
        }
        if edit.scope.is_some() {
            user.scope = stored_scope(edit.scope.as_ref())?;
        }
        if before.is_administrator() && !user.is_administrator() {
            check_administrator_remains(&mut write, Some(name)).await?;
        }
        write
            .audit()
            .record(
                &AuditEvent::by(by, AuditAction::UserEdit, name).with_rights(&user),
                self.clock.now_ms(),
            )
            .await?;
        write.users().put(&user).await?;
        write.commit().await?;
        self.changes.announce_rights();
        Ok(user.view())
    }

    /// Removes a user: their tokens end now.
    pub async fn remove_user(&self, by: &Person, name: &UserName) -> Result<(), PersonError> {
        let mut write = self.store.begin().await?;
        if known_user(&mut write, name).await?.is_administrator() {
            check_administrator_remains(&mut write, Some(name)).await?;
        }
        write
            .audit()
            .record(&AuditEvent::by(by, AuditAction::UserRemove, name), self.clock.now_ms())
            .await?;
        write.users().remove(name).await?;
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
    ) -> Result<(), PersonError> {
        // Refused before the expensive hashing.
        check_not_managed_by_provider(
            &self
                .store
                .users()
                .get(name)
                .await?
                .ok_or_else(|| PersonError::UserNotFound(name.clone()))?,
        )?;
        let hash = self.passwords.hash(name, password).await?;
        let now_ms = self.clock.now_ms();
        let mut write = self.store.begin().await?;
        let user = known_user(&mut write, name).await?;
        check_not_managed_by_provider(&user)?;
        write.users().put(&User { password: Some(hash), ..user }).await?;
        for token in write.tokens().of_user(name).await? {
            let is_own = token.id == by.token;
            if matches!(token.origin, TokenOrigin::Login | TokenOrigin::Page) && !is_own {
                write.tokens().revoke(&token.id, now_ms).await?;
            }
        }
        write.sign_in_failures().delete(&NameDigest::of(name, &self.key)).await?;
        write.audit().record(&AuditEvent::by(by, AuditAction::UserPassword, name), now_ms).await?;
        write.commit().await?;
        self.changes.announce_rights();
        Ok(())
    }

    /// Changes the user's own password, after a check of the old one.
    pub async fn change_password(
        &self,
        by: &Person,
        order: &ChangePassword,
    ) -> Result<(), PersonError> {
        if by.is_first() {
            return Err(PersonError::NotPermitted("the first token has no password".to_owned()));
        }
        let address = by.address.unwrap_or(IpAddr::from([0; 4]));
        self.check_password(&by.name, &order.old, address).await.map_err(|error| match error {
            PersonError::SignInRefused => {
                OrderError::invalid("old", "the old password is wrong").into()
            }
            error => error,
        })?;
        self.set_password(by, &by.name, &order.new).await
    }

    /// Ends the page session with this digest, if any, and the token of a sign-in; a token of any
    /// other origin stays.
    pub async fn sign_out(
        &self,
        by: &Person,
        page_session: Option<&Digest>,
    ) -> Result<(), PersonError> {
        let is_sign_in = matches!(by.origin, TokenOrigin::Login | TokenOrigin::Page);
        if !is_sign_in && page_session.is_none() {
            return Ok(());
        }
        let now_ms = self.clock.now_ms();
        let mut write = self.store.begin().await?;
        if is_sign_in {
            let event = AuditEvent::by(by, AuditAction::SignOut, &by.name);
            write.audit().record(&event, now_ms).await?;
            write.tokens().revoke(&by.token, now_ms).await?;
        }
        if let Some(page_session) = page_session {
            write.page_sessions().delete(page_session).await?;
        }
        write.commit().await?;
        self.changes.announce_rights();
        Ok(())
    }
}

impl From<PasswordError> for PersonError {
    fn from(error: PasswordError) -> Self {
        match error {
            PasswordError::Unacceptable(reason) => OrderError::invalid("password", reason).into(),
            PasswordError::Busy => Self::TooManySignIns,
            PasswordError::Failed => Self::PasswordFailed,
        }
    }
}

impl AuditEvent {
    /// Adds the user's roles and scope.
    fn with_rights(self, user: &User) -> Self {
        let scope = user.scope.as_ref().map_or_else(|| "*".to_owned(), Selector::to_string);
        self.with("roles", &user.roles).with("scope", scope)
    }
}

/// A scope as stored: a selector for all robots means no limit.
fn stored_scope(scope: Option<&Selector>) -> Result<Option<Selector>, OrderError> {
    let Some(scope) = scope else { return Ok(None) };
    let text = scope.to_string();
    if text.len() > MAX_SCOPE_BYTES {
        let reason = format!("expected at most {MAX_SCOPE_BYTES} bytes; give the robots a label");
        return Err(OrderError::invalid("scope", reason));
    }
    Ok((text != "*").then(|| scope.clone()))
}

/// Refuses a name that is taken.
async fn check_name_free(write: &mut Transaction, name: &UserName) -> Result<(), PersonError> {
    let users = write.users().list().await?;
    if RESERVED.contains(&name.as_str()) || users.iter().any(|user| user.name == *name) {
        return Err(PersonError::UserExists(name.clone()));
    }
    if users.len() >= MAX_USERS {
        let reason = format!("the maximum of {MAX_USERS} users is reached");
        return Err(OrderError::invalid("name", reason).into());
    }
    Ok(())
}

/// Refuses manual changes of fields that the provider and the OIDC rules decide.
fn check_not_managed_by_provider(user: &User) -> Result<(), PersonError> {
    match user.subject {
        Some(_) => Err(PersonError::ManagedByProvider(user.name.clone())),
        None => Ok(()),
    }
}

async fn known_user(write: &mut Transaction, name: &UserName) -> Result<User, PersonError> {
    write.users().get(name).await?.ok_or_else(|| PersonError::UserNotFound(name.clone()))
}

/// Refuses to remove the last administrator: another administrator with a password, or the first
/// token, has to remain. `except` is being removed, or else the first token.
async fn check_administrator_remains(
    write: &mut Transaction,
    except: Option<&UserName>,
) -> Result<(), PersonError> {
    if except.is_some() && write.tokens().has_first().await? {
        return Ok(());
    }
    let is_other = |user: &User| {
        user.is_administrator() && user.password.is_some() && Some(&user.name) != except
    };
    match write.users().list().await?.iter().any(is_other) {
        true => Ok(()),
        false => Err(PersonError::LastAdministrator(except.cloned().unwrap_or_else(first_name))),
    }
}
