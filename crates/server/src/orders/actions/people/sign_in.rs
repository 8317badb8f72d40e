//! Sign-in with a password, or through an OpenID provider. Each sign-in creates a token that
//! expires by itself. Failed attempts are limited before any credential is checked.

use std::net::IpAddr;

use task_proto::UserName;
use task_proto::api::{LogIn, TokenOrigin};
use task_proto::trust::token::{Token, TokenKind};

use super::{MAX_TOKENS, PersonActions, PersonError, check_name_free};
use crate::auth::passwords::{PasswordHash, Passwords};
use crate::auth::sign_ins::{
    Blocked, Familiarity, MAX_FAMILIAR, NameDigest, Network, NetworkDigest, Window,
};
use crate::config::RoleRule;
use crate::orders::actions::{DAY_MS, lifetime_ms};
use crate::store::{AuditAction, AuditEvent, NewToken, StoreError, Transaction, User};

/// Default and maximum lifetime of a token from `taskd login`.
const LOGIN_LIFETIME_MS: u64 = 30 * DAY_MS;
/// Lifetime of a page session.
pub const PAGE_LIFETIME_MS: u64 = DAY_MS / 2;

/// A user provider_user has just signed in.
pub struct SignedIn {
    pub user: UserName,
    pub token: Token,
    /// Expiry of the token.
    pub expires_at_ms: u64,
    /// Whether the user's rights differ from those before.
    pub rights_changed: bool,
}

/// A user authenticated by the OpenID provider.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ProviderUser {
    /// The subject at the provider, with the issuer in front.
    pub subject: String,
    /// The user name for a new user; `None`: the provider has no name that is valid here.
    pub name: Option<UserName>,
}

/// An attempt to sign in with a password.
struct Attempt<'a> {
    digest: NameDigest,
    password: &'a str,
    /// The hash of the account's password; `None`: there is no account with a password.
    hash: Option<&'a PasswordHash>,
    now_ms: u64,
}

impl PersonActions {
    /// Signs in with a password.
    pub async fn sign_in(
        &self,
        order: &LogIn,
        origin: TokenOrigin,
        address: IpAddr,
    ) -> Result<SignedIn, PersonError> {
        let lifetime_ms = match (origin, order.ttl_s) {
            (TokenOrigin::Page, _) => PAGE_LIFETIME_MS,
            (_, Some(seconds)) => lifetime_ms("ttl_s", seconds)?.min(LOGIN_LIFETIME_MS),
            (_, None) => LOGIN_LIFETIME_MS,
        };
        let checked = self.check_password(&order.user, &order.password, address).await?;
        let now_ms = self.clock.now_ms();
        let mut write = self.store.begin().await?;
        // The password may have been changed during the check.
        if write
            .users()
            .get(&order.user)
            .await?
            .is_none_or(|user| user.password != checked.password)
        {
            return Err(PersonError::SignInRefused);
        }
        let network = NetworkDigest::of(&order.user, address.into(), &self.key);
        write.familiar_networks().put(&order.user, &network, MAX_FAMILIAR, now_ms).await?;
        let method = if origin == TokenOrigin::Page { "page" } else { "login" };
        let signed_in =
            begin_session(&mut write, &order.user, origin, method, address, lifetime_ms, now_ms)
                .await?;
        write.commit().await?;
        Ok(signed_in)
    }

