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
const MOST_WAITING: usize = 32;
/// Minimum password length, in characters.
const SHORTEST: usize = 12;
/// Maximum password length, in bytes.
const LONGEST: usize = 1024;
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
    Unfit(String),
    /// Too many requests are queued.
    #[error("too many sign-ins at once")]
    Busy,
    /// The hash can't be computed, or the stored text is not a hash.
    #[error("a password could not be hashed")]
    Failed,
}

/// Hashes and verifies passwords. Clones share the same limits.
#[derive(Debug, Clone)]
pub struct Passwords {
    turns: Arc<Semaphore>,
    places: Arc<Semaphore>,
    decoy: PasswordHash,
    /// Duration of the last verification, in microseconds.
    took_us: Arc<AtomicU64>,
}

impl Default for Passwords {
    fn default() -> Self {
        // A quarter of the cores, at half of their time.
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let at_once = (cores / 4).clamp(1, 4);
        let places = Arc::new(Semaphore::new(at_once + MOST_WAITING));
        Self {
            turns: Arc::new(Semaphore::new(at_once)),
            places,
            decoy: PasswordHash(DECOY.to_owned()),
            took_us: Arc::default(),
        }
    }
}

impl Passwords {
    /// Hashes a new password of `user`.
    pub async fn hash(
        &self,
        user: &UserName,
        password: &str,
    ) -> Result<PasswordHash, PasswordError> {
        check(user, password)?;
        let password = password.to_owned();
        self.work(move || hashed(&password)).await?
    }

    /// Whether `password` matches the hash. Without a hash the call takes as long, and returns
    /// false.
    pub async fn verify(
        &self,
        password: &str,
        hash: Option<&PasswordHash>,
    ) -> Result<bool, PasswordError> {
        if password.len() > LONGEST {
            return Ok(false);
        }
        let (password, is_there) = (password.to_owned(), hash.is_some());
        let hash = hash.unwrap_or(&self.decoy).clone();
        let begun = Instant::now();
        let checked = self.work(move || {
            match Argon2::default().verify_password(password.as_bytes(), hash.as_str()) {
                Ok(()) => Ok(is_there),
                Err(argon2::password_hash::Error::PasswordInvalid) => Ok(false),
                Err(_) => Err(PasswordError::Failed),
            }
        });
        let checked = checked.await?;
        let took_us = u64::try_from(begun.elapsed().as_micros()).unwrap_or(u64::MAX);
        self.took_us.store(took_us, Ordering::Relaxed);
        checked
    }

    /// Takes as long as the last verification, without its work.
    pub async fn pretend(&self) {
        tokio::time::sleep(Duration::from_micros(self.took_us.load(Ordering::Relaxed))).await;
    }

    async fn work<T: Send + 'static>(
        &self,
        work: impl FnOnce() -> T + Send + 'static,
    ) -> Result<T, PasswordError> {
        let place = self.places.clone().try_acquire_owned().map_err(|_| PasswordError::Busy)?;
        let turn = self.turns.clone().acquire_owned().await.map_err(|_| PasswordError::Busy)?;
        let begun = Instant::now();
        // The work continues if the caller goes away, so its turn must continue too.
        let working = tokio::spawn(async move {
            let done = tokio::task::spawn_blocking(work).await;
            tokio::spawn(rest(begun, turn, place));
            done
        });
        match working.await {
            Ok(Ok(done)) => Ok(done),
            Ok(Err(_)) | Err(_) => Err(PasswordError::Failed),
        }
    }
}

