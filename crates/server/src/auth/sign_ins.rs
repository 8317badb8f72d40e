//! Limits failed password sign-ins per account and per address. If an account has recently signed
//! in from an address, the pair of both has a separate count, and no other count applies to it. So
//! neither strangers elsewhere nor neighbours behind the same address can lock the account's owner
//! out. Every attempt counts as failed until it has succeeded, so concurrent attempts all count.
//! The windows of names are kept by the caller; everything else is in memory, which is bounded.
//! This module never sees a password.

use std::collections::HashMap;
use std::hash::Hash;
use std::net::{IpAddr, Ipv6Addr};
use std::sync::{Mutex, MutexGuard, PoisonError};

use hmac::{Hmac, KeyInit as _, Mac as _};
use sha2::Sha256;
use task_proto::UserName;
use task_proto::ids::digest::hex;
use task_proto::trust::envelope::SigningKey;

/// Period for which failures count.
pub const WINDOW_MS: u64 = 15 * 60 * 1000;
/// Maximum failures for one name: from all unfamiliar addresses together, or from one familiar
/// address.
const MAX_FOR_NAME: u64 = 10;
/// Maximum failures from one address, for accounts unfamiliar there. A whole lab may share one
/// address.
const MAX_FROM_ADDRESS: u64 = 50;
/// Maximum counts of each kind.
const MAX_COUNTS: usize = 8_192;
/// Maximum familiar pairs of account and address.
const MAX_FAMILIAR: usize = 8_192;

#[derive(Debug, Default)]
pub struct SignInLimiter(Mutex<Counts>);

#[derive(Debug, Default)]
struct Counts {
    addresses: Windows<IpAddr>,
    /// Attempts of which only the address is known. Wrong passwords don't count here, and these
    /// attempts don't count as wrong passwords.
    anonymous: Windows<IpAddr>,
    pairs: Windows<(UserName, IpAddr)>,
    familiar: HashMap<(UserName, IpAddr), u64>,
}

/// Further attempts are refused for a while.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Blocked {
    /// The end of the block.
    pub until_ms: u64,
    /// Whether this is the first refused attempt.
    pub is_first: bool,
}

/// Whether the account has recently signed in from the address of an attempt.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Familiarity {
    /// The attempt counts for the pair of both alone.
    Familiar,
    /// The attempt counts for the address and for the name.
    Unfamiliar,
}

/// A name at a sign-in in the form that is stored: 64 hex digits, which reveal nothing without the
/// server's key. The name may be a password in the wrong field.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NameDigest(String);

