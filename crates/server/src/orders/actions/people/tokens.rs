//! Access tokens of users: listing, creating and revoking them.

use task_proto::api::{AccessToken, CreateToken, TokenList, TokenOrigin, TokenView};
use task_proto::people::roles::Permission;
use task_proto::trust::token::{Token, TokenKind};
use task_proto::{TokenId, UserName};

use super::{
    MAX_TOKENS, PersonActions, PersonError, check_administrator_remains, known_user, stored_scope,
};
use crate::domain::person::Person;
use crate::orders::actions::{DAY_MS, OrderError, lifetime_ms};
use crate::store::{AuditAction, AuditEvent, NewToken};

/// Default lifetime of a token.
const TOKEN_LIFETIME_MS: u64 = 90 * DAY_MS;
/// The longest title of a token, in characters.
const MAX_TITLE_CHARACTERS: usize = 200;

impl PersonActions {
    /// The user's own tokens, or all users' tokens.
    pub async fn tokens(&self, by: &Person, all: bool) -> Result<TokenList, PersonError> {
        let of = (!all).then_some(&by.name).filter(|_| !by.is_first());
        Ok(TokenList { tokens: self.store.tokens().list(of, self.clock.now_ms()).await? })
    }

    /// Creates a token: for the caller, or by an administrator for any user.
    pub async fn create_token(
        &self,
        by: &Person,
        order: &CreateToken,
    ) -> Result<AccessToken, PersonError> {
        let invalid = |key, reason: &str| Err(OrderError::invalid(key, reason).into());
        let user = match &order.user {
            Some(user) if *user != by.name && !by.may(Permission::Administer) => {
                return Err(PersonError::NotPermitted(format!(
                    "{} may only create tokens for {}",
                    by.name, by.name
                )));
            }
            Some(user) => user,
            None if by.is_first() => {
                return invalid(
                    "user",
                    "the first token belongs to no user; name the user of the new token",
                );
            }
            None => &by.name,
        };
        // Otherwise a leaked token could renew itself forever.
        if by.origin == TokenOrigin::Token && !by.may(Permission::Administer) {
            let reason = "a token can't create a token; sign in with your password (taskd login)";
            return Err(PersonError::NotPermitted(reason.to_owned()));
        }
        if order.title.chars().count() > MAX_TITLE_CHARACTERS
            || order.title.contains(char::is_control)
        {
            return invalid("title", "expected at most 200 printable characters");
        }
        let (scope, now_ms) = (stored_scope(order.scope.as_ref())?, self.clock.now_ms());
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
                "{user} signs in through the OpenID provider; only an administrator can create tokens for {user}"
            );
            return Err(PersonError::NotPermitted(reason));
        }
        if order
            .roles
            .as_ref()
            .is_some_and(|roles| roles.within(&owner.roles).as_ref() != Some(roles))
        {
            let reason = format!("{user} has only {}", owner.roles);
            return Err(OrderError::invalid("roles", reason).into());
        }
        if write.tokens().of_user(user).await?.len() >= 2 * MAX_TOKENS {
            return invalid("user", "the user has too many tokens; revoke some");
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
        write.tokens().create(&new, now_ms).await?;
        let event = AuditEvent::by(by, AuditAction::TokenCreate, token.id())
            .with("user", user)
            .with("title", &order.title)
            .with_some("roles", order.roles.as_ref())
            .with_some("scope", scope.as_ref())
            .with("expires_at_ms", expires_at_ms);
        write.audit().record(&event, now_ms).await?;
        write.commit().await?;
        let id = token.id().parse().expect("a token's id has its form");
        Ok(AccessToken { id, token: token.reveal(), user: user.clone(), expires_at_ms })
    }

    /// Ends a token: one of the caller's own, or by an administrator any user's. The call is
    /// idempotent. Returns the token's user. A token that was not made by a sign-in may end only
    /// itself: it may have leaked.
    pub async fn revoke_token(&self, by: &Person, id: &TokenId) -> Result<UserName, PersonError> {
        let now_ms = self.clock.now_ms();
        let mut write = self.store.begin().await?;
        let token: Option<TokenView> = write.tokens().get(id).await?;
        let is_own = |token: &TokenView| {
            token.user == by.name && (by.origin != TokenOrigin::Token || *id == by.token)
        };
        let token = token.filter(|token| is_own(token) || by.may(Permission::Administer));
        let token = token.ok_or_else(|| PersonError::TokenNotFound(id.clone()))?;
        if token.revoked_at_ms.is_some() {
            return Ok(token.user);
        }
        if token.origin == TokenOrigin::First {
            check_administrator_remains(&mut write, None).await?;
        }
        write
            .audit()
            .record(
                &AuditEvent::by(by, AuditAction::TokenRevoke, id).with("user", &token.user),
                now_ms,
            )
            .await?;
        write.tokens().revoke(id, now_ms).await?;
        write.commit().await?;
        self.changes.announce_rights();
        Ok(token.user)
    }
}
