//! Caches recent admissions, so that a robot's thousand requests ask the database once. Also caches
//! the publishers' signatures, which robots are told with each request for their desired state. An
//! answer is cached until the next write that could change it has ended, for at most some seconds,
//! and never beyond a token's own expiry. Revoking therefore takes effect at once. Refusals are not
//! cached. The cache never decides about permissions.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use task_proto::desired::BlobRef;
use task_proto::trust::token::{Token, TokenKind};
use task_proto::{Digest, RobotId};
use tokio::sync::watch;

use crate::domain::person::Person;
use crate::store::{FetchGrant, PageSession, TokenHolder};

/// The most cached answers of each kind; beyond this number all are dropped.
const MAX_ENTRIES: usize = 32 * 1024;
/// The most packages with cached signatures.
const MAX_PACKAGES: usize = 1024;
/// The longest life of an answer: another process could write to the same database.
const MAX_AGE: Duration = Duration::from_secs(5);

/// The cache. Clones share one cache.
#[derive(Debug, Clone, Default)]
pub(in crate::store) struct AuthCache {
    entries: Arc<Mutex<CacheEntries>>,
    /// Changes with each write of this process that may have changed an answer.
    written: watch::Sender<()>,
}

#[derive(Debug, Default)]
struct CacheEntries {
    epoch: u64,
    since: Option<Instant>,
    holders: HashMap<TokenKey, CachedHolder>,
    page_sessions: HashMap<Digest, PageSession>,
    fetches: HashMap<(RobotId, Digest), Arc<FetchGrant>>,
    lists: Option<Vec<BlobRef>>,
    signatures: HashMap<Digest, Vec<BlobRef>>,
}

/// A token by its kind, its id and the digest of its secret. An attacker who could exploit the
/// timing of a look-up would have to choose secrets by their SHA-256.
type TokenKey = (TokenKind, String, Digest);

#[derive(Debug)]
struct CachedHolder {
    holder: TokenHolder,
    expires_at_ms: Option<u64>,
}

/// The epoch of a query. Its answer is cached only if no write has ended since.
#[derive(Debug, Clone, Copy)]
pub(in crate::store) struct CacheEpoch(u64);

/// Guards a write in progress. When the write ends, in any way, this clears the cache if
/// `invalidates` is set.
#[derive(Debug)]
pub(in crate::store) struct InvalidationGuard {
    auth_cache: AuthCache,
    pub(in crate::store) invalidates: bool,
}

impl AuthCache {
    /// Must be called before the database is asked.
    pub(in crate::store) fn epoch(&self) -> CacheEpoch {
        CacheEpoch(self.entries().epoch)
    }

    /// The cached holder of the token.
    pub(in crate::store) fn holder(&self, token: &Token, now_ms: u64) -> Option<TokenHolder> {
        let key = token_key(token);
        let entries = self.entries();
        let known = entries.holders.get(&key)?;
        let is_current = known.expires_at_ms.is_none_or(|expires_at_ms| expires_at_ms > now_ms);
        is_current.then(|| known.holder.clone())
    }

    /// Caches the holder of the token. The secret has just been verified.
    pub(in crate::store) fn cache_holder(
        &self,
        epoch: CacheEpoch,
        token: &Token,
        holder: &TokenHolder,
        expires_at_ms: Option<u64>,
    ) {
        let mut entries = self.entries();
        if entries.epoch == epoch.0 {
            if entries.holders.len() >= MAX_ENTRIES {
                entries.holders.clear();
            }
            entries
                .holders
                .insert(token_key(token), CachedHolder { holder: holder.clone(), expires_at_ms });
        }
    }

    /// The cached person of the page session.
    pub(in crate::store) fn page_session(&self, digest: &Digest, now_ms: u64) -> Option<Person> {
        let entries = self.entries();
        let session = entries.page_sessions.get(digest)?;
        (session.expires_at_ms > now_ms).then(|| session.person.clone())
    }

    /// Caches the page session.
    pub(in crate::store) fn cache_page_session(
        &self,
        epoch: CacheEpoch,
        digest: &Digest,
        session: &PageSession,
    ) {
        let mut entries = self.entries();
        if entries.epoch == epoch.0 {
            if entries.page_sessions.len() >= MAX_ENTRIES {
                entries.page_sessions.clear();
            }
            entries.page_sessions.insert(*digest, session.clone());
        }
    }

    /// The cached order by which the robot may fetch the blob.
    pub(in crate::store) fn fetch_grant(
        &self,
        robot: &RobotId,
        digest: &Digest,
    ) -> Option<Arc<FetchGrant>> {
        self.entries().fetches.get(&(robot.clone(), *digest)).cloned()
    }

    /// Caches the order by which the robot may fetch the blob, and returns it.
    pub(in crate::store) fn cache_fetch_grant(
        &self,
        epoch: CacheEpoch,
        robot: &RobotId,
        digest: &Digest,
        order: FetchGrant,
    ) -> Arc<FetchGrant> {
        let order = Arc::new(order);
        let mut entries = self.entries();
        if entries.epoch == epoch.0 {
            if entries.fetches.len() >= MAX_ENTRIES {
                entries.fetches.clear();
            }
            entries.fetches.insert((robot.clone(), *digest), order.clone());
        }
        order
    }

