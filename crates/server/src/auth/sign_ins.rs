//! Limits failed password sign-ins per account and per network. If an account has recently signed
//! in from a network, the pair of both has a separate count, and no other count applies to it. So
//! neither strangers elsewhere nor neighbours behind the same address can lock the account's owner
//! out. Every attempt counts as failed until it has succeeded, so concurrent attempts all count.
//! The caller keeps the windows of names and the familiar networks; everything else is in memory,
//! which is bounded. This module never sees a password.

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
/// Maximum familiar networks of one account.
pub const MAX_FAMILIAR: u32 = 32;

#[derive(Debug, Default)]
pub struct SignInLimiter(Mutex<Counts>);

#[derive(Debug, Default)]
struct Counts {
    networks: Windows<Network>,
    /// Attempts of which only the address is known. Wrong passwords don't count here, and these
    /// attempts don't count as wrong passwords.
    anonymous: Windows<Network>,
    pairs: Windows<(UserName, Network)>,
}

/// The addresses that count as one: the owner of one IPv6 address has 2^64 of them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Network(IpAddr);

impl From<IpAddr> for Network {
    fn from(address: IpAddr) -> Self {
        Self(match address.to_canonical() {
            IpAddr::V6(address) => {
                IpAddr::V6(Ipv6Addr::from_bits(address.to_bits() & !u128::from(u64::MAX)))
            }
            address => address,
        })
    }
}

/// Further attempts are refused for a while.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Blocked {
    /// The end of the block.
    pub until_ms: u64,
    /// Whether this is the first refused attempt.
    pub is_first: bool,
}

/// Whether the account has recently signed in from the network of an attempt.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Familiarity {
    /// The attempt counts for the pair of both alone.
    Familiar,
    /// The attempt counts for the network and for the name.
    Unfamiliar,
}

/// A name at a sign-in in the form that is stored: 64 hex digits, which reveal nothing without the
/// server's key. The name may be a password in the wrong field.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NameDigest(String);

impl NameDigest {
    pub fn of(name: &UserName, key: &SigningKey) -> Self {
        Self(keyed_digest(key, &format!("name at a sign-in {name}")))
    }

    pub fn as_str(&self) -> &str {
        &self.0
    }
}

/// An account and a network from which it has signed in, in the form that is stored: 64 hex digits,
/// so that the database keeps no list of the places of people.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NetworkDigest(String);

impl NetworkDigest {
    pub fn of(user: &UserName, network: Network, key: &SigningKey) -> Self {
        Self(keyed_digest(key, &format!("network of a sign-in {} {user}", network.0)))
    }

    pub fn as_str(&self) -> &str {
        &self.0
    }
}

fn keyed_digest(key: &SigningKey, text: &str) -> String {
    let mut mac =
        Hmac::<Sha256>::new_from_slice(&key.to_bytes()).expect("HMAC takes keys of any length");
    mac.update(text.as_bytes());
    hex(&mac.finalize().into_bytes())
}

impl SignInLimiter {
    /// Counts an attempt before it is made. The caller counts an unfamiliar one in the [`Window`] of
    /// the name as well.
    pub fn begin(
        &self,
        user: &UserName,
        network: Network,
        familiarity: Familiarity,
        now_ms: u64,
    ) -> Result<(), Blocked> {
        let mut counts = self.lock();
        match familiarity {
            Familiarity::Familiar => {
                counts.pairs.count((user.clone(), network), MAX_FOR_NAME, now_ms)
            }
            Familiarity::Unfamiliar => counts.networks.count(network, MAX_FROM_ADDRESS, now_ms),
        }
    }

    /// Counts an attempt of which only the address is known, before it is made.
    pub fn begin_anonymous(&self, address: IpAddr, now_ms: u64) -> Result<(), Blocked> {
        self.lock().anonymous.count(address.into(), MAX_FROM_ADDRESS, now_ms)
    }

    /// The unnamed attempt has succeeded.
    pub fn anonymous_succeeded(&self, address: IpAddr) {
        self.lock().anonymous.decrement(&address.into());
    }

    /// The end of the block for unfamiliar names at the network. A wrong password for a familiar
    /// name gets the same answer, so that an attacker can't learn which names are familiar.
    pub fn blocked_at(&self, network: Network, now_ms: u64) -> Option<Blocked> {
        self.lock().networks.active_block(&network, MAX_FROM_ADDRESS, now_ms)
    }

    /// The attempt has succeeded or was not made after all: it no longer counts.
    pub fn uncount(&self, user: &UserName, network: Network, familiarity: Familiarity) {
        let mut counts = self.lock();
        match familiarity {
            Familiarity::Familiar => counts.pairs.decrement(&(user.clone(), network)),
            Familiarity::Unfamiliar => counts.networks.decrement(&network),
        }
    }

    fn lock(&self) -> MutexGuard<'_, Counts> {
        // Every change under this lock is complete in itself.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
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

#[cfg(test)]
mod tests {
    use super::*;

    const NOW_MS: u64 = 1_000_000;

    fn user(name: &str) -> UserName {
        name.parse().expect("a name")
    }

    fn network(n: u8) -> Network {
        IpAddr::from([10, 0, 0, n]).into()
    }

    /// The limiter, and what its caller keeps of one account.
    #[derive(Default)]
    struct Account {
        sign_ins: SignInLimiter,
        window: Option<Window>,
        familiar: Vec<Network>,
    }

