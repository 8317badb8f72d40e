//! Limits failed password sign-ins per account and per address. If an account has recently signed
//! in from an address, the pair of both has a separate count, and no other count applies to it. So
//! neither strangers elsewhere nor neighbours behind the same address can lock the account's owner
//! out. Every attempt counts as failed until it has succeeded, so concurrent attempts all count.
//! Memory is bounded. This module never sees a password.

use std::collections::HashMap;
use std::hash::Hash;
use std::net::{IpAddr, Ipv6Addr};
use std::sync::{Mutex, MutexGuard, PoisonError};

use task_proto::UserName;

/// Period for which failures count.
const WINDOW_MS: u64 = 15 * 60 * 1000;
/// Maximum failures for one account: from all unfamiliar addresses together, or from one familiar
/// address.
const MOST_FOR_ACCOUNT: u32 = 10;
/// Maximum failures from one address, for accounts unfamiliar there. A whole lab may share one
/// address.
const MOST_FROM_ADDRESS: u32 = 50;
/// Maximum counts of each kind.
const MOST_COUNTS: usize = 8_192;
/// Maximum familiar pairs of account and address.
const MOST_FAMILIAR: usize = 8_192;

#[derive(Debug, Default)]
pub struct SignIns(Mutex<Counts>);

#[derive(Debug, Default)]
struct Counts {
    accounts: Windows<UserName>,
    /// Names without an account: answered like others, but they must not take room from real
    /// accounts.
    nobody: Windows<UserName>,
    addresses: Windows<IpAddr>,
    /// Attempts of which only the address is known. Wrong passwords don't count here, and these
    /// attempts don't count as wrong passwords.
    unnamed: Windows<IpAddr>,
    pairs: Windows<(UserName, IpAddr)>,
    familiar: HashMap<(UserName, IpAddr), u64>,
}

/// Further attempts are refused for a while.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Blocked {
    /// The end of the block.
    pub until_ms: u64,
    /// Whether this is the first refused attempt.
    pub is_news: bool,
}

impl SignIns {
    /// Counts an attempt before it is made. `is_known` tells whether the account exists.
    pub fn begin(
        &self,
        user: &UserName,
        is_known: bool,
        address: IpAddr,
        now_ms: u64,
    ) -> Result<(), Blocked> {
        let address = network(address);
        let mut counts = self.lock();
        let pair = (user.clone(), address);
        if counts.familiar.contains_key(&pair) {
            return counts.pairs.count(pair, MOST_FOR_ACCOUNT, now_ms);
        }
        counts.addresses.count(address, MOST_FROM_ADDRESS, now_ms)?;
        let accounts = if is_known { &mut counts.accounts } else { &mut counts.nobody };
        accounts.count(user.clone(), MOST_FOR_ACCOUNT, now_ms)
    }

    /// Counts an attempt of which only the address is known, before it is made.
    pub fn begin_unnamed(&self, address: IpAddr, now_ms: u64) -> Result<(), Blocked> {
        self.lock().unnamed.count(network(address), MOST_FROM_ADDRESS, now_ms)
    }

    /// The unnamed attempt has succeeded.
    pub fn unnamed_succeeded(&self, address: IpAddr) {
        self.lock().unnamed.take_back(&network(address));
    }

    /// The end of the block for unfamiliar names at the address. A wrong password for a familiar
    /// name gets the same answer, so that an attacker can't learn which names are familiar.
    pub fn blocked_at(&self, address: IpAddr, now_ms: u64) -> Option<Blocked> {
        self.lock().addresses.exceeded(&network(address), MOST_FROM_ADDRESS, now_ms)
    }