/// Holds the turn for as long again as the work took.
async fn rest(begun: Instant, turn: OwnedSemaphorePermit, place: OwnedSemaphorePermit) {
    tokio::time::sleep(begun.elapsed()).await;
    drop((turn, place));
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
    let unfit = |reason: &str| Err(PasswordError::Unfit(reason.to_owned()));
    if password.chars().count() < SHORTEST {
        return Err(PasswordError::Unfit(format!("it needs at least {SHORTEST} characters")));
    }
    if password.len() > LONGEST {
        return Err(PasswordError::Unfit(format!("it may have at most {LONGEST} bytes")));
    }
    let lower = password.to_lowercase();
    if lower.replace(user.as_str(), "").chars().count() < SHORTEST / 2 {
        return unfit("it is little more than the user's name");
    }
    let mut different: Vec<char> = lower.chars().collect();
    different.sort_unstable();
    different.dedup();
    if different.len() < 5 {
        return unfit("it has too few different characters");
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn alice() -> UserName {
        "alice".parse().expect("a name")
    }

    #[tokio::test]
    async fn a_password_is_known_again_and_no_other_is() {
        let passwords = Passwords::default();
        let hash = passwords.hash(&alice(), "correct horse battery").await.expect("hashed");
        assert!(hash.as_str().starts_with("$argon2id$v=19$m=19456,t=2,p=1$"), "{}", hash.as_str());
        assert!(!format!("{hash:?}").contains("argon2"));
        assert!(passwords.verify("correct horse battery", Some(&hash)).await.expect("checked"));
        for wrong in
            ["correct horse batterz", "", "Correct horse battery", &"x".repeat(LONGEST + 1)]
        {
            assert!(!passwords.verify(wrong, Some(&hash)).await.expect("checked"), "{wrong:?}");
        }
        assert!(!passwords.verify("correct horse battery", None).await.expect("checked"));
        let nonsense = PasswordHash::stored("nonsense".to_owned());
        assert!(matches!(
            passwords.verify("correct horse battery", Some(&nonsense)).await,
            Err(PasswordError::Failed)
        ));
        let again = passwords.hash(&alice(), "correct horse battery").await.expect("hashed");
        assert_ne!(again, hash, "each has its own salt");
    }

    #[tokio::test]
    async fn who_has_no_password_costs_as_much_as_who_has_one() {
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
            unreadable.verify("correct horse battery", None).await,
            Err(PasswordError::Failed)
        ));
        let fitting = Passwords { decoy: hash, ..Passwords::default() };
        assert!(!fitting.verify("correct horse battery", None).await.expect("checked"));
    }

    #[test]
    fn what_anyone_would_try_is_refused() {
        for bad in [
            "short",
            "elevenchars",
            "aliceAlice12",
            "aaaaaaaaaaaaaaa",
            "abababababab",
            &"x1y2z3".repeat(200),
        ] {
            assert!(matches!(check(&alice(), bad), Err(PasswordError::Unfit(_))), "{bad:?}");
        }
        for good in
            ["correct horse battery", "twelve chars", "pässwörter sind", "alice in chains live"]
        {
            assert!(check(&alice(), good).is_ok(), "{good:?}");
        }
    }

    #[tokio::test]
    async fn a_flood_is_turned_away_and_the_rest_gets_its_turn() {
        let passwords = Passwords::default();
        let (places, held) =
            (passwords.places.available_permits(), passwords.turns.available_permits());
        assert!(
            (1..=4).contains(&held) && places == held + MOST_WAITING,
            "{held} at once, {places} in all"
        );
        let mut flood = tokio::task::JoinSet::new();
        // The running verification is held until all requests have arrived.
        let gate = Arc::new(std::sync::Barrier::new(2));
        for _ in 0..held {
            let (passwords, gate) = (passwords.clone(), gate.clone());
            flood.spawn(async move {
                passwords
                    .work(move || {
                        gate.wait();
                    })
                    .await
                    .is_ok()
            });
        }
        while passwords.turns.available_permits() > 0 {
            tokio::task::yield_now().await;
        }
        for _ in held..places {
            let passwords = passwords.clone();
            flood.spawn(async move { passwords.work(|| ()).await.is_ok() });
        }
        while passwords.places.available_permits() > 0 {
            tokio::task::yield_now().await;
        }
        let turned_away = passwords.verify("correct horse battery", None).await;
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
    async fn a_turn_rests_for_as_long_as_it_has_worked() {
        let passwords = Passwords::default();
        let all = u32::try_from(passwords.turns.available_permits()).expect("few");
        let work = || {
            let begun = Instant::now();
            hashed("correct horse battery").expect("hashed");
            (begun.elapsed(), Instant::now())
        };
        let (worked, done_at) = passwords.work(work).await.expect("a turn");
        let _every_turn = passwords.turns.acquire_many(all).await.expect("open");
        assert!(done_at.elapsed() >= worked, "{:?} after {worked:?}", done_at.elapsed());
    }
}
