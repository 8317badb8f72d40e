//! Caches recent admissions, so that a robot's thousand requests ask the database once. Also caches
//! the publishers' signatures, which robots are told with each request for their desired state. An
//! answer is cached until the next write that could change it has ended, for at most some seconds,
//! and never beyond a token's own expiry. Revoking therefore takes effect at once. Refusals are not
//! cached. The cache never decides about permissions.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use task_proto::desired::BlobRef;
use task_proto::token::{Token, TokenKind};
use task_proto::{Digest, RobotId};

use crate::store::{FetchedBy, TokenHolder};

/// The most cached answers of each kind; beyond this number all are dropped.
const MAX_ANSWERS: usize = 32 * 1024;
/// The most packages with cached signatures.
const MAX_PACKAGES: usize = 1024;
/// The longest life of an answer: another process could write to the same database.
const MAX_AGE: Duration = Duration::from_secs(5);

/// The cache. Clones share one cache.
#[derive(Debug, Clone, Default)]
pub(in crate::store) struct Access {
    answers: Arc<Mutex<Answers>>,
}

#[derive(Debug, Default)]
struct Answers {
    epoch: u64,
    since: Option<Instant>,
    holders: HashMap<Shown, Holder>,
    fetches: HashMap<(RobotId, Digest), Arc<FetchedBy>>,
    lists: Option<Vec<BlobRef>>,
    signatures: HashMap<Digest, Vec<BlobRef>>,
}

/// A token by its kind, its id and the digest of its secret. An attacker who could exploit the
/// timing of a look-up would have to choose secrets by their SHA-256.
type Shown = (TokenKind, String, Digest);

#[derive(Debug)]
struct Holder {
    holder: TokenHolder,
    expires_at_ms: Option<u64>,
}

/// The epoch of a question. Its answer is cached only if no write has ended since.
#[derive(Debug, Clone, Copy)]
pub(in crate::store) struct Asked {
    epoch: u64,
}

/// Guards a write in progress. When the write ends, in any way, this drops all answers if `is_due`
/// is set.
#[derive(Debug)]
pub(in crate::store) struct Ending {
    access: Access,
    pub(in crate::store) is_due: bool,
}

impl Access {
    /// Must be called before the database is asked.
    pub(in crate::store) fn ask(&self) -> Asked {
        Asked { epoch: self.answers().epoch }
    }

    /// The cached holder of the token.
    pub(in crate::store) fn holder(&self, token: &Token, now_ms: u64) -> Option<TokenHolder> {
        let shown = shown(token);
        let answers = self.answers();
        let known = answers.holders.get(&shown)?;
        let is_current = known.expires_at_ms.is_none_or(|expires_at_ms| expires_at_ms > now_ms);
        is_current.then(|| known.holder.clone())
    }

    /// Caches the holder of the token. The secret has just been verified.
    pub(in crate::store) fn remember_holder(
        &self,
        asked: Asked,
        token: &Token,
        holder: &TokenHolder,
        expires_at_ms: Option<u64>,
    ) {
        let mut answers = self.answers();
        if answers.epoch == asked.epoch {
            if answers.holders.len() >= MAX_ANSWERS {
                answers.holders.clear();
            }
            answers.holders.insert(shown(token), Holder { holder: holder.clone(), expires_at_ms });
        }
    }

    /// The cached order by which the robot may fetch the blob.
    pub(in crate::store) fn fetched_by(
        &self,
        robot: &RobotId,
        digest: &Digest,
    ) -> Option<Arc<FetchedBy>> {
        self.answers().fetches.get(&(robot.clone(), *digest)).cloned()
    }

    /// Caches the order by which the robot may fetch the blob, and returns it.
    pub(in crate::store) fn remember_fetch(
        &self,
        asked: Asked,
        robot: &RobotId,
        digest: &Digest,
        order: FetchedBy,
    ) -> Arc<FetchedBy> {
        let order = Arc::new(order);
        let mut answers = self.answers();
        if answers.epoch == asked.epoch {
            if answers.fetches.len() >= MAX_ANSWERS {
                answers.fetches.clear();
            }
            answers.fetches.insert((robot.clone(), *digest), order.clone());
        }
        order
    }