    /// The cached lists of publishers for robots.
    pub(in crate::store) fn lists(&self) -> Option<Vec<BlobRef>> {
        self.entries().lists.clone()
    }

    /// Caches the lists of publishers for robots.
    pub(in crate::store) fn cache_lists(&self, epoch: CacheEpoch, lists: &[BlobRef]) {
        let mut entries = self.entries();
        if entries.epoch == epoch.0 {
            entries.lists = Some(lists.to_vec());
        }
    }

    /// The cached signatures of the package with this manifest.
    pub(in crate::store) fn signatures(&self, manifest: &Digest) -> Option<Vec<BlobRef>> {
        self.entries().signatures.get(manifest).cloned()
    }

    /// Caches the signatures of a package.
    pub(in crate::store) fn cache_signatures(
        &self,
        epoch: CacheEpoch,
        manifest: Digest,
        signatures: Vec<BlobRef>,
    ) {
        let mut entries = self.entries();
        if entries.epoch == epoch.0 {
            if entries.signatures.len() >= MAX_PACKAGES {
                entries.signatures.clear();
            }
            entries.signatures.insert(manifest, signatures);
        }
    }

    /// Begins a write. The write changes no access rights until [`InvalidationGuard::invalidates`]
    /// is set.
    pub(in crate::store) fn invalidation_guard(&self) -> InvalidationGuard {
        InvalidationGuard { auth_cache: self.clone(), invalidates: false }
    }

    /// Forgets all answers: another process has changed the database.
    pub(in crate::store) fn forget(&self) {
        self.entries.lock().unwrap_or_else(PoisonError::into_inner).clear();
    }

    /// Changes with each write of this process that may have changed an answer.
    pub(in crate::store) fn changed(&self) -> watch::Receiver<()> {
        self.written.subscribe()
    }

    fn entries(&self) -> MutexGuard<'_, CacheEntries> {
        // Every change under this lock is complete in itself, so a panic elsewhere leaves nothing
        // half-done.
        let mut entries = self.entries.lock().unwrap_or_else(PoisonError::into_inner);
        if entries.since.is_none_or(|since| since.elapsed() > MAX_AGE) {
            entries.clear();
        }
        entries
    }
}

fn token_key(token: &Token) -> TokenKey {
    (token.kind(), token.id(), token.secret_digest())
}

impl CacheEntries {
    fn clear(&mut self) {
        self.epoch += 1;
        self.since = Some(Instant::now());
        self.holders.clear();
        self.page_sessions.clear();
        self.fetches.clear();
        self.lists = None;
        self.signatures.clear();
    }
}

impl Drop for InvalidationGuard {
    fn drop(&mut self) {
        if self.invalidates {
            self.auth_cache.forget();
            self.auth_cache.written.send_replace(());
        }
    }
}

#[cfg(test)]
mod tests {
    use task_proto::trust::token::TokenKind;

    use super::*;

    #[test]
    fn cached_answer_is_valid_until_a_write_ends_or_the_token_expires() {
        let auth_cache = AuthCache::default();
        let person = Person::first("0123456789ab".parse().expect("an id"));
        let session = PageSession { person: person.clone(), expires_at_ms: 100 };
        let (token, robot, blob) =
            (Token::random(TokenKind::Robot), RobotId::random(), Digest::of(b"x"));
        let holder = TokenHolder::Robot { robot: robot.clone(), token_number: 3, key: None };
        let remember = |epoch| {
            auth_cache.cache_holder(epoch, &token, &holder, Some(100));
            auth_cache.cache_page_session(epoch, &blob, &session);
            let order = FetchGrant { priority: 0, number: 1, labels: Default::default() };
            auth_cache.cache_fetch_grant(epoch, &robot, &blob, order);
            auth_cache.cache_lists(epoch, &[BlobRef::of(b"list")]);
            auth_cache.cache_signatures(epoch, blob, Vec::new());
        };
        let known = || {
            let found = auth_cache.fetch_grant(&robot, &blob).is_some();
            assert_eq!(
                (auth_cache.lists().is_some(), auth_cache.signatures(&blob).is_some()),
                (found, found)
            );
            assert_eq!(auth_cache.page_session(&blob, 99), found.then(|| person.clone()));
            (auth_cache.holder(&token, 99), found)
        };
        assert_eq!(known(), (None, false));
        remember(auth_cache.epoch());
        assert_eq!(known(), (Some(holder.clone()), true));
        assert_eq!(auth_cache.holder(&Token::random(TokenKind::Robot), 99), None);
        assert_eq!(
            (auth_cache.holder(&token, 100), auth_cache.page_session(&blob, 100)),
            (None, None)
        );
        drop(auth_cache.invalidation_guard());
        assert_eq!(known(), (Some(holder.clone()), true), "the write changed no rights");
        let end = || auth_cache.invalidation_guard().invalidates = true;
        end();
        assert_eq!(known(), (None, false));
        // An answer read before a write ended says nothing about the time after the write.
        let epoch = auth_cache.epoch();
        end();
        remember(epoch);
        assert_eq!(known(), (None, false));
    }
}
