//! Password rules, hashing and verification. Hashing is slow on purpose, so it runs off the async
//! threads, few at a time, each followed by a pause as long as the work. A flood of sign-ins is
//! refused and does not queue. This module never knows the owner of a password.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use argon2::{Argon2, PasswordHasher as _, PasswordVerifier as _};
use task_proto::UserName;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::Instant;

/// Maximum queue length; a further request is refused.
const MAX_QUEUED: usize = 32;
/// Minimum password length, in characters.
const MIN_CHARS: usize = 12;
/// Maximum password length, in bytes.
const MAX_BYTES: usize = 1024;
/// The hash of an unknown password, at the costs of new hashes: verified for a user without a
/// password.
const DECOY: &str = "$argon2id$v=19$m=19456,t=2,p=1$oiWDNzbpRSZLLWAsLdq6YA$fFQXZmPfKzsmg/2F1msjXUWT4U8aycI1kUvh4FTMccY";

/// The stored form of a password: an argon2id hash in PHC form, with its own salt and costs.
#[derive(Clone, PartialEq, Eq)]
pub struct PasswordHash(String);

impl PasswordHash {
    pub fn as_str(&self) -> &str {
        &self.0
    }

    /// Wraps a stored text.
    pub fn stored(text: String) -> Self {
        Self(text)
    }
}

impl std::fmt::Debug for PasswordHash {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("PasswordHash(…)")
    }
}

/// The reason why a password was not hashed or verified.
#[derive(Debug, thiserror::Error)]
pub enum PasswordError {
    /// The password is too easy to guess, or too long.
    #[error("{0}")]
    Unacceptable(String),
    /// Too many requests are queued.
    #[error("too many concurrent sign-ins")]
    Busy,
    /// The hash can't be computed, or the stored text is not a hash.
    #[error("a password could not be hashed")]
    Failed,
}

/// Hashes and verifies passwords. Clones share the same limits.
#[derive(Debug, Clone)]
pub struct Passwords {
    slots: Arc<Semaphore>,
    queue: Arc<Semaphore>,
    decoy: PasswordHash,
    /// Duration of the last verification, in microseconds.
    last_duration_us: Arc<AtomicU64>,
}

/// The permit to hash or verify one password. It is returned when it is dropped.
#[derive(Debug)]
pub struct HashPermit {
    requested: Instant,
    queued: OwnedSemaphorePermit,
    slot: OwnedSemaphorePermit,
}

impl Default for Passwords {
    fn default() -> Self {
        // A quarter of the cores, at half of their time.
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let at_once = (cores / 4).clamp(1, 4);
        let queue = Arc::new(Semaphore::new(at_once + MAX_QUEUED));
        Self {
            slots: Arc::new(Semaphore::new(at_once)),
            queue,
            decoy: PasswordHash(DECOY.to_owned()),
            last_duration_us: Arc::default(),
        }
    }
}

impl Passwords {
    /// Waits for a permit. There are few, so a caller may also do its own work of a sign-in while it
    /// holds one: the same limit then bounds that work.
    pub async fn permit(&self) -> Result<HashPermit, PasswordError> {
        let requested = Instant::now();
        let queued = self.queue.clone().try_acquire_owned().map_err(|_| PasswordError::Busy)?;
        let slot = self.slots.clone().acquire_owned().await.map_err(|_| PasswordError::Busy)?;
        Ok(HashPermit { requested, queued, slot })
    }

    /// Hashes a new password of `user`.
    pub async fn hash(
        &self,
        user: &UserName,
        password: &str,
    ) -> Result<PasswordHash, PasswordError> {
        check(user, password)?;
        let password = password.to_owned();
        self.permit().await?.work(move || hashed(&password)).await?
    }

    /// Whether `password` is longer than any user's.
    pub fn is_too_long(password: &str) -> bool {
        password.len() > MAX_BYTES
    }

