//! Who was let in a moment ago, so that a robot's thousand requests ask the database once, and what
//! publishers have signed, which robots are told each time they ask what they should have. An
//! answer is remembered until the next write that could change it has ended, at most for some
//! seconds, and never beyond a token's own end: what is revoked here is revoked at once. Refusals
//! are not remembered. It never decides who may do what.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use task_proto::desired::BlobRef;
use task_proto::token::{Token, TokenKind};
use task_proto::{Digest, RobotId};

use crate::store::{FetchedBy, TokenHolder};

/// Answers remembered of each kind; beyond it all are forgotten.
const MAX_ANSWERS: usize = 32 * 1024;
/// Packages whose signatures are remembered.
const MAX_PACKAGES: usize = 1024;
/// How long an answer counts in any case: somebody else could write to the same database.
const MAX_AGE: Duration = Duration::from_secs(5);

/// What is remembered. Clones are the same.
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

/// A token by its kind, its id and the digest of its secret. Whoever could make use of how long a
/// look-up takes would have to choose secrets by their SHA-256.
type Shown = (TokenKind, String, Digest);

#[derive(Debug)]
struct Holder {
    holder: TokenHolder,
    expires_at_ms: Option<u64>,
}

/// When a question was asked. Its answer is remembered only if nothing has ended since.
#[derive(Debug, Clone, Copy)]
pub(in crate::store) struct Asked {
    epoch: u64,
}

/// A write that is under way. When it ends, however it ends, all answers are forgotten, if that is
/// due.
#[derive(Debug)]
pub(in crate::store) struct Ending {
    access: Access,
    pub(in crate::store) is_due: bool,
}

impl Access {
    /// To be called before the database is asked.
    pub(in crate::store) fn ask(&self) -> Asked {
        Asked { epoch: self.answers().epoch }
    }

    /// Whom the token stands for, if that is known.
    pub(in crate::store) fn holder(&self, token: &Token, now_ms: u64) -> Option<TokenHolder> {
        let shown = shown(token);
        let answers = self.answers();
        let known = answers.holders.get(&shown)?;
        let is_current = known.expires_at_ms.is_none_or(|expires_at_ms| expires_at_ms > now_ms);
        is_current.then(|| known.holder.clone())
    }

    /// Remembers whom the token, of which that has just been proven, stands for.
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

    /// By which order the robot may fetch the blob, if that is known.
    pub(in crate::store) fn fetched_by(
        &self,
        robot: &RobotId,
        digest: &Digest,
    ) -> Option<Arc<FetchedBy>> {
        self.answers().fetches.get(&(robot.clone(), *digest)).cloned()
    }

    /// Remembers by which order the robot may fetch the blob, and gives it back.
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

    /// The lists of publishers that robots are told of, if they are known.
    pub(in crate::store) fn lists(&self) -> Option<Vec<BlobRef>> {
        self.answers().lists.clone()
    }

    /// Remembers the lists of publishers that robots are told of.
    pub(in crate::store) fn remember_lists(&self, asked: Asked, lists: &[BlobRef]) {
        let mut answers = self.answers();
        if answers.epoch == asked.epoch {
            answers.lists = Some(lists.to_vec());
        }
    }

    /// The signatures of the package with this manifest, if they are known.
    pub(in crate::store) fn signatures(&self, manifest: &Digest) -> Option<Vec<BlobRef>> {
        self.answers().signatures.get(manifest).cloned()
    }

    /// Remembers the signatures of a package.
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

    /// A write begins. It changes nobody's rights until it says that it may.
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
        // What was read before a write ended says nothing about the time after it.
        let asked = access.ask();
        end();
        remember(asked);
        assert_eq!(known(), (None, false));
    }
}