    /// The cached lists of publishers for robots.
    pub(in crate::store) fn lists(&self) -> Option<Vec<BlobRef>> {
        self.answers().lists.clone()
    }

    /// Caches the lists of publishers for robots.
    pub(in crate::store) fn remember_lists(&self, asked: Asked, lists: &[BlobRef]) {
        let mut answers = self.answers();
        if answers.epoch == asked.epoch {
            answers.lists = Some(lists.to_vec());
        }
    }

    /// The cached signatures of the package with this manifest.
    pub(in crate::store) fn signatures(&self, manifest: &Digest) -> Option<Vec<BlobRef>> {
        self.answers().signatures.get(manifest).cloned()
    }

    /// Caches the signatures of a package.
    pub(in crate::store) fn remember_signatures(
        &self,
        asked: Asked,
        manifest: Digest,
        signatures: Vec<BlobRef>,
    ) {
        let mut answers = self.answers();
        if answers.epoch == asked.epoch {
            if answers.signatures.len() >= MAX_PACKAGES {
                answers.signatures.clear();
            }
            answers.signatures.insert(manifest, signatures);
        }
    }

    /// Begins a write. The write changes no access rights until [`Ending::is_due`] is set.
    pub(in crate::store) fn until_ended(&self) -> Ending {
        Ending { access: self.clone(), is_due: false }
    }

    fn answers(&self) -> MutexGuard<'_, Answers> {
        // Every change under this lock is complete in itself, so a panic elsewhere leaves nothing
        // half-done.
        let mut answers = self.answers.lock().unwrap_or_else(PoisonError::into_inner);
        if answers.since.is_none_or(|since| since.elapsed() > MAX_AGE) {
            answers.forget();
        }
        answers
    }
}

fn shown(token: &Token) -> Shown {
    (token.kind(), token.id(), token.secret_digest())
}

impl Answers {
    fn forget(&mut self) {
        self.epoch += 1;
        self.since = Some(Instant::now());
        self.holders.clear();
        self.fetches.clear();
        self.lists = None;
        self.signatures.clear();
    }
}

impl Drop for Ending {
    fn drop(&mut self) {
        if self.is_due {
            self.access.answers.lock().unwrap_or_else(PoisonError::into_inner).forget();
        }
    }
}

#[cfg(test)]
mod tests {
    use task_proto::token::TokenKind;

    use super::*;

    #[test]
    fn an_answer_counts_until_a_write_ends_or_the_token_does() {
        let access = Access::default();
        let (token, robot, blob) =
            (Token::random(TokenKind::Robot), RobotId::random(), Digest::of(b"x"));
        let holder = TokenHolder::Robot { robot: robot.clone(), token_number: 3, key: None };
        let remember = |asked| {
            access.remember_holder(asked, &token, &holder, Some(100));
            let order = FetchedBy { priority: 0, number: 1, labels: Default::default() };
            access.remember_fetch(asked, &robot, &blob, order);
            access.remember_lists(asked, &[BlobRef::of(b"list")]);
            access.remember_signatures(asked, blob, Vec::new());
        };
        let known = || {
            let found = access.fetched_by(&robot, &blob).is_some();
            assert_eq!(
                (access.lists().is_some(), access.signatures(&blob).is_some()),
                (found, found)
            );
            (access.holder(&token, 99), found)
        };
        assert_eq!(known(), (None, false));
        remember(access.ask());
        assert_eq!(known(), (Some(holder.clone()), true));
        assert_eq!(access.holder(&Token::random(TokenKind::Robot), 99), None);
        assert_eq!(access.holder(&token, 100), None);
        drop(access.until_ended());
        assert_eq!(known(), (Some(holder.clone()), true), "it changed nobody's rights");
        let end = || access.until_ended().is_due = true;
        end();
        assert_eq!(known(), (None, false));
        // An answer read before a write ended says nothing about the time after the write.
        let asked = access.ask();
        end();
        remember(asked);
        assert_eq!(known(), (None, false));
    }
}
