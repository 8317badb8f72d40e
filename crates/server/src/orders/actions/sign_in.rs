//! Sign-in with a password, or through an OpenID provider. Each sign-in creates a token that
//! expires by itself. Failed attempts are limited before any credential is checked.

use std::net::IpAddr;

use task_proto::UserName;
use task_proto::api::{LogIn, TokenOrigin};
use task_proto::token::{Token, TokenKind};

use super::people::{MOST_TOKENS, check_new};
use super::robots::lifetime_ms;
use super::{ActionError, Actions, DAY_MS};
use crate::auth::sign_ins::Blocked;
use crate::config::RoleRule;
use crate::store::{Act, Deed, NewToken, StoreError, User, Write};

/// Default and maximum lifetime of a token from `taskd login`.
const LOGIN_LIFETIME_MS: u64 = 30 * DAY_MS;
/// Lifetime of a page session.
pub const PAGE_LIFETIME_MS: u64 = DAY_MS / 2;

/// A user who has just signed in.
pub struct SignedIn {
    pub user: UserName,
    pub token: Token,
    /// Expiry of the token.
    pub expires_at_ms: u64,
    /// Whether the user's rights differ from those before.
    pub has_other_rights: bool,
}

/// A user authenticated by the OpenID provider.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ProviderUser {
    /// The subject at the provider, with the issuer in front.
    pub subject: String,
    /// The user name for a new user; `None`: the provider has no name that is valid here.
    pub name: Option<UserName>,
}

impl Actions {
    /// Signs in with a password.
    pub async fn sign_in(
        &self,
        order: &LogIn,
        origin: TokenOrigin,
        address: IpAddr,
    ) -> Result<SignedIn, ActionError> {
        let lifetime_ms = match (origin, order.ttl_s) {
            (TokenOrigin::Page, _) => PAGE_LIFETIME_MS,
            (_, Some(seconds)) => lifetime_ms("ttl_s", seconds)?.min(LOGIN_LIFETIME_MS),
            (_, None) => LOGIN_LIFETIME_MS,
        };
        let checked = self.check_password(&order.user, &order.password, address).await?;
        let now_ms = self.clock.now_ms();
        let mut write = self.store.begin().await?;
        // The password may have been changed during the check.
        if write.user(&order.user).await?.is_none_or(|user| user.password != checked.password) {
            return Err(ActionError::SignInRefused);
        }
        let how = if origin == TokenOrigin::Page { "page" } else { "login" };
        let signed_in =
            begin_session(&mut write, &order.user, origin, how, address, lifetime_ms, now_ms)
                .await?;
        write.commit().await?;
        Ok(signed_in)
    }

    /// Signs in a user authenticated by the OpenID provider. The user is the one that this subject
    /// had at the last sign-in; the permissions are those that `rule` gives now.
    pub async fn sign_in_by_provider(
        &self,
        who: &ProviderUser,
        rule: Option<&RoleRule>,
        address: IpAddr,
    ) -> Result<SignedIn, ActionError> {
        let now_ms = self.clock.now_ms();
        let mut write = self.store.begin().await?;
        let before = write.user_by_subject(&who.subject).await?;
        let deed =
            |act, name: &UserName| Deed::new("server".to_owned(), None, Some(address), act, name);
        let Some(rule) = rule else {
            // The user's existing sessions end, too.
            if let Some(user) = &before {
                write.remove_user(&user.name).await?;
                let deed = deed(Act::UserRemove, &user.name)
                    .with("why", "no rule gives them a role any more");
                write.audit(&deed, now_ms).await?;
                write.commit().await?;
                self.changes.announce_rights();
            }
            return Err(ActionError::NoRole { removed: before.map(|user| user.name) });
        };
        let (roles, scope) = (rule.roles.clone(), rule.robots.clone());
        let user = match &before {
            Some(user) => User { roles, scope, ..user.clone() },
            None => {
                let name = who.name.clone().ok_or(ActionError::NoName)?;
                check_new(&mut write, &name).await?;
                User {
                    name,
                    roles,
                    scope,
                    password: None,
                    subject: Some(who.subject.clone()),
                    created_at_ms: now_ms,
                }
            }
        };
        if before.as_ref() != Some(&user) {
            write.put_user(&user).await?;
            let act = if before.is_some() { Act::UserEdit } else { Act::UserAdd };
            write
                .audit(
                    &deed(act, &user.name).described(&user).with("subject", &who.subject),
                    now_ms,
                )
                .await?;
        }
        let (origin, lifetime_ms) = (TokenOrigin::Page, PAGE_LIFETIME_MS);
        let signed_in =
            begin_session(&mut write, &user.name, origin, "provider", address, lifetime_ms, now_ms)
                .await?;
        write.commit().await?;
        let has_other_rights = before.is_some_and(|before| before != user);
        if has_other_rights {
            self.changes.announce_rights();
        }
        Ok(SignedIn { has_other_rights, ..signed_in })
    }