impl NameDigest {
    pub fn of(name: &UserName, key: &SigningKey) -> Self {
        let mut mac =
            Hmac::<Sha256>::new_from_slice(&key.to_bytes()).expect("HMAC takes keys of any length");
        mac.update(b"name at a sign-in ");
        mac.update(name.as_str().as_bytes());
        Self(hex(&mac.finalize().into_bytes()))
    }

    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl SignInLimiter {
    /// Counts an attempt before it is made. The caller counts an unfamiliar one in the [`Window`] of
    /// the name as well.
    pub fn begin(
        &self,
        user: &UserName,
        address: IpAddr,
        now_ms: u64,
    ) -> Result<Familiarity, Blocked> {
        let address = network(address);
        let mut counts = self.lock();
        let pair = (user.clone(), address);
        if counts.familiar.contains_key(&pair) {
            counts.pairs.count(pair, MAX_FOR_NAME, now_ms)?;
            return Ok(Familiarity::Familiar);
        }
        counts.addresses.count(address, MAX_FROM_ADDRESS, now_ms)?;
        Ok(Familiarity::Unfamiliar)
    }

    /// Counts an attempt of which only the address is known, before it is made.
    pub fn begin_anonymous(&self, address: IpAddr, now_ms: u64) -> Result<(), Blocked> {
        self.lock().anonymous.count(network(address), MAX_FROM_ADDRESS, now_ms)
    }

    /// The unnamed attempt has succeeded.
    pub fn anonymous_succeeded(&self, address: IpAddr) {
        self.lock().anonymous.decrement(&network(address));
    }

    /// The end of the block for unfamiliar names at the address. A wrong password for a familiar
    /// name gets the same answer, so that an attacker can't learn which names are familiar.
    pub fn blocked_at(&self, address: IpAddr, now_ms: u64) -> Option<Blocked> {
        self.lock().addresses.active_block(&network(address), MAX_FROM_ADDRESS, now_ms)
    }

    /// The attempt has succeeded: it no longer counts, and the address is now familiar for the
    /// account.
    pub fn succeeded(
        &self,
        user: &UserName,
        address: IpAddr,
        familiarity: Familiarity,
        now_ms: u64,
    ) {
        let pair = (user.clone(), network(address));
        let mut counts = self.lock();
        counts.decrement(&pair, familiarity);
        if counts.familiar.len() >= MAX_FAMILIAR && !counts.familiar.contains_key(&pair) {
            let oldest = counts
                .familiar
                .iter()
                .min_by_key(|(_, since_ms)| **since_ms)
                .map(|(pair, _)| pair.clone());
            oldest.map(|oldest| counts.familiar.remove(&oldest));
        }
        counts.familiar.insert(pair, now_ms);
    }

    /// The attempt was not made after all.
    pub fn cancelled(&self, user: &UserName, address: IpAddr, familiarity: Familiarity) {
        self.lock().decrement(&(user.clone(), network(address)), familiarity);
    }

    fn lock(&self) -> MutexGuard<'_, Counts> {
        // Every change under this lock is complete in itself.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Counts {
    fn decrement(&mut self, pair: &(UserName, IpAddr), familiarity: Familiarity) {
        match familiarity {
            Familiarity::Familiar => self.pairs.decrement(pair),
            Familiarity::Unfamiliar => self.addresses.decrement(&pair.1),
        }
    }
}

/// Counts that restart when their window is over.
#[derive(Debug)]
struct Windows<K> {
    counts: HashMap<K, Window>,
}

/// The attempts of one period.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Window {
    pub began_ms: u64,
    /// Attempts that have not succeeded.
    pub count: u64,
}

impl Window {
    /// The latest window with one more attempt; a new window if that one is over.
    pub fn with_attempt(latest: Option<Self>, now_ms: u64) -> Self {
        let latest = latest.filter(|latest| !latest.is_over(now_ms));
        let Self { began_ms, count } = latest.unwrap_or(Self { began_ms: now_ms, count: 0 });
        Self { began_ms, count: count.saturating_add(1) }
    }

    /// The window without an attempt that has succeeded.
    pub fn without_attempt(self) -> Self {
        Self { count: self.count.saturating_sub(1), ..self }
    }

    /// Refuses the attempt for a name that was just added, if there are too many.
    pub fn check_name(self) -> Result<(), Blocked> {
        self.check(MAX_FOR_NAME)
    }

    /// The block of a name; `None`: more attempts are permitted.
    pub fn name_block(self, now_ms: u64) -> Option<Blocked> {
        self.block(MAX_FOR_NAME, now_ms)
    }

    fn check(self, max: u64) -> Result<(), Blocked> {
        if self.count <= max {
            return Ok(());
        }
        Err(Blocked { until_ms: self.began_ms + WINDOW_MS, is_first: self.count == max + 1 })
    }

    fn block(self, max: u64, now_ms: u64) -> Option<Blocked> {
        let until_ms = self.began_ms + WINDOW_MS;
        (self.count > max && !self.is_over(now_ms)).then_some(Blocked { until_ms, is_first: false })
    }

    /// Also true for a window far in the future, from a clock that was wrong.
    fn is_over(self, now_ms: u64) -> bool {
        now_ms.abs_diff(self.began_ms) >= WINDOW_MS
    }
}

impl<K> Default for Windows<K> {
    fn default() -> Self {
        Self { counts: HashMap::new() }
    }
}