    impl Account {
        fn begin(&mut self, network: Network, now_ms: u64) -> Result<Familiarity, Blocked> {
            let familiarity = match self.familiar.contains(&network) {
                true => Familiarity::Familiar,
                false => Familiarity::Unfamiliar,
            };
            self.sign_ins.begin(&user("alice"), network, familiarity, now_ms)?;
            if familiarity == Familiarity::Unfamiliar {
                let window = Window::with_attempt(self.window, now_ms);
                self.window = Some(window);
                window.check_name()?;
            }
            Ok(familiarity)
        }

        fn sign_in(&mut self, network: Network, now_ms: u64) {
            let familiarity = self.begin(network, now_ms).expect("allowed");
            self.sign_ins.uncount(&user("alice"), network, familiarity);
            if familiarity == Familiarity::Unfamiliar {
                self.window = self.window.map(Window::without_attempt);
            }
            self.familiar.push(network);
        }
    }

    /// An attempt for an account that is unfamiliar at the network.
    fn begin(sign_ins: &SignInLimiter, name: &str, network: Network) -> Result<(), Blocked> {
        sign_ins.begin(&user(name), network, Familiarity::Unfamiliar, NOW_MS)
    }

    #[test]
    fn account_is_blocked_for_strangers_and_not_for_its_owner() {
        let mut alice = Account::default();
        alice.sign_in(network(1), NOW_MS);
        for n in 0..MAX_FOR_NAME {
            assert_eq!(alice.window.and_then(|window| window.name_block(NOW_MS)), None);
            alice.begin(network(100 + n as u8), NOW_MS).expect("allowed");
        }
        let until_ms = NOW_MS + WINDOW_MS;
        let blocked = |is_first| Blocked { until_ms, is_first };
        assert_eq!(alice.begin(network(99), NOW_MS + 1), Err(blocked(true)));
        assert_eq!(alice.begin(network(98), NOW_MS + 1), Err(blocked(false)));
        let window = alice.window.expect("attempts were counted");
        assert_eq!(window.name_block(NOW_MS + 1), Some(blocked(false)));
        for _ in 0..MAX_FOR_NAME {
            alice.begin(network(1), NOW_MS + 2).expect("the owner's address has its own count");
        }
        assert!(alice.begin(network(1), NOW_MS + 2).is_err());
        assert_eq!(window.name_block(until_ms), None);
        assert_eq!(alice.begin(network(99), until_ms), Ok(Familiarity::Unfamiliar));
        assert_eq!(alice.window, Some(Window { began_ms: until_ms, count: 1 }));
    }

    #[test]
    fn address_is_blocked_across_all_names() {
        let sign_ins = SignInLimiter::default();
        for n in 0..MAX_FROM_ADDRESS {
            begin(&sign_ins, &format!("user{n}"), network(1)).expect("allowed");
        }
        assert!(begin(&sign_ins, "alice", network(1)).is_err());
        assert!(begin(&sign_ins, "alice", network(2)).is_ok());
        // Neighbours in one IPv6 network count as one, and an IPv4 address stays the same when
        // mapped into IPv6.
        let six = |text: &str| Network::from(text.parse::<IpAddr>().expect("an address"));
        assert_eq!(six("2001:db8::1"), six("2001:db8::ffff:1:2"));
        assert_ne!(six("2001:db8::1"), six("2001:db8:0:1::1"));
        assert_eq!(six("::ffff:10.0.0.1"), network(1));
    }

    #[test]
    fn account_known_at_an_address_is_not_blocked_by_its_neighbours() {
        let mut alice = Account::default();
        alice.sign_in(network(1), NOW_MS);
        assert_eq!(alice.sign_ins.blocked_at(network(1), NOW_MS), None);
        for n in 0..=MAX_FROM_ADDRESS {
            let _ = begin(&alice.sign_ins, &format!("user{n}"), network(1));
        }
        let blocked = begin(&alice.sign_ins, "ghost", network(1)).expect_err("blocked");
        for _ in 0..MAX_FOR_NAME {
            alice.begin(network(1), NOW_MS).expect("she is known there");
        }
        assert_eq!(
            alice.sign_ins.blocked_at(network(1), NOW_MS),
            Some(blocked),
            "her failures are told like theirs"
        );
        assert_eq!(alice.sign_ins.blocked_at(network(1), NOW_MS + WINDOW_MS), None);
        alice
            .sign_ins
            .begin_anonymous(IpAddr::from([10, 0, 0, 1]), NOW_MS)
            .expect("the provider's sign-ins are counted apart");
    }

    #[test]
    fn successful_and_cancelled_attempts_do_not_count() {
        let mut alice = Account::default();
        for n in 0..10 * MAX_FROM_ADDRESS {
            let from = network(n as u8);
            alice.sign_in(from, NOW_MS);
            begin(&alice.sign_ins, "bob", from).expect("allowed");
            alice.sign_ins.uncount(&user("bob"), from, Familiarity::Unfamiliar);
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
            let from = Network::from(IpAddr::from(n.to_be_bytes()));
            let _ = begin(&sign_ins, &format!("u{n}"), from);
            let _ = sign_ins.begin(&user("alice"), from, Familiarity::Familiar, NOW_MS);
        }
        let Counts { networks, pairs, .. } = &*sign_ins.lock();
        assert!(networks.counts.len() <= MAX_COUNTS && pairs.counts.len() <= MAX_COUNTS);
    }
}
