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
const GRACE: Duration = Duration::from_secs(3);

/// All unauthenticated connections of one listener.
pub struct UnauthenticatedConnections {
    max_per_address: usize,
    table: Mutex<Table>,
}

#[derive(Default)]
struct Table {
    last_number: u64,
    /// In the order of arrival.
    by_arrival: BTreeMap<u64, Entry>,
    by_address: HashMap<IpAddr, BTreeSet<u64>>,
}

struct Entry {
    /// Absent while it is unknown.
    address: Option<IpAddr>,
    since: Instant,
    evicted: CancellationToken,
}

/// A place, freed on drop: the client has authenticated, or is gone.
pub struct UnauthenticatedConnection {
    connections: Arc<UnauthenticatedConnections>,
    number: u64,
    evicted: CancellationToken,
}

impl UnauthenticatedConnections {
    /// Starts empty, with `max_per_address` for each address.
    pub fn new(max_per_address: usize) -> Arc<Self> {
        Arc::new(Self { max_per_address: max_per_address.max(1), table: Mutex::default() })
    }

    /// Takes a place for a connection from `address`; the longest silent connection of that address
    /// may have to be closed.
    pub fn add(self: &Arc<Self>, address: IpAddr, now: Instant) -> UnauthenticatedConnection {
        let address = network(address);
        let mut table = self.table();
        let neighbours = table
            .by_address
            .get(&address)
            .filter(|neighbours| neighbours.len() >= self.max_per_address);
        if let Some(oldest) = neighbours.and_then(|neighbours| neighbours.first().copied()) {
            table.evict(oldest, now);
        }
        let (number, evicted) = table.insert(Some(address), now);
        UnauthenticatedConnection { connections: self.clone(), number, evicted }
    }

    /// Takes a place for a connection from a proxy that has not named its client yet. The limit per
    /// address does not apply; [`Self::evict_oldest`] does.
    pub fn add_proxied(self: &Arc<Self>, now: Instant) -> UnauthenticatedConnection {
        let (number, evicted) = self.table().insert(None, now);
        UnauthenticatedConnection { connections: self.clone(), number, evicted }
    }

    /// Closes the longest silent connection of any address; false if none has been silent for long.
    pub fn evict_oldest(&self, now: Instant) -> bool {
        let mut table = self.table();
        let oldest = table.by_arrival.keys().next().copied();
        oldest.is_some_and(|oldest| table.evict(oldest, now))
    }

    fn table(&self) -> MutexGuard<'_, Table> {
        // Every change under this lock is complete in itself, so a panic elsewhere leaves nothing
        // half-done.
        self.table.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Table {
    fn insert(&mut self, address: Option<IpAddr>, now: Instant) -> (u64, CancellationToken) {
        self.last_number += 1;
        let (number, evicted) = (self.last_number, CancellationToken::new());
        if let Some(address) = address {
            self.by_address.entry(address).or_default().insert(number);
        }
        self.by_arrival.insert(number, Entry { address, since: now, evicted: evicted.clone() });
        (number, evicted)
    }

    /// Evicts this connection; false if it has not been silent for long.
    fn evict(&mut self, number: u64, now: Instant) -> bool {
        let is_long = |entry: &Entry| now.duration_since(entry.since) >= GRACE;
        if !self.by_arrival.get(&number).is_some_and(is_long) {
            return false;
        }
        self.remove(number).is_some_and(|entry| {
            entry.evicted.cancel();
            true
        })
    }

    fn remove(&mut self, number: u64) -> Option<Entry> {
        let entry = self.by_arrival.remove(&number)?;
        if let Some(address) = entry.address
            && let Some(neighbours) = self.by_address.get_mut(&address)
        {
            neighbours.remove(&number);
            if neighbours.is_empty() {
                self.by_address.remove(&address);
            }
        }
        Some(entry)
    }
}

impl UnauthenticatedConnection {
    /// Cancelled when the connection has to close.
    pub fn evicted(&self) -> &CancellationToken {
        &self.evicted
    }
}

impl Drop for UnauthenticatedConnection {
    fn drop(&mut self) {
        self.connections.table().remove(self.number);
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
    fn new_connection_evicts_the_oldest_of_its_address() {
        let (connections, start) = (UnauthenticatedConnections::new(2), Instant::now());
        let later = start + GRACE;
        let here: IpAddr = "192.0.2.1".parse().expect("an address");
        let elsewhere = connections.add("192.0.2.2".parse().expect("an address"), start);
        let [first, second] = [
            connections.add(here, start),
            connections.add("::ffff:192.0.2.1".parse().expect("an address"), start),
        ];
        assert!(!first.evicted().is_cancelled());
        let third = connections.add(here, later);
        assert!(first.evicted().is_cancelled());
        drop(second);
        let fourth = connections.add(here, later);
        assert!([&third, &fourth, &elsewhere].iter().all(|place| !place.evicted().is_cancelled()));
    }

    #[test]
    fn whole_fleet_authenticates_at_once() {
        let (connections, start) = (UnauthenticatedConnections::new(1), Instant::now());
        let fleet: Vec<UnauthenticatedConnection> =
            (0..50).map(|_| connections.add([192, 0, 2, 1].into(), start)).collect();
        assert!(fleet.iter().all(|place| !place.evicted().is_cancelled()));
    }

    #[test]
    fn oldest_connection_is_evicted_after_the_grace_period() {
        let (connections, start) = (UnauthenticatedConnections::new(9), Instant::now());
        let [oldest, next] = [1, 2].map(|last| connections.add([192, 0, 2, last].into(), start));
        assert!(!connections.evict_oldest(start + GRACE / 2));
        assert!(connections.evict_oldest(start + GRACE));
        assert!(oldest.evicted().is_cancelled() && !next.evicted().is_cancelled());
        drop(next);
        assert!(
            !connections.evict_oldest(start + GRACE),
            "the first has been asked, the second has spoken"
        );
    }

    #[test]
    fn proxied_connection_evicts_none_and_is_evicted_as_the_oldest() {
        let (connections, start) = (UnauthenticatedConnections::new(1), Instant::now());
        let [first, second] = [start, start + GRACE].map(|at| connections.add_proxied(at));
        assert!(!first.evicted().is_cancelled());
        assert!(connections.evict_oldest(start + GRACE));
        assert!(first.evicted().is_cancelled() && !second.evicted().is_cancelled());
        drop((first, second));
        assert!(connections.table().by_arrival.is_empty());
    }

    #[test]
    fn ipv6_network_counts_as_one_address() {
        let (connections, start) = (UnauthenticatedConnections::new(1), Instant::now());
        let first = connections.add("2001:db8::1".parse().expect("an address"), start);
        let other = connections.add("2001:db8:0:1::1".parse().expect("an address"), start);
        assert!(!first.evicted().is_cancelled());
        let _next = connections.add("2001:db8::2".parse().expect("an address"), start + GRACE);
        assert!(first.evicted().is_cancelled() && !other.evicted().is_cancelled());
    }

    #[test]
    fn closed_connections_leave_no_entries() {
        let (connections, start) = (UnauthenticatedConnections::new(1), Instant::now());
        let places: Vec<UnauthenticatedConnection> =
            (0..50).map(|last| connections.add([192, 0, 2, last].into(), start)).collect();
        let same = connections.add([192, 0, 2, 0].into(), start + GRACE);
        drop((places, same));
        assert!(connections.table().by_address.is_empty());
        assert!(connections.table().by_arrival.is_empty());
    }
}