impl<K: Eq + Hash> Windows<K> {
    fn count(&mut self, key: K, max: u64, now_ms: u64) -> Result<(), Blocked> {
        if self.counts.len() >= MAX_COUNTS && !self.counts.contains_key(&key) {
            self.counts.retain(|_, window| !window.is_over(now_ms));
            // An attacker that fills the table with names or addresses gains as many tries as a
            // restart of the server gives.
            if self.counts.len() >= MAX_COUNTS {
                self.counts.clear();
            }
        }
        let window = Window::with_attempt(self.counts.get(&key).copied(), now_ms);
        self.counts.insert(key, window);
        window.check(max)
    }

    /// The end of the block; `None`: more attempts are permitted.
    fn active_block(&self, key: &K, max: u64, now_ms: u64) -> Option<Blocked> {
        self.counts.get(key)?.block(max, now_ms)
    }

    fn decrement(&mut self, key: &K) {
        if let Some(window) = self.counts.get_mut(key) {
            *window = window.without_attempt();
        }
    }
}

/// The network that counts as one address: the owner of one IPv6 address has 2^64 of them.
fn network(address: IpAddr) -> IpAddr {
    match address.to_canonical() {
        IpAddr::V6(address) => {
            IpAddr::V6(Ipv6Addr::from_bits(address.to_bits() & !u128::from(u64::MAX)))
        }
        address => address,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NOW_MS: u64 = 1_000_000;

    fn user(name: &str) -> UserName {
        name.parse().expect("a name")
    }

    fn address(n: u8) -> IpAddr {
        IpAddr::from([10, 0, 0, n])
    }

    /// The limiter, and the window of one account as its caller keeps it.
    #[derive(Default)]
    struct Account {
        sign_ins: SignInLimiter,
        window: Option<Window>,
    }

    impl Account {
        fn begin(&mut self, address: IpAddr, now_ms: u64) -> Result<Familiarity, Blocked> {
            let familiarity = self.sign_ins.begin(&user("alice"), address, now_ms)?;
            if familiarity == Familiarity::Unfamiliar {
                let window = Window::with_attempt(self.window, now_ms);
                self.window = Some(window);
                window.check_name()?;
            }
            Ok(familiarity)
        }

        fn sign_in(&mut self, address: IpAddr, now_ms: u64) {
            let familiarity = self.begin(address, now_ms).expect("allowed");
            self.sign_ins.succeeded(&user("alice"), address, familiarity, now_ms);
            if familiarity == Familiarity::Unfamiliar {
                self.window = self.window.map(Window::without_attempt);
            }
        }
    }

    #[test]
    fn account_is_blocked_for_strangers_and_not_for_its_owner() {
        let mut alice = Account::default();
        alice.sign_in(address(1), NOW_MS);
        for n in 0..MAX_FOR_NAME {
            assert_eq!(alice.window.and_then(|window| window.name_block(NOW_MS)), None);
            alice.begin(address(100 + n as u8), NOW_MS).expect("allowed");
        }
        let until_ms = NOW_MS + WINDOW_MS;
        let blocked = |is_first| Blocked { until_ms, is_first };
        assert_eq!(alice.begin(address(99), NOW_MS + 1), Err(blocked(true)));
        assert_eq!(alice.begin(address(98), NOW_MS + 1), Err(blocked(false)));
        let window = alice.window.expect("attempts were counted");
        assert_eq!(window.name_block(NOW_MS + 1), Some(blocked(false)));
        for _ in 0..MAX_FOR_NAME {
            alice.begin(address(1), NOW_MS + 2).expect("the owner's address has its own count");
        }
        assert!(alice.begin(address(1), NOW_MS + 2).is_err());
        assert_eq!(window.name_block(until_ms), None);
        assert_eq!(alice.begin(address(99), until_ms), Ok(Familiarity::Unfamiliar));
        assert_eq!(alice.window, Some(Window { began_ms: until_ms, count: 1 }));
    }

    #[test]
    fn address_is_blocked_across_all_names() {
        let sign_ins = SignInLimiter::default();
        for n in 0..MAX_FROM_ADDRESS {
            sign_ins.begin(&user(&format!("user{n}")), address(1), NOW_MS).expect("allowed");
        }
        assert!(sign_ins.begin(&user("alice"), address(1), NOW_MS).is_err());
        assert!(sign_ins.begin(&user("alice"), address(2), NOW_MS).is_ok());
        // Neighbours in one IPv6 network count as one, and an IPv4 address stays the same when
        // mapped into IPv6.
        let six = |text: &str| network(text.parse().expect("an address"));
        assert_eq!(six("2001:db8::1"), six("2001:db8::ffff:1:2"));
        assert_ne!(six("2001:db8::1"), six("2001:db8:0:1::1"));
        assert_eq!(six("::ffff:10.0.0.1"), address(1));
    }

    #[test]
    fn account_known_at_an_address_is_not_blocked_by_its_neighbours() {
        let mut alice = Account::default();
        alice.sign_in(address(1), NOW_MS);
        assert_eq!(alice.sign_ins.blocked_at(address(1), NOW_MS), None);
        for n in 0..=MAX_FROM_ADDRESS {
            let _ = alice.sign_ins.begin(&user(&format!("user{n}")), address(1), NOW_MS);
        }
        let blocked =
            alice.sign_ins.begin(&user("ghost"), address(1), NOW_MS).expect_err("blocked");
        for _ in 0..MAX_FOR_NAME {
            alice.begin(address(1), NOW_MS).expect("she is known there");
        }
        assert_eq!(
            alice.sign_ins.blocked_at(address(1), NOW_MS),
            Some(blocked),
            "her failures are told like theirs"
        );
        assert_eq!(alice.sign_ins.blocked_at(address(1), NOW_MS + WINDOW_MS), None);
        alice
            .sign_ins
            .begin_anonymous(address(1), NOW_MS)
            .expect("the provider's sign-ins are counted apart");
    }

    #[test]
    fn successful_and_cancelled_attempts_do_not_count() {
        let mut alice = Account::default();
        for n in 0..10 * MAX_FROM_ADDRESS {
            let from = address(n as u8);
            alice.sign_in(from, NOW_MS);
            let name = user("bob");
            let familiarity = alice.sign_ins.begin(&name, from, NOW_MS).expect("allowed");
            alice.sign_ins.cancelled(&name, from, familiarity);
        }
        assert_eq!(alice.window.expect("it was used").count, 0);
    }

    #[test]
    fn window_from_a_clock_that_was_wrong_is_over() {
        let blocked = |began_ms| Window { began_ms, count: MAX_FOR_NAME + 1 }.name_block(NOW_MS);
        assert!(blocked(NOW_MS + WINDOW_MS - 1).is_some() && blocked(NOW_MS + WINDOW_MS).is_none());
        let stored = Window { began_ms: NOW_MS + WINDOW_MS, count: MAX_FOR_NAME };
        assert_eq!(
            Window::with_attempt(Some(stored), NOW_MS),
            Window { began_ms: NOW_MS, count: 1 }
        );
    }

    #[test]
    fn name_is_stored_as_a_digest_with_the_servers_key() {
        let (one, other) = (SigningKey::random(), SigningKey::random());
        let digest = NameDigest::of(&user("alice"), &one);
        assert_eq!(digest, NameDigest::of(&user("alice"), &one));
        assert_ne!(digest, NameDigest::of(&user("bob"), &one));
        assert_ne!(digest, NameDigest::of(&user("alice"), &other));
        assert!(digest.as_str().len() == 64 && !digest.as_str().contains("alice"));
    }

    #[test]
    fn many_names_and_addresses_take_no_more_memory() {
        let sign_ins = SignInLimiter::default();
        for n in 0..2 * MAX_COUNTS as u32 {
            let (name, from) = (user(&format!("u{n}")), IpAddr::from(n.to_be_bytes()));
            let _ = sign_ins.begin(&name, from, NOW_MS);
            let at_ms = NOW_MS + u64::from(n);
            sign_ins.succeeded(&name, from, Familiarity::Unfamiliar, at_ms);
        }
        let counts = sign_ins.lock();
        assert!(
            counts.addresses.counts.len() <= MAX_COUNTS && counts.familiar.len() <= MAX_FAMILIAR
        );
    }
}
