//! Connections whose client has not said anything yet, by where they come from. Each address has a
//! number of places: when they are taken, a newcomer gets the place of whoever has been silent for
//! longest there, unless nobody has been for long. A listener that is full as a whole may ask the
//! one of all who has. So a crowd of silent connections pushes out itself, while a fleet that comes
//! back at once from behind one address, whose robots speak within moments, is let in whole. It
//! never touches a socket.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::net::{IpAddr, Ipv6Addr};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use tokio_util::sync::CancellationToken;

/// Nobody has to leave sooner: a client may be far away, or one of thousands that a slow machine
/// has to serve.
const PATIENCE: Duration = Duration::from_secs(3);

/// All who wait before one listener.
pub struct Anteroom {
    places: usize,
    waiting: Mutex<Waiting>,
}

#[derive(Default)]
struct Waiting {
    last_number: u64,
    /// In the order of their coming.
    everybody: BTreeMap<u64, Silent>,
    by_address: HashMap<IpAddr, BTreeSet<u64>>,
}

struct Silent {
    address: IpAddr,
    since: Instant,
    leave: CancellationToken,
}

/// A place, given back by dropping it: the client has spoken, or is gone.
pub struct Place {
    room: Arc<Anteroom>,
    number: u64,
    leave: CancellationToken,
}

impl Anteroom {
    /// An empty room with `places` for each address.
    pub fn new(places: usize) -> Arc<Self> {
        Arc::new(Self { places: places.max(1), waiting: Mutex::default() })
    }

    /// Takes a place for a connection from `address`; whoever has been there for longest may have
    /// to leave.
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

    /// Whoever has been here for longest has to leave, wherever it is from; false if nobody has
    /// been here for long.
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
    /// Asks this one to leave; false if it has not been here for long.
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
    /// Ends when the connection has to go.
    pub fn leave(&self) -> &CancellationToken {
        &self.leave
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        self.room.waiting().remove(self.number);
    }
}

/// What one machine can't leave: its address, and with IPv6 the network of which it may have any
/// address.
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