    /// Whether `password` matches the hash. Without a hash the call takes as long, and returns
    /// false.
    pub async fn verify(
        &self,
        permit: HashPermit,
        password: &str,
        hash: Option<&PasswordHash>,
    ) -> Result<bool, PasswordError> {
        if Self::is_too_long(password) {
            return Ok(false);
        }
        let (password, has_hash) = (password.to_owned(), hash.is_some());
        let hash = hash.unwrap_or(&self.decoy).clone();
        let requested = permit.requested;
        let checked = permit.work(move || {
            match Argon2::default().verify_password(password.as_bytes(), hash.as_str()) {
                Ok(()) => Ok(has_hash),
                Err(argon2::password_hash::Error::PasswordInvalid) => Ok(false),
                Err(_) => Err(PasswordError::Failed),
            }
        });
        let checked = checked.await?;
        let last_duration_us = u64::try_from(requested.elapsed().as_micros()).unwrap_or(u64::MAX);
        self.last_duration_us.store(last_duration_us, Ordering::Relaxed);
        checked
    }

    /// Takes as long as the last verification with its wait for a permit, without the work.
    pub async fn simulate_verify(&self) {
        tokio::time::sleep(Duration::from_micros(self.last_duration_us.load(Ordering::Relaxed)))
            .await;
    }
}

impl HashPermit {
    async fn work<T: Send + 'static>(
        self,
        work: impl FnOnce() -> T + Send + 'static,
    ) -> Result<T, PasswordError> {
        let Self { queued, slot, .. } = self;
        let begun = Instant::now();
        // The work continues if the caller goes away, so its slot stays taken too.
        let working = tokio::spawn(async move {
            let done = tokio::task::spawn_blocking(work).await;
            tokio::spawn(hold_slot(begun, slot, queued));
            done
        });
        match working.await {
            Ok(Ok(done)) => Ok(done),
            Ok(Err(_)) | Err(_) => Err(PasswordError::Failed),
        }
    }
}

/// Holds the slot for as long again as the work took.
async fn hold_slot(begun: Instant, slot: OwnedSemaphorePermit, queued: OwnedSemaphorePermit) {
    tokio::time::sleep(begun.elapsed()).await;
    drop((slot, queued));
}

fn hashed(password: &str) -> Result<PasswordHash, PasswordError> {
    let salt: [u8; 16] = rand::random();
    let hash = Argon2::default().hash_password_with_salt(password.as_bytes(), &salt);
    hash.map(|hash: argon2::PasswordHash| PasswordHash(hash.to_string()))
        .map_err(|_| PasswordError::Failed)
}