    /// The attempt has succeeded: it no longer counts, and the address is now familiar for the
    /// account.
    pub fn succeeded(&self, user: &UserName, address: IpAddr, now_ms: u64) {
        let pair = (user.clone(), network(address));
        let mut counts = self.lock();
        counts.take_back(&pair, true);
        if counts.familiar.len() >= MOST_FAMILIAR && !counts.familiar.contains_key(&pair) {
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
    pub fn given_up(&self, user: &UserName, is_known: bool, address: IpAddr) {
        self.lock().take_back(&(user.clone(), network(address)), is_known);
    }

    fn lock(&self) -> MutexGuard<'_, Counts> {
        // Every change under this lock is complete in itself.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Counts {
    fn take_back(&mut self, pair: &(UserName, IpAddr), is_known: bool) {
        if self.familiar.contains_key(pair) {
            self.pairs.take_back(pair);
        } else {
            self.addresses.take_back(&pair.1);
            let accounts = if is_known { &mut self.accounts } else { &mut self.nobody };
            accounts.take_back(&pair.0);
        }
    }
}

/// Counts that restart when their window is over.
#[derive(Debug)]
struct Windows<K> {
    counts: HashMap<K, Window>,
}

#[derive(Debug)]
struct Window {
    began_ms: u64,
    count: u32,
}

impl<K> Default for Windows<K> {
    fn default() -> Self {
        Self { counts: HashMap::new() }
    }
}

impl<K: Eq + Hash> Windows<K> {
    fn count(&mut self, key: K, most: u32, now_ms: u64) -> Result<(), Blocked> {
        let is_over = |window: &Window| now_ms.saturating_sub(window.began_ms) >= WINDOW_MS;
        if self.counts.len() >= MOST_COUNTS && !self.counts.contains_key(&key) {
            self.counts.retain(|_, window| !is_over(window));
            // An attacker that fills the table with names or addresses gains as many tries as a
            // restart of the server gives.
            if self.counts.len() >= MOST_COUNTS {
                self.counts.clear();
            }
        }
        let window = self.counts.entry(key).or_insert(Window { began_ms: now_ms, count: 0 });
        if is_over(window) {
            *window = Window { began_ms: now_ms, count: 0 };
        }
        window.count = window.count.saturating_add(1);
        if window.count <= most {
            return Ok(());
        }
        Err(Blocked { until_ms: window.began_ms + WINDOW_MS, is_news: window.count == most + 1 })
    }

    /// The end of the block; `None`: more attempts are permitted.
    fn exceeded(&self, key: &K, most: u32, now_ms: u64) -> Option<Blocked> {
        let until_ms = |window: &Window| window.began_ms + WINDOW_MS;
        let window = self
            .counts
            .get(key)
            .filter(|window| window.count > most && now_ms < until_ms(window))?;
        Some(Blocked { until_ms: until_ms(window), is_news: false })
    }

    fn take_back(&mut self, key: &K) {
        if let Some(window) = self.counts.get_mut(key) {
            window.count = window.count.saturating_sub(1);
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

    #[test]
    fn an_account_is_blocked_for_strangers_and_not_for_its_owner() {
        let sign_ins = SignIns::default();
        let alice = user("alice");
        sign_ins.begin(&alice, true, address(1), NOW_MS).expect("allowed");
        sign_ins.succeeded(&alice, address(1), NOW_MS);
        for n in 0..MOST_FOR_ACCOUNT {
            sign_ins.begin(&alice, true, address(100 + n as u8), NOW_MS).expect("allowed");
        }
        let until_ms = NOW_MS + WINDOW_MS;
        let blocked = |is_news| Err(Blocked { until_ms, is_news });
        assert_eq!(sign_ins.begin(&alice, true, address(99), NOW_MS + 1), blocked(true));
        assert_eq!(sign_ins.begin(&alice, true, address(98), NOW_MS + 1), blocked(false));
        assert_eq!(sign_ins.begin(&user("bob"), true, address(99), NOW_MS), Ok(()));
        for _ in 0..MOST_FOR_ACCOUNT {
            sign_ins
                .begin(&alice, true, address(1), NOW_MS + 2)
                .expect("the owner's address has its own count");
        }
        assert!(sign_ins.begin(&alice, true, address(1), NOW_MS + 2).is_err());
        assert_eq!(sign_ins.begin(&alice, true, address(99), until_ms), Ok(()));
    }

    #[test]
    fn an_address_is_blocked_whatever_names_it_tries() {
        let sign_ins = SignIns::default();
        for n in 0..MOST_FROM_ADDRESS {
            sign_ins
                .begin(&user(&format!("user{n}")), n % 2 == 0, address(1), NOW_MS)
                .expect("allowed");
        }
        assert!(sign_ins.begin(&user("alice"), true, address(1), NOW_MS).is_err());
        assert_eq!(sign_ins.begin(&user("alice"), true, address(2), NOW_MS), Ok(()));
        // Neighbours in one IPv6 network count as one, and an IPv4 address stays the same when
        // mapped into IPv6.
        let six = |text: &str| network(text.parse().expect("an address"));
        assert_eq!(six("2001:db8::1"), six("2001:db8::ffff:1:2"));
        assert_ne!(six("2001:db8::1"), six("2001:db8:0:1::1"));
        assert_eq!(six("::ffff:10.0.0.1"), address(1));
    }

    #[test]
    fn account_known_at_an_address_is_not_blocked_by_its_neighbours() {
        let sign_ins = SignIns::default();
        let (alice, ghost) = (user("alice"), user("ghost"));
        sign_ins.begin(&alice, true, address(1), NOW_MS).expect("allowed");
        sign_ins.succeeded(&alice, address(1), NOW_MS);
        assert_eq!(sign_ins.blocked_at(address(1), NOW_MS), None);
        for n in 0..=MOST_FROM_ADDRESS {
            let _ = sign_ins.begin(&user(&format!("user{n}")), false, address(1), NOW_MS);
        }
        let blocked = sign_ins.begin(&ghost, false, address(1), NOW_MS).expect_err("blocked");
        for _ in 0..MOST_FOR_ACCOUNT {
            sign_ins.begin(&alice, true, address(1), NOW_MS).expect("she is known there");
        }
        assert_eq!(
            sign_ins.blocked_at(address(1), NOW_MS),
            Some(blocked),
            "her failures are told like theirs"
        );
        assert_eq!(sign_ins.blocked_at(address(1), NOW_MS + WINDOW_MS), None);
        sign_ins
            .begin_unnamed(address(1), NOW_MS)
            .expect("the provider's sign-ins are counted apart");
    }

    #[test]
    fn what_succeeds_or_is_given_up_does_not_count() {
        let sign_ins = SignIns::default();
        let alice = user("alice");
        for n in 0..10 * MOST_FROM_ADDRESS {
            sign_ins.begin(&alice, true, address(1), NOW_MS).expect("allowed");
            match n % 2 {
                0 => sign_ins.succeeded(&alice, address(1), NOW_MS),
                _ => sign_ins.given_up(&alice, true, address(1)),
            }
        }
    }

    #[test]
    fn a_name_that_nobody_has_is_blocked_like_any_other() {
        let sign_ins = SignIns::default();
        for n in 0..MOST_FOR_ACCOUNT {
            sign_ins.begin(&user("ghost"), false, address(n as u8), NOW_MS).expect("allowed");
        }
        assert!(sign_ins.begin(&user("ghost"), false, address(200), NOW_MS).is_err());
    }

    #[test]
    fn many_names_and_addresses_take_no_more_memory() {
        let sign_ins = SignIns::default();
        for n in 0..2 * MOST_COUNTS as u32 {
            let (name, from) = (user(&format!("u{n}")), IpAddr::from(n.to_be_bytes()));
            let _ = sign_ins.begin(&name, n % 2 == 0, from, NOW_MS);
            sign_ins.succeeded(&name, from, NOW_MS + u64::from(n));
        }
        let counts = sign_ins.lock();
        assert!(
            counts.addresses.counts.len() <= MOST_COUNTS
                && counts.accounts.counts.len() <= MOST_COUNTS
        );
        assert!(
            counts.nobody.counts.len() <= MOST_COUNTS && counts.familiar.len() <= MOST_FAMILIAR
        );
    }
}