    /// Counts an attempt to sign in by the provider as failed until
    /// [`Self::provider_sign_in_succeeded`].
    pub async fn begin_provider_sign_in(&self, address: IpAddr) -> Result<(), ActionError> {
        let now_ms = self.clock.now_ms();
        let Err(blocked) = self.sign_ins.begin_unnamed(address, now_ms) else { return Ok(()) };
        self.blocked("nobody", address, blocked, now_ms).await
    }

    /// The attempt counts no longer.
    pub fn provider_sign_in_succeeded(&self, address: IpAddr) {
        self.sign_ins.unnamed_succeeded(address);
    }

    /// The user, if the password is theirs and not too many were wrong.
    pub(super) async fn check_password(
        &self,
        name: &UserName,
        password: &str,
        address: IpAddr,
    ) -> Result<User, ActionError> {
        let user = self.store.user(name).await?;
        let hash = user.as_ref().and_then(|user| user.password.as_ref());
        let now_ms = self.clock.now_ms();
        if let Err(blocked) = self.sign_ins.begin(name, hash.is_some(), address, now_ms) {
            // An unknown user name may be a password in the wrong field.
            let whose = if user.is_some() { name.as_str() } else { "nobody" };
            // Otherwise the response time would reveal which names are known at this address.
            self.passwords.pretend().await;
            self.blocked(whose, address, blocked, now_ms).await?;
        }
        match self.passwords.verify(password, hash).await {
            Ok(true) => self.sign_ins.succeeded(name, address, now_ms),
            Ok(false) => {
                return Err(match self.sign_ins.blocked_at(address, now_ms) {
                    Some(blocked) => too_many_failures(blocked, now_ms),
                    None => ActionError::SignInRefused,
                });
            }
            Err(error) => {
                self.sign_ins.given_up(name, hash.is_some(), address);
                return Err(error.into());
            }
        }
        user.ok_or(ActionError::SignInRefused)
    }

    /// Always an error; the first time it is recorded in the audit.
    async fn blocked(
        &self,
        whose: &str,
        address: IpAddr,
        blocked: Blocked,
        now_ms: u64,
    ) -> Result<(), ActionError> {
        let Blocked { until_ms, is_news } = blocked;
        if is_news {
            let mut write = self.store.begin_keeping_rights().await?;
            // The user is unknown, so the audit event names no actor.
            let deed =
                Deed::new("server".to_owned(), None, Some(address), Act::SignInBlocked, whose);
            write.audit(&deed.with("until_ms", until_ms), now_ms).await?;
            write.commit().await?;
        }
        Err(too_many_failures(blocked, now_ms))
    }
}

fn too_many_failures(blocked: Blocked, now_ms: u64) -> ActionError {
    ActionError::SignInBlocked { seconds: blocked.until_ms.saturating_sub(now_ms).div_ceil(1000) }
}

/// Stores the token of a signed-in user, and records the sign-in in the audit.
async fn begin_session(
    write: &mut Write,
    user: &UserName,
    origin: TokenOrigin,
    how: &str,
    address: IpAddr,
    lifetime_ms: u64,
    now_ms: u64,
) -> Result<SignedIn, StoreError> {
    let (token, expires_at_ms) = (Token::random(TokenKind::Operator), now_ms + lifetime_ms);
    let tokens = write.tokens_of_user(user).await?;
    let signed_in = tokens.iter().filter(|token| token.origin == origin);
    for surplus in signed_in.skip(MOST_TOKENS / 2 - 1) {
        write.revoke_person_token(&surplus.id, now_ms).await?;
    }
    let title = format!("from {address}");
    let (roles, scope) = (None, None);
    let new = NewToken { token: &token, user, origin, title: &title, roles, scope, expires_at_ms };
    write.create_token(&new, now_ms).await?;
    let deed =
        Deed::new(user.to_string(), token.id().parse().ok(), Some(address), Act::SignIn, user);
    write.audit(&deed.with("how", how).with("expires_at_ms", expires_at_ms), now_ms).await?;
    Ok(SignedIn { user: user.clone(), token, expires_at_ms, has_other_rights: false })
}
