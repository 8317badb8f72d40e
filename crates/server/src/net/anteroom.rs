//! Limits unauthenticated connections per source address. When an address is at its limit, the
//! connection that has been silent for longest there is closed to admit the new one, unless none
//! has been silent for long. A listener at its total limit may close the longest silent connection
//! of all addresses. So a crowd of silent connections only displaces itself. A fleet that
//! reconnects at once from behind one address is fully admitted, because its robots authenticate
//! within moments. This module never touches a socket.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::net::{IpAddr, Ipv6Addr};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use tokio_util::sync::CancellationToken;

/// Minimum time before a connection is closed: a client may be far away, or one of thousands that a
/// slow machine has to serve.
const PATIENCE: Duration = Duration::from_secs(3);

/// All unauthenticated connections of one listener.
pub struct Anteroom {
    places: usize,
    waiting: Mutex<Waiting>,
}

#[derive(Default)]
struct Waiting {
    last_number: u64,
    /// In the order of arrival.
    everybody: BTreeMap<u64, Silent>,
    by_address: HashMap<IpAddr, BTreeSet<u64>>,
}

struct Silent {
    address: IpAddr,
    since: Instant,
    leave: CancellationToken,
}

/// A place, freed on drop: the client has authenticated, or is gone.
pub struct Place {
    room: Arc<Anteroom>,
    number: u64,
    leave: CancellationToken,
}

impl Anteroom {
    /// Starts empty, with `places` for each address.
    pub fn new(places: usize) -> Arc<Self> {
        Arc::new(Self { places: places.max(1), waiting: Mutex::default() })
    }

    /// Takes a place for a connection from `address`; the longest silent connection of that address
    /// may have to leave.
    pub fn enter(self: &Arc<Self>, address: IpAddr, now: Instant) -> Place {
        let address = network(address);
        let leave = CancellationToken::new();
        let mut waiting = self.waiting();
        let neighbours =
            waiting.by_address.get(&address).filter(|neighbours| neighbours.len() >= self.places);
        if let Some(oldest) = neighbours.and_then(|neighbours| neighbours.first().copied()) {
            waiting.send_away(oldest, now);
        }
        waiting.last_number += 1;
        let number = waiting.last_number;
        waiting.by_address.entry(address).or_default().insert(number);
        waiting.everybody.insert(number, Silent { address, since: now, leave: leave.clone() });
        Place { room: self.clone(), number, leave }
    }

    /// Closes the longest silent connection of any address; false if none has been silent for long.
    pub fn make_room(&self, now: Instant) -> bool {
        let mut waiting = self.waiting();
        let oldest = waiting.everybody.keys().next().copied();
        oldest.is_some_and(|oldest| waiting.send_away(oldest, now))
    }

    fn waiting(&self) -> MutexGuard<'_, Waiting> {
        // Every change under this lock is complete in itself, so a panic elsewhere leaves nothing
        // half-done.
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Waiting {
    /// Asks this connection to leave; false if it has not been silent for long.
    fn send_away(&mut self, number: u64, now: Instant) -> bool {
        let is_long = |silent: &Silent| now.duration_since(silent.since) >= PATIENCE;
        if !self.everybody.get(&number).is_some_and(is_long) {
            return false;
        }
        self.remove(number).is_some_and(|silent| {
            silent.leave.cancel();
            true
        })
    }

    fn remove(&mut self, number: u64) -> Option<Silent> {
        let silent = self.everybody.remove(&number)?;
        if let Some(neighbours) = self.by_address.get_mut(&silent.address) {
            neighbours.remove(&number);
            if neighbours.is_empty() {
                self.by_address.remove(&silent.address);
            }
        }
        Some(silent)
    }
}

impl Place {
    /// Cancelled when the connection has to close.
    pub fn leave(&self) -> &CancellationToken {
        &self.leave
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        self.room.waiting().remove(self.number);
    }
}

/// The addresses that one machine can use: its IPv4 address, or its IPv6 network, in which the
/// machine may have any address.
fn network(address: IpAddr) -> IpAddr {
    match address.to_canonical() {
        IpAddr::V6(address) => {
            Ipv6Addr::from_bits(address.to_bits() & !u128::from(u64::MAX)).into()
        }
        address => address,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_newcomer_takes_the_place_of_its_oldest_neighbour() {
        let (room, start) = (Anteroom::new(2), Instant::now());
        let later = start + PATIENCE;
        let here: IpAddr = "192.0.2.1".parse().expect("an address");
        let elsewhere = room.enter("192.0.2.2".parse().expect("an address"), start);
        let [first, second] = [
            room.enter(here, start),
            room.enter("::ffff:192.0.2.1".parse().expect("an address"), start),
        ];
        assert!(!first.leave().is_cancelled());
        let third = room.enter(here, later);
        assert!(first.leave().is_cancelled());
        drop(second);
        let fourth = room.enter(here, later);
        assert!([&third, &fourth, &elsewhere].iter().all(|place| !place.leave().is_cancelled()));
    }

    #[test]
    fn a_fleet_that_comes_at_once_is_let_in_whole() {
        let (room, start) = (Anteroom::new(1), Instant::now());
        let fleet: Vec<Place> = (0..50).map(|_| room.enter([192, 0, 2, 1].into(), start)).collect();
        assert!(fleet.iter().all(|place| !place.leave().is_cancelled()));
    }

    #[test]
    fn the_oldest_of_all_makes_room_after_a_while() {
        let (room, start) = (Anteroom::new(9), Instant::now());
        let [oldest, next] = [1, 2].map(|last| room.enter([192, 0, 2, last].into(), start));
        assert!(!room.make_room(start + PATIENCE / 2));
        assert!(room.make_room(start + PATIENCE));
        assert!(oldest.leave().is_cancelled() && !next.leave().is_cancelled());
        drop(next);
        assert!(
            !room.make_room(start + PATIENCE),
            "the first has been asked, the second has spoken"
        );
    }

    #[test]
    fn an_ipv6_network_is_one_address() {
        let (room, start) = (Anteroom::new(1), Instant::now());
        let first = room.enter("2001:db8::1".parse().expect("an address"), start);
        let other = room.enter("2001:db8:0:1::1".parse().expect("an address"), start);
        assert!(!first.leave().is_cancelled());
        let _next = room.enter("2001:db8::2".parse().expect("an address"), start + PATIENCE);
        assert!(first.leave().is_cancelled() && !other.leave().is_cancelled());
    }

    #[test]
    fn an_empty_room_remembers_nobody() {
        let (room, start) = (Anteroom::new(1), Instant::now());
        let places: Vec<Place> =
            (0..50).map(|last| room.enter([192, 0, 2, last].into(), start)).collect();
        let same = room.enter([192, 0, 2, 0].into(), start + PATIENCE);
        drop((places, same));
        assert!(room.waiting().by_address.is_empty());
        assert!(room.waiting().everybody.is_empty());
    }
}