/// Length is the only requirement for a password, as in NIST SP 800-63B, besides not being an
/// obvious guess.
fn check(user: &UserName, password: &str) -> Result<(), PasswordError> {
    let unacceptable = |reason: &str| Err(PasswordError::Unacceptable(reason.to_owned()));
    if password.chars().count() < MIN_CHARS {
        return Err(PasswordError::Unacceptable(format!(
            "must have at least {MIN_CHARS} characters"
        )));
    }
    if password.len() > MAX_BYTES {
        return Err(PasswordError::Unacceptable(format!("must have at most {MAX_BYTES} bytes")));
    }
    let lower = password.to_lowercase();
    if lower.replace(user.as_str(), "").chars().count() < MIN_CHARS / 2 {
        return unacceptable("too similar to the user's name");
    }
    let mut different: Vec<char> = lower.chars().collect();
    different.sort_unstable();
    different.dedup();
    if different.len() < 5 {
        return unacceptable("too few different characters");
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn alice() -> UserName {
        "alice".parse().expect("a name")
    }

    async fn verify(
        passwords: &Passwords,
        password: &str,
        hash: Option<&PasswordHash>,
    ) -> Result<bool, PasswordError> {
        passwords.verify(passwords.permit().await?, password, hash).await
    }

    #[tokio::test]
    async fn password_verifies_and_others_do_not() {
        let passwords = Passwords::default();
        let hash = passwords.hash(&alice(), "correct horse battery").await.expect("hashed");
        assert!(hash.as_str().starts_with("$argon2id$v=19$m=19456,t=2,p=1$"), "{}", hash.as_str());
        assert!(!format!("{hash:?}").contains("argon2"));
        assert!(verify(&passwords, "correct horse battery", Some(&hash)).await.expect("checked"));
        for wrong in
            ["correct horse batterz", "", "Correct horse battery", &"x".repeat(MAX_BYTES + 1)]
        {
            assert!(!verify(&passwords, wrong, Some(&hash)).await.expect("checked"), "{wrong:?}");
        }
        assert!(!verify(&passwords, "correct horse battery", None).await.expect("checked"));
        let nonsense = PasswordHash::stored("nonsense".to_owned());
        assert!(matches!(
            verify(&passwords, "correct horse battery", Some(&nonsense)).await,
            Err(PasswordError::Failed)
        ));
        let again = passwords.hash(&alice(), "correct horse battery").await.expect("hashed");
        assert_ne!(again, hash, "each has its own salt");
    }

    #[tokio::test]
    async fn verification_without_a_password_costs_as_much() {
        let passwords = Passwords::default();
        let (hash, costs) = (
            passwords.hash(&alice(), "correct horse battery").await.expect("hashed"),
            "$m=19456,t=2,p=1$",
        );
        assert!(hash.as_str().contains(costs) && passwords.decoy.as_str().contains(costs));
        assert_eq!(hash.as_str().len(), passwords.decoy.as_str().len());
        // The decoy is really verified: an unreadable hash would be noticed, and a matching one
        // grants nothing.
        let unreadable = Passwords {
            decoy: PasswordHash::stored("nonsense".to_owned()),
            ..Passwords::default()
        };
        assert!(matches!(
            verify(&unreadable, "correct horse battery", None).await,
            Err(PasswordError::Failed)
        ));
        let fitting = Passwords { decoy: hash, ..Passwords::default() };
        assert!(!verify(&fitting, "correct horse battery", None).await.expect("checked"));
    }

    #[test]
    fn obvious_passwords_are_refused() {
        for bad in [
            "short",
            "elevenchars",
            "aliceAlice12",
            "aaaaaaaaaaaaaaa",
            "abababababab",
            &"x1y2z3".repeat(200),
        ] {
            assert!(matches!(check(&alice(), bad), Err(PasswordError::Unacceptable(_))), "{bad:?}");
        }
        for good in
            ["correct horse battery", "twelve chars", "pässwörter sind", "alice in chains live"]
        {
            assert!(check(&alice(), good).is_ok(), "{good:?}");
        }
    }

    #[tokio::test]
    async fn verification_flood_is_refused_beyond_the_queue() {
        let passwords = Passwords::default();
        let (queue, held) =
            (passwords.queue.available_permits(), passwords.slots.available_permits());
        assert!(
            (1..=4).contains(&held) && queue == held + MAX_QUEUED,
            "{held} at once, {queue} in all"
        );
        let mut flood = tokio::task::JoinSet::new();
        // The running verification is held until all requests have arrived.
        let gate = Arc::new(std::sync::Barrier::new(2));
        for _ in 0..held {
            let (passwords, gate) = (passwords.clone(), gate.clone());
            flood.spawn(async move {
                let permit = passwords.permit().await.expect("a permit");
                let wait = move || {
                    gate.wait();
                };
                permit.work(wait).await.is_ok()
            });
        }
        while passwords.slots.available_permits() > 0 {
            tokio::task::yield_now().await;
        }
        for _ in held..queue {
            let passwords = passwords.clone();
            flood.spawn(async move {
                passwords.permit().await.expect("a permit").work(|| ()).await.is_ok()
            });
        }
        while passwords.queue.available_permits() > 0 {
            tokio::task::yield_now().await;
        }
        let turned_away = verify(&passwords, "correct horse battery", None).await;
        for _ in 0..held {
            let gate = gate.clone();
            tokio::task::spawn_blocking(move || {
                gate.wait();
            })
            .await
            .expect("let go");
        }
        assert!(flood.join_all().await.into_iter().all(|is_done| is_done));
        assert!(matches!(turned_away, Err(PasswordError::Busy)), "{turned_away:?}");
    }

    #[tokio::test]
    async fn slot_rests_as_long_as_it_worked() {
        let passwords = Passwords::default();
        let all = u32::try_from(passwords.slots.available_permits()).expect("few");
        let work = || {
            let begun = Instant::now();
            hashed("correct horse battery").expect("hashed");
            (begun.elapsed(), Instant::now())
        };
        let permit = passwords.permit().await.expect("a permit");
        let (worked, done_at) = permit.work(work).await.expect("done");
        let _every_slot = passwords.slots.acquire_many(all).await.expect("open");
        assert!(done_at.elapsed() >= worked, "{:?} after {worked:?}", done_at.elapsed());
    }
}