    /// Signs in a user authenticated by the OpenID provider. The user is the one that this subject
    /// had at the last sign-in; the permissions are those that `rule` gives now.
    pub async fn sign_in_through_provider(
        &self,
        provider_user: &ProviderUser,
        rule: Option<&RoleRule>,
        address: IpAddr,
    ) -> Result<SignedIn, PersonError> {
        let now_ms = self.clock.now_ms();
        let mut write = self.store.begin().await?;
        let before = write.users().find_by_subject(&provider_user.subject).await?;
        let event = |act, name: &UserName| {
            AuditEvent::new("server".to_owned(), None, Some(address), act, name)
        };
        let Some(rule) = rule else {
            // The user's existing sessions end, too.
            if let Some(user) = &before {
                write.users().remove(&user.name).await?;
                let event = event(AuditAction::UserRemove, &user.name)
                    .with("why", "no rule gives the user a role any more");
                write.audit().record(&event, now_ms).await?;
                write.commit().await?;
                self.changes.announce_rights();
            }
            return Err(PersonError::NoRole { removed: before.map(|user| user.name) });
        };
        let (roles, scope) = (rule.roles.clone(), rule.robots.clone());
        let user = match &before {
            Some(user) => User { roles, scope, ..user.clone() },
            None => {
                let name = provider_user.name.clone().ok_or(PersonError::NoName)?;
                check_name_free(&mut write, &name).await?;
                User {
                    name,
                    roles,
                    scope,
                    password: None,
                    subject: Some(provider_user.subject.clone()),
                    created_at_ms: now_ms,
                }
            }
        };
        if before.as_ref() != Some(&user) {
            write.users().put(&user).await?;
            let act = if before.is_some() { AuditAction::UserEdit } else { AuditAction::UserAdd };
            write
                .audit()
                .record(
                    &event(act, &user.name)
                        .with_rights(&user)
                        .with("subject", &provider_user.subject),
                    now_ms,
                )
                .await?;
        }
        let (origin, lifetime_ms) = (TokenOrigin::Page, PAGE_LIFETIME_MS);
        let signed_in =
            begin_session(&mut write, &user.name, origin, "provider", address, lifetime_ms, now_ms)
                .await?;
        write.commit().await?;
        let rights_changed = before.is_some_and(|before| before != user);
        if rights_changed {
            self.changes.announce_rights();
        }
        Ok(SignedIn { rights_changed, ..signed_in })
    }

    /// Counts an attempt to sign in by the provider as failed until
    /// [`Self::provider_sign_in_succeeded`].
    pub async fn begin_provider_sign_in(&self, address: IpAddr) -> Result<(), PersonError> {
        let now_ms = self.clock.now_ms();
        match self.sign_ins.begin_anonymous(address, now_ms) {
            Ok(()) => Ok(()),
            Err(blocked) => Err(self.blocked("nobody", address, blocked, now_ms).await),
        }
    }

    /// The attempt counts no longer.
    pub fn provider_sign_in_succeeded(&self, address: IpAddr) {
        self.sign_ins.anonymous_succeeded(address);
    }

    /// The user, if the password is theirs and not too many were wrong.
    pub(super) async fn check_password(
        &self,
        name: &UserName,
        password: &str,
        address: IpAddr,
    ) -> Result<User, PersonError> {
        // Such a password belongs to no account, so it costs neither a permit nor a write.
        if Passwords::is_too_long(password) {
            return Err(PersonError::SignInRefused);
        }
        let user = self.store.users().get(name).await?;
        let hash = user.as_ref().and_then(|user| user.password.as_ref());
        let (now_ms, network) = (self.clock.now_ms(), Network::from(address));
        let stored = NetworkDigest::of(name, network, &self.key);
        let familiarity = match self.store.familiar_networks().contains(name, &stored).await? {
            true => Familiarity::Familiar,
            false => Familiarity::Unfamiliar,
        };
        let attempt = Attempt { digest: NameDigest::of(name, &self.key), password, hash, now_ms };
        let verified = match self.sign_ins.begin(name, network, familiarity, now_ms) {
            Ok(()) => {
                let verified = match familiarity {
                    Familiarity::Familiar => self.verify(&attempt).await.map(Ok),
                    Familiarity::Unfamiliar => self.verify_unfamiliar(&attempt).await,
                };
                // Neither a right password nor a fault of the server is a failed attempt.
                if !matches!(verified, Ok(Ok(false) | Err(_))) {
                    self.sign_ins.uncount(name, network, familiarity);
                }
                verified?
            }
            Err(blocked) => Err(blocked),
        };
        match verified {
            Ok(true) => user.ok_or(PersonError::SignInRefused),
            Ok(false) => Err(match self.sign_ins.blocked_at(network, now_ms) {
                Some(blocked) => too_many_failures(blocked, now_ms),
                None => PersonError::SignInRefused,
            }),
            Err(blocked) => {
                // An unknown user name may be a password in the wrong field.
                let subject = if user.is_some() { name.as_str() } else { "nobody" };
                // Otherwise the response time would reveal which names are known at this address.
                self.passwords.simulate_verify().await;
                Err(self.blocked(subject, address, blocked, now_ms).await)
            }
        }
    }

    /// Whether the password is right.
    async fn verify(&self, attempt: &Attempt<'_>) -> Result<bool, PersonError> {
        let permit = self.passwords.permit().await?;
        Ok(self.passwords.verify(permit, attempt.password, attempt.hash).await?)
    }

    /// Whether the password is right, or else the block of the name.
    async fn verify_unfamiliar(
        &self,
        attempt: &Attempt<'_>,
    ) -> Result<Result<bool, Blocked>, PersonError> {
        let Attempt { digest, password, hash, now_ms } = attempt;
        // A refused attempt neither waits for a permit nor writes.
        let stored = self.store.sign_in_failures().get(digest).await?;
        if let Some(blocked) = stored.and_then(|window| window.name_block(*now_ms)) {
            return Ok(Err(blocked));
        }
        let permit = self.passwords.permit().await?;
        // Permits are few, and so are these writes and rows.
        if let Err(blocked) = self.count_for_name(digest, *now_ms).await? {
            return Ok(Err(blocked));
        }
        let is_right = self.passwords.verify(permit, password, *hash).await?;
        if is_right {
            let mut write = self.store.begin_without_auth_invalidation().await?;
            if let Some(window) = write.sign_in_failures().get(digest).await? {
                write.sign_in_failures().put(digest, window.without_attempt()).await?;
            }
            write.commit().await?;
        }
        Ok(Ok(is_right))
    }

    /// Counts an attempt for its name. A name without an account is counted in the same way: the
    /// time of the answer, and a block that lasts over a restart, would tell accounts from others.
    async fn count_for_name(
        &self,
        name: &NameDigest,
        now_ms: u64,
    ) -> Result<Result<(), Blocked>, StoreError> {
        let mut write = self.store.begin_without_auth_invalidation().await?;
        let window = Window::with_attempt(write.sign_in_failures().get(name).await?, now_ms);
        write.sign_in_failures().put(name, window).await?;
        write.commit().await?;
        Ok(window.check_name())
    }

    /// The error of a blocked attempt. The first one is recorded in the audit.
    async fn blocked(
        &self,
        subject: &str,
        address: IpAddr,
        blocked: Blocked,
        now_ms: u64,
    ) -> PersonError {
        match self.record_block(subject, address, blocked, now_ms).await {
            Ok(()) => too_many_failures(blocked, now_ms),
            Err(error) => error.into(),
        }
    }

    async fn record_block(
        &self,
        subject: &str,
        address: IpAddr,
        blocked: Blocked,
        now_ms: u64,
    ) -> Result<(), StoreError> {
        let Blocked { until_ms, is_first } = blocked;
        if is_first {
            let mut write = self.store.begin_without_auth_invalidation().await?;
            // The user is unknown, so the audit event names no actor.
            let event = AuditEvent::new(
                "server".to_owned(),
                None,
                Some(address),
                AuditAction::SignInBlocked,
                subject,
            );
            match write.audit().record(&event.with("until_ms", until_ms), now_ms).await {
                Ok(()) => write.commit().await?,
                // Strangers can cause blocks without end. The block holds all the same.
                Err(StoreError::TooManyActs { .. }) => {}
                Err(error) => return Err(error),
            }
        }
        Ok(())
    }
}

fn too_many_failures(blocked: Blocked, now_ms: u64) -> PersonError {
    PersonError::SignInBlocked { seconds: blocked.until_ms.saturating_sub(now_ms).div_ceil(1000) }
}

/// Stores the token of a signed-in user, and records the sign-in in the audit.
async fn begin_session(
    write: &mut Transaction,
    user: &UserName,
    origin: TokenOrigin,
    method: &str,
    address: IpAddr,
    lifetime_ms: u64,
    now_ms: u64,
) -> Result<SignedIn, StoreError> {
    let (token, expires_at_ms) = (Token::random(TokenKind::Operator), now_ms + lifetime_ms);
    let tokens = write.tokens().of_user(user).await?;
    let signed_in = tokens.iter().filter(|token| token.origin == origin);
    for surplus in signed_in.skip(MAX_TOKENS / 2 - 1) {
        write.tokens().revoke(&surplus.id, now_ms).await?;
    }
    let title = format!("from {address}");
    let (roles, scope) = (None, None);
    let new = NewToken { token: &token, user, origin, title: &title, roles, scope, expires_at_ms };
    write.tokens().create(&new, now_ms).await?;
    let event = AuditEvent::new(
        user.to_string(),
        token.id().parse().ok(),
        Some(address),
        AuditAction::SignIn,
        user,
    );
    write
        .audit()
        .record(&event.with("how", method).with("expires_at_ms", expires_at_ms), now_ms)
        .await?;
    Ok(SignedIn { user: user.clone(), token, expires_at_ms, rights_changed: false })
}
